"""Thesis figures 14, 17, 22 (rates), 15, 18, 23 (inputs) and 16, 19, 24 (bias), of one closed loop each."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style

LEAST = {"choke": 10.0, "gas_lift": 100.0}  # of an axis, so that a few steps of 2 % do not look like much


@contextlib.contextmanager
def rates(data: xr.Dataset, controller: str) -> Iterator[Figure]:
    """Measured CVs with their setpoints and deadzones; limits that hold every controller in `data`.

    Args:
        data: results, whole or a stretch of time or of controllers.
        controller: name of a finished run.
    """
    names = panels.cv_names(data)
    with _stack(data, controller, len(names)) as (drawn, axes, seconds):
        for ax, cv in zip(axes, names, strict=True):
            panels.controlled(ax, data, controller, cv, seconds)
            run = data.sel(controller=controller, cv=cv)
            half = panels.soft_half_width(run)
            panels.limits(ax, data.measurement.sel(cv=cv), run.setpoint - half, run.setpoint + half)
            panels.changes(ax, data, seconds)
        yield drawn


@contextlib.contextmanager
def inputs(data: xr.Dataset, controller: str) -> Iterator[Figure]:
    """Demanded and actual choke position, and the lift rate; arguments of `rates`."""
    with _stack(data, controller, 2) as (drawn, axes, seconds):
        panels.choke(axes[0], data, controller, seconds)
        panels.manipulated(axes[1], data, controller, "gas_lift", seconds)
        for ax, mv in zip(axes, ("choke", "gas_lift"), strict=True):
            panels.limits(ax, data.position.sel(mv=mv), data.demand.sel(mv=mv), least=LEAST[mv])
            panels.changes(ax, data, seconds)
        yield drawn


@contextlib.contextmanager
def bias(data: xr.Dataset, controller: str) -> Iterator[Figure]:
    """Filtered output bias of both CVs; arguments of `rates`."""
    names = panels.cv_names(data)
    with _stack(data, controller, len(names)) as (drawn, axes, seconds):
        for ax, cv in zip(axes, names, strict=True):
            panels.bias(ax, data, controller, cv, seconds)
            panels.limits(ax, data.bias.sel(cv=cv))
            panels.changes(ax, data, seconds)
        yield drawn


@contextlib.contextmanager
def _stack(data: xr.Dataset, controller: str, rows: int):
    with style.figure(rows) as (drawn, axes):
        drawn.suptitle(str(data.label.sel(controller=controller).item()), fontsize=10)
        seconds = panels.time_axis(axes[-1], *panels.span(data))
        yield drawn, axes, seconds
