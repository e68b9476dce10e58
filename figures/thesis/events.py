"""Thesis figures 29, 30 (fine regulation of the oil rate, 7.2.4) and 31 to 33 (a pressure drop, 7.2.5)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.figure import FigureEntry
from figures.panels import between
from figures.thesis import runs
from figures.thesis.facts import settled
from jaxmpc.errors import InputError
from studies.store.reading import provenance
from studies.thesis.well import CHOKE, GAS, LIFT, OIL, WELL

INTEGER = "mixed-integer"
When = Callable[[xr.Dataset, str], float]


def retuned_at(data: xr.Dataset, controller: str) -> float:
    """When the tuning of a controller changes for the first time [s]; an `InputError` if it never does."""
    for known in (provenance(data, "definition") or {}).get("controllers", ()):
        if known["name"] == controller and known.get("then"):
            return float(known["then"][0]["at"])
    raise InputError("results.definition", controller, "a controller whose tuning changes during the run")


def disturbed_at(data: xr.Dataset, _controller: str = INTEGER) -> float:
    """When the reservoir pressure first leaves its nominal value [s]; an `InputError` if it never does."""
    away = np.flatnonzero(offset(data).values != 0)
    if not len(away):
        raise InputError("results.disturbance", "0 bar throughout", "a run with a pressure offset")
    return float(data.time.values[away[0]])


def offset(data: xr.Dataset) -> xr.DataArray:
    """Offset of the reservoir pressure, ``"time"`` [bar]."""
    return data.disturbance.sel(disturbance_name=WELL.disturbance_names[0])


def rates(data: xr.Dataset, controller: str, when: When) -> Figure:
    """Oil rate above gas rate over time, with setpoints and deadzones; a dotted line marks the event."""
    return _marked(runs.rates(data, controller), data, when(data, controller))


def inputs(data: xr.Dataset, controller: str, when: When) -> Figure:
    """Demanded and actual choke above the gas lift over time; a dotted line marks the event."""
    return _marked(runs.inputs(data, controller), data, when(data, controller))


def _marked(drawn: Figure, data: xr.Dataset, at: float) -> Figure:
    drop = float(offset(data).min())
    words = style.minus(f"{drop:+g} bar") if drop else "gas weights zero"
    seconds = panels.time_unit(*panels.span(data))[0]
    for ax in drawn.axes:
        panels.mark(ax, at / seconds, words)
        if ax.get_legend() is not None or ax is drawn.axes[0]:
            panels.legend_above(ax, 4)
    return drawn


def pressure(data: xr.Dataset) -> Figure:
    """A step plot over time: offset of the reservoir pressure."""
    drawn, (axes,) = style.figure(1, row_height=2.6)
    seconds = panels.time_axis(axes, *panels.span(data))
    panels.step(axes, data, offset(data), seconds, color=style.BLACK)
    axes.set_ylabel("reservoir pressure:\noffset from nominal [bar]")
    panels.limits(axes, offset(data))
    return drawn


def _retuned_caption(data: xr.Dataset, controller: str, when: When) -> str:
    at = when(data, controller)
    before, after = settled(between(data, 0.0, at, closed=False), controller), settled(data, controller)
    return (
        f"Until {at:,.0f} s the controller settles {before[OIL]:+.1f} m³/h of oil and "
        f"{before[GAS]:+.0f} m³/h of gas off two setpoints that are out of reach together. "
        f"Without gas weights the oil rate closes in on its setpoint: {after[OIL]:+.1f} m³/h "
        f"off at the end, and gas {after[GAS]:+.0f} m³/h."
    )


def _disturbed_caption(data: xr.Dataset, controller: str, when: When) -> str:
    after = between(data, when(data, controller))
    run = after.sel(controller=controller, cv=OIL)
    fall, end = float((run.setpoint - run.measurement).max()), settled(after, controller)
    text = (
        f"The pressure drop takes the oil rate up to {fall:.1f} m³/h below its setpoint. It ends "
        f"{end[OIL]:+.1f} m³/h off, the gas rate {end[GAS]:+.0f} m³/h."
    )
    if abs(end[OIL]) > panels.soft_half_width(run):
        text += " More lift would bring the oil back and take the gas rate up: the weights settle in between."
    return text


def _inputs_caption(data: xr.Dataset, controller: str, when: When) -> str:
    at = when(data, controller)
    before = int(np.searchsorted(data.time.values, at)) - 1
    position = data.position.sel(controller=controller)
    lift, choke = (position.sel(mv=mv).values[[before, -1]] for mv in (LIFT, CHOKE))
    moved = f"the choke from {choke[0]:.0f} to {choke[1]:.0f} %"
    return (
        f"From {at:,.0f} s to the end the controller takes the lift from {lift[0]:.0f} to {lift[1]:.0f} m³/h "
        f"and {moved if choke[0] != choke[1] else f'leaves the choke at {choke[0]:.0f} %'}."
    )


def _pressure_caption(data: xr.Dataset) -> str:
    return (
        f"The disturbance of figures 31 and 32: the reservoir pressure changes by {float(offset(data).min()):+g} "
        f"bar at {disturbed_at(data):,.0f} s and stays there; the controller is not told."
    )


ENTRIES = (
    *(
        FigureEntry(
            str(id),
            f"{what}: {words}",
            study,
            function,
            caption,
            f"{function.__name__}_{study.replace('-', '_')}",
            (INTEGER,),
            {"controller": INTEGER, "when": when},
        )
        for first, study, what, rates_caption, when in (
            (29, "fine-regulation", "fine regulation of the oil rate", _retuned_caption, retuned_at),
            (31, "disturbance", "drop of the reservoir pressure", _disturbed_caption, disturbed_at),
        )
        for id, words, function, caption in (
            (first, "oil and gas rate", rates, rates_caption),
            (first + 1, "choke and gas lift", inputs, _inputs_caption),
        )
    ),
    FigureEntry("33", "the disturbance", "disturbance", pressure, _pressure_caption, "pressure"),
)
