"""How far a solution is from optimal: Karush-Kuhn-Tucker residuals of the relaxed problem (`condense`), per lane.

Tests and benchmarks judge solvers with these, the library's own and foreign ones. They use the problem, the moves and the
prices, and nothing that a solver says of itself: objective, bound and status are not looked at, and no helper
of the solvers is called. The problem is

    min  sum Q t^2 + sum (A x + b)^2 + sum P x^2 + sum_k soft_k(t_k) + sum_m b_m(x) + sum_g rho_g max(0, violation_g),
    t = theta x + t0,
    lower <= x <= upper,    row_low <= W x <= row_high,

with soft(t) = S e^2 + s e, e = max(|t| - c, 0), the envelope b_m(x) = steep_m max(|x| - m, 0) of integer moves, and one
group g per CV and side. With a price v for every soft row, w for every level of the envelope, p for every CV limit, mu for
every hard row and lambda for every limit of x, a solution has (Boyd and Vandenberghe 2004, 5.5.3)

    2 theta'Q t + 2 A'(A x + b) + 2 P x + theta'(v + p) + sum_m w_m + W'mu + lambda = 0,  v in the subdifferential of soft(t)

A x + b are the distances of MVs from their ideal values (6.20), where they have any. The hard rows W are written out here,
sample by sample; those of the library are products by structure.
"""

from __future__ import annotations

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmpc.problem.condense import CondensedQp
from jaxmpc.problem.instance import QpInstance
from jaxmpc.problem.layout import Size
from jaxmpc.problem.structure import Structure
from jaxmpc.programs.numerics import largest
from jaxmpc.relaxed.problem import QpSolution

LEAST_MOVE = 1e-3  # [scaled moves]: what smaller moves cost is no scale for a residual
SMALLEST = 1e-300


class KktResiduals(eqx.Module):
    """Residuals of one lane, all relative and non-negative; not a number where the moves or prices are none.

    Two scales serve all of them. The *force* scale is the largest gradient of any one term of the objective or any one
    family of prices [objective per scaled move]; the *cost* scale is the objective. Neither is taken smaller than what a
    move of `LEAST_MOVE` would cost by curvature, so that a problem whose optimum is zero has meaningful residuals.

    Attributes:
        stationarity: largest component of the Lagrangian's gradient, over the force scale.
        primal: largest violation of the limits of x and of the hard rows, over max(1, |limit|).
        dual: largest price of the wrong sign, at an infinite limit, beyond s of a row with S = 0, or beyond rho of its CV
            and side, or beyond the slope of the envelope, each as the force it exerts, over the force scale.
        complementarity: largest product of price and distance to a limit, largest rho max(0, violation) - sum p violation
            of a CV and side, largest soft(t) + soft*(v) - v t of a row (Fenchel-Young: zero if and only if v is in the
            subdifferential at t), and the same of the envelope, over the cost scale.
        gap: distance between the objective and the dual objective of these prices (Wolfe), over the cost scale.
    """

    stationarity: Float[Array, ""]
    primal: Float[Array, ""]
    dual: Float[Array, ""]
    complementarity: Float[Array, ""]
    gap: Float[Array, ""]

    @property
    def worst(self) -> Float[Array, ""]:
        """The largest of the five."""
        parts = (self.stationarity, self.primal, self.dual, self.complementarity, self.gap)
        return functools.reduce(jnp.maximum, parts)


class _Prices(eqx.Module):
    """One non-negative vector per family of inequalities if the signs are right; v and w keep their signs."""

    row: Array
    envelope: Array
    high: Array
    low: Array
    lower: Array
    upper: Array
    row_low: Array
    row_high: Array


