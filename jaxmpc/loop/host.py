"""Closed loops that ask the host at every sample: for plants outside JAX, and plans that are carried out.

Their lanes decide in one compiled call, and then their plants step one after the other. `loop.simulate` calls it for one
loop, `loop.host_lanes` for many.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from jaxmpc import status
from jaxmpc.controller.measurement import MISSING, received
from jaxmpc.controller.sample import Sample
from jaxmpc.controller.state import ControllerState, StepInfo
from jaxmpc.errors import PlantError
from jaxmpc.loop.compiled import Inputs
from jaxmpc.loop.events import Course, Stage
from jaxmpc.loop.interventions import CarriedOut

REPORT = 20  # samples between two progress reports
NOTHING = {"status": status.FAILED, "fallback": True, "quality": MISSING}  # of a plant that has failed


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
    run, total = HostLoops(controllers, inputs, stages, blind), inputs.disturbance.shape[1]

    def tick(done: int) -> None:
        if progress is not None and (done % REPORT == 0 or done == total):
            progress(done, total)

    run.begin([plant])
    if not run.failed:
        run.compile()  # before the clock starts
        with undisturbed():
            fields = run.advanced([plant], tick, lambda: bool(run.failed))
    for error in run.failed.values():
        raise error
    return {name: values[0] for name, values in fields.items()}


class HostLoops:
    """Loops under way, of lanes that decide together; arguments as of `simulate_on_host`."""

    def __init__(
        self, controllers: Any, inputs: Inputs, stages: Sequence[Sequence[Stage]], blind: int | None = None
    ):
        self.course, self.inputs, self.blind = Course(controllers, stages), inputs, blind
        self.told = Told(inputs, controllers.size.future)
        structure, count = controllers.structure, controllers.count
        # where a lane has no plant (any more) its MVs are somebody else's: there is nothing to decide
        self.alive = np.zeros(count, dtype=bool)
        self.cv, self.mv = np.zeros((count, structure.cv_count)), np.zeros((count, structure.mv_count))
        self.failed: dict[int, PlantError] = {}

    def begin(self, plants: Sequence[Any]) -> None:
        """Start a plant per lane; lanes without one are copies of the last."""
        self.alive[: len(plants)] = True
        self._each(plants, lambda lane, plant: plant.init())

    def compile(self) -> None:
        """Decide a sample of no consequence."""
        self._decide(self.course.controllers.init(self.cv, self.mv), self.cv, 0)

    def advanced(
        self, plants: Sequence[Any], tick: Callable[[int], None], stopped: Callable[[], bool]
    ) -> dict[str, np.ndarray]:
        """The whole run of plants that have begun, ``"lane sample ..."``; `tick` is told how many samples are done."""
        offsets, errors, faults = self.inputs.disturbance, self.inputs.errors, self.inputs.faults
        state, records, carried = self.course.controllers.init(self.cv, self.mv), [], None
        named = [hasattr(plant, "disturbance_names") for plant in plants]
        for k in range(offsets.shape[1]):
            measured = self.alive.copy()
            cv = np.where(measured[:, None], self.cv + errors[:, k], np.nan)
            self.course.enter(k)
            if carried is None:
                arrived = received(cv, faults[:, k], np.asarray(state.sensors.value))
                state, info = self._decide(state, arrived, k)
                record = recorded(cv, state, info)
                if k == self.blind:
                    own = {name: value[0] for name, value in record.items()}
                    carried = CarriedOut(self.course.controllers.structure, own)
            else:
                later = carried.record(k - (self.blind or 0), cv[0])
                record = {name: value[None] for name, value in later.items()}
            demand = record["mv_demand"]

            def step(lane, plant, at=k, demand=demand):
                off = offsets[lane, at] if named[lane] else float(offsets[lane, at, 0])
                return plant.step(demand[lane], off)

            self._each(plants, step)
            record["mv"] = np.where(self.alive[:, None], self.mv, np.nan)
            records.append({name: _masked(name, v, measured) for name, v in record.items()})
            tick(k + 1)
            if stopped():
                break
        return {name: np.stack([record[name] for record in records], axis=1) for name in records[0]}

    def _decide(self, state, arrived: np.ndarray, k: int):
        gone = np.repeat(~self.alive[:, None], self.mv.shape[1], axis=1)
        sample = self.told.sample(k, arrived, self.mv, self.course.manual, gone)
        return self.course.controllers.decide(state, sample)

    def _each(self, plants: Sequence[Any], act: Callable[[int, Any], Any]) -> None:
        """Do something with the plant of every lane that has one, and keep what it measures."""
        for lane in np.flatnonzero(self.alive).tolist():
            try:
                outputs = act(lane, plants[lane])
            except PlantError as error:
                self.alive[lane], self.failed[lane] = False, error
            else:
                self.cv[lane], self.mv[lane] = outputs.cv, outputs.mv


def _masked(name: str, values: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Values of a field, and none where the plant had failed before."""
    if measured.all():
        return values
    none = np.nan if values.dtype.kind == "f" else NOTHING.get(name, 0)
    return np.where(measured.reshape(-1, *[1] * (values.ndim - 1)), values, none).astype(values.dtype)


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
