"""A relaxed problem, solved to the end: Newton, and where that falls short the interior point and Newton again.

This is what controllers and the integer search call; `qp` and `newton` are its two methods. Under `jax.vmap` a batch is
not solved in lockstep, where every lane would pay for the slowest. A CPU solves one lane after the other, so that each takes
the steps it needs; elsewhere many lanes at a time take Newton steps together, those that finish make room for others, and
the interior point sees only the lanes that need it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmpc.problem.condense import CondensedQp, QpInstance
from jaxmpc.relaxed.gram import SUMMED_LIMIT, running_sums
from jaxmpc.relaxed.interior_point import solve
from jaxmpc.relaxed.newton import WarmStart, refine, warm_start_of
from jaxmpc.relaxed.problem import QpSolution, evaluate, prepare
from jaxmpc.status import FAILED, OPTIMAL

ROUGH = 1e-9  # relative gap at which the interior point stops
ENOUGH = 1e-7  # residual from which on a solution is not improved
WIDTH = 1024  # lanes of a batch that go in lockstep on an accelerator
LEFT = 4  # they stop when one in so many is unfinished, and leave the room to others
AXIS = "relaxed lane"
ROW_ROUNDING = 1e-6  # slack of the hard rows of rounded moves, which are whole numbers themselves


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
        qp: constant part; a batch that shares its `response` is fastest.
        rows: hard rows, `blocking.hard_rows(structure)`.
        instance: offsets and limits of this sample.
        lower, upper: limits of x; equal limits fix a move.
        start: moves and prices of a neighbouring problem, None to start cold.

    Returns:
        `QpSolution` with status `OPTIMAL` if its duality gap is at most 1e-6 and the hard rows hold to 1e-8 [scaled moves],
        else `FAILED`; `iterations` counts both methods, `residual` is the larger of gap and violation.
    """
    start = cold_start(qp, len(rows), instance.limit_high.shape[-1]) if start is None else start
    return _solve((qp, jnp.asarray(rows), instance, lower, upper), start)


@jax.custom_batching.custom_vmap
def _solve(given, start: WarmStart) -> QpSolution:
    return _solve_lane(given, start, None)


@_solve.def_vmap
def _(size: int, batched, given, start):
    result = _lanes_solver(size, *batched)(given, start)
    return result, jax.tree.map(lambda _: True, result)


def _lanes_solver(size: int, own, own_start):
    """`_solve_batch` for so many lanes; `own` and `own_start` are True for arrays with a batch axis."""
    mine = own, own_start

    @jax.custom_batching.custom_vmap
    def solver(given, start):
        return _solve_batch(size, given, own, start, own_start)

    @solver.def_vmap
    def _(outer: int, batched, given, start):
        arguments, batched = (given, start), tuple(batched)
        spread = lambda v, mapped: v if mapped else jnp.broadcast_to(v, (outer, *v.shape))  # noqa: E731
        if batched[0][0].response and not own[0].response:  # one batch for each model
            result = jax.lax.map(lambda a: solver(*a), jax.tree.map(spread, arguments, batched))
            return result, jax.tree.map(lambda _: True, result)
        # a batch of batches is one large batch
        either = jax.tree.map(lambda mapped, one: mapped or one, batched, mine)

        def merge(v, mapped, one, any_):
            if not any_:
                return v
            v = spread(v, mapped) if one else jnp.repeat(v[:, None], size, axis=1)
            return v.reshape(outer * size, *v.shape[2:])

        given, start = jax.tree.map(merge, arguments, batched, mine, either)
        result = _lanes_solver(outer * size, *either)(given, start)
        result = jax.tree.map(lambda v: v.reshape(outer, size, *v.shape[1:]), result)
        return result, jax.tree.map(lambda _: True, result)

    return solver


def _with_sums(given, own):
    """The same problems with running sums where lanes share the responses; and what has a batch axis."""
    qp, instance = given[0], given[2]
    if qp.summed is not None or own[0].response or qp.response.shape[-1] > SUMMED_LIMIT:
        return given, own
    put = lambda tree, sums: eqx.tree_at(lambda q: q.summed, tree, sums, is_leaf=lambda v: v is None)  # noqa: E731
    predictions, cvs = instance.limit_high.shape[-1], qp.slack_weight.shape[-1]
    sums = running_sums(qp.response[:predictions], cvs)
    return (put(qp, sums), *given[1:]), (put(own[0], False), *own[1:])


