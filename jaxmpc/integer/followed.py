"""Whether continuous moves beyond the integer horizon can follow whole ones where chains do not tell: mean moves (6.6)."""

from __future__ import annotations

import numpy as np

from jaxmpc.integer.chain import SLACK
from jaxmpc.problem.condense import Rows
from jaxmpc.problem.instance import QpInstance
from jaxmpc.problem.layout import Size
from jaxmpc.problem.structure import Structure


def followed(structure: Structure, size: Size, rows: Rows, instance: QpInstance, moves: np.ndarray) -> bool:
    """Whether continuous moves beyond the integer horizon can keep all hard rows after these whole moves.

    A linear programme per MV, for the rows of mean moves: all others are in the chains, exactly.
    """
    from jaxmpc.integer.highs import solve_milp  # HiGHS is loaded when it is first needed

    by_mv = lambda values: np.reshape(np.asarray(values), (size.mvs, -1))  # noqa: E731
    row_low, row_high, lower, upper = map(
        by_mv, (instance.row_low, instance.row_high, instance.lower, instance.upper)
    )
    own = np.broadcast_to(rows.own, (size.mvs, *np.shape(rows.own)[-2:]))
    first = 0
    for mv in structure.integer_mvs:
        count, blocks = structure.whole_blocks(mv), len(structure.blocks_of(mv))
        made = own[mv][:, :count] @ moves[first : first + count]
        first += count
        later, there = own[mv][:, count:blocks], np.isfinite(row_low[mv]) | np.isfinite(row_high[mv])
        if count == blocks:
            continue
        later = later[there]
        row, column = np.nonzero(later)
        status, _, _ = solve_milp(
            np.zeros(blocks - count),
            (row, column, later[row, column]),
            (row_low[mv] - made)[there] - SLACK,
            (row_high[mv] - made)[there] + SLACK,
            lower[mv, count:blocks],
            upper[mv, count:blocks],
            np.zeros(blocks - count, dtype=bool),
        )
        if status == "infeasible":
            return False
    return True
