"""What the integer searches need of a `CondensedQp`, computed once per structure, model and tuning."""

from __future__ import annotations

import jax
import numpy as np

from jaxmpc.errors import InputError
from jaxmpc.integer.lower_bound import assignment_order, leading_factor, root_factor, schur_complement
from jaxmpc.problem.blocking import hard_rows
from jaxmpc.problem.condense import CondensedQp, integer_columns
from jaxmpc.problem.structure import Structure
from jaxmpc.relaxed.solve import cold_start


def _check_finite(qp: CondensedQp) -> None:
    for values in (qp.hessian, qp.curvature, qp.scale, qp.row_size, qp.bend, qp.reach):
        if not np.isfinite(values).all():
            raise FloatingPointError


class Constants:
    """Of one scenario."""

    def __init__(self, structure: Structure, qp: CondensedQp):
        self.structure, self.qp = structure, qp
        self.rows = hard_rows(structure)
        predictions = structure.cv_count * structure.horizon_count
        self.cold = jax.tree.map(np.asarray, cold_start(qp, len(self.rows), predictions))
        self.integer = integer_columns(structure)
        self.scales = np.asarray(qp.scale)  # MV units per unit of x
        hessian = np.asarray(qp.hessian)
        self.order = assignment_order(structure.block_count, len(structure.integer_mvs))
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
        self.slope = np.asarray(qp.soft_linear)[predictions:]  # of the envelope rows
        self.knot = np.asarray(qp.deadzone)[predictions:]
        self.levels = len(self.slope) // max(len(self.integer), 1)
        self.scale = max(float(np.diag(np.asarray(qp.curvature)).max()), 1e-12)
        full = np.diag(np.asarray(qp.curvature))[self.integer]
        self.own_weight = (
            0.5 * (full - np.diag(hessian)[self.integer]) if self.levels else np.zeros(len(self.integer))
        )
