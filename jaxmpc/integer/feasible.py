"""Hard limits on whole moves: which integers a search may still choose (thesis 6.1, 6.5).

The rows of different MVs are independent, and those of one MV form a chain: the position after a block is the
position before it plus the block's move, and the oscillation rows couple neighbours only. Limits therefore
propagate along the chain, and a dynamic programme over (position, last move) decides feasibility exactly. Moves beyond the
integer horizon are continuous: what they can reach the limits of their own positions from is the last limit of the chain.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxmpc.problem.blocking import coupled_blocks, moves_per_block, window_rows
from jaxmpc.problem.instance import QpInstance
from jaxmpc.problem.layout import Size
from jaxmpc.problem.structure import Structure

NEAR = (3, 30)  # steps around the wanted moves in which the nearest are looked for first
MOST = 20_000_000  # combinations of position and move that are looked at in one chain
HELD = 2_000_000  # of them that are remembered
CHECKED = 100  # of them between two looks at the clock
UNBOUNDED = 10**12  # whole steps that stand for "no limit" in integer arithmetic
SLACK = 1e-7  # by which limits of continuous moves may miss each other [scaled moves]


class UndecidedError(Exception):
    """Whether whole moves satisfy the hard rows would take too long to find out."""


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
    """

    columns: Int[np.ndarray, " block"]
    counts: Int[np.ndarray, " block"]
    low: Int[np.ndarray, " block"]
    high: Int[np.ndarray, " block"]
    coupled: Bool[np.ndarray, " block"]
    windows: np.ndarray
    window_low: np.ndarray
    window_high: np.ndarray


def chains_of(structure: Structure, size: Size, instance: QpInstance) -> list[Chain]:
    """Chains of all integer MVs from the limits of a problem, NumPy's arrays."""
    chains, first = [], 0
    for mv in structure.integer_mvs:
        chains.append(_chain(structure, size, instance, mv, first))
        first += len(chains[-1].columns)
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


