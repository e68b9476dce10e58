"""Measures on the three controllers of the thesis comparison (7.1, 7.2.1, 8): who oscillates, who deviates, what moves."""

from __future__ import annotations

from typing import Any

import numpy as np

from studies.kpi.evaluate import final_deviation, window_deviation
from studies.thesis.claims.limits import ALIKE, FAR_MORE, HUNTING, OUT_OF_REACH, STATIONARY
from studies.thesis.claims.record import Evidence, Finding, Run, name_of, short
from studies.thesis.claims.why import price_of_a_step
from studies.thesis.reach import distance_to_reach, reversals_near_closed
from studies.thesis.well import CHOKE

# ------------------------------------------------------------------------------------------------ oscillation


def hunting(evidence: Evidence, run: Run) -> tuple[np.ndarray, dict[str, Any]]:
    """Whether the second half of a window counts as oscillation, ``"window"``, and the numbers of reversals there."""
    counts = evidence.figure("late_reversals", run)
    hunts = counts >= HUNTING
    return hunts, {
        "hunting": hunts.sum(),
        "windows": len(counts),
        "total": counts.sum(),
        "most": counts.max(),
        "where": evidence.starts(hunts),
    }


def quiet(evidence: Evidence, run: Run) -> Finding:
    """No window oscillates."""
    hunts, numbers = hunting(evidence, run)
    return Finding((not hunts.any(),), numbers)


def oscillates(evidence: Evidence, run: Run) -> Finding:
    """Some window oscillates."""
    hunts, numbers = hunting(evidence, run)
    return Finding((hunts.any(),), numbers)


def below_half(evidence: Evidence, run: Run) -> Finding:
    """Most reversals happen with the choke near closed."""
    hunts, numbers = hunting(evidence, run)
    low, total = reversals_near_closed(evidence.data, name_of(run)), numbers["total"]
    return Finding(
        (low > total / 2,) if hunts.any() else (), {"low": low, "total": total, "high": total - low}
    )


def travels(evidence: Evidence, rounded: Run, integer: Run) -> Finding:
    """Rounding travels far more."""
    far, near = (evidence.figure("travel", run) for run in (rounded, integer))
    numbers = {"far": far, "near": near, "ratio": far / max(near, 1e-9), "more": far - near}
    return Finding((far > near, far > FAR_MORE * near), numbers)


# ------------------------------------------------------------------------------------------------ deviation


def deviates_less(evidence: Evidence, rounded: Run, integer: Run) -> Finding:
    """Rounding deviates less in the mean; where it does not, the window that costs most."""
    runs, data = (rounded, integer), evidence.data
    a, b = (evidence.figure("mean_absolute_deviation", run) for run in runs)
    more = np.subtract(*(window_deviation(data, name_of(run)) for run in runs))
    texts, why = [], []
    for i, (cv, windows) in enumerate(zip(data.cv.values, more.T, strict=True)):
        texts.append(
            f"{short(cv)} {a[i]:.4g} against {b[i]:.4g} m3/h, "
            f"less in {(windows < 0).sum()} of {len(windows)} windows"
        )
        if a[i] >= b[i]:
            worst = int(windows.argmax())
            choke = rounded.position.sel(mv=CHOKE).values[data.window.values == worst]
            why.append(
                f"{short(cv)}: most is lost in the {evidence.starts(worst)}, {windows.max():.0f} m3/h more with the choke "
                f"swinging around {choke.mean():.0f} %"
            )
    return Finding(tuple(a < b), {"texts": "; ".join(texts), "lost": "; ".join(why)})


def _ratios(evidence: Evidence, smooth: Run, integer: Run) -> tuple[np.ndarray, dict[str, Any]]:
    a, b = (evidence.figure("mean_absolute_deviation", run) for run in (integer, smooth))
    pairs = [
        f"{short(cv)} {x:.4g} against {y:.4g} m3/h, {x / y:.2f} times"
        for cv, x, y in zip(evidence.data.cv.values, a, b, strict=True)
    ]
    return a / b, {"pairs": "; ".join(pairs)}


def resembles(evidence: Evidence, smooth: Run, integer: Run) -> Finding:
    """Mixed-integer MPC deviates hardly more than the continuous choke."""
    ratio, numbers = _ratios(evidence, smooth, integer)
    return Finding(tuple(ratio <= ALIKE), numbers | {"rest": _at_rest(evidence, smooth, integer)})


def deviates_more(evidence: Evidence, smooth: Run, integer: Run) -> Finding:
    """It deviates more than the continuous choke."""
    ratio, numbers = _ratios(evidence, smooth, integer)
    return Finding(tuple(ratio > 1), numbers)


def off_windows(evidence: Evidence, run: Run) -> np.ndarray:
    """Windows at whose end a CV stands off its setpoint, ``"window"``."""
    return np.abs(final_deviation(evidence.data, name_of(run))).max(axis=1) > STATIONARY


def stationary(evidence: Evidence, run: Run) -> Finding:
    """Deviations stay in the windows out of reach, and in no other."""
    away, stays = distance_to_reach(evidence.data) > OUT_OF_REACH, off_windows(evidence, run)
    arrive = f"; {(~stays & ~away).sum()} of {(~away).sum()} within reach arrive" if (~away).any() else ""
    numbers = {"off": (stays & away).sum(), "away": away.sum(), "arrive": arrive}
    conditions = (stays[away].all(), (~stays[~away]).all()) if away.any() else ()
    return Finding(conditions, numbers | {"wrong": evidence.starts(stays != away)})


def same_windows(evidence: Evidence, smooth: Run, integer: Run) -> Finding:
    """Both end off their setpoints in the same windows."""
    free, whole = off_windows(evidence, smooth), off_windows(evidence, integer)
    numbers = {"whole": whole.sum(), "free": free.sum(), "both": (free & whole).sum(), "count": len(free)}
    conditions = whole[free].all(), not (whole & ~free).any()
    return Finding(conditions, numbers | {"rest": _at_rest(evidence, smooth, integer)})


def _at_rest(evidence: Evidence, smooth: Run, integer: Run) -> str:
    """Why the mixed-integer controller stays off where the continuous choke does not: what one more step is worth."""
    more = off_windows(evidence, integer) & ~off_windows(evidence, smooth)
    if not more.any():
        return "it ends where the continuous choke ends; the difference lies on the way"
    away = final_deviation(evidence.data, name_of(integer))
    worst = int(np.where(more, np.abs(away).max(axis=1), -np.inf).argmax())
    there = integer.isel(time=np.flatnonzero(integer.window.values == worst))
    deviation = away[worst] * integer.tuning_deadzone.values
    saved, price = price_of_a_step(there, deviation)
    return (
        f"in {more.sum()} windows whose targets the continuous choke reaches it rests off them, farthest in the "
        f"{evidence.starts(worst)} ({evidence.rates(deviation):+.1f} m3/h): one more step of the "
        f"choke would save {max(saved, 0.0):.0f} over the horizon by the model and costs {price:.0f}"
    )
