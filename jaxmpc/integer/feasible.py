"""Which whole moves satisfy the hard rows, as far as limits can tell: propagation along the chains of `chain`."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jaxmpc.integer.chain import UNBOUNDED, Chain


def propagate(
    chains: list[Chain], lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tighten integer limits along every chain until nothing changes.

    Args:
        chains: the hard rows.
        lower, upper: ``"batch integer"`` limits of the moves [steps].

    Returns:
        ``(lower, upper, possible)``: the tightened copies, and per lane whether no domain is empty.
    """
    low, high = (np.broadcast_to(limits, lower.shape) for limits in position_limits(chains))
    tight, possible = tighten(chains, MoveLimits(lower, upper, low, high))
    return tight.lower, tight.upper, possible


class MoveLimits(NamedTuple):
    """Limits of integer moves and of the positions after them, ``"integer"`` or ``"batch integer"`` [steps]."""

    lower: Int[np.ndarray, "..."]
    upper: Int[np.ndarray, "..."]
    low: Int[np.ndarray, "..."]
    high: Int[np.ndarray, "..."]

    def lane(self, k: int) -> MoveLimits:
        """Those of one lane of a batch."""
        return MoveLimits(*(values[k] for values in self))


def position_limits(chains: list[Chain]) -> tuple[np.ndarray, np.ndarray]:
    """Limits of the positions after all integer moves that the hard rows themselves set, ``"integer"`` [steps]."""
    low, high = (np.zeros(sum(len(chain.columns) for chain in chains), dtype=int) for _ in range(2))
    for chain in chains:
        low[chain.columns], high[chain.columns] = chain.low, chain.high
    return low, high


def within(chains: list[Chain], limits: MoveLimits) -> list[Chain]:
    """The chains with the position limits of one lane."""
    return [
        dataclasses.replace(chain, low=limits.low[chain.columns], high=limits.high[chain.columns])
        for chain in chains
    ]


def tighten(chains: list[Chain], limits: MoveLimits) -> tuple[MoveLimits, np.ndarray]:
    """Tighten limits of moves and positions ``"batch integer"`` along every chain until nothing changes.

    Args:
        chains: the hard rows; their positions are not read, the limits have their own.
        limits: of every lane.

    Returns:
        The tightened copies, and per lane whether no domain is empty.
    """
    limits = MoveLimits(*(np.array(values) for values in limits))
    for _ in range(2 * limits.lower.shape[1]):
        before = [values.copy() for values in limits]
        for chain in chains:
            _sweep(chain, limits)
        if all(map(np.array_equal, before, limits)):
            break
        if (limits.lower > limits.upper).any(axis=1).all():
            break
    good = (limits.lower <= limits.upper) & (limits.low <= limits.high)
    return limits, np.asarray(good.all(axis=1))


def needed(chains: list[Chain], limits: MoveLimits) -> tuple[np.ndarray, np.ndarray]:
    """Limits of positions ``"batch integer"`` that do not follow from others and the moves', the rest `UNBOUNDED`.

    Rows that follow from others tell a relaxation nothing, and their prices are not unique.
    """
    low, high = np.full_like(limits.low, -UNBOUNDED), np.full_like(limits.high, UNBOUNDED)
    for chain in chains:
        lower, upper, least, most = (values[:, chain.columns] for values in limits)
        low[:, chain.columns] = _kept(least, lower * chain.counts, upper * chain.counts)
        high[:, chain.columns] = -_kept(-most, -upper * chain.counts, -lower * chain.counts)
    return low, high


