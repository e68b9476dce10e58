"""Problems that cannot fit into memory, refused before anything is computed: horizons and blocks, ranges of whole moves.

The estimates count the arrays of one solve, generously; a problem beyond `BUDGET` has a typing error in a horizon, a step
or a limit.
"""

from __future__ import annotations

import numpy as np

from jaxmpc.errors import InputError
from jaxmpc.problem.condense import SUMMED_BYTES
from jaxmpc.problem.structure import Structure

BUDGET = 4 * 2**30  # bytes that one problem may take
FARTHEST = 10**12  # whole steps that a move may be away; with block lengths far below what 64 bits hold
_NUMBER = 8  # bytes
_DENSE, _SUMS, _SQUARE = 8, 3, 16  # copies of responses, of their running sums, and of matrices of the moves
_RANGE = 24  # arrays over every whole move a move may take: prices, and what nodes of a search keep


def check_size(structure: Structure) -> None:
    """Refuse horizons and blocks whose matrices do not fit.

    Raises:
        InputError: naming ``structure.blocks`` and the bytes that are needed.
    """
    rows = structure.cv_count * structure.horizon_count
    moves = structure.mv_count * structure.block_count
    numbers = (
        _DENSE * (rows + structure.control_horizon) * moves
        + min(_SUMS * rows * (moves * (moves + 1) // 2), _SUMS * SUMMED_BYTES // _NUMBER)
        + _SQUARE * moves**2
    )
    if _NUMBER * numbers > BUDGET:
        raise InputError(
            "structure.blocks",
            f"{structure.block_count} blocks",
            f"a problem of {_gib(BUDGET)} at most: {moves} moves and {rows} predictions take {_gib(_NUMBER * numbers)}",
            "Take fewer and longer blocks, or a shorter horizon",
        )


def check_ranges(structure: Structure, lower: np.ndarray, upper: np.ndarray) -> None:
    """Refuse ranges of whole moves that a search cannot list.

    Args:
        lower, upper: limits ``"scenario integer"`` of all whole moves [steps], MV after MV.

    Raises:
        InputError: naming ``structure.integer_step`` of the MV with the widest range, and the bytes that are needed.
    """
    width = np.where(lower <= upper, upper - lower + 1.0, 1.0)
    far = np.where(lower <= upper, np.maximum(np.abs(lower), np.abs(upper)), 0.0)
    needed = _NUMBER * (_RANGE + len(lower)) * width.shape[1] * float(width.max(initial=1.0))
    if needed <= BUDGET and far.max(initial=0.0) <= FARTHEST:
        return
    most = np.maximum(width, far).max(axis=0)
    mvs = range(structure.mv_count)
    mv = np.repeat(mvs, [structure.whole_blocks(mv) for mv in mvs])[int(np.argmax(most))]
    listed = structure.integer_step[mv] is None
    raise InputError(
        f"structure.{'integer_values' if listed else 'integer_step'}.{structure.mv_names[mv]}",
        structure.integer_values[mv] if listed else structure.integer_step[mv],
        f"a step [MV unit] with fewer whole moves inside the limits: up to {most.max():.3g} of them per block take "
        f"{_gib(needed)} of the {_gib(BUDGET)} that one problem may take",
        "Take a larger step, or narrower tuning.move_low and tuning.move_high",
    )


def _gib(size: float) -> str:
    return f"{size / 2**30:.3g} GiB"
