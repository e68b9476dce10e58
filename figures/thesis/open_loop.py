"""Thesis figures 27 and 28: the first plan carried out to its end without feedback, against the closed loop."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.thesis import plans

RUNS = (("closed-loop", "closed loop", None), ("open-loop", "open loop", style.PLAN))  # name, label, colour


@contextlib.contextmanager
def rates(data: xr.Dataset) -> Iterator[Figure]:
    """Oil and gas rate of both runs; `data` are the results of the study ``predictions``."""
    names = panels.cv_names(data)
    with style.figure(2) as (drawn, axes):
        seconds = panels.time_axis(axes[-1], *panels.span(data))
        for ax, cv in zip(axes, names, strict=True):
            panels.deadzone_lines(ax, data, RUNS[0][0], cv, seconds)
            for name, label, colour in RUNS:
                panels.measured(ax, data, name, cv, seconds, label, colour)
            panels.setpoint(ax, data, cv, seconds)
            panels.mark(ax, plans.first_change(data) / seconds)
            panels.legend_above(ax, 4)
        yield drawn


@contextlib.contextmanager
def inputs(data: xr.Dataset) -> Iterator[Figure]:
    """Choke and lift of both runs; arguments of `rates`."""
    with style.figure(2) as (drawn, axes):
        seconds = panels.time_axis(axes[-1], *panels.span(data))
        for ax, mv in zip(axes, ("choke", "gas_lift"), strict=True):
            for name, label, colour in RUNS:
                panels.manipulated(ax, data, name, mv, seconds, legend=False, label=label, colour=colour)
            panels.mark(ax, plans.first_change(data) / seconds)
        panels.legend_above(axes[0])
        yield drawn
