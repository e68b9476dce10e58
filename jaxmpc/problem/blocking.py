"""Move blocking (thesis 6.2) in both modes, and the rows that blocked moves must satisfy (5.5a), (6.16), 6.6.

All matrices here are static: they follow from the `Structure` alone. Their columns are the blocks of one MV.
"""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxmpc.problem.structure import Structure


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


def block_members(structure: Structure) -> Float[np.ndarray, "sample block"]:
    """Which samples belong to which block."""
    return np.repeat(np.eye(structure.block_count), structure.blocks, axis=0)


@functools.lru_cache(maxsize=64)
def coupled_blocks(structure: Structure) -> Bool[np.ndarray, " block"]:
    """Blocks whose move is coupled to the one before by an oscillation row (6.16).

    Differences inside a block are zero in `moves`. In `inputs` a block longer than one sample ends with zero moves,
    so its neighbours are not coupled but limited one by one: see `single_step_blocks`.
    """
    alone = np.asarray(structure.blocks) == 1
    return np.concatenate([[False], alone[:-1] | (structure.blocking == "moves")])


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
