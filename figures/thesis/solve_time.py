"""Thesis figure 39: time of every controller step over the run, continuous and mixed-integer MPC."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import xarray as xr
from matplotlib.figure import Figure

from figures import benchmark

MILLISECONDS = 1e3  # of a second


@contextlib.contextmanager
def draw(data: xr.Dataset, controllers: tuple[str, ...]) -> Iterator[Figure]:
    """One panel per controller, on one logarithmic axis.

    Args:
        data: results of the thesis study.
        controllers: names of finished runs of different kinds.
    """
    series = {}
    for name in controllers:
        run = data.sel(controller=name)
        kind, mode = str(run.kind.item()), str(run.blocking.item())
        series[f"run {kind} {mode}"] = {"solve_ms": (MILLISECONDS * run.solve_time.values).tolist()}
    with benchmark.time_per_sample(series) as drawn:
        yield drawn