def _solve_lane(given, start: WarmStart, axis: str | None) -> QpSolution:
    """One lane from its start to the end; with an axis name, as one of a few lanes that go in lockstep."""
    problem = prepare(*given)
    somewhere = lambda flag: flag if axis is None else jax.lax.psum(flag.astype(jnp.int32), axis) > 0  # noqa: E731

    def attempt(carry):
        round_, best, start = carry

        def rescue(best):
            other = solve(problem, skip=~_unsolved(best), tolerance=ROUGH)
            best = _better(best, other)
            return best, warm_start_of(best)

        # the interior point has a try only where Newton fell short; Newton then finishes its result
        best, start = jax.lax.cond(round_ > 0, rescue, lambda best: (best, start), best)
        other, start, _ = refine(problem, start, skip=~_unsolved(best), axis=axis)
        return round_ + 1, _better(best, other), start

    carry = jnp.zeros((), dtype=jnp.int32), _nothing(*given[:3]), start
    _, best, _ = jax.lax.while_loop(
        lambda carry: (carry[0] < 2) & somewhere(_unsolved(carry[1])), attempt, carry
    )
    return best


def _unsolved(best: QpSolution) -> Bool[Array, ""]:
    return ~((best.status == OPTIMAL) & (best.residual <= ENOUGH))


def _nothing(qp: CondensedQp, rows, instance: QpInstance) -> QpSolution:
    """A solution that any other is better than."""
    hard, n, count = rows.shape[-2], qp.response.shape[-1], qp.response.shape[-2]
    infinite = jnp.asarray(np.inf)
    return QpSolution(
        x=jnp.zeros(n),
        objective=infinite,
        bound=-infinite,
        status=jnp.asarray(FAILED),
        iterations=jnp.zeros((), dtype=jnp.int32),
        row_price=jnp.zeros(count),
        limit_price=jnp.zeros(instance.limit_high.shape[-1]),
        lower_price=jnp.zeros(n),
        upper_price=jnp.zeros(n),
        row_low_price=jnp.zeros(hard),
        row_high_price=jnp.zeros(hard),
        residual=infinite,
    )


def _better(best: QpSolution, other: QpSolution) -> QpSolution:
    picked = jax.tree.map(lambda a, b: jnp.where(other.residual < best.residual, b, a), best, other)
    return eqx.tree_at(lambda s: s.iterations, picked, best.iterations + other.iterations)


NEWTON, RESCUE, RETRY, DONE = range(4)  # what a lane of a batch waits for


class _Progress(NamedTuple):
    """A batch on its way: results so far, where lanes go on, what they wait for, and whose turn it is."""

    result: QpSolution
    start: WarmStart
    stage: Array
    turn: Array


def _solve_batch(size: int, given, own, start: WarmStart, own_start) -> QpSolution:
    """Many lanes; `own` and `own_start` are True for arrays with a batch axis."""
    given, own = _with_sums(given, own)
    if jax.default_backend() == "cpu":
        return solve_singly(given, own, start, own_start)
    return solve_together(size, given, own, start, own_start)


def solve_singly(given, own, start: WarmStart, own_start) -> QpSolution:
    """A batch, one lane after the other; arguments as in `solve_together`."""
    return map_singly(lambda given, start: _solve_lane(given, start, None), (given, start), (own, own_start))


def map_singly(function, arguments, own):
    """The function over the arrays of its arguments that have a batch axis, one lane after the other."""
    leaves, form = jax.tree.flatten(arguments)
    mine = jax.tree.leaves(own)

    def lane(some):
        some = iter(some)
        return function(
            *form.unflatten([next(some) if its else v for v, its in zip(leaves, mine, strict=True)])
        )

    return jax.lax.map(lane, [v for v, its in zip(leaves, mine, strict=True) if its])


