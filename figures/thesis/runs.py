"""Thesis figures 14 to 24, 34 and 35: rates, inputs and output bias of one closed loop (thesis 7.1, 7.2.1, 7.2.6).

Figures 20 and 21 show the stretch in which the rounded controller oscillates most.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures import panels, style
from figures.figure import FigureEntry
from figures.panels import between
from figures.thesis.facts import reversals, times
from jaxmpc.errors import InputError
from studies.kpi import loop as kpi
from studies.thesis.reach import NEAR_CLOSED, choke_moves, turns
from studies.thesis.well import CHOKE, GAS, LIFT, OIL

SMOOTH, ROUNDED, INTEGER, HARD = "continuous-choke", "step-choke", "mixed-integer", "no-soft"
COMPARED = ("soft", HARD, "no-soft-plain")  # controllers with and without Soft MPC
LEAST = {CHOKE: 10.0, LIFT: 100.0}  # of an axis, so that a few steps of 2 % do not look like much
SWINGS = 8  # reversals to show in a close-up
MARGIN = 0.1  # of the stretch, before and after
SHORTEST = 600.0  # s


def rates(data: xr.Dataset, controller: str) -> Figure:
    """Oil rate above gas rate over time: measured, the setpoint dashed, and the deadzone if there is one.

    Vertical limits hold every controller in `data`.
    """
    drawn, axes, seconds = _stack(data, controller, 2)
    for ax, cv in zip(axes, (OIL, GAS), strict=True):
        panels.controlled(ax, data, controller, cv, seconds)
        run = data.sel(controller=controller, cv=cv)
        half = panels.soft_half_width(run)
        panels.limits(ax, data.measurement.sel(cv=cv), run.setpoint - half, run.setpoint + half)
    return drawn


def inputs(data: xr.Dataset, controller: str) -> Figure:
    """Demanded and actual choke position above the gas-lift rate over time."""
    drawn, axes, seconds = _stack(data, controller, 2)
    for ax, mv in zip(axes, (CHOKE, LIFT), strict=True):
        panels.manipulated(ax, data, controller, mv, seconds, demand=mv == CHOKE)
        panels.limits(ax, data.position.sel(mv=mv), data.demand.sel(mv=mv), least=LEAST[mv])
    panels.legend_above(axes[0])
    return drawn


def bias(data: xr.Dataset, controller: str) -> Figure:
    """Filtered output bias of the oil rate above that of the gas rate over time."""
    drawn, axes, seconds = _stack(data, controller, 2)
    for ax, cv in zip(axes, (OIL, GAS), strict=True):
        panels.bias(ax, data, controller, cv, seconds)
        panels.limits(ax, data.bias.sel(cv=cv))
    return drawn


def close_up_rates(data: xr.Dataset, controller: str) -> Figure:
    """Oil rate above gas rate in the short stretch in which the controller oscillates most."""
    return rates(stretch(data, controller), controller)


def close_up_inputs(data: xr.Dataset, controller: str) -> Figure:
    """Choke above gas lift in the short stretch in which the controller oscillates most."""
    return inputs(stretch(data, controller), controller)


def _stack(data: xr.Dataset, controller: str, rows: int) -> tuple[Figure, list[Axes], float]:
    drawn, axes = style.figure(rows)
    drawn.suptitle(str(data.label.sel(controller=controller).item()), fontsize=10)
    seconds = panels.time_axis(axes[-1], *panels.span(data))
    for ax in axes:
        panels.changes(ax, data, seconds)
    return drawn, axes, seconds


def oscillating_stretch(data: xr.Dataset, controller: str) -> tuple[float, float]:
    """Start and end [s] of a close-up: up to `SWINGS` reversals in the second half of a setpoint window.

    The window is the one with most choke reversals below 50 % there; an `InputError` if the choke never reverses there.
    """
    late = kpi.second_halves(data.window.values)
    run = data.sel(controller=controller)
    event = turns(run, late) & (run.position.sel(mv=CHOKE).values < NEAR_CLOSED)
    counts = np.asarray(kpi.count_by_segment(event, late, int(late.max()) + 1))
    if counts.max() == 0:
        expected = f"a run whose choke reverses below {NEAR_CLOSED:.0f} % in some window"
        raise InputError("figure 20", controller, expected)
    window = int(counts.argmax())
    at = np.flatnonzero(event & (late == window))[:SWINGS]
    dt = float(data.attrs["dt"])
    start, end = data.time.values[at[0]], data.time.values[at[-1]] + dt
    margin = max(MARGIN * (end - start), (SHORTEST - (end - start)) / 2)
    inside = data.time.values[data.window.values == window]
    return max(start - margin, float(inside[0])), min(end + margin, float(inside[-1]) + dt)


def stretch(data: xr.Dataset, controller: str) -> xr.Dataset:
    """The controller's results in that stretch of time."""
    start, end = oscillating_stretch(data, controller)
    return between(data.sel(controller=[controller]), start, end, closed=False)


