"""Thesis figures 10 and 11: steady-state step coefficients over the choke position, for three lift rates (thesis 4.1.1)."""

from __future__ import annotations

import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.figure import FigureEntry
from studies.thesis.well import GAS, OIL, WELL

MARKERS = ("o", "s", "^")
WORKING_CHOKE = 50.0  # %, where the model is identified


def draw(data: xr.Dataset, cv: str) -> Figure:
    """Three curves, one per gas-lift rate: steady change of the rate per % of choke over the choke."""
    curves = data.sweep_coefficient.sel(cv=cv)
    drawn, (axes,) = style.figure(1, row_height=3.6)
    for lift, mark, (colour, line) in zip(curves.sweep_lift.values, MARKERS, style.SERIES, strict=False):
        look = {"color": colour, "linestyle": line, "marker": mark, "markersize": 3.2}
        values = curves.sel(sweep_lift=lift).values
        axes.plot(curves.sweep_choke.values, values, **look, label=f"gas lift {lift:.0f} m³/h")
    axes.axhline(0, color=style.BLACK, linewidth=0.8)
    axes.set_xlim(0, 100)
    axes.set_xlabel("choke position before the step [%]")
    per = f"{panels.unit_of(data, cv)} per %"
    axes.set_ylabel(f"{WELL.labels[cv]}: steady change\nper % of choke [{per}]")
    axes.legend()
    return drawn


def _caption(data: xr.Dataset, cv: str) -> str:
    curves = data.sweep_coefficient.sel(cv=cv)
    largest = curves.where(curves == curves.max(), drop=True)
    at, lift = float(largest.sweep_choke.values[0]), largest.sweep_lift.values[0]
    working = float(curves.sel(sweep_lift=lift).interp(sweep_choke=WORKING_CHOKE).item())
    return (
        f"The gain of the choke on the {WELL.labels[cv]} depends on where it stands: at a lift of {lift:.0f} m³/h a "
        f"step at {at:.0f} % does {float(curves.max()) / working:.1f} times as much as one at {WORKING_CHOKE:.0f} %, where "
        "the prediction model is identified."
    )


ENTRIES = tuple(
    FigureEntry(
        id,
        f"{WELL.labels[cv]}: steady-state step coefficients over the choke",
        "thesis",
        draw,
        _caption,
        f"{cv.removesuffix('_rate')}_coefficients",
        arguments={"cv": cv},
    )
    for id, cv in (("10", OIL), ("11", GAS))
)
