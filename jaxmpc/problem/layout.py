"""A structure as arrays of a size from a short ladder: compiled programs see these, and never the structure itself.

Whatever follows from horizons, blocks, blocking mode and integer steps is built here once, with NumPy. What a structure does
not fill is padding that changes no result: moves that are fixed at zero, predictions without weight, rows without
limits. Structures of one size therefore share their programs, and may be lanes of one batch.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmpc.problem.blocking import (
    block_members,
    block_starts,
    coupled_blocks,
    moves_per_block,
    sample_moves,
    single_step_blocks,
    window_rows,
)
from jaxmpc.problem.structure import Structure

# rungs; beyond the last one, multiples of it
BLOCKS = (4, 8, 16, 32, 64, 128, 256)
HORIZON = (32, 64, 128, 256, 384, 512)
WINDOW = (32, 128, 512)
VALUES = (8, 64, 512)


def rung(count: int, ladder: tuple[int, ...]) -> int:
    """The least rung that holds so many."""
    return next((r for r in ladder if r >= count), -(-count // ladder[-1]) * ladder[-1])


class Size(NamedTuple):
    """What programs are compiled for, besides the numbers of CVs and MVs."""

    cvs: int
    mvs: int
    blocks: int  # moves per MV that are decided
    horizon: int  # predictions per CV
    # samples of the shift register, at least the prediction horizon and the coefficients of the model
    future: int
    windows: int  # rows of the predictive mean-move limit per MV; none in other modes
    past: int  # moves that the mean-move limit and the dwell remember
    own_blocks: bool = False  # whether the MVs may have blocks of their own
    values: int = 0  # allowed values of an MV, none where no MV has a list
    dvs: int = 0  # measured disturbances

    @classmethod
    def of(cls, structure: Structure, samples: int, dvs: int = 0) -> Size:
        """The size of a structure with a model of so many coefficients and measured disturbances."""
        lists = [values for values in structure.integer_values if values is not None]
        return cls(
            cvs=structure.cv_count,
            mvs=structure.mv_count,
            blocks=rung(structure.block_count, BLOCKS),
            horizon=rung(structure.horizon_count, HORIZON),
            future=rung(max(structure.prediction_horizon, samples), HORIZON),
            windows=rung(len(window_rows(structure)), HORIZON) if len(window_rows(structure)) else 0,
            past=rung(max(structure.mean_move_window, *structure.dwell, 1), WINDOW),
            own_blocks=structure.own_blocks,
            values=rung(max(map(len, lists)), VALUES) if lists else 0,
            dvs=dvs,
        )

    @property
    def moves(self) -> int:
        """Moves that are decided, of all MVs."""
        return self.mvs * self.blocks

    @property
    def rows(self) -> int:
        """Hard rows of one MV (`condense.Rows`)."""
        return 2 * self.blocks + self.windows

    def __str__(self) -> str:
        return f"{self.moves} moves and {self.cvs} x {self.horizon} predictions"

    def __or__(self, other: Size) -> Size:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The size that holds structures of both."""
        return Size(*map(max, self, other))  # pyright: ignore[reportArgumentType]


