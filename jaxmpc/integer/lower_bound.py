"""What one relaxed solve proves about the integers: level-set fixing and the enumeration of what it leaves.

The prices of a relaxed solve give a quadratic lower bound of the whole problem over the whole moves d,

    F(d) >= value + sum_i excess_i(d_i) + 1/2 (d - center)' S (d - center),

with S the curvature that remains after the continuous moves have been minimised out, and excess_i >= 0 what the
linearised move weight and the priced box leave out at the integers. Prices of the position rows add what a position
stays away from a priced limit. It combines reduced-cost fixing with the level-set (strong convexity) radius. Only integers
whose bound stays below the incumbent can improve on it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxmpc.integer.chain import Chain
from jaxmpc.integer.feasible import MoveLimits, satisfied

GRID = 1024  # combinations up to which all are evaluated at once
# partial assignments times values of the next move that are kept: half a gigabyte with all that is made of them
CELLS = 2**22
PIECE = 2**15  # of them that are looked at together: a millisecond


class PositionPrices(NamedTuple):
    """What the limits of the positions after the integer moves cost, ``"integer"``.

    Attributes:
        price: per step, upper limit positive.
        low, high: the limits of this solve [steps].
    """

    price: Float[np.ndarray, " integer"]
    low: Int[np.ndarray, " integer"]
    high: Int[np.ndarray, " integer"]

    def excess(self, column: int, position: np.ndarray) -> np.ndarray:
        """What the prices leave out at these positions after one move, within the limits."""
        price = float(self.price[column])
        return price * (self.high[column] - position) if price > 0 else -price * (position - self.low[column])


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
        order: in which the moves are assigned one after the other, those of an MV block by block.
        leading: R with R'R = S in that order, lower triangular, so that term i of |R d|^2 involves d_0..d_i only.
        positions: prices of the position rows, None to leave them out.
    """

    value: float
    center: Float[np.ndarray, " integer"]
    lower: Int[np.ndarray, " integer"]
    upper: Int[np.ndarray, " integer"]
    excess: Float[np.ndarray, "integer value"]
    schur: Float[np.ndarray, "integer integer"]
    radius: Float[np.ndarray, " integer"]
    order: Int[np.ndarray, " integer"]
    leading: Float[np.ndarray, "integer integer"]
    positions: PositionPrices | None = None

    def priced(self, price: np.ndarray, limits: MoveLimits) -> LowerModel:
        """With the prices of the position rows of the same solve, which had these limits."""
        return dataclasses.replace(self, positions=PositionPrices(price, limits.low, limits.high))


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
    return block, _radii(values, vectors)


