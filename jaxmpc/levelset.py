"""What one relaxed solve proves about the integers: level-set fixing and the enumeration of what it leaves.

The prices of a relaxed solve give a quadratic lower bound of the whole problem over the whole moves d,

    F(d) >= value + sum_i excess_i(d_i) + 1/2 (d - center)' S (d - center),

with S the curvature that remains after the continuous moves have been minimised out, and excess_i >= 0 what the
linearised move weight and the priced box leave out at the integers. It combines reduced-cost fixing with
the level-set (strong convexity) radius. Only integers whose bound stays below the incumbent can improve on it.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from jaxmpc.propagation import Chain


@dataclasses.dataclass(frozen=True)
class LowerModel:
    """The bound above for one node.

    Attributes:
        value: its constant.
        center: relaxed moves of the integer MVs [steps].
        lower, upper: the node's integer limits.
        excess: ``"integer value"``; column v stands for the move `lower + v`, infinite beyond `upper`.
        schur: S.
        radius: diagonal of the inverse of S; bounds one move with the others free.
    """

    value: float
    center: Float[np.ndarray, " integer"]
    lower: Int[np.ndarray, " integer"]
    upper: Int[np.ndarray, " integer"]
    excess: Float[np.ndarray, "integer value"]
    schur: Float[np.ndarray, "integer integer"]
    radius: Float[np.ndarray, " integer"]


def schur_complement(hessian: np.ndarray, integer: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Curvature in the integer moves with the others minimised out, and the diagonal of its inverse.

    A semidefinite Hessian is allowed: directions without curvature get an infinite radius.
    """
    others = np.setdiff1d(np.arange(len(hessian)), integer)
    block = hessian[np.ix_(integer, integer)]
    if len(others):
        cross = hessian[np.ix_(others, integer)]
        inner = hessian[np.ix_(others, others)]
        values, vectors = np.linalg.eigh(inner)
        # leaving out small curvature of the other moves can only lower the bound if its directions are left in as free
        keep = values > 1e-10 * max(values.max(initial=0.0), 1e-300)
        projected = vectors.T @ cross
        block = block - (projected[keep].T / values[keep]) @ projected[keep]
        leak = np.abs(projected[~keep]).sum()
        if leak > 1e-8 * max(np.abs(hessian).max(), 1e-300):
            block = np.zeros_like(block)
    block = 0.5 * (block + block.T)
    values, vectors = np.linalg.eigh(block)
    top = max(values.max(initial=0.0), 0.0)
    # round-off must not add curvature: shave it off, then drop what is negative
    values = np.maximum(values - 1e-11 * top - 1e-13 * np.abs(hessian).max(initial=0.0), 0.0)
    block = (vectors * values) @ vectors.T
    flat = values <= 1e-12 * top
    with np.errstate(divide="ignore"):
        radius = ((vectors**2) * np.where(flat, 0.0, 1.0 / np.where(flat, 1.0, values))).sum(axis=1)
    radius = np.where(((vectors**2) * flat).sum(axis=1) > 1e-12, np.inf, radius)
    return block, radius


def exclude(model: LowerModel, cutoff: float) -> tuple[np.ndarray, np.ndarray]:
    """Integer limits that keep every move whose own bound is below `cutoff` (the value of the incumbent)."""
    values = model.lower[:, None] + np.arange(model.excess.shape[1])[None, :]
    away = values - model.center[:, None]
    with np.errstate(invalid="ignore"):
        single = (
            model.value
            + model.excess
            + np.where(np.isfinite(model.radius)[:, None], 0.5 * away**2 / model.radius[:, None], 0.0)
        )
    alive = single < cutoff
    none = ~alive.any(axis=1)
    first = np.argmax(alive, axis=1)
    last = alive.shape[1] - 1 - np.argmax(alive[:, ::-1], axis=1)
    lower, upper = model.lower + first, model.lower + last
    lower[none], upper[none] = model.upper[none] + 1, model.lower[none]
    return lower, upper


def enumerate_below(
    model: LowerModel,
    chains: list[Chain],
    lower: np.ndarray,
    upper: np.ndarray,
    cutoff: float,
    most: int | None,
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """All whole moves within limits whose bound is below `cutoff`, by breadth-first search over the blocks.

    Args:
        model: lower bound.
        chains: hard rows, checked as far as the assigned blocks allow.
        lower, upper: limits of the moves, within the model's.
        cutoff: moves with a bound at or above it are left out.
        most: give up (return None) when more partial assignments than this are alive at once; None for no limit.

    Returns:
        ``(moves "point integer", bounds "point", least)`` sorted by bound, `least` being the smallest bound of
        what was left out (infinite if nothing was), or None.
    """
    blocks = len(chains[0].columns)
    order = np.array([chain.columns[b] for b in range(blocks) for chain in chains])
    owner = [(chain, b) for b in range(blocks) for chain in chains]
    # S = R'R with R lower triangular in this order, so that a partial assignment fixes the leading terms
    permuted = model.schur[np.ix_(order, order)]
    factor = _leading_factor(permuted)
    count = len(order)
    moves = np.zeros((1, count), dtype=int)
    bounds = np.array([model.value])
    position = {id(chain): np.zeros(1, dtype=int) for chain in chains}
    least = np.inf
    for i in range(count):
        chain, b = owner[i]
        column = order[i]
        domain = np.arange(int(lower[column]), int(upper[column]) + 1)
        parents = np.repeat(np.arange(len(moves)), len(domain))
        value = np.tile(domain, len(moves))
        moves, bounds = moves[parents], bounds[parents]
        moves[:, i] = value
        position = {key: state[parents] for key, state in position.items()}
        position[id(chain)] = position[id(chain)] + chain.counts[b] * value
        good = (position[id(chain)] >= chain.low[b]) & (position[id(chain)] <= chain.high[b])
        if chain.coupled[b]:
            good &= np.abs(value - moves[:, i - len(chains)]) <= 1
        away = moves[:, : i + 1] - model.center[order[: i + 1]]
        term = away @ factor[i, : i + 1]
        bounds = bounds + 0.5 * term**2 + model.excess[column, value - model.lower[column]]
        out = good & ~(bounds < cutoff)
        if out.any():
            least = min(least, bounds[out].min())
        good &= bounds < cutoff
        moves, bounds = moves[good], bounds[good]
        position = {key: state[good] for key, state in position.items()}
        if most is not None and len(moves) > most:
            return None
        if not len(moves):
            break
    result = np.zeros_like(moves)
    result[:, order] = moves
    rank = np.argsort(bounds, kind="stable")
    return result[rank], bounds[rank], least


def _leading_factor(matrix: np.ndarray) -> np.ndarray:
    """Lower-triangular R with R'R = matrix, so that term i of |R d|^2 involves d_0..d_i only."""
    values, vectors = np.linalg.eigh(matrix)
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return np.asarray(np.linalg.qr(root[:, ::-1], mode="r"))[::-1, ::-1]
