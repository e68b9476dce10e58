"""Relaxed problems (`condense`) solved by other people's QP solvers, with every slack as a variable of its own."""

from __future__ import annotations

import contextlib

import clarabel
import jax.numpy as jnp
import numpy as np
import piqp
import scipy.sparse as sp

from jaxmpc.problem.condense import CondensedQp
from jaxmpc.problem.instance import QpInstance
from jaxmpc.relaxed.problem import QpSolution


def solution_of(x, row, envelope, limit, lower, upper, row_low, row_high) -> QpSolution:
    """Moves and prices alone; everything that a solver would say of itself is not a number."""
    nothing = jnp.asarray(jnp.nan)
    prices = row, envelope, np.zeros(0), limit, lower, upper, row_low, row_high
    as_arrays = (jnp.asarray(v, dtype=float) for v in prices)
    return QpSolution(
        jnp.asarray(x, dtype=float), nothing, nothing, jnp.asarray(-1), jnp.asarray(0), *as_arrays, nothing
    )


def inequalities(qp: CondensedQp, rows: np.ndarray, instance: QpInstance):
    """The problem with its slacks: min z'Pz/2 + q'z, Gz <= h, over moves, eta, envelope and eps.

    Returns:
        ``(P, q, parts, soft, whole)``: by name the rows of each family; which predictions have an eta, and which levels
        ``(level, move)`` of the envelope a variable.
    """
    theta, t0 = np.asarray(qp.theta), np.asarray(instance.offset)
    n, cvs, predictions = theta.shape[1], len(qp.slack_weight), len(t0)
    steep, rho = np.asarray(qp.steep), np.asarray(qp.slack_weight)
    soft = np.flatnonzero((np.asarray(qp.soft_quadratic) > 0) | (np.asarray(qp.soft_linear) > 0))
    whole = np.nonzero(steep > 0)
    paid = np.repeat(rho > 0, predictions // cvs)
    high, low = (
        np.where(paid, np.asarray(limit), absent) if qp.has_limits else np.full(predictions, absent)
        for limit, absent in ((instance.limit_high, np.inf), (instance.limit_low, -np.inf))
    )
    sizes = n, len(soft), len(whole[0]), cvs, cvs
    weight = np.asarray(qp.quadratic)
    smooth = 2 * theta.T @ (weight[:, None] * theta) + 2 * np.diag(qp.move_weight)
    rest = sp.csc_matrix((sum(sizes[2:]),) * 2)
    P = sp.block_diag([smooth, sp.diags(2 * np.asarray(qp.soft_quadratic)[soft]), rest], format="csc")
    linear = 2 * (weight * t0) @ theta
    q = np.concatenate([linear, np.asarray(qp.soft_linear)[soft], steep[whole], rho, rho])

    def columns(**parts):
        """Rows with these blocks; the others are zero."""
        count = next(iter(parts.values())).shape[0]
        names = ("x", "eta", "own", "over", "under")
        wide = [parts.get(k, sp.csr_matrix((count, size))) for k, size in zip(names, sizes, strict=True)]
        return sp.hstack([sp.csr_matrix(part) for part in wide], format="csr")

    member = np.repeat(np.eye(cvs), predictions // cvs, axis=0)
    eta, own, eps, box = (sp.identity(size, format="csr") for size in (*sizes[1:4], n))
    picked, knot, c = box[whole[1]], whole[0].astype(float), np.asarray(qp.deadzone)[soft]
    parts = {
        "above": (columns(x=theta[soft], eta=-eta), c - t0[soft]),
        "below": (columns(x=-theta[soft], eta=-eta), c + t0[soft]),
        "eta": (columns(eta=-eta), np.zeros(len(soft))),
        "rising": (columns(x=picked, own=-own), knot),
        "falling": (columns(x=-picked, own=-own), knot),
        "own": (columns(own=-own), np.zeros(len(knot))),
        "high": (columns(x=theta, over=-member), high - t0),
        "low": (columns(x=-theta, under=-member), t0 - low),
        "over": (columns(over=-eps), np.zeros(cvs)),
        "under": (columns(under=-eps), np.zeros(cvs)),
        "lower": (columns(x=-box), -np.asarray(instance.lower)),
        "upper": (columns(x=box), np.asarray(instance.upper)),
        "row_low": (columns(x=-rows), -np.asarray(instance.row_low)),
        "row_high": (columns(x=rows), np.asarray(instance.row_high)),
    }
    return P, q, parts, soft, whole


def foreign_solution(qp: CondensedQp, rows: np.ndarray, instance: QpInstance, solver: str) -> QpSolution:
    """Moves and prices from ``clarabel`` or ``piqp``, or from the first that succeeds with ``any``."""
    P, q, parts, soft, whole = inequalities(qp, rows, instance)
    G = sp.vstack([matrix for matrix, _ in parts.values()], format="csr")
    h = np.concatenate([bound for _, bound in parts.values()])
    keep = np.isfinite(h)
    z, dual = WAYS[solver](P, q, G[keep].tocsc(), h[keep])
    prices = np.zeros(len(h))
    prices[keep] = dual
    ends = np.cumsum([len(bound) for _, bound in parts.values()])
    p = dict(zip(parts, np.split(prices, ends[:-1]), strict=True))
    row, envelope = np.zeros(len(qp.quadratic)), np.zeros(np.shape(qp.steep))
    row[soft], envelope[whole] = p["above"] - p["below"], p["rising"] - p["falling"]
    limit = p["high"] - p["low"] if qp.has_limits else np.zeros(0)
    rest = (p[name] for name in ("lower", "upper", "row_low", "row_high"))
    return solution_of(z[: len(qp.scale)], row, envelope, limit, *rest)


def chorded_optimum(qp: CondensedQp, rows: np.ndarray, instance: QpInstance) -> float:
    """With `position_weight`, for positions up to four steps away: squares are variables above all their chords."""
    P, q, parts, _, _ = inequalities(qp, rows, instance)
    weight, count, moves = np.asarray(qp.position_weight), P.shape[0], len(qp.scale)
    paid = np.flatnonzero(weight)
    P = P.tolil()
    P[:moves, :moves] -= 2.0 * rows.T @ np.diag(weight) @ rows
    reached = sp.hstack([rows[paid], sp.csr_matrix((len(paid), count - moves))])
    G = [sp.hstack([matrix, sp.csr_matrix((matrix.shape[0], len(paid)))]) for matrix, _ in parts.values()]
    h = [bound for _, bound in parts.values()]
    for k in range(-5, 5):
        G.append(sp.hstack([(2 * k + 1) * reached, -sp.identity(len(paid))]))
        h.append(np.full(len(paid), k * (k + 1.0)))
    G, h = sp.vstack(G, format="csr"), np.concatenate(h)
    keep = np.isfinite(h)
    P, q = sp.block_diag([P, sp.csc_matrix((len(paid),) * 2)], format="csc"), np.append(q, weight[paid])
    z, _ = by_any(P, q, G[keep].tocsc(), h[keep])
    return 0.5 * z @ (P @ z) + q @ z + (np.asarray(qp.quadratic) * instance.offset**2).sum()


def by_clarabel(P, q, G, h):
    """Primal and dual solution."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    cones = [clarabel.NonnegativeConeT(len(h))]
    found = clarabel.DefaultSolver(sp.triu(P, format="csc"), q, G, h, cones, settings).solve()
    assert str(found.status) in ("Solved", "AlmostSolved")
    return np.array(found.x), np.array(found.z)


def by_piqp(P, q, G, h):
    """Primal and dual solution."""
    solver = piqp.SparseSolver()
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-11
    solver.settings.check_duality_gap = True
    solver.settings.eps_duality_gap_abs = solver.settings.eps_duality_gap_rel = 1e-11
    solver.setup(P, q, None, None, G, np.full(len(h), -np.inf), h)
    assert solver.solve() == piqp.PIQP_SOLVED
    return np.array(solver.result.x), np.array(solver.result.z_u)


def by_any(P, q, G, h):
    """Primal and dual solution by the first that succeeds."""
    unit = max(
        abs(P).max(), np.abs(q).max()
    )  # of the objective, as the stopping tests of solvers are absolute
    for way, scale in ((by_piqp, 1.0), (by_clarabel, 1.0), (by_piqp, unit)):
        with contextlib.suppress(AssertionError):
            z, dual = way(P / scale, q / scale, G, h)
            return z, scale * dual
    z, dual = by_clarabel(P / unit, q / unit, G, h)
    return z, unit * dual


WAYS = {"clarabel": by_clarabel, "piqp": by_piqp, "any": by_any}
