"""Rows on the three controllers of the thesis comparison (7.1, 7.2.1, 8): who oscillates, who deviates, what moves.

The first eight are also those of the summary page (`claims`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import xarray as xr

from studies.definition.presets import CHOKE, GAS, OIL
from studies.kpi.evaluate import NEAR_CLOSED, distance_to_reach, final_deviation, window_deviation
from studies.thesis.claims.moves import STAIRCASE
from studies.thesis.claims.record import STATIONARY, Claim, Evidence, Finding, Row, both, judge, short
from studies.thesis.claims.why import price_of_a_step

HUNTING = 3  # reversals in the second half of a window that count as oscillation: more than a swing and back
OUT_OF_REACH = 0.1  # deadzone half widths between a setpoint pair and the nearest steady state of the plant
ALIKE = 1.25  # ratio of mean deviations up to which one performance closely resembles another
STUDY = "thesis"
LATE_REVERSALS = (
    "reversals of the actual choke position (|m| > 0.05 %, opposite to the move before) between two moves of the second "
    "half of a setpoint window"
)
QUIET = f"no window with {HUNTING} or more reversals in its second half"
MEAN_DEVIATION = "mean over the run of |y - r|, y the measured CV, r its setpoint"


def claims(data: xr.Dataset, figures: xr.Dataset | None = None) -> list[Claim]:
    """The rows of the summary page: what the thesis says of the three controllers, measured on these results.

    Rows whose controllers have not run are left out.

    Args:
        data: results of the thesis study.
        figures: from `key_figures`, if already there.
    """
    evidence = Evidence.of(data)
    evidence = Evidence(evidence.data, given=figures)
    return [judge(row, evidence) for row in SUMMARY if all(role in evidence.roles for role in row.needs)]


# ------------------------------------------------------------------------------------------------ oscillation


def late_reversals(evidence: Evidence, role: str) -> np.ndarray:
    """Reversals in the second half of every window, ``"window"``."""
    return evidence.key.late_reversals.sel(controller=evidence.roles[role]).values


def _hunts(evidence: Evidence, role: str) -> tuple[str, bool]:
    counts = late_reversals(evidence, role)
    hunting = counts >= HUNTING
    value = f"{int(hunting.sum())} of {len(counts)} windows, {int(counts.sum())} reversals"
    return value, bool(hunting.any())


def _quiet(role: str) -> Callable[[Evidence], Finding]:
    def measure(evidence: Evidence) -> Finding:
        value, hunts = _hunts(evidence, role)
        hunting = late_reversals(evidence, role) >= HUNTING
        return Finding(value, (not hunts,), f"the choke still turns in the {evidence.starts(hunting)}")

    return measure


def _rounded_oscillates(evidence: Evidence) -> Finding:
    value, hunts = _hunts(evidence, "rounded")
    most = int(late_reversals(evidence, "rounded").max())
    return Finding(value, (hunts,), f"never more than {most} reversals in a second half")


def _below_half(evidence: Evidence) -> Finding:
    total = int(late_reversals(evidence, "rounded").sum())
    low = int(evidence.key.late_reversals_near_closed.sel(controller=evidence.roles["rounded"]))
    value = f"{low} of {total} reversals"
    if not _hunts(evidence, "rounded")[1]:
        return Finding(value, ())
    return Finding(value, (low > total / 2,), f"{total - low} reversals with the choke further open")


def _rounded_travels(evidence: Evidence) -> Finding:
    travel = [
        float(evidence.key.choke_travel.sel(controller=evidence.roles[role]))
        for role in ("rounded", "integer")
    ]
    ratio = travel[0] / max(travel[1], 1e-9)
    return Finding(
        f"{travel[0]:.0f} % against {travel[1]:.0f} %, {ratio:.1f} times",
        (travel[0] > travel[1], travel[0] > 1.5 * travel[1]),
        f"the swings add only {travel[0] - travel[1]:.0f} %",
    )


# ------------------------------------------------------------------------------------------------ deviation


def _means(evidence: Evidence, role: str) -> np.ndarray:
    mean = evidence.key.mean_absolute_deviation.sel(controller=evidence.roles[role])
    return np.array([float(mean.sel(cv=cv)) for cv in (GAS, OIL)])


def _rounded_deviates_less(evidence: Evidence) -> Finding:
    a, b = _means(evidence, "rounded"), _means(evidence, "integer")
    names = [evidence.roles[role] for role in ("rounded", "integer")]
    more = np.subtract(*(window_deviation(evidence.data, name) for name in names))
    texts, why = [], []
    for i, cv in enumerate((GAS, OIL)):
        windows = more[:, list(evidence.data.cv.values).index(cv)]
        texts.append(
            f"{short(cv)} {a[i]:.4g} against {b[i]:.4g} m3/h, "
            f"less in {int((windows < 0).sum())} of {len(windows)} windows"
        )
        if a[i] >= b[i]:
            worst = np.arange(len(windows)) == windows.argmax()
            choke = evidence.run("rounded").position.sel(mv=CHOKE).values
            mean = choke[evidence.data.window.values == windows.argmax()].mean()
            why.append(
                f"{short(cv)}: most is lost in the {evidence.starts(worst)}, {windows.max():.0f} m3/h more with the choke "
                f"swinging around {mean:.0f} %"
            )
    return Finding("; ".join(texts), tuple(bool(less) for less in a < b), "; ".join(why))


def _ratios(evidence: Evidence) -> tuple[np.ndarray, str]:
    ratio = _means(evidence, "integer") / _means(evidence, "smooth")
    pairs = [
        f"{short(cv)} {a:.4g} against {b:.4g} m3/h, {r:.2f} times"
        for cv, a, b, r in zip(
            (GAS, OIL), _means(evidence, "integer"), _means(evidence, "smooth"), ratio, strict=True
        )
    ]
    return ratio, "; ".join(pairs)


def _resembles(evidence: Evidence) -> Finding:
    ratio, value = _ratios(evidence)
    return Finding(value, tuple(bool(r <= ALIKE) for r in ratio), _at_rest(evidence))


def _deviates_more(evidence: Evidence) -> Finding:
    ratio, value = _ratios(evidence)
    return Finding(value, tuple(bool(r > 1) for r in ratio), "it does not deviate more in the mean")


def off_windows(evidence: Evidence, role: str) -> np.ndarray:
    """Windows at whose end a CV stands off its setpoint, ``"window"``."""
    away = np.abs(final_deviation(evidence.data, evidence.roles[role])).max(axis=1)
    return away > STATIONARY


def _stationary(evidence: Evidence) -> Finding:
    away = distance_to_reach(evidence.data) > OUT_OF_REACH
    stays = off_windows(evidence, "smooth")
    value = f"{int((stays & away).sum())} of {int(away.sum())} windows out of reach stay off"
    if (~away).any():
        value += f"; {int((~stays & ~away).sum())} of {int((~away).sum())} within reach arrive"
    if not away.any():
        return Finding(value, ())
    wrong = stays != away
    words = f"the other way round in the {evidence.starts(wrong)}"
    return Finding(value, (bool(stays[away].all()), bool((~stays[~away]).all())), words)


def _same_windows(evidence: Evidence) -> Finding:
    smooth, integer = off_windows(evidence, "smooth"), off_windows(evidence, "integer")
    more = integer & ~smooth
    return Finding(
        f"off in {int(integer.sum())} windows, the continuous choke in {int(smooth.sum())}, in both "
        f"{int((smooth & integer).sum())} of {len(smooth)}",
        (bool(integer[smooth].all()), not more.any()),
        _at_rest(evidence),
    )


def _at_rest(evidence: Evidence) -> str:
    """Why the mixed-integer controller stays off where the continuous choke does not: what one more step is worth."""
    run = evidence.run("integer")
    more = off_windows(evidence, "integer") & ~off_windows(evidence, "smooth")
    if not more.any():
        return "it ends where the continuous choke ends; the difference lies on the way"
    away = final_deviation(evidence.data, evidence.roles["integer"])
    worst = int(np.where(more, np.abs(away).max(axis=1), -np.inf).argmax())
    there = run.isel(time=np.flatnonzero(evidence.data.window.values == worst))
    deviation = away[worst] * evidence.half("integer")
    saved, price = price_of_a_step(there, deviation)
    return (
        f"in {int(more.sum())} windows whose targets the continuous choke reaches it rests off them, farthest in the "
        f"{evidence.starts(np.arange(len(more)) == worst)} ({both(deviation, run.cv.values, '+.1f')}): one more step of the "
        f"choke would save {max(saved, 0.0):.0f} over the horizon by the model and costs {price:.0f}"
    )


SUMMARY = (
    Row(
        "smooth-quiet",
        "7.1.1",
        "With a continuous choke, the continuous MPC does not oscillate",
        LATE_REVERSALS,
        QUIET,
        STUDY,
        ("14", "15"),
        ("smooth",),
        _quiet("smooth"),
    ),
    Row(
        "rounded-oscillates",
        "7.1.2",
        "The same MPC on the step choke oscillates",
        LATE_REVERSALS,
        f"a window with {HUNTING} or more reversals in its second half",
        STUDY,
        ("17", "18", "20", "21"),
        ("rounded",),
        _rounded_oscillates,
    ),
    Row(
        "rounded-below-half",
        "7.1.2",
        f"It oscillates mainly below {NEAR_CLOSED:.0f} % choke",
        f"those of these reversals after which the choke stands below {NEAR_CLOSED:.0f} %",
        f"more than half of these reversals below {NEAR_CLOSED:.0f} %",
        STUDY,
        ("18", "21"),
        ("rounded",),
        _below_half,
    ),
    Row(
        "integer-quiet",
        "7.2.1",
        "Mixed-integer MPC does not oscillate",
        LATE_REVERSALS,
        QUIET,
        STUDY,
        ("22", "23"),
        ("integer",),
        _quiet("integer"),
    ),
    Row(
        "rounded-deviates-less",
        "8",
        "Rounding deviates less in the mean than mixed-integer MPC",
        MEAN_DEVIATION,
        "smaller mean absolute deviation of gas and of oil (in part: of one)",
        STUDY,
        ("17", "22"),
        ("rounded", "integer"),
        _rounded_deviates_less,
    ),
    Row(
        "rounded-travels-more",
        "8",
        "Rounding moves the choke much more",
        "sum over the run of |u[k] - u[k-1]|, u the actual choke position",
        "more than 1.5 times the travel (in part: more)",
        STUDY,
        ("18", "23"),
        ("rounded", "integer"),
        _rounded_travels,
    ),
    Row(
        "stationary-deviation",
        "7.1.1",
        "Deviations stay where the plant has no steady state at both setpoints",
        "mean of (y - r)/c over the last quarter of a window, c the half width of the deadzone; out of reach: every point "
        f"of the steady-state map is more than {OUT_OF_REACH} c from a setpoint",
        f"mean deviation above {STATIONARY} deadzone half widths in the last quarter of every window out of "
        "reach, and of no other (in part: one of the two)",
        STUDY,
        ("14",),
        ("smooth",),
        _stationary,
    ),
    STAIRCASE,
)

ROWS = (
    *SUMMARY,
    Row(
        "integer-resembles-benchmark",
        "7.2.1, 8",
        "Mixed-integer MPC performs like the continuous choke",
        f"{MEAN_DEVIATION}: mixed-integer MPC over continuous MPC with a continuous choke",
        f"at most {ALIKE} times, gas and oil (in part: one)",
        STUDY,
        ("14", "22"),
        ("smooth", "integer"),
        _resembles,
    ),
    Row(
        "integer-deviates-more",
        "7.2.1",
        "It deviates more than the continuous choke",
        f"{MEAN_DEVIATION}: mixed-integer MPC over continuous MPC with a continuous choke",
        "more than once, gas and oil (in part: one)",
        STUDY,
        ("14", "22"),
        ("smooth", "integer"),
        _deviates_more,
    ),
    Row(
        "integer-same-windows",
        "7.2.1",
        "Its deviations stay in the same periods as with the continuous choke",
        f"windows whose last quarter has a mean deviation above {STATIONARY} half widths",
        "all windows that the continuous choke ends off, and no others (in part: one of the two)",
        STUDY,
        ("14", "22"),
        ("smooth", "integer"),
        _same_windows,
    ),
)
