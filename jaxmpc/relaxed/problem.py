"""The relaxed problem itself: its value, its scale, its Newton matrix, its solution type and its dual bound.

`newton` solves a `Prepared` lane, in which the objective is divided by a unit that brings curvatures and prices to the
order of one.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmpc.problem.condense import CondensedQp
from jaxmpc.problem.gram import gram
from jaxmpc.problem.instance import QpInstance
from jaxmpc.relaxed.gap import SMALLEST, reference
from jaxmpc.status import FAILED, OPTIMAL

FIXED = 1e-9  # box width [scaled moves] below which a variable is a constant
TINY = 1e-300
FEASIBLE = 1e-8  # hard rows and limits, in scaled moves
ACCEPTED = 1e-6  # relative duality gap up to which a solution counts as solved
RIDGE = 1e-13  # on the diagonal of a Newton matrix, whose entries are of the order of one
MANY = 16  # active CV limits from which on they are summed by where they change along the horizon
SINGLE = 1e-9  # of the curvature of a single active CV limit that is left where its price cannot rise


class QpSolution(eqx.Module):
    """Result of one relaxed problem; all fields in the scaled units of `CondensedQp`.

    Attributes:
        x: moves.
        objective: value of the relaxed problem at x, constants included.
        bound: lower bound of the relaxed problem from the multipliers, constants included; valid for any status.
        status: `status.OPTIMAL` or `status.FAILED`.
        iterations: Newton steps.
        row_price: multiplier of every prediction's deadzone cost (subgradient in t).
        envelope_price: the same for the levels of the envelope, in x.
        position_price: the same for the chords of squared positions; empty where there are none.
        limit_price: net price of the CV limits per prediction (high minus low); empty where there are none.
        lower_price, upper_price: multipliers of the limits of x, non-negative.
        row_low_price, row_high_price: multipliers of the hard rows, non-negative.
        residual: relative duality gap or violation of the hard rows, whichever is larger.
    """

    x: Float[Array, " n"]
    objective: Float[Array, ""]
    bound: Float[Array, ""]
    status: Int[Array, ""]
    iterations: Int[Array, ""]
    row_price: Float[Array, " prediction"]
    envelope_price: Float[Array, "level n"]
    position_price: Float[Array, " position"]
    limit_price: Float[Array, " limit"]
    lower_price: Float[Array, " n"]
    upper_price: Float[Array, " n"]
    row_low_price: Float[Array, " hard"]
    row_high_price: Float[Array, " hard"]
    residual: Float[Array, ""]


class Slopes(NamedTuple):
    """Weights of a proximal Newton step.

    Attributes:
        level, sharp: of the predictions, see `gram`.
        limit: of the CV limits per prediction; empty where there are none.
        beyond: what their prices were if nothing were given up of them, upper positive.
        move: of every move by itself: limits and envelope.
        hard: of the hard rows.
    """

    level: Float[Array, " prediction"]
    sharp: Float[Array, " prediction"]
    limit: Float[Array, " limit"]
    beyond: Float[Array, " limit"]
    move: Float[Array, " n"]
    hard: Float[Array, " hard"]


class Prepared(eqx.Module):
    """One lane, ready to be solved; objective terms are divided by `unit`.

    Attributes:
        qp, instance, lower, upper: the problem as it was given.
        unit: what objectives and prices are divided by.
        hessian, linear: smooth part of the objective.
        curvature, steepness: 2 S and s per prediction.
        steep: slopes of the envelope.
        position: curvature whose place chords take, per hard row; empty where there are none.
        free: moves with room between their limits.
        takes_part: hard rows with free moves; the others are constants.
        row_low, row_high: their limits, infinite for the constants.
        limit_low, limit_high: CV limits that cost something, infinite for the others; empty where there are none at all.
        slack_price: price of eps per CV [1/CV unit].
    """

    qp: CondensedQp
    instance: QpInstance
    lower: Float[Array, " n"]
    upper: Float[Array, " n"]
    unit: Float[Array, ""]
    hessian: Float[Array, "n n"]
    linear: Float[Array, " n"]
    curvature: Float[Array, " prediction"]
    steepness: Float[Array, " prediction"]
    steep: Float[Array, "level n"]
    position: Float[Array, " position"]
    free: Bool[Array, " n"]
    takes_part: Bool[Array, " hard"]
    row_low: Float[Array, " hard"]
    row_high: Float[Array, " hard"]
    limit_low: Float[Array, " limit"]
    limit_high: Float[Array, " limit"]
    slack_price: Float[Array, " cv"]

    @property
    def keep(self) -> Float[Array, " n"]:
        """1 for free moves, 0 for fixed ones."""
        return self.free.astype(self.lower.dtype)

    def respond(self, x: Float[Array, " n"]) -> Float[Array, " prediction"]:
        """Theta x."""
        return self.qp.response @ (self.qp.scale * x)

    def pull(self, prices: Float[Array, " prediction"]) -> Float[Array, " n"]:
        """Theta' prices."""
        return (prices @ self.qp.response) * self.qp.scale

    def by_cv(self, values: Float[Array, " limit"]) -> Float[Array, "cv horizon"]:
        """Values per prediction, one row per CV."""
        return values.reshape(self.slack_price.shape[0], -1)

    def proximal_matrix(self, slopes: Slopes, ridge) -> Float[Array, "n n"]:
        """Hessian + theta' diag(..) theta + W' diag(hard) W + diag(move) + ridge, identity on fixed moves."""
        qp, keep, scale = self.qp, self.keep, self.qp.scale
        level, sharp = slopes.level, slopes.sharp
        if qp.has_limits:
            count = total((slopes.limit > 0.0).astype(scale.dtype))
            level = level + jnp.where(count > MANY, slopes.limit, 0.0)
            sharp = sharp + jnp.where(count > MANY, 0.0, slopes.limit)
        squares = gram(qp.response, qp.summed, qp.slack_weight.shape[0], level, sharp)
        if qp.has_limits:
            squares = jax.lax.cond(count > 0.0, lambda: squares - self._common(slopes), lambda: squares)
        matrix = self.hessian + scale[:, None] * scale[None, :] * squares + qp.rows.square(slopes.hard)
        return matrix * keep[:, None] * keep[None, :] + jnp.diag(keep * slopes.move + (1.0 - keep + ridge))

    def _common(self, slopes: Slopes) -> Float[Array, "n n"]:
        """What active CV limits have in common whose prices add up to what eps costs, so that only differences count."""
        cvs = self.qp.slack_weight.shape[0]
        response = self.qp.response.reshape(cvs, -1, self.qp.scale.shape[0])
        curvature = jnp.max(self.by_cv(slopes.limit), axis=1)
        common = jnp.zeros(())
        for sign in (1.0, -1.0):
            beyond = self.by_cv(jnp.maximum(sign * slopes.beyond, 0.0))
            active = ((beyond > 0.0) & (self.by_cv(slopes.limit) > 0.0)).astype(response.dtype)
            spent = jnp.sum(beyond, axis=1) > self.slack_price
            # a share short of the whole leaves a single active limit hardly any curvature, but never less than none
            weight = jnp.where(
                spent, (1.0 - SINGLE) * curvature / jnp.maximum(jnp.sum(active, axis=1), 1.0), 0.0
            )
            summed = jnp.einsum("cj,cjn->cn", active, response)
            common += summed.T @ (weight[:, None] * summed)
        return common

    def uncovered(self, x: Float[Array, " n"], gradient: Float[Array, " n"]) -> Float[Array, ""]:
        """What a gradient g that is left at x costs the bound: -min over the box of g'(z - x) + (z - x)'D (z - x).

        D is the moves' own weight, which `hessian` surely holds of curvature. It is left to what the search for whole moves
        makes of bounds and curvature where there are any.
        """
        own = jnp.where(jnp.any(self.qp.whole), 0.0, 2.0 * self.qp.move_weight / self.unit)
        far, bowl = 10.0 * (1.0 + jnp.abs(x)), own > 0.0
        low = jnp.where(bowl | jnp.isfinite(self.lower), self.lower - x, -far)
        high = jnp.where(bowl | jnp.isfinite(self.upper), self.upper - x, far)
        move = jnp.clip(-gradient / jnp.maximum(own, TINY), low, high)
        return -total((gradient + 0.5 * own * move) * move)

    @property
    def tolerated(self) -> Float[Array, ""]:
        """Gap that is accepted where the objective is next to nothing."""
        return ACCEPTED * SMALLEST * self.qp.unit / self.unit

    def value(self, x, t) -> Float[Array, ""]:
        """Objective in its own unit at x with t = theta x + t0."""
        return _value(self.qp, self.instance, x, t)


