"""Move blocking (thesis 6.2) in both modes, and the rows that blocked moves must satisfy (5.5a), (6.16), 6.6.

All matrices here are static: they follow from the `Structure` alone. Their columns are the blocks of one MV; which one
matters only where the MVs have blocks of their own.
"""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxmpc.problem.structure import Structure


def block_starts(structure: Structure, mv: int = 0) -> Int[np.ndarray, " block"]:
    """First sample of every block."""
    return np.concatenate([[0], np.cumsum(structure.blocks_of(mv))[:-1]]).astype(int)


@functools.lru_cache(maxsize=64)
def moves_per_block(structure: Structure, mv: int = 0) -> Int[np.ndarray, " block"]:
    """Samples that carry the block's move: its length in `moves`, one in `inputs`."""
    lengths = np.asarray(structure.blocks_of(mv))
    return lengths if structure.blocking == "moves" else np.ones_like(lengths)


@functools.lru_cache(maxsize=64)
def sample_moves(structure: Structure, mv: int = 0) -> Float[np.ndarray, "sample block"]:
    """Matrix that turns block moves into the moves of the Hu samples."""
    matrix = np.zeros((structure.control_horizon, len(structure.blocks_of(mv))))
    for block, (start, count) in enumerate(
        zip(block_starts(structure, mv), moves_per_block(structure, mv), strict=True)
    ):
        matrix[start : start + count, block] = 1.0
    return matrix


def moves_of_samples(
    structure: Structure, moves: Float[np.ndarray, "block mv"]
) -> Float[np.ndarray, "sample mv"]:
    """Moves of the Hu samples by a plan; what it has beyond the blocks of an MV is not read."""
    if not structure.own_blocks:
        return sample_moves(structure) @ moves
    own = (sample_moves(structure, mv) for mv in range(structure.mv_count))
    return np.stack([matrix @ moves[: matrix.shape[1], mv] for mv, matrix in enumerate(own)], axis=1)


def counts_by_mv(structure: Structure) -> Int[np.ndarray, "block mv"]:
    """`moves_per_block` of all MVs, 0 beyond the blocks of an MV."""
    counts = np.zeros((structure.block_count, structure.mv_count), dtype=int)
    for mv in range(structure.mv_count):
        own = moves_per_block(structure, mv)
        counts[: len(own), mv] = own
    return counts


def block_members(structure: Structure, mv: int = 0) -> Float[np.ndarray, "sample block"]:
    """Which samples belong to which block."""
    blocks = structure.blocks_of(mv)
    return np.repeat(np.eye(len(blocks)), blocks, axis=0)


@functools.lru_cache(maxsize=64)
def coupled_blocks(structure: Structure, mv: int = 0) -> Bool[np.ndarray, " block"]:
    """Blocks whose move is coupled to the one before by an oscillation row (6.16).

    Differences inside a block are zero in `moves`. In `inputs` a block longer than one sample ends with zero moves,
    so its neighbours are not coupled but limited one by one: see `single_step_blocks`.
    """
    alone = np.asarray(structure.blocks_of(mv)) == 1
    return np.concatenate([[False], alone[:-1] | (structure.blocking == "moves")])


def single_step_blocks(structure: Structure, mv: int = 0) -> np.ndarray:
    """Blocks whose move has a zero move beside it, so that the oscillation rows limit it to one step."""
    blocks = structure.blocks_of(mv)
    if structure.blocking == "moves":
        return np.zeros(len(blocks), dtype=bool)
    longer = np.asarray(blocks) > 1
    return longer | np.concatenate([[False], longer[:-1]])


@functools.lru_cache(maxsize=64)
def window_rows(structure: Structure, mv: int = 0) -> Float[np.ndarray, "sample block"]:
    """Moves of the horizon inside the mean-move window that ends at each sample (6.6, predictive mode)."""
    if structure.mean_move_mode != "predictive":
        return np.zeros((0, len(structure.blocks_of(mv))))
    cumulative = np.cumsum(sample_moves(structure, mv), axis=0)
    delayed = np.zeros_like(cumulative)
    window = structure.mean_move_window
    delayed[window:] = cumulative[:-window] if window < len(cumulative) else 0.0
    return cumulative - delayed
