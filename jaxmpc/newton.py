"""A start finished exactly: semismooth Newton on the augmented Lagrangian of the relaxed problem.

With the prices of a neighbouring problem (the previous sample, the parent node) most rows are already known to be inside,
outside or at the edge of their deadzone, and most limits to be active or not. Every row becomes a proximal
term with its price (Hermans, Themelis and Patrinos 2022, QPALM), whose gradient is piecewise linear, so that a Newton step
is exact as soon as the classification is right, which takes a handful of steps even without a start. What is returned is
judged by its own duality gap; `relaxation` turns to the interior point of `qp` when that is not closed. CV limits that are
reached are left to the interior point, too.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxmpc.relaxed_problem import RIDGE, TINY, Prepared, Prices, QpSolution, conclude, solve_positive, total

STEPS = 20  # Newton steps after which a start is given up
PENALTY = 1e4  # curvature of a proximal term against the largest of the Hessian
FLAT_ROW = 1e-9  # squared length below which a row has next to no effect, against the longest
SEARCHES = 12  # trials of the line search
FLAT = 0.3  # share of its slope at the start that the merit may have where a line search ends


class WarmStart(eqx.Module):
    """Moves and prices of a neighbouring problem, in the scaled units of `CondensedQp`.

    Attributes:
        x: moves.
        row_price: prices of the deadzone rows.
        box_price: prices of the limits of x, upper positive.
        hard_price: prices of the hard rows, upper positive.
    """

    x: Float[Array, " n"]
    row_price: Float[Array, " row"]
    box_price: Float[Array, " n"]
    hard_price: Float[Array, " hard"]


def warm_start_of(solution: QpSolution) -> WarmStart:
    """Start from a solved problem."""
    return WarmStart(
        x=solution.x,
        row_price=solution.row_price,
        box_price=solution.upper_price - solution.lower_price,
        hard_price=solution.row_high_price - solution.row_low_price,
    )


class _Families(NamedTuple):
    """One value per deadzone row, limit of x and hard row."""

    row: Array
    box: Array
    hard: Array


class _State(NamedTuple):
    x: Array
    t: Array
    prices: _Families
    ridge: Array
    steps: Array
    done: Array


class _Proximal(NamedTuple):
    """The augmented Lagrangian of one lane: new prices of all families, and their slopes.

    A deadzone row with z = sigma t + price has the new price r e + (1 - r) clip(e, -s, s), where e is what z exceeds
    sigma c by, and r = 2 S / (2 S + sigma).
    """

    problem: Prepared
    row_sigma: Array
    hard_sigma: Array
    knot: Array
    share: Array

    def prices(self, x, t, w, old: _Families) -> _Families:
        """New prices at x."""
        p, excess = self.problem, self._excess(t, old.row)
        return _Families(
            row=self.share * excess + (1.0 - self.share) * jnp.clip(excess, -p.steepness, p.steepness),
            box=_away(PENALTY * x + old.box, PENALTY * p.lower, PENALTY * p.upper),
            hard=_away(
                self.hard_sigma * w + old.hard, self.hard_sigma * p.row_low, self.hard_sigma * p.row_high
            ),
        )

    def slopes(self, t, old: _Families, new: _Families) -> _Families:
        """Derivatives of the new prices in t, x, w."""
        excess = jnp.abs(self._excess(t, old.row))
        row = jnp.where(excess <= self.problem.steepness, self.row_sigma, self.row_sigma * self.share)
        return _Families(
            row=jnp.where(excess > 0.0, row, 0.0),
            box=jnp.where(new.box != 0.0, PENALTY, 0.0),
            hard=jnp.where(new.hard != 0.0, self.hard_sigma, 0.0),
        )

    def _excess(self, t, price):
        return _away(self.row_sigma * t + price, -self.knot, self.knot)

    def gradient(self, x, prices: _Families):
        """Gradient of the augmented Lagrangian, given the new prices at x."""
        p = self.problem
        force = p.hessian @ x + p.linear + p.pull(prices.row) + prices.box + prices.hard @ p.w_matrix
        return p.keep * force


def _away(value, low, high):
    """What a value exceeds its limits by."""
    return value - jnp.clip(value, low, high)


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
    largest = jnp.max(p.qp.row_size)
    row_sigma = PENALTY / jnp.maximum(p.qp.row_size, FLAT_ROW * jnp.where(largest > 0.0, largest, 1.0))
    hard_sigma = PENALTY / jnp.maximum(jnp.sum(p.w_matrix**2, axis=1), TINY)
    proximal = _Proximal(
        problem=p,
        row_sigma=row_sigma,
        hard_sigma=hard_sigma,
        knot=row_sigma * p.qp.deadzone,
        share=p.curvature / (p.curvature + row_sigma),
    )
    large = 1.0 + jnp.max(jnp.abs(p.linear))

    def step(state: _State) -> _State:
        x, t, w = state.x, state.t, state.x @ p.w_matrix.T
        prices = proximal.prices(x, t, w, state.prices)
        slopes = proximal.slopes(t, state.prices, prices)
        gradient = proximal.gradient(x, prices)
        matrix = p.newton_matrix(slopes.row, slopes.hard, slopes.box, state.ridge)
        dx = -keep * solve_positive(matrix, gradient)
        dt, dw = p.respond(dx), dx @ p.w_matrix.T
        bend, slope = dx @ (p.hessian @ dx), (p.hessian @ x + p.linear) @ dx

        def along(alpha):  # derivative of the merit along dx, increasing in alpha
            new = proximal.prices(x + alpha * dx, t + alpha * dt, w + alpha * dw, state.prices)
            forces = total(new.row * dt) + new.box @ dx + new.hard @ dw
            return slope + alpha * bend + forces

        alpha = _search(along, gradient @ dx)
        x, t, w = x + alpha * dx, t + alpha * dt, w + alpha * dw
        prices = proximal.prices(x, t, w, state.prices)
        left = jnp.max(jnp.abs(proximal.gradient(x, prices)))
        settled, exact = left < 1e-7 * large, left < 1e-12 * large
        moved = jax.tree.map(lambda new, old: (new - old) ** 2, prices, state.prices)
        change = total(moved.row / row_sigma) + total(moved.box / PENALTY) + total(moved.hard / hard_sigma)
        good = jnp.all(jnp.isfinite(x))
        after = _State(
            x=x,
            t=t,
            prices=jax.tree.map(lambda new, old: jnp.where(settled, new, old), prices, state.prices),
            ridge=state.ridge,
            steps=state.steps + 1,
            done=exact & (change < 1e-14),
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
    first = _State(
        x=x,
        t=p.respond(x) + p.instance.offset,
        prices=_Families(
            row=jnp.where(p.soft, start.row_price / unit, 0.0),
            box=keep * start.box_price / unit,
            hard=jnp.where(p.takes_part, start.hard_price / unit, 0.0),
        ),
        ridge=jnp.asarray(RIDGE),
        steps=jnp.zeros((), dtype=jnp.int32),
        done=jnp.asarray(False) if skip is None else skip,
    )
    state = jax.lax.while_loop(unfinished, step, first)
    row, box, hard = (unit * value for value in state.prices)
    x = jnp.clip(state.x, p.lower, p.upper)
    solution = conclude(p, x, Prices(row, hard), state.steps)
    return solution, WarmStart(state.x, row, box, hard), state.done | (state.steps >= STEPS)


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
