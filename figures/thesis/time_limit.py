"""What limited solve times cost (thesis 8): gaps of the steps that ended at the limit, wear and deviation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures import style
from figures.figure import FigureEntry
from jaxmpc.status import LIMIT
from studies.kpi.evaluate import key_figures
from studies.thesis.well import CHOKE, OIL


def draw(data: xr.Dataset) -> Figure:
    """Three plots over the time limit: proven gaps of limited steps, choke travel, mean deviation of the oil rate."""
    figures = key_figures(data)
    order = sorted(map(str, figures.controller.values), key=_milliseconds)
    figures = figures.sel(controller=order)
    drawn, ((gaps, travel, deviation),) = style.grid(1, 3, 9.6, 3.4)
    _gap_strips(gaps, data, [name for name in order if name != "exact"])
    away = figures.mean_absolute_deviation.sel(cv=OIL)
    ticks = ["none" if name == "exact" else f"{_milliseconds(name):g} ms" for name in order]
    for ax, values, form, colour, label in (
        (travel, figures.travel.sel(mv=CHOKE), "{:.0f}", style.GREEN, "choke travel [%]"),
        (deviation, away, "{:.2f}", style.BLUE, "mean absolute deviation, oil [m³/h]"),
    ):
        bars = ax.bar(np.arange(len(order)), values.values, 0.6, color=colour)
        ax.bar_label(bars, fmt=form, fontsize=8)
        ax.set_ylabel(label)
        ax.set_xticks(np.arange(len(order)), ticks)
        ax.set_xlabel("time limit of a step")
        ax.grid(axis="x", visible=False)
    return drawn


def _milliseconds(name: str) -> float:
    """The limit in the name of a controller, infinite for the exact one."""
    return np.inf if name == "exact" else float(name.removeprefix("limit-").removesuffix("-ms"))


def _gap_strips(axes: Axes, data: xr.Dataset, names: Sequence[str]) -> None:
    """Certified gaps of the steps that ended at the limit as dots, their median as a bar, their share in words."""
    scatter = np.random.default_rng(0)
    words = []
    for i, name in enumerate(names):
        run = data.sel(controller=name)
        stopped = run.status.values == LIMIT
        gap = 100.0 * run.gap.values[stopped]
        words.append(f"{_milliseconds(name):g} ms\n({100.0 * stopped.mean():.1f} %)")
        if len(gap):
            axes.scatter(i + scatter.uniform(-0.25, 0.25, len(gap)), gap, s=7, color=style.GREY, alpha=0.6)
            axes.hlines(np.median(gap), i - 0.35, i + 0.35, color=style.BLACK, linewidth=2.0)
    axes.set_yscale("log")
    axes.set_xticks(np.arange(len(names)), words)
    axes.set_xlim(-0.5, len(names) - 0.5)  # the last limits may stop no step
    axes.set_ylabel("proven gap of limited steps [%]")
    axes.set_xlabel("time limit of a step (share that reaches it)")
    axes.grid(axis="x", visible=False)


ENTRIES = (
    FigureEntry(
        "time-limit",
        "what limited solve times cost",
        "time-limit",
        draw,
        "A step that ends at its limit applies the best plan found so far. The gaps are what the search could prove by "
        "then, not what the plan lost.",
        needs=("exact",),
    ),
)
