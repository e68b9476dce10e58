"""A relaxed problem solved exactly: semismooth Newton on its augmented Lagrangian.

With the prices of a neighbouring problem (the previous sample, the parent node) most rows are already known to be inside,
outside or at the edge of their deadzone, and most limits to be active or not. Every row becomes a proximal
term with its price (Hermans, Themelis and Patrinos 2022, QPALM), whose gradient is piecewise linear, so that a Newton step
is exact as soon as the classification is right. From a start with prices that takes one to three steps. Without
any, the terms are soft at first and stiffer with every problem solved, which finds the classification in about four. Where
kinks lie so close that steps get nowhere, they are damped and the terms soft again.
CV limits are rows like others, with what is given up of them (eps) as further variables.
What is returned is judged by its own duality gap.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

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
# the first and the last of these curvatures: where one lets steps go in circles, another may not
ATTEMPTS = np.array([(SOFT, STIFF), (100.0, 1e5), (10.0, 1e3), (1000.0, 1e6)])
STIFFEN = 10.0  # what it grows by when the problem with the present prices is solved, and falls by after a short step
SHORT = 0.003  # step length from which on the next step is damped
DAMPING, MOST_DAMPING, DAMP = 1e-4, 10.0, 10.0  # on the diagonal after short steps, and what that changes by
STEEPER = 100.0  # stiffness of CV limits per price of eps, against that of other terms
SEARCHES = 12  # trials of the line search
FLAT = 0.3  # share of its slope at the start that the merit may have where a line search ends
UPHILL = 1e-3  # the same for a merit that may be above that at the start
NOTHING = 0.01  # gradient without moves, and moves, below which there is next to nothing to gain
SETTLED, EXACT = 1e-7, 1e-12  # share of the gradient without moves left when prices are taken, and at the end
# 1e-10 ended a step of the thesis run too early
ROUNDED, STALLED = 1e-11, 0.3  # share that rounding may be, and what a step then leaves of what there was
UNPAID, OUTSIDE = (
    1e-14,
    1e-9,
)  # last change of the prices, squared, and what it leaves hard rows violated by, at the end


class WarmStart(eqx.Module):
    """Moves and prices of a neighbouring problem, in the scaled units of `CondensedQp`.

    Attributes:
        x: moves.
        row_price: prices of the deadzones.
        envelope_price: prices of the envelope.
        limit_price: prices of the CV limits, upper positive; empty where there are none.
        box_price: prices of the limits of x, upper positive.
        hard_price: prices of the hard rows, upper positive.
    """

    x: Float[Array, " n"]
    row_price: Float[Array, " prediction"]
    envelope_price: Float[Array, "level n"]
    limit_price: Float[Array, " limit"]
    box_price: Float[Array, " n"]
    hard_price: Float[Array, " hard"]


def warm_start_of(solution: QpSolution) -> WarmStart:
    """Start from a solved problem."""
    return WarmStart(
        x=solution.x,
        row_price=solution.row_price,
        envelope_price=solution.envelope_price,
        limit_price=solution.limit_price,
        box_price=solution.upper_price - solution.lower_price,
        hard_price=solution.row_high_price - solution.row_low_price,
    )


class _Families(NamedTuple):
    """Values per deadzone, level of the envelope, CV limit (upper positive), eps, limit of x and hard row."""

    row: Array
    envelope: Array
    limit: Array
    slack: Array
    box: Array
    hard: Array


class _Point(NamedTuple):
    """Moves, eps, and what follows from the moves: t and the hard rows."""

    x: Array
    slack: Array
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


class _Proximal(NamedTuple):
    """The augmented Lagrangian of one lane: new prices of all families, and their slopes.

    A deadzone row with z = sigma t + price has the new price r e + (1 - r) clip(e, -s, s), where e is what z exceeds
    sigma c by, and r = 2 S / (2 S + sigma).
    """

    problem: Prepared
    sigma: _Families
    share: Array

    @classmethod
    def of(cls, problem: Prepared, stiffness) -> _Proximal:
        """With so much curvature per term."""
        p = problem
        row = stiffness * p.qp.row_unit
        of_one = stiffness / jnp.maximum(p.qp.rows.size, TINY)
        hard = p.qp.rows.spread(of_one, p.row_low.shape[0] // of_one.shape[0])
        # a limit that costs much has far to go with its price
        urgent = jnp.clip(STEEPER * stiffness * p.slack_price, stiffness, jnp.maximum(stiffness, STIFF))
        horizon = p.limit_high.shape[0] // p.slack_unit.shape[0]
        # the same along the horizon, so that limits that are active side by side are summed at once
        limit = (
            jnp.repeat(urgent[: p.slack_unit.shape[0]] / p.slack_unit**2, horizon)
            if p.qp.has_limits
            else urgent
        )
        sigma = _Families(row, stiffness, limit, urgent, stiffness, hard)
        return cls(p, sigma, p.curvature / (p.curvature + row))

    def prices(self, point: _Point, old: _Families, quiet: Bool[Array, ""]) -> _Families:
        """New prices at a point; those of CV limits are looked at only where these are not quiet."""
        p, sigma = self.problem, self.sigma
        excess = self._excess(point, old)
        own = self._beyond(point, old)

        def limits():
            high, low = p.given_up(point.slack)
            limit = _away(sigma.limit, point.t, old.limit, p.limit_low - low, p.limit_high + high)
            return limit, jnp.minimum(sigma.slack * point.slack + old.slack, p.slack_price)

        limit, slack = old.limit, old.slack  # none
        if p.qp.has_limits:
            limit, slack = jax.lax.cond(quiet, lambda: (limit, slack), limits)
        return _Families(
            row=self.share * excess + (1.0 - self.share) * jnp.clip(excess, -p.steepness, p.steepness),
            envelope=jnp.clip(own, -p.steep, p.steep),
            limit=limit,
            slack=slack,
            box=_away(sigma.box, point.x, old.box, p.lower, p.upper),
            hard=_away(sigma.hard, point.w, old.hard, p.row_low, p.row_high),
        )

    def slopes(self, point: _Point, old: _Families, new: _Families) -> Slopes:
        """Derivatives of the new prices."""
        p, sigma = self.problem, self.sigma
        excess = jnp.abs(self._excess(point, old))
        at_edge = (excess > 0.0) & (excess <= p.steepness)
        own = jnp.abs(self._beyond(point, old))
        bend = jnp.sum(jnp.where((own > 0.0) & (own <= p.steep), sigma.envelope, 0.0), axis=0)
        active = lambda prices, curvature: jnp.where(prices != 0.0, curvature, 0.0)  # noqa: E731
        return Slopes(
            level=jnp.where(excess > 0.0, sigma.row * self.share, 0.0),
            sharp=jnp.where(at_edge, sigma.row * (1.0 - self.share), 0.0),
            limit=active(new.limit, sigma.limit),
            upper=new.limit > 0.0,
            slack=jnp.where(new.slack < p.slack_price, sigma.slack, 0.0),
            move=active(new.box, sigma.box) + bend,
            hard=active(new.hard, sigma.hard),
        )

    def _excess(self, point: _Point, old: _Families):
        return _away(self.sigma.row, point.t, old.row, -self.problem.qp.deadzone, self.problem.qp.deadzone)

    def _beyond(self, point: _Point, old: _Families):
        return _away(self.sigma.envelope, point.x, old.envelope, -self.problem.qp.knot, self.problem.qp.knot)

    def quiet(self, point: _Point, old: _Families) -> Bool[Array, ""]:
        """Whether the CV limits have no prices and are not reached."""
        p = self.problem
        inside = jnp.all(
            (point.t[: len(p.limit_low)] >= p.limit_low) & (point.t[: len(p.limit_low)] <= p.limit_high)
        )
        return inside & ~(jnp.any(old.limit != 0.0) | jnp.any(point.slack != 0.0) | jnp.any(old.slack != 0.0))

    def gradient(self, x, prices: _Families, quiet: Bool[Array, ""]) -> Float[Array, " m"]:
        """Gradient of the augmented Lagrangian in moves and eps, given the new prices at x."""
        p = self.problem
        net = prices.row + prices.limit if p.qp.has_limits else prices.row
        force = p.hessian @ x + p.linear + p.pull(net) + prices.box + jnp.sum(prices.envelope, axis=0)
        force = p.keep * (force + p.qp.rows.pull(prices.hard))
        if not p.qp.has_limits:
            return force
        spent = jax.lax.cond(quiet, lambda: prices.slack, lambda: p.spent(prices.limit))
        return jnp.concatenate([force, prices.slack - jnp.tile(p.slack_unit, 2) * spent])


def _away(sigma, value, price, low, high):
    """New price of limits: what sigma value + price exceeds them by."""
    z = sigma * value + price
    return z - jnp.clip(z, sigma * low, sigma * high)


def refine(problem: Prepared, start: WarmStart) -> QpSolution:
    """Solve one lane from a start.

    Args:
        problem: the lane.
        start: where to begin.

    Returns:
        The solution, judged by `relaxed.problem.conclude`.
    """
    p, keep, unit, moves = problem, problem.keep, problem.unit, problem.lower.shape[0]
    largest = jnp.max(jnp.abs(p.linear))

    def moved(point: _Point, direction: _Point, alpha) -> _Point:
        return jax.tree.map(lambda v, d: v + alpha * d, point, direction)

    def step(state: _State) -> _State:
        proximal = _Proximal.of(p, state.stiffness)
        point = state.point
        quiet = proximal.quiet(point, state.prices)
        prices = proximal.prices(point, state.prices, quiet)
        gradient = proximal.gradient(point.x, prices, quiet)
        matrix = p.proximal_matrix(proximal.slopes(point, state.prices, prices), state.ridge)
        way = -solve_positive(matrix, gradient)
        dx, slack = keep * way[:moves], way[moves:]
        direction = _Point(dx, slack, p.respond(dx), p.qp.rows.of(dx))
        bend, slope = dx @ (p.hessian @ dx), (p.hessian @ point.x + p.linear) @ dx

        # limits that hold at both ends of a full step hold on the way
        silent = quiet & proximal.quiet(moved(point, direction, 1.0), state.prices)

        def of_limits(new: _Families):
            own = total(new.limit * direction.t) + new.slack @ direction.slack
            return own - (jnp.tile(p.slack_unit, 2) * direction.slack) @ p.spent(new.limit)

        def along(alpha):  # derivative of the merit along the direction, increasing in alpha
            new = proximal.prices(moved(point, direction, alpha), state.prices, silent)
            change = slope + alpha * bend + total(new.row * direction.t) + new.hard @ direction.w
            change += (new.box + jnp.sum(new.envelope, axis=0)) @ dx
            if p.qp.has_limits:
                change += jax.lax.cond(silent, lambda _: jnp.zeros(()), of_limits, new)
            return change

        alpha = _search(along, gradient @ way)
        point = moved(point, direction, alpha)
        prices = proximal.prices(point, state.prices, silent)
        left = jnp.max(jnp.abs(proximal.gradient(point.x, prices, silent)))
        # where there is next to nothing to gain, the gap has to be small against a small share of the unit
        at_play = NOTHING + largest + jnp.max(jnp.abs(point.x))
        settled, exact = left < SETTLED * (1.0 + largest), left < EXACT * at_play
        gained = jax.tree.map(lambda new, old: new - old, prices, state.prices)
        change = sum(jnp.sum(g**2 / sigma) for g, sigma in zip(gained, proximal.sigma, strict=True))
        outside = jnp.max(jnp.abs(gained.hard) / proximal.sigma.hard, initial=0.0)
        # a kink close by stops a step that has hardly any curvature before it: shorter ones get on
        short = alpha < SHORT
        attempt = state.steps // STEPS
        stiffer = jnp.minimum(STIFFEN * state.stiffness, jnp.asarray(ATTEMPTS)[attempt, 1])
        softer = jnp.maximum(state.stiffness / STIFFEN, SOFTEST)
        damped = jnp.clip(DAMP * state.ridge, DAMPING, MOST_DAMPING)
        good = jnp.all(jnp.isfinite(point.x)) & jnp.all(jnp.isfinite(point.slack))
        after = _State(
            point=point,
            prices=jax.tree.map(lambda new, old: jnp.where(settled, new, old), prices, state.prices),
            stiffness=jnp.where(settled, stiffer, jnp.where(short, softer, state.stiffness)),
            ridge=jnp.where(short, damped, jnp.maximum(state.ridge / DAMP, RIDGE)),
            steps=state.steps + 1,
            # rounding may keep more of the gradient than asked for: then one step leaves as much as the one before
            done=(exact | (left < ROUNDED * (1.0 + largest)) & (left > STALLED * state.left))
            & (change < UNPAID)
            & (outside < OUTSIDE),
            left=left,
        )
        # a matrix that rounding left indefinite is tried again with more on its diagonal
        again = state._replace(ridge=1e2 * state.ridge, steps=state.steps + 1)
        after = jax.tree.map(lambda new, old: jnp.where(good, new, old), after, again)
        anew = (after.steps % STEPS == 0) & ~after.done & (attempt + 1 < len(ATTEMPTS))
        softness = jnp.asarray(ATTEMPTS)[after.steps // STEPS, 0]
        fresh = nothing._replace(steps=after.steps, stiffness=softness)
        return jax.tree.map(lambda new, old: jnp.where(anew, new, old), fresh, after)

    def unfinished(state: _State):
        return ~state.done & (state.steps < STEPS * len(ATTEMPTS))

    nothing = _begin(p, jax.tree.map(jnp.zeros_like, start))
    state = jax.lax.while_loop(unfinished, step, _begin(p, start))
    x = jnp.clip(state.point.x, p.lower, p.upper)
    found = jax.tree.map(lambda prices: unit * prices, state.prices)
    prices = Prices(found.row, found.envelope, found.limit, found.hard)
    return conclude(p, x, prices, state.steps)


def _begin(p: Prepared, start: WarmStart) -> _State:
    """The first point and prices of a lane."""
    x = jnp.where(p.free, jnp.clip(start.x, p.lower, p.upper), 0.5 * (p.lower + p.upper))
    t = p.respond(x) + p.instance.offset
    limit = start.limit_price / p.unit
    slack = price = jnp.zeros(0)
    if p.qp.has_limits:
        sides = jnp.concatenate([p.by_cv(t - p.limit_high), p.by_cv(p.limit_low - t)])
        spent = p.spent(limit)
        # where nothing is known of the prices, giving up nothing takes fewer steps
        slack = jnp.where(spent > 0.0, jnp.maximum(sides.max(axis=1), 0.0) / jnp.tile(p.slack_unit, 2), 0.0)
        price = jnp.minimum(jnp.tile(p.slack_unit, 2) * spent, p.slack_price)
    prices = _Families(
        row=jnp.where(p.curvature + p.steepness > 0.0, start.row_price / p.unit, 0.0),
        envelope=jnp.where(p.steep > 0.0, start.envelope_price / p.unit, 0.0),
        limit=limit,
        slack=price,
        box=p.keep * start.box_price / p.unit,
        hard=jnp.where(p.takes_part, start.hard_price / p.unit, 0.0),
    )
    priced = jnp.any(jnp.concatenate([jnp.ravel(v) for v in prices]) != 0.0)
    return _State(
        point=_Point(x, slack, t, p.qp.rows.of(x)),
        prices=prices,
        stiffness=jnp.where(priced, STIFF, SOFT),
        ridge=jnp.asarray(RIDGE),
        steps=jnp.zeros((), dtype=jnp.int32),
        done=jnp.asarray(False),
        left=jnp.asarray(jnp.inf),
    )


def _search(along, slope):
    """Step length where the merit is nearly flat: 1, or what the secant method finds between 0 and 1."""

    # one vector holds the bracket, so that a batch freezes its finished lanes with one operation
    def closer(bracket):
        low, high, at_low, at_high, _, _, tried = bracket
        alpha = low - at_low * (high - low) / (at_high - at_low)
        alpha = jnp.where((alpha > low) & (alpha < high), alpha, 0.5 * (low + high))
        value = along(alpha)
        # Illinois rule: the end that stays gets half its slope, so that both ends move
        left = jnp.stack([alpha, high, value, 0.5 * at_high, alpha, value, tried + 1.0])
        right = jnp.stack([low, alpha, 0.5 * at_low, value, alpha, value, tried + 1.0])
        return jnp.where(value > 0.0, right, left)

    def steep(bracket):
        low, _, at_low, _, alpha, value, tried = bracket
        size = jnp.abs(slope)
        # a full step may stop short of the minimum
        far = (tried > 0.0) & (value < -FLAT * size)
        # beyond a kink the merit may have risen: up to `low` its slope is at most `at_low`, from there on `value`
        downhill = low * at_low + (alpha - low) * value < 0.0
        good = ~far & ((value <= UPHILL * size) | (downhill & (value <= FLAT * size)))
        return ~good & (tried <= SEARCHES)

    at_one = along(1.0)
    zero, one = jnp.zeros(()), jnp.ones(())
    return jax.lax.while_loop(steep, closer, jnp.stack([zero, one, slope, at_one, one, at_one, zero]))[4]
