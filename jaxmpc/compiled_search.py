"""The search for the whole moves of one step as one compiled program.

It takes the line of `integer` as far as most steps need it: the rounded relaxation is solved for an incumbent, the
prices of the root leave a list of whole moves that may be better (`levelset`), and the best of the list are solved one
after the other, each with a quadratic cut that bounds all others (`cuts`), until none is left. What does not fit (moves of
more than one step, rounded moves that break a hard row, longer lists) is left to `integer`, which starts anew.

A list is an array of codes with two bits per move, in the order in which the moves are assigned, block by block.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmpc.blocking import first_position_rows, moves_per_block, oscillation_rows
from jaxmpc.condense import CondensedQp, QpInstance, integer_columns
from jaxmpc.constants import Constants
from jaxmpc.levelset import assignment_order
from jaxmpc.relaxation import Solved, map_singly, relax
from jaxmpc.status import finisher_code
from jaxmpc.structure import Structure

LONGEST = 4096  # moves on a list; longer lists are left to the host
MOST_SOLVED = 64  # of a list
GRID_FREE = 5  # free moves up to which all combinations are looked at
BLOCK, CUT_BLOCK = 32, 256  # entries of a list that are extended, or cut, together
MOST_MOVES = 31  # of two bits each in one code
STEPS = np.array([0.0, 1.0, -1.0])  # of one move; their codes are 0, 1, 3


class Tables(eqx.Module):
    """Constants of a scenario that the search reads, integer moves in the order in which they are assigned.

    Attributes:
        radius, leading: as in `levelset.LowerModel`.
        root: factor of the curvature, `levelset.root_factor`.
        slope, knot: of the envelope of every move.
        own_weight: see `cuts`.
        scale: smallest value that gaps are relative to.
    """

    radius: Float[np.ndarray, " integer"]
    leading: Float[np.ndarray, "integer integer"]
    root: Float[np.ndarray, "integer integer"]
    slope: Float[np.ndarray, "level integer"]
    knot: Float[np.ndarray, "level integer"]
    own_weight: Float[np.ndarray, " integer"]
    scale: Float[np.ndarray, ""]

    @classmethod
    def of(cls, constants: Constants) -> Tables:
        """Those of one scenario."""
        c, order = constants, constants.order

        def levels(values):
            return values.reshape(c.levels, -1)[:, order] if c.levels else np.zeros((0, len(order)))

        return cls(
            radius=c.radius[order],
            leading=c.leading,
            root=c.root_factor[order],
            slope=levels(c.slope),
            knot=levels(c.knot),
            own_weight=c.own_weight[order],
            scale=np.asarray(1e-6 * c.scale),
        )


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


class _Order(NamedTuple):
    """Integer moves in the order in which they are assigned, from the structure alone.

    Attributes:
        order: their places among the integer moves.
        columns: their places in x.
        reach: ``"integer integer"``, row i gives the position of its MV after move i.
        previous: row i picks the move before i of the same MV.
        position: hard row of that position.
        pair: hard row that couples the move to the one before it; -1 for none.
    """

    order: np.ndarray
    columns: np.ndarray
    reach: np.ndarray
    previous: np.ndarray
    position: np.ndarray
    pair: np.ndarray


@functools.lru_cache(maxsize=64)
def _order_of(structure: Structure) -> _Order:
    mvs, blocks, counts = structure.integer_mvs, structure.block_count, moves_per_block(structure)
    order = assignment_order(blocks, len(mvs))
    chain, block = order // blocks, order % blocks
    mine = chain[:, None] == chain[None, :]
    earlier = block[None, :] <= block[:, None]
    firsts = first_position_rows(structure)[np.asarray(mvs)]
    pairs = oscillation_rows(structure)
    row_of = np.full(blocks, -1)
    row_of[np.argmax(pairs, axis=1)] = np.arange(len(pairs))
    return _Order(
        order=order,
        columns=integer_columns(structure)[order],
        reach=(mine & earlier) * counts[block][None, :].astype(float),
        previous=(mine & (block[None, :] == block[:, None] - 1)).astype(float),
        position=firsts[chain] + block,
        pair=np.where(row_of[block] < 0, -1, firsts[chain] + blocks + row_of[block]),
    )


def searchable(structure: Structure) -> bool:
    """Whether the search knows all hard rows of a structure, and its codes hold all moves."""
    moves = len(structure.integer_mvs) * structure.block_count
    return 0 < moves <= MOST_MOVES and structure.mean_move_mode != "predictive"


class _Lower(NamedTuple):
    """The root's quadratic lower bound, see `levelset.LowerModel`; `excess` has one column per entry of `STEPS`."""

    value: Array
    center: Array
    excess: Array


