"""A warm start finished exactly: semismooth Newton on the augmented Lagrangian of the relaxed problem.

With the prices of a neighbouring problem (the previous sample, the parent node) most rows are already known to be inside,
outside or at the edge of their deadzone, and most limits to be active or not. Every row becomes a proximal
term with its price (Hermans, Themelis and Patrinos 2022, QPALM), whose gradient is piecewise linear, so that a Newton step
is exact as soon as the classification is right. What is returned is judged by its own duality gap;
`integer` and the controllers solve with the interior point of `qp` when that is not closed. CV limits that are reached
are left to the interior point, too.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmpc.condense import CondensedQp, QpInstance
from jaxmpc.relaxed_problem import FIXED, TINY, QpSolution, dual_bound, evaluate, solver_unit, weighted_gram
from jaxmpc.status import FAILED, OPTIMAL

STEPS = 14  # Newton steps after which a start is given up
PENALTY = 1e4  # curvature of a proximal term against the largest of the Hessian
CLOSED = 1e-9  # relative duality gap of a finished solve
FEASIBLE = 1e-8  # hard rows and limits, in scaled moves
LEAST_SHARE = 1e-7  # of the solver unit: objectives below it have their gap measured against it
SEARCHES = 6  # secant steps of the line search


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


class _State(NamedTuple):
    x: Array
    row_price: Array
    box_price: Array
    hard_price: Array
    steps: Array
    done: Array


def refine(
    qp: CondensedQp,
    rows: Float[Array, "hard n"] | np.ndarray,
    instance: QpInstance,
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    start: WarmStart,
    *,
    skip: Bool[Array, ""] | None = None,
) -> QpSolution:
    """Solve one relaxed problem from a start; arguments and result as `qp.solve`.

    The status is `OPTIMAL` only if the duality gap is closed and the hard rows hold; otherwise solve anew.
    """
    w_matrix = jnp.asarray(rows)
    offset = instance.offset
    unit = solver_unit(qp, instance)
    hessian, linear = qp.hessian / unit, 2.0 * ((qp.quadratic * offset) @ qp.theta) / unit
    s2, s1, c = 2.0 * qp.soft_quadratic / unit, qp.soft_linear / unit, qp.deadzone
    soft = (s2 + s1) > 0.0
    free = (upper - lower) > FIXED
    keep = free.astype(lower.dtype)
    takes_part = (jnp.abs(w_matrix) @ keep) > 0.0
    row_low = jnp.where(takes_part, instance.row_low, -jnp.inf)
    row_high = jnp.where(takes_part, instance.row_high, jnp.inf)
    row_sigma = PENALTY / jnp.maximum(jnp.sum(qp.theta**2, axis=1), TINY)
    hard_sigma = PENALTY / jnp.maximum(jnp.sum(w_matrix**2, axis=1), TINY)
    gram = weighted_gram(qp)

    def row_prox(t, price):
        """New price of a deadzone row and its slope in t."""
        q = t + price / row_sigma
        beyond = jnp.abs(q) - c
        edge = beyond <= s1 / row_sigma
        outside = row_sigma * (s2 * beyond + s1) / (row_sigma + s2)
        new = jnp.where(beyond <= 0.0, 0.0, jnp.where(edge, row_sigma * beyond, outside)) * jnp.sign(q)
        slope = jnp.where(beyond <= 0.0, 0.0, jnp.where(edge, row_sigma, s2 * row_sigma / (row_sigma + s2)))
        return jnp.where(soft, new, 0.0), jnp.where(soft, slope, 0.0)

    def interval_prox(value, price, low, high, sigma):
        q = value + price / sigma
        away = jnp.where(q > high, q - high, jnp.where(q < low, q - low, 0.0))
        return sigma * away, jnp.where(away != 0.0, sigma, 0.0)

    def gradient_of(x, t, w, state):
        row, row_slope = row_prox(t, state.row_price)
        box, box_slope = interval_prox(x, state.box_price, lower, upper, PENALTY)
        hard, hard_slope = interval_prox(w, state.hard_price, row_low, row_high, hard_sigma)
        gradient = keep * (hessian @ x + linear + row @ qp.theta + box + hard @ w_matrix)
        return gradient, (row, box, hard), (row_slope, box_slope, hard_slope)

    def step(state: _State) -> _State:
        x = state.x
        t, w = qp.theta @ x + offset, w_matrix @ x
        gradient, _, (row_slope, box_slope, hard_slope) = gradient_of(x, t, w, state)
        matrix = hessian + gram(row_slope) + jnp.diag(box_slope)
        matrix += w_matrix.T @ (hard_slope[:, None] * w_matrix)
        matrix = matrix * keep[:, None] * keep[None, :] + jnp.diag(1.0 - keep + 1e-11)
        dx = -keep * jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), gradient)
        dt, dw = qp.theta @ dx, w_matrix @ dx
        along0 = gradient @ dx
        hdx, hx = hessian @ dx, hessian @ x + linear

        def along(alpha):  # derivative of the merit along dx, increasing in alpha
            row, _ = row_prox(t + alpha * dt, state.row_price)
            box, _ = interval_prox(x + alpha * dx, state.box_price, lower, upper, PENALTY)
            hard, _ = interval_prox(w + alpha * dw, state.hard_price, row_low, row_high, hard_sigma)
            return (hx + alpha * hdx) @ dx + row @ dt + (keep * box) @ dx + hard @ dw

        def secant(_, bracket):
            low, high, d_low, d_high = bracket
            alpha = jnp.clip(
                low - d_low * (high - low) / jnp.where(d_high > d_low, d_high - d_low, 1.0), low, high
            )
            alpha = jnp.where(d_high > d_low, alpha, high)
            value = along(alpha)
            right = value > 0.0
            # Illinois rule: the end that stays gets half its slope, so that both ends move
            return (
                jnp.where(right, low, alpha),
                jnp.where(right, alpha, high),
                jnp.where(right, 0.5 * d_low, value),
                jnp.where(right, value, 0.5 * d_high),
            )

        at_one = along(1.0)
        whole = at_one <= 1e-2 * jnp.abs(along0)
        searched = jax.lax.fori_loop(0, SEARCHES, secant, (jnp.zeros(()), jnp.ones(()), along0, at_one))
        alpha = jnp.where(whole, 1.0, jnp.where(searched[0] > 0.0, searched[0], searched[1]))
        x = x + alpha * dx
        t, w = t + alpha * dt, w + alpha * dw
        gradient, (row, box, hard), _ = gradient_of(x, t, w, state)
        settled = jnp.max(jnp.abs(gradient)) < 1e-7 * (1.0 + jnp.max(jnp.abs(linear)))
        change = jnp.maximum(
            jnp.max(jnp.abs(row - state.row_price) / row_sigma * jnp.sqrt(row_sigma)),
            jnp.max(jnp.abs(box - state.box_price)) / jnp.sqrt(PENALTY),
        )
        if w_matrix.shape[0]:
            change = jnp.maximum(change, jnp.max(jnp.abs(hard - state.hard_price) / jnp.sqrt(hard_sigma)))
        exact = jnp.max(jnp.abs(gradient)) < 1e-11 * (1.0 + jnp.max(jnp.abs(linear)))
        pick = lambda new, old: jnp.where(settled, new, old)  # noqa: E731
        good = jnp.all(jnp.isfinite(x))
        return _State(
            x=jnp.where(good, x, state.x),
            row_price=pick(row, state.row_price),
            box_price=pick(box, state.box_price),
            hard_price=pick(hard, state.hard_price),
            steps=jnp.where(good, state.steps + 1, STEPS),
            done=exact & (change < 1e-9),
        )

    scaled = _State(
        x=jnp.where(free, jnp.clip(start.x, lower, upper), 0.5 * (lower + upper)),
        row_price=jnp.where(soft, start.row_price / unit, 0.0),
        box_price=keep * start.box_price / unit,
        hard_price=jnp.where(takes_part, start.hard_price / unit, 0.0),
        steps=jnp.zeros((), dtype=jnp.int32),
        done=jnp.asarray(False) if skip is None else skip,
    )
    state = jax.lax.while_loop(lambda s: ~s.done & (s.steps < STEPS), step, scaled)
    x = jnp.clip(state.x, lower, upper)
    zero = jnp.zeros(instance.limit_high.shape[0])
    solution = QpSolution(
        x=x,
        objective=evaluate(qp, instance, x),
        bound=jnp.asarray(-jnp.inf),
        status=jnp.asarray(FAILED),
        iterations=state.steps,
        row_price=unit * state.row_price,
        limit_price=zero,
        lower_price=unit * jnp.maximum(-state.box_price, 0.0),
        upper_price=unit * jnp.maximum(state.box_price, 0.0),
        row_low_price=unit * jnp.maximum(-state.hard_price, 0.0),
        row_high_price=unit * jnp.maximum(state.hard_price, 0.0),
        residual=jnp.zeros(()),
    )
    none = zero if qp.has_limits else zero[:0]
    solution = dual_bound(qp, w_matrix, instance, solution, lower, upper, none, none)
    return certified(qp, w_matrix, instance, solution, lower, upper, CLOSED)


def certified(qp, rows, instance: QpInstance, solution: QpSolution, lower, upper, gap: float) -> QpSolution:
    """Judge a solution by its own bound and the hard rows; sets status and residual.

    Args:
        qp: constant part.
        rows: hard rows.
        instance: offsets and limits.
        solution: with its bound.
        lower, upper: limits of x.
        gap: relative duality gap up to which the status is `OPTIMAL`.
    """
    least = LEAST_SHARE * solver_unit(qp, instance)
    found = (solution.objective - solution.bound) / jnp.maximum(jnp.abs(solution.objective), least)
    takes_part = (jnp.abs(jnp.asarray(rows)) @ (upper - lower > FIXED).astype(lower.dtype)) > 0.0
    w = jnp.asarray(rows) @ solution.x
    over = jnp.where(takes_part, jnp.maximum(w - instance.row_high, instance.row_low - w), -jnp.inf)
    broken = jnp.max(over, initial=0.0)
    good = (found <= gap) & (broken <= FEASIBLE) & ~jnp.any(lower > upper + FIXED)
    return eqx.tree_at(
        lambda s: (s.status, s.residual),
        solution,
        (jnp.where(good, OPTIMAL, FAILED), jnp.maximum(found, broken)),
    )
