"""Input targets in the controller (thesis 6.7, (6.20)-(6.21)): a price on the distance of an MV from its ideal value.

J_new = J + sum over j = 1..Hp of weight * (u(k+j-1) - u_target)^2, with u held after the control horizon. An MV with a
target gets a CV of its own: its step response is 1 from the next sample on, its measurement the present demand, its
setpoint the target. Prediction, condensing, relaxations, whole moves, batches and certificates then need not know of
targets at all, and the answer is exact. `TargetController` hides the further CVs; `loop.targets` closes the loop.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import ArrayLike, Bool, Float

from jaxmpc.check import is_number
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.core import ControllerState, StepInfo
from jaxmpc.controller.sample import checked, checked_off, checked_start
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.structure import Structure, check_match
from jaxmpc.problem.tuning import CV_FIELDS, DEFAULTS, Tuning

SUFFIX = ".target"


def augment(
    structure: Structure,
    tuning: Tuning,
    model: StepResponseModel,
    target_weight: Mapping[str, float],
) -> tuple[Structure, Tuning, StepResponseModel]:
    """The controller's problem with one more CV per MV that has a target, named ``valve.target`` and the like.

    Every sample j = first_penalised..Hp pays weight * (u(k+j-1) - target)^2; beyond the control horizon u is held, so that
    its last value counts Hp - Hu + 1 times.

    Args:
        target_weight: by MV name [1/MV unit^2], 0 or more; an MV that is not named gets no CV.

    Returns:
        ``(structure, tuning, model)`` with the further CVs after the others, in MV order; as given for an empty mapping.

    Raises:
        InputError: naming the MV, for unknown names and weights that are negative or not finite.
    """
    check_match(structure, model)
    if not isinstance(target_weight, Mapping):
        raise InputError("target_weight", target_weight, "a mapping from MV name to weight [1/MV unit^2]")
    for name, weight in target_weight.items():
        if name not in structure.mv_names:
            raise InputError(
                f"target_weight.{name}", weight, f"one of the MV names {', '.join(structure.mv_names)}"
            )
        if not is_number(weight) or weight < 0:
            raise InputError(f"target_weight.{name}", weight, "a finite number, 0 or more [1/MV unit^2]")
    mvs = [i for i, name in enumerate(structure.mv_names) if name in target_weight]
    if not mvs:
        return structure, tuning, model
    names = tuple(structure.mv_names[i] + SUFFIX for i in mvs)
    taken = [name for name in names if name in structure.cv_names]
    if taken:
        raise InputError("structure.cv_names", taken[0], f"no CV whose name ends in {SUFFIX}")
    wide_names = structure.cv_names + names
    units = _units(structure.cv_units, structure.cv_count, structure.mv_units, mvs)
    wide_structure = dataclasses.replace(structure, cv_names=wide_names, cv_units=units)
    new: dict[str, Any] = {key: DEFAULTS.get(key, 0.0) for key in CV_FIELDS} | {"slack_weight": 0.0}
    new["cv_weight"] = [float(target_weight[structure.mv_names[i]]) for i in mvs]
    wide = {
        key: jnp.concatenate([getattr(tuning, key), jnp.broadcast_to(jnp.asarray(new[key]), (len(mvs),))])
        for key in CV_FIELDS
    }
    own = np.zeros((len(mvs), structure.mv_count, model.samples))
    own[np.arange(len(mvs)), mvs] = 1.0
    wide_model = dataclasses.replace(
        model,
        coefficients=jnp.concatenate([model.coefficients, jnp.asarray(own)]),
        dv_coefficients=np.pad(np.asarray(model.dv_coefficients), ((0, len(mvs)), (0, 0), (0, 0))),
        cv_names=wide_names,
        cv_units=_units(model.cv_units, structure.cv_count, model.mv_units, mvs),
    )
    return wide_structure, dataclasses.replace(tuning, **wide), wide_model


def _units(cv_units: tuple[str, ...], cvs: int, mv_units: tuple[str, ...], mvs: list[int]) -> tuple[str, ...]:
    """Units of the CVs and of the MVs with a target; empty where neither is known."""
    if not cv_units and not mv_units:
        return ()
    return (cv_units or ("",) * cvs) + tuple(mv_units[i] if mv_units else "" for i in mvs)


class TargetController:
    """A controller that also steers some MVs to targets; `step` takes them beside the setpoints.

    Without integer MVs `step` is pure, as that of `Controller`.

    Args:
        target_weight: by MV name [1/MV unit^2]; see `augment`.

    Attributes:
        structure: as given, without the further CVs.
        controller: the controller of the augmented problem.
        targeted: MVs with a target, positions in MV order.
    """

    def __init__(
        self,
        structure: Structure,
        tuning: Tuning,
        model: StepResponseModel,
        target_weight: Mapping[str, float],
        **options: Any,
    ):
        self.structure = structure
        self.controller = Controller(*augment(structure, tuning, model, target_weight), **options)
        self.targeted = tuple(i for i, name in enumerate(structure.mv_names) if name in target_weight)

    def init(
        self,
        cv: Float[ArrayLike, " cv"],
        mv: Float[ArrayLike, " mv"],
        dv: Float[ArrayLike, " dv"] | None = None,
    ) -> ControllerState:
        """State at a steady state; arguments and errors as in `Controller.init`."""
        cv, mv, dv = checked_start(self.structure, cv, mv, dv, dv_names=self.controller.model.dv_names)
        return self.controller.init(self._with(cv, mv), mv, dv)

    def step(
        self,
        state: ControllerState,
        cv: Float[ArrayLike, " cv"],
        setpoint: Float[ArrayLike, " cv"] | Float[ArrayLike, "horizon cv"],
        mv_target: Float[ArrayLike, " mv"],
        mv: Float[ArrayLike, " mv"] | None = None,
        manual: Bool[ArrayLike, " mv"] | None = None,
        dv: Float[ArrayLike, " dv"] | Float[ArrayLike, "horizon dv"] | None = None,
        cv_off: Bool[ArrayLike, " cv"] | None = None,
    ) -> tuple[ControllerState, StepInfo]:
        """One sample; the objective in the info is J + J_u (6.20).

        Args:
            cv: measurement now, without the further CVs [CV unit].
            setpoint: at j = 1..Hp, or held over the horizon [CV unit].
            mv_target: held over the horizon [MV unit]; entries of MVs without a target are not looked at.
            mv, manual, dv, cv_off: as in `Controller.step`.
        """
        given = checked(self.structure, cv, setpoint, mv, manual)
        self._check_targets(mv_target)
        xp = _module(given.cv, given.mv, state.position)
        stands = xp.where(given.mv == given.mv, given.mv, state.position)
        wide = self._with(given.cv, stands), self._with(given.setpoint, mv_target)
        off = np.append(checked_off(self.structure, cv_off), np.zeros(len(self.targeted), dtype=bool))
        return self.controller.step(state, *wide, given.mv, given.manual, dv, off)

    def _check_targets(self, mv_target: Any) -> None:
        """Refuse targets of another shape, and those that are not finite where they are looked at."""
        names = ", ".join(self.structure.mv_names[i] for i in self.targeted)
        good = np.shape(mv_target) == (self.structure.mv_count,)
        if good and not isinstance(mv_target, Tracer):
            good = np.isfinite(np.asarray(mv_target, dtype=np.float64)[list(self.targeted)]).all()
        if not good:
            expected = f"{self.structure.mv_count} numbers [MV unit], one per MV, finite for {names}"
            raise InputError("mv_target", mv_target, expected)

    def _with(self, cv, mv):
        """Values of the CVs, over a horizon or not, then those of the MVs with a target; on the host if these are."""
        xp = _module(cv, mv)
        own = xp.asarray(mv)[np.asarray(self.targeted, dtype=int)]
        return xp.concatenate(
            [xp.asarray(cv), xp.broadcast_to(own, (*cv.shape[:-1], len(self.targeted)))], axis=-1
        )


def _module(*values: Any) -> Any:
    return jnp if any(isinstance(value, Tracer) for value in values) else np
