"""Gain scheduling (thesis 8): one model against a schedule of models, where the choke is nearly closed."""

from __future__ import annotations

import itertools

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures import panels, style
from figures.figure import FigureEntry
from studies.kpi.evaluate import key_figures
from studies.thesis.well import CHOKE, GAS, OIL

NEAR_CLOSED = 6500.0  # m3/h, gas setpoints below it need a choke of less than about 12 %
PAIRS = {  # one model and schedule, in words
    "with Soft MPC": ("single", "scheduled"),
    "without": ("single-no-soft", "scheduled-no-soft"),
    "rounded": ("rounded", "rounded-scheduled"),
}
_COLOURS = (style.GREEN, style.BLUE, style.PURPLE, style.ORANGE, style.VERMILLION, style.SKY)
COLOURS = dict(zip(itertools.chain(*PAIRS.values()), _COLOURS, strict=True))
RATE_SHOWN, CHOKE_SHOWN = (55.0, 135.0), (0.0, 20.0)  # m3/h of oil, %


def near_closed(data: xr.Dataset) -> xr.Dataset:
    """The stretch from the first to the last window with a target that needs a nearly closed choke."""
    low = np.flatnonzero(data.setpoint.sel(cv=GAS).values < NEAR_CLOSED)
    return data.isel(time=slice(low[0], low[-1] + 1))


def draw(data: xr.Dataset) -> Figure:
    """Oil rate and choke over time in two columns, with and without Soft MPC; below, bars of reversals per window."""
    zoom = near_closed(data)
    drawn, axes = style.grid(3, 2, 9.6, 7.1)
    for column, (words, pair) in zip(axes[:2].T, list(PAIRS.items())[:2], strict=True):
        rate, choke = column
        rate.sharex(choke)
        rate.tick_params(labelbottom=False)
        seconds = panels.time_axis(choke, *panels.span(zoom), bins=6)
        words_of = zip(pair, ("one model", "scheduled"), strict=True)
        curves = {name: {"label": text, "color": COLOURS[name]} for name, text in words_of}
        for ax, channel in zip(column, (OIL, CHOKE), strict=True):
            panels.compared(ax, zoom, channel, curves, seconds, zone=pair[0])
        rate.set_title(words if "Soft" in words else f"{words} Soft MPC")
        rate.legend(loc="upper right", ncols=2)
    for row, shown in zip(axes[:2], (RATE_SHOWN, CHOKE_SHOWN), strict=True):
        row[1].sharey(row[0])
        row[1].set_ylabel("")
        row[0].set_ylim(*shown)
    whole = axes[2, 0].get_gridspec()[2, :]
    for unused in axes[2]:
        unused.remove()
    _reversal_bars(drawn.add_subplot(whole), data)
    return drawn


def _reversal_bars(axes: Axes, data: xr.Dataset) -> None:
    """Choke reversals in the second half of every window, one bar per controller."""
    figures = key_figures(data)
    names = [name for name in COLOURS if name in figures.controller.values]
    windows = figures.sizes["window"]
    width = 0.85 / len(names)
    for i, name in enumerate(names):
        run = figures.sel(controller=name)
        at = np.arange(windows) + (i - 0.5 * (len(names) - 1)) * width
        label = str(run.label.item()).replace("mixed-integer MPC", "MIMPC").replace("continuous MPC", "MPC")
        axes.bar(at, run.late_reversals.sel(mv=CHOKE).values, width, color=COLOURS[name], label=label)
    first = np.searchsorted(data.window.values, np.arange(windows))
    oil = data.setpoint.sel(cv=OIL).values[first]
    axes.set_xticks(np.arange(windows), [f"{value:g}" for value in oil])
    axes.set_xlabel("window, by its oil setpoint [m³/h]")
    axes.set_ylabel("late reversals [1]")
    axes.grid(axis="x", visible=False)
    axes.legend(ncols=2, fontsize=7.5, loc="upper left")
    axes.set_ylim(top=1.5 * max(1.0, axes.get_ylim()[1]))


def _caption(data: xr.Dataset) -> str:
    late = key_figures(data).late_reversals.sel(mv=CHOKE).sum("window")
    counts = "; ".join(
        f"{words} {int(late.sel(controller=one))} and {int(late.sel(controller=two))}"
        for words, (one, two) in PAIRS.items()
    )
    return (
        "One model from half open underestimates what the choke does near closed several times over. Reversals in the "
        f"second halves of the windows with one model and with a schedule: {counts}. Rounding hunts for another reason."
    )


ENTRIES = (
    FigureEntry(
        "gain-scheduling",
        "one model against a gain schedule, near closed",
        "gain-scheduling",
        draw,
        _caption,
        needs=tuple(COLOURS),
    ),
)
