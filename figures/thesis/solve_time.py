"""Thesis figure 39: time of every controller step over the run, continuous and mixed-integer MPC (chapter 8)."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import benchmark
from figures.figure import FigureEntry
from figures.thesis.facts import time_note

MILLISECONDS = 1e3  # of a second
TIMED = ("step-choke", "mixed-integer")


def draw(data: xr.Dataset, controllers: tuple[str, ...]) -> Figure:
    """One panel per controller, on one logarithmic axis.

    Args:
        data: results of the thesis study.
        controllers: names of finished runs of different kinds.
    """
    runs = [data.sel(controller=name) for name in controllers]
    return benchmark.time_per_sample(
        [
            (str(run.kind.item()), str(run.blocking.item()), MILLISECONDS * run.solve_time.values)
            for run in runs
        ]
    )


def caption(data: xr.Dataset, controllers: tuple[str, ...]) -> str:
    """Median and longest time of each."""
    parts = []
    for name in controllers:
        ms = MILLISECONDS * data.solve_time.sel(controller=name).values
        kind = str(data.kind.sel(controller=name).item())
        parts.append(f"{kind} MPC {np.median(ms):.1f} / {ms.max():.0f} ms")
    return (
        f"Median and longest time of one step: {', '.join(parts)}; the sampling interval is "
        f"{float(data.attrs['dt']):.0f} s.{time_note(data, controllers)}"
    )


ENTRIES = (
    FigureEntry(
        "39",
        "computation time of every sample: continuous and mixed-integer MPC",
        "thesis",
        "figure_39_solve_time",
        draw,
        caption,
        "Two scatter plots over time on a logarithmic axis: milliseconds of each controller step.",
        TIMED,
        {"controllers": TIMED},
    ),
)
