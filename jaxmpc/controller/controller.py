"""A controller (thesis 5.3, 6): `init` and `step(state, measurement, setpoint) -> (state, info)`.

It is one lane of `jaxmpc.controller.batch` without its axis. Without integer MVs a step is pure, and may be used inside
`jax.jit`, `jax.vmap` and `jax.lax.scan`.
"""

from __future__ import annotations

import copy
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Bool, Float

from jaxmpc.controller.batch import Batch, Controllers, one_lane, traced
from jaxmpc.controller.core import Core
from jaxmpc.controller.sample import checked, checked_off, checked_start
from jaxmpc.controller.state import ControllerState, StepInfo
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning


class Controller:
    """MPC of one process (thesis chapters 5 and 6), with whole moves of the integer MVs if the structure has any.

    Without integer MVs, `init` and `step` are pure functions inside `jax.jit`, `jax.vmap` and `jax.lax.scan`, and the tuning
    may be traced as well.

    Args:
        gap: relative gap of a solve with whole moves.
        time_limit: seconds per solve, None for none.
        finish: path that closes the integer problem, see `jaxmpc.integer.solve`.
    """

    def __init__(
        self,
        structure: Structure,
        tuning: Tuning,
        model: StepResponseModel,
        *,
        gap: float = 1e-6,
        time_limit: float | None = None,
        finish: str = "auto",
    ):
        made = Controllers(structure, tuning, model, gap=gap, time_limit=time_limit, finish=finish)
        self.lanes: Batch = made
        self.structure, self.tuning, self.model = structure, tuning, model
        self.gap, self.time_limit, self.finish = gap, time_limit, finish

    def with_tuning(self, tuning: Tuning) -> Self:
        """This controller with another tuning, for the states of this one.

        It shares the compiled programs, unless the tuning is the first with a CV limit, an ideal value or a `bad_limit`.
        """
        other = copy.copy(self)
        other.tuning, other.lanes = tuning, self.lanes.of(self.lanes.scenarios.with_tunings([tuning]))
        return other

    @property
    def compiled(self) -> bool:
        """Whether its steps may be part of a compiled loop."""
        return True

    @property
    def core(self) -> Core:
        """What compiled programs know of the controller."""
        return self.lanes.cores.shared

    def init(
        self,
        cv: Float[ArrayLike, " cv"],
        mv: Float[ArrayLike, " mv"],
        dv: Float[ArrayLike, " dv"] | None = None,
    ) -> ControllerState:
        """State at a steady state with measured CVs, present MVs and measured disturbances (engineering units).

        Args:
            dv: zeros if not given, which counts measured disturbances from the start.

        Raises:
            InputError: for other shapes and values that are not finite.
        """
        start = checked_start(self.structure, cv, mv, dv, dv_names=self.model.dv_names)
        if traced(self.core, start):
            return self.core.init(*jax.tree.map(jnp.asarray, start))
        return one_lane(self.lanes.init(*jax.tree.map(lambda v: np.asarray(v)[None], start)))

    def step(
        self,
        state: ControllerState,
        cv: Float[ArrayLike, " cv"],
        setpoint: Float[ArrayLike, " cv"] | Float[ArrayLike, "horizon cv"],
        mv: Float[ArrayLike, " mv"] | None = None,
        manual: Bool[ArrayLike, " mv"] | None = None,
        dv: Float[ArrayLike, " dv"] | Float[ArrayLike, "horizon dv"] | None = None,
        cv_off: Bool[ArrayLike, " cv"] | None = None,
    ) -> tuple[ControllerState, StepInfo]:
        """One sample.

        Args:
            state: from `init` or the previous step.
            cv: measurement now [CV unit]; NaN where there is none.
            setpoint: at j = 1..Hp, or held over the horizon [CV unit].
            dv: measured disturbances now, or at j = 0..Hp-1, now and as they will be; NaN, and without it, where they
                are as before [DV unit].
            mv: where the actuators stand before the move [MV unit], NaN where that is not known; without it, demands
                count as followed.
            manual: MVs that somebody else moves; they are predicted from `mv` and not moved.
            cv_off: CVs that somebody has switched off: without weights and limits, and predicted as ever.

        Raises:
            InputError: for other shapes, setpoints that are not finite, and where double precision is off.
            TypeError: for traced values where there are integer MVs, whose search may go on outside the program.
        """
        sample = checked(self.structure, cv, setpoint, mv, manual, dv, dv_names=self.model.dv_names)
        off = checked_off(self.structure, cv_off)
        with_lane = lambda tree: jax.tree.map(lambda leaf: leaf[None], tree)  # noqa: E731
        if not traced(self.core, state, sample):
            lane, of_lane = with_lane(jax.tree.map(np.asarray, (state, sample)))
            return self._shown(*one_lane(self.lanes.decide(lane, of_lane, off[None])))
        if self.structure.integer_mvs:
            raise TypeError("step() of a controller with integer MVs runs on the host and cannot be traced")
        core = self.lanes.without(off[None]).cores.shared
        sample = jax.tree.map(lambda v: v[0], self.lanes.over_register(with_lane(sample)))
        return self._shown(*core.conclude(core.consider(state, sample, self.gap)))

    def _shown(self, state: ControllerState, info: StepInfo) -> tuple[ControllerState, StepInfo]:
        """The planned moves without padding."""
        return state, eqx.tree_at(lambda i: i.moves, info, info.moves[: self.structure.block_count])
