"""The search for the whole moves of one step as one compiled program.

It takes the line of `integer` as far as most steps need it: the rounded relaxation is solved for an incumbent, the
prices of the root leave a list of whole moves that may be better (`levelset`), and the best of the list are solved one
after the other, each with a quadratic cut that bounds all others (`cuts`), until none is left. What does not fit (moves of
more than one step, rounded moves that break a hard row, longer lists) is left to `integer`, which starts anew.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxmpc.integer import listing as lists
from jaxmpc.integer.listing import STEPS, Listed, LowerBound, Order, Tables, decode, encode, fits, order_of
from jaxmpc.problem.condense import CondensedQp, QpInstance
from jaxmpc.problem.structure import Structure
from jaxmpc.relaxed.gap import closes, cutoff
from jaxmpc.relaxed.solve import Solved, map_singly, relax
from jaxmpc.status import finisher_code

MOST_SOLVED = 64  # of a list
CUT_BLOCK = 256  # entries of a list that are cut together
MOST_MOVES = 31  # of two bits each in one code


class Decision(NamedTuple):
    """What a search found.

    Attributes:
        closed: whether it is proven; nothing else counts otherwise.
        x: the moves, scaled.
        value, bound: objective, and what no whole moves are below.
        finished_by: code of `status.FINISHERS`.
        nodes: relaxations solved in place of the root and the rounded root.
        steps: Newton steps and interior-point iterations.
    """

    closed: Bool[Array, ""]
    x: Float[Array, " n"]
    value: Float[Array, ""]
    bound: Float[Array, ""]
    finished_by: Int[Array, ""]
    nodes: Int[Array, ""]
    steps: Int[Array, ""]


def searchable(structure: Structure) -> bool:
    """Whether the search knows all hard rows of a structure, and its codes hold all moves."""
    moves = len(structure.integer_mvs) * structure.block_count
    return 0 < moves <= MOST_MOVES and structure.mean_move_mode != "predictive"


class _State(NamedTuple):
    point: Array
    expected: Array
    codes: Array
    bounds: Array
    count: Array
    value: Array
    x: Array
    left_out: Array
    nodes: Array
    steps: Array
    finished_by: Array
    open: Array
    given_up: Array


def decide(
    structure: Structure,
    qp: CondensedQp,
    tables: Tables,
    rows: Float[Array, "hard n"],
    instance: QpInstance,
    root: Solved,
    gap: Float[Array, ""] | float,
) -> Decision:
    """Search one step (use `jax.vmap` for a batch).

    Args:
        structure: `searchable`.
        qp: constant part.
        tables: of the same scenario.
        rows: hard rows.
        instance: the problem of this sample.
        root: its relaxation.
        gap: relative gap at which a solve is optimal.
    """
    return _decide(structure)(qp, tables, jnp.asarray(rows), instance, root, jnp.asarray(gap, dtype=float))


@functools.lru_cache(maxsize=64)
def _decide(structure: Structure):
    """`decide_lane`, whose batches a CPU searches one by one."""
    lane = functools.partial(decide_lane, structure)

    def where_open(*arguments) -> Decision:
        """A search takes as long to set up as a relaxation: none without a root."""
        root: Solved = arguments[-2]
        none, zero = jnp.zeros(()), jnp.zeros((), dtype=int)
        nothing = Decision(jnp.asarray(False), jnp.zeros_like(root.warm.x), none, none, zero, zero + 1, zero)
        return jax.lax.cond(jnp.isfinite(root.bound), lambda: lane(*arguments), lambda: nothing)

    search = jax.custom_batching.custom_vmap(lane)

    @search.def_vmap
    def _(size: int, batched, *arguments):
        own = tuple(batched)
        if jax.default_backend() == "cpu":
            result = map_singly(where_open, arguments, own)
        else:
            axes = jax.tree.map(lambda its: 0 if its else None, own)
            result = jax.vmap(lane, in_axes=axes, axis_size=size)(*arguments)
        return result, jax.tree.map(lambda _: True, result)

    return search


def decide_lane(
    structure: Structure, qp: CondensedQp, tables: Tables, rows, instance, root: Solved, gap
) -> Decision:
    """`decide` for one lane; under `jax.vmap`, all lanes go in lockstep."""
    order = order_of(structure)
    columns = order.columns
    predictions = instance.limit_high.shape[0]
    low, high = jnp.round(instance.lower[columns]), jnp.round(instance.upper[columns])
    limits = lists.position_limits(order, instance)
    usable = jnp.isfinite(root.warm.x).all() & jnp.isfinite(root.bound)
    usable &= jnp.all((low >= -1.0) & (high <= 1.0) & (low <= high))
    root_bound = jnp.maximum(root.bound, 0.0)  # every term of (6.6) is non-negative
    model = _lower_model(order, tables, root, predictions, low, high)
    first = jnp.clip(jnp.round(model.center), low, high)
    usable &= fits(order, limits, first[None])[0]

    def solved(point) -> Solved:
        lower, upper = (v.at[columns].set(point) for v in (instance.lower, instance.upper))
        return relax(qp, rows, columns, instance, lower, upper, root.warm)

    def cut_of(result: Solved, low, high):
        """See `cuts.cut_of`."""
        at, gradient = result.warm.x[columns], -result.warm.box_price[columns]
        value = result.bound - jnp.sum(jnp.minimum(gradient * (low - at), gradient * (high - at)))
        price = _envelope(order, tables, result, predictions)
        value -= jnp.sum(price * at - tables.knot * jnp.abs(price))
        return value, at, gradient - jnp.sum(price, axis=0)

    def listed(state: _State, result: Solved) -> _State:
        """The first incumbent is known: what may be better?"""
        limit = cutoff(state.value, tables.scale, gap)
        away = STEPS - model.center[:, None]
        curved = jnp.where(jnp.isfinite(tables.radius), 0.5 / tables.radius, 0.0)[:, None] * away**2
        alone = model.value + model.excess + curved
        excess = jnp.where(alone < limit, model.excess, jnp.inf)
        left = jnp.isfinite(excess)
        sizes = jnp.sum(left, axis=1)
        kept = LowerBound(model.value, model.center, excess)
        grid = jnp.sum(sizes > 1) <= lists.GRID_FREE
        closed, empty = root_bound >= limit, jnp.any(sizes == 0)

        which = jnp.where(closed | empty, 0, jnp.where(grid, 1, 2))
        found = jax.lax.switch(
            which,
            [
                Listed.empty,
                lambda: lists.grid_below(order, tables, limits, kept, sizes, limit),
                lambda: lists.list_below(order, tables, limits, kept, limit),
            ],
        )
        fixed = empty | (jnp.max(sizes) == 1)
        by = jnp.where(
            closed,
            finisher_code("relaxation"),
            jnp.where(fixed, finisher_code("fixing"), finisher_code("enumeration")),
        )
        bounds = jnp.where(found.codes == encode(state.point), jnp.inf, found.bounds)
        state = state._replace(
            codes=found.codes,
            bounds=bounds,
            count=jnp.minimum(found.count, lists.LONGEST),
            left_out=jnp.minimum(state.left_out, jnp.where(closed, root_bound, limit)),
            finished_by=by,
            given_up=(found.count > lists.LONGEST) | ~jnp.isfinite(state.value),
        )
        return with_cut(state, cut_of(root, low, high))

    def with_cut(state: _State, cut) -> _State:
        """Bounds of everything on the list are raised to those of a cut."""
        value, at, gradient = cut
        sound = jnp.isfinite(value) & jnp.isfinite(gradient).all()
        curved_at = at @ tables.root

        def more(carry):
            begin, bounds = carry
            points = decode(jax.lax.dynamic_slice(state.codes, (begin,), (CUT_BLOCK,)), len(columns))
            away = points @ tables.root - curved_at
            bound = (
                value
                + (points - at) @ gradient
                + 0.5 * jnp.sum(away**2, axis=1)
                + points**2 @ tables.own_weight
            )
            old = jax.lax.dynamic_slice(bounds, (begin,), (CUT_BLOCK,))
            new = jnp.where(sound, jnp.maximum(old, bound), old)
            return begin + CUT_BLOCK, jax.lax.dynamic_update_slice(bounds, new, (begin,))

        _, bounds = jax.lax.while_loop(lambda carry: carry[0] < state.count, more, (0, state.bounds))
        return state._replace(bounds=bounds)

    def visit(state: _State) -> _State:
        """Solve the next moves: an incumbent, a cut, and what to solve after them."""
        result = solved(state.point)
        better = (result.snapped < state.value) & jnp.isfinite(result.warm.x).all()
        state = state._replace(
            value=jnp.where(better, result.snapped, state.value),
            x=jnp.where(better, result.warm.x.at[columns].set(state.point), state.x),
            left_out=jnp.minimum(
                state.left_out, jnp.minimum(jnp.maximum(result.bound, state.expected), result.snapped)
            ),
            nodes=state.nodes + 1,
            steps=state.steps + result.steps,
        )
        state = jax.lax.cond(state.nodes == 2, listed, lambda state, _: state, state, result)
        state = with_cut(state, cut_of(result, state.point, state.point))
        best = jnp.argmin(state.bounds)
        going = (state.bounds[best] < cutoff(state.value, tables.scale, gap)) & ~state.given_up
        return state._replace(
            point=jnp.where(going, decode(state.codes[best], len(columns)), state.point),
            expected=state.bounds[best],
            bounds=state.bounds.at[best].set(jnp.where(going, jnp.inf, state.bounds[best])),
            open=going & (state.nodes <= MOST_SOLVED),
            given_up=state.given_up | (going & (state.nodes > MOST_SOLVED)),
        )

    rounded = root.warm.x.at[columns].set(jnp.round(root.warm.x[columns]))
    state = _State(
        point=first,
        expected=jnp.asarray(-jnp.inf),
        codes=jnp.zeros(lists.LONGEST, dtype=int),
        bounds=jnp.full(lists.LONGEST, jnp.inf),
        count=jnp.zeros((), dtype=int),
        value=root.snapped,
        x=rounded,
        left_out=jnp.asarray(jnp.inf),
        nodes=jnp.ones((), dtype=int),
        steps=jnp.zeros((), dtype=int),
        finished_by=jnp.zeros((), dtype=int),
        open=usable,
        given_up=~usable,
    )
    state = jax.lax.while_loop(lambda state: state.open, visit, state)
    left_out = jnp.minimum(state.left_out, jnp.min(state.bounds))
    bound = jnp.minimum(jnp.maximum(left_out, root_bound), state.value)
    closed = ~state.given_up & closes(state.value, bound, tables.scale, gap)
    return Decision(
        closed, state.x, state.value, bound, state.finished_by, jnp.maximum(state.nodes - 1, 1), state.steps
    )


def _envelope(order: Order, tables: Tables, result: Solved, predictions: int):
    """Prices of the envelope, ``"level integer"``."""
    return result.warm.row_price[predictions:].reshape(tables.knot.shape)[:, order.order]


def _lower_model(order: Order, tables: Tables, root: Solved, predictions: int, low, high) -> LowerBound:
    """See `search.Search.lower_model`."""
    center, slope = root.warm.x[order.columns], -root.warm.box_price[order.columns]
    least = jnp.minimum(slope * (low - center), slope * (high - center))
    excess = slope[:, None] * (STEPS - center[:, None]) - least[:, None]
    price, knot = _envelope(order, tables, root, predictions)[..., None], tables.knot[..., None]
    own = tables.slope[..., None] * jnp.maximum(jnp.abs(STEPS) - knot, 0.0)
    excess += jnp.sum(own - price * STEPS + knot * jnp.abs(price), axis=0)
    allowed = (low[:, None] <= STEPS) & (high[:, None] >= STEPS)
    return LowerBound(root.bound, center, jnp.where(allowed, jnp.maximum(excess, 0.0), jnp.inf))
