"""A closed loop that asks the host at every sample: for plants outside JAX, and plans that are carried out.

`loop.simulate` is the only caller.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from jaxmpc.controller.measurement import received
from jaxmpc.controller.sample import Sample
from jaxmpc.controller.state import ControllerState, StepInfo
from jaxmpc.loop.compiled import Inputs
from jaxmpc.loop.events import Course, Stage
from jaxmpc.loop.interventions import CarriedOut

REPORT = 20  # samples between two progress reports


def simulate_on_host(
    controllers: Any,
    plant: Any,
    inputs: Inputs,
    stages: Sequence[Sequence[Stage]],
    blind: int | None,
    progress: Callable[[int, int], None] | None,
) -> dict[str, np.ndarray]:
    """One closed loop; fields of `Trajectory`.

    Args:
        controllers: a single one that steps like `Batch`, in its first stage.
        stages: as of `simulate_compiled`.
        blind: sample whose plan is carried out without feedback; None for none.
        progress: called with ``(done, total)`` samples.
    """
    offsets, errors, faults = inputs.disturbance[0], inputs.errors[0], inputs.faults[0]
    total, named = len(offsets), hasattr(plant, "disturbance_names")
    outputs, course, told = plant.init(), Course(controllers, stages), Told(inputs, controllers.size.future)
    now, mv = np.asarray(outputs.cv), np.asarray(outputs.mv)
    state = controllers.init(now[None], mv[None])
    controllers.decide(
        state, told.sample(0, now[None], mv[None], course.manual)
    )  # compile before the clock starts
    records: list[dict[str, Any]] = []
    carried = None
    with undisturbed():
        for k in range(total):
            cv = np.asarray(outputs.cv) + errors[k]
            course.enter(k)
            if carried is None or blind is None:
                arrived = received(cv, faults[k], np.asarray(state.sensors.value)[0])
                sample = told.sample(k, arrived[None], np.asarray(outputs.mv)[None], course.manual)
                state, info = course.controllers.decide(state, sample)
                record = {name: value[0] for name, value in recorded(cv[None], state, info).items()}
                carried = CarriedOut(controllers.structure, record) if k == blind else None
            else:
                record = carried.record(k - blind, cv)
            outputs = plant.step(record["mv_demand"], offsets[k] if named else float(offsets[k, 0]))
            records.append(record | {"mv": np.asarray(outputs.mv)})
            if progress is not None and ((k + 1) % REPORT == 0 or k + 1 == total):
                progress(k + 1, total)
    return {name: np.stack([record[name] for record in records]) for name in records[0]}


class Told:
    """What controllers are told at a sample, all arrays with a lane axis.

    Args:
        future: samples of the shift register, which a preview covers; beyond the end of the run the last sample is repeated.
    """

    def __init__(self, inputs: Inputs, future: int):
        self.preview, self.positions = inputs.preview, inputs.told[:, None]
        self.rows = rows = future if inputs.preview else 1
        beyond = lambda v: np.concatenate([v, np.repeat(v[:, -1:], rows, axis=1)], axis=1)  # noqa: E731
        self.setpoints, self.dv = beyond(inputs.setpoints), beyond(inputs.dv)

    def sample(self, k: int, cv: np.ndarray, mv: np.ndarray, manual: np.ndarray, gone: Any = False) -> Sample:
        """Sample k.

        Args:
            cv: what arrived [CV unit].
            mv: where the actuators stand, told to lanes with position feedback [MV unit].
            manual: MVs that are held.
            gone: MVs of no plant, which are held where they stood.
        """
        first = k + 1 if self.preview else k  # the setpoint of the sample itself where no other is told
        dv = self.dv[:, k : k + self.rows] if self.dv.size else None
        stands = np.where(self.positions | gone, mv, np.nan)
        return Sample(cv, self.setpoints[:, first : first + self.rows], stands, manual | gone, dv)


def recorded(cv: np.ndarray, state: ControllerState, info: StepInfo) -> dict[str, np.ndarray]:
    """What a sample of some lanes leaves behind, by the names of `Trajectory`; `cv` as sensors without fault measure it."""
    found = {f.name: getattr(info, f.name) for f in dataclasses.fields(info) if f.name != "recovering"}
    found |= dict(
        mv_demand=found.pop("mv"), plan=found.pop("moves"), bias=state.bias, bias_raw=state.bias_raw
    )
    return {"cv": cv} | {name: np.asarray(value) for name, value in found.items()}


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """No search for garbage among what is there already: compiled programs would keep it busy for a fifth of a second."""
    if gc.get_freeze_count():  # the caller's business
        yield
        return
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