def _kept(low: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Of least positions those that steps within limits do not keep from the positions before and after."""
    low = low.copy()
    reached = np.zeros(len(low), dtype=int)
    for b in range(low.shape[1]):
        reached = reached + lower[:, b]
        follows = low[:, b] <= reached
        reached = np.maximum(reached, low[:, b])
        low[follows, b] = -UNBOUNDED
    reached = low[:, -1]
    for b in range(low.shape[1] - 2, -1, -1):
        reached = reached - upper[:, b + 1]
        follows = low[:, b] <= reached
        reached = np.maximum(reached, low[:, b])
        low[follows, b] = -UNBOUNDED
    return low


def _sweep(chain: Chain, limits: MoveLimits) -> None:
    """One pass over a chain, in place: oscillation rows, positions reachable from both ends, moves between them."""
    counts, columns, place = chain.counts, chain.columns, np.arange(len(chain.columns))
    own_low, own_high, low, high = (values[:, columns] for values in limits)
    # |d_b - d_(b-1)| <= 1 lets a limit weaken by one per block; runs of coupled blocks are kept apart by a large offset
    run = np.cumsum(~chain.coupled) * (8 * UNBOUNDED)
    own_low = _running_max(own_low + place + run) - place - run
    own_high = -_running_max(-own_high + place + run) + place + run
    own_low = _running_max_back(own_low - place - run) + place + run
    own_high = -_running_max_back(-own_high - place - run) - place - run
    if chain.apart is not None:  # a block that must move leaves those within the dwell at rest
        rest = ((own_low > 0) | (own_high < 0)) @ chain.apart
        own_low = np.where(rest, np.maximum(own_low, 0), own_low)
        own_high = np.where(rest, np.minimum(own_high, 0), own_high)
    # positions: forward from zero within the limits, then backward
    low = _reach(low, np.cumsum(own_low * counts, axis=1))
    high = -_reach(-high, -np.cumsum(own_high * counts, axis=1))
    after = np.zeros_like(own_low)
    after[:, :-1] = own_high[:, 1:] * counts[1:]
    low = _back(low, after)
    after[:, :-1] = own_low[:, 1:] * counts[1:]
    high = -_back(-high, -after)
    low, high = chain.up(low), chain.down(high)
    for b in np.flatnonzero(chain.counts > 1) if chain.hops else ():
        _hop(chain, int(b), own_low, own_high, low, high)
    before_low, before_high = np.zeros_like(low), np.zeros_like(high)
    before_low[:, 1:], before_high[:, 1:] = low[:, :-1], high[:, :-1]
    limits.lower[:, columns] = np.maximum(own_low, -((before_high - low) // counts))
    limits.upper[:, columns] = np.minimum(own_high, (high - before_low) // counts)
    limits.low[:, columns], limits.high[:, columns] = low, high


def _hop(chain: Chain, b: int, lower, upper, low, high) -> None:
    """Limits of a longer block's move and of the positions around it, in place: of all ways through allowed samples."""
    before, move = chain.hops[int(chain.counts[b])]
    after = before + chain.counts[b] * move
    good = (move >= lower[:, b, None]) & (move <= upper[:, b, None])
    good &= (after >= low[:, b, None]) & (after <= high[:, b, None])
    start = low[:, b - 1, None] if b else np.zeros((len(low), 1)), high[:, b - 1, None] if b else 0
    good &= (before >= start[0]) & (before <= start[1])
    ranges = [(lower, upper, b, move), (low, high, b, after)] + ([(low, high, b - 1, before)] if b else [])
    for least, most, place, values in ranges:
        least[:, place] = np.where(good, values, UNBOUNDED).min(axis=1, initial=UNBOUNDED)
        most[:, place] = np.where(good, values, -UNBOUNDED).max(axis=1, initial=-UNBOUNDED)


def _running_max(values: np.ndarray) -> np.ndarray:
    return np.maximum.accumulate(values, axis=1)


def _running_max_back(values: np.ndarray) -> np.ndarray:
    return np.maximum.accumulate(values[:, ::-1], axis=1)[:, ::-1]


def _reach(limit: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Least positions from zero on with moves of sum `total`, never below `limit`."""
    return total + np.maximum(_running_max(limit - total), 0)


def _back(low: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Least positions from which the later ones can be reached: low_b >= low_(b+1) - after_b."""
    ahead = np.cumsum(after, axis=1) - after  # what all moves before block b's successor add at most
    return _running_max_back(low - ahead) + ahead


def satisfied(chains: list[Chain], moves: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Whether whole moves ``"batch integer"`` satisfy every hard row exactly."""
    good = ((moves >= lower) & (moves <= upper)).all(axis=1)
    for chain in chains:
        own = moves[:, chain.columns]
        position = np.cumsum(own * chain.counts, axis=1)
        good &= ((position >= chain.low) & (position <= chain.high)).all(axis=1)
        steps = np.abs(np.diff(own, axis=1))
        good &= (steps[:, chain.coupled[1:]] <= 1).all(axis=1)
        if len(chain.windows):
            total = own @ chain.windows.T
            good &= ((total >= chain.window_low - 1e-6) & (total <= chain.window_high + 1e-6)).all(axis=1)
        if chain.allowed is not None:
            visited = np.cumsum(np.repeat(own, chain.counts, axis=1), axis=1)
            good &= (chain.up(visited) == visited).all(axis=1)
        if chain.apart is not None:
            moving = own != 0
            good &= ~(moving & (moving @ chain.apart)).any(axis=1)
    return np.asarray(good)


def around(chains: list[Chain], point: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The point and the feasible points one or two steps away, ``"point integer"``."""
    free = np.flatnonzero(upper > lower)
    unit = np.eye(len(point), dtype=int)[free]
    first, second = np.triu_indices(len(free), k=1)
    pair = unit[first] - unit[second]  # a step moved from one block to another
    steps = np.concatenate([0 * unit[:1], -unit, unit, -pair, pair])
    array = point + steps if len(free) else point[None]
    array = np.concatenate([array, *(_farther(chain, point) for chain in chains if chain.restricted)])
    return array[satisfied(chains, array, lower, upper)]


def _farther(chain: Chain, point: np.ndarray) -> np.ndarray:
    """Points around one of a restricted chain: one position or all from it on at the next allowed one, moves swapped."""
    columns, blocks = chain.columns, len(chain.columns)
    own = point[columns]
    at = np.cumsum(own * chain.counts)
    first, second = np.triu_indices(blocks, k=1)
    unit = np.eye(blocks, dtype=int)
    later = [own + (own[j] - own[i]) * (unit[i] - unit[j]) for i, j in zip(first, second, strict=True)]
    for there in (chain.up(at + 1), chain.down(at - 1)):
        away = np.where(np.abs(there) < UNBOUNDED, there - at, 0)
        for b in np.flatnonzero((away != 0) & (away % chain.counts == 0)):
            on = own + away[b] // chain.counts[b] * unit[b]
            later += [on] + [on - away[b] // chain.counts[c] * unit[c] for c in range(b + 1, blocks)]
    moves = np.unique(np.array([own, *later]), axis=0)
    array = np.repeat(point[None], len(moves), axis=0)
    array[:, columns] = moves
    return array
