"""Closed loops with targets for the MVs (thesis 6.7, (6.20)): the plant also reports its actuators to `TargetController`."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from jaxmpc.controller.targets import TargetController
from jaxmpc.errors import InputError
from jaxmpc.loop.simulate import simulate
from jaxmpc.loop.trajectory import AXES, Trajectory
from jaxmpc.process.host import HostPlant
from jaxmpc.process.plant import JaxPlant, disturbances_of
from jaxmpc.process.reference import Reference


def simulate_with_targets(
    controller: TargetController,
    plant: Any,
    reference: Reference,
    mv_target: Reference,
    *,
    noise=None,
    faults=None,
    position_feedback: bool = False,
    **options: Any,
) -> Trajectory:
    """Close the loop with setpoints for the CVs and targets for the MVs.

    Args:
        reference: setpoints, one column per CV.
        mv_target: targets over time, one column per MV; columns of MVs without a target are not looked at.
        noise: standard deviation of the measurement noise, ``"cv"`` [CV unit]; demands are known without noise.
        faults, position_feedback: as in `jaxmpc.simulate`, for the plant's own CVs.

    Returns:
        `Trajectory` of the plant's own CVs; `setpoint` has those of `reference`. Its objective is J + J_u (6.20).

    Raises:
        InputError: as `jaxmpc.simulate`, and if the targets have not one column per MV.
    """
    own, targeted = controller.structure, controller.targeted
    if mv_target.cv_count != own.mv_count:
        names = ", ".join(own.mv_names)
        raise InputError(
            "mv_target", f"{mv_target.cv_count} columns", f"{own.mv_count} columns, one per MV ({names})"
        )
    if noise is not None:
        given = np.asarray(noise, dtype=np.float64)
        if given.shape != (own.cv_count,):
            raise InputError(
                "noise", np.asarray(noise).tolist(), f"{own.cv_count} standard deviations, one per CV"
            )
        noise = np.append(given, np.zeros(len(targeted)))
    if faults is not None:
        faults = np.asarray(faults, dtype=np.float64)
        if faults.ndim != 2 or faults.shape[1] != own.cv_count:
            raise InputError("faults", f"shape {list(faults.shape)}", f"[sample, {own.cv_count}] errors")
        faults = np.pad(faults, ((0, 0), (0, len(targeted))))
    both = _joined(reference, mv_target, own.dt, targeted)
    reporting = _Reporting(plant, targeted, position_feedback)
    given = dict(noise=noise, faults=faults, position_feedback=position_feedback)
    wide = simulate(controller.controller, reporting, both, **given, **options)
    count = own.cv_count
    fields = {key: getattr(wide, key)[:, :count] for key in AXES["cv"]}
    return dataclasses.replace(wide, **fields, cv_names=own.cv_names, cv_units=own.cv_units)


def _joined(reference: Reference, mv_target: Reference, dt: float, targeted: tuple[int, ...]) -> Reference:
    """Setpoints and targets in one reference, which changes where either does."""
    duration = min(reference.duration, mv_target.duration)
    times = sorted({0.0, *reference.times.tolist(), *mv_target.times.tolist()})
    times = np.array([t for t in times if t < duration])
    held = lambda r: r.setpoints[np.searchsorted(r.times, times, side="right") - 1]  # noqa: E731
    return Reference(
        times, np.concatenate([held(reference), held(mv_target)[:, list(targeted)]], axis=1), duration
    )


class _Outputs(NamedTuple):
    cv: np.ndarray
    mv: np.ndarray


class _Reporting:
    """A plant on the host that also measures the MVs with a target: their demands, or their positions if these are told."""

    def __init__(self, plant: Any, targeted: tuple[int, ...], told: bool):
        self.plant = HostPlant(plant) if isinstance(plant, JaxPlant) else plant
        self.disturbance_names = disturbances_of(plant)
        self.targeted, self.told, self.dt = list(targeted), told, plant.dt

    def init(self) -> _Outputs:
        outputs = self.plant.init()
        return self._report(outputs, outputs.mv)

    def step(self, mv, disturbance: Any = 0.0) -> _Outputs:
        return self._report(self.plant.step(mv, disturbance), mv)

    def _report(self, outputs, demand) -> _Outputs:
        known = np.asarray(outputs.mv if self.told else demand)[self.targeted]
        return _Outputs(np.append(np.asarray(outputs.cv), known), np.asarray(outputs.mv))
