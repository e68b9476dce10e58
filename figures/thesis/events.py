"""Thesis figures 29, 30 (fine regulation of the oil rate) and 31 to 33 (a pressure drop): one run, one event marked."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.thesis import tracking
from jaxmpc.errors import InputError
from studies.store.comparison import provenance


def retuned_at(data: xr.Dataset, controller: str) -> float:
    """When the tuning of a controller changes for the first time [s].

    Raises:
        InputError: if it never does.
    """
    for known in (provenance(data, "definition") or {}).get("controllers", ()):
        if known["name"] == controller and known.get("then"):
            return float(known["then"][0]["at"])
    raise InputError("results.definition", controller, "a controller whose tuning changes during the run")


def disturbed_at(data: xr.Dataset) -> float:
    """When the reservoir pressure first leaves its nominal value [s].

    Raises:
        InputError: if it never does.
    """
    away = np.flatnonzero(data.disturbance.values != 0)
    if not len(away):
        raise InputError("results.disturbance", "0 bar throughout", "a run with a pressure offset")
    return float(data.time.values[away[0]])


@contextlib.contextmanager
def rates(data: xr.Dataset, controller: str, at: float, what: str) -> Iterator[Figure]:
    """Measured CVs with setpoints and deadzones, and the event marked.

    Args:
        data: results.
        controller: name of a finished run.
        at: time of the event [s].
        what: happens there.
    """
    with tracking.rates(data, controller) as drawn:
        _mark(drawn, data, at, what)
        yield drawn


@contextlib.contextmanager
def inputs(data: xr.Dataset, controller: str, at: float, what: str) -> Iterator[Figure]:
    """Choke and lift, and the event marked; arguments of `rates`."""
    with tracking.inputs(data, controller) as drawn:
        _mark(drawn, data, at, what)
        yield drawn


@contextlib.contextmanager
def pressure(data: xr.Dataset) -> Iterator[Figure]:
    """Figure 33: the reservoir-pressure offset of the run; `data` are the results of the study ``disturbance``."""
    with style.figure(1, row_height=2.6) as (drawn, (axes,)):
        seconds = panels.time_axis(axes, *panels.span(data))
        t = np.append(data.time.values, panels.span(data)[1]) / seconds
        values = data.disturbance.values
        axes.step(t, np.append(values, values[-1]), where="post", color=style.BLACK)
        axes.set_ylabel("reservoir pressure:\noffset from nominal [bar]")
        panels.limits(axes, data.disturbance)
        yield drawn


def _mark(drawn: Figure, data: xr.Dataset, at: float, what: str) -> None:
    start, end = panels.span(data)
    seconds = panels.time_unit(start, end)[0]
    for ax in drawn.axes:
        panels.mark(ax, at / seconds, what)
        if ax.get_legend() is not None or ax is drawn.axes[0]:
            panels.legend_above(ax, 4)
