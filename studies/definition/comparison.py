"""What a study is, as typed data: what is hashed and stored with its results.

Unknown keys, wrong types and impossible values are refused with the path of the offending key before anything
is computed.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import msgspec
import numpy as np

from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from studies.definition import presets
from studies.definition.refusing import located, require
from studies.definition.sections import ReferenceDefinition as ReferenceDefinition

PlantKind = Literal["fmu", "jax"]
PLANTS: tuple[PlantKind, ...] = ("fmu", "jax")


def held_offsets(steps: np.ndarray, samples: int, dt: float) -> np.ndarray:
    """Offsets ``"sample"`` that hold from one step to the next, 0 before the first.

    Args:
        steps: ``"step 2"``, increasing times [s] and the offset from then on; a step counts from the first sample that
            starts at its time or later.
        samples: of the run.
        dt: sampling interval [s].
    """
    place = np.searchsorted(steps[:, 0], (np.arange(samples) + 1e-9) * dt, side="right")
    return np.concatenate([[0.0], steps[:, 1]])[place]


class TuningChange(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Another tuning from some time on.

    Attributes:
        at: time from which it holds [s]; the first sample at or after it is the first that it decides.
        changes: fields of `jaxmpc.problem.tuning.Tuning` that replace those of the tuning before.
    """

    at: float
    changes: dict[str, Any]


class ControllerDefinition(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One controller and the actuator that it drives.

    Attributes:
        name: short and unique, the coordinate of the results.
        label: for legends.
        kind: ``continuous`` or ``mixed-integer`` MPC.
        actuator: ``continuous`` or ``step`` choke.
        blocking: ``moves``, ``inputs`` or ``none``; see `studies.definition.presets.structure`.
        tuning: name of a preset in `studies.definition.presets.TUNINGS`.
        changes: fields of `jaxmpc.problem.tuning.Tuning` that replace those of the preset.
        then: later tunings, in order of time; the controller keeps its state.
        open_loop_from: the plan of this time [s] is carried out to its end, whatever the well does; never if None.
        time_limit: of one step [s], for a mixed-integer controller; None for none.
        mean_move_mode: ``reactive`` or ``predictive``; see `jaxmpc.problem.structure.Structure`.
        schedule: whether the model follows the MVs, see `jaxmpc.controller.schedule`.
    """

    name: str
    label: str
    kind: Literal["continuous", "mixed-integer"]
    actuator: Literal["continuous", "step"]
    blocking: Literal["moves", "inputs", "none"] = "moves"
    tuning: str = "thesis"
    changes: dict[str, Any] = {}
    then: tuple[TuningChange, ...] = ()
    open_loop_from: float | None = None
    time_limit: float | None = None
    mean_move_mode: Literal["reactive", "predictive"] = "reactive"
    schedule: bool = False

    def structure(self) -> Structure:
        """The checked structure."""
        shape = presets.structure(self.blocking, integer=self.kind == "mixed-integer")
        return dataclasses.replace(shape, mean_move_mode=self.mean_move_mode)

    def build_tuning(self) -> Tuning:
        """The checked tuning that the run starts with."""
        return presets.tuning(self.structure(), self.tuning, self.changes)

    def later_tunings(self) -> tuple[tuple[float, Tuning], ...]:
        """The checked tunings of `then`, with the times from which they hold [s].

        Raises:
            InputError: naming the entry of `then`.
        """
        out, changes = [], dict(self.changes)
        for i, change in enumerate(self.then):
            changes |= change.changes
            with located(lambda field, i=i: f"then[{i}].changes.{field.removeprefix('tuning.')}"):
                out.append((change.at, presets.tuning(self.structure(), self.tuning, changes)))
        return tuple(out)

    def resolved(self) -> dict[str, Any]:
        """Every number that this controller runs with, presets filled in."""
        out = {
            "kind": self.kind,
            "actuator": self.actuator,
            "structure": dataclasses.asdict(self.structure()),
            "tuning": _fields(self.build_tuning()),
        }
        if self.then:
            out["then"] = [{"at": at, "tuning": _fields(tuning)} for at, tuning in self.later_tunings()]
        for key in ("open_loop_from", "time_limit"):
            if getattr(self, key) is not None:
                out[key] = getattr(self, key)
        if self.schedule:
            out["schedule"] = True
        return out

    def check(self, duration: float) -> None:
        """Build everything once.

        Args:
            duration: of the run [s].

        Raises:
            InputError: naming the field, by its path in the controller.
        """
        self.build_tuning()
        self.later_tunings()
        dt, before, earlier = self.structure().dt, 0.0, "the start"
        last = duration - dt
        for i, change in enumerate(self.then):
            expected = f"a time from {before + dt:g} s, a sample after {earlier}, to {last:g} s"
            require(before + dt <= change.at <= last, f"then[{i}].at", change.at, expected)
            before, earlier = change.at, "the change before"
        start, limit = self.open_loop_from, self.time_limit
        expected = f"a time from {before:g} s, the last change of tuning, to {last:g} s"
        require(start is None or before <= start <= last, "open_loop_from", start, expected)
        if limit is not None:
            expected = "None: only mixed-integer controllers have limits"
            require(self.kind == "mixed-integer", "time_limit", limit, expected)
            require(0 < limit < np.inf, "time_limit", limit, "a positive time of one step [s]")


def _fields(tuning: Tuning) -> dict[str, Any]:
    return {f.name: np.asarray(getattr(tuning, f.name)).tolist() for f in dataclasses.fields(tuning)}


class ComparisonDefinition(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Several controllers over one reference on one plant.

    Attributes:
        name: of the study.
        title: for reports.
        plant: ``fmu`` or ``jax``.
        controllers: in the order of reports.
        reference: setpoints.
        disturbance: times [s] and reservoir-pressure offsets [bar], each held until the next; none before the first.
    """

    name: str
    title: str
    plant: PlantKind
    controllers: tuple[ControllerDefinition, ...]
    reference: ReferenceDefinition
    disturbance: tuple[tuple[float, float], ...] = ()

    def offsets(self, dt: float) -> np.ndarray:
        """Reservoir-pressure offset at every sample of `dt` [s], ``"sample"`` [bar]."""
        steps = np.array(self.disturbance, dtype=float).reshape(-1, 2)
        return held_offsets(steps, self.reference.build().samples(dt), dt)

    def check(self) -> None:
        """Build everything once, so that bad values are refused before a run.

        Raises:
            InputError: naming the field.
        """
        require(self.plant in PLANTS, "plant", self.plant, f"one of {', '.join(PLANTS)}")
        names = [controller.name for controller in self.controllers]
        distinct = names and len(set(names)) == len(names)
        require(distinct, "controllers", names, "one or more controllers with distinct names")
        reference = self.reference.build()
        duration, dt = reference.duration, self.controllers[0].structure().dt
        for controller in self.controllers:
            own, path = controller.structure().dt, f"controllers.{controller.name}"
            with located(lambda field, path=path: f"{path}.{field}"):
                controller.check(duration)
            require(own == dt, f"{path}.dt", own, f"{dt} s like the others")
        require(reference.samples(dt) >= 1, "reference.duration", duration, f"at least one sample of {dt} s")
        last = -1.0
        for i, (start, offset) in enumerate(self.disturbance):
            increasing = max(last, 0.0) <= start < duration and start != last
            require(increasing, f"disturbance[{i}][0]", start, f"increasing times from 0 to {duration:g} s")
            require(np.isfinite(offset), f"disturbance[{i}][1]", offset, "a finite pressure offset [bar]")
            last = start
