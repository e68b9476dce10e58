"""Rows on what the runs of the thesis comparison settle at, and on the bias (6.3, 7.1.1, 7.1.2, 7.2.1)."""

from __future__ import annotations

import numpy as np
import xarray as xr

from studies.definition.presets import CHOKE, GAS, LIFT, OIL
from studies.kpi.evaluate import NEAR_CLOSED, distance_to_reach, final_deviation
from studies.kpi.loop import second_halves
from studies.thesis.claims.comparison import HUNTING, OUT_OF_REACH, STUDY, late_reversals, off_windows
from studies.thesis.claims.record import STATIONARY, Evidence, Finding, Row, both, quarters, short
from studies.thesis.claims.why import compromise, exchange

NEARLY_CLOSED = 20.0  # % choke
STEP = 2.0  # %, a move of the choke
FULL = 1e-3  # of the range of an MV, for "at its limit"


def _swing(values: np.ndarray, groups: list[np.ndarray]) -> np.ndarray:
    """Largest minus smallest value in groups of samples, ``"group channel"``."""
    return np.array([np.ptp(values[samples], axis=0) for samples in groups])


# ------------------------------------------------------------------------------------------------ convergence


def _converges(evidence: Evidence) -> Finding:
    run, window = evidence.run("smooth"), evidence.data.window.values
    arrived = ~off_windows(evidence, "smooth")
    outside = (np.abs(run.measurement.values - run.setpoint.values) > run.tuning_deadzone.values).any(axis=1)
    times = []
    for w in np.flatnonzero(arrived):
        late = np.flatnonzero(outside[window == w])
        times.append((late[-1] + 1 if late.size else 0) * float(run.attrs["dt"]))
    value = f"{int(arrived.sum())} of {len(arrived)} windows"
    if times:
        value += f"; both rates are inside their deadzones for good after {np.median(times):.0f} s (median)"
    reach = distance_to_reach(evidence.data) <= OUT_OF_REACH
    return Finding(value, (bool(arrived.mean() > 0.5),), f"{int(reach.sum())} targets are within reach")


def _comes_to_rest(evidence: Evidence) -> Finding:
    run, groups = evidence.run("smooth"), quarters(evidence.data.window.values)
    cv = (_swing(run.measurement.values, groups) / run.tuning_deadzone.values).max(axis=1)
    choke = _swing(run.position.sel(mv=CHOKE).values[:, None], groups)[:, 0]
    creeping = choke >= STEP
    middle = np.array([run.position.sel(mv=CHOKE).values[samples].mean() for samples in groups])
    return Finding(
        f"rates within {cv.max():.2f} half widths, choke within {choke.max():.1f} %",
        (bool((cv <= STATIONARY).all()), not creeping.any()),
        f"the choke still creeps in the {evidence.starts(creeping)}, at "
        f"{' and '.join(f'{at:.0f} %' for at in middle[creeping])}, where it hardly acts on the rates"
        if creeping.any()
        else f"the rates still move in the {evidence.starts(cv > STATIONARY)}",
    )


def _oil_first(evidence: Evidence) -> Finding:
    data, run = evidence.data, evidence.run("smooth")
    out = distance_to_reach(data) > OUT_OF_REACH
    cvs = [str(cv) for cv in data.cv.values]
    groups = quarters(data.window.values)
    target = np.array([run.setpoint.values[samples[0]] for samples in groups])
    away = final_deviation(data, evidence.roles["smooth"]) * run.tuning_deadzone.values
    share = 100 * np.abs(away / target)
    gas, oil = cvs.index(GAS), cvs.index(OIL)
    first = share[:, oil] < share[:, gas]
    value = "; ".join(
        f"oil {share[w, oil]:.1f} % and gas {share[w, gas]:.1f} % of the setpoint in the "
        f"{evidence.starts(np.arange(len(out)) == w)}"
        for w in np.flatnonzero(out)
    )
    if not out.any():
        return Finding("no target is out of reach", ())
    wrong = np.flatnonzero(out & ~first)
    at = wrong[0] if wrong.size else 0
    return Finding(
        value,
        (bool(first[out].any()), bool(first[out].all())),
        f"{exchange(run)}. In the {evidence.starts(np.arange(len(out)) == at)} {compromise(run, away[at])}",
    )


