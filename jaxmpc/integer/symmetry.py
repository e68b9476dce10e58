"""Equal actuators: of plans that differ only in which of them moves, one is kept.

MVs whose responses (up to their sign), weights and limits (up to where they lie) are equal may exchange their
positions at any time: with positions above the lower limit in decreasing order at every sample the predictions are the same,
and neither the moves' squares nor their limits are exceeded, because of two sorted lists the entries of one rank lie closest
together. So some best plan is in order, the one that starts furthest up being first, and branching and lists look at such
plans only (Margot 2010 on symmetric integer programmes). A move over several samples of a block may end where the
other's cannot: from the first such block on nothing is demanded. Oscillation rows, dwell, lists and windows are not kept by
an exchange: MVs with them are left alone.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int

from jaxmpc.integer.chain import UNBOUNDED, Chain, whole
from jaxmpc.integer.feasible import MoveLimits, tighten
from jaxmpc.integer.tables import Constants


@dataclasses.dataclass(frozen=True)
class Ranked:
    """Leading moves of one MV: ``sign * position + shift`` counts from its lower limit."""

    columns: Int[np.ndarray, " block"]
    sign: int
    shift: int


ROUNDING = 1e-13  # of what is largest
Order = tuple[Ranked, Ranked]  # the position of the first is nowhere below that of the second


def orders_of(constants: Constants, chains: Sequence[Chain], lower, upper) -> list[Order]:
    """Orders that some best plan keeps.

    Args:
        constants: of the problem.
        chains: what whole moves must keep.
        lower, upper: limits of the moves, ``"integer"`` [steps].
    """
    if len(chains) < 2 or constants.qp.ideal is not None or constants.structure.relaxed_moves:
        return []
    groups: list[tuple[_Told, list[Ranked]]] = []
    qp = constants.qp
    weight = np.asarray(qp.move_weight) + (np.asarray(qp.steep[0]) if len(qp.steep) else 0.0)
    for chain in chains:
        if chain.restricted or len(chain.windows) or chain.coupled.any():
            continue
        place = constants.integer[chain.columns]
        response = np.asarray(qp.response)[:, place] * constants.scales[place]
        first = response.flat[np.argmax(response != 0.0)]
        sign = -1 if first < 0.0 else 1
        low, high, (least, most) = chain.low, chain.high, _own_limits(chain, lower, upper)
        if sign < 0:
            least, most, low, high = -most, -least, -high, -low
        longer = np.flatnonzero(chain.counts > 1)
        columns = chain.columns[: longer[0] if len(longer) else None]
        if (
            (low != low[0]).any()
            or max(np.abs(low).max(), np.abs(high).max()) >= UNBOUNDED
            or not len(columns)
        ):
            continue
        told = _Told(sign * response, weight[place], np.stack([chain.counts, least, most, high - low[0]]))
        group = next((group for other, group in groups if told.equals(other)), None)
        if group is None:
            groups.append((told, group := []))
        group.append(Ranked(columns, sign, -int(low[0])))
    ranks = (sorted(group, key=lambda one: -one.shift) for _, group in groups)
    return [pair for rank in ranks for pair in itertools.pairwise(rank)]


@dataclasses.dataclass(frozen=True)
class _Told:
    """All that a problem knows of an MV, where it stands apart."""

    response: np.ndarray
    weight: np.ndarray
    limits: np.ndarray

    def equals(self, other: _Told) -> bool:
        """Whether nothing tells one MV from the other but rounding, as that of units."""
        if not np.array_equal(self.limits, other.limits):
            return False
        pairs = (self.response, other.response), (self.weight, other.weight)
        return all(np.abs(a - b).max() <= ROUNDING * np.abs(a).max() for a, b in pairs)


def _own_limits(chain: Chain, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Limits of the moves of one MV, `UNBOUNDED` where they follow from those of its positions."""
    low_before, high_before = (np.append(0, values[:-1]) for values in (chain.low, chain.high))
    least, most = whole(lower[chain.columns]), whole(upper[chain.columns])
    least = np.where(least * chain.counts <= chain.low - high_before, -UNBOUNDED, least)
    return least, np.where(most * chain.counts >= chain.high - low_before, UNBOUNDED, most)


def tighten_in_order(
    chains: list[Chain], orders: Sequence[Order], limits: MoveLimits
) -> tuple[MoveLimits, np.ndarray]:
    """`feasible.tighten` for plans in order."""
    limits, good = tighten(chains, limits)
    for _ in range(len(orders)):
        low, high = limits.low.copy(), limits.high.copy()
        for first, second in orders:
            above, below = _reach(first, limits), _reach(second, limits)
            _set(first, limits, np.maximum(above[0], below[0]), above[1])
            _set(second, limits, below[0], np.minimum(above[1], below[1]))
        if np.array_equal(low, limits.low) and np.array_equal(high, limits.high):
            break
        limits, good = tighten(chains, limits)
    return limits, good


def in_order(
    chains: Sequence[Chain], orders: Sequence[Order], points: Int[np.ndarray, "point integer"]
) -> Bool[np.ndarray, " point"]:
    """Which whole moves are in order."""
    good = np.ones(len(points), dtype=bool)
    if not orders:
        return good
    position = np.zeros_like(points)
    for chain in chains:
        position[:, chain.columns] = np.cumsum(points[:, chain.columns] * chain.counts, axis=1)
    for first, second in orders:
        above, below = (one.sign * position[:, one.columns] + one.shift for one in (first, second))
        good &= (above >= below).all(axis=1)
    return good


def _reach(one: Ranked, limits: MoveLimits) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest positions of an MV, counted from its lower limit."""
    low, high = one.sign * limits.low[:, one.columns], one.sign * limits.high[:, one.columns]
    return np.minimum(low, high) + one.shift, np.maximum(low, high) + one.shift


def _set(one: Ranked, limits: MoveLimits, least: np.ndarray, most: np.ndarray) -> None:
    """Put limits in place that `_reach` gave."""
    low, high = one.sign * (least - one.shift), one.sign * (most - one.shift)
    limits.low[:, one.columns], limits.high[:, one.columns] = (low, high) if one.sign > 0 else (high, low)
