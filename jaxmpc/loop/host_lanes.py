"""Many closed loops on plants that keep their own state, such as FMUs, each of which works in a process of its own.

The lanes of a part decide in one compiled call, and then their plants step one after the other; as many parts as there are
cores run side by side in threads. While one thread waits for its FMU, the other decides or waits for another one, so that
all cores have work, and only the FMUs of the parts under way have a process.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxmpc import status
from jaxmpc.controller.controller import Batch
from jaxmpc.controller.measurement import MISSING, received
from jaxmpc.errors import PlantError
from jaxmpc.loop.compiled import Inputs
from jaxmpc.loop.events import Course, Stage
from jaxmpc.loop.host import Told, recorded, undisturbed
from jaxmpc.process.plant import StatefulPlant, closing
from jaxmpc.programs.compilation import compiling_for
from jaxmpc.programs.threads import parts_of, side_by_side

TOGETHER = 8  # lanes of a part
NOTHING = {"status": status.FAILED, "fallback": True, "quality": MISSING}  # of a plant that has failed


def simulate_host_lanes(
    controllers: Batch,
    plants: Sequence[StatefulPlant],
    inputs: Inputs,
    progress: Callable[[int], None] | None = None,
    stages: Sequence[Sequence[Stage]] = (),
) -> tuple[dict[str, np.ndarray], dict[int, PlantError]]:
    """Closed loops of controllers and plants, one of each per lane; plants are closed when their loop is over.

    A plant that fails ends its own lane: what is measured from then on is not a number, nothing is decided, and the status
    is ``failed``. Results do not depend on the number of cores.

    Args:
        plants: whose processes start with `init`, so that no more of them run than are needed (`FmuPlant.replaced`).
        progress: told how many samples of all lanes were done, by one thread at a time.
        stages: as of `simulate_compiled`.

    Returns:
        ``(fields, failures)``: fields of `Trajectory`, ``"lane sample ..."``, and what ended a lane, by its number.
    """
    lock, count, failures = threading.Lock(), len(plants), {}
    parts = parts_of(count, TOGETHER, cut=True)
    runs = [
        _Run(controllers.part(part), inputs.part(part), [stages[k] for k in part] if stages else [])
        for part in parts
    ]
    with compiling_for(f"loops of {controllers.size}"):
        runs[0].compile()

    def advance(k: int, stopped: Callable[[], bool]) -> dict[str, np.ndarray]:
        first = len(parts[0]) * k
        own = plants[first : first + len(parts[0])]

        def tick(samples: int) -> None:
            if progress is not None:
                with lock:
                    progress(samples * len(own))

        fields, failed = runs[k].advanced(own, tick, stopped)
        failures.update({first + lane: error for lane, error in failed.items()})
        return {name: values[: len(own)] for name, values in fields.items()}

    with undisturbed():
        found = side_by_side(advance, range(len(parts)))
    fields = {name: np.concatenate([part.pop(name) for part in found]) for name in list(found[0])}
    return fields, dict(sorted(failures.items()))


class _Run:
    """Loops under way, of lanes that decide together."""

    def __init__(self, controllers: Batch, inputs: Inputs, stages: Sequence[Sequence[Stage]]):
        self.course, self.inputs = Course(controllers, stages), inputs
        self.told = Told(inputs, controllers.size.future)
        structure, count = controllers.structure, controllers.count
        # where a lane has no plant (any more) its MVs are somebody else's: there is nothing to decide
        self.alive = np.zeros(count, dtype=bool)
        self.cv, self.mv = np.zeros((count, structure.cv_count)), np.zeros((count, structure.mv_count))
        self.failed: dict[int, PlantError] = {}

    def compile(self) -> None:
        """Before the clock starts."""
        self._decide(self.course.controllers.init(self.cv, self.mv), self.cv, 0)

    def advanced(
        self, plants: Sequence[Any], tick: Callable[[int], None], stopped: Callable[[], bool]
    ) -> tuple[dict[str, np.ndarray], dict[int, PlantError]]:
        """The whole run of a plant per lane; lanes without one are copies of the last."""
        self.alive[: len(plants)] = True
        with contextlib.ExitStack() as stack:
            for plant in plants:
                stack.enter_context(closing(plant))
            self._each(plants, lambda lane, plant: plant.init())
            records = self._samples(plants, tick, stopped)
        return {name: np.stack([r[name] for r in records], axis=1) for name in records[0]}, self.failed

    def _samples(self, plants, tick, stopped) -> list[dict[str, np.ndarray]]:
        offsets, errors, faults = self.inputs.disturbance, self.inputs.errors, self.inputs.faults
        state, records = self.course.controllers.init(self.cv, self.mv), []
        named = [hasattr(plant, "disturbance_names") for plant in plants]
        for k in range(offsets.shape[1]):
            measured = self.alive.copy()
            cv = np.where(measured[:, None], self.cv + errors[:, k], np.nan)
            arrived = received(cv, faults[:, k], np.asarray(state.sensors.value))
            self.course.enter(k)
            state, info = self._decide(state, arrived, k)
            record = recorded(cv, state, info)
            demand = record["mv_demand"]

            def step(lane, plant, at=k, demand=demand):
                off = offsets[lane, at] if named[lane] else float(offsets[lane, at, 0])
                return plant.step(demand[lane], off)

            self._each(plants, step)
            record["mv"] = np.where(self.alive[:, None], self.mv, np.nan)
            records.append({name: _masked(name, v, measured) for name, v in record.items()})
            tick(1)
            if stopped():
                break
        return records

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