def whole(steps: np.ndarray) -> Int[np.ndarray, "..."]:
    """Whole steps, with `UNBOUNDED` for anything larger and for no limit."""
    return np.clip(np.round(steps), -UNBOUNDED, UNBOUNDED).astype(int)


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
    # positions: forward from zero within the limits, then backward
    low = _reach(low, np.cumsum(own_low * counts, axis=1))
    high = -_reach(-high, -np.cumsum(own_high * counts, axis=1))
    after = np.zeros_like(own_low)
    after[:, :-1] = own_high[:, 1:] * counts[1:]
    low = _back(low, after)
    after[:, :-1] = own_low[:, 1:] * counts[1:]
    high = -_back(-high, -after)
    before_low, before_high = np.zeros_like(low), np.zeros_like(high)
    before_low[:, 1:], before_high[:, 1:] = low[:, :-1], high[:, :-1]
    limits.lower[:, columns] = np.maximum(own_low, -((before_high - low) // counts))
    limits.upper[:, columns] = np.minimum(own_high, (high - before_low) // counts)
    limits.low[:, columns], limits.high[:, columns] = low, high


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
    return np.asarray(good)


def around(chains: list[Chain], point: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The point and the feasible points one or two steps away, ``"point integer"``."""
    free = np.flatnonzero(upper > lower)
    unit = np.eye(len(point), dtype=int)[free]
    first, second = np.triu_indices(len(free), k=1)
    pair = unit[first] - unit[second]  # a step moved from one block to another
    steps = np.concatenate([0 * unit[:1], -unit, unit, -pair, pair])
    array = point + steps if len(free) else point[None]
    return array[satisfied(chains, array, lower, upper)]


def nearest(
    chains: list[Chain],
    wanted: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    check_time: Callable[[], None] = lambda: None,
) -> np.ndarray | None:
    """Feasible whole moves closest to `wanted` in the sum of absolute differences, or None where there are none.

    Window rows are not looked at. Dynamic programming over (position, last move), exact; costs milliseconds and is
    called only when rounding breaks a hard row.

    Args:
        chains: the hard rows.
        wanted: moves [steps].
        lower, upper: limits of the moves.
        check_time: called now and then; may raise to end it.

    Raises:
        UndecidedError: where there are more moves and positions than can be looked at.
    """
    result = np.zeros(len(wanted), dtype=int)
    for chain in chains:
        own = chain.columns
        path = _nearest_in_chain(chain, wanted[own], lower[own], upper[own], check_time)
        if path is None:
            return None
        result[chain.columns] = path
    return result


def _nearest_in_chain(chain: Chain, wanted, lower, upper, check_time) -> list[int] | None:
    """Of one MV: among the moves around the wanted ones first, which are few."""
    around = whole(wanted)
    for reach in NEAR:
        low, high = np.maximum(lower, around - reach), np.minimum(upper, around + reach)
        if (low == lower).all() and (high == upper).all():
            break
        path = _among(chain, wanted, low, high, check_time)
        # paths that leave these limits have a move that alone is farther away
        if path is not None and np.abs(path - wanted).sum() <= reach:
            return path
    return _among(chain, wanted, lower, upper, check_time)


def _among(chain: Chain, wanted, lower, upper, check_time) -> list[int] | None:
    """Of one MV, by dynamic programming over all moves within these limits."""
    looked_at = kept = 0
    layers: list[dict] = [{(0, None): (0.0, None, None)}]
    for b in range(len(wanted)):
        layer: dict = {}
        remember = b + 1 < len(wanted) and chain.coupled[b + 1]
        for number, (state, (cost, _, _)) in enumerate(layers[-1].items()):
            if number % CHECKED == 0:
                check_time()
            position, last = state
            first, final = int(lower[b]), int(upper[b])
            if chain.coupled[b]:
                first, final = max(first, last - 1), min(final, last + 1)
            count = int(chain.counts[b])
            first = max(first, -((position - int(chain.low[b])) // count))
            final = min(final, (int(chain.high[b]) - position) // count)
            looked_at += max(final - first + 1, 0)
            if looked_at > MOST or kept + len(layer) + final - first >= HELD:
                raise UndecidedError
            for move in range(first, final + 1):
                key = (position + count * move, move if remember else None)
                total = cost + abs(move - wanted[b])
                if key not in layer or total < layer[key][0]:
                    layer[key] = (total, state, move)
        if not layer:
            return None
        layers.append(layer)
        kept += len(layer)
    key = min(layers[-1], key=lambda k: layers[-1][k][0])
    path = []
    for layer in layers[:0:-1]:
        _, key, move = layer[key]
        path.append(move)
    return path[::-1]


def held_within(
    structure: Structure, size: Size, instance: QpInstance, x: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Moves that need not be whole near `x` that keep their limits: block after block, the end always within reach.

    The others stay as they are; where the limits leave no moves at all, some are broken.
    """
    by_mv = lambda values: np.reshape(values, (size.mvs, -1))  # noqa: E731
    lower, upper = by_mv(instance.lower), by_mv(instance.upper)
    row_low, row_high = by_mv(instance.row_low), by_mv(instance.row_high)
    x = np.array(x)
    for mv in range(size.mvs):
        counts, whole_blocks = moves_per_block(structure, mv), structure.whole_blocks(mv)
        # positions from which all later limits can be kept
        least, most = row_low[mv, : len(counts)].copy(), row_high[mv, : len(counts)].copy()
        for b in range(len(counts) - 2, -1, -1):
            least[b] = max(least[b], least[b + 1] - counts[b + 1] * upper[mv, b + 1])
            most[b] = min(most[b], most[b + 1] - counts[b + 1] * lower[mv, b + 1])
        position, own = 0.0, by_mv(x)[mv]
        for b, count in enumerate(counts):
            low = max(lower[mv, b], (least[b] - position) / count)
            high = min(upper[mv, b], (most[b] - position) / count)
            own[b] = min(max(own[b], low), high) if b >= whole_blocks and low <= high else own[b]
            position += count * own[b]
    return x
