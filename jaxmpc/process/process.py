"""A process: what a study needs to know beyond the controller, in one typed object and one TOML file.

CVs, MVs with their actuators and disturbances by name and unit, plants, the model, the default structure, presets of
tunings, references, disturbances over time and key figures. Study keys, key figures, figures, reports and the app follow
from it. `jaxmpc.process.file` reads the TOML; `jaxmpc.process.library` has the shipped processes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxmpc import html
from jaxmpc.check import among
from jaxmpc.errors import InputError
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import FIELDS, Tuning, make_tuning
from jaxmpc.process.actuator import Actuator
from jaxmpc.process.reference import Reference
from jaxmpc.process.variables import Cv as Cv
from jaxmpc.process.variables import KeyFigure, ModelSource
from jaxmpc.process.variables import Mv as Mv
from jaxmpc.process.variables import PlantSource as PlantSource
from jaxmpc.process.variables import Variable as Variable

Fields = dict[str, Any]
BLOCKING = "moves", "inputs", "none"


def amount(value: float, unit: str) -> str:
    """A number in three digits with its unit, if it has one."""
    return f"{value:.3g}" + (f" {unit}" if unit not in ("", "1") else "")


@dataclasses.dataclass(frozen=True, eq=False)
class Process:
    """One process; made by `jaxmpc.process.file.load_process`, checked when it exists.

    Attributes:
        name: of letters, digits and dashes; names its studies.
        dt: sampling interval [s].
        plants: by name, the default first.
        structure_fields: fields of `Structure` that are not its defaults.
        presets: fields of `Tuning` by preset, the default first.
        references: setpoints by name, the default first.
        courses: disturbances by name: rows of start [s] and one value per disturbance, each held until the next.
        folder: that files are relative to.
        body: content of the file.
    """

    name: str
    title: str
    source: str
    dt: float
    cvs: tuple[Cv, ...]
    mvs: tuple[Mv, ...]
    disturbances: tuple[Variable, ...]
    plants: Mapping[str, PlantSource]
    model: ModelSource
    structure_fields: Fields
    presets: Mapping[str, Fields]
    references: Mapping[str, Reference]
    courses: Mapping[str, np.ndarray]
    key_figures: tuple[KeyFigure, ...]
    folder: str = "."
    body: Fields = dataclasses.field(default_factory=dict)

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html.process(self)

    @property
    def cv_names(self) -> tuple[str, ...]:
        """Names of the CVs."""
        return tuple(cv.name for cv in self.cvs)

    @property
    def mv_names(self) -> tuple[str, ...]:
        """Names of the MVs."""
        return tuple(mv.name for mv in self.mvs)

    @property
    def disturbance_names(self) -> tuple[str, ...]:
        """Names of the disturbances, in the order of the plant's."""
        return tuple(disturbance.name for disturbance in self.disturbances)

    @property
    def units(self) -> dict[str, str]:
        """Units by name."""
        return {v.name: v.unit for v in (*self.cvs, *self.mvs, *self.disturbances)}

    @property
    def labels(self) -> dict[str, str]:
        """Labels by name."""
        return {v.name: v.label for v in (*self.cvs, *self.mvs, *self.disturbances)}

    @property
    def stepped(self) -> tuple[int, ...]:
        """Positions of the MVs whose actuators do not take every value."""
        return tuple(i for i, mv in enumerate(self.mvs) if mv.actuator.kind != "continuous")

    @property
    def settled(self) -> np.ndarray:
        """Half widths ``"cv"`` around the setpoint in which CVs count as settled [CV unit]."""
        return np.array([cv.settled for cv in self.cvs])

    @property
    def default_preset(self) -> str:
        """The first preset."""
        return next(iter(self.presets))

    @property
    def default_reference(self) -> str:
        """The first reference."""
        return next(iter(self.references))

    def actuators(self, actual: bool = True) -> tuple[Actuator, ...]:
        """Of the MVs; where they are not the actual ones, they take every value between the same limits."""
        return tuple(mv.actuator if actual else Actuator(low=mv.low, high=mv.high) for mv in self.mvs)

    def structure(self, blocking: str = "", *, integer: bool = False, **changes: Any) -> Structure:
        """The default structure.

        Args:
            blocking: meaning of a block, or ``none`` for single moves; that of the process if not given.
            integer: whether MVs with stepped actuators move in whole steps or among their values.
            **changes: further fields of `Structure`.

        Raises:
            InputError: naming the field.
        """
        blocking = blocking or self.structure_fields.get("blocking", BLOCKING[0])
        if blocking not in BLOCKING:
            raise InputError("structure.blocking", blocking, "'moves', 'inputs' or 'none'")
        given = dict(self.structure_fields)
        given |= {"blocks": ()} if blocking == "none" else {"blocking": blocking}
        if integer:
            steps = [mv.actuator.step if mv.actuator.kind == "stepped" else None for mv in self.mvs]
            lists = [mv.actuator.listed for mv in self.mvs]
            given["integer_step"] = tuple(steps)
            given["integer_values"] = tuple(lists) if any(lists) else ()
        else:
            given.pop("dwell", None)
        return Structure(
            cv_names=self.cv_names,
            mv_names=self.mv_names,
            dt=self.dt,
            cv_units=tuple(cv.unit for cv in self.cvs),
            mv_units=tuple(mv.unit for mv in self.mvs),
            **(given | changes),
        )

    def tuning_fields(self, preset: str | None = None, changes: Fields | None = None) -> Fields:
        """Fields of a preset, the default one if none is named, some replaced; limits of CVs and MVs filled in.

        Raises:
            InputError: for an unknown preset; unknown fields are refused by `make_tuning`.
        """
        preset = self.default_preset if preset is None else preset
        among("tuning", preset, self.presets, "one of the presets")
        own: Fields = {}
        for key, field, variables in (
            ("cv_low", "low", self.cvs),
            ("cv_high", "high", self.cvs),
            ("mv_low", "low", self.mvs),
            ("mv_high", "high", self.mvs),
            ("move_high", "move", self.mvs),
        ):
            own[key] = {v.name: _or_none(getattr(v, field)) for v in variables}
        own["move_low"] = {mv.name: _or_none(-mv.move) for mv in self.mvs}
        given = {
            key: dict(value) if isinstance(value, dict) else value
            for key, value in self.presets[preset].items()
        }
        return own | given | (changes or {})

    def tuning(
        self, structure: Structure, preset: str | None = None, changes: Fields | None = None
    ) -> Tuning:
        """A preset for a structure; oscillation rows (6.16) hold for MVs that are integer in it.

        Args:
            structure: gives names, sizes, and which MVs are integer.
            preset: the default one if none is named.
            changes: fields of `Tuning` that replace those of the preset.
        """
        fields = self.tuning_fields(preset, changes)
        rows, whole = fields.get("oscillation_rows"), {structure.mv_names[i] for i in structure.integer_mvs}
        if isinstance(rows, dict) and "oscillation_rows" not in (changes or {}):
            fields["oscillation_rows"] = {name: on and name in whole for name, on in rows.items()}
        return make_tuning(structure, **{key: self._complete(key, value) for key, value in fields.items()})

    def reference(self, name: str | None = None) -> Reference:
        """Setpoints by name; the default ones if none is named.

        Raises:
            InputError: for an unknown name.
        """
        name = self.default_reference if name is None else name
        among("reference", name, self.references)
        return self.references[name]

    def _complete(self, key: str, value: Any) -> Any:
        """A mapping by name with what is left out in it, where there is a value for that."""
        field = FIELDS.get(key)
        if field is None or not isinstance(value, dict) or (field.default is None and not field.infinite):
            return value
        names = self.cv_names if field.of == "cv" else self.mv_names
        return {**{name: field.default for name in names if name not in value}, **value}


def _or_none(limit: float) -> float | None:
    return None if np.isinf(limit) else limit
