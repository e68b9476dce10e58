"""Thesis figures 27 and 28: the first plan carried out to its end without feedback, against the closed loop (7.2.3)."""

from __future__ import annotations

import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.figure import FigureEntry
from figures.thesis.facts import settled
from figures.thesis.plans import first_change
from studies.thesis.well import CHOKE, GAS, LIFT, OIL

CLOSED, OPEN = "closed-loop", "open-loop"
CURVES = {CLOSED: {"label": "closed loop"}, OPEN: {"label": "open loop", "color": style.PLAN}}


def compared(data: xr.Dataset, channels: tuple[str, str]) -> Figure:
    """Two plots over time, each with an open-loop and a closed-loop curve."""
    drawn, axes = style.figure(2)
    seconds = panels.time_axis(axes[-1], *panels.span(data))
    for ax, channel in zip(axes, channels, strict=True):
        panels.compared(ax, data, channel, CURVES, seconds, zone=CLOSED)
        panels.mark(ax, first_change(data) / seconds)
        if panels.is_cv(data, channel) or ax is axes[0]:
            panels.legend_above(ax, 4)
    return drawn


def _caption(data: xr.Dataset, channels: tuple[str, str]) -> str:
    if channels == (OIL, GAS):
        off = settled(data, OPEN), settled(data, CLOSED)
        (open_oil, open_gas), (oil, gas) = ((f"{run[OIL]:+.1f}", f"{run[GAS]:+.0f}") for run in off)
        return (
            f"The plan carried out without feedback settles {open_oil} m³/h of oil and {open_gas} m³/h of gas off the "
            f"setpoints, the closed loop {oil} and {gas} m³/h."
        )
    last = data.position.isel(time=-1)
    ends = [
        f"{last.sel(controller=name, mv=CHOKE).item():.0f} % and {last.sel(controller=name, mv=LIFT).item():.0f} m³/h"
        for name in (OPEN, CLOSED)
    ]
    return f"The plan ends at a choke and a lift of {ends[0]}; feedback leads to {ends[1]} instead."


ENTRIES = tuple(
    FigureEntry(
        id,
        f"{words}: open against closed loop",
        "predictions",
        compared,
        _caption,
        f"{kind}_open_loop",
        (CLOSED, OPEN),
        {"channels": channels},
    )
    for id, kind, words, channels in (
        ("27", "rates", "oil and gas rate", (OIL, GAS)),
        ("28", "inputs", "choke and gas lift", (CHOKE, LIFT)),
    )
)
