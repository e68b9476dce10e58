"""What a study is, as typed data: what is hashed and stored with its results.

Unknown keys, wrong types and impossible values are refused with the path of the offending key before anything
is computed.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import msgspec
import numpy as np

from jaxmpc.check import among, located, require
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from jaxmpc.process.process import Process
from studies.definition.sections import ReferenceDefinition as ReferenceDefinition


def held(rows: np.ndarray, samples: int, dt: float) -> np.ndarray:
    """Values ``"sample value"`` that hold from one row to the next, 0 before the first.

    Args:
        rows: ``"row 1+value"``, increasing times [s] and the values from then on; a row counts from the first sample that
            starts at its time or later.
        samples: of the run.
        dt: sampling interval [s].
    """
    place = np.searchsorted(rows[:, 0], (np.arange(samples) + 1e-9) * dt, side="right")
    return np.concatenate([np.zeros((1, rows.shape[1] - 1)), rows[:, 1:]])[place]


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
        actuator: ``step`` if MVs move as their actuators do, ``continuous`` if they take every value.
        blocking: ``moves``, ``inputs`` or ``none``; see `jaxmpc.process.process.Process.structure`.
        tuning: name of a preset of the process; its first if not given.
        changes: fields of `jaxmpc.problem.tuning.Tuning` that replace those of the preset.
        then: later tunings, in order of time; the controller keeps its state.
        open_loop_from: the plan of this time [s] is carried out to its end, whatever the well does; never if None.
        time_limit: of one step [s], for a mixed-integer controller; None for none.
        mean_move_mode: ``reactive`` or ``predictive``; see `jaxmpc.problem.structure.Structure`.
        schedule: whether the model follows the MVs, see `jaxmpc.controller.schedule`.
        position_feedback: whether it is told where the actuators stand, and predicts from there.
        model: file of its step-response model, relative to the process file; that of the process if not given.
    """

    name: str
    label: str
    kind: Literal["continuous", "mixed-integer"]
    actuator: Literal["continuous", "step"]
    blocking: Literal["moves", "inputs", "none"] = "moves"
    tuning: str = ""
    changes: dict[str, Any] = {}
    then: tuple[TuningChange, ...] = ()
    open_loop_from: float | None = None
    time_limit: float | None = None
    mean_move_mode: Literal["reactive", "predictive"] = "reactive"
    schedule: bool = False
    position_feedback: bool = False
    model: str = ""

    def structure(self, process: Process) -> Structure:
        """The checked structure."""
        whole = self.kind == "mixed-integer"
        return process.structure(self.blocking, integer=whole, mean_move_mode=self.mean_move_mode)

    def build_tuning(self, process: Process) -> Tuning:
        """The checked tuning that the run starts with."""
        return process.tuning(self.structure(process), self.tuning or None, self.changes)

    def later_tunings(self, process: Process) -> tuple[tuple[float, Tuning], ...]:
        """The checked tunings of `then`, with the times from which they hold [s].

        Raises:
            InputError: naming the entry of `then`.
        """
        out, changes = [], dict(self.changes)
        for i, change in enumerate(self.then):
            changes |= change.changes
            with located(lambda field, i=i: f"then[{i}].changes.{field.removeprefix('tuning.')}"):
                tuning = process.tuning(self.structure(process), self.tuning or None, changes)
                out.append((change.at, tuning))
        return tuple(out)

    def resolved(self, process: Process) -> dict[str, Any]:
        """Every number that this controller runs with, presets filled in."""
        out = {
            "kind": self.kind,
            "actuator": self.actuator,
            "structure": dataclasses.asdict(self.structure(process)),
            "tuning": _fields(self.build_tuning(process)),
        }
        if self.then:
            out["then"] = [
                {"at": at, "tuning": _fields(tuning)} for at, tuning in self.later_tunings(process)
            ]
        for key in ("open_loop_from", "time_limit"):
            if getattr(self, key) is not None:
                out[key] = getattr(self, key)
        for key in ("schedule", "position_feedback"):
            if getattr(self, key):
                out[key] = True
        return out

    def check(self, process: Process, duration: float) -> None:
        """Build everything once.

        Args:
            duration: of the run [s].

        Raises:
            InputError: naming the field, by its path in the controller.
        """
        expected = f"continuous: no MV of {process.name} moves in steps or among values"
        require(not (self.model and self.schedule), "model", self.model, "nothing: it has a gain schedule")
        require(self.kind == "continuous" or process.stepped, "kind", self.kind, expected)
        self.build_tuning(process)
        self.later_tunings(process)
        dt, before, earlier = process.dt, 0.0, "the start"
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
        process: a shipped process, or a process file.
        plant: name of one of its plants.
        controllers: in the order of reports.
        reference: setpoints.
        disturbance: rows of time [s] and one value per disturbance of the process, each held until the next; none before
            the first.
    """

    name: str
    title: str
    process: str
    plant: str
    controllers: tuple[ControllerDefinition, ...]
    reference: ReferenceDefinition
    disturbance: tuple[tuple[float, ...], ...] = ()

    def offsets(self, process: Process) -> np.ndarray:
        """Disturbances at every sample, ``"sample disturbance"``."""
        rows = np.array(self.disturbance, dtype=float).reshape(-1, 1 + len(process.disturbances))
        return held(rows, self.reference.build(process).samples(process.dt), process.dt)

    def check(self, process: Process) -> None:
        """Build everything once, so that bad values are refused before a run.

        Raises:
            InputError: naming the field.
        """
        among("plant", self.plant, process.plants)
        names = [controller.name for controller in self.controllers]
        distinct = names and len(set(names)) == len(names)
        require(distinct, "controllers", names, "one or more controllers with distinct names")
        reference = self.reference.build(process)
        duration, dt = reference.duration, process.dt
        for controller in self.controllers:
            path = f"controllers.{controller.name}"
            with located(lambda field, path=path: f"{path}.{field}"):
                controller.check(process, duration)
        require(reference.samples(dt) >= 1, "reference.duration", duration, f"at least one sample of {dt} s")
        last = -1.0
        for i, (start, *values) in enumerate(self.disturbance):
            increasing = max(last, 0.0) <= start < duration and start != last
            require(increasing, f"disturbance[{i}][0]", start, f"increasing times from 0 to {duration:g} s")
            listed = ", ".join(f"{d.name} [{d.unit}]" for d in process.disturbances)
            good = len(values) == len(process.disturbances) and np.isfinite(values).all()
            require(good, f"disturbance[{i}]", values, f"finite values of {listed}")
            last = start
