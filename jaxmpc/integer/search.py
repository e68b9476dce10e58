"""The whole moves of one step as one compiled program, from the relaxation on.

One loop carries what to solve next: first the problem itself, then its rounded moves for an incumbent, then the best of a
list. The prices of the root leave a list of whole moves that may be better than the incumbent (`lower_bound`,
`listing`), and the best of the list are solved one after the other, each with a quadratic cut that bounds all others
(`cuts`), until none is left. What does not fit (moves of more than one step, rounded moves that break a hard row, longer
lists) is left to `integer.solve`, which goes on from the relaxation; so are whole moves that must keep more than limits and
hard rows (`actuators`).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmpc.integer import listing
from jaxmpc.integer.listing import STEPS, Listed, LowerBound, decode, encode, fits
from jaxmpc.integer.tables import Tables
from jaxmpc.problem.condense import CondensedQp
from jaxmpc.problem.instance import QpInstance
from jaxmpc.programs.lanes import one_by_one
from jaxmpc.relaxed.gap import closes, cutoff
from jaxmpc.relaxed.newton import WarmStart, warm_start_of
from jaxmpc.relaxed.problem import evaluate
from jaxmpc.relaxed.solve import solve_relaxed
from jaxmpc.status import OPTIMAL, finisher_code

MOST_SOLVED = 64  # of a list
CUT_BLOCK = 256  # entries of a list that are cut together
LISTING = 10.0  # blocks of a list that are extended, or cut, while one Newton step is taken
ROW_ROUNDING = 1e-6  # slack of the hard rows of rounded moves, which are whole numbers themselves


class Relaxed(NamedTuple):
    """What a search reads of one relaxed problem, or of a batch.

    Attributes:
        warm: its moves and prices.
        objective, bound, status: as in `QpSolution`.
        snapped: objective with the integer moves rounded where they are and the others kept; infinite if that breaks
            a hard row.
        steps: Newton steps.
    """

    warm: WarmStart
    objective: Array
    bound: Array
    snapped: Array
    status: Array
    steps: Array


def relax(
    qp: CondensedQp,
    instance: QpInstance,
    lower,
    upper,
    start: WarmStart,
    integers: bool = True,
    most: Array | float = jnp.inf,
) -> Relaxed:
    """Relax one problem within limits of the moves, and evaluate its moves with the integer ones, if any, rounded."""
    s = solve_relaxed(qp, instance, lower, upper, start, most)
    if not integers:
        return Relaxed(warm_start_of(s), s.objective, s.bound, s.objective, s.status, s.iterations)
    snapped = jnp.where(qp.whole, jnp.round(s.x), s.x)
    w = qp.rows.of(snapped)
    fit = jnp.all((w <= instance.row_high + ROW_ROUNDING) & (w >= instance.row_low - ROW_ROUNDING))
    fit &= jnp.all((snapped <= instance.upper + ROW_ROUNDING) & (snapped >= instance.lower - ROW_ROUNDING))
    value = jnp.where(fit, evaluate(qp, instance, snapped), jnp.inf)
    return Relaxed(warm_start_of(s), s.objective, s.bound, value, s.status, s.iterations)


class Decision(NamedTuple):
    """What a search found.

    Attributes:
        closed: whether it is proven.
        x: the moves, scaled; the best that were found where it is not.
        value, bound: objective, and what no whole moves are below; true where nothing is closed, too.
        finished_by: code of `status.FINISHERS`.
        nodes: relaxations solved with whole moves, 1 where the root was enough.
        steps: Newton steps.
        root: the relaxation.
    """

    closed: Bool[Array, ""]
    x: Float[Array, " n"]
    value: Float[Array, ""]
    bound: Float[Array, ""]
    finished_by: Int[Array, ""]
    nodes: Int[Array, ""]
    steps: Int[Array, ""]
    root: Relaxed


class _State(NamedTuple):
    """Of a search; `point` and the limits are what is solved next, `expected` its bound so far."""

    lower: Array
    upper: Array
    point: Array
    expected: Array
    codes: Array
    bounds: Array
    count: Array
    value: Array
    x: Array
    left_out: Array
    complete: Array
    work: Array
    solved: Array
    steps: Array
    finished_by: Array
    open: Array
    given_up: Array
    root: Relaxed


def decide(
    qp: CondensedQp,
    tables: Tables,
    instance: QpInstance,
    start: WarmStart,
    gap: Float[Array, ""],
    most: Float[Array, ""] | float = jnp.inf,
) -> Decision:
    """Relax and search one step (use `jax.vmap` for a batch).

    Args:
        qp: constant part.
        tables: of the same scenario.
        instance: the problem of this sample.
        start: where the relaxation begins.
        gap: relative gap at which a solve is optimal.
        most: Newton steps of all its relaxations, or as much other work, after which it gives up.
    """
    if tables.column.shape[0]:
        return _searched(qp, tables, instance, start, jnp.asarray(gap, float), jnp.asarray(most, float))
    root = relax(qp, instance, instance.lower, instance.upper, start, False, most)
    solved = root.status == OPTIMAL
    return Decision(
        closed=solved,
        x=root.warm.x,
        value=root.objective,
        bound=jnp.minimum(
            jnp.maximum(root.bound, 0.0), root.objective
        ),  # every term of (6.6) is non-negative
        finished_by=jnp.where(solved, finisher_code("relaxation"), 0),
        nodes=jnp.ones((), dtype=int),
        steps=root.steps.astype(int),
        root=root,
    )


@one_by_one
def _searched(
    qp: CondensedQp, tables: Tables, instance: QpInstance, start: WarmStart, gap: Array, most: Array
) -> Decision:
    """`decide` where there may be whole moves; lane by lane, so that the relaxations of none wait for those of others."""
    search = _Search(qp, tables, instance, gap, most)

    def visit(state: _State) -> _State:
        """Solve what is next, and choose what to solve after it."""
        left = jnp.maximum(search.most - state.work, 0.0)
        result = relax(qp, instance, state.lower, state.upper, state.root.warm, most=left)
        state = state._replace(
            solved=state.solved + 1, steps=state.steps + result.steps, work=state.work + result.steps
        )
        return jax.lax.cond(state.solved == 1, search.begun, search.after, state, result)

    state = jax.lax.while_loop(lambda state: state.open, visit, search.start(start))
    left_out = jnp.minimum(state.left_out, jnp.min(state.bounds))
    root_bound = jnp.maximum(state.root.bound, 0.0)
    left_out = jnp.where(state.complete, left_out, -jnp.inf)
    bound = jnp.minimum(jnp.maximum(left_out, root_bound), state.value)
    closed = ~state.given_up & closes(state.value, bound, tables.scale, search.gap)
    return Decision(
        closed=closed | search.none & ~state.given_up,
        x=state.x,
        value=state.value,
        bound=bound,
        finished_by=state.finished_by,
        nodes=jnp.maximum(state.solved - 1, 1),
        steps=state.steps,
        root=state.root,
    )


class _Search(NamedTuple):
    """The problem of one search."""

    qp: CondensedQp
    tables: Tables
    instance: QpInstance
    gap: Array
    most: Array

    @property
    def none(self) -> Array:
        """Whether there is nothing to search for: no integer moves."""
        return self.tables.count == 0

    @property
    def used(self) -> Array:
        """Integer moves that are no padding."""
        return jnp.arange(self.tables.column.shape[0]) < self.tables.count

    def of(self, values: Float[Array, "*rest n"], absent: float = 0.0):
        """The entries of the integer moves."""
        return jnp.where(self.used, values[..., self.tables.column], absent)

    def start(self, warm: WarmStart) -> _State:
        """Before the relaxation."""
        number, whole = jnp.zeros(()), jnp.zeros((), dtype=int)
        infinite, no = jnp.asarray(jnp.inf), jnp.asarray(False)
        root = Relaxed(warm, number, -infinite, infinite, whole, whole.astype(jnp.int32))
        return _State(
            lower=self.instance.lower,
            upper=self.instance.upper,
            point=jnp.zeros(self.tables.column.shape[0]),
            expected=-infinite,
            codes=jnp.zeros(listing.LONGEST, dtype=int),
            bounds=jnp.full(listing.LONGEST, jnp.inf),
            count=whole,
            value=infinite,
            x=jnp.zeros_like(self.instance.lower),
            left_out=infinite,
            complete=no,
            work=number,
            solved=whole,
            steps=whole,
            finished_by=whole,
            open=~no,
            given_up=no,
            root=root,
        )

    @property
    def limits(self) -> tuple[Array, Array]:
        """Limits of the integer moves."""
        return jnp.round(self.of(self.instance.lower)), jnp.round(self.of(self.instance.upper))

    def begun(self, state: _State, root: Relaxed) -> _State:
        """The relaxation is known: it may be whole already; if not, its rounded moves come next."""
        low, high = self.limits
        bound = jnp.maximum(root.bound, 0.0)  # every term of (6.6) is non-negative
        # the envelope of squared moves is exact up to as many steps as it has levels, and a bound beyond them
        levels = self.qp.steep.shape[0] or np.inf
        exact = jnp.all(~self.qp.whole | (jnp.abs(root.warm.x) < levels + 0.5))
        value = jnp.where(self.none, root.objective, jnp.where(exact, root.snapped, jnp.inf))
        found = jnp.isfinite(root.warm.x).all() & jnp.isfinite(root.bound)
        closed = jnp.where(
            self.none,
            root.status == OPTIMAL,
            closes(value, jnp.minimum(bound, value), self.tables.scale, self.gap),
        )
        if self.tables.complete is not None:  # what else there is to keep is known on the host only
            closed &= self.tables.complete | self.none
        first = jnp.clip(jnp.round(self.of(root.warm.x)), low, high)
        usable = found & self.tables.known & ~self.none
        usable &= jnp.all((low >= -1.0) & (high <= 1.0) & (low <= high))
        limits = listing.position_limits(self.tables, self.instance)
        usable &= fits(self.tables, limits, first[None])[0] & (state.work < self.most)
        state = state._replace(
            value=value,
            x=jnp.where(self.qp.whole, jnp.round(root.warm.x), root.warm.x),
            finished_by=jnp.where(closed, finisher_code("relaxation"), 0),
            left_out=jnp.where(closed, bound, jnp.inf),
            complete=closed,
            open=usable & ~closed,
            given_up=~closed & ~usable,
            root=root,
        )
        return self.next(state, first)

    def next(self, state: _State, point) -> _State:
        """With these whole moves to be solved next."""
        put = lambda values: values.at[self.tables.column].set(point, mode="drop")  # noqa: E731
        lower, upper = put(self.instance.lower), put(self.instance.upper)
        return state._replace(point=point, lower=lower, upper=upper)

    def after(self, state: _State, result: Relaxed) -> _State:
        """Whole moves are solved: an incumbent, a cut, and what to solve after them."""
        better = (result.snapped < state.value) & jnp.isfinite(result.warm.x).all()
        x = result.warm.x.at[self.tables.column].set(state.point, mode="drop")
        bound = jnp.maximum(result.bound, state.expected)
        state = state._replace(
            value=jnp.where(better, result.snapped, state.value),
            x=jnp.where(better, x, state.x),
            left_out=jnp.minimum(state.left_out, jnp.minimum(bound, result.snapped)),
        )
        state = jax.lax.cond(state.solved == 2, self.listed, lambda state: state, state)
        state = self.with_cut(state, self.cut_of(result, state.point, state.point))
        best = jnp.argmin(state.bounds)
        limit = cutoff(state.value, self.tables.scale, self.gap)
        going = (state.bounds[best] < limit) & ~state.given_up
        too_many = (state.solved > MOST_SOLVED) | (state.work >= self.most)
        going_on = going & ~too_many
        state = state._replace(
            expected=state.bounds[best],
            bounds=state.bounds.at[best].set(jnp.where(going_on, jnp.inf, state.bounds[best])),
            open=going_on,
            given_up=state.given_up | (going & too_many),
        )
        return self.next(state, jnp.where(going, decode(state.codes[best], len(state.point)), state.point))

    def lower_bound(self, root: Relaxed, low, high) -> LowerBound:
        """See `host_search.Search.lower_model`."""
        center, slope = self.of(root.warm.x), -self.of(root.warm.box_price)
        least = jnp.minimum(slope * (low - center), slope * (high - center))
        excess = slope[:, None] * (STEPS - center[:, None]) - least[:, None]
        price, knot = self.of(root.warm.envelope_price)[..., None], self.qp.knot[..., None]
        own = self.tables.slope[..., None] * jnp.maximum(jnp.abs(STEPS) - knot, 0.0)
        excess += jnp.sum(own - price * STEPS + knot * jnp.abs(price), axis=0)
        allowed = (low[:, None] <= STEPS) & (high[:, None] >= STEPS)
        return LowerBound(root.bound, center, jnp.where(allowed, jnp.maximum(excess, 0.0), jnp.inf))

    def cut_of(self, result: Relaxed, low, high):
        """See `cuts.cut_of`."""
        at, gradient = self.of(result.warm.x), -self.of(result.warm.box_price)
        value = result.bound - jnp.sum(jnp.minimum(gradient * (low - at), gradient * (high - at)))
        price = self.of(result.warm.envelope_price)
        value -= jnp.sum(price * at - self.qp.knot * jnp.abs(price))
        return value, at, gradient - jnp.sum(price, axis=0)

    def listed(self, state: _State) -> _State:
        """The first incumbent is known: what may be better?"""
        tables, root, (low, high) = self.tables, state.root, self.limits
        root_bound, limit = jnp.maximum(root.bound, 0.0), cutoff(state.value, tables.scale, self.gap)
        model = self.lower_bound(root, low, high)
        away = STEPS - model.center[:, None]
        curved = jnp.where(jnp.isfinite(tables.radius), 0.5 / tables.radius, 0.0)[:, None] * away**2
        alone = model.value + model.excess + curved
        excess = jnp.where(alone < limit, model.excess, jnp.inf)
        sizes = jnp.sum(jnp.isfinite(excess), axis=1)
        kept = LowerBound(model.value, model.center, excess)
        grid = jnp.sum(sizes > 1) <= listing.GRID_FREE
        closed, empty = root_bound >= limit, jnp.any(sizes == 0)
        limits = listing.position_limits(tables, self.instance)
        found = jax.lax.switch(
            jnp.where(closed | empty, 0, jnp.where(grid, 1, 2)),
            [
                Listed.empty,
                lambda: listing.grid_below(tables, limits, kept, sizes, limit),
                lambda: listing.list_below(tables, limits, kept, limit, LISTING * (self.most - state.work)),
            ],
        )
        fixed = empty | (jnp.max(sizes) == 1)
        by = jnp.where(
            closed,
            finisher_code("relaxation"),
            jnp.where(fixed, finisher_code("fixing"), finisher_code("enumeration")),
        )
        state = state._replace(
            codes=found.codes,
            bounds=jnp.where(found.codes == encode(state.point), jnp.inf, found.bounds),
            count=jnp.minimum(found.count, listing.LONGEST),
            left_out=jnp.minimum(state.left_out, jnp.where(closed, root_bound, limit)),
            complete=found.count <= listing.LONGEST,
            work=state.work + found.looked_at / LISTING,
            finished_by=by,
            given_up=(found.count > listing.LONGEST) | ~jnp.isfinite(state.value),
        )
        return self.with_cut(state, self.cut_of(root, low, high))

    def with_cut(self, state: _State, cut) -> _State:
        """Bounds of everything on the list are raised to those of a cut."""
        value, at, gradient = cut
        tables = self.tables
        sound = jnp.isfinite(value) & jnp.isfinite(gradient).all()
        curved_at = at @ tables.root

        def more(carry):
            begin, bounds = carry
            points = decode(jax.lax.dynamic_slice(state.codes, (begin,), (CUT_BLOCK,)), len(at))
            away = points @ tables.root - curved_at
            own = 0.5 * jnp.sum(away**2, axis=1) + points**2 @ tables.own_weight
            bound = value + (points - at) @ gradient + own
            old = jax.lax.dynamic_slice(bounds, (begin,), (CUT_BLOCK,))
            new = jnp.where(sound, jnp.maximum(old, bound), old)
            return begin + CUT_BLOCK, jax.lax.dynamic_update_slice(bounds, new, (begin,))

        _, bounds = jax.lax.while_loop(lambda carry: carry[0] < state.count, more, (0, state.bounds))
        return state._replace(bounds=bounds, work=state.work + state.count / (CUT_BLOCK * LISTING))
