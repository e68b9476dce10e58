"""Thesis figures 10 and 11: steady-state step coefficients over the choke position, for three lift rates."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import xarray as xr
from matplotlib.figure import Figure

from figures import style

MARKERS = ("o", "s", "^")


@contextlib.contextmanager
def draw(data: xr.Dataset, cv: str) -> Iterator[Figure]:
    """The coefficients of one CV.

    Args:
        data: results of the thesis study, with `sweep_coefficient`.
        cv: name of the CV.
    """
    curves = data.sweep_coefficient.sel(cv=cv)
    unit = style.unit(str(data.cv_unit.sel(cv=cv).item()))
    with style.figure(1, row_height=3.6) as (drawn, (axes,)):
        for i, lift in enumerate(curves.sweep_lift.values):
            colour, line = style.SERIES[i % len(style.SERIES)]
            axes.plot(
                curves.sweep_choke.values,
                curves.sel(sweep_lift=lift).values,
                color=colour,
                linestyle=line,
                marker=MARKERS[i % len(MARKERS)],
                markersize=3.2,
                label=f"gas lift {lift:.0f} m³/h",
            )
        axes.axhline(0, color=style.BLACK, linewidth=0.8)
        axes.set_xlim(0, 100)
        axes.set_xlabel("choke position before the step [%]")
        axes.set_ylabel(f"{style.NAMES.get(cv, cv)}: steady change\nper % of choke [{unit} per %]")
        axes.legend()
        yield drawn
