"""Measures on what the runs of the thesis comparison settle at, and on the bias (6.3, 7.1.1, 7.1.2, 7.2.1)."""

from __future__ import annotations

import numpy as np

from studies.kpi.evaluate import final_deviation, quarters
from studies.kpi.loop import second_halves
from studies.thesis.claims.comparison import hunting, off_windows
from studies.thesis.claims.limits import FULL, NEARLY_CLOSED, OUT_OF_REACH, STATIONARY, STEP
from studies.thesis.claims.record import Evidence, Finding, Run, index, name_of, short, swing
from studies.thesis.claims.why import compromise, exchange
from studies.thesis.reach import NEAR_CLOSED, distance_to_reach
from studies.thesis.well import CHOKE, GAS, OIL

# ------------------------------------------------------------------------------------------------ convergence


def converges(evidence: Evidence, run: Run) -> Finding:
    """Most windows end at their setpoints, and soon."""
    arrived, window = ~off_windows(evidence, run), run.window.values
    outside = (np.abs(run.measurement.values - run.setpoint.values) > run.tuning_deadzone.values).any(axis=1)
    times = []
    for w in np.flatnonzero(arrived):
        out = np.flatnonzero(outside[window == w])
        times.append((out[-1] + 1 if out.size else 0) * float(run.attrs["dt"]))
    soon = ""
    if times:
        soon = f"; both rates are inside their deadzones for good after {np.median(times):.0f} s (median)"
    reach = (distance_to_reach(evidence.data) <= OUT_OF_REACH).sum()
    numbers = {"arrived": arrived.sum(), "count": len(arrived), "soon": soon, "reach": reach}
    return Finding((arrived.mean() > 0.5,), numbers)


def comes_to_rest(evidence: Evidence, run: Run) -> Finding:
    """CVs and choke stand still at the end of a window."""
    groups = quarters(run)
    cv = (swing(run.measurement.values, groups) / run.tuning_deadzone.values).max(axis=1)
    position = run.position.sel(mv=CHOKE).values
    choke = swing(position, groups)
    creeping = choke >= STEP
    middle = [
        f"{position[samples].mean():.0f} %" for samples, slow in zip(groups, creeping, strict=True) if slow
    ]
    numbers = {
        "cv": cv.max(),
        "choke": choke.max(),
        "creeping": evidence.starts(creeping),
        "middle": " and ".join(middle),
        "moving": evidence.starts(cv > STATIONARY),
    }
    conditions = (cv <= STATIONARY).all(), not creeping.any()
    return Finding(conditions, numbers, "choke" if creeping.any() else "rates")


def oil_first(evidence: Evidence, run: Run) -> Finding:
    """Out of reach, oil ends nearer to its setpoint than gas."""
    data = evidence.data
    out = distance_to_reach(data) > OUT_OF_REACH
    if not out.any():
        return Finding((), {}, instead="no target is out of reach")
    target = np.array([run.setpoint.values[samples[0]] for samples in quarters(data)])
    away = final_deviation(data, name_of(run)) * run.tuning_deadzone.values
    share = 100 * np.abs(away / target)
    oil, gas = share[:, index(data, OIL)], share[:, index(data, GAS)]
    first = oil < gas
    texts = [
        f"oil {oil[w]:.1f} % and gas {gas[w]:.1f} % of the setpoint in the {evidence.starts(int(w))}"
        for w in np.flatnonzero(out)
    ]
    at = int((out & ~first).argmax())  # the first window where it is the other way round
    numbers = {"texts": "; ".join(texts), "worth": exchange(run), "at": evidence.starts(at)}
    return Finding((first[out].any(), first[out].all()), numbers | {"pulls": compromise(run, away[at])})


