"""Move blocking (thesis 6.2) in both modes, and the rows that blocked moves must satisfy (5.5a), (6.16), 6.6.

All matrices here are static: they follow from the `Structure` alone. Their columns are the blocks of one MV.
"""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float, Int

from jaxmpc.problem.structure import Structure


@functools.lru_cache(maxsize=64)
def block_starts(structure: Structure) -> Int[np.ndarray, " block"]:
    """First sample of every block."""
    return np.concatenate([[0], np.cumsum(structure.blocks)[:-1]]).astype(int)


@functools.lru_cache(maxsize=64)
def moves_per_block(structure: Structure) -> Int[np.ndarray, " block"]:
    """Samples that carry the block's move: its length in `moves`, one in `inputs`."""
    lengths = np.asarray(structure.blocks)
    return lengths if structure.blocking == "moves" else np.ones_like(lengths)


@functools.lru_cache(maxsize=64)
def sample_moves(structure: Structure) -> Float[np.ndarray, "sample block"]:
    """Matrix that turns block moves into the moves of the Hu samples."""
    matrix = np.zeros((structure.control_horizon, structure.block_count))
    for block, (start, count) in enumerate(
        zip(block_starts(structure), moves_per_block(structure), strict=True)
    ):
        matrix[start : start + count, block] = 1.0
    return matrix


@functools.lru_cache(maxsize=64)
def block_members(structure: Structure) -> Float[np.ndarray, "sample block"]:
    """Which samples belong to which block."""
    return np.repeat(np.eye(structure.block_count), structure.blocks, axis=0)


@functools.lru_cache(maxsize=64)
def position_rows(structure: Structure) -> Float[np.ndarray, "block block"]:
    """Change of the MV at the end of each block; with a constant move in a block its ends bound all samples."""
    return np.tril(np.ones((structure.block_count, structure.block_count))) * moves_per_block(structure)


@functools.lru_cache(maxsize=64)
def oscillation_rows(structure: Structure) -> Float[np.ndarray, "row block"]:
    """Differences of consecutive sample moves that couple two blocks (6.16).

    Differences inside a block are zero in `moves`. In `inputs` a block longer than one sample ends with zero moves,
    so its neighbours are not coupled but limited one by one: see `single_step_blocks`.
    """
    rows = []
    for block in range(1, structure.block_count):
        if structure.blocking == "moves" or structure.blocks[block - 1] == 1:
            row = np.zeros(structure.block_count)
            row[block - 1], row[block] = -1.0, 1.0
            rows.append(row)
    return np.array(rows).reshape(-1, structure.block_count)


@functools.lru_cache(maxsize=64)
def single_step_blocks(structure: Structure) -> np.ndarray:
    """Blocks whose move has a zero move beside it, so that the oscillation rows limit it to one step."""
    if structure.blocking == "moves":
        return np.zeros(structure.block_count, dtype=bool)
    longer = np.asarray(structure.blocks) > 1
    return longer | np.concatenate([[False], longer[:-1]])


@functools.lru_cache(maxsize=64)
def window_rows(structure: Structure) -> Float[np.ndarray, "sample block"]:
    """Moves of the horizon inside the mean-move window that ends at each sample (6.6, predictive mode)."""
    if structure.mean_move_mode != "predictive":
        return np.zeros((0, structure.block_count))
    cumulative = np.cumsum(sample_moves(structure), axis=0)
    delayed = np.zeros_like(cumulative)
    window = structure.mean_move_window
    delayed[window:] = cumulative[:-window] if window < len(cumulative) else 0.0
    return cumulative - delayed


@functools.lru_cache(maxsize=64)
def hard_rows(structure: Structure) -> Float[np.ndarray, "row n"]:
    """All hard rows on the moves of all MVs, MV after MV: positions, oscillation (integer MVs), windows.

    Columns are MV-major (`block` fastest). `condense.row_limits` gives the limits in the same order.
    """
    n = structure.mv_count * structure.block_count
    parts = []
    for mv in range(structure.mv_count):
        own = [position_rows(structure)]
        if mv in structure.integer_mvs:
            own.append(oscillation_rows(structure))
        own.append(window_rows(structure))
        rows = np.concatenate(own)
        wide = np.zeros((len(rows), n))
        wide[:, mv * structure.block_count : (mv + 1) * structure.block_count] = rows
        parts.append(wide)
    return np.concatenate(parts)


@functools.lru_cache(maxsize=64)
def first_position_rows(structure: Structure) -> Int[np.ndarray, " mv"]:
    """Where the position rows of each MV begin in `hard_rows`; there is one per block."""
    rows, blocks = hard_rows(structure), structure.block_count
    return np.array([np.flatnonzero(rows[:, mv * blocks])[0] for mv in range(structure.mv_count)])
