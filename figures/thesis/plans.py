"""Thesis figures 25, 26 (a plan, and what came of it) and 36 to 38 (prediction against response in an oscillation).

The past is white and what lies ahead grey; `figures.planned` draws it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import panels, style
from figures.figure import FigureEntry
from figures.planned import BEFORE, draw_plan, index_of
from figures.thesis.facts import oil_first
from jaxmpc.errors import InputError
from studies.plans import StoredPlan, plan_at
from studies.thesis.reach import NEAR_CLOSED, turns
from studies.thesis.well import CHOKE, GAS, LIFT, OIL

SWING = (300.0, 600.0)  # s, at least, to show before and after the moves of an oscillation
WORDS = ("first", "second", "third")
PREDICTED = "closed-loop"  # the controller of figures 25 to 28


def planned(data: xr.Dataset, controller: str) -> Figure:
    """Six plots over time: rates, inputs and their moves; past on white, a plan with its prediction on grey."""
    data = oil_first(data)
    plan = plan_at(data, controller, first_change(data))
    return _six_panels(data, controller, plan, known=plan.time)


def evolved(data: xr.Dataset, controller: str) -> Figure:
    """Six plots over time: rates, inputs and their moves; what happened, and the first plan dashed."""
    data = oil_first(data)
    plan = plan_at(data, controller, first_change(data))
    return _six_panels(data, controller, plan, known=np.inf, grey=False, line="--")


def _six_panels(data: xr.Dataset, controller: str, plan: StoredPlan, **options: Any) -> Figure:
    start, end = panels.span(data)
    drawn, rows = style.grid(3, 2, 9.6, 6.5, sharex=True)
    shown = max(plan.time - BEFORE * plan.dt, start), min(float(plan.cv_time[-1]), end)
    draw_plan(rows, data, controller, plan, shown, **options)
    panels.shared_legend(drawn, rows.flat)
    return drawn


def swing(data: xr.Dataset, controller: str, which: int) -> Figure:
    """Four plots over time: oil and gas rate with prediction and response, choke and lift with the plan.

    `which` of the three moves of an oscillation: 0, 1 or 2.
    """
    data = oil_first(data)
    moves = swing_moves(data, controller)
    plan = plan_at(data, controller, moves[which])
    length = moves[2] - moves[0]
    start = max(moves[0] - max(SWING[0], length / 2), panels.span(data)[0])
    end = min(moves[2] + max(SWING[1], length), panels.span(data)[1])
    drawn, rows = style.grid(2, 2, 9.6, 4.5, sharex=True)
    draw_plan(rows, data, controller, plan, (start, end), known=np.inf)
    size = style.minus(f"{plan.move[0, index_of(data.mv, CHOKE)]:+g}")
    title = f"{WORDS[which]} turn: choke {size} % at {plan.time:,.0f} s"
    panels.shared_legend(drawn, rows.flat, title=title)
    return drawn


def first_change(data: xr.Dataset) -> float:
    """When the setpoints change for the first time [s]."""
    return float(data.time.values[int(np.flatnonzero(data.window.values > 0)[0])])


def swing_moves(data: xr.Dataset, controller: str) -> tuple[float, float, float]:
    """Times [s] of three successive moves that turn the choke back, the quickest three of the busiest window.

    The window is the one in which the choke turns back most often, below half open if it does so there.

    Raises:
        InputError: if the choke turns back fewer than three times in every window.
    """
    window = data.window.values
    run = data.sel(controller=controller)
    turn = turns(run, window)
    near = turn & (run.position.sel(mv=CHOKE).values < NEAR_CLOSED)
    turn = near if np.bincount(window, weights=near).max() >= 3 else turn
    at = np.flatnonzero(turn & (window == np.bincount(window, weights=turn).argmax()))
    if len(at) < 3:
        raise InputError("controller", controller, "a run whose choke turns back three times at one setpoint")
    first = int(np.argmin(at[2:] - at[:-2]))
    one, two, three = data.time.values[at[first : first + 3]].tolist()
    return one, two, three


def _planned_caption(data: xr.Dataset, controller: str) -> str:
    plan = plan_at(data, controller, first_change(data))
    end = dict(zip(map(str, data.mv.values), plan.mv[-1], strict=True))
    off = _off_setpoint(data, plan, dict(zip(map(str, data.cv.values), plan.cv[-1], strict=True)))
    moving = np.flatnonzero(np.abs(plan.move[:, index_of(data.mv, CHOKE)]) > 0)
    minutes = (moving[-1] + 1) * plan.dt / 60 if moving.size else 0.0
    return (
        f"At the step of the setpoints the controller plans to bring the choke to {end[CHOKE]:.0f} % within {minutes:.1f} "
        f"minutes and the lift to {end[LIFT]:.0f} m³/h, and expects to end {off[OIL]:+.1f} m³/h of oil "
        f"and {off[GAS]:+.0f} m³/h of gas off the setpoints."
    )


def _evolved_caption(data: xr.Dataset, controller: str) -> str:
    plan = plan_at(data, controller, first_change(data))
    end = int(np.searchsorted(data.time.values, plan.cv_time[-1], side="right")) - 1
    run = data.sel(controller=controller).isel(time=end)
    off = _off_setpoint(data, plan, {cv: run.measurement.sel(cv=cv).item() for cv in (GAS, OIL)})
    choke, lift = (
        f"{run.position.sel(mv=mv).item():.0f} {unit} (planned {plan.mv[-1, index_of(data.mv, mv)]:.0f} {unit})"
        for mv, unit in ((CHOKE, "%"), (LIFT, "m³/h"))
    )
    return (
        f"What followed: at the end of that horizon the choke stands at {choke} and the lift at {lift}, with oil "
        f"{off[OIL]:+.1f} and gas {off[GAS]:+.0f} m³/h off the setpoints."
    )


def _off_setpoint(data: xr.Dataset, plan: StoredPlan, cv: dict[str, float]) -> dict[str, float]:
    """CVs above the setpoints of the time of a plan."""
    row = data.setpoint.isel(time=int(np.searchsorted(data.time.values, plan.time)))
    return {name: value - float(row.sel(cv=name)) for name, value in cv.items()}


def _swing_caption(data: xr.Dataset, controller: str, which: int) -> str:
    moves = swing_moves(data, controller)
    plan = plan_at(data, controller, moves[which])
    until = moves[which + 1] if which < 2 else min(moves[2] + (moves[2] - moves[1]), plan.cv_time[-1])
    k = int(np.searchsorted(data.time.values, min(until, data.time.values[-1])))
    j = min(k - int(np.searchsorted(data.time.values, plan.time)), len(plan.cv))
    run = data.sel(controller=controller).measurement.sel(cv=OIL).values
    start = run[k - j]
    expected, real = plan.cv[j - 1, index_of(data.cv, OIL)] - start, run[k] - start
    return (
        f"The controller turns the choke back by {plan.move[0, index_of(data.mv, CHOKE)]:+g} % and expects the "
        f"oil rate to change by {expected:+.1f} m³/h in the next {j * plan.dt:.0f} s; it changes by "
        f"{real:+.1f} m³/h."
    )


ENTRIES = (
    *(
        FigureEntry(id, title, "predictions", draw, caption, slug, (PREDICTED,), {"controller": PREDICTED})
        for id, title, draw, caption, slug in (
            (
                "25",
                "plan of the mixed-integer MPC at a step of the setpoints",
                planned,
                _planned_caption,
                "plan",
            ),
            ("26", "evolution after that step", evolved, _evolved_caption, "evolution"),
        )
    ),
    *(
        FigureEntry(
            str(36 + which),
            f"prediction and response at the {word} turn of an oscillation",
            "without-soft",
            swing,
            _swing_caption,
            f"prediction_{which + 1}",
            ("no-soft",),
            {"controller": "no-soft", "which": which},
        )
        for which, word in enumerate(WORDS)
    ),
)
