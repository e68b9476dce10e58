"""Chains: what the whole moves of one MV must keep, in whole steps.

The rows of different MVs are independent, and those of one MV form a chain: the position after a block is the
position before it plus the block's move, and the oscillation rows couple neighbours only. Positions that a list of
allowed values leaves out and a minimum dwell (`actuators`) are part of a chain. Moves beyond an integer horizon are
continuous: what they need limits the last whole position. `feasible` propagates limits along chains, `nearest`
finds moves that keep them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int

from jaxmpc.integer.actuators import Actuator
from jaxmpc.problem.blocking import block_starts, coupled_blocks, moves_per_block, window_rows
from jaxmpc.problem.instance import QpInstance
from jaxmpc.problem.layout import Size
from jaxmpc.problem.structure import Structure

HOPS = 100_000  # pairs of allowed positions that propagation looks at
UNBOUNDED = 10**12  # whole steps that stand for "no limit" in integer arithmetic
SLACK = 1e-7  # by which limits of continuous moves may miss each other [scaled moves]


@dataclasses.dataclass(frozen=True)
class Chain:
    """The blocks of one integer MV whose moves are whole.

    Attributes:
        columns: positions of its moves in the integer vector.
        counts: moves per block.
        low, high: allowed position after each block, in steps from now.
        coupled: whether the move of block b and of b - 1 may differ by one step at most (first entry unused).
        windows, window_low, window_high: rows of the predictive mean-move limit; checked, not propagated. Where continuous
            moves are part of them, too, they are what these leave at most.
        allowed: positions that are allowed at every sample, increasing; None for all between the limits.
        apart: pairs of blocks of which one at most may move, because of the dwell; None without one.
    """

    columns: Int[np.ndarray, " block"]
    counts: Int[np.ndarray, " block"]
    low: Int[np.ndarray, " block"]
    high: Int[np.ndarray, " block"]
    coupled: Bool[np.ndarray, " block"]
    windows: np.ndarray
    window_low: np.ndarray
    window_high: np.ndarray
    allowed: Int[np.ndarray, " value"] | None = None
    apart: Bool[np.ndarray, "block block"] | None = None

    @property
    def restricted(self) -> bool:
        """Whether there is more to keep than limits and rows."""
        return self.allowed is not None or self.apart is not None

    def up(self, low: np.ndarray) -> np.ndarray:
        """The least allowed positions from these on, `UNBOUNDED` where there is none."""
        if self.allowed is None:
            return low
        place = np.searchsorted(self.allowed, low)
        found = self.allowed[np.minimum(place, len(self.allowed) - 1)]
        return np.where(place < len(self.allowed), found, UNBOUNDED)

    def down(self, high: np.ndarray) -> np.ndarray:
        """The largest allowed positions up to these, minus `UNBOUNDED` where there is none."""
        if self.allowed is None:
            return high
        place = np.searchsorted(self.allowed, high, side="right") - 1
        return np.where(place >= 0, self.allowed[np.maximum(place, 0)], -UNBOUNDED)

    @functools.cached_property
    def hops(self) -> dict[int, np.ndarray]:
        """Positions before a block and moves whose samples are all allowed, ``"2 hop"`` by the samples of a longer block."""
        found: dict[int, np.ndarray] = {}
        for block, count in enumerate(self.counts):
            if self.allowed is None or count == 1 or count in found or len(self.allowed) ** 2 > HOPS:
                continue
            before, after = (
                pair.reshape(-1) for pair in np.meshgrid(self.allowed, self.allowed, indexing="ij")
            )
            near = (after - before) % count == 0
            before, move = before[near], (after - before)[near] // count
            good = self.passes(block, before, move)
            found[int(count)] = np.stack([before[good], move[good]])
        return found

    def passes(self, block: int, before: np.ndarray, moves: np.ndarray) -> np.ndarray:
        """Whether every sample of a block is allowed that is entered at a position with a move, in any shape."""
        good: np.ndarray = np.ones(np.broadcast_shapes(np.shape(before), np.shape(moves)), dtype=bool)
        if self.allowed is not None:
            for sample in range(1, int(self.counts[block]) + 1):
                at = before + sample * moves
                good &= self.up(at) == at
        return good


def chains_of(
    structure: Structure, size: Size, instance: QpInstance, actuators: Sequence[Actuator] = ()
) -> list[Chain]:
    """Chains of all integer MVs from the limits of a problem, NumPy's arrays, and what else they must keep.

    The limits of the positions are rounded into the allowed ones.
    """
    chains, first = [], 0
    for k, mv in enumerate(structure.integer_mvs):
        chain = _chain(structure, size, instance, mv, first)
        chains.append(_restricted(chain, actuators[k], structure, mv) if actuators else chain)
        first += len(chain.columns)
    return chains


def _chain(structure: Structure, size: Size, instance: QpInstance, mv: int, first: int) -> Chain:
    """Of one integer MV, whose moves stand in the integer vector from place `first` on."""
    blocks, windows = structure.whole_blocks(mv), window_rows(structure, mv)
    low, high = (
        np.reshape(v, (size.mvs, size.rows))[mv]
        for v in map(np.asarray, (instance.row_low, instance.row_high))
    )
    window = slice(2 * size.blocks, 2 * size.blocks + len(windows))
    least, most, window_low, window_high = low[:blocks], high[:blocks], low[window], high[window]
    counts = moves_per_block(structure, mv)
    if blocks < len(counts):
        lower, upper = (
            np.reshape(v, (size.mvs, -1))[mv, : len(counts)]
            for v in map(np.asarray, (instance.lower, instance.upper))
        )
        tail = slice(blocks, len(counts))
        ends = _before_tail(low[: len(counts)], high[: len(counts)], lower * counts, upper * counts, blocks)
        least, most = np.append(least[:-1], ends[0]), np.append(most[:-1], ends[1])
        with np.errstate(invalid="ignore"):  # no limit times no share
            reach = [np.nansum(windows[:, tail] * own[tail], axis=1) for own in (lower, upper)]
        windows, window_low, window_high = windows[:, :blocks], window_low - reach[1], window_high - reach[0]
    return Chain(
        columns=first + np.arange(blocks),
        counts=counts[:blocks],
        low=whole(least),
        high=whole(most),
        coupled=coupled_blocks(structure, mv)[:blocks]
        & np.isfinite(high[size.blocks : size.blocks + blocks]),
        windows=windows,
        window_low=window_low,
        window_high=window_high,
    )


def _before_tail(low, high, lower, upper, blocks: int) -> tuple[float, float]:
    """Least and largest whole position after so many blocks from which the continuous moves after them fit their limits.

    Args:
        low, high: limits of the positions after all blocks.
        lower, upper: of what the blocks add to them.
    """
    least, most = low[-1], high[-1]
    for b in range(len(low) - 1, blocks - 1, -1):
        if lower[b] > upper[b] + SLACK or least > most + SLACK:
            return np.inf, -np.inf
        least, most = max(low[b - 1], least - upper[b]), min(high[b - 1], most - lower[b])
    return np.ceil(least - SLACK), np.floor(most + SLACK)


def _restricted(chain: Chain, actuator: Actuator, structure: Structure, mv: int) -> Chain:
    """The chain of one MV with what it must keep."""
    start, apart = block_starts(structure, mv)[: len(chain.columns)], None
    if actuator.dwell > 1:
        apart = np.abs(start[:, None] - start) < actuator.dwell
        np.fill_diagonal(apart, False)
    chain = dataclasses.replace(chain, allowed=actuator.allowed, apart=apart)
    return dataclasses.replace(chain, low=chain.up(chain.low), high=chain.down(chain.high))


def resting(structure: Structure, actuator: Actuator, mv: int) -> Bool[np.ndarray, " block"]:
    """Blocks of whole moves that must not move: too soon after the last one, or with one that would repeat in the dwell."""
    count = structure.whole_blocks(mv)
    if actuator.dwell <= 1:
        return np.zeros(count, dtype=bool)
    early = block_starts(structure, mv)[:count] < actuator.dwell - actuator.since
    return early | (moves_per_block(structure, mv)[:count] > 1)


def whole(steps: np.ndarray) -> Int[np.ndarray, "..."]:
    """Whole steps, with `UNBOUNDED` for anything larger and for no limit."""
    return np.clip(np.round(steps), -UNBOUNDED, UNBOUNDED).astype(int)


def rows_of(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Limits of whole positions as those of hard rows: infinite where they are `UNBOUNDED`."""
    return np.where(low > -UNBOUNDED, low, -np.inf), np.where(high < UNBOUNDED, high, np.inf)
