"""Move blocking (thesis 6.2): responses with 16 blocks and with 200 single moves, and what a step of each costs."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.figure import FigureEntry
from figures.thesis.solve_time import MILLISECONDS, time_note, two_digits
from studies.thesis.well import CHOKE, OIL

BLOCKS, SINGLE = "blocks", "no-blocks"
TIMED: dict[str, dict[str, Any]] = {
    BLOCKS: {"label": "continuous, 16 blocks", "color": style.BLUE},
    SINGLE: {"label": "continuous, 200 moves", "color": style.ORANGE},
    "mixed-integer-blocks": {"label": "mixed-integer, 16 blocks", "color": style.GREEN},
    "mixed-integer-no-blocks": {"label": "mixed-integer, 200 moves", "color": style.PURPLE},
}
PAIR: dict[str, dict[str, Any]] = {  # both curves are seen where they are one
    BLOCKS: TIMED[BLOCKS],
    SINGLE: {**TIMED[SINGLE], "linestyle": (0, (4, 3))},
}


def draw(data: xr.Dataset) -> Figure:
    """Three plots over time: oil rate and choke position of two controllers, and time per sample of each controller."""
    drawn, (rate, choke, times) = style.figure(3, row_height=2.1)
    seconds = panels.time_axis(times, *panels.span(data))
    for ax, channel in ((rate, OIL), (choke, CHOKE)):
        panels.compared(ax, data, channel, PAIR, seconds, BLOCKS)
    panels.legend_above(rate, 4)
    for name in _timed(data):
        milliseconds = MILLISECONDS * data.solve_time.sel(controller=name).values
        times.plot(data.time.values / seconds, milliseconds, ".", markersize=3, **TIMED[name])
    times.set_yscale("log")
    times.set_ylabel("time per sample [ms]")
    panels.legend_above(times, 2)
    return drawn


def _timed(data: xr.Dataset) -> list[str]:
    finished = data.controller.values[data.complete.values == 1]
    return [name for name in TIMED if name in finished]


def _caption(data: xr.Dataset) -> str:
    pair = data.measurement.sel(controller=[BLOCKS, SINGLE])
    half = data.tuning_deadzone.sel(controller=BLOCKS)
    apart = float((np.abs(pair[0] - pair[1]) / half).max())
    median = MILLISECONDS * data.solve_time.median("time")
    medians = ", ".join(
        f"{TIMED[name]['label']} {two_digits(float(median.sel(controller=name)))} ms" for name in _timed(data)
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
        draw,
        _caption,
        needs=(BLOCKS, SINGLE),
    ),
)
