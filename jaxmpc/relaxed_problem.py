"""The relaxed problem itself: its value, its scale, its Newton matrix, its solution type and its dual bound.

`qp` and `newton` are two methods for it; `relaxation` combines them.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmpc.condense import CondensedQp, QpInstance

FIXED = 1e-9  # box width [scaled moves] below which a variable is a constant
TINY = 1e-300


class QpSolution(eqx.Module):
    """Result of one relaxed problem; all fields in the scaled units of `CondensedQp`.

    Attributes:
        x: moves.
        objective: value of the relaxed problem at x, constants included.
        bound: lower bound of the relaxed problem from the multipliers, constants included; valid for any status.
        status: `status.OPTIMAL` or `status.FAILED`.
        iterations: interior-point iterations.
        row_price: multiplier of every row's deadzone cost (subgradient in t).
        limit_price: net price of the CV limits per prediction row (high minus low).
        lower_price, upper_price: multipliers of the limits of x, non-negative.
        row_low_price, row_high_price: multipliers of the hard rows, non-negative.
        residual: largest scaled KKT residual the solver itself saw (`kkt` has the independent ones).
    """

    x: Float[Array, " n"]
    objective: Float[Array, ""]
    bound: Float[Array, ""]
    status: Int[Array, ""]
    iterations: Int[Array, ""]
    row_price: Float[Array, " row"]
    limit_price: Float[Array, " prediction"]
    lower_price: Float[Array, " n"]
    upper_price: Float[Array, " n"]
    row_low_price: Float[Array, " hard"]
    row_high_price: Float[Array, " hard"]
    residual: Float[Array, ""]


def evaluate(qp: CondensedQp, instance: QpInstance, x: Float[Array, " n"]) -> Float[Array, ""]:
    """Objective of the relaxed problem at x, constants included; equals (6.6) where integer moves are whole."""
    t = qp.theta @ x + instance.offset
    beyond = jnp.maximum(jnp.abs(t) - qp.deadzone, 0.0)
    rows = jnp.sum(qp.quadratic * t**2 + (qp.soft_quadratic * beyond + qp.soft_linear) * beyond)
    own = jnp.sum(qp.move_weight * x**2)
    return rows + own + jnp.sum(limit_cost(qp, instance, t))


def solver_unit(qp: CondensedQp, instance: QpInstance) -> Float[Array, ""]:
    """What the solvers divide the objective by, so that curvatures and prices are of the order of one."""
    theta, offset = jnp.abs(qp.theta), instance.offset
    beyond = jnp.maximum(jnp.abs(offset) - qp.deadzone, 0.0)
    bent = 2.0 * qp.soft_quadratic @ theta**2  # curvature outside the deadzones
    steep = jnp.abs(2.0 * (qp.quadratic * offset) @ qp.theta)
    steep += (qp.soft_linear + 2.0 * qp.soft_quadratic * beyond) @ theta
    unit = jnp.maximum(jnp.max(jnp.diagonal(qp.curvature) + bent), 1e-2 * jnp.max(steep))
    if qp.has_limits:
        predictions = instance.limit_high.shape[0]
        reach = jnp.max(theta[:predictions].reshape(qp.slack_weight.shape[0], -1), axis=1)
        unit = jnp.maximum(unit, 1e-3 * jnp.max(qp.slack_weight * reach))
    return jnp.where(unit > 0.0, unit, 1.0)


def weighted_gram(qp: CondensedQp):
    """The function w -> theta' diag(w) theta, by the packed products where they are kept."""
    n = qp.theta.shape[1]
    first, second = np.triu_indices(n)
    place = np.zeros((n, n), dtype=np.int32)
    place[first, second] = place[second, first] = np.arange(len(first))

    def gram(weights: Float[Array, " row"]) -> Float[Array, "n n"]:
        if qp.packed is not None:
            return jnp.take(weights @ qp.packed, place.reshape(-1)).reshape(n, n)
        return qp.theta.T @ (weights[:, None] * qp.theta)

    return gram


