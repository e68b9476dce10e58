"""Move blocking (thesis 6.2): responses with 16 blocks and with 200 single moves, and what a step of each costs."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.benchmark import two_digits
from figures.figure import FigureEntry
from figures.thesis.facts import time_note
from studies.definition.presets import CHOKE, OIL

BLOCKS, SINGLE = "blocks", "no-blocks"
TIMED = {  # name: label, colour
    BLOCKS: ("continuous, 16 blocks", style.BLUE),
    SINGLE: ("continuous, 200 moves", style.ORANGE),
    "mixed-integer-blocks": ("mixed-integer, 16 blocks", style.GREEN),
    "mixed-integer-no-blocks": ("mixed-integer, 200 moves", style.PURPLE),
}
MILLISECONDS = 1e3  # of a second


def draw(data: xr.Dataset) -> Figure:
    """Oil rate and choke of the continuous controllers; time of every step of all that have run.

    Args:
        data: results of the study ``unblocked``.
    """
    drawn, (rate, choke, times) = style.figure(3, row_height=2.1)
    seconds = panels.time_axis(times, *panels.span(data))
    for ax, channel in ((rate, OIL), (choke, CHOKE)):
        panels.compared(ax, data, channel, {name: TIMED[name] for name in (BLOCKS, SINGLE)}, seconds, BLOCKS)
        second = next(line for line in ax.lines if line.get_label() == TIMED[SINGLE][0])
        second.set_linestyle((0, (4, 3)))  # both curves of a pair are seen where they are one
    panels.legend_above(rate, 4)
    for name in _timed(data):
        label, colour = TIMED[name]
        milliseconds = MILLISECONDS * data.solve_time.sel(controller=name).values
        times.plot(data.time.values / seconds, milliseconds, ".", markersize=3, color=colour, label=label)
    times.set_yscale("log")
    times.set_ylabel("time per sample [ms]")
    panels.legend_above(times, 2)
    return drawn


def _timed(data: xr.Dataset) -> list[str]:
    finished = data.controller.values[data.complete.values == 1]
    return [name for name in TIMED if name in finished]


def caption(data: xr.Dataset) -> str:
    """How far the responses are apart, and the median times."""
    pair = data.measurement.sel(controller=[BLOCKS, SINGLE])
    half = data.tuning_deadzone.sel(controller=BLOCKS)
    apart = float((np.abs(pair[0] - pair[1]) / half).max())
    medians = ", ".join(
        f"{TIMED[name][0]} {two_digits(MILLISECONDS * float(data.solve_time.sel(controller=name).median()))} ms"
        for name in _timed(data)
    )
    return (
        f"With 16 blocks and with 200 single moves the rates are at most {apart:.2g} half widths of the deadzone apart. "
        f"Median time of one step: {medians}.{time_note(data, _timed(data))}"
    )


ENTRIES = (
    FigureEntry(
        "blocking",
        "what move blocking changes, and what it saves",
        "unblocked",
        "blocking",
        draw,
        caption,
        "Three plots over time: oil rate and choke position of two controllers, and time per sample of each controller.",
        (BLOCKS, SINGLE),
    ),
)