def prepare(
    qp: CondensedQp, instance: QpInstance, lower: Float[Array, " n"], upper: Float[Array, " n"]
) -> Prepared:
    """Scale one lane (use `jax.vmap` for a batch).

    Args:
        qp: constant part.
        instance: offsets and limits of this sample.
        lower, upper: limits of x; equal limits fix a move.
    """
    offset, size = instance.offset, jnp.abs(qp.response)
    linear = 2.0 * ((qp.quadratic * offset) @ qp.response) * qp.scale
    if qp.ideal is not None and instance.distance is not None:
        linear += qp.ideal.linear(instance.distance)
    beyond = jnp.maximum(jnp.abs(offset) - qp.deadzone, 0.0)
    steep = jnp.abs(linear) + ((qp.soft_linear + 2.0 * qp.soft_quadratic * beyond) @ size) * qp.scale
    steep += jnp.sum(qp.steep, axis=0)
    unit = jnp.maximum(jnp.max(jnp.diagonal(qp.curvature) + qp.bend), 1e-2 * jnp.max(steep))
    if qp.has_limits:
        unit = jnp.maximum(unit, 1e-3 * jnp.max(qp.slack_weight * qp.reach))
    unit = jnp.where(unit > 0.0, unit, 1.0)
    none = jnp.zeros(0)
    horizon = instance.limit_high.shape[0] // qp.slack_weight.shape[0]
    paid = jnp.repeat(qp.slack_weight > 0.0, horizon)
    free = (upper - lower) > FIXED
    # rows without free moves are constants and leave the solver; feasibility of the whole is checked outside
    takes_part = qp.rows.touch(free.astype(lower.dtype))
    return Prepared(
        qp=qp,
        instance=instance,
        lower=lower,
        upper=upper,
        unit=unit,
        hessian=qp.hessian / unit,
        linear=linear / unit,
        curvature=2.0 * qp.soft_quadratic / unit,
        steepness=qp.soft_linear / unit,
        steep=qp.steep / unit,
        position=none if qp.position_weight is None else qp.position_weight / unit,
        free=free,
        takes_part=takes_part,
        row_low=jnp.where(takes_part, instance.row_low, -jnp.inf),
        row_high=jnp.where(takes_part, instance.row_high, jnp.inf),
        limit_low=jnp.where(paid, instance.limit_low, -jnp.inf) if qp.has_limits else none,
        limit_high=jnp.where(paid, instance.limit_high, jnp.inf) if qp.has_limits else none,
        slack_price=qp.slack_weight / unit,
    )


