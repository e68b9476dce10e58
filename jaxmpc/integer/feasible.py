"""Hard limits on whole moves: which integers a search may still choose (thesis 6.1, 6.5).

The rows of different MVs are independent, and those of one MV form a chain: the position after a block is the
position before it plus the block's move, and the oscillation rows couple neighbours only. Limits therefore
propagate along the chain, and a dynamic programme over (position, last move) decides feasibility exactly. Positions
that a list of allowed values leaves out and a minimum dwell (`actuators`) are part of a chain. Moves beyond the
integer horizon are continuous: what they can reach the limits of their own positions from is the last limit of the chain.
"""

from __future__ import annotations

import bisect
import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxmpc.integer.actuators import Actuator
from jaxmpc.problem.blocking import block_starts, coupled_blocks, moves_per_block, window_rows
from jaxmpc.problem.instance import QpInstance
from jaxmpc.problem.layout import Size
from jaxmpc.problem.structure import Structure

NEAR = (3, 30)  # steps around the wanted moves in which the nearest are looked for first
MOST = 20_000_000  # combinations of position and move that are looked at in one chain
HELD = 2_000_000  # of them that are remembered
HOPS = 100_000  # pairs of allowed positions that propagation looks at
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


def fastest_return(
    chain: Chain, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Position limits of a chain widened so far that an MV outside them has a way back, the shortest one.

    Args:
        chain: whose position limits it cannot keep.
        lower, upper: limits of its moves.

    Returns:
        ``(low, high)``, or None where no moves at all keep the rest.
    """
    free = np.full(len(lower), UNBOUNDED)
    open_chain = dataclasses.replace(chain, low=chain.up(-free), high=chain.down(free))
    path = _among(open_chain, None, lower, upper, outside=(chain.low, chain.high))
    if path is None:
        return None
    at = np.cumsum(np.array(path) * chain.counts)
    return np.minimum(chain.low, at), np.maximum(chain.high, at)


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


def _among(chain: Chain, wanted, lower, upper, check_time=lambda: None, outside=None) -> list[int] | None:
    """Of one MV, by dynamic programming over all moves within these limits.

    The nearest to the wanted moves, or without any those whose positions are the least outside two limits.
    """
    looked_at = kept = 0
    layers: list[dict] = [{(0, None, None): (0.0, None, None)}]
    allowed = [] if chain.allowed is None else chain.allowed.tolist()
    known = set(allowed)
    for b in range(len(lower)):
        layer: dict = {}
        remember = b + 1 < len(lower) and chain.coupled[b + 1]
        count = int(chain.counts[b])
        for number, (state, (cost, _, _)) in enumerate(layers[-1].items()):
            if number % CHECKED == 0:
                check_time()
            position, last, moved = state
            first, final = int(lower[b]), int(upper[b])
            if chain.coupled[b]:
                first, final = max(first, last - 1), min(final, last + 1)
            first = max(first, -((position - int(chain.low[b])) // count))
            final = min(final, (int(chain.high[b]) - position) // count)
            if moved is not None and chain.apart is not None and chain.apart[moved, b]:
                first, final = max(first, 0), min(final, 0)
            choices: Iterable[int] = range(first, final + 1)
            if chain.allowed is not None:
                choices = _choices(position, count, first, final, allowed, known)
            looked_at += len(choices)
            if looked_at > MOST or kept + len(layer) + len(choices) > HELD:
                raise UndecidedError
            for move in choices:
                reached = position + count * move
                latest = moved
                if chain.apart is not None:
                    latest = b if move else moved
                    latest = latest if latest is not None and chain.apart[latest, b + 1 :].any() else None
                key = (reached, move if remember else None, latest)
                if outside is None:
                    total = cost + abs(move - wanted[b])
                else:
                    total = cost + max(outside[0][b] - reached, reached - outside[1][b], 0)
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


def _choices(
    position: int, count: int, first: int, final: int, allowed: list[int], known: set[int]
) -> list[int]:
    """Moves of a block from a position whose samples are all allowed."""
    ends = allowed[
        bisect.bisect_left(allowed, position + count * first) : bisect.bisect_right(
            allowed, position + count * final
        )
    ]
    moves = [(end - position) // count for end in ends if (end - position) % count == 0]
    return [m for m in moves if count == 1 or all(position + k * m in known for k in range(1, count))]


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