def _saturates(evidence: Evidence) -> Finding:
    last = quarters(evidence.data.window.values)[-1]
    parts, full = [], []
    for name in evidence.data.controller.values:
        run = evidence.run(str(name))
        low, high = run.tuning_mv_low.values, run.tuning_mv_high.values
        least = run.position.values[last].min(axis=0)
        full.append(bool((least >= high - FULL * (high - low)).all()))
        at = dict(zip((str(mv) for mv in run.mv.values), least, strict=True))
        parts.append(f"{at[CHOKE]:.1f} % and {at[LIFT]:.0f} m3/h")
    return Finding(
        f"choke and lift at least {', '.join(parts)}", tuple(full), "an input stays below its limit"
    )


# ------------------------------------------------------------------------------------------------ bias


def _jumps(run: xr.Dataset, name: str) -> np.ndarray:
    """Changes of a bias from sample to sample in half widths, ``"sample cv"``."""
    return np.diff(run[name].values, axis=0) / run.tuning_deadzone.values


def _spikes(evidence: Evidence) -> Finding:
    parts, ratios = [], []
    undone = total = 0
    for name in evidence.data.controller.values:
        run = evidence.run(str(name))
        raw, filtered = _jumps(run, "bias_raw"), _jumps(run, "bias")
        largest = np.abs(raw).max(axis=0), np.abs(filtered).max(axis=0)
        ratios.append(largest[1] / np.maximum(largest[0], 1e-12))
        parts.append(both(ratios[-1], run.cv.values, ".2f", ""))
        big = np.abs(raw[:-1]) > STATIONARY
        total += int(big.sum())
        undone += int((big & (raw[1:] * raw[:-1] < 0) & (np.abs(raw[1:]) > np.abs(raw[:-1]) / 2)).sum())
    ratio = np.array(ratios)
    return Finding(
        "; ".join(parts) + " times the raw one",
        (bool((ratio < 1).all()), bool((ratio <= 0.5).all())),
        f"without measurement noise there are hardly any spikes: {undone} of {total} raw changes above {STATIONARY} half "
        "widths are undone in the next sample; the others are ramps, which a low-pass filter follows",
    )


def _bias_settles(evidence: Evidence) -> Finding:
    run, groups = evidence.run("smooth"), quarters(evidence.data.window.values)
    swing = (_swing(run.bias.values, groups) / run.tuning_deadzone.values).max(axis=1)
    settled = swing <= STATIONARY
    return Finding(
        f"{int(settled.sum())} of {len(settled)} windows, at most {swing.max():.2f} half widths",
        (bool(settled.mean() > 0.5), bool(settled.all())),
        f"the bias still moves in the {evidence.starts(~settled)}",
    )


def _bias_swings(evidence: Evidence) -> Finding:
    run, window = evidence.run("rounded"), evidence.data.window.values
    late = second_halves(window)
    halves = [np.flatnonzero(late == w) for w in range(int(window.max()) + 1)]
    swing = (_swing(run.bias.values, halves) / run.tuning_deadzone.values).max(axis=1)
    hunting = late_reversals(evidence, "rounded") >= HUNTING
    if not hunting.any() or hunting.all():
        return Finding("every window is alike", ())
    a, b = np.median(swing[hunting]), np.median(swing[~hunting])
    return Finding(
        f"median swing {a:.2f} half widths in {int(hunting.sum())} windows with oscillation, {b:.2f} in the others",
        (bool(a > b), bool(a > b and a >= 3 * b)),
        "the bias swings in windows without oscillation, too",
    )


def _bias_large(evidence: Evidence) -> Finding:
    run = evidence.run("integer")
    size = np.abs(run.bias.values) / run.tuning_deadzone.values
    closed = run.position.sel(mv=CHOKE).values < NEARLY_CLOSED
    largest = size.max(axis=0)
    value = f"largest {both(largest, run.cv.values, '.1f', 'half widths')}"
    if not closed.any() or closed.all():
        return Finding(value, ())
    near, elsewhere = size[closed].mean(axis=0), size[~closed].mean(axis=0)
    return Finding(
        f"{value}; mean {both(near, run.cv.values, '.1f', '')} below {NEARLY_CLOSED:.0f} % choke, "
        f"{both(elsewhere, run.cv.values, '.1f', '')} above",
        (bool((largest > 1).all()), bool((near > elsewhere).all())),
        "the bias is small, or no larger near a closed choke",
    )