def _rates_caption(data: xr.Dataset, controller: str) -> str:
    run = data.sel(controller=controller)
    off = np.abs(run.measurement - run.setpoint).mean("time")
    others = ", ".join(
        f"{data.label.sel(controller=name).item()} {times(reversals(data, name))}"
        for name in data.controller.values
        if name != controller and data.complete.sel(controller=name) == 1
    )
    return (
        f"Mean absolute deviation from the setpoints: gas {off.sel(cv=GAS).item():.0f} m³/h, oil "
        f"{off.sel(cv=OIL).item():.1f} m³/h, targets out of reach included. The choke reverses "
        f"{times(reversals(data, controller))}{f' ({others})' if others else ''}."
    )


def _inputs_caption(data: xr.Dataset, controller: str) -> str:
    run = data.sel(controller=controller)
    choke = run.position.sel(mv=CHOKE)
    return (
        f"The choke travels {np.abs(choke_moves(run)).sum():.0f} % between {choke.min().item():.0f} and "
        f"{choke.max().item():.0f} % and reverses {times(reversals(data, controller))}; the lift travels "
        f"{np.abs(run.move.sel(mv=LIFT)).sum().item():,.0f} m³/h."
    )


def _bias_caption(data: xr.Dataset, controller: str) -> str:
    size = np.abs(data.bias.sel(controller=controller)).max("time")
    return (
        "What the linear model leaves unexplained of the measurements, filtered: up to "
        f"{size.sel(cv=GAS).item():.0f} m³/h of gas and {size.sel(cv=OIL).item():.0f} m³/h of oil. Every prediction "
        "is corrected by that much."
    )


def _close_up_rates_caption(data: xr.Dataset, controller: str) -> str:
    part = stretch(data, controller).sel(controller=controller)
    swing = part.measurement.max("time") - part.measurement.min("time")
    choke = part.position.sel(mv=CHOKE)
    return (
        f"With the choke between {choke.min().item():.0f} and {choke.max().item():.0f} % gas swings over "
        f"{swing.sel(cv=GAS).item():.0f} m³/h and oil over {swing.sel(cv=OIL).item():.1f} m³/h."
    )


def _close_up_inputs_caption(data: xr.Dataset, controller: str) -> str:
    part = stretch(data, controller)
    minutes = (part.time.values[-1] - part.time.values[0]) / 60
    return (
        f"In these {minutes:.0f} minutes the choke reverses {times(reversals(part, controller))}: the controller asks "
        "for positions between two steps and gets the one or the other, once its demand is far enough away."
    )


def _without_soft_caption(data: xr.Dataset, controller: str) -> str:
    soft, hard, plain = (times(reversals(data, name)) for name in COMPARED)
    return (
        f"Without Soft MPC the choke reverses {hard} over the run, with the extra penalty simply left out "
        f"{plain}, with Soft MPC {soft}."
    )


_RATES = ("rates", "oil and gas rate", rates, _rates_caption)
_INPUTS = ("inputs", "choke and gas lift", inputs, _inputs_caption)
_BIAS = ("bias", "output bias", bias, _bias_caption)
_WHOLE = (_RATES, _INPUTS, _BIAS)
_CLOSE_UPS = (
    (*_RATES[:2], close_up_rates, _close_up_rates_caption),
    (*_INPUTS[:2], close_up_inputs, _close_up_inputs_caption),
)
_HARD = ((*_RATES[:3], _without_soft_caption), _INPUTS)
_GROUPS = (  # of successive figures: controller, number of the first, what it shows, study, files, and what they are
    (SMOOTH, 14, ": continuous MPC, continuous choke", "thesis", "continuous_choke", _WHOLE),
    (ROUNDED, 17, ": continuous MPC, step choke", "thesis", "step_choke", _WHOLE),
    (ROUNDED, 20, " while the rounded controller oscillates", "thesis", "oscillating", _CLOSE_UPS),
    (INTEGER, 22, ": mixed-integer MPC", "thesis", "mixed_integer", _WHOLE),
    (HARD, 34, ": mixed-integer MPC without Soft MPC", "without-soft", "without_soft", _HARD),
)

ENTRIES = tuple(
    FigureEntry(
        str(first + i),
        f"{words}{what}",
        study,
        function,
        caption,
        f"{kind}_{file}",
        COMPARED if caption is _without_soft_caption else (controller,),
        {"controller": controller},
    )
    for controller, first, what, study, file, kinds in _GROUPS
    for i, (kind, words, function, caption) in enumerate(kinds)
)
