"""The real-time optimisation of thesis 6.7: where two controllers end in the steady map, and how they get there.

Reads the results of `studies.thesis.rto`. The band of lift that slugs is shaded in every panel that has lift.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures import panels, style
from jaxmpc.errors import InputError
from studies.store.comparison import open_results, provenance

COLOURS = {"without-rto": style.GREEN, "with-rto": style.PURPLE}
NAMES = {"without-rto": "without RTO", "with-rto": "with RTO"}
MARKERS = {"without-rto": "o", "with-rto": "D"}
FORBIDDEN = "#F6DDD3"
ABOVE: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0, 1.0), "ncols": 2, "borderaxespad": 0.1}
SETTLED = 30  # samples at the end of a window whose mean is where the run has settled


@contextlib.contextmanager
def draw(data: xr.Dataset) -> Iterator[Figure]:
    """The steady map with the end points of each demand; lift, choke and rates over time beside it.

    Args:
        data: results of `studies.thesis.rto`, both runs finished.
    """
    ranges = provenance(data, "lift_ranges")
    with plt.rc_context(style.RC):
        drawn = plt.figure(figsize=(11.0, 6.8))
        try:
            grid = drawn.add_gridspec(4, 2, width_ratios=(1.0, 1.15))
            _map(drawn.add_subplot(grid[:, 0]), data, ranges)
            axes = [drawn.add_subplot(grid[0, 1])]
            axes += [drawn.add_subplot(grid[row, 1], sharex=axes[0]) for row in (1, 2, 3)]
            seconds = panels.time_axis(axes[-1], *panels.span(data))
            for ax, mv in zip(axes, ("gas_lift", "choke"), strict=False):
                _input(ax, data, mv, seconds)
            _shade(axes[0], ranges)
            axes[0].set_ylim(bottom=0.0)
            for ax, cv in zip(axes[2:], ("oil_rate", "gas_rate"), strict=True):
                _rate(ax, data, cv, seconds)
            for ax in axes:
                panels.changes(ax, data, seconds)
                if ax is not axes[-1]:
                    ax.tick_params(labelbottom=False)
            handles = [h for ax in (axes[0], axes[2]) for h in ax.get_legend_handles_labels()[0]]
            axes[0].legend(handles=handles, **ABOVE)
            drawn.suptitle(str(data.attrs["title"]), fontsize=10.5, x=0.01, ha="left")
            yield drawn
        finally:
            plt.close(drawn)


def draw_all(folder: str | Path) -> list[Path]:
    """Draw the figure of a study folder into its ``figures`` folder.

    Returns:
        The files written.

    Raises:
        InputError: if a run is not finished.
    """
    folder = Path(folder)
    data = open_results(folder).load()
    if not (data.complete.values == 1).all():
        raise InputError("results", str(folder), "both runs finished", "Run the study again to finish them")
    with draw(data) as drawn:
        return style.save(drawn, folder / "figures", "rto")


def _shade(axes: Axes, ranges: list[list[float]], label: str | None = None) -> None:
    """Lift between two allowed ranges; the axes have lift upwards."""
    for (_, low), (high, _) in itertools.pairwise(ranges):
        axes.axhspan(low, high, color=FORBIDDEN, linewidth=0, zorder=0.5, label=label)


def _map(axes: Axes, data: xr.Dataset, ranges: list[list[float]]) -> None:
    """Contours of the steady rates, and where each run settles for each demand."""
    _shade(axes, ranges, "slugging: not to settle in")
    choke, lift = data.map_choke.values, data.map_lift.values
    for cv, colour, line in (("oil_rate", style.BLACK, "-"), ("gas_rate", style.BLUE, "--")):
        lines = axes.contour(
            choke, lift, data.map_rate.sel(cv=cv).values, 8, colors=colour, linewidths=0.7, linestyles=line
        )
        axes.clabel(lines, fontsize=6.5, fmt="%.0f")
        name = style.label(cv, str(data.cv_unit.sel(cv=cv).item()))
        axes.plot([], [], color=colour, linewidth=0.7, linestyle=line, label=f"steady {name}")
    window = data.window.values
    for name, colour in COLOURS.items():
        run = data.position.sel(controller=name)
        ends = np.array(
            [run.values[np.flatnonzero(window == w)[-SETTLED:]].mean(axis=0) for w in np.unique(window)]
        )
        label = f"settled, {NAMES[name]}"
        axes.plot(
            ends[:, 0],
            ends[:, 1],
            linestyle="none",
            marker=MARKERS[name],
            markersize=7,
            color=colour,
            markeredgecolor="white",
            label=label,
            zorder=4,
        )
        for k, (x, y) in enumerate(ends):
            side = -1 if name == "without-rto" else 1
            axes.annotate(
                str(k + 1),
                (x, y),
                xytext=(7 * side, 5 * side),
                textcoords="offset points",
                fontsize=8.5,
                weight="bold",
                color=colour,
                ha="left" if side > 0 else "right",
                va="center",
                zorder=5,
            )
    axes.set_xlim(0, 103)
    axes.set_ylim(-150, lift[-1])
    axes.set_xlabel(style.label("choke", str(data.mv_unit.sel(mv="choke").item())))
    axes.set_ylabel(style.label("gas_lift", str(data.mv_unit.sel(mv="gas_lift").item())))
    axes.grid(False)
    axes.legend(**ABOVE)


def _input(axes: Axes, data: xr.Dataset, mv: str, seconds: float) -> None:
    """Both runs of an MV, and its target dashed."""
    for name, colour in COLOURS.items():
        panels.manipulated(axes, data, name, mv, seconds, label=NAMES[name], colour=colour)
    target = data.target.sel(controller="with-rto", mv=mv).values
    _dashed(axes, data, target, seconds, COLOURS["with-rto"], "input target")
    panels.limits(axes, data.position.sel(mv=mv), data.target.sel(mv=mv))


def _rate(axes: Axes, data: xr.Dataset, cv: str, seconds: float) -> None:
    """Both runs of a CV, the demand with its deadzone, and the setpoint that the RTO makes of it."""
    demanded = data.demanded.sel(cv=cv)
    half = float(data.tuning_deadzone.sel(cv=cv)[0])
    t = np.append(data.time.values, panels.span(data)[1]) / seconds
    held = np.append(demanded.values, demanded.values[-1])
    axes.fill_between(t, held - half, held + half, step="post", color=style.BAND, linewidth=0)
    for name, colour in COLOURS.items():
        panels.measured(axes, data, name, cv, seconds, label="_measured", colour=colour)
    _dashed(axes, data, demanded.values, seconds, style.BLACK, "demand and its deadzone")
    setpoint = data.setpoint.sel(controller="with-rto", cv=cv).values
    _dashed(axes, data, setpoint, seconds, COLOURS["with-rto"], "setpoint of the RTO")
    panels.limits(axes, data.measurement.sel(cv=cv), demanded - half, demanded + half)


def _dashed(
    axes: Axes, data: xr.Dataset, values: np.ndarray, seconds: float, colour: str, label: str
) -> None:
    t = np.append(data.time.values, panels.span(data)[1]) / seconds
    held = np.append(values, values[-1])
    axes.step(t, held, where="post", color=colour, linestyle="--", linewidth=1.0, label=label)
