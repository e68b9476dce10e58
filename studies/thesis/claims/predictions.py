"""Rows on plans: what one expects, what follows instead, and what comes of it without feedback (7.2.2, 7.2.3)."""

from __future__ import annotations

import numpy as np
import xarray as xr

from studies.definition.presets import CHOKE, GAS, LIFT, OIL
from studies.thesis.claims.record import (
    SETTLED,
    STATIONARY,
    Evidence,
    Finding,
    Row,
    both,
    index,
    late_deviation,
)
from studies.thesis.claims.why import exchange
from studies.thesis.plans import StoredPlan, plan_at

ALIKE = 0.1  # of a setpoint step: difference of two responses that count as alike
FIRST = 600.0  # s after the step that are its beginning
PREDICTED = ("closed-loop", "open-loop")


def _changed_at(data: xr.Dataset) -> int:
    """First sample of the second setpoint window."""
    return int(np.flatnonzero(data.window.values > 0)[0])


def _plan(evidence: Evidence) -> tuple[StoredPlan, int]:
    """The plan of the step of the setpoints, and the last sample of its horizon that was simulated."""
    data = evidence.data
    k = _changed_at(data)
    plan = plan_at(data, evidence.roles["closed-loop"], float(data.time.values[k]))
    return plan, min(k + len(plan.cv), data.sizes["time"] - 1)


def _expected(evidence: Evidence) -> np.ndarray:
    """What the plan expects to end off the setpoints, ``"cv"`` [CV unit]."""
    plan, _ = _plan(evidence)
    return plan.cv[-1] - evidence.data.setpoint.values[_changed_at(evidence.data)]


def _beyond_plan(evidence: Evidence) -> Finding:
    plan, end = _plan(evidence)
    run = evidence.run("closed-loop")
    start, reached = run.position.values[_changed_at(evidence.data) - 1], run.position.values[end]
    beyond = (reached - plan.mv[-1]) * np.sign(plan.mv[-1] - start) > 0
    parts = [
        f"{name.replace('_', ' ')} {reached[i]:.{d}f} {unit} (planned {plan.mv[-1, i]:.{d}f})"
        for i, (name, unit, d) in enumerate(((CHOKE, "%", 0), (LIFT, "m3/h", 0)))
    ]
    reached_off, cvs = (run.measurement - run.setpoint).values[end], run.cv.values
    short_of = " and ".join(
        name.replace("_", " ") for name, more in zip((CHOKE, LIFT), beyond, strict=True) if not more
    )
    return Finding(
        ", ".join(parts),
        tuple(bool(more) for more in beyond),
        f"the {short_of} stays short of the plan: with less of it the rates end {both(reached_off, cvs, '+.1f')} off the "
        f"setpoints, where the plan with all of it expects {both(_expected(evidence), cvs, '+.1f')}",
    )


def _plan_oil_first(evidence: Evidence) -> Finding:
    off = _expected(evidence)
    target = evidence.data.setpoint.values[_changed_at(evidence.data)]
    share = 100 * np.abs(off / target)
    run = evidence.run("closed-loop")
    oil, gas = index(run, OIL), index(run, GAS)
    return Finding(
        f"plan ends {both(off, run.cv.values, '+.1f')} off, {share[oil]:.1f} % and {share[gas]:.1f} % of the setpoints",
        (bool(share[oil] < share[gas]),),
        exchange(run),
    )


def _feedback_reaches(evidence: Evidence) -> Finding:
    run, off = evidence.run("closed-loop"), _expected(evidence)
    half, real = evidence.half("closed-loop"), late_deviation(run)
    return Finding(
        f"planned {both(off, run.cv.values, '+.1f')} off, settled {both(real, run.cv.values, '+.1f')} off",
        (bool((np.abs(real) <= STATIONARY * half).all()), bool((np.abs(off) > STATIONARY * half).any())),
        "feedback ends off a setpoint"
        if (np.abs(real) > STATIONARY * half).any()
        else "the plan expects to arrive, too",
    )