def limit_cost(qp: CondensedQp, instance: QpInstance, t):
    """Rho times the largest violation per CV and side, high sides first."""
    if not qp.has_limits:
        return jnp.zeros(1)
    cvs = qp.slack_weight.shape[0]
    y = t[: instance.limit_high.shape[0]]
    over = jnp.max((y - instance.limit_high).reshape(cvs, -1), axis=1)
    under = jnp.max((instance.limit_low - y).reshape(cvs, -1), axis=1)
    rho = jnp.concatenate([qp.slack_weight, qp.slack_weight])
    return rho * jnp.maximum(jnp.concatenate([over, under]), 0.0)


def dual_bound(qp, w_matrix, instance, solution, lower, upper, high, low):
    """Lagrangian lower bound with prices made dual feasible, and the prices that were used.

    soft(t) >= v t - soft*(v) with soft*(v) = c|v| + max(|v| - s, 0)^2 / (4 S); rho max(0, w) >= sum of p w for
    p >= 0 with sum p <= rho. What is left of the gradient in x is covered by the box of x, or by its curvature.
    """
    s2, s1 = qp.soft_quadratic, qp.soft_linear
    price = jnp.where(s2 > 0, solution.row_price, jnp.clip(solution.row_price, -s1, s1))
    beyond = jnp.maximum(jnp.abs(price) - s1, 0.0)
    conjugate = qp.deadzone * jnp.abs(price) + jnp.where(
        s2 > 0, beyond**2 / jnp.where(s2 > 0, 4.0 * s2, 1.0), 0.0
    )
    x = solution.x
    t = qp.theta @ x + instance.offset
    constant = jnp.sum(qp.quadratic * instance.offset**2)
    linear = 2.0 * (qp.quadratic * instance.offset) @ qp.theta
    hx = qp.hessian @ x
    value = constant + 0.5 * x @ hx + linear @ x + jnp.sum(price * t - conjugate)
    gradient = hx + linear + price @ qp.theta
    limit_price = solution.limit_price
    if qp.has_limits:
        cvs = qp.slack_weight.shape[0]
        predictions = limit_price.shape[0]
        rho = jnp.concatenate([qp.slack_weight, qp.slack_weight])
        both = jnp.concatenate([high, low]).reshape(2 * cvs, -1)
        spent = jnp.sum(both, axis=1)
        both = both * jnp.where(spent > rho, rho / jnp.maximum(spent, TINY), 1.0)[:, None]
        high, low = both.reshape(-1)[:predictions], both.reshape(-1)[predictions:]
        y = t[:predictions]
        value += jnp.sum(jnp.where(high > 0, high * (y - instance.limit_high), 0.0))
        value += jnp.sum(jnp.where(low > 0, low * (instance.limit_low - y), 0.0))
        limit_price = high - low
        gradient += limit_price @ qp.theta[:predictions]
    wx = w_matrix @ x
    row_low, row_high = solution.row_low_price, solution.row_high_price
    value += jnp.sum(jnp.where(row_high > 0, row_high * (wx - instance.row_high), 0.0))
    value += jnp.sum(jnp.where(row_low > 0, row_low * (instance.row_low - wx), 0.0))
    gradient += (row_high - row_low) @ w_matrix
    # the box of x is not priced but kept: min over the box of gradient'(z - x), curvature left out
    reach_low = jnp.where(jnp.isfinite(lower), lower, x - 10.0 * (1.0 + jnp.abs(x)))
    reach_high = jnp.where(jnp.isfinite(upper), upper, x + 10.0 * (1.0 + jnp.abs(x)))
    value += jnp.sum(jnp.minimum(gradient * (reach_low - x), gradient * (reach_high - x)))
    return eqx.tree_at(
        lambda s: (s.bound, s.row_price, s.limit_price, s.lower_price, s.upper_price),
        solution,
        (value, price, limit_price, jnp.maximum(gradient, 0.0), jnp.maximum(-gradient, 0.0)),
    )
