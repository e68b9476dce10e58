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
from jaxmpc.qp import solve
from jaxmpc.relaxed_problem import QpSolution
from jaxmpc.status import FAILED, OPTIMAL

ROUGH = 1e-9  # relative gap at which the interior point stops
ENOUGH = 5e-9  # relative gap up to which its result needs no Newton finish
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

    def attempt(carry):
        round_, best, start = carry
        known = best.status == OPTIMAL
        newton = refine(qp, rows, instance, lower, upper, start, skip=known)
        best = _choose(known | ~(newton.residual < best.residual), best, newton)
        # the interior point follows a first attempt only; a second one starts from its result
        skip = (best.status == OPTIMAL) | (round_ > 0)
        cold = judge(solve(qp, rows, instance, lower, upper, skip=skip, tolerance=ROUGH), ENOUGH)
        best = _choose(skip | ~(cold.residual < best.residual), best, cold)
        return round_ + 1, best, warm_start_of(best)

    first = start if start is not None else cold_start(qp, len(rows))
    shape = jax.eval_shape(lambda: refine(qp, rows, instance, lower, upper, first))
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
    nothing = eqx.tree_at(
        lambda s: (s.status, s.residual, s.bound, s.objective),
        nothing,
        (
            jnp.full_like(nothing.status, FAILED),
            *(jnp.full_like(nothing.bound, v) for v in (np.inf, -np.inf, np.inf)),
        ),
    )
    _, best, _ = jax.lax.while_loop(
        lambda carry: (carry[0] < 2) & (carry[1].status != OPTIMAL),
        attempt,
        (jnp.zeros((), dtype=jnp.int32), nothing, first),
    )
    return judge(best, ACCEPTED)


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
