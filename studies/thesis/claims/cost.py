"""Rows on computing time: what blocking saves (6.2), and what whole moves cost (8, figure 39)."""

from __future__ import annotations

import numpy as np

from studies.thesis.claims.record import Evidence, Finding, Row, both

FASTER = 7.0  # times, 29 against 4 minutes in the thesis
ITERATION = 0.1  # s
SAME = 0.1  # half widths of difference between two responses that cannot be told apart in a figure
SLOWER = 2.0  # times that count as significantly longer
SPIKE = 10.0  # times the median of a step
TIMES = "median time of one controller step, over the same samples"


def _unknowns(evidence: Evidence) -> Finding:
    count = []
    for name in ("no-blocks", "blocks"):
        run = evidence.run(name)
        count.append(int((run.block_length.values > 0).sum()) * run.sizes["mv"])
    return Finding(
        f"{count[0]} against {count[1]} moves",
        (count == [400, 32],),
        "other blocks or horizons are configured",
    )


def _pair(evidence: Evidence, slow: str, fast: str) -> tuple[np.ndarray, np.ndarray]:
    """Times of two runs [s], over the samples that both have."""
    times = [evidence.times(name) for name in (slow, fast)]
    count = min(map(len, times))
    return times[0][:count], times[1][:count]


def _faster(evidence: Evidence) -> Finding:
    without, blocked = _pair(evidence, "no-blocks", "blocks")
    ratio = np.median(without) / np.median(blocked)
    return Finding(
        f"{1e3 * np.median(without):.1f} against {1e3 * np.median(blocked):.2f} ms, {ratio:.0f} times",
        (bool(ratio > 1), bool(ratio >= FASTER)),
        f"without blocks a step takes {1e3 * np.median(without):.1f} ms",
    )


def _integer_faster(evidence: Evidence) -> Finding:
    without, blocked = _pair(evidence, "mixed-integer-no-blocks", "mixed-integer-blocks")
    ratio = np.median(without) / np.median(blocked)
    return Finding(
        f"median {1e3 * np.median(without):.1f} against {1e3 * np.median(blocked):.2f} ms, {ratio:.0f} times; longest "
        f"{without.max():.2g} against {blocked.max():.2g} s",
        (bool(ratio > 1), bool(ratio >= FASTER)),
        f"half of the steps without blocks take {1e3 * np.median(without):.1f} ms or less",
    )


def _alike(evidence: Evidence) -> Finding:
    free, blocked = evidence.run("no-blocks"), evidence.run("blocks")
    apart = np.abs(free.measurement.values - blocked.measurement.values) / evidence.half("blocks")
    k = int(apart.max(axis=1).argmax())
    return Finding(
        f"at most {both(apart.max(axis=0), blocked.cv.values, '.2g', 'half widths')} apart",
        (bool(np.median(apart.max(axis=1)) <= SAME), bool(apart.max() <= SAME)),
        f"they part for a while, most at {blocked.time.values[k]:.0f} s: single moves follow the setpoint step more finely "
        "than blocks can",
    )


def _real_time(evidence: Evidence) -> Finding:
    times = evidence.times("blocks")
    return Finding(
        f"median {1e3 * np.median(times):.2f} ms, longest {1e3 * times.max():.1f} ms",
        (bool(np.median(times) < ITERATION), bool(times.max() < ITERATION)),
        "single steps take longer",
    )


def _costs_more(evidence: Evidence) -> Finding:
    integer, continuous = _pair(evidence, "integer", "rounded")
    ratio = np.median(integer) / np.median(continuous)
    high = np.percentile(integer, 99) / np.percentile(continuous, 99)
    return Finding(
        f"median {1e3 * np.median(integer):.2f} against {1e3 * np.median(continuous):.2f} ms ({ratio:.1f} times), 99 % "
        f"{high:.1f} times",
        (bool(ratio > 1), bool(ratio > SLOWER)),
        "half of the steps take about as long",
    )


def _spikes(evidence: Evidence) -> Finding:
    times = evidence.times("integer")
    longest = times.max() / np.median(times)
    share = 100 * float((times > SPIKE * np.median(times)).mean())
    return Finding(
        f"longest {1e3 * times.max():.0f} ms, {longest:.0f} times the median; {share:.1f} % of the steps above {SPIKE:g} "
        "times",
        (bool(longest > SPIKE),),
        "no step takes that much longer than the others",
    )


ROWS = (
    Row(
        "blocking-unknowns",
        "6.2",
        "Blocking leaves 16 moves per input instead of 200",
        "blocks times inputs, the unknown moves of one problem",
        "400 and 32",
        "unblocked",
        ("25", "blocking"),
        ("blocks", "no-blocks"),
        _unknowns,
    ),
    Row(
        "blocking-time",
        "6.2",
        "That cuts the time of the continuous MPC to about a seventh",
        TIMES,
        f"at least {FASTER:g} times faster (in part: faster)",
        "unblocked",
        ("blocking",),
        ("blocks", "no-blocks"),
        _faster,
    ),
    Row(
        "blocking-time-integer",
        "6.2",
        "Blocking lets mixed-integer MPC be solved more efficiently",
        TIMES,
        f"at least {FASTER:g} times faster (in part: faster)",
        "unblocked",
        ("blocking",),
        ("mixed-integer-blocks", "mixed-integer-no-blocks"),
        _integer_faster,
    ),
    Row(
        "blocking-alike",
        "6.2",
        "The performance with and without blocking cannot be told apart",
        "largest |y - y'|/c of the continuous MPC with and without blocks",
        f"up to {SAME} half widths (in part: half of the samples)",
        "unblocked",
        ("blocking",),
        ("blocks", "no-blocks"),
        _alike,
    ),
    Row(
        "blocking-real-time",
        "6.2",
        "A blocked iteration takes less than 0.1 s",
        "time of one controller step",
        f"longest below {ITERATION:g} s (in part: median)",
        "unblocked",
        ("blocking",),
        ("blocks",),
        _real_time,
    ),
    Row(
        "integer-costs-more",
        "8",
        "A step of mixed-integer MPC takes much longer than one of continuous MPC",
        f"{TIMES}: mixed-integer over continuous MPC, both on the step choke",
        f"more than {SLOWER:g} times (in part: more)",
        "thesis",
        ("39",),
        ("rounded", "integer"),
        _costs_more,
    ),
    Row(
        "integer-spikes",
        "8",
        "Single steps of mixed-integer MPC take very much longer",
        "longest time of a controller step over the median",
        f"more than {SPIKE:g} times",
        "thesis",
        ("39",),
        ("integer",),
        _spikes,
    ),
)
