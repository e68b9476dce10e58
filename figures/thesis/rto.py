"""The real-time optimisation of thesis 6.7: where two controllers end in the steady map, and how they get there.

Reads the results of `studies.thesis.rto`. The band of lift that slugs is shaded in every panel that has lift.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures import panels, style
from jaxmpc.errors import InputError
from studies.store.reading import open_results, provenance
from studies.thesis.rto import SETTLED, WITH, WITHOUT
from studies.thesis.well import CHOKE, GAS, LIFT, OIL

CURVES = {
    WITHOUT: {"label": "without RTO", "color": style.GREEN},
    WITH: {"label": "with RTO", "color": style.PURPLE},
}
FORBIDDEN = "#F6DDD3"


@style.house_style
def draw(data: xr.Dataset) -> Figure:
    """The steady map with the end points of each demand; lift, choke and rates over time beside it."""
    ranges = provenance(data, "lift_ranges")
    drawn, spare = style.grid(4, 2, 11.0, 6.8, sharex="col", width_ratios=(1.0, 1.15))
    grid = spare[0, 0].get_gridspec()
    for ax in spare[:, 0]:
        ax.remove()
    _map(drawn.add_subplot(grid[:, 0]), data, ranges)
    lift, choke, oil, gas = axes = spare[:, 1]
    seconds = panels.time_axis(gas, *panels.span(data))
    for ax, mv in ((lift, LIFT), (choke, CHOKE)):
        panels.compared(ax, data, mv, CURVES, seconds)
        target = data.target.sel(controller=WITH, mv=mv)
        panels.dashed(ax, data, target, seconds, "ideal value", CURVES[WITH]["color"])
        panels.limits(ax, data.position.sel(mv=mv), data.target.sel(mv=mv))
    _shade(lift, ranges)
    lift.set_ylim(bottom=0.0)
    for ax, cv in ((oil, OIL), (gas, GAS)):
        _rate(ax, data, cv, seconds)
    for ax in axes:
        panels.changes(ax, data, seconds)
    handles = [h for ax in (lift, oil) for h in ax.get_legend_handles_labels()[0]]
    panels.legend_above(lift, 2, handles=handles)
    drawn.suptitle(str(data.attrs["title"]), fontsize=10.5, x=0.01, ha="left")
    return drawn


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
    return style.save(draw(data), folder / "figures", "rto")


def _shade(axes: Axes, ranges: list[list[float]], label: str | None = None) -> None:
    """Lift between two allowed ranges; the axes have lift upwards."""
    for (_, low), (high, _) in itertools.pairwise(ranges):
        axes.axhspan(low, high, color=FORBIDDEN, linewidth=0, zorder=0.5, label=label)


def _map(axes: Axes, data: xr.Dataset, ranges: list[list[float]]) -> None:
    """Contours of the steady rates, and where each run settles for each demand."""
    _shade(axes, ranges, "slugging: not to settle in")
    choke, lift = data.map_choke.values, data.map_lift.values
    for cv, colour, line in ((OIL, style.BLACK, "-"), (GAS, style.BLUE, "--")):
        rate = data.map_rate.sel(cv=cv).values
        lines = axes.contour(choke, lift, rate, 8, colors=colour, linewidths=0.7, linestyles=line)
        axes.clabel(lines, fontsize=6.5, fmt="%.0f")
        label = f"steady {panels.label_of(data, cv)}"
        axes.plot([], [], color=colour, linewidth=0.7, linestyle=line, label=label)
    window, settled = data.window.values, round(SETTLED / float(data.attrs["dt"]))
    for (name, curve), mark, side in zip(CURVES.items(), "oD", (-1, 1), strict=True):
        run = data.position.sel(controller=name).values
        ends = np.array([run[window == w][-settled:].mean(axis=0) for w in np.unique(window)])
        colour, label = curve["color"], f"settled, {curve['label']}"
        look: dict[str, Any] = {"markersize": 7, "markeredgecolor": "white", "zorder": 4}
        axes.plot(*ends.T, mark, label=label, color=colour, **look)
        note = {"fontsize": 8.5, "weight": "bold", "color": colour, "va": "center", "zorder": 5}
        note |= {"xytext": (7 * side, 5 * side), "ha": "left" if side > 0 else "right"}
        for k, place in enumerate(ends):
            axes.annotate(str(k + 1), place, textcoords="offset points", **note)
    axes.set(xlim=(0, 103), ylim=(-150, lift[-1]))
    axes.set_xlabel(panels.label_of(data, CHOKE))
    axes.set_ylabel(panels.label_of(data, LIFT))
    axes.grid(False)
    panels.legend_above(axes, 2)


def _rate(axes: Axes, data: xr.Dataset, cv: str, seconds: float) -> None:
    """Both runs of a CV, the demand with its deadzone, and the setpoint that the RTO makes of it."""
    demanded = data.demanded.sel(cv=cv)
    half = float(data.tuning_deadzone.sel(cv=cv)[0])
    panels.band(axes, data, demanded, half, seconds, None)
    for name, curve in CURVES.items():
        panels.measured(axes, data, name, cv, seconds, color=curve["color"], label="_measured")
    panels.dashed(axes, data, demanded, seconds, "demand and its deadzone")
    wanted = data.setpoint.sel(controller=WITH, cv=cv)
    panels.dashed(axes, data, wanted, seconds, "setpoint of the RTO", CURVES[WITH]["color"])
    panels.limits(axes, data.measurement.sel(cv=cv), demanded - half, demanded + half)
