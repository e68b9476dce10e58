"""Captions of the figures around the thesis comparison, with numbers from the results that are drawn."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

import numpy as np
import xarray as xr

from figures import panels
from figures.facts import index_of, late, reversals, setpoint_after, signed, times
from figures.thesis import events, plans, soft
from studies.definition.presets import CHOKE, GAS, LIFT, OIL
from studies.thesis import integer_example as example
from studies.thesis.integer_example import EXAMPLE
from studies.thesis.plans import plan_at


def optima(_results) -> str:
    """Figure 3."""
    x, near, best = (find(EXAMPLE) for find in (example.relaxed_optimum, example.rounded, example.optimum))
    loss = 100 * (1 - EXAMPLE.value(near) / EXAMPLE.value(best))
    return (
        f"The relaxation of (2.14) has its optimum at ({x[0]}, {x[1]}). Rounded to the nearest feasible integers it is "
        f"({near[0]}, {near[1]}), {float(loss):.1f} % worse than the integer optimum ({best[0]}, {best[1]}) far away."
    )


def hull(_results) -> str:
    """Figure 4."""
    corners = example.hull(example.integer_points(EXAMPLE))
    points = len(example.integer_points(EXAMPLE))
    return (
        f"The {points} feasible integer points of (2.14) and their convex hull of {len(corners)} corners (grey): a linear "
        "program over the hull has the integer optimum as its solution."
    )


def cut(_results) -> str:
    """Figure 5."""
    found = example.best_cut(EXAMPLE)
    u = " and ".join(str(value) for value in found.multipliers)
    right = sum((a * b.limit for a, b in zip(found.multipliers, found.rows, strict=True)), start=Fraction(0))
    return (
        f"A facet of the hull cuts off the relaxed optimum and no integer point. It is the sum of {u} times the two "
        f"rows, its right side {float(right):.2f} rounded down to {found.row.limit}; the relaxation with it has its "
        f"optimum at ({found.optimum[0]}, {found.optimum[1]}), which is the integer one."
    )


def nominal_and_soft(data: xr.Dataset) -> str:
    """Figure 12."""
    count = {name: reversals(data, name) for name in (soft.NOMINAL, soft.SOFT)}
    return (
        f"Without the deadzone the choke reverses {times(count[soft.NOMINAL])} over the run, with Soft MPC "
        f"{times(count[soft.SOFT])}: a small constant deviation of the oil rate is cheap, another move is not."
    )


def penalties(_results) -> str:
    """Figure 13."""
    half = soft.TUNINGS["thesis"]["deadzone"][OIL]
    edge, far = np.array([half]), np.array([10 * half])
    inside, outside = (
        float(soft.penalty("thesis", OIL, d)[0] / soft.penalty("no-soft", OIL, d)[0]) for d in (edge, far)
    )
    return (
        f"The penalty of one sample with the weights of our presets: inside the deadzone Soft MPC charges "
        f"{100 * inside:.0f} % of the nominal controller, at ten times its half width {100 * outside:.0f} %."
    )


def planned(data: xr.Dataset) -> str:
    """Figure 25."""
    plan = plan_at(data, "closed-loop", plans.first_change(data))
    target = setpoint_after(data, plan.time)
    off = {cv: plan.cv[-1, index_of(data.cv, cv)] - target[cv] for cv in (GAS, OIL)}
    choke, lift = (plan.mv[-1, index_of(data.mv, mv)] for mv in (CHOKE, LIFT))
    moving = np.flatnonzero(np.abs(plan.move[:, index_of(data.mv, CHOKE)]) > 0)
    minutes = (moving[-1] + 1) * plan.dt / 60 if moving.size else 0.0
    return (
        f"At the step of the setpoints the controller plans to bring the choke to {choke:.0f} % within {minutes:.1f} "
        f"minutes and the lift to {lift:.0f} m³/h, and expects to end {signed(off[OIL], '.1f')} m³/h of oil and "
        f"{signed(off[GAS], '.0f')} m³/h of gas off the setpoints."
    )


def evolved(data: xr.Dataset) -> str:
    """Figure 26."""
    plan = plan_at(data, "closed-loop", plans.first_change(data))
    end = int(np.searchsorted(data.time.values, plan.cv_time[-1], side="right")) - 1
    run = data.sel(controller="closed-loop").isel(time=end)
    target = setpoint_after(data, plan.time)
    off = {cv: run.measurement.sel(cv=cv).item() - target[cv] for cv in (GAS, OIL)}
    choke, lift = (
        f"{run.position.sel(mv=mv).item():.0f} {unit} (planned {plan.mv[-1, index_of(data.mv, mv)]:.0f} {unit})"
        for mv, unit in ((CHOKE, "%"), (LIFT, "m³/h"))
    )
    return (
        f"What followed: at the end of that horizon the choke stands at {choke} and the lift at {lift}, with oil "
        f"{signed(off[OIL], '.1f')} and gas {signed(off[GAS], '.0f')} m³/h off the setpoints."
    )


def open_loop_rates(data: xr.Dataset) -> str:
    """Figure 27."""
    off = {}
    for name in ("closed-loop", "open-loop"):
        run = late(data.sel(controller=name))
        off[name] = [float((run.measurement - run.setpoint).sel(cv=cv).mean()) for cv in (OIL, GAS)]
    return (
        "The plan carried out without feedback settles "
        f"{signed(off['open-loop'][0], '.1f')} m³/h of oil and {signed(off['open-loop'][1], '.0f')} m³/h of gas off the "
        f"setpoints, the closed loop {signed(off['closed-loop'][0], '.1f')} and "
        f"{signed(off['closed-loop'][1], '.0f')} m³/h."
    )


def open_loop_inputs(data: xr.Dataset) -> str:
    """Figure 28."""
    last = data.position.isel(time=-1)
    ends = [
        f"{last.sel(controller=name, mv=CHOKE).item():.0f} % and {last.sel(controller=name, mv=LIFT).item():.0f} m³/h"
        for name in ("open-loop", "closed-loop")
    ]
    return f"The plan ends at a choke and a lift of {ends[0]}; feedback leads to {ends[1]} instead."


def fine_rates(controller: str) -> Callable[[xr.Dataset], str]:
    """Figure 29."""

    def text(data: xr.Dataset) -> str:
        at = events.retuned_at(data, controller)
        run = data.sel(controller=controller)
        away = run.measurement - run.setpoint
        before = late(away.isel(time=np.flatnonzero(data.time.values < at))).mean("time")
        after = late(away).mean("time")
        return (
            f"Until {at:,.0f} s the controller settles {signed(before.sel(cv=OIL).item(), '.1f')} m³/h of oil and "
            f"{signed(before.sel(cv=GAS).item(), '.0f')} m³/h of gas off two setpoints that are out of reach together. "
            f"Without gas weights the oil rate closes in on its setpoint: {signed(after.sel(cv=OIL).item(), '.1f')} m³/h "
            f"off at the end, and gas {signed(after.sel(cv=GAS).item(), '.0f')} m³/h."
        )

    return text


def event_inputs(controller: str, when: Callable[[xr.Dataset], float]) -> Callable[[xr.Dataset], str]:
    """Figures 30 and 32."""

    def text(data: xr.Dataset) -> str:
        before = int(np.searchsorted(data.time.values, when(data))) - 1
        position = data.position.sel(controller=controller)
        lift, choke = (position.sel(mv=mv).values[[before, -1]] for mv in (LIFT, CHOKE))
        moved = f"the choke from {choke[0]:.0f} to {choke[1]:.0f} %"
        return (
            f"From {when(data):,.0f} s to the end the controller takes the lift from {lift[0]:.0f} to {lift[1]:.0f} m³/h "
            f"and {moved if choke[0] != choke[1] else f'leaves the choke at {choke[0]:.0f} %'}."
        )

    return text


def disturbed_rates(controller: str) -> Callable[[xr.Dataset], str]:
    """Figure 31."""

    def text(data: xr.Dataset) -> str:
        at = events.disturbed_at(data)
        run = data.sel(controller=controller)
        after = run.isel(time=np.flatnonzero(data.time.values >= at))
        away = after.measurement - after.setpoint
        end = late(away).mean("time")
        compromise = (
            " More lift would bring the oil back and take the gas rate up: the weights settle in between."
        )
        return (
            f"The pressure drop takes the oil rate up to {-float(away.sel(cv=OIL).min()):.1f} m³/h below its setpoint. It "
            f"ends {signed(end.sel(cv=OIL).item(), '.1f')} m³/h off, the gas rate "
            f"{signed(end.sel(cv=GAS).item(), '.0f')} m³/h."
            f"{compromise if abs(end.sel(cv=OIL).item()) > panels.soft_half_width(run.sel(cv=OIL)) else ''}"
        )

    return text


def pressure(data: xr.Dataset) -> str:
    """Figure 33."""
    low = float(data.disturbance.min())
    return (
        f"The disturbance of figures 31 and 32: the reservoir pressure changes by {signed(low, 'g')} bar at "
        f"{events.disturbed_at(data):,.0f} s and stays there; the controller is not told."
    )


def without_soft(data: xr.Dataset) -> str:
    """Figure 34."""
    count = {name: times(reversals(data, name)) for name in ("soft", "no-soft", "no-soft-plain")}
    return (
        f"Without Soft MPC the choke reverses {count['no-soft']} over the run, with the extra penalty simply left out "
        f"{count['no-soft-plain']}, with Soft MPC {count['soft']}."
    )


def swing(controller: str, which: int) -> Callable[[xr.Dataset], str]:
    """Figures 36, 37 and 38."""

    def text(data: xr.Dataset) -> str:
        moves = plans.swing_moves(data, controller)
        plan = plan_at(data, controller, moves[which])
        until = moves[which + 1] if which < 2 else min(moves[2] + (moves[2] - moves[1]), plan.cv_time[-1])
        k = int(np.searchsorted(data.time.values, min(until, data.time.values[-1])))
        j = k - int(np.searchsorted(data.time.values, plan.time))
        j = min(j, len(plan.cv))
        run = data.sel(controller=controller).measurement.sel(cv=OIL).values
        start = run[k - j]
        expected, real = plan.cv[j - 1, index_of(data.cv, OIL)] - start, run[k] - start
        size = plan.move[0, index_of(data.mv, CHOKE)]
        return (
            f"The controller turns the choke back by {signed(size, 'g')} % and expects the oil rate to change by "
            f"{signed(expected, '.1f')} m³/h in the next {j * plan.dt:.0f} s; it changes by "
            f"{signed(real, '.1f')} m³/h."
        )

    return text
