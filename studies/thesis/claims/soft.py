"""Measures on Soft MPC: its penalty, the oscillation near a closed choke that it removes, and its cause (6.4, 7.2.6)."""

from __future__ import annotations

import itertools

import numpy as np

from studies.kpi.loop import second_halves
from studies.plans import plan_at
from studies.thesis import reach
from studies.thesis.claims.limits import FAR, FAR_MORE, HUNTING, MOST, NEARLY_CLOSED
from studies.thesis.claims.record import Evidence, Finding, Run, index, name_of
from studies.thesis.claims.why import horizon_cost
from studies.thesis.well import CHOKE, OIL


def turns(run: Run) -> np.ndarray:
    """Whether the choke turns back, both moves in one setpoint window, ``"sample"``."""
    return reach.turns(run, run.window.values)


def turns_by_window(run: Run) -> np.ndarray:
    """How often the choke turns back in every setpoint window, ``"window"``."""
    window = run.window.values
    return np.bincount(window[turns(run)], minlength=int(window.max()) + 1)


def _said(run: Run) -> str:
    counts = turns_by_window(run)
    total = counts.sum()
    return f"{total} reversal{'s' if total != 1 else ''}, up to {counts.max()} in a window"


def oscillates(evidence: Evidence, run: Run) -> Finding:
    """The choke swings, near closed, and goes on swinging."""
    turned, window, time = turns(run), run.window.values, run.time.values
    closed = (turned & (run.position.sel(mv=CHOKE).values < NEARLY_CLOSED)).sum()
    lasting = (turned & (second_halves(window) >= 0)).sum()
    total = turned.sum()
    numbers = {"said": _said(run), "closed": closed, "total": total, "lasting": lasting}
    if total:
        last = np.flatnonzero(turned)[-1]
        numbers["after"] = time[last] - time[window == window[last]][0]
    conditions = turns_by_window(run).max() >= HUNTING, closed > total / 2, lasting >= HUNTING
    return Finding(conditions, numbers, "dies" if total else "still")


def removes(evidence: Evidence, *runs: Run) -> Finding:
    """With Soft MPC, the run ``soft``, no window oscillates; without it, the other run, one does."""
    run, hard = sorted(runs, key=lambda one: name_of(one) != "soft")
    counts, without = turns_by_window(run), turns_by_window(hard)
    numbers = {"with": _said(run), "without": _said(hard)}
    if without.max() < HUNTING:
        return Finding((), numbers)
    worst = np.flatnonzero(run.window.values == counts.argmax())
    last, time = worst[turns(run)[worst]], run.time.values
    if last.size:
        numbers |= {"where": evidence.starts(int(counts.argmax())), "count": last.size}
        numbers |= {"after": time[last[-1]] - time[worst[0]], "rest": time[worst[-1]] - time[last[-1]]}
    return Finding((counts.max() < HUNTING,), numbers)


def _penalty(run: Run, half_widths: float) -> np.ndarray:
    """What a sample that is some half widths of the deadzone off costs, ``"cv"``."""
    off = half_widths * run.tuning_deadzone.values
    return np.array([horizon_cost(run, alone[None]) for alone in np.diag(off)])


def penalises_less(evidence: Evidence, nominal: Run, soft: Run) -> Finding:
    """Soft MPC charges less inside the deadzone and about the same far outside."""
    inside, outside = (_penalty(soft, at) / _penalty(nominal, at) for at in (1.0, FAR))
    conditions = (inside < 1).all(), (np.abs(outside - 1) <= 0.25).all()
    numbers = {"inside": evidence.rates(100 * inside), "outside": evidence.rates(100 * outside)}
    return Finding(conditions, numbers, "outside" if conditions[0] else "inside")


def better(evidence: Evidence, *runs: Run) -> Finding:
    """Soft MPC turns and travels less than without its penalty, or with a hard weight in place of it."""
    count = [turns(run).sum() for run in runs]
    way = [evidence.figure("travel", run) for run in runs]
    cheap = _penalty(runs[2], FAR) / _penalty(runs[0], FAR)
    conditions = tuple(count[0] < count[i] and way[0] < way[i] for i in (1, 2))
    return Finding(conditions, {"count": count, "way": way, "cheap": 100 * cheap.min()})


def responses(run: Run, data: Run) -> np.ndarray:
    """Predicted and actual change of the CVs from a turn of the choke to the next, ``"turn kind cv"`` [CV unit].

    Args:
        run: of one controller, whose turns are looked at, at most `MOST` of them.
        data: the results that it is from, with the plans.
    """
    at, window, y = np.flatnonzero(turns(run)), run.window.values, run.measurement.values
    out = []
    for k, end in itertools.pairwise(at):
        if window[k] != window[end] or end - k > int(run.prediction_horizon) or len(out) == MOST:
            continue
        plan = plan_at(data, name_of(run), float(run.time.values[k]))
        out.append([plan.cv[end - k - 1] - y[k], y[end] - y[k]])
    return np.array(out).reshape(-1, 2, run.sizes["cv"])


def mismatch(evidence: Evidence, run: Run) -> Finding:
    """The well answers the turns of the choke far more than predicted."""
    found = np.abs(responses(run, evidence.data))
    if not len(found):
        return Finding((), {}, instead="no two turns of the choke in one window")
    ratio = np.median(found[:, 1] / np.maximum(found[:, 0], 1e-9), axis=0)
    oil = index(run, OIL)
    expected, came = np.median(found, axis=0)[:, oil]
    numbers = {"ratio": evidence.rates(ratio), "came": came, "expected": expected, "count": len(found)}
    return Finding((ratio[oil] > 1, (ratio > FAR_MORE).all()), numbers)
