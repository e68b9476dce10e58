"""Measures of computing time: what blocking saves (6.2), and what whole moves cost (8, figure 39)."""

from __future__ import annotations

import numpy as np

from studies.thesis.claims.limits import FASTER, ITERATION, SAME, SLOWER, SPIKE
from studies.thesis.claims.record import Evidence, Finding, Run


def unknowns(evidence: Evidence, blocked: Run, free: Run) -> Finding:
    """Moves of one problem."""
    few = [int((run.block_length.values > 0).sum()) * run.sizes["mv"] for run in (free, blocked)]
    return Finding((few == [400, 32],), {"free": few[0], "blocked": few[1]})


def _compared(evidence: Evidence, slow: Run, fast: Run) -> tuple[float, dict[str, float]]:
    """How many times as long the median step of a run takes, over the samples that both have, and the numbers for it."""
    times = [evidence.times(run) for run in (slow, fast)]
    a, b = (taken[: min(map(len, times))] for taken in times)
    ratio = float(np.median(a) / np.median(b))
    return ratio, {
        "slow": 1e3 * np.median(a),
        "fast": 1e3 * np.median(b),
        "ratio": ratio,
        "high": np.percentile(a, 99) / np.percentile(b, 99),
        "longest_slow": a.max(),
        "longest_fast": b.max(),
    }


def faster(evidence: Evidence, blocked: Run, free: Run) -> Finding:
    """Blocking makes a step much faster."""
    ratio, numbers = _compared(evidence, free, blocked)
    return Finding((ratio > 1, ratio >= FASTER), numbers)


def costs_more(evidence: Evidence, continuous: Run, integer: Run) -> Finding:
    """A step with whole moves takes much longer."""
    ratio, numbers = _compared(evidence, integer, continuous)
    return Finding((ratio > 1, ratio > SLOWER), numbers)


def alike(evidence: Evidence, blocked: Run, free: Run) -> Finding:
    """The CVs go the same way with and without blocks."""
    apart = np.abs(free.measurement - blocked.measurement).values / blocked.tuning_deadzone.values
    largest = apart.max(axis=1)
    numbers = {"apart": evidence.rates(apart.max(axis=0)), "at": blocked.time.values[largest.argmax()]}
    return Finding((np.median(largest) <= SAME, apart.max() <= SAME), numbers)


def real_time(evidence: Evidence, run: Run) -> Finding:
    """A step is done in time."""
    times = evidence.times(run)
    median, longest = np.median(times), times.max()
    return Finding(
        (median < ITERATION, longest < ITERATION), {"median": 1e3 * median, "longest": 1e3 * longest}
    )


def spikes(evidence: Evidence, run: Run) -> Finding:
    """Some step takes very much longer than the median."""
    times = evidence.times(run)
    median = np.median(times)
    share = 100 * (times > SPIKE * median).mean()
    ratio = times.max() / median
    return Finding((ratio > SPIKE,), {"longest": 1e3 * times.max(), "ratio": ratio, "share": share})
