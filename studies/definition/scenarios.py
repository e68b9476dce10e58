"""A sweep study, expanded: its scenarios, the groups that share one compiled program, and the chunks that are computed.

`Study` is immutable, small and picklable, so that every worker can hold one; `scenario(k)` makes the typed inputs of one run
when they are needed. Hashes cover resolved numbers and code, so that equal scenarios of two studies have equal hashes.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, Literal

import numpy as np
from msgspec import UnsetType

from identify.plants import model_samples
from jaxmpc import html
from jaxmpc.check import require
from jaxmpc.controller.measurement import SensorFault, fault_errors
from jaxmpc.loop.events import Event, stages_of
from jaxmpc.loop.trajectory import AXES
from jaxmpc.problem.layout import Size
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning, make_tuning
from jaxmpc.process.file import process_digest
from jaxmpc.process.process import Process
from jaxmpc.process.reference import Reference
from studies.definition import models
from studies.definition.axes import AxisTable, expand_axes
from studies.definition.comparison import held
from studies.definition.estimate import MODEL_SECONDS, Description, Work, chunk_seconds
from studies.definition.resolve import Inputs, Variant, resolve, row
from studies.definition.sweep import StudyDefinition
from studies.store import fingerprint
from studies.store.layout import Column

KEY_FIGURES = 64  # numbers of a scenario besides trajectories
NUMBER_BYTES = 8
CHUNKS = 8  # at least, of a study with that many scenarios
COMPUTING = ("kpi.loop", "kpi.setpoint", "kpi.sweep", "run.chunk")  # what results depend on of `studies`


@dataclasses.dataclass(frozen=True, eq=False)
class Scenario:
    """The inputs of one run, typed and checked.

    Attributes:
        kind, tuning: of the controller.
        actuator: ``step`` if MVs move as their actuators do, ``continuous`` if they take every value.
        structure: of the controller; the same object for all scenarios of a group that agree in it.
        model_point: working point of the model, ``"mv"`` [MV unit], identified on the plant with its own parameters.
        plant: parameters of the plant that is controlled, where they are not its own, in the units of their keys.
        reference: setpoints; the same object for scenarios with the same ones.
        windows: the same before they are filtered or ramped, for the windows of key figures.
        noise: standard deviation ``"cv"`` [CV unit]; None without noise.
        seed: of the noise.
        disturbance: ``"sample disturbance"``, in the order of the process; None without any.
        faults: errors of failing sensors ``"sample cv"`` (`jaxmpc.controller.measurement.fault_errors`); None without any.
        position_feedback: whether the controller is told where the actuators stand.
        preview: whether it is told future setpoints and measured disturbances.
        events: what changes in it during the run.
    """

    number: int
    kind: Literal["continuous", "mixed-integer"]
    actuator: Literal["continuous", "step"]
    structure: Structure
    tuning: Tuning
    model_point: models.Point
    plant: dict[str, float]
    reference: Reference
    windows: Reference
    samples: int
    noise: np.ndarray | None
    seed: int
    disturbance: np.ndarray | None
    faults: np.ndarray | None
    position_feedback: bool
    preview: bool
    events: tuple[Event, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Group:
    """Scenarios that one compiled program computes with one matrix of responses where their model is the same.

    Groups of one size share the program; a batch of several structures would lose what makes its Newton steps fast.

    Attributes:
        kind, actuator, structure, samples: what all of them have.
        has_limits: whether they have a finite CV limit.
        has_ideal: whether an MV has an ideal value.
        switching: whether bad measurements may switch a CV off.
        preview: whether the controllers are told future setpoints and measured disturbances.
        points: distinct working points of their models.
        scenarios: their numbers, increasing.
    """

    kind: Literal["continuous", "mixed-integer"]
    actuator: Literal["continuous", "step"]
    structure: Structure
    samples: int
    has_limits: bool
    has_ideal: bool
    switching: bool
    preview: bool
    points: tuple[models.Point, ...]
    scenarios: np.ndarray
    model_samples: int  # coefficients of the models

    @property
    def program(self) -> tuple[Any, ...]:
        """What it is compiled for, besides the number of lanes."""
        size, whole = Size.of(self.structure, self.model_samples), bool(self.structure.integer_mvs)
        form = self.has_limits, self.has_ideal, self.switching
        return size, whole, self.actuator, *form, len(self.points) == 1


@dataclasses.dataclass(frozen=True, eq=False)
class Chunk:
    """What is computed and stored together."""

    index: int
    group: int  # index of its group
    scenarios: np.ndarray  # 1 to ``chunk_size`` scenario numbers, increasing; lanes beyond are padding


@dataclasses.dataclass(frozen=True, eq=False)
class Study:
    """All scenarios of a definition; made by `studies.load`, checked when it exists.

    Attributes:
        definition: as written, quick cuts applied.
        columns: one coordinate per axis key, in the order of the axes.
        groups: in the order of their first scenarios.
        chunks: of the groups in turn, each of consecutive scenarios of one group.
        chunk_size: lanes of every chunk: ``study.chunk_size`` or `default_chunk_size`, or the largest group if that is
            smaller.
    """

    definition: StudyDefinition
    count: int
    columns: tuple[Column, ...]
    groups: tuple[Group, ...]
    chunks: tuple[Chunk, ...]
    chunk_size: int
    _inputs: Inputs

    @property
    def name(self) -> str:
        """Of the study; ends in ``-quick`` for the quick cut."""
        return self.definition.study.name

    @property
    def title(self) -> str:
        """For reports."""
        return self.definition.study.title or self.name

    @property
    def process(self) -> Process:
        """That is controlled."""
        return self.definition.process

    @functools.cached_property
    def events(self) -> tuple[Event, ...]:
        """What changes in every controller during its run."""
        return tuple(section.event() for section in self.definition.base.get("event", ()))

    @property
    def model_points(self) -> tuple[models.Point, ...]:
        """Distinct working points of all models, for `models.identify_models`."""
        return tuple(dict.fromkeys(point for group in self.groups for point in group.points))

    def scenario(self, k: int) -> Scenario:
        """The typed inputs of scenario k."""
        inputs, variant = self._inputs, self._variant(k)
        fields = {name: row(values, k).tolist() for name, values in inputs.tuning.items()}
        noise = row(inputs.noise, k)
        return Scenario(
            number=int(k),
            kind=variant.kind,  # type: ignore[arg-type]
            actuator=variant.actuator,  # type: ignore[arg-type]
            structure=variant.structure,
            tuning=make_tuning(variant.structure, **fields),
            model_point=tuple(row(inputs.point, k).tolist()),
            plant={name: float(row(values, k)) for name, values in inputs.plant.items()},
            reference=variant.reference,
            windows=variant.windows,
            samples=variant.samples,
            noise=noise.copy() if noise.any() else None,
            seed=int(row(inputs.seed, k)),
            disturbance=self._disturbance(k),
            faults=self._faults(k),
            position_feedback=bool(row(inputs.told, k)),
            preview=bool(row(inputs.preview, k)),
            events=self.events,
        )

    def scenario_hash(self, k: int) -> str:
        """Content hash of the numbers of scenario k and of the code that turns them into a run."""
        self._variant(k)  # refuses numbers that are no scenario
        inputs, noise = self._inputs, row(self._inputs.noise, k)
        return fingerprint.content_hash(
            self._code,
            self._process,
            self._variant_hashes[inputs.variant[k]],
            {name: row(values, k).tolist() for name, values in inputs.tuning.items()},
            self._changed(k),
            row(inputs.point, k).tolist(),
            [*noise.tolist(), int(row(inputs.seed, k))] if noise.any() else None,  # no noise, no seed
            self._disturbance(k),
            self._faults(k),
            bool(row(inputs.told, k)),
            bool(row(inputs.preview, k)),
            [dataclasses.asdict(event) for event in self.events],
        )

    @functools.cached_property
    def scenario_hashes(self) -> tuple[str, ...]:
        """`scenario_hash` of every scenario, in order."""
        return tuple(self.scenario_hash(k) for k in range(self.count))

    def varying_plant(self, group: int) -> tuple[str, ...]:
        """Parameters of the plant that differ within a group, so that a compiled program takes them per lane."""
        members = self.groups[group].scenarios
        return tuple(
            name
            for name, values in self._inputs.plant.items()
            if len(values) > 1 and (values[members] != values[members[0]]).any()
        )

    @functools.cached_property
    def hash(self) -> str:
        """Of everything that the stored results depend on: all scenarios, their coordinates, and what is stored."""
        columns = [(c.key, c.label, c.unit, c.values.tolist()) for c in self.columns]
        chunks = [(c.group, c.scenarios.tolist()) for c in self.chunks]
        kept = self.definition.store.every, list(self.definition.store.trajectories)
        return fingerprint.content_hash(list(self.scenario_hashes), columns, chunks, *kept)

    def lanes(self, group: int) -> int:
        """Scenarios of the compiled program of a group, padding included."""
        return min(self.chunk_size, len(self.groups[group].scenarios))

    @property
    def work(self) -> Work:
        """The chunks and what they are expected to cost."""
        return Work(
            groups=[chunk.group for chunk in self.chunks],
            kinds=[group.kind for group in self.groups],
            seconds=[chunk_seconds(g.kind, g.samples, self.lanes(i)) for i, g in enumerate(self.groups)],
        )

    def describe(self) -> Description:
        """What a run would do, for a dry run; prints as a short table."""
        store = self.definition.store
        widths = {"": 1, "cv": len(self.process.cvs), "mv": len(self.process.mvs)}
        kept = sum(widths[axis] * len(set(names) & set(store.trajectories)) for axis, names in AXES.items())
        points = math.ceil(max(group.samples for group in self.groups) / store.every)
        identified = 0 if self.process.model.given else len(self.model_points)
        return Description(
            name=self.name,
            scenarios=self.count,
            group_sizes=tuple(len(group.scenarios) for group in self.groups),
            chunks=len(self.chunks),
            compilations=len({(*group.program, self.lanes(i)) for i, group in enumerate(self.groups)}),
            models=identified,
            samples=sum(len(group.scenarios) * group.samples for group in self.groups),
            stored_bytes=self.count * (KEY_FIGURES + kept * points) * NUMBER_BYTES,
            seconds=MODEL_SECONDS * identified + self.work.rest({}),
        )

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html.study(self)

    def _variant(self, k: int) -> Variant:
        whole = isinstance(k, (int, np.integer)) and not isinstance(k, bool)
        require(whole and 0 <= k < self.count, "scenario", k, f"a number from 0 to {self.count - 1}")
        return self._inputs.variants[self._inputs.variant[k]]

    def _changed(self, k: int) -> dict[str, float]:
        """Parameters of the plant that are not its own."""
        values = {name: float(row(given, k)) for name, given in self._inputs.plant.items()}
        own = {name: self.definition.fields[f"plant.{name}"].default for name in values}
        return {name: value for name, value in values.items() if value != own[name]}

    def _disturbance(self, k: int) -> np.ndarray | None:
        """Disturbances "sample disturbance"."""
        inputs, variant, process = self._inputs, self._variant(k), self.process
        steps, course = row(inputs.steps, k), str(row(inputs.course, k))
        if not steps[:, 1].any() and not course:
            return None
        of = np.array(inputs.step_names)
        run = variant.samples, process.dt
        columns = [
            held(steps[of == name] if len(of) else steps, *run)[:, 0] for name in process.disturbance_names
        ]
        return np.stack(columns, axis=1) + (held(process.courses[course], *run) if course else 0.0)

    def _faults(self, k: int) -> np.ndarray | None:
        """Errors of the sensors "sample cv" [CV unit]."""
        inputs, variant = self._inputs, self._variant(k)
        if not inputs.fault_kinds:
            return None
        numbers = row(inputs.faults, k).tolist()
        faults = [SensorFault(*kind, *its) for kind, its in zip(inputs.fault_kinds, numbers, strict=True)]  # type: ignore[arg-type]
        return fault_errors(variant.structure, variant.samples, faults, path="base.sensor_fault")

    @functools.cached_property
    def _process(self) -> list[str]:
        study = self.definition.study
        return [process_digest(self.process), study.plant]

    @functools.cached_property
    def _code(self) -> str:
        return code_hash()

    @functools.cached_property
    def _variant_hashes(self) -> list[str]:
        out = []
        for v in self._inputs.variants:
            reference = np.asarray(v.reference.times), np.asarray(v.reference.setpoints)
            shape = v.kind, v.actuator, dataclasses.asdict(v.structure)
            out.append(fingerprint.content_hash(*shape, *reference, v.samples))
        return out


def code_hash() -> str:
    """Of the code that turns the numbers of a scenario into results."""
    modules = [fingerprint.module_hash(f"studies.{name}") for name in COMPUTING]
    return fingerprint.content_hash(list(fingerprint.packages_hash().values()), modules)


def expand_sweep(definition: StudyDefinition, *, confirmed: bool = False) -> Study:
    """Expand a definition without ``[search]``; see `studies.load.expand`.

    What is guaranteed: every scenario has a structure, tuning, plant, working point, reference and disturbance that the
    typed objects accept, also in combination. What only a simulation shows, such as a plant that does not settle, is not.
    """
    table = expand_axes(definition, confirmed=confirmed)
    inputs = resolve(definition, table)
    groups = _groups(inputs, len(table), model_samples(definition.process))
    given = definition.study.chunk_size
    wanted = default_chunk_size(len(table)) if isinstance(given, UnsetType) else given
    size = min(wanted, max(len(group.scenarios) for group in groups))
    chunks: list[Chunk] = []
    for g, group in enumerate(groups):
        for begin in range(0, len(group.scenarios), size):
            chunks.append(Chunk(len(chunks), g, group.scenarios[begin : begin + size]))
    study = Study(definition, len(table), _columns(table), groups, tuple(chunks), size, inputs)
    for group in groups:  # the typed objects agree with the checks of whole columns
        first = study.scenario(int(group.scenarios[0]))
        stages_of(first.structure, first.tuning, study.events, first.samples, "base.event")
    return study


def default_chunk_size(scenarios: int) -> int:
    """Scenarios of a chunk where the definition does not say: a power of two that makes `CHUNKS` chunks or more, at most 64.

    So several workers have something to do, and a run that is killed loses little. It follows from the study and not from
    the workers, who may change from one start to the next; as a power of two it stays when a study grows a little, and with
    it the chunks and the compiled programs.
    """
    return 2 ** min(max(scenarios // CHUNKS, 1).bit_length() - 1, 6)


def _columns(table: AxisTable) -> tuple[Column, ...]:
    return tuple(
        Column(field.key, label, field.unit, field.column(values)[table.index[:, a]])
        for a, axis in enumerate(table.axes)
        for field, label, values in zip(axis.fields, axis.labels, axis.values, strict=True)
    )


def _groups(inputs: Inputs, count: int, samples: int) -> tuple[Group, ...]:
    tuning = inputs.tuning
    limited = np.any(np.isfinite(tuning["cv_low"]) | np.isfinite(tuning["cv_high"]), axis=1)
    ideal = np.any(tuning["ideal_weight"] > 0.0, axis=1)
    switching = np.any(np.isfinite(tuning["bad_limit"]), axis=1)
    members: dict[tuple[Any, Any, Any, int, bool, bool, bool, bool], list[int]] = {}
    for k in range(count):
        variant = inputs.variants[inputs.variant[k]]
        same = variant.kind, variant.actuator, variant.structure, variant.samples
        facts: Any = tuple(bool(row(values, k)) for values in (limited, ideal, switching, inputs.preview))
        members.setdefault((*same, *facts), []).append(k)
    groups = []
    for key, scenarios in members.items():
        points = dict.fromkeys(tuple(row(inputs.point, k).tolist()) for k in scenarios)
        groups.append(Group(*key, tuple(points), np.array(scenarios), samples))
    return tuple(groups)
