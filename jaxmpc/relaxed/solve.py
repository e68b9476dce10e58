"""Relaxed problems, solved to the end; what controllers and the integer search call.

Under `jax.vmap` a batch is not solved in lockstep on a CPU, where every lane would pay for the slowest: one lane is solved
after the other, so that each takes the steps it needs (`programs.lanes`).
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmpc.problem.condense import CondensedQp
from jaxmpc.problem.instance import QpInstance
from jaxmpc.relaxed.newton import WarmStart, refine
from jaxmpc.relaxed.problem import QpSolution, prepare


def solve_relaxed(
    qp: CondensedQp,
    instance: QpInstance,
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    start: WarmStart | None = None,
    most: Array | float = np.inf,
) -> QpSolution:
    """Solve one relaxed problem (one lane; use `jax.vmap` for a batch).

    Args:
        qp: constant part; a batch that shares its `response` is fastest.
        instance: offsets and limits of this sample.
        lower, upper: limits of x; equal limits fix a move.
        start: moves and prices of a neighbouring problem, None to start cold.
        most: Newton steps at most; the certificate is what they reach.

    Returns:
        `QpSolution` with status `OPTIMAL` if its duality gap is at most 1e-6 and the hard rows hold to 1e-8 [scaled moves],
        else `FAILED`; `residual` is the larger of gap and violation.
    """
    start = cold_start(qp, instance) if start is None else start
    return refine(prepare(qp, instance, lower, upper), start, most)


def cold_start(qp: CondensedQp, instance: QpInstance) -> WarmStart:
    """A start that knows nothing: no moves, no prices."""
    # on the host NumPy makes zeros in no time
    none: Any = jnp.zeros_like if isinstance(instance.lower, jax.Array) else np.zeros_like
    x, hard = none(instance.lower), none(instance.row_low)
    position = hard[: 0 if qp.position_weight is None else hard.shape[0]]
    return WarmStart(x, none(instance.offset), none(qp.steep), position, none(instance.limit_high), x, hard)


def shifted_start(start: WarmStart, cvs: int) -> WarmStart:
    """The same prices one sample later: those of the predictions move one up, the last of a CV is repeated."""

    def moved(prices):
        by_cv = prices.reshape(cvs, -1)
        return jnp.concatenate([by_cv[:, 1:], by_cv[:, -1:]], axis=1).reshape(-1)

    return eqx.tree_at(
        lambda s: (s.row_price, s.limit_price), start, (moved(start.row_price), moved(start.limit_price))
    )
