"""What the search for whole moves needs of a problem's constant part, computed once per structure, model and tuning.

The host reads `Constants`, the compiled search the arrays of `Tables`, padded to a rung of `INTEGERS`.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmpc.errors import InputError
from jaxmpc.integer.lower_bound import assignment_order, leading_factor, root_factor, schur_complement
from jaxmpc.integer.tighten import chord_weights
from jaxmpc.problem.blocking import block_starts, coupled_blocks, moves_per_block
from jaxmpc.problem.condense import CondensedQp
from jaxmpc.problem.layout import Size
from jaxmpc.problem.structure import Structure

INTEGERS = (8, 16, 31)  # rungs; codes of 64 bits hold so many moves of two bits


class Tables(eqx.Module):
    """Constants of a scenario that the search reads, integer moves in the order in which they are assigned.

    Attributes:
        count: integer moves; what follows them is padding.
        known: whether the search knows all hard rows and its codes hold all moves.
        column: their places in x; out of range for padding.
        position: hard row of the position after a move.
        pair: hard row that couples it to the move before.
        coupled: whether there is one.
        reach: row i gives the position of its MV after move i.
        previous: row i picks the move before i of the same MV.
        radius, leading: as in `lower_bound.LowerModel`.
        root: factor of the curvature, `lower_bound.root_factor`.
        slope: of the envelope of every move.
        own_weight: see `cuts`.
        scale: see `gap.closes`.
        complete: whether limits and hard rows are all that whole moves must keep; None where that is so in every lane.
    """

    count: Int[Array, ""]
    known: Bool[Array, ""]
    column: Int[Array, " integer"]
    position: Int[Array, " integer"]
    pair: Int[Array, " integer"]
    coupled: Bool[Array, " integer"]
    reach: Float[Array, "integer integer"]
    previous: Float[Array, "integer integer"]
    radius: Float[Array, " integer"]
    leading: Float[Array, "integer integer"]
    root: Float[Array, "integer integer"]
    slope: Float[Array, "level integer"]
    own_weight: Float[Array, " integer"]
    scale: Float[Array, ""]
    complete: Bool[Array, ""] | None = None


class Constants:
    """Of one scenario.

    Args:
        structure: of the controller.
        size: of its arrays.
        qp: constant part of its problems, with NumPy's arrays.

    Raises:
        InputError: for weights and responses whose products are not finite.
    """

    def __init__(self, structure: Structure, size: Size, qp: CondensedQp):
        self.structure, self.size, self.qp = structure, size, qp
        whole = [(mv, structure.whole_blocks(mv)) for mv in structure.integer_mvs]
        # MV and block of every integer move, and their places in x
        self.mv = np.repeat([mv for mv, _ in whole], [count for _, count in whole]).astype(int)
        self.block = np.concatenate([*(np.arange(count) for _, count in whole), []]).astype(int)
        self.integer = self.mv * size.blocks + self.block
        self.scales = np.asarray(qp.scale)  # MV units per unit of x
        hessian, curvature = np.asarray(qp.hessian), np.asarray(qp.curvature)
        starts = [block_starts(structure, mv)[:count] for mv, count in whole]
        self.order = assignment_order(np.concatenate([*starts, []]), self.mv)
        try:
            with np.errstate(over="raise", invalid="raise"):
                _check_finite(qp)
                self.schur, self.radius = schur_complement(hessian, self.integer)
                self.root_factor = root_factor(self.schur)
                self.leading = leading_factor(self.schur[np.ix_(self.order, self.order)])
        except (FloatingPointError, np.linalg.LinAlgError):
            raise InputError(
                "tuning",
                "weights and step responses of very different sizes",
                "numbers whose products are finite [CV unit, MV unit]",
                "Check cv_weight, move_weight, soft_quadratic, the model's coefficients and the integer steps",
            ) from None
        self.slope = np.asarray(qp.steep)[:, self.integer]  # of the envelope
        self.knot = np.arange(len(self.slope), dtype=float)[:, None]
        self.scale = float(qp.unit)
        self.own_weight = 0.5 * (np.diag(curvature) - np.diag(hessian))[self.integer]
        # hard rows of the positions of the integer MVs, and these positions as sums of the whole moves
        self.position = self.mv * size.rows + self.block
        counts = [moves_per_block(structure, mv)[:count] for mv, count in whole]
        self.counts = np.concatenate([*counts, []]).astype(int)  # samples that carry each of them
        self.reached = self._before(self.block[:, None] >= self.block[None, :]) * self.counts
        self._chord_weight: Float[np.ndarray, " position"] | None = None

    def _before(self, related: Bool[np.ndarray, "integer integer"]) -> Float[np.ndarray, "integer integer"]:
        """Which pairs of integer moves are of one MV and related."""
        return (related & (self.mv[:, None] == self.mv[None, :])).astype(float)

    @property
    def chord_weight(self) -> Float[np.ndarray, " position"]:
        """Curvature of the positions that chords may pay (`tighten`), made when first needed."""
        found = self.chords_within(None)
        assert found is not None
        return found

    def chords_within(self, seconds: float | None) -> Float[np.ndarray, " position"] | None:
        """`chord_weight` if it is known or made in so many seconds (None for no limit), else None."""
        if self._chord_weight is None:
            back = np.linalg.inv(self.reached)
            self._chord_weight = chord_weights(back.T @ self.schur @ back, seconds)
        return self._chord_weight

    def of_chords(self, price: np.ndarray, at: np.ndarray) -> tuple[float, np.ndarray]:
        """What prices of chords add to a lower bound with all curvature: its value and its gradient at moves.

        D w^2 is at least price w less the largest of price k - D k^2 over whole k; about w0 it is
        D w0^2 + 2 D w0 (w - w0) and the curvature that `schur` has.

        Args:
            price: of the chords, per hard row; empty where there are none.
            at: moves of the integer MVs [steps].
        """
        if not len(price):
            return 0.0, np.zeros(len(at))
        weight, own, w = self.chord_weight, price[self.position], self.reached @ at
        k = np.round(own / np.where(weight > 0.0, 2.0 * weight, 1.0)) * (weight > 0.0)
        value = (weight * w**2 - own * w + own * k - weight * k**2).sum()
        return float(value), self.reached.T @ (2.0 * weight * w - own)

    def tables(self, integers: int, restricted: bool = False) -> Tables:
        """For the compiled search, with room for so many integer moves.

        Args:
            restricted: whether in any lane there is more to keep than limits and hard rows.
        """
        structure, size, order = self.structure, self.size, self.order
        count, room = len(order), integers - len(order)
        known = room >= 0 and structure.mean_move_mode != "predictive" and not structure.has_gaps_or_dwell
        if not known:
            order, count, room = order[:integers], min(count, integers), max(room, 0)
        place, previous = self.position, self._before(self.block[:, None] - 1 == self.block[None, :])
        couplings = [coupled_blocks(structure, mv) for mv in range(size.mvs)]
        coupled = np.array(
            [couplings[mv][block] for mv, block in zip(self.mv, self.block, strict=True)], bool
        )

        def padded(values, absent: float = 0):
            widths = [(0, room if n == count else 0) for n in values.shape]
            return np.pad(values, widths, constant_values=absent)

        one = lambda values: values[order]  # noqa: E731
        fields: dict[str, Any] = dict(
            count=np.asarray(count),
            known=np.asarray(known),
            column=padded(one(self.integer), size.moves),
            position=padded(one(place)),
            pair=padded(size.blocks + one(place)),
            coupled=padded(one(coupled)),
            reach=padded(self.reached[np.ix_(order, order)]),
            previous=padded(previous[np.ix_(order, order)]),
            radius=padded(one(self.radius), np.inf),
            leading=padded(self.leading[:count, :count]),
            root=padded(one(self.root_factor)[:, :count]),
            slope=np.pad(self.slope[:, order], ((0, 0), (0, room))),
            own_weight=padded(one(self.own_weight)),
            scale=np.asarray(self.scale),
            complete=np.asarray(not structure.has_gaps_or_dwell) if restricted else None,
        )
        return Tables(**fields)


def _check_finite(qp: CondensedQp) -> None:
    for values in (qp.hessian, qp.curvature, qp.scale, qp.row_size, qp.bend, qp.reach):
        if not np.isfinite(values).all():
            raise FloatingPointError
