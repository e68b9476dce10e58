"""What integer MVs must keep besides limits and hard rows: lists of allowed values with gaps, and a minimum dwell.

Both depend on where an MV stands and when it last moved, so that they are told anew at every sample, in steps from there.
Only the searches on the host know them: `feasible` propagates and checks them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxmpc.problem.structure import Structure
from jaxmpc.problem.values import has_gaps, positions

LONG_AGO = 10**9  # samples since a move that no dwell reaches


class Actuator(NamedTuple):
    """Of one integer MV at one sample.

    Attributes:
        allowed: positions that it may be in, increasing [steps from now]; None where limits and rows say all.
        dwell: least samples from one move to the next; 1 for none.
        since: samples since its last move; 1 for a move at the sample before.
    """

    allowed: Int[np.ndarray, " value"] | None = None
    dwell: int = 1
    since: int = LONG_AGO


def actuators_of(
    structure: Structure,
    mv_now: Float[np.ndarray, " mv"],
    since: Int[np.ndarray, " mv"],
    manual: Bool[np.ndarray, " mv"] | None = None,
) -> list[Actuator]:
    """Those of all integer MVs; none where limits and rows say all of what they must keep.

    Args:
        mv_now: where they stand, those with a list on one of its values [MV unit].
        since: samples since their last moves.
        manual: MVs that somebody else moves, which nothing is asked of.
    """
    if not structure.has_gaps_or_dwell:
        return []
    found = []
    for mv in structure.integer_mvs:
        values = structure.integer_values[mv] if structure.integer_values else None
        dwell = structure.dwell[mv] if structure.dwell else 1
        if manual is not None and manual[mv]:
            found.append(Actuator())
            continue
        allowed, step = None, structure.steps[mv]
        if values is not None and step is not None and has_gaps(values):
            allowed = positions(values) - int(np.round((mv_now[mv] - values[0]) / step))
        found.append(Actuator(allowed, dwell, int(since[mv])))
    return found


def samples_since(structure: Structure, past_moves: Float[np.ndarray, "past mv"]) -> Int[np.ndarray, " mv"]:
    """Samples since the last move of every MV, a move being half a step or more; `LONG_AGO` without one.

    Args:
        past_moves: the last moves, oldest first [MV unit].
    """
    found = np.full(structure.mv_count, LONG_AGO)
    for mv in structure.integer_mvs:
        moved = np.flatnonzero(np.abs(past_moves[:, mv]) >= 0.5 * (structure.steps[mv] or 1.0))
        if len(moved):
            found[mv] = len(past_moves) - moved[-1]
    return found