def radii(schur: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Diagonal of ``rows S^-1 rows'``: (r (d - center))^2 / (2 radius) is the least curvature cost of a row's value."""
    values, vectors = np.linalg.eigh(schur)
    return _radii(np.maximum(values, 0.0), rows @ vectors)


def _radii(values: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Of rows given in the eigenvectors' basis; infinite where they have a part in directions without curvature."""
    flat = values <= 1e-12 * values.max(initial=0.0)
    radius = ((along**2) * np.where(flat, 0.0, 1.0 / np.where(flat, 1.0, values))).sum(axis=1)
    return np.where(((along**2) * flat).sum(axis=1) > 1e-12, np.inf, radius)


def root_factor(schur: np.ndarray) -> np.ndarray:
    """L with L L' = S, for values d'S d = |d L|^2 of many points at once."""
    values, vectors = np.linalg.eigh(schur)
    return vectors * np.sqrt(np.maximum(values, 0.0))


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
    beam: int | None = None,
    check_time: Callable[[], None] = lambda: None,
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """All whole moves within limits whose bound is below `cutoff`: as a grid, or by breadth-first search over the blocks.

    Args:
        model: lower bound.
        chains: hard rows, checked as far as the assigned blocks allow.
        lower, upper: limits of the moves, within the model's.
        cutoff: moves with a bound at or above it are left out.
        most: give up (return None) when more partial assignments than this are alive at once; None for as many as
            fit into memory.
        beam: keep only so many partial assignments of least bound, to find good moves rather than all.
        check_time: called between two moves; may raise to end it.

    Returns:
        ``(moves "point integer", bounds "point", least)`` sorted by bound, `least` being the smallest bound of
        what was left out (infinite if nothing was), or None.
    """
    sizes = np.maximum(upper - lower + 1, 0)
    if beam is None and np.prod(sizes.astype(float)) <= GRID:
        return _grid_below(model, chains, lower, upper, sizes, cutoff)
    owner = {int(column): (k, b) for k, chain in enumerate(chains) for b, column in enumerate(chain.columns)}
    place = np.argsort(model.order)
    narrow = max(np.abs(lower).max(), np.abs(upper).max()) < np.iinfo(np.int16).max
    moves = np.zeros((1, 0), dtype=np.int16 if narrow else int)  # long lists take memory
    bounds = np.array([model.value])
    position = np.zeros((1, len(chains)), dtype=int)
    least = np.inf
    for i, column in enumerate(model.order):
        check_time()
        k, b = owner[int(column)]
        chain = chains[k]
        domain = np.arange(int(lower[column]), int(upper[column]) + 1)
        if chain.allowed is not None:  # few of many moves end where they may
            away = np.unique(chain.allowed[:, None] - np.unique(position[:, k]))
            domain = np.intersect1d(domain, away[away % chain.counts[b] == 0] // chain.counts[b])
        if len(bounds) * len(domain) > CELLS:
            if beam is None:
                return None
            best = np.argsort(bounds, kind="stable")[: max(CELLS // len(domain), 1)]
            moves, bounds, position = moves[best], bounds[best], position[best]
        row, center = model.leading[i], model.center[model.order]
        own = model.excess[column, domain - model.lower[column]]
        near = [] if chain.apart is None else chain.columns[:b][chain.apart[b, :b]]
        found = []
        for some in _pieces(len(bounds), check_time, max(len(domain), 1)):
            before = position[some, k, None]
            term = (moves[some] @ row[:i] - row[: i + 1] @ center[: i + 1])[:, None] + row[i] * domain
            reached = before + chain.counts[b] * domain
            total = bounds[some, None] + 0.5 * term**2 + own
            if model.positions is not None and model.positions.price[column]:
                total += np.maximum(model.positions.excess(column, reached), 0.0)
            good = (reached >= chain.low[b]) & (reached <= chain.high[b])
            if chain.coupled[b]:
                good &= np.abs(domain - moves[some, place[chain.columns[b - 1]], None]) <= 1
            if chain.allowed is not None:
                good &= chain.passes(b, before, domain)
            if len(near):
                good &= (domain == 0) | (moves[some][:, place[near]] == 0).all(axis=1, keepdims=True)
            below = total < cutoff
            if np.isfinite(cutoff):
                least = min(least, total[good & ~below].min(initial=np.inf))
            parents, chosen = np.nonzero(good & below)
            found.append((parents + some.start, chosen, total[parents, chosen]))
            if most is not None and sum(len(part) for part, _, _ in found) > most:
                return None
        none = np.zeros(0, dtype=int)
        parents, chosen, bounds = (
            np.concatenate(part) for part in zip(*found or [(none, none, np.zeros(0))], strict=True)
        )
        if beam is not None and len(bounds) > beam:
            best = np.argpartition(bounds, beam)[:beam]
            parents, chosen, bounds = parents[best], chosen[best], bounds[best]
        longer = np.empty((len(parents), i + 1), dtype=moves.dtype)
        for some in _pieces(len(parents), check_time):
            longer[some, :i], longer[some, i] = moves[parents[some]], domain[chosen[some]]
        moves = longer
        position = position[parents]
        position[:, k] += chain.counts[b] * domain[chosen]
        if not len(moves):
            break
    rank = np.argsort(bounds, kind="stable")
    result = np.zeros((len(moves), len(owner)), dtype=int)
    for some in _pieces(len(moves), check_time):
        result[some][:, model.order[: moves.shape[1]]] = moves[rank[some]]
    return result, bounds[rank], least


def _pieces(count: int, check_time: Callable[[], None], each: int = 1) -> Iterator[slice]:
    """Parts of long arrays, of so many numbers per entry, with a look at the clock before each."""
    width = max(PIECE // each, 1)
    for begin in range(0, count, width):
        check_time()
        yield slice(begin, begin + width)


def _grid_below(model: LowerModel, chains: list[Chain], lower, upper, sizes, cutoff: float):
    """`enumerate_below` where all combinations are few: every one is looked at."""
    points = np.repeat(lower[None], int(np.prod(sizes)), axis=0)
    free = np.flatnonzero(sizes > 1)
    points[:, free] += np.indices(sizes[free]).reshape(len(free), len(points)).T
    points = points[satisfied(chains, points, lower, upper)]
    away = (points - model.center)[:, model.order] @ model.leading.T
    own = model.excess[np.arange(len(lower)), points - model.lower].sum(axis=1)
    bounds = model.value + own + 0.5 * (away**2).sum(axis=1)
    if model.positions is not None:
        for chain in chains:
            reached = np.cumsum(points[:, chain.columns] * chain.counts, axis=1)
            for column, position in zip(chain.columns, reached.T, strict=True):
                bounds += model.positions.excess(column, position)
    below = bounds < cutoff
    least = bounds[~below].min(initial=np.inf) if np.isfinite(cutoff) else np.inf
    points, bounds = points[below], bounds[below]
    rank = np.argsort(bounds, kind="stable")
    return points[rank], bounds[rank], least


def assignment_order(start: np.ndarray, mv: np.ndarray) -> Int[np.ndarray, " integer"]:
    """Integer moves by their first sample, the MVs of a sample one after the other."""
    return np.lexsort((mv, start))


def leading_factor(matrix: np.ndarray) -> np.ndarray:
    """Lower-triangular R with R'R = matrix, so that term i of |R d|^2 involves d_0..d_i only."""
    values, vectors = np.linalg.eigh(matrix)
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return np.asarray(np.linalg.qr(root[:, ::-1], mode="r"))[::-1, ::-1]