def dense_rows(structure: Structure, size: Size) -> Float[np.ndarray, "hard n"]:
    """W, MV after MV: positions at the ends of blocks, differences of neighbouring moves, mean-move windows (6.6).

    From the moves of the samples, one after the other. The last position is repeated where blocks are padding; rows of
    padded windows are zero, and nothing limits a row of padding.
    """
    moves, blocks, mvs = np.zeros((structure.control_horizon, size.blocks)), size.blocks, size.mvs
    ends = []
    for b, length in enumerate(structure.blocks):
        begin = sum(structure.blocks[:b])
        moves[begin : begin + (length if structure.blocking == "moves" else 1), b] = 1.0
        ends.append(begin + length - 1)
    position, pair, window = (
        np.zeros((blocks, blocks)),
        np.zeros((blocks, blocks)),
        np.zeros((size.windows, blocks)),
    )
    for b in range(blocks):
        position[b] = moves[: ends[min(b, len(ends) - 1)] + 1].sum(axis=0)
        pair[b, b] = 1.0
        if b:
            pair[b, b - 1] = -1.0
    if structure.mean_move_mode == "predictive":
        for k in range(structure.control_horizon):
            window[k] = moves[max(k + 1 - structure.mean_move_window, 0) : k + 1].sum(axis=0)
    return np.kron(np.eye(mvs), np.concatenate([position, pair, window]))


def kkt_residuals(
    qp: CondensedQp,
    rows: Float[Array, "hard n"] | np.ndarray,
    instance: QpInstance,
    solution: QpSolution,
    lower: Float[Array, " n"] | None = None,
    upper: Float[Array, " n"] | None = None,
) -> KktResiduals:
    """Residuals of one lane (use `jax.vmap` for a batch).

    Args:
        qp: constant part.
        rows: hard rows, `dense_rows`.
        instance: offsets and limits of this sample.
        solution: its moves and prices; everything else in it is ignored.
        lower, upper: limits of x that were solved for; the instance's if not given. Equal limits fix a move.
    """
    lower = instance.lower if lower is None else lower
    upper = instance.upper if upper is None else upper
    limit_price = solution.limit_price
    if not qp.has_limits:  # then the CV limits are no part of the problem
        none = jnp.full_like(instance.offset, jnp.inf)
        instance = eqx.tree_at(lambda i: (i.limit_high, i.limit_low), instance, (none, -none))
        limit_price = limit_price if limit_price.size else jnp.zeros_like(none)
    w_matrix, x = jnp.asarray(rows), solution.x
    t, wx = qp.theta @ x + instance.offset, w_matrix @ x
    prices = _Prices(
        row=solution.row_price,
        envelope=solution.envelope_price,
        high=jnp.maximum(limit_price, 0.0),
        low=jnp.maximum(-limit_price, 0.0),
        lower=solution.lower_price,
        upper=solution.upper_price,
        row_low=solution.row_low_price,
        row_high=solution.row_high_price,
    )
    objective = _objective(qp, instance, x, t)
    flat = _cost_of_a_move(qp, instance)
    cost = jnp.maximum(jnp.abs(objective), flat * LEAST_MOVE**2) + SMALLEST
    forces = _forces(qp, instance, w_matrix, x, t, prices)
    force = jnp.maximum(jnp.max(jnp.abs(forces)), flat * LEAST_MOVE) + SMALLEST
    inequalities = (  # price, room to the limit, limit
        (prices.lower, x - lower, lower),
        (prices.upper, upper - x, upper),
        (prices.row_low, wx - instance.row_low, instance.row_low),
        (prices.row_high, instance.row_high - wx, instance.row_high),
    )
    products = [jnp.where(jnp.isfinite(limit), price * room, 0.0) for price, room, limit in inequalities]
    return KktResiduals(
        stationarity=_largest(jnp.sum(forces, axis=0)) / force,
        primal=_largest(*(_over(room, limit) for _, room, limit in inequalities)),
        dual=_dual_infeasibility(qp, w_matrix, instance, prices, lower, upper) / force,
        complementarity=_largest(
            *products,
            *_limit_products(qp, instance, t, prices),
            _fenchel_young(qp, t, prices.row),
            _fenchel_young_of_envelope(qp, x, prices.envelope),
        )
        / cost,
        gap=jnp.abs(objective - _dual_objective(qp, instance, x, prices, lower, upper)) / cost,
    )


