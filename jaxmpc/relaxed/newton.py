"""A relaxed problem solved exactly: semismooth Newton on its augmented Lagrangian.

With the prices of a neighbouring problem (the previous sample, the parent node) most rows are already known to be inside,
outside or at the edge of their deadzone, and most limits to be active or not. Every row becomes a proximal
term with its price (Hermans, Themelis and Patrinos 2022, QPALM), whose gradient is piecewise linear, so that a Newton step
is exact as soon as the classification is right. From a start with prices that takes one to three steps. Without
any, the terms are soft at first and stiffer with every problem solved, which finds the classification in about four. Where
kinks lie so close that steps get nowhere, they are damped and the terms soft again.
What is returned is judged by its own duality gap; `relaxation` turns to the interior point of `qp` when that is not closed.
CV limits count as hard here: where they cannot be met for their weight, the interior point has to decide what is given up.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

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

STEPS = 60  # Newton steps after which a start is given up
# curvature of a proximal term against the largest of the Hessian: without prices, in the end, and the least there is
SOFT, STIFF, SOFTEST = 10.0, 1e4, 0.1
STIFFEN = 10.0  # what it grows by when the problem with the present prices is solved, and falls by after a short step
SHORT = 0.003  # step length from which on the next step is damped
DAMPING, MOST_DAMPING, DAMP = 1e-4, 10.0, 10.0  # on the diagonal after short steps, and what that changes by
SEARCHES = 12  # trials of the line search
FLAT = 0.3  # share of its slope at the start that the merit may have where a line search ends
SETTLED, EXACT = 1e-7, 1e-12  # share of the gradient without moves left when prices are taken, and at the end
UNPAID, OUTSIDE = (
    1e-14,
    1e-9,
)  # last change of the prices, squared, and what it leaves hard rows violated by, at the end


class WarmStart(eqx.Module):
    """Moves and prices of a neighbouring problem, in the scaled units of `CondensedQp`.

    Attributes:
        x: moves.
        row_price: prices of the deadzone rows.
        limit_price: prices of the CV limits, upper positive.
        box_price: prices of the limits of x, upper positive.
        hard_price: prices of the hard rows, upper positive.
    """

    x: Float[Array, " n"]
    row_price: Float[Array, " row"]
    limit_price: Float[Array, " prediction"]
    box_price: Float[Array, " n"]
    hard_price: Float[Array, " hard"]


def warm_start_of(solution: QpSolution) -> WarmStart:
    """Start from a solved problem."""
    return WarmStart(
        x=solution.x,
        row_price=solution.row_price,
        limit_price=solution.limit_price,
        box_price=solution.upper_price - solution.lower_price,
        hard_price=solution.row_high_price - solution.row_low_price,
    )


class _Families(NamedTuple):
    """One value per deadzone row, CV limit, limit of x and hard row."""

    row: Array
    limit: Array
    box: Array
    hard: Array


class _State(NamedTuple):
    x: Array
    t: Array
    prices: _Families
    stiffness: Array
    ridge: Array
    steps: Array
    done: Array


class _Proximal(NamedTuple):
    """The augmented Lagrangian of one lane: new prices of all families, and their slopes.

    A deadzone row with z = sigma t + price has the new price r e + (1 - r) clip(e, -s, s), where e is what z exceeds
    sigma c by, and r = 2 S / (2 S + sigma).
    """

    problem: Prepared
    sigma: _Families
    knot: Array
    share: Array

    @classmethod
    def of(cls, problem: Prepared, stiffness) -> _Proximal:
        """With so much curvature per term."""
        p = problem
        row = stiffness * p.qp.row_unit
        hard = stiffness / jnp.maximum(jnp.sum(p.w_matrix**2, axis=1), TINY)
        limit = row[: p.limit_high.shape[0]]
        share = p.curvature / (p.curvature + row)
        return cls(p, _Families(row, limit, stiffness, hard), row * p.qp.deadzone, share)

    def prices(self, x, t, w, old: _Families) -> _Families:
        """New prices at x."""
        p, sigma = self.problem, self.sigma
        excess = self._excess(t, old.row)
        return _Families(
            row=self.share * excess + (1.0 - self.share) * jnp.clip(excess, -p.steepness, p.steepness),
            limit=_away(sigma.limit, t[: len(sigma.limit)], old.limit, p.limit_low, p.limit_high),
            box=_away(sigma.box, x, old.box, p.lower, p.upper),
            hard=_away(sigma.hard, w, old.hard, p.row_low, p.row_high),
        )

    def slopes(self, t, old: _Families, new: _Families) -> Slopes:
        """Derivatives of the new prices in t, x, w."""
        excess = jnp.abs(self._excess(t, old.row))
        level = jnp.where(excess > 0.0, self.sigma.row * self.share, 0.0)
        at_edge = (excess > 0.0) & (excess <= self.problem.steepness)
        sharp = jnp.where(at_edge, self.sigma.row * (1.0 - self.share), 0.0)
        split, bounded = self.problem.predictions, len(self.sigma.limit)
        limit = jnp.where(new.limit != 0.0, self.sigma.limit, 0.0)
        return Slopes(
            level=level[:split],
            sharp=sharp[:split] + limit if bounded else sharp[:split],
            envelope=level[split:] + sharp[split:],
            box=jnp.where(new.box != 0.0, self.sigma.box, 0.0),
            hard=jnp.where(new.hard != 0.0, self.sigma.hard, 0.0),
        )

    def _excess(self, t, price):
        z = self.sigma.row * t + price
        return z - jnp.clip(z, -self.knot, self.knot)

    def gradient(self, x, prices: _Families):
        """Gradient of the augmented Lagrangian, given the new prices at x."""
        p = self.problem
        force = p.hessian @ x + p.linear + p.pull(p.net(prices.row, prices.limit)) + prices.box
        return p.keep * (force + prices.hard @ p.w_matrix)


def _away(sigma, value, price, low, high):
    """New price of limits: what sigma value + price exceeds them by."""
    z = sigma * value + price
    return z - jnp.clip(z, sigma * low, sigma * high)


def refine(
    problem: Prepared,
    start: WarmStart,
    *,
    skip: Bool[Array, ""] | None = None,
    few: int | Int[Array, ""] = 0,
    axis: str | None = None,
) -> tuple[QpSolution, WarmStart, Bool[Array, ""]]:
    """Solve one lane from a start.

    Args:
        problem: the lane.
        start: where to begin.
        skip: do not iterate (the lane is solved already, its result is not used).
        few: number of unfinished lanes at which a whole batch stops.
        axis: name of the batch axis; None for a single lane.

    Returns:
        ``(solution, start, ended)``: the solution is judged by `relaxed_problem.conclude`; the start says where to go on,
        unless there is nothing left to do here.
    """
    p, keep, unit = problem, problem.keep, problem.unit
    large = 1.0 + jnp.max(jnp.abs(p.linear))

    def step(state: _State) -> _State:
        proximal = _Proximal.of(p, state.stiffness)
        x, t, w = state.x, state.t, state.x @ p.w_matrix.T
        prices = proximal.prices(x, t, w, state.prices)
        gradient = proximal.gradient(x, prices)
        matrix = p.proximal_matrix(proximal.slopes(t, state.prices, prices), state.ridge)
        dx = -keep * solve_positive(matrix, gradient)
        dt, dw = p.respond(dx), dx @ p.w_matrix.T
        bend, slope = dx @ (p.hessian @ dx), (p.hessian @ x + p.linear) @ dx

        def along(alpha):  # derivative of the merit along dx, increasing in alpha
            new = proximal.prices(x + alpha * dx, t + alpha * dt, w + alpha * dw, state.prices)
            return slope + alpha * bend + total(p.net(new.row, new.limit) * dt) + new.box @ dx + new.hard @ dw

        alpha = _search(along, gradient @ dx)
        x, t, w = x + alpha * dx, t + alpha * dt, w + alpha * dw
        prices = proximal.prices(x, t, w, state.prices)
        left = jnp.max(jnp.abs(proximal.gradient(x, prices)))
        settled, exact = left < SETTLED * large, left < EXACT * large
        moved = jax.tree.map(lambda new, old: new - old, prices, state.prices)
        change = sum(jnp.sum(m**2 / sigma) for m, sigma in zip(moved, proximal.sigma, strict=True))
        outside = jnp.max(jnp.abs(moved.hard) / proximal.sigma.hard, initial=0.0)
        # a kink close by stops a step that has hardly any curvature before it: shorter ones get on
        short = alpha < SHORT
        stiffer = jnp.minimum(STIFFEN * state.stiffness, STIFF)
        softer = jnp.maximum(state.stiffness / STIFFEN, SOFTEST)
        damped = jnp.clip(DAMP * state.ridge, DAMPING, MOST_DAMPING)
        good = jnp.all(jnp.isfinite(x))
        after = _State(
            x=x,
            t=t,
            prices=jax.tree.map(lambda new, old: jnp.where(settled, new, old), prices, state.prices),
            stiffness=jnp.where(settled, stiffer, jnp.where(short, softer, state.stiffness)),
            ridge=jnp.where(short, damped, jnp.maximum(state.ridge / DAMP, RIDGE)),
            steps=state.steps + 1,
            done=exact & (change < UNPAID) & (outside < OUTSIDE),
        )
        # a matrix that rounding left indefinite is tried again with more on its diagonal
        again = state._replace(ridge=1e2 * state.ridge, steps=state.steps + 1)
        after = jax.tree.map(lambda new, old: jnp.where(good, new, old), after, again)
        return jax.tree.map(lambda new, old: jnp.where(state.done, old, new), after, state)

    def unfinished(state: _State):
        open_ = ~state.done & (state.steps < STEPS)
        # one predicate for the whole batch: the loop ends when few lanes are left
        return open_ if axis is None else jax.lax.psum(open_.astype(jnp.int32), axis) > few

    x = jnp.where(p.free, jnp.clip(start.x, p.lower, p.upper), 0.5 * (p.lower + p.upper))
    prices = _Families(
        row=jnp.where(p.soft, start.row_price / unit, 0.0),
        limit=start.limit_price[: p.limit_high.shape[0]] / unit,
        box=keep * start.box_price / unit,
        hard=jnp.where(p.takes_part, start.hard_price / unit, 0.0),
    )
    priced = jnp.any(jnp.concatenate(prices) != 0.0)
    first = _State(
        x=x,
        t=p.respond(x) + p.instance.offset,
        prices=prices,
        stiffness=jnp.where(priced, STIFF, SOFT),
        ridge=jnp.asarray(RIDGE),
        steps=jnp.zeros((), dtype=jnp.int32),
        done=jnp.asarray(False) if skip is None else skip,
    )
    state = jax.lax.while_loop(unfinished, step, first)
    row, limit, box, hard = (unit * value for value in state.prices)
    x = jnp.clip(state.x, p.lower, p.upper)
    solution = conclude(p, x, Prices(row, hard, limit), state.steps)
    resume = WarmStart(state.x, row, solution.limit_price, box, hard)
    return solution, resume, state.done | (state.steps >= STEPS)


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
        *_, value, tried = bracket
        # a full step may stop short of the minimum
        size = jnp.where(tried > 0.0, jnp.abs(value), value)
        return ~(size <= FLAT * jnp.abs(slope)) & (tried <= SEARCHES)

    at_one = along(1.0)
    zero, one = jnp.zeros(()), jnp.ones(())
    return jax.lax.while_loop(steep, closer, jnp.stack([zero, one, slope, at_one, one, at_one, zero]))[4]