def _open_loop_off(evidence: Evidence) -> Finding:
    runs = [evidence.run(name) for name in ("open-loop", "closed-loop")]
    away = [np.abs(late_deviation(run)) / evidence.half("closed-loop") for run in runs]
    cvs = runs[0].cv.values
    texts = [both(late_deviation(run), cvs, "+.1f") for run in runs]
    return Finding(
        f"open loop {texts[0]} off, closed loop {texts[1]}",
        (bool((away[0] > STATIONARY).any()), bool((away[1] <= STATIONARY).all())),
        "the open loop ends within the tolerance of the closed one"
        if not (away[0] > STATIONARY).any()
        else "the closed loop ends off a setpoint",
    )


def _alike_at_first(evidence: Evidence) -> Finding:
    data, k = evidence.data, _changed_at(evidence.data)
    dt = float(data.attrs["dt"])
    blind, closed = (evidence.run(name) for name in ("open-loop", "closed-loop"))
    size = np.abs(data.setpoint.values[k] - data.setpoint.values[k - 1])
    apart = np.abs(blind.measurement.values - closed.measurement.values)[k:] / size
    first = apart[: int(FIRST / dt)].max(axis=0)
    cvs = data.cv.values
    beyond = np.flatnonzero((apart > ALIKE).any(axis=1))
    value = f"apart by {both(100 * first, cvs, '.1f', '%')} of the step within {FIRST:.0f} s"
    if beyond.size:
        value += f", alike until {beyond[0] * dt:.0f} s"
    choke = np.abs((blind.position - closed.position).sel(mv=CHOKE).values[k:])
    left = np.flatnonzero(choke > 0.05)
    said = "the chokes stay together"
    if left.size and left[0] > 0:
        more = closed.measurement.values[k + left[0]] - _plan(evidence)[0].cv[left[0] - 1]
        said = (
            f"the closed loop leaves the plan {left[0] * dt:.0f} s after the step, when the rates are "
            f"{both(more, cvs, '+.1f')} off the prediction; the chokes come to be {choke.max():.0f} % apart"
        )
    return Finding(value, tuple(bool(part <= ALIKE) for part in first), said)


ROWS = (
    Row(
        "plan-oil-first",
        "7.2.2",
        "The plan of a step of the setpoints meets oil nearly and leaves more of gas",
        "last predicted y minus r over r, of the plan made at the step",
        "less for oil than for gas",
        "predictions",
        ("25",),
        PREDICTED[:1],
        _plan_oil_first,
    ),
    Row(
        "beyond-plan",
        "7.2.2, 7.2.3",
        "What follows differs from the plan: choke and lift go beyond it",
        "choke and lift at the end of the horizon of the plan, against its last values",
        "both further from the start than planned (in part: one)",
        "predictions",
        ("25", "26", "28"),
        PREDICTED[:1],
        _beyond_plan,
    ),
    Row(
        "feedback-reaches",
        "7.2.2",
        "Feedback reaches both setpoints, better than the plan expected",
        f"closed loop: {SETTLED}; plan: its last predicted y minus r",
        f"closed loop up to {STATIONARY} half widths for oil and gas, the plan more for one (in part: one of the two)",
        "predictions",
        ("25", "26"),
        PREDICTED[:1],
        _feedback_reaches,
    ),
    Row(
        "alike-at-first",
        "7.2.3",
        "Open and closed loop respond alike at first",
        f"largest |y of the open loop - y of the closed loop| in the first {FIRST:.0f} s, over the step of the setpoint",
        f"up to {100 * ALIKE:.0f} %, oil and gas (in part: one)",
        "predictions",
        ("27",),
        PREDICTED,
        _alike_at_first,
    ),
    Row(
        "open-loop-off",
        "7.2.3",
        "The open loop settles off the setpoints that the closed loop reaches",
        SETTLED,
        f"open loop more than {STATIONARY} half widths for oil or gas, closed loop for none (in part: one of the two)",
        "predictions",
        ("27", "28"),
        PREDICTED,
        _open_loop_off,
    ),
)