def saturates(evidence: Evidence) -> Finding:
    """Both MVs end at their upper limits."""
    last = quarters(evidence.data)[-1]
    parts, full = [], []
    for run in evidence.runs:
        low, high = run.tuning_mv_low.values, run.tuning_mv_high.values
        least = run.position.values[last].min(axis=0)
        full.append((least >= high - FULL * (high - low)).all())
        parts.append(f"{least[0]:.1f} % and {least[1]:.0f} m3/h")
    return Finding(tuple(full), {"parts": ", ".join(parts)})


# ------------------------------------------------------------------------------------------------ bias


def spikes(evidence: Evidence) -> Finding:
    """The filtered bias jumps less than the raw one."""
    parts, ratios, undone, total = [], [], 0, 0
    for run in evidence.runs:
        half = run.tuning_deadzone.values
        raw, filtered = (np.diff(run[key].values, axis=0) / half for key in ("bias_raw", "bias"))
        ratios.append(np.abs(filtered).max(axis=0) / np.maximum(np.abs(raw).max(axis=0), 1e-12))
        parts.append(f"{evidence.rates(ratios[-1]):.2f}")
        big = np.abs(raw[:-1]) > STATIONARY
        total += big.sum()
        undone += (big & (raw[1:] * raw[:-1] < 0) & (np.abs(raw[1:]) > np.abs(raw[:-1]) / 2)).sum()
    ratio = np.array(ratios)
    numbers = {"parts": "; ".join(parts), "undone": undone, "total": total}
    return Finding(((ratio < 1).all(), (ratio <= 0.5).all()), numbers)


def bias_settles(evidence: Evidence, run: Run) -> Finding:
    """The bias stands still at the end of a window."""
    groups = quarters(run)
    moved = (swing(run.bias.values, groups) / run.tuning_deadzone.values).max(axis=1)
    settled = moved <= STATIONARY
    numbers = {"settled": settled.sum(), "count": len(settled), "most": moved.max()}
    return Finding((settled.mean() > 0.5, settled.all()), numbers | {"moving": evidence.starts(~settled)})


def bias_swings(evidence: Evidence, run: Run) -> Finding:
    """The bias swings where the choke does."""
    late = second_halves(run.window.values)
    halves = [np.flatnonzero(late == w) for w in range(int(run.window.values.max()) + 1)]
    moved = (swing(run.bias.values, halves) / run.tuning_deadzone.values).max(axis=1)
    hunts, _ = hunting(evidence, run)
    if not hunts.any() or hunts.all():
        return Finding((), {}, instead="every window is alike")
    a, b = np.median(moved[hunts]), np.median(moved[~hunts])
    return Finding((a > b, a > b and a >= 3 * b), {"hunting": a, "count": hunts.sum(), "others": b})


def bias_large(evidence: Evidence, run: Run) -> Finding:
    """The bias is large, above all near a closed choke."""
    size = np.abs(run.bias.values) / run.tuning_deadzone.values
    closed = run.position.sel(mv=CHOKE).values < NEARLY_CLOSED
    largest = size.max(axis=0)
    numbers = {"largest": evidence.rates(largest), "where": ""}
    if not closed.any() or closed.all():
        return Finding((), numbers)
    near, elsewhere = size[closed].mean(axis=0), size[~closed].mean(axis=0)
    numbers["where"] = (
        f"; mean {evidence.rates(near):.1f} below {NEARLY_CLOSED:.0f} % choke, {evidence.rates(elsewhere):.1f} above"
    )
    return Finding(((largest > 1).all(), (near > elsewhere).all()), numbers)


def gains(evidence: Evidence) -> Finding:
    """The steady gain of the choke falls as it opens."""
    curve = evidence.data.sweep_coefficient
    low, high = (
        curve.where(part).mean(("sweep_lift", "sweep_choke"))
        for part in (curve.sweep_choke < NEAR_CLOSED, curve.sweep_choke >= NEAR_CLOSED)
    )
    ratio = (low / high).values
    pairs = zip(curve.cv.values, ratio, strict=True)
    return Finding(tuple(ratio > 2), {"ratios": ", ".join(f"{short(cv)} {r:.1f} times" for cv, r in pairs)})
