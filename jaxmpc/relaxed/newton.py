"""A relaxed problem solved exactly: semismooth Newton on its augmented Lagrangian.

With the prices of a neighbouring problem (the previous sample, the parent node) most rows are already known to be inside,
outside or at the edge of their deadzone, and most limits to be active or not. Every row becomes a proximal
term with its price (Hermans, Themelis and Patrinos 2022, QPALM), whose gradient is piecewise linear, so that a Newton step
is exact as soon as the classification is right. From a start with prices that takes one to three steps. Without
any, the terms are soft at first and stiffer with every problem solved, which finds the classification in about four. Where
kinks lie so close that steps get nowhere, they are damped and the terms soft again.
CV limits are rows like others, whose prices per CV and side spend no more than eps costs: eps itself, which the
augmented Lagrangian is least in, follows from these prices (a projection onto the simplex; Michelot 1986).
What is returned is judged by its own duality gap.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmpc.programs.lanes import one_by_one
from jaxmpc.relaxed.problem import (
    RIDGE,
    TINY,
    Prepared,
    Prices,
    QpSolution,
    Slopes,
    conclude,
    solve_positive,
    total,
)

STEPS = 150  # Newton steps after which a lane starts again from nothing, by the next row of `ATTEMPTS`
# curvature of a proximal term against the largest of the Hessian: without prices, in the end, and the least there is
SOFT, STIFF, SOFTEST = 1.0, 1e4, 0.1
# the first and the last of these curvatures, and that of CV limits per price of eps: where one lets steps go in circles,
# another may not
ATTEMPTS = np.array([(SOFT, STIFF, 0.3), (100.0, 1e5, 100.0), (10.0, 1e3, 0.3), (1000.0, 1e6, 100.0)])
MOST_STEPS = STEPS * len(ATTEMPTS)  # Newton steps of a lane
STIFFEN = 10.0  # what it grows by when the problem with the present prices is solved, and falls by after a short step
SHORT, SHORTER = (
    0.03,
    0.003,
)  # step length from which on the next step is damped: from stiff terms, and from softer ones
DAMPING, MOST_DAMPING, DAMP = 1e-4, 10.0, 10.0  # on the diagonal after short steps, and what that changes by
SEARCHES = 12  # trials of the line search
FLAT = 0.3  # share of its slope at the start that the merit may have where a line search ends
UPHILL = 1e-3  # the same for a merit that may be above that at the start
INEXACT = (
    0.1  # of the root of the change of the prices, squared: a gradient below it is good enough to take them
)
NOTHING = 0.01  # gradient without moves, and moves, below which there is next to nothing to gain
SETTLED, EXACT = 1e-7, 1e-12  # share of the gradient without moves left when prices are taken, and at the end
OPEN = 0.1  # share of the tolerated gap that the gradient may leave at the end
# 1e-10 ended a step of the thesis run too early
ROUNDED, STALLED = 1e-11, 0.3  # share that rounding may be, and what a step then leaves of what there was
# at the end, the last change of the prices, squared, and what it leaves hard rows violated by
UNPAID, OUTSIDE = 1e-14, 1e-9
OWED, KEPT = (
    1e-13,
    0.9,
)  # duality gap that a change of the prices is worth at the end, unless a step leaves so much of it


class WarmStart(eqx.Module):
    """Moves and prices of a neighbouring problem, in the scaled units of `CondensedQp`.

    Attributes:
        x: moves.
        row_price: prices of the deadzones.
        envelope_price: prices of the envelope.
        position_price: prices of the chords of squared positions; empty where there are none.
        limit_price: prices of the CV limits, upper positive; empty where there are none.
        box_price: prices of the limits of x, upper positive.
        hard_price: prices of the hard rows, upper positive.
    """

    x: Float[Array, " n"]
    row_price: Float[Array, " prediction"]
    envelope_price: Float[Array, "level n"]
    position_price: Float[Array, " position"]
    limit_price: Float[Array, " limit"]
    box_price: Float[Array, " n"]
    hard_price: Float[Array, " hard"]


def warm_start_of(solution: QpSolution) -> WarmStart:
    """Start from a solved problem."""
    return WarmStart(
        x=solution.x,
        row_price=solution.row_price,
        envelope_price=solution.envelope_price,
        position_price=solution.position_price,
        limit_price=solution.limit_price,
        box_price=solution.upper_price - solution.lower_price,
        hard_price=solution.row_high_price - solution.row_low_price,
    )


class _Families(NamedTuple):
    """Values per deadzone, level of the envelope, chord, CV limit (upper positive), limit of x and hard row."""

    row: Array
    envelope: Array
    position: Array
    limit: Array
    box: Array
    hard: Array


class _Point(NamedTuple):
    """Moves, and what follows from them: t and the hard rows."""

    x: Array
    t: Array
    w: Array


class _State(NamedTuple):
    point: _Point
    prices: _Families
    stiffness: Array
    ridge: Array
    steps: Array
    done: Array
    left: Array
    owed: Array


class _Proximal(NamedTuple):
    """The augmented Lagrangian of one lane: new prices of all families, and their slopes.

    A deadzone row with z = sigma t + price has the new price r e + (1 - r) clip(e, -s, s), where e is what z exceeds
    sigma c by, and r = 2 S / (2 S + sigma).
    """

    problem: Prepared
    sigma: _Families
    share: Array

    @classmethod
    def of(cls, problem: Prepared, stiffness, steeper) -> _Proximal:
        """With so much curvature per term, and for CV limits this much more per price of eps."""
        p = problem
        row = stiffness * p.qp.row_unit
        of_one = stiffness / jnp.maximum(p.qp.rows.size, TINY)
        hard = p.qp.rows.spread(of_one, p.row_low.shape[0] // of_one.shape[-1])
        limit = p.limit_high  # none
        if p.qp.has_limits:
            # a limit that costs much has far to go with its price
            reach = jnp.where(p.qp.reach > 0.0, p.qp.reach, 1.0)
            urgent = steeper * stiffness * p.slack_price * reach
            urgent = jnp.clip(urgent, stiffness, jnp.maximum(stiffness, STIFF))
            # the same along the horizon, so that limits that are active side by side are summed at once
            limit = jnp.repeat(urgent / reach**2, p.limit_high.shape[0] // reach.shape[0])
        sigma = _Families(row, stiffness, hard[: p.position.shape[0]], limit, stiffness, hard)
        return cls(p, sigma, p.curvature / (p.curvature + row))

    def prices(self, point: _Point, old: _Families) -> _Families:
        """New prices at a point."""
        p, sigma = self.problem, self.sigma
        excess = self._excess(point, old)
        own = self._beyond(point, old)
        return _Families(
            row=self.share * excess + (1.0 - self.share) * jnp.clip(excess, -p.steepness, p.steepness),
            envelope=jnp.clip(own, -p.steep, p.steep),
            position=self._chords(point, old)[0] if chorded(p) else old.position,
            limit=self._limits(point, old) if p.qp.has_limits else old.limit,
            box=_away(sigma.box, point.x, old.box, p.lower, p.upper),
            hard=_away(sigma.hard, point.w, old.hard, p.row_low, p.row_high),
        )

    def _chords(self, point: _Point, old: _Families) -> tuple[Float[Array, " hard"], Bool[Array, " hard"]]:
        """Prices of the chords of D w^2, and whether a position is held at a whole number.

        With z = sigma w + price it is held at k where z is within D of k (sigma + 2 D); between k and k + 1 the price is
        the slope D (2 k + 1) of the chord.
        """
        weight, sigma = self.problem.position, self.sigma.position
        z = sigma * point.w + old.position
        k = jnp.floor((z + weight) / (sigma + 2.0 * weight))
        at = z - k * (sigma + 2.0 * weight) <= weight
        return jnp.where(at, z - sigma * k, weight * (2.0 * k + 1.0)), at & (weight > 0.0)

    def _limits(self, point: _Point, old: _Families) -> Float[Array, " limit"]:
        """Prices of the CV limits: what sigma t + price exceeds sigma (limit + eps) by, with the best eps."""
        p = self.problem
        beyond = p.by_cv(self._outside(point, old))
        ones = np.ones(beyond.shape[1])

        def project():
            both = jnp.maximum(jnp.stack([beyond, -beyond]), 0.0)

            # a level per side and CV, sigma eps, above which they add up to the price of eps
            def rise(levels):
                _, level = levels
                above = both > level[..., None]
                sum_, number = jnp.where(above, both, 0.0) @ ones, above.astype(level.dtype) @ ones
                return level, jnp.maximum(level, (sum_ - p.slack_price) / jnp.maximum(number, 1.0))

            start = jnp.zeros((2, len(p.slack_price)))
            _, level = jax.lax.while_loop(
                lambda levels: jnp.any(levels[1] > levels[0]), rise, (start - 1.0, start)
            )
            high, low = jnp.maximum(both - level[..., None], 0.0)
            return high - low

        within = jnp.all(jnp.abs(beyond) @ ones <= p.slack_price)
        return jax.lax.cond(within, lambda: beyond, project).reshape(-1)

    def slopes(self, point: _Point, old: _Families, new: _Families) -> Slopes:
        """Derivatives of the new prices."""
        p, sigma = self.problem, self.sigma
        excess = jnp.abs(self._excess(point, old))
        at_edge = (excess > 0.0) & (excess <= p.steepness)
        own = jnp.abs(self._beyond(point, old))
        bend = jnp.sum(jnp.where((own > 0.0) & (own <= p.steep), sigma.envelope, 0.0), axis=0)
        active = lambda prices, curvature: jnp.where(prices != 0.0, curvature, 0.0)  # noqa: E731
        hard = active(new.hard, sigma.hard)
        if chorded(p):
            hard += jnp.where(self._chords(point, old)[1], sigma.position, 0.0)
        return Slopes(
            level=jnp.where(excess > 0.0, sigma.row * self.share, 0.0),
            sharp=jnp.where(at_edge, sigma.row * (1.0 - self.share), 0.0),
            limit=active(new.limit, sigma.limit),
            beyond=self._outside(point, old) if p.qp.has_limits else new.limit,
            move=active(new.box, sigma.box) + bend,
            hard=hard,
        )

    def _excess(self, point: _Point, old: _Families):
        return _away(self.sigma.row, point.t, old.row, -self.problem.qp.deadzone, self.problem.qp.deadzone)

    def _outside(self, point: _Point, old: _Families):
        return _away(self.sigma.limit, point.t, old.limit, self.problem.limit_low, self.problem.limit_high)

    def _beyond(self, point: _Point, old: _Families):
        return _away(self.sigma.envelope, point.x, old.envelope, -self.problem.qp.knot, self.problem.qp.knot)

    def gradient(self, x, prices: _Families) -> Float[Array, " n"]:
        """Gradient of the augmented Lagrangian, given the new prices at x."""
        p = self.problem
        force = p.hessian @ x + p.linear + p.pull(self.net(prices))
        force += prices.box + jnp.sum(prices.envelope, axis=0) + p.qp.rows.pull(self.pushed(prices))
        return p.keep * force

    def pushed(self, prices: _Families) -> Float[Array, " hard"]:
        """Prices of the hard rows."""
        return prices.hard + prices.position if chorded(self.problem) else prices.hard

    def net(self, prices: _Families) -> Float[Array, " prediction"]:
        """Prices of the predictions."""
        return prices.row + prices.limit if self.problem.qp.has_limits else prices.row


def chorded(problem: Prepared) -> bool:
    """Whether squared positions are replaced by their chords."""
    return problem.qp.position_weight is not None


def _away(sigma, value, price, low, high):
    """New price of limits: what sigma value + price exceeds them by."""
    z = sigma * value + price
    return z - jnp.clip(z, sigma * low, sigma * high)


def refine(problem: Prepared, start: WarmStart, most: Array | float = np.inf) -> QpSolution:
    """Solve one lane from a start.

    Args:
        problem: the lane.
        start: where to begin.
        most: Newton steps after which moves and prices are judged as they are.

    Returns:
        The solution, judged by `relaxed.problem.conclude`.
    """
    x, found, steps = _solved(problem, *_begin(problem, start), jnp.asarray(most, dtype=float))
    x = jnp.clip(x, problem.lower, problem.upper)
    prices = jax.tree.map(lambda prices: problem.unit * prices, found)
    return conclude(problem, x, prices, steps)


def _begin(p: Prepared, start: WarmStart) -> tuple[Float[Array, " n"], _Families]:
    """Moves and prices of a lane that starts from a neighbouring problem."""
    prices = _Families(
        row=jnp.where(p.curvature + p.steepness > 0.0, start.row_price / p.unit, 0.0),
        envelope=jnp.where(p.steep > 0.0, start.envelope_price / p.unit, 0.0),
        position=start.position_price / p.unit,
        limit=start.limit_price / p.unit,
        box=p.keep * start.box_price / p.unit,
        hard=jnp.where(p.takes_part, start.hard_price / p.unit, 0.0),
    )
    return jnp.where(p.free, jnp.clip(start.x, p.lower, p.upper), 0.5 * (p.lower + p.upper)), prices


@one_by_one
def _solved(p: Prepared, x: Float[Array, " n"], prices: _Families, most: Float[Array, ""]):
    """``(x, prices, steps)`` of a lane when it is solved, or after so many steps, from moves and prices."""
    largest = jnp.max(jnp.abs(p.linear))

    def moved(point: _Point, direction: _Point, alpha) -> _Point:
        return jax.tree.map(lambda v, d: v + alpha * d, point, direction)

    def step(state: _State) -> _State:
        _, stiffest, steeper = jnp.asarray(ATTEMPTS)[state.steps // STEPS]
        proximal = _Proximal.of(p, state.stiffness, steeper)
        point = state.point
        prices = proximal.prices(point, state.prices)
        gradient = proximal.gradient(point.x, prices)
        matrix = p.proximal_matrix(proximal.slopes(point, state.prices, prices), state.ridge)
        way = -solve_positive(matrix, gradient)
        dx = p.keep * way
        direction = _Point(dx, p.respond(dx), p.qp.rows.of(dx))
        bend, slope = dx @ (p.hessian @ dx), (p.hessian @ point.x + p.linear) @ dx

        def along(alpha):  # derivative of the merit along the direction, increasing in alpha; and the prices
            new = proximal.prices(moved(point, direction, alpha), state.prices)
            change = (
                slope
                + alpha * bend
                + total(proximal.net(new) * direction.t)
                + proximal.pushed(new) @ direction.w
            )
            return change + (new.box + jnp.sum(new.envelope, axis=0)) @ dx, new

        alpha, prices = _search(along, gradient @ way, prices)
        point = moved(point, direction, alpha)
        force = proximal.gradient(point.x, prices)
        left = jnp.max(jnp.abs(force))
        # where there is next to nothing to gain, the gap has to be small against a small share of the unit
        at_play = NOTHING + largest + jnp.max(jnp.abs(point.x))
        exact = (left < EXACT * at_play) & (p.uncovered(point.x, force) < OPEN * p.tolerated)
        gained = jax.tree.map(lambda new, old: new - old, prices, state.prices)
        moving = _flat(jax.tree.map(jnp.divide, gained, proximal.sigma))
        change, owed = total(moving * _flat(gained)), total(jnp.abs(moving * _flat(prices)))
        settled = (left < SETTLED * (1.0 + largest)) | (left < INEXACT * jnp.sqrt(change))
        outside = jnp.max(jnp.abs(gained.hard) / proximal.sigma.hard, initial=0.0)
        # a kink close by stops a step that has hardly any curvature before it: shorter ones get on
        short = alpha < jnp.where(state.stiffness < STIFF, SHORTER, SHORT)
        stiffer = jnp.minimum(STIFFEN * state.stiffness, stiffest)
        softer = jnp.maximum(state.stiffness / STIFFEN, SOFTEST)
        damped = jnp.clip(DAMP * state.ridge, DAMPING, MOST_DAMPING)
        good = jnp.all(jnp.isfinite(point.x))
        after = _State(
            point=point,
            prices=jax.tree.map(lambda new, old: jnp.where(settled, new, old), prices, state.prices),
            stiffness=jnp.where(settled, stiffer, jnp.where(short, softer, state.stiffness)),
            ridge=jnp.where(short, damped, jnp.maximum(state.ridge / DAMP, RIDGE)),
            steps=state.steps + 1,
            # rounding may keep more of the gradient than asked for: then one step leaves as much as the one before
            done=(exact | (left < ROUNDED * (1.0 + largest)) & (left > STALLED * state.left))
            & (change < UNPAID)
            & ((owed < OWED) | (owed > KEPT * state.owed))
            & (outside < OUTSIDE),
            left=left,
            owed=owed,
        )
        # a matrix that rounding left indefinite is tried again with more on its diagonal
        again = state._replace(ridge=1e2 * state.ridge, steps=state.steps + 1)
        after = jax.tree.map(lambda new, old: jnp.where(good, new, old), after, again)
        anew = (after.steps % STEPS == 0) & unfinished(after)
        return jax.lax.cond(anew, lambda: fresh(after.steps), lambda: after)

    def fresh(steps) -> _State:
        middle = jnp.where(p.free, jnp.clip(0.0, p.lower, p.upper), x)
        nothing = _at(p, middle, jax.tree.map(jnp.zeros_like, prices))
        return nothing._replace(steps=steps, stiffness=jnp.asarray(ATTEMPTS)[steps // STEPS, 0])

    def unfinished(state: _State):
        return ~state.done & (state.steps < jnp.minimum(most, MOST_STEPS))

    last = jax.lax.while_loop(unfinished, step, _at(p, x, prices))
    found = last.prices
    return (
        last.point.x,
        Prices(found.row, found.envelope, found.position, found.limit, found.hard),
        last.steps,
    )


def _flat(families: _Families) -> Array:
    """All of them as one vector."""
    return jnp.concatenate([jnp.ravel(v) for v in families])


def _at(p: Prepared, x: Float[Array, " n"], prices: _Families) -> _State:
    """Before the first step, from these moves and prices."""
    priced = jnp.any(_flat(prices) != 0.0)
    return _State(
        point=_Point(x, p.respond(x) + p.instance.offset, p.qp.rows.of(x)),
        prices=prices,
        stiffness=jnp.where(priced, STIFF, SOFT),
        ridge=jnp.asarray(RIDGE),
        steps=jnp.zeros((), dtype=jnp.int32),
        done=jnp.asarray(False),
        left=jnp.asarray(jnp.inf),
        owed=jnp.asarray(jnp.inf),
    )


def _search(along, slope, nothing: _Families) -> tuple[Array, _Families]:
    """Step length where the merit is nearly flat: 1, or what the secant method finds between 0 and 1; and the prices there.

    The loop tries 1 as well, so that a program holds the prices along a direction once.

    Args:
        along: the slope of the merit at a step length, and the prices there.
        slope: at the start.
        nothing: prices of any value.
    """

    # one vector holds the bracket, so that a batch freezes its finished lanes with one operation
    def closer(carry):
        low, high, at_low, at_high, _, _, tried = carry[0]
        first = tried < 0.0
        alpha = low - at_low * (high - low) / (at_high - at_low)
        alpha = jnp.where((alpha > low) & (alpha < high), alpha, 0.5 * (low + high))
        alpha = jnp.where(first, 1.0, alpha)
        value, prices = along(alpha)
        # Illinois rule: the end that stays gets half its slope, so that both ends move
        left = jnp.stack([alpha, high, value, 0.5 * at_high, alpha, value, tried + 1.0])
        kept = jnp.where(first, at_low, 0.5 * at_low)
        right = jnp.stack([low, alpha, kept, value, alpha, value, tried + 1.0])
        return jnp.where(first | (value > 0.0), right, left), prices

    def steep(carry):
        low, _, at_low, _, alpha, value, tried = carry[0]
        size = jnp.abs(slope)
        # a full step may stop short of the minimum
        far = (tried > 0.0) & (value < -FLAT * size)
        # beyond a kink the merit may have risen: up to `low` its slope is at most `at_low`, from there on `value`
        downhill = low * at_low + (alpha - low) * value < 0.0
        good = ~far & ((value <= UPHILL * size) | (downhill & (value <= FLAT * size)))
        return (tried < 0.0) | ~good & (tried <= SEARCHES)

    zero, one = jnp.zeros(()), jnp.ones(())
    start = jnp.stack([zero, one, slope, zero, one, zero, -one])
    bracket, prices = jax.lax.while_loop(steep, closer, (start, nothing))
    return bracket[4], prices