def solve_positive(matrix: Float[Array, "n n"], rhs: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solution of a symmetric positive definite system; not a number where it is not definite."""
    return substitute(factorise(matrix), rhs)


def factorise(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Cholesky factor of a symmetric matrix (transposed, which is how LAPACK stores it: this saves a copy)."""
    return jax.lax.linalg.cholesky(matrix.T, symmetrize_input=False)


def substitute(factor: Float[Array, "n n"], rhs: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solution of the factorised system."""
    half = jax.lax.linalg.triangular_solve(factor, rhs[:, None], left_side=True, lower=True)
    return jax.lax.linalg.triangular_solve(factor, half, left_side=True, lower=True, transpose_a=True)[:, 0]


def evaluate(qp: CondensedQp, instance: QpInstance, x: Float[Array, " n"]) -> Float[Array, ""]:
    """Objective of the relaxed problem at x, constants included; equals (6.6) where integer moves are whole."""
    return _value(qp, instance, x, qp.response @ (qp.scale * x) + instance.offset)


def _value(qp: CondensedQp, instance: QpInstance, x, t) -> Float[Array, ""]:
    own = jnp.sum(qp.move_weight * x**2) + jnp.sum(_envelope_cost(qp, x))
    if qp.position_weight is not None:
        w = qp.rows.of(x)
        own += qp.position_weight @ (chords(w) - w**2)
    if qp.ideal is not None and instance.distance is not None:
        own += qp.ideal.value(x, instance.distance)
    return total(qp.quadratic * t**2 + _soft_cost(qp, t)) + own + jnp.sum(limit_cost(qp, instance, t))


def total(values: Float[Array, " row"]) -> Float[Array, ""]:
    """Sum over rows; as a matrix product it takes XLA half the time of a reduction on a CPU."""
    return values @ np.ones(values.shape[0])


def _soft_cost(qp: CondensedQp, t):
    beyond = jnp.maximum(jnp.abs(t) - qp.deadzone, 0.0)
    return (qp.soft_quadratic * beyond + qp.soft_linear) * beyond


def _envelope_cost(qp: CondensedQp, x):
    return qp.steep * jnp.maximum(jnp.abs(x) - qp.knot, 0.0)


def chords(w: Float[Array, " hard"]) -> Float[Array, " hard"]:
    """The square at whole numbers, straight lines between them."""
    k = jnp.floor(w)
    return k**2 + (2.0 * k + 1.0) * (w - k)


def limit_cost(qp: CondensedQp, instance: QpInstance, t):
    """Rho times the largest violation per CV and side, high sides first."""
    if not qp.has_limits:
        return jnp.zeros(1)
    cvs = qp.slack_weight.shape[0]
    over = jnp.max((t - instance.limit_high).reshape(cvs, -1), axis=1)
    under = jnp.max((instance.limit_low - t).reshape(cvs, -1), axis=1)
    rho = jnp.concatenate([qp.slack_weight, qp.slack_weight])
    return rho * jnp.maximum(jnp.concatenate([over, under]), 0.0)


class Prices(eqx.Module):
    """Multipliers in the objective's own unit, net of both sides; `limit` is empty where there are no CV limits."""

    row: Float[Array, " prediction"]
    envelope: Float[Array, "level n"]
    position: Float[Array, " position"]
    limit: Float[Array, " limit"]
    hard: Float[Array, " hard"]


def conclude(
    problem: Prepared, x: Float[Array, " n"], prices: Prices, iterations: Int[Array, ""]
) -> QpSolution:
    """Bound, value and verdict of moves and prices, wherever they come from.

    The bound is Lagrangian, with prices made dual feasible: soft(t) >= v t - soft*(v) with
    soft*(v) = c|v| + max(|v| - s, 0)^2 / (4 S), and rho max(0, w) >= sum of p w for p >= 0 with sum p <= rho. What is left
    of the gradient in x is covered by the box of x and the curvature of the moves' own weight.

    Args:
        problem: the lane.
        x: moves within their limits.
        prices: of any quality.
        iterations: to be reported.

    Returns:
        `QpSolution` with status `OPTIMAL` if its duality gap is at most `ACCEPTED` and the hard rows hold to `FEASIBLE`.
    """
    qp, instance = problem.qp, problem.instance
    s2, s1 = qp.soft_quadratic, qp.soft_linear
    t = problem.respond(x) + instance.offset
    price = jnp.where(s2 > 0, prices.row, jnp.clip(prices.row, -s1, s1))
    over = jnp.maximum(jnp.abs(price) - s1, 0.0)
    conjugate = qp.deadzone * jnp.abs(price) + over**2 / jnp.where(s2 > 0, 4.0 * s2, 1.0)
    envelope = jnp.clip(prices.envelope, -qp.steep, qp.steep)
    # the gap is summed term by term: each is small at a solution, while objective and bound may be large
    found = total(_soft_cost(qp, t) + conjugate - price * t)
    found += jnp.sum(_envelope_cost(qp, x) + qp.knot * jnp.abs(envelope) - envelope * x)
    net, limit_price = price, prices.limit
    if qp.has_limits:
        limit_price, paid = _limit_terms(qp, instance, t, prices.limit)
        found += jnp.sum(limit_cost(qp, instance, t)) - paid
        net = price + limit_price
    wx, pushed = qp.rows.of(x), prices.hard
    if qp.position_weight is not None:
        weight, position = qp.position_weight, prices.position
        found += total(weight * chords(wx) + chord_conjugate(weight, position) - position * wx)
        pushed = pushed + position
    row_low, row_high = jnp.maximum(-prices.hard, 0.0), jnp.maximum(prices.hard, 0.0)
    found -= jnp.sum(jnp.where(row_high > 0, row_high * (wx - instance.row_high), 0.0))
    found -= jnp.sum(jnp.where(row_low > 0, row_low * (instance.row_low - wx), 0.0))
    gradient = qp.hessian @ x + problem.linear * problem.unit + problem.pull(net)
    gradient += jnp.sum(envelope, axis=0) + qp.rows.pull(pushed)
    # the box of x is not priced but kept
    found += problem.uncovered(x, gradient / problem.unit) * problem.unit
    objective = problem.value(x, t)
    relative = found / reference(objective, qp.unit)
    outside = jnp.maximum(wx - instance.row_high, instance.row_low - wx)
    broken = jnp.max(jnp.where(problem.takes_part, outside, -jnp.inf), initial=0.0)
    good = (relative <= ACCEPTED) & (broken <= FEASIBLE) & ~jnp.any(problem.lower > problem.upper + FIXED)
    return QpSolution(
        x=x,
        objective=objective,
        bound=objective - found,
        status=jnp.where(good, OPTIMAL, FAILED),
        iterations=iterations,
        row_price=price,
        envelope_price=envelope,
        position_price=prices.position,
        limit_price=limit_price,
        lower_price=jnp.maximum(gradient, 0.0),
        upper_price=jnp.maximum(-gradient, 0.0),
        row_low_price=row_low,
        row_high_price=row_high,
        residual=jnp.maximum(relative, broken),
    )


def chord_conjugate(weight: Float[Array, " hard"], price: Float[Array, " hard"]) -> Float[Array, " hard"]:
    """The largest of price k - weight k^2 over whole numbers k."""
    some = weight > 0.0
    k = jnp.where(some, jnp.round(price / jnp.where(some, 2.0 * weight, 1.0)), 0.0)
    return price * k - weight * k**2


def _limit_terms(qp: CondensedQp, instance: QpInstance, t, price):
    """Prices of the CV limits that spend no more than rho per CV and side, and what they add to the bound."""
    cvs, predictions = qp.slack_weight.shape[0], instance.limit_high.shape[0]
    rho = jnp.concatenate([qp.slack_weight, qp.slack_weight])
    both = jnp.maximum(jnp.concatenate([price, -price]), 0.0).reshape(2 * cvs, -1)
    spent = jnp.sum(both, axis=1)
    both = both * jnp.where(spent > rho, rho / jnp.maximum(spent, TINY), 1.0)[:, None]
    high, low = both.reshape(-1)[:predictions], both.reshape(-1)[predictions:]
    paid = total(jnp.where(high > 0, high * (t - instance.limit_high), 0.0))
    paid += total(jnp.where(low > 0, low * (instance.limit_low - t), 0.0))
    return high - low, paid