def solve_together(size: int, given, own, start: WarmStart, own_start) -> QpSolution:
    """A batch, up to `WIDTH` lanes in lockstep.

    Args:
        size: number of lanes.
        given: arguments of `solve_relaxed` up to the limits.
        own: of the same structure, True for arrays with a batch axis.
        start: where to begin.
        own_start: as `own`.
    """
    if size <= WIDTH:
        to_the_end = lambda given, start: _solve_lane(given, start, AXIS)  # noqa: E731
        return _lanes(to_the_end, (given, start), (own, own_start))
    start = jax.tree.map(
        lambda v, mine: v if mine else jnp.broadcast_to(v, (size, *v.shape)), start, own_start
    )
    mine = own, jax.tree.map(lambda _: True, start)

    def newton(few, picked, stage, skip):
        some_steps = lambda given, start, skip: refine(prepare(*given), start, skip=skip, few=few, axis=AXIS)  # noqa: E731
        solution, resume, ended = _lanes(some_steps, (*picked, skip), (*mine, True))
        return solution, resume, jnp.where(ended, jnp.where(stage == NEWTON, RESCUE, DONE), stage)

    def rescue(_, picked, stage, skip):
        def interior(given, start, skip):
            solution = solve(prepare(*given), skip=skip, tolerance=ROUGH)
            return solution, warm_start_of(solution)

        return *_lanes(interior, (*picked, skip), (*mine, True)), jnp.full_like(stage, RETRY)

    def visit(progress: _Progress) -> _Progress:
        """Some lanes get on: those whose turn it is, Newton's first."""
        ready = (progress.stage == NEWTON) | (progress.stage == RETRY)
        stepping = jnp.any(ready)
        waiting = jnp.where(stepping, ready, progress.stage == RESCUE)
        crowd = jnp.sum(waiting)
        order = (jnp.arange(size) + progress.turn) % size
        lanes = order[jnp.nonzero(waiting[order], size=WIDTH, fill_value=0)[0]]
        skip = jnp.arange(WIDTH) >= crowd
        few = jnp.where(crowd > WIDTH, WIDTH // LEFT, 0)
        picked = jax.tree.map(lambda v, own: v[lanes] if own else v, (given, progress.start), mine)
        solution, resume, stage = jax.lax.cond(
            stepping, newton, rescue, few, picked, progress.stage[lanes], skip
        )
        steps = progress.result.iterations[lanes] + solution.iterations
        stage = jnp.where(jax.vmap(_unsolved)(solution), stage, DONE)
        # rows that must not be written are sent out of range
        write = lambda rows: lambda old, new: old.at[rows].set(new, mode="drop")  # noqa: E731
        here = jnp.where(skip, size, lanes)
        improved = solution.residual < progress.result.residual[lanes]
        result = jax.tree.map(write(jnp.where(improved, here, size)), progress.result, solution)
        result = eqx.tree_at(lambda s: s.iterations, result, write(here)(result.iterations, steps))
        return _Progress(
            result=result,
            start=jax.tree.map(write(here), progress.start, resume),
            stage=write(here)(progress.stage, stage),
            turn=(lanes[-1] + 1) % size,
        )

    nothing = jax.tree.map(lambda v: jnp.broadcast_to(v, (size, *v.shape)), _nothing(*given[:3]))
    first = _Progress(nothing, start, jnp.full(size, NEWTON), jnp.zeros((), dtype=int))
    return jax.lax.while_loop(lambda progress: jnp.any(progress.stage != DONE), visit, first).result


def _lanes(function, arguments, own):
    """The function under `jax.vmap`, over the arrays of its arguments that have a batch axis."""
    leaves, form = jax.tree.flatten(arguments)
    axes = tuple(0 if mine else None for mine in jax.tree.leaves(own))
    call = lambda *leaves: function(*jax.tree.unflatten(form, leaves))  # noqa: E731
    return jax.vmap(call, in_axes=axes, axis_name=AXIS)(*leaves)


def cold_start(qp: CondensedQp, hard: int, predictions: int) -> WarmStart:
    """A start that knows nothing: no moves, no prices."""
    rows, n = qp.response.shape
    return WarmStart(*(jnp.zeros(size) for size in (n, rows, predictions, n, hard)))


def shifted_start(start: WarmStart, cvs: int, horizon: int) -> WarmStart:
    """The same prices one sample later: those of the predictions move one row up, the last is repeated."""

    def moved(prices):
        by_cv = prices[: cvs * horizon].reshape(cvs, horizon)
        later = jnp.concatenate([by_cv[:, 1:], by_cv[:, -1:]], axis=1).reshape(-1)
        return jnp.concatenate([later, prices[cvs * horizon :]])

    return eqx.tree_at(
        lambda s: (s.row_price, s.limit_price), start, (moved(start.row_price), moved(start.limit_price))
    )


class Solved(NamedTuple):
    """What a search reads of one relaxed problem, or of a batch; see `relaxer.Relaxations`."""

    warm: WarmStart
    objective: Any
    bound: Any
    snapped: Any
    status: Any
    steps: Any


def relax(qp: CondensedQp, rows, integer, instance: QpInstance, lower, upper, start: WarmStart) -> Solved:
    """Relax one problem within limits of the moves, and evaluate its moves with the integer ones rounded."""
    s = solve_relaxed(qp, rows, instance, lower, upper, start)
    snapped = s.x.at[integer].set(jnp.round(s.x[integer]))
    w = rows @ snapped
    fits = jnp.all((w <= instance.row_high + ROW_ROUNDING) & (w >= instance.row_low - ROW_ROUNDING))
    fits &= jnp.all((snapped <= instance.upper + ROW_ROUNDING) & (snapped >= instance.lower - ROW_ROUNDING))
    value = jnp.where(fits, evaluate(qp, instance, snapped), jnp.inf)
    return Solved(warm_start_of(s), s.objective, s.bound, value, s.status, s.iterations)