class _Rows(NamedTuple):
    """Limits of the positions after every move, and whether a move may differ from the last by one step at most."""

    low: Array
    high: Array
    coupled: Array


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


def closes(root: Solved, scale, gap) -> Bool[Array, ""]:
    """Whether the rounded moves of a relaxation are proven by its own bound.

    Args:
        root: the relaxation.
        scale: smallest value that gaps are relative to.
        gap: relative gap.
    """
    bound = jnp.maximum(root.bound, 0.0)
    size = jnp.maximum(jnp.abs(root.snapped), scale)
    return jnp.isfinite(root.snapped) & (root.snapped - bound <= gap * size)


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
    order = _order_of(structure)
    columns = order.columns
    predictions = instance.limit_high.shape[0]
    low, high = jnp.round(instance.lower[columns]), jnp.round(instance.upper[columns])
    limits = _limits(order, instance)
    usable = jnp.isfinite(root.warm.x).all() & jnp.isfinite(root.bound)
    usable &= jnp.all((low >= -1.0) & (high <= 1.0) & (low <= high))
    root_bound = jnp.maximum(root.bound, 0.0)  # every term of (6.6) is non-negative
    model = _lower_model(order, tables, root, predictions, low, high)
    first = jnp.clip(jnp.round(model.center), low, high)
    usable &= _fits(order, limits, first[None])[0]
    reference = lambda value: jnp.maximum(jnp.abs(value), tables.scale)  # noqa: E731
    cutoff = lambda value: value - 0.5 * gap * reference(value)  # noqa: E731

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
        limit = cutoff(state.value)
        away = STEPS - model.center[:, None]
        curved = jnp.where(jnp.isfinite(tables.radius), 0.5 / tables.radius, 0.0)[:, None] * away**2
        alone = model.value + model.excess + curved
        excess = jnp.where(alone < limit, model.excess, jnp.inf)
        left = jnp.isfinite(excess)
        sizes = jnp.sum(left, axis=1)
        kept = _Lower(model.value, model.center, excess)
        grid = jnp.sum(sizes > 1) <= GRID_FREE
        closed, empty = root_bound >= limit, jnp.any(sizes == 0)

        def nothing():
            return _Listed(
                jnp.zeros(LONGEST, dtype=int), jnp.full(LONGEST, jnp.inf), jnp.zeros((), dtype=int)
            )

        which = jnp.where(closed | empty, 0, jnp.where(grid, 1, 2))
        found = jax.lax.switch(
            which,
            [
                nothing,
                lambda: _grid_below(order, tables, limits, kept, sizes, limit),
                lambda: _list_below(order, tables, limits, kept, limit),
            ],
        )
        fixed = empty | (jnp.max(sizes) == 1)
        by = jnp.where(
            closed,
            finisher_code("relaxation"),
            jnp.where(fixed, finisher_code("fixing"), finisher_code("enumeration")),
        )
        bounds = jnp.where(found.codes == _encode(state.point), jnp.inf, found.bounds)
        state = state._replace(
            codes=found.codes,
            bounds=bounds,
            count=jnp.minimum(found.count, LONGEST),
            left_out=jnp.minimum(state.left_out, jnp.where(closed, root_bound, limit)),
            finished_by=by,
            given_up=(found.count > LONGEST) | ~jnp.isfinite(state.value),
        )
        return with_cut(state, cut_of(root, low, high))

    def with_cut(state: _State, cut) -> _State:
        """Bounds of everything on the list are raised to those of a cut."""
        value, at, gradient = cut
        sound = jnp.isfinite(value) & jnp.isfinite(gradient).all()
        curved_at = at @ tables.root

        def more(carry):
            begin, bounds = carry
            points = _decode(jax.lax.dynamic_slice(state.codes, (begin,), (CUT_BLOCK,)), len(columns))
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
        going = (state.bounds[best] < cutoff(state.value)) & ~state.given_up
        return state._replace(
            point=jnp.where(going, _decode(state.codes[best], len(columns)), state.point),
            expected=state.bounds[best],
            bounds=state.bounds.at[best].set(jnp.where(going, jnp.inf, state.bounds[best])),
            open=going & (state.nodes <= MOST_SOLVED),
            given_up=state.given_up | (going & (state.nodes > MOST_SOLVED)),
        )

    rounded = root.warm.x.at[columns].set(jnp.round(root.warm.x[columns]))
    state = _State(
        point=first,
        expected=jnp.asarray(-jnp.inf),
        codes=jnp.zeros(LONGEST, dtype=int),
        bounds=jnp.full(LONGEST, jnp.inf),
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
    closed = ~state.given_up & (state.value - bound <= gap * reference(state.value))
    return Decision(
        closed, state.x, state.value, bound, state.finished_by, jnp.maximum(state.nodes - 1, 1), state.steps
    )


def _limits(order: _Order, instance: QpInstance) -> _Rows:
    return _Rows(
        low=jnp.round(instance.row_low[order.position]),
        high=jnp.round(instance.row_high[order.position]),
        coupled=jnp.isfinite(instance.row_high[order.pair]) & (order.pair >= 0),
    )


def _fits(order: _Order, limits: _Rows, points: Float[Array, "point integer"]) -> Bool[Array, " point"]:
    """Whether whole moves satisfy the hard rows."""
    position, before = points @ order.reach.T, points @ order.previous.T
    good = (position >= limits.low) & (position <= limits.high)
    return jnp.all(good & (~limits.coupled | (jnp.abs(points - before) <= 1.0)), axis=1)


def _envelope(order: _Order, tables: Tables, result: Solved, predictions: int):
    """Prices of the envelope, ``"level integer"``."""
    return result.warm.row_price[predictions:].reshape(tables.knot.shape)[:, order.order]


def _lower_model(order: _Order, tables: Tables, root: Solved, predictions: int, low, high) -> _Lower:
    """See `search.Search.lower_model`."""
    center, slope = root.warm.x[order.columns], -root.warm.box_price[order.columns]
    least = jnp.minimum(slope * (low - center), slope * (high - center))
    excess = slope[:, None] * (STEPS - center[:, None]) - least[:, None]
    price, knot = _envelope(order, tables, root, predictions)[..., None], tables.knot[..., None]
    own = tables.slope[..., None] * jnp.maximum(jnp.abs(STEPS) - knot, 0.0)
    excess += jnp.sum(own - price * STEPS + knot * jnp.abs(price), axis=0)
    allowed = (low[:, None] <= STEPS) & (high[:, None] >= STEPS)
    return _Lower(root.bound, center, jnp.where(allowed, jnp.maximum(excess, 0.0), jnp.inf))


class _Listed(NamedTuple):
    """Whole moves with a bound below a cutoff; `count` may be more than the arrays hold, which then hold too few."""

    codes: Array
    bounds: Array
    count: Array


def _encode(points: Float[Array, "*point integer"]) -> Int[Array, "*point"]:
    shifts = 2 * np.arange(points.shape[-1])
    return jnp.sum((points.astype(int) & 3) << shifts, axis=-1)


def _decode(codes: Int[Array, "*point"], moves: int) -> Float[Array, "*point integer"]:
    digits = (codes[..., None] >> (2 * np.arange(moves))) & 3
    return jnp.where(digits == 3, -1, digits).astype(float)


def _grid_below(order: _Order, tables: Tables, limits: _Rows, model: _Lower, sizes, cutoff) -> _Listed:
    """All combinations of a few free moves."""
    left = jnp.isfinite(model.excess)
    free = sizes > 1
    rank = jnp.clip(jnp.cumsum(free) - 1, 0, GRID_FREE)
    powers = jnp.asarray(3 ** np.arange(GRID_FREE + 1))
    digit = (np.arange(3**GRID_FREE)[:, None] // powers[rank]) % 3
    # a move that is not free has one value, which is the first of those that are left
    only = jnp.argmax(left, axis=1)
    digit = jnp.where(free, digit, only)
    points = jnp.asarray(STEPS)[digit]
    own = jnp.sum(jnp.select([digit == k for k in range(3)], list(model.excess.T)), axis=1)
    away = (points - model.center) @ tables.leading.T
    bounds = model.value + own + 0.5 * jnp.sum(away**2, axis=1)
    used = np.arange(3**GRID_FREE) < powers[jnp.minimum(jnp.sum(free), GRID_FREE)]
    bounds = jnp.where(used & _fits(order, limits, points) & (bounds < cutoff), bounds, jnp.inf)
    rest = LONGEST - len(points)
    return _Listed(
        jnp.pad(_encode(points), (0, rest)),
        jnp.pad(bounds, (0, rest), constant_values=np.inf),
        jnp.asarray(len(points)),
    )


def _list_below(order: _Order, tables: Tables, limits: _Rows, model: _Lower, cutoff) -> _Listed:
    """Breadth-first search, move by move; `BLOCK` partial assignments at a time get their next move."""
    moves, room = len(order.columns), LONGEST + 3 * BLOCK
    reach, previous, leading = (jnp.asarray(v) for v in (order.reach, order.previous, tables.leading))

    def assign(carry):
        i, codes, bounds, count = carry
        now, then = i % 2, (i + 1) % 2
        row = leading[i]
        shift = row @ model.center
        pick = jnp.stack([row, reach[i], previous[i]], axis=1)  # of the moves before, this one still zero
        step, place = row[i] * STEPS - shift, reach[i, i] * STEPS

        def extend(carry):
            begin, codes, bounds, found = carry
            parents = jax.lax.dynamic_slice(codes, (now, begin), (1, BLOCK))[0]
            before = jax.lax.dynamic_slice(bounds, (now, begin), (1, BLOCK))[0]
            there = begin + np.arange(BLOCK) < count
            term, position, last = (_decode(parents, moves) @ pick).T[:, :, None]
            total = before[:, None] + 0.5 * (term + step) ** 2 + model.excess[i]
            reached = position + place
            good = (reached >= limits.low[i]) & (reached <= limits.high[i]) & there[:, None]
            good &= ~limits.coupled[i] | (jnp.abs(STEPS - last) <= 1.0)
            alive = (good & (total < cutoff)).reshape(-1)
            ranks = jnp.cumsum(alive)
            # the k-th that is alive comes k-th
            source = jnp.searchsorted(ranks, np.arange(1, 3 * BLOCK + 1), method="compare_all")
            source = jnp.minimum(source, 3 * BLOCK - 1)
            children = parents[:, None] | (jnp.asarray([0, 1, 3]) << (2 * i))
            codes = jax.lax.dynamic_update_slice(codes, children.reshape(-1)[source][None], (then, found))
            bounds = jax.lax.dynamic_update_slice(bounds, total.reshape(-1)[source][None], (then, found))
            return begin + BLOCK, codes, bounds, jnp.minimum(found + ranks[-1], LONGEST + 1)

        _, codes, bounds, found = jax.lax.while_loop(
            lambda carry: (carry[0] < count) & (carry[3] <= LONGEST), extend, (0, codes, bounds, 0)
        )
        return i + 1, codes, bounds, jnp.asarray(found)

    codes = jnp.zeros((2, room), dtype=int)
    bounds = jnp.full((2, room), jnp.inf).at[0, 0].set(model.value)
    _, codes, bounds, count = jax.lax.while_loop(
        lambda carry: (carry[0] < moves) & (carry[3] <= LONGEST), assign, (0, codes, bounds, jnp.asarray(1))
    )
    end = moves % 2
    there = np.arange(LONGEST) < count
    return _Listed(codes[end, :LONGEST], jnp.where(there, bounds[end, :LONGEST], jnp.inf), count)
