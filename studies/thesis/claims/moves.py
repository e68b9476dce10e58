"""Measures on the moves of the choke: whole steps, no move back at once, and how fast it opens (6.5, 6.6, 7.1.1, 7.2.1)."""

from __future__ import annotations

import numpy as np

from studies.thesis.claims.record import Evidence, Finding, Run
from studies.thesis.well import CHOKE


def staircase(evidence: Evidence) -> Finding:
    """No opening above the mean-move limit, and pauses."""
    key = evidence.key.sel(mv=CHOKE)
    stops, broken = key.mean_move_stops.values, key.rises_above_limit.values
    numbers = {
        "means": _means(evidence),
        "broken": ", ".join(map(str, broken)),
        "stops": ", ".join(map(str, stops)),
    }
    return Finding(((broken == 0).all(), (stops > 0).all()), numbers)


def _means(evidence: Evidence) -> str:
    return ", ".join(f"{mean:.3f}" for mean in evidence.key.largest_mean_rise.sel(mv=CHOKE).values)


def mean_move(evidence: Evidence) -> Finding:
    """The windowed mean passes the limit by one step at most."""
    data = evidence.data
    limit = data.tuning_mean_move_limit.sel(mv=CHOKE).values
    step = data.tuning_move_high.sel(mv=CHOKE).values / data.mean_move_window.values
    below = evidence.key.largest_mean_rise.sel(mv=CHOKE).values <= limit + step + 1e-6
    return Finding(tuple(below), {"means": _means(evidence), "limit": limit.max(), "step": step.max()})


def follows(evidence: Evidence, run: Run) -> Finding:
    """Demands are whole steps, and the choke is where it is told to be."""
    demand, position, move = (run[name].sel(mv=CHOKE).values for name in ("demand", "position", "move"))
    steps = (demand - (demand[0] - move[0])) / run.tuning_move_high.sel(mv=CHOKE).item()
    fraction, behind = np.abs(steps - np.round(steps)).max(), np.abs(demand - position).max()
    return Finding((fraction < 1e-6, behind < 1e-6), {"fraction": fraction, "behind": behind})


def no_reversal_at_once(evidence: Evidence, run: Run) -> Finding:
    """No move is taken back in the next sample."""
    move = run.move.sel(mv=CHOKE).values
    at_once = (move[1:] * move[:-1] < -1e-9).sum()
    moved = np.flatnonzero(np.abs(move) > 1e-9)
    turns = np.diff(moved)[np.sign(move[moved[1:]]) != np.sign(move[moved[:-1]])]
    quickest = f", the quickest after {turns.min() * float(run.attrs['dt']):.0f} s" if turns.size else ""
    numbers = {"at_once": at_once, "moved": len(moved), "turns": turns.size, "quickest": quickest}
    return Finding((at_once == 0,), numbers)
