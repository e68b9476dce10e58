"""Ideal values of MVs (thesis 6.7, input targets): what their distance adds to the objective (6.6).

    J_u = sum over j = Hw..Hp of weight (u(k+j-1) - ideal)^2,   (6.20)

with u held after the control horizon. It is smooth, so that solvers see it in their Hessian and gradient alone. `condense`
and `relaxed.problem` call this.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from jaxmpc.problem.layout import Layout, Size
from jaxmpc.problem.tuning import Tuning


class IdealCost(eqx.Module):
    """J_u as squares without cancellation, |by_move x + by_distance d|^2 of every MV, d its distance before all moves."""

    by_move: Float[Array, "mv row block"]
    by_distance: Float[Array, "mv row"]

    @classmethod
    def of(
        cls, layout: Layout, size: Size, tuning: Tuning, j: Array, inside: Bool[Array, " horizon"]
    ) -> IdealCost:
        """Per MV unit of every move; `j`, `inside` of `condense.penalised`."""
        # moves of every block that are made before sample j
        made = jnp.clip(j[:, None] - layout.start[..., None, :], 0, layout.count[..., None, :])
        rows = jnp.concatenate([made, jnp.ones((*made.shape[:-1], 1))], axis=-1) * inside[:, None]
        factor = jnp.linalg.qr(rows, mode="r")
        weighted = jnp.sqrt(tuning.ideal_weight)[:, None, None] * factor
        return cls(weighted[..., : size.blocks], weighted[..., size.blocks])

    def scaled(self, scale: Float[Array, " n"]) -> IdealCost:
        """The same of moves in other units."""
        mvs, _, blocks = self.by_move.shape
        return IdealCost(self.by_move * scale.reshape(mvs, 1, blocks), self.by_distance)

    def curvature(self) -> Float[Array, "n n"]:
        """Of J_u in the moves."""
        mvs, _, blocks = self.by_move.shape
        own = 2.0 * jnp.einsum("mri,mrk->mik", self.by_move, self.by_move)
        return (own[:, :, None, :] * np.eye(mvs)[:, None, :, None]).reshape(mvs * blocks, mvs * blocks)

    def linear(self, distance: Float[Array, " mv"]) -> Float[Array, " n"]:
        """Gradient of J_u without moves."""
        return 2.0 * jnp.einsum("mrb,mr->mb", self.by_move, self.by_distance * distance[:, None]).reshape(-1)

    def value(self, x: Float[Array, " n"], distance: Float[Array, " mv"]) -> Float[Array, ""]:
        """J_u."""
        mvs, _, blocks = self.by_move.shape
        away = jnp.einsum("mrb,mb->mr", self.by_move, x.reshape(mvs, blocks))
        return jnp.sum((away + self.by_distance * distance[:, None]) ** 2)


def has_ideal(tuning: Tuning) -> bool:
    """Whether any MV has an ideal value; true where that is not known yet."""
    return isinstance(tuning.ideal_weight, Tracer) or bool(np.any(np.asarray(tuning.ideal_weight) > 0.0))