def _ideal(qp: CondensedQp, instance: QpInstance) -> tuple[Float[Array, "row n"], Float[Array, " row"]]:
    """A and b."""
    if qp.ideal is None or instance.distance is None:
        return jnp.zeros((0, qp.scale.shape[0])), jnp.zeros(0)
    mvs, rows, blocks = qp.ideal.by_move.shape
    matrix = qp.ideal.by_move[:, :, None, :] * jnp.eye(mvs)[:, None, :, None]
    offset = qp.ideal.by_distance * instance.distance[:, None]
    return matrix.reshape(mvs * rows, mvs * blocks), offset.reshape(-1)


def _largest(*values):
    """Largest magnitude in some vectors, 0 if all are empty."""
    return largest(jnp.concatenate([jnp.atleast_1d(value) for value in values]))


def _over(room, limit):
    """Relative violation of limits; infinite ones hold."""
    finite = jnp.isfinite(limit)
    size = jnp.maximum(1.0, jnp.abs(jnp.where(finite, limit, 0.0)))
    # a limit that is infinite on the wrong side (lower = inf) can never be met
    return jnp.where(finite, jnp.maximum(-room, 0.0) / size, jnp.where(room < 0.0, jnp.inf, 0.0))


def _soft(qp: CondensedQp, t):
    beyond = jnp.maximum(jnp.abs(t) - qp.deadzone, 0.0)
    return (qp.soft_quadratic * beyond + qp.soft_linear) * beyond


def _soft_conjugate(qp: CondensedQp, price):
    """soft*(v) = c|v| + max(|v| - s, 0)^2 / (4 S); prices that S = 0 forbids count as the largest it allows."""
    bent = qp.soft_quadratic > 0.0
    size = jnp.where(bent, jnp.abs(price), jnp.minimum(jnp.abs(price), qp.soft_linear))
    beyond = jnp.maximum(size - qp.soft_linear, 0.0)
    return qp.deadzone * size + beyond**2 / jnp.where(bent, 4.0 * qp.soft_quadratic, 1.0)


def _fenchel_young(qp: CondensedQp, t, price):
    allowed = jnp.where(qp.soft_quadratic > 0.0, price, jnp.clip(price, -qp.soft_linear, qp.soft_linear))
    return _soft(qp, t) + _soft_conjugate(qp, price) - allowed * t


def _knots(qp: CondensedQp) -> Float[np.ndarray, "level 1"]:
    """Where the slopes of the envelope begin [steps]: 0, 1, 2, ..."""
    return np.arange(float(qp.steep.shape[0]))[:, None]


def _envelope(qp: CondensedQp, x) -> Float[Array, "level n"]:
    return qp.steep * jnp.maximum(jnp.abs(x) - _knots(qp), 0.0)


def _fenchel_young_of_envelope(qp: CondensedQp, x, price):
    allowed = jnp.clip(price, -qp.steep, qp.steep)
    return (_envelope(qp, x) + _knots(qp) * jnp.abs(allowed) - allowed * x).reshape(-1)


def _per_group(qp: CondensedQp, values, reduce):
    return reduce(values.reshape(qp.slack_weight.shape[0], -1), axis=1)


def _limit_products(qp: CondensedQp, instance: QpInstance, t, prices: _Prices):
    """Rho max(0, violation) - sum of price times violation, per CV, for the high and the low sides."""
    found = []
    for price, over in ((prices.high, t - instance.limit_high), (prices.low, instance.limit_low - t)):
        paid = jnp.where(jnp.isfinite(over), price * over, 0.0)
        worst = jnp.maximum(_per_group(qp, over, jnp.max), 0.0)
        found.append(qp.slack_weight * worst - _per_group(qp, paid, jnp.sum))
    return tuple(found)


def _objective(qp: CondensedQp, instance: QpInstance, x, t):
    value = jnp.sum(qp.quadratic * t**2) + jnp.sum(qp.move_weight * x**2) + jnp.sum(_soft(qp, t))
    value += jnp.sum(_envelope(qp, x))
    matrix, off = _ideal(qp, instance)
    value += jnp.sum((matrix @ x + off) ** 2)
    for over in (t - instance.limit_high, instance.limit_low - t):
        value += qp.slack_weight @ jnp.maximum(_per_group(qp, over, jnp.max), 0.0)
    return value


