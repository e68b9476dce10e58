"""Rows on the moves of the choke: whole steps, no move back at once, and how fast it opens (6.5, 6.6, 7.1.1, 7.2.1)."""

from __future__ import annotations

import numpy as np

from studies.definition.presets import CHOKE
from studies.thesis.claims.record import Evidence, Finding, Row

STUDY = "thesis"


def _staircase(evidence: Evidence) -> Finding:
    key = evidence.key
    mean = key.largest_mean_opening.values
    stops, broken = key.mean_move_stops.values, key.openings_above_limit.values
    return Finding(
        f"largest mean {', '.join(f'{m:.3f}' for m in mean)} %/sample; openings above the limit "
        f"{', '.join(map(str, broken))}; pauses {', '.join(map(str, stops))}",
        (bool((broken == 0).all()), bool((stops > 0).all())),
        "openings above the limit, or no pause",
    )


def _mean_move(evidence: Evidence) -> Finding:
    data = evidence.data
    limit = data.tuning_mean_move_limit.sel(mv=CHOKE).values
    one_step = data.tuning_move_high.sel(mv=CHOKE).values / data.mean_move_window.values
    mean = evidence.key.largest_mean_opening.values
    return Finding(
        f"largest windowed mean {', '.join(f'{m:.3f}' for m in mean)} %/sample, limit {limit.max():.2f} and one step "
        f"{one_step.max():.2f}",
        tuple(bool(m <= high + 1e-6) for m, high in zip(mean, limit + one_step, strict=True)),
        "the limit acts on the next move and one move passes it by more than a step",
    )


def _follows(evidence: Evidence) -> Finding:
    run = evidence.run("integer")
    demand, position = (run[name].sel(mv=CHOKE).values for name in ("demand", "position"))
    steps = (demand - (demand[0] - run.move.sel(mv=CHOKE).values[0])) / run.tuning_move_high.sel(
        mv=CHOKE
    ).item()
    fraction, behind = float(np.abs(steps - np.round(steps)).max()), float(np.abs(demand - position).max())
    return Finding(
        f"largest fraction of a step {fraction:.1g}; actual position at most {behind:.1g} % from the demand",
        (fraction < 1e-6, behind < 1e-6),
        "demands between steps, or a choke that does not follow",
    )


def _no_reversal_at_once(evidence: Evidence) -> Finding:
    run = evidence.run("integer")
    move = run.move.sel(mv=CHOKE).values
    at_once = int((move[1:] * move[:-1] < -1e-9).sum())
    moved = np.flatnonzero(np.abs(move) > 1e-9)
    turns = np.diff(moved)[np.sign(move[moved[1:]]) != np.sign(move[moved[:-1]])]
    quickest = f", the quickest after {turns.min() * float(run.attrs['dt']):.0f} s" if turns.size else ""
    return Finding(
        f"{at_once} in {len(moved)} moves; {turns.size} reversals in all{quickest}",
        (at_once == 0,),
        "moves turned back in the next sample",
    )


STAIRCASE = Row(
    "staircase",
    "7.1.1",
    "Under the mean-move limit the choke opens in a staircase",
    "mean of the last 25 demanded moves; a pause is a sample or more between two openings, the first of which brought "
    "the mean above its limit",
    "no opening while the mean is above its limit, and pauses in the opening (every controller; in part: one of the "
    "two)",
    STUDY,
    ("15", "18", "23"),
    (),
    _staircase,
)

ROWS = (
    Row(
        "integer-whole-steps",
        "7.2.1",
        "Its desired choke positions are whole steps, and the choke follows them",
        "largest distance of (demand - start)/2 % from a whole number; largest |demand - actual position|",
        "both below 1e-6 (in part: one)",
        STUDY,
        ("23",),
        ("integer",),
        _follows,
    ),
    Row(
        "no-reversal-at-once",
        "6.5",
        "It never takes a choke move back in the next sample",
        "samples with m[k] m[k-1] < 0, m the demanded choke moves",
        "none",
        STUDY,
        ("23",),
        ("integer",),
        _no_reversal_at_once,
    ),
    Row(
        "mean-move-limit",
        "6.6",
        "The choke does not open faster than 0.55 % per sample in the mean",
        "largest mean of the last 25 demanded moves",
        "at most the limit and one more step, 2 %/25 (every controller; in part: some)",
        STUDY,
        ("15", "18", "23"),
        (),
        _mean_move,
    ),
)
