"""Rows on Soft MPC: its penalty, the oscillation near a closed choke that it removes, and its cause (6.4, 7.2.6)."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import xarray as xr

from studies.definition.presets import CHOKE, OIL
from studies.kpi.loop import moves_of, reversal_events, second_halves
from studies.thesis.claims.comparison import HUNTING
from studies.thesis.claims.record import Evidence, Finding, Row, both
from studies.thesis.claims.settling import NEARLY_CLOSED
from studies.thesis.claims.why import horizon_cost
from studies.thesis.plans import plan_at

FAR = 10.0  # half widths, far outside the deadzone
MOST = 40  # turns to look at
DOUBLE = 1.5  # times the predicted response that count as far more


def turns(run: xr.Dataset) -> np.ndarray:
    """Whether the choke turns back, both moves in one setpoint window, ``"sample"``."""
    position = run.position.sel(mv=CHOKE).values
    start = run.demand.sel(mv=CHOKE).values[0] - run.move.sel(mv=CHOKE).values[0]
    return np.asarray(reversal_events(moves_of(position, start), segment=run.window.values))


def turns_by_window(run: xr.Dataset) -> np.ndarray:
    """How often the choke turns back in every setpoint window, ``"window"``."""
    window = run.window.values
    return np.bincount(window[turns(run)], minlength=int(window.max()) + 1)


def _lasting(run: xr.Dataset) -> np.ndarray:
    """Those turns that lie in the second half of a window, ``"sample"``."""
    return turns(run) & (second_halves(run.window.values) >= 0)


def _said(run: xr.Dataset) -> str:
    counts = turns_by_window(run)
    total = int(counts.sum())
    return f"{total} reversal{'s' if total != 1 else ''}, up to {int(counts.max())} in a window"


def _oscillates(role: str) -> Callable[[Evidence], Finding]:
    def measure(evidence: Evidence) -> Finding:
        run = evidence.run(role)
        turned, counts = turns(run), turns_by_window(run)
        closed = turned & (run.position.sel(mv=CHOKE).values < NEARLY_CLOSED)
        lasting = int(_lasting(run).sum())
        last = np.flatnonzero(turned)
        words = f"its targets do not make it swing {HUNTING} times"
        if last.size:
            begin = np.flatnonzero(run.window.values == run.window.values[last[-1]])[0]
            after = float(run.time.values[last[-1]] - run.time.values[begin])
            words = (
                f"the swings die out: the last turn comes {after:.0f} s after the step of the setpoints, "
                f"{lasting} of {int(turned.sum())} in the second half of a window"
            )
        return Finding(
            f"{_said(run)}; {int(closed.sum())} of {int(turned.sum())} below {NEARLY_CLOSED:.0f} % choke",
            (bool(counts.max() >= HUNTING), bool(closed.sum() > turned.sum() / 2), lasting >= HUNTING),
            words,
        )

    return measure


def _removes(hard: str) -> Callable[[Evidence], Finding]:
    def measure(evidence: Evidence) -> Finding:
        run = evidence.run("soft")
        counts, without = turns_by_window(run), turns_by_window(evidence.run(hard))
        value = f"with Soft MPC {_said(run)}; without {_said(evidence.run(hard))}"
        if without.max() < HUNTING:
            return Finding(value, ())
        worst = np.flatnonzero(run.window.values == counts.argmax())
        last = worst[turns(run)[worst]]
        words = ""
        if last.size:
            after = float(run.time.values[last[-1]] - run.time.values[worst[0]])
            rest = float(run.time.values[worst[-1]] - run.time.values[last[-1]])
            words = (
                f"in the {evidence.starts(np.arange(len(counts)) == counts.argmax())} it still turns {last.size} times, "
                f"the last {after:.0f} s after the step of the setpoints, {rest:.0f} s before the end of the window"
            )
        return Finding(value, (bool(counts.max() < HUNTING),), words)

    return measure


def _penalty(run: xr.Dataset, half_widths: float) -> np.ndarray:
    """What a sample that is some half widths of the deadzone off costs, ``"cv"``."""
    off = half_widths * run.tuning_deadzone.values
    return np.array(
        [horizon_cost(run, np.where(np.arange(len(off)) == i, off, 0.0)[None]) for i in range(len(off))]
    )


def _penalises_less(evidence: Evidence) -> Finding:
    soft, nominal = evidence.run("soft"), evidence.run("nominal")
    inside, outside = (_penalty(soft, at) / _penalty(nominal, at) for at in (1.0, FAR))
    cvs = soft.cv.values
    return Finding(
        f"{both(100 * inside, cvs, '.0f', '%')} of the nominal penalty at the edge of the deadzone, "
        f"{both(100 * outside, cvs, '.0f', '%')} at {FAR:.0f} half widths",
        (bool((inside < 1).all()), bool((np.abs(outside - 1) <= 0.25).all())),
        "not less inside" if (inside >= 1).any() else "another weight far outside",
    )


def _better(evidence: Evidence) -> Finding:
    names = ("soft", "no-soft", "no-soft-plain")
    count = {name: int(turns(evidence.run(name)).sum()) for name in names}
    way = {name: float(evidence.key.choke_travel.sel(controller=name)) for name in names}
    hard, plain = names[1:]
    cheap = _penalty(evidence.run(plain), FAR) / _penalty(evidence.run("soft"), FAR)
    return Finding(
        f"{count['soft']} reversals and {way['soft']:.0f} % of travel with Soft MPC, {count[hard]} and {way[hard]:.0f} % "
        f"without it, {count[plain]} and {way[plain]:.0f} % with its penalty left out and the weight kept",
        (
            count["soft"] < count[hard] and way["soft"] < way[hard],
            count["soft"] < count[plain] and way["soft"] < way[plain],
        ),
        f"with the extra penalty left out a deviation of {FAR:.0f} half widths costs {100 * cheap.min():.0f} % of that "
        "with Soft MPC: that controller has less reason to move",
    )


def responses(run: xr.Dataset, data: xr.Dataset) -> np.ndarray:
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
        plan = plan_at(data, str(run.controller.item()), float(run.time.values[k]))
        out.append([plan.cv[end - k - 1] - y[k], y[end] - y[k]])
    return np.array(out).reshape(-1, 2, run.sizes["cv"])


def _mismatch(evidence: Evidence) -> Finding:
    run = evidence.run("no-soft")
    found = responses(run, evidence.data)
    if not len(found):
        return Finding("no two turns of the choke in one window", ())
    ratio = np.median(np.abs(found[:, 1]) / np.maximum(np.abs(found[:, 0]), 1e-9), axis=0)
    size = np.median(np.abs(found), axis=0)
    oil = [str(cv) for cv in run.cv.values].index(OIL)
    return Finding(
        f"{both(ratio, run.cv.values, '.1f', 'times')} the predicted change (oil {size[1, oil]:.1f} instead of "
        f"{size[0, oil]:.1f} m3/h, medians of {len(found)} moves)",
        (bool(ratio[oil] > 1), bool((ratio > DOUBLE).all())),
        "the well answers about as predicted",
    )


OSCILLATION = "reversals of the actual choke position, both moves in one setpoint window"
OSCILLATES = (
    f"{HUNTING} or more in a window, more than half of all below {NEARLY_CLOSED:.0f} %, and {HUNTING} or more in second "
    "halves of windows (in part: some of the three)"
)

REMOVED = f"with Soft MPC fewer than {HUNTING} in every window, and without it {HUNTING} or more in one"

ROWS = (
    Row(
        "soft-penalises-less",
        "6.4",
        "Soft MPC charges less inside the deadzone and about the same far outside",
        "Q d^2 + S eta^2 + s eta with eta = max(|d| - c, 0), soft over nominal, at d = c and at d = 10 c",
        "below 1 at c, and 0.75 to 1.25 at 10 c, oil and gas (in part: one of the two)",
        "soft",
        ("13",),
        ("nominal", "soft"),
        _penalises_less,
    ),
    Row(
        "nominal-oscillates",
        "6.4",
        "Without Soft MPC mixed-integer MPC oscillates near a closed choke",
        OSCILLATION,
        OSCILLATES,
        "soft",
        ("12",),
        ("nominal",),
        _oscillates("nominal"),
    ),
    Row(
        "soft-removes",
        "6.4",
        "Soft MPC removes that oscillation",
        OSCILLATION,
        REMOVED,
        "soft",
        ("12",),
        ("nominal", "soft"),
        _removes("nominal"),
    ),
    Row(
        "hard-oscillates",
        "7.2.6",
        "Over the thesis reference it oscillates at times without Soft MPC, most near a closed choke",
        OSCILLATION,
        OSCILLATES,
        "without-soft",
        ("34", "35"),
        ("no-soft",),
        _oscillates("no-soft"),
    ),
    Row(
        "soft-removes-thesis",
        "7.2.6",
        "Over the thesis reference Soft MPC removes that oscillation",
        OSCILLATION,
        REMOVED,
        "without-soft",
        ("34", "35"),
        ("soft", "no-soft"),
        _removes("no-soft"),
    ),
    Row(
        "mismatch",
        "7.2.6",
        "The well answers the turns of the choke with far more than was predicted",
        "from a turn to the next in the same window: |change of y| over the change predicted at the turn, median",
        f"more than {DOUBLE} times, oil and gas (in part: more for oil)",
        "without-soft",
        ("36", "37", "38"),
        ("no-soft",),
        _mismatch,
    ),
    Row(
        "soft-better",
        "7.2.6",
        "Soft MPC spares the choke",
        "reversals and travel of the actual choke position",
        "both less than with one hard weight, and less than with the extra penalty left out (in part: one of the two)",
        "without-soft",
        ("34", "35"),
        ("soft", "no-soft", "no-soft-plain"),
        _better,
    ),
)
