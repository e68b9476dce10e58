"""Whole moves that keep a chain, nearest to wanted ones: a dynamic programme over (position, last move) decides exactly.

Continuous moves are held within their limits block after block.
"""

from __future__ import annotations

import bisect
import dataclasses
from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Float

from jaxmpc.integer.chain import UNBOUNDED, Chain, whole
from jaxmpc.problem.blocking import moves_per_block
from jaxmpc.problem.instance import QpInstance
from jaxmpc.problem.layout import Size
from jaxmpc.problem.structure import Structure

NEAR = (3, 30)  # steps around the wanted moves in which the nearest are looked for first
MOST = 20_000_000  # combinations of position and move that are looked at in one chain
HELD = 2_000_000  # of them that are remembered
CHECKED = 100  # of them between two looks at the clock


class UndecidedError(Exception):
    """Whether whole moves satisfy the hard rows would take too long to find out."""


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