def _dual_objective(qp: CondensedQp, instance: QpInstance, x, prices: _Prices, lower, upper):
    """The Lagrangian less its gradient times x: the dual objective where the gradient vanishes."""
    offset = instance.offset
    value = jnp.sum(qp.quadratic * (offset**2 - (qp.theta @ x) ** 2)) - jnp.sum(qp.move_weight * x**2)
    matrix, off = _ideal(qp, instance)
    value += jnp.sum(off**2 - (matrix @ x) ** 2)
    value += jnp.sum(prices.row * offset - _soft_conjugate(qp, prices.row))
    value -= jnp.sum(_knots(qp) * jnp.minimum(jnp.abs(prices.envelope), qp.steep))
    for price, constant in (
        (prices.high, offset - instance.limit_high),
        (prices.low, instance.limit_low - offset),
        (prices.lower, lower),
        (prices.upper, -upper),
        (prices.row_low, instance.row_low),
        (prices.row_high, -instance.row_high),
    ):
        value += jnp.sum(jnp.where(jnp.isfinite(constant), price * constant, 0.0))
    return value


def _forces(qp: CondensedQp, instance: QpInstance, w_matrix, x, t, prices: _Prices) -> Float[Array, "term n"]:
    """Gradients in x of the terms of the Lagrangian, one row each; their sum is its gradient."""
    net = prices.high - prices.low
    matrix, off = _ideal(qp, instance)
    return jnp.stack(
        [
            (2.0 * qp.quadratic * t) @ qp.theta,
            2.0 * (matrix @ x + off) @ matrix,
            2.0 * qp.move_weight * x,
            prices.row @ qp.theta,
            jnp.sum(prices.envelope, axis=0),
            net @ qp.theta,
            (prices.row_high - prices.row_low) @ w_matrix,
            prices.upper - prices.lower,
        ]
    )


def _cost_of_a_move(qp: CondensedQp, instance: QpInstance) -> Float[Array, ""]:
    """What one scaled move costs at most, alone and away from every deadzone [objective]."""
    theta = jnp.abs(qp.theta)
    bent = (qp.quadratic + qp.soft_quadratic) @ theta**2 + qp.move_weight
    bent += jnp.sum(_ideal(qp, instance)[0] ** 2, axis=0)
    return jnp.max(bent + qp.soft_linear @ theta + jnp.sum(qp.steep, axis=0))


def _dual_infeasibility(qp: CondensedQp, w_matrix, instance: QpInstance, prices: _Prices, lower, upper):
    """Largest force of a price that no solution can have."""

    def wrong(price, limit, reach):
        """Negative prices, and any price where there is no limit."""
        return jnp.where(jnp.isfinite(limit), jnp.maximum(-price, 0.0), jnp.abs(price)) * reach

    reach = jnp.max(jnp.abs(qp.theta), axis=1)
    hard = jnp.max(jnp.abs(w_matrix), axis=1, initial=0.0)
    excess = jnp.maximum(jnp.abs(prices.row) - qp.soft_linear, 0.0)
    found = [
        wrong(prices.lower, lower, 1.0),
        wrong(prices.upper, upper, 1.0),
        wrong(prices.row_low, instance.row_low, hard),
        wrong(prices.row_high, instance.row_high, hard),
        jnp.where(qp.soft_quadratic > 0.0, 0.0, excess) * reach,
        jnp.maximum(jnp.abs(prices.envelope) - qp.steep, 0.0).reshape(-1),
    ]
    for price, limit in ((prices.high, instance.limit_high), (prices.low, instance.limit_low)):
        beyond = jnp.maximum(_per_group(qp, price, jnp.sum) - qp.slack_weight, 0.0)
        found += [wrong(price, limit, reach), beyond * _per_group(qp, reach, jnp.max)]
    return _largest(*found)
