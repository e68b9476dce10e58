"""What a study is, as typed data: what is hashed and stored with its results.

Unknown keys, wrong types and impossible values are refused with the path of the offending key before anything
is computed.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import msgspec
import numpy as np

from jaxmpc.errors import InputError
from jaxmpc.reference import Reference
from jaxmpc.structure import Structure
from jaxmpc.tuning import Tuning
from studies import presets

PlantKind = Literal["fmu", "jax"]
PLANTS: tuple[PlantKind, ...] = ("fmu", "jax")


class ReferenceDefinition(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Setpoints over time; see `jaxmpc.reference.Reference`.

    Attributes:
        times: change times [s].
        setpoints: one row per change, in CV order [CV unit].
        duration: length of the run [s].
    """

    times: tuple[float, ...]
    setpoints: tuple[tuple[float, ...], ...]
    duration: float

    @classmethod
    def of(cls, reference: Reference) -> ReferenceDefinition:
        """The definition of an existing reference."""
        return cls(
            tuple(reference.times.tolist()),
            tuple(tuple(row) for row in reference.setpoints.tolist()),
            reference.duration,
        )

    def build(self) -> Reference:
        """The checked reference."""
        return Reference(self.times, self.setpoints, self.duration)


class ControllerDefinition(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One controller and the actuator that it drives.

    Attributes:
        name: short and unique, the coordinate of the results.
        label: for legends.
        kind: ``continuous`` or ``mixed-integer`` MPC.
        actuator: ``continuous`` or ``step`` choke.
        blocking: ``moves``, ``inputs`` or ``none``; see `studies.presets.structure`.
        tuning: name of a preset in `studies.presets.TUNINGS`.
        changes: fields of `jaxmpc.tuning.Tuning` that replace those of the preset.
    """

    name: str
    label: str
    kind: Literal["continuous", "mixed-integer"]
    actuator: Literal["continuous", "step"]
    blocking: Literal["moves", "inputs", "none"] = "moves"
    tuning: str = "thesis"
    changes: dict[str, Any] = {}

    def structure(self) -> Structure:
        """The checked structure."""
        return presets.structure(self.blocking, integer=self.kind == "mixed-integer")

    def build_tuning(self) -> Tuning:
        """The checked tuning."""
        return presets.tuning(self.structure(), self.tuning, self.changes)

    def resolved(self) -> dict[str, Any]:
        """Every number that this controller runs with, presets filled in."""
        tuning = self.build_tuning()
        fields = {f.name: np.asarray(getattr(tuning, f.name)).tolist() for f in dataclasses.fields(tuning)}
        return {
            "kind": self.kind,
            "actuator": self.actuator,
            "structure": dataclasses.asdict(self.structure()),
            "tuning": fields,
        }


class ComparisonDefinition(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Several controllers over one reference on one plant.

    Attributes:
        name: of the study.
        title: for reports.
        plant: ``fmu`` or ``jax``.
        controllers: in the order of reports.
        reference: setpoints.
    """

    name: str
    title: str
    plant: PlantKind
    controllers: tuple[ControllerDefinition, ...]
    reference: ReferenceDefinition

    def check(self) -> None:
        """Build everything once, so that bad values are refused before a run.

        Raises:
            InputError: naming the field.
        """
        if self.plant not in PLANTS:
            raise InputError("plant", self.plant, f"one of {', '.join(PLANTS)}")
        names = [controller.name for controller in self.controllers]
        if not names or len(set(names)) != len(names):
            raise InputError("controllers", names, "one or more controllers with distinct names")
        reference = self.reference.build()
        first = self.controllers[0].structure()
        for controller in self.controllers:
            structure = controller.structure()
            controller.build_tuning()
            if structure.dt != first.dt:
                raise InputError(
                    f"controllers.{controller.name}.dt", structure.dt, f"{first.dt} s like the others"
                )
            if reference.cv_count != structure.cv_count:
                raise InputError(
                    "reference.setpoints",
                    f"{reference.cv_count} columns",
                    f"{structure.cv_count} columns, one per CV ({', '.join(structure.cv_names)})",
                )
        if reference.samples(first.dt) < 1:
            raise InputError("reference.duration", reference.duration, f"at least one sample of {first.dt} s")
