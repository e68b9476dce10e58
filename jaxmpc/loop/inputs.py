"""What goes into closed loops, checked before anything runs: for one run, and for all lanes of a sweep.

`jaxmpc.loop.simulate` is the only caller. A sweep stays on the host; the loop takes some lanes at a time from it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxmpc.controller.batch import Batch
from jaxmpc.errors import InputError
from jaxmpc.loop.compiled import Inputs
from jaxmpc.loop.events import Stage, has_lanes, staged
from jaxmpc.loop.noise import check_deviation, check_seed, errors_of
from jaxmpc.problem.structure import Structure
from jaxmpc.process.plant import JaxPlant, StatefulPlant, disturbances_of
from jaxmpc.process.reference import Reference
from jaxmpc.programs.lanes import Lanes, for_all


@dataclasses.dataclass(frozen=True)
class Sweep:
    """All lanes of a sweep on the host, checked."""

    controllers: Batch
    plants: Lanes[JaxPlant] | Sequence[StatefulPlant]
    setpoints: Sequence[np.ndarray]  # one for all, or one per lane
    offsets: np.ndarray  # "sample disturbance" or "lane sample disturbance"
    deviation: np.ndarray  # "lane cv"
    seeds: np.ndarray  # "lane 2": seed and stream
    faults: np.ndarray  # "sample cv" or "lane sample cv"
    position_feedback: np.ndarray  # "lane"
    stages: list[list[Stage]]  # of every controller; empty without events
    measured: list[int]  # which of the disturbances the controllers are told
    preview: bool
    samples: int
    count: int

    @property
    def structure(self) -> Structure:
        """Of the controllers, the same in every lane."""
        return self.controllers.structure

    @classmethod
    def checked(
        cls,
        controllers,
        plants,
        reference,
        *,
        samples=None,
        disturbance=None,
        noise=None,
        seed: Any = 0,
        faults=None,
        position_feedback: Any = False,
        preview: Any = False,
        events=(),
    ) -> Sweep:
        """The sweep, or an `InputError` that names what does not fit."""
        structure = controllers.structure
        plants, first, own_plants = _plants(plants, structure)
        setpoints, own_references = _setpoints(reference, structure, samples)
        samples = len(setpoints[0]) if setpoints else samples or 0
        names = disturbances_of(first)
        for name in controllers.dv_names:
            if name not in names:
                raise InputError("model.dv", name, f"one of the plant's disturbances, {list(names)}")
        if not isinstance(preview, bool | np.bool_):
            raise InputError("preview", preview, "true or false")
        offsets = _numbers(disturbance, (samples, len(names)))
        if len(names) == 1 and offsets.ndim in (1, 2) and offsets.shape[-1:] == (samples,):
            offsets = offsets[..., None]
        failing = _numbers(faults, (samples, structure.cv_count))
        told = np.asarray(position_feedback)
        if told.ndim > 1 or told.dtype != np.bool_:
            raise InputError("position_feedback", position_feedback, "true or false, or one of them per lane")
        deviation, seed = check_deviation(noise, structure.cv_count), check_seed(seed)
        own_controllers = controllers.count > 1 or controllers.scenarios.lanes
        count = _lanes(
            controllers=controllers.count if own_controllers else None,
            plants=own_plants,
            reference=len(setpoints) if own_references else None,
            disturbance=len(offsets) if offsets.ndim == 3 else None,
            noise=len(deviation) if deviation.ndim == 2 else None,
            seed=len(seed) if seed.ndim else None,
            faults=len(failing) if failing.ndim == 3 else None,
            position_feedback=len(told) if told.ndim else None,
            events=len(events) if has_lanes(events) else None,
        )
        each = (
            f"one per sample and disturbance ({', '.join(names)})"
            if names
            else "of a plant without disturbances"
        )
        shape = samples, len(names)
        _fitting("disturbance", offsets, shape, count, f"finite numbers, {each}", finite=True)
        shape = samples, structure.cv_count
        _fitting("faults", failing, shape, count, "errors, one per sample and CV")
        stages = []
        if events:
            controllers, stages = staged(controllers, events, count, samples)
        stream = np.arange(count) if seed.ndim == 0 else np.zeros(count)
        return cls(
            controllers=controllers,
            plants=plants,
            setpoints=setpoints,
            offsets=offsets,
            deviation=np.broadcast_to(deviation, (count, structure.cv_count)),
            seeds=np.stack([np.broadcast_to(seed, count), stream], axis=1).astype(np.int64),
            faults=failing,
            position_feedback=np.broadcast_to(told, count),
            stages=stages,
            measured=[names.index(name) for name in controllers.dv_names],
            preview=bool(preview),
            samples=samples,
            count=count,
        )

    def controllers_of(self, index: np.ndarray) -> Batch:
        """The controllers of some lanes."""
        if self.controllers.count == 1:
            return self.controllers.repeated(len(index))
        return self.controllers.part(index)

    def stages_of(self, index: np.ndarray) -> list[list[Stage]]:
        """What holds from which sample on in some lanes; nothing without events."""
        if len(self.stages) == 1:
            return self.stages * len(index)
        return [self.stages[k] for k in index] if self.stages else []

    def inputs_of(self, index: np.ndarray) -> Inputs:
        """What comes from outside, of some lanes."""
        disturbance = self._of(self.offsets, 3, index)
        return Inputs(
            setpoints=self.setpoints_of(index),
            disturbance=disturbance,
            errors=errors_of(self.deviation[index], self.seeds[index], self.samples),
            faults=self._of(self.faults, 3, index),
            told=self.position_feedback[index],
            dv=disturbance[..., self.measured],
            preview=self.preview,
        )

    def setpoints_of(self, index: np.ndarray) -> np.ndarray:
        """Setpoints "lane sample cv" of some lanes; no copies where all are the same."""
        if len(self.setpoints) == 1:
            return np.broadcast_to(self.setpoints[0], (len(index), *self.setpoints[0].shape))
        return np.stack([self.setpoints[k] for k in index])

    @staticmethod
    def _of(values: np.ndarray, axes: int, index: np.ndarray) -> np.ndarray:
        """Those of some lanes, where there is a lane axis or not."""
        return values[index] if values.ndim == axes else np.broadcast_to(values, (len(index), *values.shape))


def _plants(plants, structure: Structure):
    """The plants, the first of them, and how many lanes they have of their own, or None."""
    if isinstance(plants, (list, tuple)):
        if not plants:
            raise InputError("plants", [], "one or more, one per lane")
        first, count = plants[0], len(plants)
    else:
        plants = plants if isinstance(plants, Lanes) else for_all(plants)
        first, count = plants.shared, plants.count
    if abs(first.dt - structure.dt) > 1e-9 * structure.dt:
        expected = f"the controller's sampling interval {structure.dt} s"
        raise InputError("plant.dt", first.dt, expected)
    return plants, first, count


def _setpoints(reference, structure: Structure, samples: int | None) -> tuple[list[np.ndarray], bool]:
    """Setpoints "sample cv" of every reference, and whether there is one per lane."""
    per_lane = not isinstance(reference, Reference)
    references = list(reference) if per_lane else [reference]
    if samples is None and references:
        samples = min(r.samples(structure.dt) for r in references)
    for r in references:
        if r.cv_count != structure.cv_count:
            expected = f"one per CV: {', '.join(structure.cv_names)}"
            raise InputError("reference.setpoints", f"{r.cv_count} columns", expected)
    known = {r: r.sample(structure.dt, samples) for r in dict.fromkeys(references)}
    return [known[r] for r in references], per_lane


def _numbers(given, shape: tuple[int, ...]) -> np.ndarray:
    """As an array; zeros where nothing is given."""
    return np.zeros(shape) if given is None else np.asarray(given, dtype=np.float64)


def _lanes(**counts: int | None) -> int:
    """The one number of lanes of all that has lanes."""
    given = {name: count for name, count in counts.items() if count is not None}
    if len(set(given.values())) != 1 or not min(given.values()):
        expected = "one number of lanes, 1 or more, in all that has lanes"
        raise InputError("lanes", given or "none", expected)
    return next(iter(given.values()))


def _fitting(path: str, array: np.ndarray, shape, count: int, what: str, *, finite: bool = False) -> None:
    """An InputError unless the array has this shape, for all lanes or with a lane axis."""
    shapes = shape, (count, *shape)
    if array.shape not in shapes or (finite and not np.isfinite(array).all()):
        expected = f"{' or '.join(str(list(s)) for s in shapes)} {what}"
        raise InputError(path, f"shape {list(array.shape)}", expected)
