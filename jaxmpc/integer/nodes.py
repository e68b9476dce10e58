"""Nodes of branch and bound: limits of moves and positions with what their relaxation proves, and how they part."""

from __future__ import annotations

import dataclasses

import numpy as np

from jaxmpc.integer.chain import Chain
from jaxmpc.integer.feasible import MoveLimits
from jaxmpc.integer.lower_bound import LowerModel
from jaxmpc.integer.relaxer import Relaxations
from jaxmpc.relaxed.newton import WarmStart


@dataclasses.dataclass(frozen=True)
class Node:
    """A relaxed node; `limits` may be tighter than those of its `model`, whose center are its moves."""

    bound: float
    limits: MoveLimits
    model: LowerModel
    start: WarmStart

    @property
    def size(self) -> int:
        """Numbers it keeps."""
        prices = (
            self.start.row_price,
            self.start.limit_price,
            self.start.envelope_price,
            self.start.hard_price,
        )
        return self.model.excess.size + sum(np.size(part) for part in prices)


@dataclasses.dataclass
class Child:
    """What may become a node; `solved` are its relaxation's batch and lane, None where no whole moves are left."""

    limits: MoveLimits
    start: WarmStart
    solved: tuple[Relaxations, int] | None = None


@dataclasses.dataclass(frozen=True)
class Branching:
    """Two children: entry `row` (a move, or from `count` on a position) at most `cut`, or at least `next`, nothing being
    between them; estimates of their gains.
    """

    row: int
    cut: int
    next: int
    estimate: tuple[float, float]


def both(one: MoveLimits, other: MoveLimits) -> MoveLimits:
    """What lies within both limits."""
    return MoveLimits(
        np.maximum(one.lower, other.lower),
        np.minimum(one.upper, other.upper),
        np.maximum(one.low, other.low),
        np.minimum(one.high, other.high),
    )


def log_size(chains: list[Chain], limits: MoveLimits) -> float:
    """Logarithm of the whole moves in a level set, estimated by its box."""
    by_moves = [room(limits.lower, limits.upper, chain) for chain in chains]
    by_positions = [choices(limits, chain) for chain in chains]
    return sum(map(min, by_moves, by_positions))


def choices(limits: MoveLimits, chain: Chain) -> float:
    """Logarithm of the combinations of one MV's allowed positions within limits."""
    if chain.allowed is None:
        return room(limits.low, limits.high, chain)
    low, high = limits.low[chain.columns], limits.high[chain.columns]
    count = np.searchsorted(chain.allowed, high, side="right") - np.searchsorted(chain.allowed, low)
    return float(np.log(np.maximum(count, 1)).sum())


def room(low: np.ndarray, high: np.ndarray, chain: Chain) -> float:
    """Logarithm of the combinations of one MV's moves or positions within limits."""
    return float(np.log(high[chain.columns] - low[chain.columns] + 1.0).sum())
