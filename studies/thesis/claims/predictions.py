"""Measures on plans: what one expects, what follows instead, and what comes of it without feedback (7.2.2, 7.2.3)."""

from __future__ import annotations

import numpy as np

from studies.plans import StoredPlan, plan_at
from studies.thesis.claims.limits import FIRST, PLAN_ALIKE, STATIONARY
from studies.thesis.claims.record import Evidence, Finding, Run, index, late_deviation, name_of
from studies.thesis.claims.why import exchange
from studies.thesis.well import CHOKE, GAS, LIFT, OIL


def _changed_at(run: Run) -> int:
    """First sample of the second setpoint window."""
    return int(np.flatnonzero(run.window.values > 0)[0])


def _plan(evidence: Evidence, run: Run) -> StoredPlan:
    """The plan of the step of the setpoints."""
    return plan_at(evidence.data, name_of(run), float(run.time.values[_changed_at(run)]))


def _expected(evidence: Evidence, run: Run) -> np.ndarray:
    """What the plan expects to end off the setpoints, ``"cv"`` [CV unit]."""
    return _plan(evidence, run).cv[-1] - run.setpoint.values[_changed_at(run)]


def beyond_plan(evidence: Evidence, run: Run) -> Finding:
    """Choke and lift go further than planned."""
    plan, k = _plan(evidence, run), _changed_at(run)
    end = min(k + len(plan.cv), run.sizes["time"] - 1)  # the last sample of the horizon that was simulated
    start, reached = run.position.values[k - 1], run.position.values[end]
    beyond = (reached - plan.mv[-1]) * np.sign(plan.mv[-1] - start) > 0
    short_of = [name.replace("_", " ") for name, more in zip((CHOKE, LIFT), beyond, strict=True) if not more]
    numbers = {
        "choke": reached[0],
        "lift": reached[1],
        "planned": plan.mv[-1],
        "short_of": " and ".join(short_of),
        "off": evidence.rates((run.measurement - run.setpoint).values[end]),
        "expected": evidence.rates(_expected(evidence, run)),
    }
    return Finding(tuple(beyond), numbers)


def plan_oil_first(evidence: Evidence, run: Run) -> Finding:
    """The plan leaves less of oil than of gas."""
    off = _expected(evidence, run)
    share = 100 * np.abs(off / run.setpoint.values[_changed_at(run)])
    oil, gas = share[index(run, OIL)], share[index(run, GAS)]
    return Finding((oil < gas,), {"off": evidence.rates(off), "oil": oil, "gas": gas, "worth": exchange(run)})


def feedback_reaches(evidence: Evidence, run: Run) -> Finding:
    """Feedback reaches what the plan did not expect to reach."""
    near = STATIONARY * run.tuning_deadzone.values
    off, real = _expected(evidence, run), late_deviation(run)
    conditions = (np.abs(real) <= near).all(), (np.abs(off) > near).any()
    why = "plan" if conditions[0] else "feedback"
    return Finding(conditions, {"planned": evidence.rates(off), "settled": evidence.rates(real)}, why)


def open_loop_off(evidence: Evidence, closed: Run, blind: Run) -> Finding:
    """The open loop settles off the setpoints, the closed loop does not."""
    off = [late_deviation(run) for run in (blind, closed)]
    far = [np.abs(away) / closed.tuning_deadzone.values > STATIONARY for away in off]
    conditions = far[0].any(), not far[1].any()
    why = "closed" if conditions[0] else "open"
    return Finding(conditions, {"blind": evidence.rates(off[0]), "closed": evidence.rates(off[1])}, why)


def alike_at_first(evidence: Evidence, closed: Run, blind: Run) -> Finding:
    """Open and closed loop respond alike at first."""
    k, dt = _changed_at(closed), float(closed.attrs["dt"])
    step = np.abs(closed.setpoint.values[k] - closed.setpoint.values[k - 1])
    apart = np.abs(blind.measurement - closed.measurement).values[k:] / step
    first = apart[: int(FIRST / dt)].max(axis=0)
    beyond = np.flatnonzero((apart > PLAN_ALIKE / 100).any(axis=1))
    numbers = {
        "first": evidence.rates(100 * first),
        "until": f", alike until {beyond[0] * dt:.0f} s" if beyond.size else "",
    }
    choke = np.abs((blind.position - closed.position).sel(mv=CHOKE).values[k:])
    left = np.flatnonzero(choke > 0.05)
    why = "together"
    if left.size and left[0] > 0:
        more = closed.measurement.values[k + left[0]] - _plan(evidence, closed).cv[left[0] - 1]
        numbers |= {"leaves": left[0] * dt, "off": evidence.rates(more), "apart": choke.max()}
        why = "apart"
    return Finding(tuple(first <= PLAN_ALIKE / 100), numbers, why)
