"""The batched relaxation: a structured interior-point method for the piecewise-quadratic form of `condense`.

Called by the controllers (continuous moves) and by `integer` (nodes, fixed-integer problems, bounds). One lane is
one problem; `jax.vmap` makes the batch, and lanes may share the dynamic matrix, in which case the assembly
of all Newton matrices is a single matrix product.

Method: Mehrotra's predictor-corrector (Nocedal and Wright 2006, algorithm 16.4) on the problem with its slacks eta and
eps, whose Newton system is reduced by hand to the moves and the eps. Slack rows start feasible and stay so; limits
of moves and positions may start infeasible. Every solve returns a lower bound from its multipliers that is
valid whether it converged or not, see `_dual_bound`.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmpc.condense import CondensedQp, QpInstance
from jaxmpc.status import FAILED, OPTIMAL

MAX_ITERATIONS = 60
TOLERANCE = 1e-9  # of the scaled residuals and of the complementarity
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
    return rows + own + jnp.sum(_limit_cost(qp, instance, t))


def _limit_cost(qp: CondensedQp, instance: QpInstance, t):
    """rho times the largest violation per CV and side, high sides first."""
    if not qp.has_limits:
        return jnp.zeros(1)
    cvs = qp.slack_weight.shape[0]
    y = t[: instance.limit_high.shape[0]]
    over = jnp.max((y - instance.limit_high).reshape(cvs, -1), axis=1)
    under = jnp.max((instance.limit_low - y).reshape(cvs, -1), axis=1)
    rho = jnp.concatenate([qp.slack_weight, qp.slack_weight])
    return rho * jnp.maximum(jnp.concatenate([over, under]), 0.0)


class _Rows(NamedTuple):
    """One family of inequalities: slack, multiplier, and which rows take part."""

    slack: Array
    price: Array


class _State(NamedTuple):
    x: Array
    eps: Array
    eta: Array
    above: _Rows  # eta + c - t >= 0
    below: _Rows  # eta + c + t >= 0
    beyond: _Rows  # eta >= 0
    high: _Rows  # eps_high + limit_high - t >= 0
    low: _Rows  # eps_low + t - limit_low >= 0
    slack: _Rows  # eps >= 0
    box_low: _Rows
    box_high: _Rows
    row_low: _Rows
    row_high: _Rows
    iterations: Array
    residual: Array
    best: Array
    stalled: Array


FAMILIES = ("above", "below", "beyond", "high", "low", "slack", "box_low", "box_high", "row_low", "row_high")


def solve(
    qp: CondensedQp,
    rows: np.ndarray,
    instance: QpInstance,
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    start: Float[Array, " n"] | None = None,
) -> QpSolution:
    """Solve one relaxed problem (one lane; use `jax.vmap` for a batch).

    Args:
        qp: constant part.
        rows: hard rows, `blocking.hard_rows(structure)` ("hard n").
        instance: offsets and limits of this sample.
        lower, upper: limits of x that replace the instance's (a search tightens them); equal limits fix a move.
        start: moves to start from, for example the previous plan shifted; need not be feasible.

    Returns:
        `QpSolution`; a lane that did not converge has status `FAILED` and still a valid bound.
    """
    n, cvs = lower.shape[0], qp.slack_weight.shape[0]
    predictions = instance.limit_high.shape[0]
    free = (upper - lower) > FIXED
    fixed_value = jnp.where(free, 0.0, 0.5 * (lower + upper))
    w_matrix = jnp.asarray(rows)
    # rows without free moves are constants and leave the solver; feasibility of the whole is checked outside
    takes_part = (jnp.abs(w_matrix) @ free.astype(float)) > 0.0
    own_quadratic = qp.hessian
    offset = instance.offset
    scale = jnp.maximum(jnp.max(jnp.diagonal(qp.curvature)), 1e-12)
    gradient0 = 2.0 * (qp.quadratic * offset) @ qp.theta
    scale = jnp.maximum(scale, 1e-2 * jnp.max(jnp.abs(gradient0)))
    hessian = own_quadratic / scale
    linear = gradient0 / scale
    s2, s1, c = 2.0 * qp.soft_quadratic / scale, qp.soft_linear / scale, qp.deadzone
    active_soft = (s2 + s1) > 0.0
    rho = jnp.concatenate([qp.slack_weight, qp.slack_weight]) / scale
    masks = {
        "above": active_soft,
        "below": active_soft,
        "beyond": active_soft,
        "box_low": free & jnp.isfinite(lower),
        "box_high": free & jnp.isfinite(upper),
        "row_low": takes_part & jnp.isfinite(instance.row_low),
        "row_high": takes_part & jnp.isfinite(instance.row_high),
    }
    if qp.has_limits:
        rho_rows = jnp.repeat(rho, predictions // cvs)
        masks["high"] = jnp.isfinite(instance.limit_high) & (rho_rows[:predictions] > 0.0)
        masks["low"] = jnp.isfinite(instance.limit_low) & (rho_rows[predictions:] > 0.0)
        masks["slack"] = jnp.any(jnp.concatenate([masks["high"], masks["low"]]).reshape(2 * cvs, -1), axis=1)
    else:
        masks["high"] = masks["low"] = jnp.zeros(0, dtype=bool)
        masks["slack"] = jnp.zeros(0, dtype=bool)
    count = jnp.maximum(sum(jnp.sum(mask) for mask in masks.values()), 1)
    groups = (2 * cvs, predictions // cvs)
    limit_high = jnp.where(masks["high"], instance.limit_high, 0.0) if qp.has_limits else jnp.zeros(0)
    limit_low = jnp.where(masks["low"], instance.limit_low, 0.0) if qp.has_limits else jnp.zeros(0)
    box_low = jnp.where(masks["box_low"], lower, 0.0)
    box_high = jnp.where(masks["box_high"], upper, 0.0)
    row_low = jnp.where(masks["row_low"], instance.row_low, 0.0)
    row_high = jnp.where(masks["row_high"], instance.row_high, 0.0)
    pairs = np.triu_indices(n)
    back = np.zeros((n, n), dtype=np.int32)
    back[pairs] = np.arange(len(pairs[0]))
    back = np.maximum(back, back.T)

    def gram(weights):
        if qp.packed is not None:
            return jnp.take(weights @ qp.packed, back.reshape(-1)).reshape(n, n)
        return qp.theta.T @ (weights[:, None] * qp.theta)

    def predictions_of(vector):
        return vector[:predictions]

    def gather(price_high, price_low):  # net price on all rows of theta
        if not qp.has_limits:
            return jnp.zeros(qp.theta.shape[0])
        return jnp.concatenate([price_high - price_low, jnp.zeros(qp.theta.shape[0] - predictions)])

    def by_group(high, low):
        return jnp.concatenate([high, low]).reshape(groups)

    # ---- start: slack rows exactly feasible, eta and eps with dual-feasible prices
    middle = 0.5 * (jnp.clip(lower, -10.0, 10.0) + jnp.clip(upper, -10.0, 10.0))
    x = middle if start is None else 0.8 * jnp.clip(start, lower, upper) + 0.2 * jnp.clip(middle, lower, upper)
    x = jnp.where(free, x, fixed_value)
    t = qp.theta @ x + offset
    reach = 0.1 * jnp.sqrt(jnp.sum(qp.theta**2, axis=1)) + 1e-12
    eta = jnp.maximum(jnp.abs(t) - c, 0.0) + reach
    slack3 = (eta + c - t, eta + c + t, eta)
    total = s2 * eta + s1
    share = total / sum(1.0 / s for s in slack3)
    families = {
        name: _Rows(jnp.where(active_soft, s, 1.0), jnp.where(active_soft, share / s, 0.0))
        for name, s in zip(("above", "below", "beyond"), slack3, strict=True)
    }
    if qp.has_limits:
        y = predictions_of(t)
        over = jnp.max(by_group(jnp.where(masks["high"], y - limit_high, -jnp.inf), jnp.where(masks["low"], limit_low - y, -jnp.inf)), axis=1)
        reach_group = jnp.max(by_group(predictions_of(reach), predictions_of(reach)), axis=1) * 10.0
        eps = jnp.where(masks["slack"], jnp.maximum(over, 0.0) + reach_group, 0.0)
        eps_rows = jnp.repeat(eps, groups[1])
        s_high = jnp.where(masks["high"], eps_rows[:predictions] + limit_high - y, 1.0)
        s_low = jnp.where(masks["low"], eps_rows[predictions:] + y - limit_low, 1.0)
        inverse = by_group(jnp.where(masks["high"], 1.0 / s_high, 0.0), jnp.where(masks["low"], 1.0 / s_low, 0.0))
        share_group = rho / (jnp.sum(inverse, axis=1) + 1.0 / jnp.where(masks["slack"], eps, 1.0))
        share_rows = jnp.repeat(share_group, groups[1])
        families["high"] = _Rows(s_high, jnp.where(masks["high"], share_rows[:predictions] / s_high, 0.0))
        families["low"] = _Rows(s_low, jnp.where(masks["low"], share_rows[predictions:] / s_low, 0.0))
        families["slack"] = _Rows(
            jnp.where(masks["slack"], eps, 1.0), jnp.where(masks["slack"], share_group / jnp.where(masks["slack"], eps, 1.0), 0.0)
        )
    else:
        eps = jnp.zeros(0)
        families |= dict.fromkeys(("high", "low", "slack"), _Rows(jnp.zeros(0), jnp.zeros(0)))
    typical = jnp.maximum(sum(jnp.sum(f.slack * f.price) for f in families.values()) / count, 1e-2)
    wx = w_matrix @ x
    for name, room in (
        ("box_low", x - box_low),
        ("box_high", box_high - x),
        ("row_low", wx - row_low),
        ("row_high", row_high - wx),
    ):
        room = jnp.maximum(room, 0.1)
        families[name] = _Rows(jnp.where(masks[name], room, 1.0), jnp.where(masks[name], typical / room, 0.0))
    state = _State(
        x=x,
        eps=eps,
        eta=eta,
        iterations=jnp.zeros((), dtype=jnp.int32),
        residual=jnp.asarray(jnp.inf),
        best=jnp.asarray(jnp.inf),
        stalled=jnp.zeros((), dtype=jnp.int32),
        **families,
    )

    def residuals(state: _State):
        t_price = state.above.price - state.below.price + gather(state.high.price, state.low.price)
        dual = hessian @ state.x + linear + t_price @ qp.theta
        dual += state.box_high.price - state.box_low.price
        dual += (state.row_high.price - state.row_low.price) @ w_matrix
        dual = jnp.where(free, dual, 0.0)
        wx = w_matrix @ state.x
        primal = {
            "box_low": state.x - box_low - state.box_low.slack,
            "box_high": box_high - state.x - state.box_high.slack,
            "row_low": wx - row_low - state.row_low.slack,
            "row_high": row_high - wx - state.row_high.slack,
        }
        primal = {name: jnp.where(masks[name], value, 0.0) for name, value in primal.items()}
        return dual, primal

    def iterate(state: _State) -> _State:
        dual, primal = residuals(state)
        weight = {
            name: jnp.where(masks[name], getattr(state, name).price / getattr(state, name).slack, 0.0)
            for name in FAMILIES
        }
        gap = sum(jnp.sum(jnp.where(masks[name], getattr(state, name).slack * getattr(state, name).price, 0.0)) for name in FAMILIES)
        mu = gap / count
        eta_pivot = jnp.where(active_soft, s2 + weight["above"] + weight["below"] + weight["beyond"], 1.0)
        both = weight["above"] + weight["below"]
        skew = (weight["above"] - weight["below"]) / eta_pivot
        row_weight = (both * (s2 + weight["beyond"]) + 4.0 * weight["above"] * weight["below"]) / eta_pivot
        if qp.has_limits:
            row_weight = row_weight.at[:predictions].add(weight["high"] + weight["low"])
            sums = by_group(weight["high"], weight["low"])
            eps_pivot = jnp.where(masks["slack"], jnp.sum(sums, axis=1) + weight["slack"], 1.0)
            half = predictions // cvs
            by_cv = predictions_of(qp.theta).reshape(cvs, half, n)
            signed = sums.reshape(2, cvs, half) * jnp.asarray([1.0, -1.0])[:, None, None]
            cross = jnp.einsum("scj,cjn->scn", signed, by_cv).reshape(2 * cvs, n)
        matrix = hessian + gram(row_weight)
        matrix += w_matrix.T @ ((weight["row_low"] + weight["row_high"])[:, None] * w_matrix)
        diagonal = weight["box_low"] + weight["box_high"]
        matrix = matrix + jnp.diag(diagonal)
        if qp.has_limits:  # eps eliminated last: a border of two columns per CV
            matrix = matrix - cross.T @ (cross / eps_pivot[:, None])
        keep = free.astype(float)
        matrix = matrix * keep[:, None] * keep[None, :] + jnp.diag(1.0 - keep + 1e-11)
        jacobi = 1.0 / jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), TINY))
        factor = jnp.linalg.cholesky(matrix * jacobi[:, None] * jacobi[None, :] + 1e-14 * jnp.eye(n))

        def direction(target):
            """Newton direction for complementarity targets, target[name] = wanted slack * price."""
            push = {
                name: jnp.where(masks[name], target[name] / getattr(state, name).slack - getattr(state, name).price, 0.0)
                for name in FAMILIES
            }
            eta_residual = jnp.where(
                active_soft, s2 * state.eta + s1 - state.above.price - state.below.price - state.beyond.price, 0.0
            )
            eta_push = push["above"] + push["below"] + push["beyond"] - eta_residual
            row_push = push["above"] - push["below"] - skew * eta_push
            if qp.has_limits:
                row_push = row_push.at[:predictions].add(push["high"] - push["low"])
                eps_residual = jnp.where(
                    masks["slack"], rho - jnp.sum(by_group(state.high.price, state.low.price), axis=1) - state.slack.price, 0.0
                )
                eps_push = jnp.sum(by_group(push["high"], push["low"]), axis=1) + push["slack"] - eps_residual
            rhs = -dual - row_push @ qp.theta
            shifted = {
                name: push[name] - weight[name] * primal[name] for name in ("box_low", "box_high", "row_low", "row_high")
            }
            rhs -= shifted["box_high"] - shifted["box_low"]
            rhs -= (shifted["row_high"] - shifted["row_low"]) @ w_matrix
            if qp.has_limits:
                rhs += (eps_push / eps_pivot) @ cross
            rhs = jnp.where(free, rhs, 0.0)
            dx = jacobi * jax.scipy.linalg.cho_solve((factor, True), jacobi * rhs)
            dx = jnp.where(free, dx, 0.0)
            dt = qp.theta @ dx
            deta = jnp.where(active_soft, eta_push / eta_pivot + skew * dt, 0.0)
            dslack = {"above": deta - dt, "below": deta + dt, "beyond": deta}
            if qp.has_limits:
                deps = jnp.where(masks["slack"], (eps_push + cross @ dx) / eps_pivot, 0.0)
                deps_rows = jnp.repeat(deps, groups[1])
                dslack |= {
                    "high": deps_rows[:predictions] - predictions_of(dt),
                    "low": deps_rows[predictions:] + predictions_of(dt),
                    "slack": deps,
                }
            else:
                deps = jnp.zeros(0)
                dslack |= dict.fromkeys(("high", "low", "slack"), jnp.zeros(0))
            dwx = w_matrix @ dx
            dslack |= {
                "box_low": dx + primal["box_low"],
                "box_high": -dx + primal["box_high"],
                "row_low": dwx + primal["row_low"],
                "row_high": -dwx + primal["row_high"],
            }
            dslack = {name: jnp.where(masks[name], value, 0.0) for name, value in dslack.items()}
            dprice = {name: push[name] - weight[name] * dslack[name] for name in FAMILIES}
            return dx, deta, deps, dslack, dprice

        def longest(dslack, dprice):
            ratio = jnp.zeros(())
            for name in FAMILIES:
                family = getattr(state, name)
                if family.slack.shape[0]:
                    ratio = jnp.maximum(ratio, jnp.max(-dslack[name] / family.slack))
                    ratio = jnp.maximum(ratio, jnp.max(jnp.where(masks[name], -dprice[name] / jnp.maximum(family.price, TINY), 0.0)))
            return 1.0 / jnp.maximum(ratio, TINY)

        zero = {name: jnp.zeros_like(getattr(state, name).slack) for name in FAMILIES}
        _, _, _, dslack, dprice = direction(zero)
        alpha = jnp.minimum(longest(dslack, dprice), 1.0)
        affine = sum(
            jnp.sum(
                jnp.where(
                    masks[name],
                    (getattr(state, name).slack + alpha * dslack[name]) * (getattr(state, name).price + alpha * dprice[name]),
                    0.0,
                )
            )
            for name in FAMILIES
        )
        sigma = jnp.clip(affine / jnp.maximum(gap, TINY), 0.0, 1.0) ** 3
        target = {name: sigma * mu - dslack[name] * dprice[name] for name in FAMILIES}
        dx, deta, deps, dslack, dprice = direction(target)
        alpha = jnp.minimum(0.995 * longest(dslack, dprice), 1.0)
        moved = {
            name: _Rows(
                jnp.maximum(getattr(state, name).slack + alpha * dslack[name], TINY),
                jnp.maximum(getattr(state, name).price + alpha * dprice[name], 0.0),
            )
            for name in FAMILIES
        }
        finite = jnp.all(jnp.isfinite(dx)) & jnp.isfinite(alpha)
        after = _State(
            x=state.x + alpha * dx,
            eps=state.eps + alpha * deps,
            eta=state.eta + alpha * deta,
            iterations=state.iterations + 1,
            residual=state.residual,
            best=state.best,
            stalled=state.stalled,
            **moved,
        )
        after = jax.tree.map(lambda new, old: jnp.where(finite, new, old), after, state)
        dual, primal = residuals(after)
        worst = jnp.max(jnp.abs(dual))
        for value in primal.values():
            if value.shape[0]:
                worst = jnp.maximum(worst, jnp.max(jnp.abs(value)))
        gap = sum(jnp.sum(jnp.where(masks[name], getattr(after, name).slack * getattr(after, name).price, 0.0)) for name in FAMILIES)
        worth = jnp.abs(evaluate(qp, instance, after.x)) / scale
        worst = jnp.maximum(worst, gap / jnp.maximum(worth, 1e-6))
        better = worst < 0.9 * state.best
        return after._replace(
            iterations=jnp.where(finite, state.iterations + 1, MAX_ITERATIONS),
            residual=worst,
            best=jnp.where(better, worst, state.best),
            stalled=jnp.where(better, 0, state.stalled + 1),
        )

    state = jax.lax.while_loop(
        lambda s: (s.residual > TOLERANCE) & (s.iterations < MAX_ITERATIONS) & (s.stalled < 8), iterate, state
    )
    x = jnp.clip(state.x, lower, upper)
    x = jnp.where(free, x, fixed_value)
    price = scale * (state.above.price - state.below.price)
    high, low = scale * state.high.price, scale * state.low.price
    pair = lambda name: jnp.where(masks[name], scale * getattr(state, name).price, 0.0)  # noqa: E731
    solution = QpSolution(
        x=x,
        objective=evaluate(qp, instance, x),
        bound=jnp.asarray(-jnp.inf),
        status=jnp.where(state.residual <= 1e-6, OPTIMAL, FAILED),
        iterations=state.iterations,
        row_price=price,
        limit_price=jnp.zeros(predictions),
        lower_price=pair("box_low"),
        upper_price=pair("box_high"),
        row_low_price=pair("row_low"),
        row_high_price=pair("row_high"),
        residual=state.residual,
    )
    return _dual_bound(qp, w_matrix, instance, solution, lower, upper, high, low)


def _dual_bound(qp, w_matrix, instance, solution, lower, upper, high, low):
    """Lagrangian lower bound with prices made dual feasible, and the prices that were used.

    soft(t) >= v t - soft*(v) with soft*(v) = c|v| + max(|v| - s, 0)^2 / (4 S); rho max(0, w) >= sum of p w for
    p >= 0 with sum p <= rho. What is left of the gradient in x is covered by the box of x, or by its curvature.
    """
    s2, s1 = qp.soft_quadratic, qp.soft_linear
    price = jnp.where(s2 > 0, solution.row_price, jnp.clip(solution.row_price, -s1, s1))
    beyond = jnp.maximum(jnp.abs(price) - s1, 0.0)
    conjugate = qp.deadzone * jnp.abs(price) + jnp.where(s2 > 0, beyond**2 / jnp.where(s2 > 0, 4.0 * s2, 1.0), 0.0)
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
