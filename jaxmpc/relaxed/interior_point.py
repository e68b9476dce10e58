"""The batched relaxation: a structured interior-point method for the piecewise-quadratic form of `condense`.

Called by the controllers (continuous moves) and by `integer` (nodes, fixed-integer problems, bounds). One lane is
one problem; `jax.vmap` makes the batch, and lanes may share the dynamic matrix, in which case the assembly
of all Newton matrices is a single matrix product.

Method: Mehrotra's predictor-corrector (Nocedal and Wright 2006, algorithm 16.4) on the problem with its slacks eta and
eps, whose Newton system is reduced by hand to the moves and the eps. Slack rows start feasible and stay so; limits
of moves and positions may start infeasible. Every solve returns a lower bound from its multipliers that is
valid whether it converged or not, see `relaxed_problem.dual_bound`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxmpc.relaxed.problem import RIDGE, TINY, Prepared, Prices, QpSolution, conclude, factorise, substitute

MAX_ITERATIONS = 60
PATIENCE = 15  # iterations without progress after which a lane gives up
TOLERANCE = 1e-9  # of the scaled residuals and of the relative complementarity gap
ACCEPTABLE = 1e-6  # residual up to which a stalled lane still counts as solved
LEAST_WORTH = 1e-6  # objective [solver units] below which the gap is measured against this
ROUNDING = 1e-10  # absolute merit from which rounding may be all that is left
LEAST_PRODUCT, ROOM, STEP = (
    1e-2,
    0.1,
    0.995,
)  # start: least slack * price, least slack; share of the way to the edge


class _State(NamedTuple):
    """Iterate of one lane; slack and price hold all families of inequalities, see `_Layout`."""

    x: Array
    t: Array
    eps: Array
    eta: Array
    slack: Array
    price: Array
    primal: Array
    dual: Array
    iterations: Array
    residual: Array
    best: Array
    best_x: Array
    best_price: Array
    best_residual: Array
    stalled: Array


class _Layout:
    """Where each family of inequalities stands in the vectors of slacks and prices.

    above: eta + c - t, below: eta + c + t, beyond: eta; high: eps_high + limit_high - t, low: eps_low + t - limit_low,
    relief: eps; then the limits of x and the hard rows. All are >= 0 at a solution.
    """

    def __init__(self, rows: int, predictions: int, groups: int, n: int, hard: int):
        sizes = (rows, rows, rows, predictions, predictions, groups, n, n, hard, hard)
        names = (
            "above",
            "below",
            "beyond",
            "high",
            "low",
            "relief",
            "box_low",
            "box_high",
            "row_low",
            "row_high",
        )
        ends = np.cumsum(sizes)
        self.parts = {k: slice(e - size, e) for k, size, e in zip(names, sizes, ends, strict=True)}
        self.sizes: dict[str, int] = dict(zip(names, sizes, strict=True))

    def split(self, vector) -> dict[str, Array]:
        """Families of a vector."""
        return {name: vector[part] for name, part in self.parts.items()}

    def join(self, families: dict[str, Array]):
        """One vector of all families."""
        return jnp.concatenate([families[name] for name in self.parts])


def solve(
    problem: Prepared, *, skip: Bool[Array, ""] | None = None, tolerance: float = TOLERANCE
) -> QpSolution:
    """Solve one lane (use `jax.vmap` for a batch).

    Args:
        problem: the lane.
        skip: do not iterate (the lane is solved already, its result is not used).
        tolerance: of the scaled residuals and the relative gap.

    Returns:
        `QpSolution`, judged by `relaxed_problem.conclude`; its bound is valid whether the lane converged or not.
    """
    p, qp, instance, lower, upper = problem, problem.qp, problem.instance, problem.lower, problem.upper
    n, cvs, rows_count = lower.shape[0], qp.slack_weight.shape[0], qp.response.shape[0]
    all_predictions = instance.limit_high.shape[0]
    predictions = all_predictions if qp.has_limits else 0
    groups = 2 * cvs if qp.has_limits else 0
    horizon = all_predictions // cvs
    w_matrix, unit, keep, free = p.w_matrix, p.unit, p.keep, p.free
    layout = _Layout(rows_count, predictions, groups, n, w_matrix.shape[0])
    fixed_value = jnp.where(free, 0.0, 0.5 * (lower + upper))
    offset, hessian, linear = instance.offset, p.hessian, p.linear
    s2, s1, c, soft = p.curvature, p.steepness, qp.deadzone, p.soft
    rho = jnp.concatenate([qp.slack_weight, qp.slack_weight])[:groups] / unit
    priced = jnp.repeat(rho > 0.0, horizon)
    high_on = jnp.isfinite(instance.limit_high[:predictions]) & priced[:predictions]
    low_on = jnp.isfinite(instance.limit_low[:predictions]) & priced[predictions:]
    relief_on = jnp.any(jnp.concatenate([high_on, low_on]).reshape(groups, -1), axis=1) if groups else high_on
    mask = layout.join(
        {
            "above": soft,
            "below": soft,
            "beyond": soft,
            "high": high_on,
            "low": low_on,
            "relief": relief_on,
            "box_low": free & jnp.isfinite(lower),
            "box_high": free & jnp.isfinite(upper),
            "row_low": jnp.isfinite(p.row_low),
            "row_high": jnp.isfinite(p.row_high),
        }
    )
    count = jnp.maximum(jnp.sum(mask), 1)
    on = layout.split(mask)
    finite = lambda value, where: jnp.where(where, value, 0.0)  # noqa: E731
    limit_high = finite(instance.limit_high[:predictions], high_on)
    limit_low = finite(instance.limit_low[:predictions], low_on)
    box_low, box_high = finite(lower, on["box_low"]), finite(upper, on["box_high"])
    row_low, row_high = finite(p.row_low, on["row_low"]), finite(p.row_high, on["row_high"])

    def per_prediction(values):  # one value per CV and side, spread over the horizon: high sides, low sides
        wide = jnp.repeat(values, horizon) if groups else values
        return wide[:predictions], wide[predictions:]

    def per_group(high, low):
        return jnp.sum(jnp.concatenate([high, low]).reshape(groups, -1), axis=1) if groups else high

    def on_rows(values):  # predictions come first among the rows
        return jnp.concatenate([values, jnp.zeros(rows_count - predictions)])

    def dual_residual(x, price):
        f = layout.split(price)
        net = f["above"] - f["below"] + on_rows(f["high"] - f["low"])
        value = hessian @ x + linear + p.pull(net) + f["box_high"] - f["box_low"]
        return keep * (value + (f["row_high"] - f["row_low"]) @ w_matrix)

    # ---- start: slack rows exactly feasible, prices of eta and eps exactly dual feasible
    x = jnp.where(free, 0.5 * (jnp.clip(lower, -10.0, 10.0) + jnp.clip(upper, -10.0, 10.0)), fixed_value)
    t = p.respond(x) + offset
    reach = jnp.sqrt(qp.row_size) + 1e-12
    eta = jnp.maximum(jnp.abs(t) - c, 0.0) + reach
    inner = jnp.stack([eta + c - t, eta + c + t, eta])
    share = (s2 * eta + s1) / jnp.sum(1.0 / inner, axis=0)
    slack = dict(zip(("above", "below", "beyond"), inner, strict=True))
    price = {name: share / value for name, value in slack.items()}
    y = t[:predictions]
    if groups:
        over = jnp.where(high_on, y - limit_high, -jnp.inf), jnp.where(low_on, limit_low - y, -jnp.inf)
        over = jnp.max(jnp.concatenate(over).reshape(groups, -1), axis=1)
        eps = jnp.maximum(over, 0.0) + jnp.tile(jnp.max(reach[:predictions].reshape(cvs, -1), axis=1), 2)
    else:
        eps = jnp.zeros(0)
    eps_high, eps_low = per_prediction(eps)
    slack |= {"high": eps_high + limit_high - y, "low": eps_low + y - limit_low, "relief": eps}
    safe = {name: jnp.where(on[name], slack[name], 1.0) for name in ("high", "low", "relief")}
    inverse = per_group(finite(1.0 / safe["high"], high_on), finite(1.0 / safe["low"], low_on))
    share = rho / (inverse + 1.0 / safe["relief"])
    share_high, share_low = per_prediction(share)
    price |= {
        "high": share_high / safe["high"],
        "low": share_low / safe["low"],
        "relief": share / safe["relief"],
    }
    wx = x @ w_matrix.T
    room = {
        "box_low": x - box_low,
        "box_high": box_high - x,
        "row_low": wx - row_low,
        "row_high": row_high - wx,
    }
    soft_part = sum(jnp.sum(finite(slack[k] * price[k], on[k])) for k in price)
    typical = jnp.maximum(soft_part / count, LEAST_PRODUCT)
    slack |= {name: jnp.maximum(value, ROOM) for name, value in room.items()}
    price |= {name: typical / slack[name] for name in room}
    slack_vector = jnp.where(mask, layout.join(slack), 1.0)
    price_vector = jnp.where(mask, layout.join(price), 0.0)
    none = {k: jnp.zeros(layout.sizes[k]) for k in layout.parts if k not in room}
    primal = finite(layout.join(none | {name: room[name] - slack[name] for name in room}), mask)
    start = _State(
        x=x,
        t=t,
        eps=eps,
        eta=eta,
        slack=slack_vector,
        price=price_vector,
        primal=primal,
        dual=dual_residual(x, price_vector),
        iterations=jnp.zeros((), dtype=jnp.int32),
        residual=jnp.asarray(jnp.inf) if skip is None else jnp.where(skip, 0.0, jnp.inf),
        best=jnp.asarray(jnp.inf),
        best_x=x,
        best_price=price_vector,
        best_residual=jnp.asarray(jnp.inf),
        stalled=jnp.zeros((), dtype=jnp.int32),
    )

    def iterate(state: _State) -> _State:
        products = state.slack * state.price
        gap = jnp.sum(products)
        mu = gap / count
        weight = state.price / state.slack
        w, prices = layout.split(weight), layout.split(state.price)
        eta_pivot = jnp.where(soft, s2 + w["above"] + w["below"] + w["beyond"], 1.0)
        skew = (w["above"] - w["below"]) / eta_pivot
        row_weight = (w["above"] + w["below"]) * (s2 + w["beyond"]) + 4.0 * w["above"] * w["below"]
        row_weight = row_weight / eta_pivot + on_rows(w["high"] + w["low"])
        matrix = p.newton_matrix(
            row_weight, w["row_low"] + w["row_high"], w["box_low"] + w["box_high"], RIDGE
        )
        if groups:  # eps eliminated last: a border of two columns per CV
            eps_pivot = jnp.where(relief_on, per_group(w["high"], w["low"]) + w["relief"], 1.0)
            signed = jnp.concatenate([w["high"], -w["low"]]).reshape(2, cvs, horizon)
            by_cv = qp.response[:predictions].reshape(cvs, horizon, n)
            cross = jnp.einsum("scj,cjn->scn", signed, by_cv).reshape(groups, n) * qp.scale * keep
            matrix -= cross.T @ (cross / eps_pivot[:, None])
        jacobi = 1.0 / jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), TINY))
        factor = factorise(matrix * jacobi[:, None] * jacobi[None, :] + 1e-14 * jnp.eye(n))
        eta_residual = finite(
            s2 * state.eta + s1 - prices["above"] - prices["below"] - prices["beyond"], soft
        )
        eps_residual = finite(rho - per_group(prices["high"], prices["low"]) - prices["relief"], relief_on)

        def direction(target):
            """Newton direction towards slack * price = target."""
            push_vector = finite(target / state.slack - state.price, mask)
            push = layout.split(push_vector)
            eta_push = push["above"] + push["below"] + push["beyond"] - eta_residual
            row_push = push["above"] - push["below"] - skew * eta_push + on_rows(push["high"] - push["low"])
            shifted = layout.split(push_vector - weight * state.primal)
            rhs = -state.dual - p.pull(row_push) - shifted["box_high"] + shifted["box_low"]
            rhs -= (shifted["row_high"] - shifted["row_low"]) @ w_matrix
            if groups:
                eps_push = per_group(push["high"], push["low"]) + push["relief"] - eps_residual
                rhs += (eps_push / eps_pivot) @ cross
            dx = keep * jacobi * substitute(factor, jacobi * keep * rhs)
            dt = p.respond(dx)
            deta = finite(eta_push / eta_pivot + skew * dt, soft)
            deps = finite((eps_push + cross @ dx) / eps_pivot, relief_on) if groups else state.eps
            deps_high, deps_low = per_prediction(deps)
            dwx = dx @ w_matrix.T
            dslack = layout.join(
                {
                    "above": deta - dt,
                    "below": deta + dt,
                    "beyond": deta,
                    "high": deps_high - dt[:predictions],
                    "low": deps_low + dt[:predictions],
                    "relief": deps,
                    "box_low": dx,
                    "box_high": -dx,
                    "row_low": dwx,
                    "row_high": -dwx,
                }
            )
            dslack = finite(dslack + state.primal, mask)
            return dx, dt, deta, deps, dslack, push_vector - weight * dslack

        def longest(dslack, dprice):
            shrink = jnp.maximum(
                -dslack / state.slack, finite(-dprice / jnp.maximum(state.price, TINY), mask)
            )
            return 1.0 / jnp.maximum(jnp.max(shrink), TINY)

        *_, dslack, dprice = direction(jnp.zeros_like(state.slack))
        alpha = jnp.minimum(longest(dslack, dprice), 1.0)
        affine = jnp.sum((state.slack + alpha * dslack) * (state.price + alpha * dprice))
        sigma = jnp.clip(affine / jnp.maximum(gap, TINY), 0.0, 1.0) ** 3
        dx, dt, deta, deps, dslack, dprice = direction(sigma * mu - dslack * dprice)
        alpha = jnp.minimum(STEP * longest(dslack, dprice), 1.0)
        moved = jnp.all(jnp.isfinite(dx)) & jnp.isfinite(alpha)
        x, t = state.x + alpha * dx, state.t + alpha * dt
        slack = jnp.maximum(state.slack + alpha * dslack, TINY)
        price = jnp.maximum(state.price + alpha * dprice, 0.0)
        primal, dual = (1.0 - alpha) * state.primal, dual_residual(x, price)
        # what the bound can lose: complementarity, and the dual residual over boxes about two units wide
        lost = jnp.sum(slack * price) + 2.0 * jnp.sum(jnp.abs(dual))
        gap = lost / jnp.maximum(p.value(x, t) / unit, LEAST_WORTH)
        worst = jnp.maximum(jnp.maximum(jnp.max(jnp.abs(dual)), jnp.max(jnp.abs(primal))), gap)
        # progress is judged in absolute terms: the relative gap may grow while the objective falls
        merit = lost + jnp.max(jnp.abs(primal))
        better = merit < 0.9 * state.best
        after = _State(
            x=x,
            t=t,
            eps=state.eps + alpha * deps,
            eta=state.eta + alpha * deta,
            slack=slack,
            price=price,
            primal=primal,
            dual=dual,
            iterations=state.iterations + 1,
            residual=worst,
            best=jnp.minimum(merit, state.best),
            best_x=jnp.where(merit < state.best, x, state.best_x),
            best_price=jnp.where(merit < state.best, price, state.best_price),
            best_residual=jnp.where(merit < state.best, worst, state.best_residual),
            stalled=jnp.where(better, 0, state.stalled + 1),
        )
        after = jax.tree.map(lambda new, old: jnp.where(moved, new, old), after, state)
        return after._replace(iterations=jnp.where(moved, after.iterations, MAX_ITERATIONS))

    def unfinished(state: _State):
        patience = jnp.where((state.best < ROUNDING) | (state.best_residual <= ACCEPTABLE), 3, PATIENCE)
        return (state.residual > tolerance) & (state.iterations < MAX_ITERATIONS) & (state.stalled < patience)

    state = jax.lax.while_loop(unfinished, iterate, start)
    # rounding can undo the last iterations of a degenerate problem: the best one is returned
    x = jnp.where(free, jnp.clip(state.best_x, lower, upper), fixed_value)
    price = layout.split(unit * state.best_price)
    prices = Prices(
        row=price["above"] - price["below"],
        hard=price["row_high"] - price["row_low"],
        limit=price["high"] - price["low"],
    )
    return conclude(p, x, prices, state.iterations)