def _gains(evidence: Evidence) -> Finding:
    curve = evidence.data.sweep_coefficient
    low = curve.where(curve.sweep_choke < NEAR_CLOSED).mean(("sweep_lift", "sweep_choke"))
    high = curve.where(curve.sweep_choke >= NEAR_CLOSED).mean(("sweep_lift", "sweep_choke"))
    ratio = (low / high).values
    names = [short(str(cv)) for cv in curve.cv.values]
    return Finding(
        ", ".join(f"{name} {r:.1f} times" for name, r in zip(names, ratio, strict=True)),
        tuple(bool(r > 2) for r in ratio),
        "the gain falls less over the choke",
    )


ROWS = (
    Row(
        "gain-below-half",
        "7.1.2",
        f"A step of the choke does far more below {NEAR_CLOSED:.0f} % than above",
        "mean over choke and lift of the steady change of a rate per % of choke: below over above",
        "more than twice, gas and oil (in part: one)",
        STUDY,
        ("10", "11"),
        (),
        _gains,
    ),
    Row(
        "smooth-converges",
        "7.1.1",
        "With a continuous choke the rates reach their setpoints for most of the time, quickly",
        f"windows with |mean of (y - r)/c| up to {STATIONARY} over their last quarter, both rates",
        "more than half of the windows",
        STUDY,
        ("14",),
        ("smooth",),
        _converges,
    ),
    Row(
        "smooth-comes-to-rest",
        "7.1.1",
        "It comes to a stationary point even where deviations stay",
        "largest minus smallest value in the last quarter of a window",
        f"rates within {STATIONARY} half widths, and the choke within one step of {STEP:g} %, in every window (in part: one "
        "of the two)",
        STUDY,
        ("14", "15"),
        ("smooth",),
        _comes_to_rest,
    ),
    Row(
        "oil-before-gas",
        "7.1.1",
        "Where both setpoints cannot be met, oil comes before gas",
        "|mean of y - r|/r over the last quarter of the windows that are out of reach",
        "less for oil than for gas in all of them (in part: in some)",
        STUDY,
        ("14",),
        ("smooth",),
        _oil_first,
    ),
    Row(
        "saturates",
        "7.1.1",
        "Both inputs saturate at the end",
        "smallest choke and lift in the last quarter of the last window",
        "both at their upper limit, up to 0.1 % of the range (every controller; in part: some)",
        STUDY,
        ("15", "18", "23"),
        (),
        _saturates,
    ),
    Row(
        "bias-spikes",
        "6.3",
        "The filter removes sudden spikes from the bias",
        "largest |v[k] - v[k-1]| of the filtered bias over that of the raw one, every controller",
        "at most half, oil and gas (in part: less)",
        STUDY,
        ("16", "19", "24"),
        (),
        _spikes,
    ),
    Row(
        "bias-settles",
        "7.1.1",
        "The bias settles after every step of the setpoints",
        "largest minus smallest bias in the last quarter of a window, over c",
        f"up to {STATIONARY} half widths in all windows (in part: in more than half)",
        STUDY,
        ("16",),
        ("smooth",),
        _bias_settles,
    ),
    Row(
        "bias-swings",
        "7.1.2",
        "With rounding the bias swings while the choke does",
        f"largest minus smallest bias in the second half of a window, over c: median over windows with {HUNTING} or more "
        "reversals there against the others",
        "at least 3 times (in part: more)",
        STUDY,
        ("19",),
        ("rounded",),
        _bias_swings,
    ),
    Row(
        "bias-near-closed",
        "7.2.1",
        "The bias is large, above all near a closed choke",
        f"|v|/c: largest, and mean over the samples with the choke below {NEARLY_CLOSED:.0f} % and over the others",
        "above 1 for oil and gas, and larger near a closed choke (in part: one of the two)",
        STUDY,
        ("24",),
        ("integer",),
        _bias_large,
    ),
)
