"""A relaxed problem, solved to the end: warm Newton, interior point, Newton again where that fell short.

This is what controllers and the integer search call; `qp` and `newton` are its two methods. A lane that one method has
solved does not iterate in the next, so a batch pays for a method only while some lane needs it.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmpc.condense import CondensedQp, QpInstance
from jaxmpc.newton import WarmStart, certified, refine, warm_start_of
from jaxmpc.qp import QpSolution, solve
from jaxmpc.status import OPTIMAL

ROUGH = 1e-8  # relative gap at which the interior point stops
ENOUGH = 3e-8  # relative gap up to which its result needs no Newton finish
ACCEPTED = 1e-6  # relative gap up to which the better of all results counts as solved


def solve_relaxed(
    qp: CondensedQp,
    rows: Float[Array, "hard n"] | np.ndarray,
    instance: QpInstance,
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    start: WarmStart | None = None,
) -> QpSolution:
    """Solve one relaxed problem (one lane; use `jax.vmap` for a batch).

    Args:
        qp: constant part.
        rows: hard rows, `blocking.hard_rows(structure)`.
        instance: offsets and limits of this sample.
        lower, upper: limits of x; equal limits fix a move.
        start: moves and prices of a neighbouring problem, None to start cold.

    Returns:
        `QpSolution` with status `OPTIMAL` if its duality gap is at most 1e-6 and the hard rows hold to 1e-8 [scaled moves],
        else `FAILED`; `iterations` counts both methods, `residual` is the larger of gap and violation.
    """
    judge = lambda s, gap: certified(qp, rows, instance, s, lower, upper, gap)  # noqa: E731
    if start is None:
        result = judge(solve(qp, rows, instance, lower, upper, tolerance=ROUGH), ENOUGH)
    else:
        warm = refine(qp, rows, instance, lower, upper, start)
        done = warm.status == OPTIMAL
        cold = judge(solve(qp, rows, instance, lower, upper, skip=done, tolerance=ROUGH), ENOUGH)
        result = _choose(done, warm, cold)
    done = result.status == OPTIMAL
    finish = refine(qp, rows, instance, lower, upper, warm_start_of(result), skip=done)
    better = ~done & jnp.isfinite(finish.residual) & (finish.residual < result.residual)
    result = _choose(~better, result, finish)
    return judge(result, ACCEPTED)


def _choose(first_is_taken, first: QpSolution, second: QpSolution) -> QpSolution:
    picked = jax.tree.map(lambda a, b: jnp.where(first_is_taken, a, b), first, second)
    return eqx.tree_at(lambda s: s.iterations, picked, first.iterations + second.iterations)


def cold_start(qp: CondensedQp, hard: int) -> WarmStart:
    """A start that knows nothing: no moves, no prices."""
    n, rows = qp.theta.shape[1], qp.theta.shape[0]
    return WarmStart(jnp.zeros(n), jnp.zeros(rows), jnp.zeros(n), jnp.zeros(hard))


def shifted_start(start: WarmStart, cvs: int, horizon: int) -> WarmStart:
    """The same prices one sample later: those of the predictions move one row up, the last is repeated."""
    predictions = start.row_price[: cvs * horizon].reshape(cvs, horizon)
    moved = jnp.concatenate([predictions[:, 1:], predictions[:, -1:]], axis=1).reshape(-1)
    return eqx.tree_at(
        lambda s: s.row_price, start, jnp.concatenate([moved, start.row_price[cvs * horizon :]])
    )