class Layout(eqx.Module):
    """A structure as arrays, padded to a `Size`.

    What blocks decide is there once for all MVs, or with an axis of the MVs before it where a size has `own_blocks`.
    """

    start: Int[Array, "*mv block"]  # first sample of every block
    length: Int[Array, "*mv block"]  # samples of every block, none of padding
    count: Float[Array, "*mv block"]  # samples that carry the move of a block (`blocking.moves_per_block`)
    # blocks of several samples of which only the first may move (blocking ``inputs``)
    longer: Bool[Array, "*mv block"]
    single: Bool[Array, "*mv block"]  # `blocking.single_step_blocks`
    # blocks whose move is coupled to the one before by an oscillation row (6.16)
    coupled: Bool[Array, "*mv block"]
    window: Float[Array, "*mv window block"]  # rows of the predictive mean-move limit (6.6)
    remaining: Float[Array, "window past"]  # past moves that are still inside each of these windows
    share: Float[Array, " past"]  # of the past moves in the reactive mean (6.6), 0 in other modes
    window_length: Float[Array, ""]  # samples of the window
    shift: Float[Array, "*mv block block"]  # the plan one sample later, in blocks again
    whole: Bool[Array, "mv block"]  # moves that are whole
    integer: Bool[Array, " mv"]  # integer MVs
    step: Float[Array, " mv"]  # their steps [MV unit], 1 for continuous ones
    first: Int[Array, ""]  # Hw
    last: Int[Array, ""]  # Hp
    dt: Float[Array, ""]  # sampling interval [s]
    # allowed values, infinite for MVs without a list and beyond its end; None where the size has none [MV unit]
    values: Float[Array, "mv value"] | None = None

    @property
    def real(self) -> Bool[Array, "*mv block"]:
        """Blocks that are no padding."""
        return self.length > 0

    def shifted(self, moves: Float[Array, "block mv"]) -> Float[Array, "block mv"]:
        """A plan one sample later."""
        if self.shift.ndim == 2:
            return self.shift @ moves
        return jnp.einsum("mbc,cm->bm", self.shift, moves)


@functools.lru_cache(maxsize=256)
def layout_of(structure: Structure, size: Size) -> Layout:
    """The arrays of a structure, NumPy's."""
    window = structure.mean_move_window
    predictive = structure.mean_move_mode == "predictive"
    # the window that ends at sample k of the horizon holds the last window - 1 - k past moves
    age = np.arange(size.past)[::-1]  # of the past moves, oldest first
    remaining = (age[None, :] < window - 1 - np.arange(size.windows)[:, None]) & predictive
    step = structure.steps
    lists = structure.integer_values or (None,) * structure.mv_count
    allowed = [np.pad(v or (), (0, size.values - len(v or ())), constant_values=np.inf) for v in lists]
    whole = np.array([structure.whole_blocks(mv) for mv in range(size.mvs)])
    if size.own_blocks:
        each = [_of_blocks(structure, size, mv) for mv in range(size.mvs)]
        blocks = {key: np.stack([own[key] for own in each]) for key in each[0]}
    else:
        blocks = _of_blocks(structure, size, 0)
    fields: dict[str, Any] = dict(
        **blocks,
        whole=np.arange(size.blocks) < whole[:, None],
        remaining=remaining.astype(float),
        share=np.where((age < window) & (not predictive), 1.0 / window, 0.0),
        window_length=np.asarray(float(window)),
        integer=np.array([s is not None for s in step]),
        step=np.array([1.0 if s is None else s for s in step]),
        first=np.asarray(structure.first_penalised),
        last=np.asarray(structure.prediction_horizon),
        dt=np.asarray(structure.dt),
        values=np.array(allowed) if size.values else None,
    )
    return Layout(**fields)


def _of_blocks(structure: Structure, size: Size, mv: int) -> dict[str, np.ndarray]:
    """What the blocks of one MV decide."""

    def padded(values, *shape) -> np.ndarray:
        values = np.asarray(values)
        return np.pad(values, [(0, n - have) for n, have in zip(shape, values.shape, strict=True)])

    lengths, counts = np.asarray(structure.blocks_of(mv)), moves_per_block(structure, mv)
    later = np.eye(structure.control_horizon, k=1)
    shift = block_members(structure, mv).T @ later @ sample_moves(structure, mv) / counts[:, None]
    return dict(
        start=padded(block_starts(structure, mv), size.blocks),
        length=padded(lengths, size.blocks),
        count=padded(counts.astype(float), size.blocks),
        longer=padded((lengths > 1) & (structure.blocking == "inputs"), size.blocks),
        single=padded(single_step_blocks(structure, mv), size.blocks),
        coupled=padded(coupled_blocks(structure, mv), size.blocks),
        window=padded(window_rows(structure, mv), size.windows, size.blocks),
        shift=padded(shift, size.blocks, size.blocks),
    )
