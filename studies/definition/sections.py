"""The tables of a study definition as strict msgspec types, one per TOML table; `studies.definition.sweep` decodes them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, UnsetType

from jaxmpc.check import located, require
from jaxmpc.controller.measurement import FAULTS, SensorFault
from jaxmpc.loop.events import Event
from jaxmpc.loop.trajectory import AXES
from jaxmpc.process.file import DEFAULT_PROCESS
from jaxmpc.process.process import Process
from jaxmpc.process.reference import Reference

Count = Annotated[int, msgspec.Meta(ge=1)]
STORABLE = tuple(name for names in AXES.values() for name in names if name != "time")


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename=lambda n: n.rstrip("_")):
    """A table of the file; a trailing underscore avoids a Python keyword."""


class StudySection(Section, frozen=True):
    """``[study]``."""

    name: str  # of the study and of its folder of results
    process: str = DEFAULT_PROCESS  # a shipped process, or a process file relative to the definition
    plant: str = ""  # one of its plants; the first if not given
    title: str = ""  # for reports
    # scenarios that are computed and stored together; if not given, `scenarios.default_chunk_size` of a
    # study, `search_study.BATCH` of a search
    chunk_size: Count | UnsetType = UNSET
    confirmation_limit: Count = 10_000  # scenarios beyond which a run must be confirmed


class Range(Section, frozen=True):
    """Evenly spaced values, ends included; ``log`` spaces their logarithms evenly."""

    from_: float
    to: float
    count: Count
    scale: Literal["linear", "log"] = "linear"


class Distribution(Section, frozen=True):
    """What a sampled axis is drawn from: uniform or log-uniform `from`..`to`, or normal with `mean` and `deviation`."""

    kind: Literal["uniform", "log-uniform", "normal"]
    from_: float | UnsetType = UNSET
    to: float | UnsetType = UNSET
    mean: float | UnsetType = UNSET
    deviation: float | UnsetType = UNSET


class CsvSource(Section, frozen=True):
    """Columns of a CSV file, relative to the definition; a column has the name of its key if not given."""

    file: str
    column: str | UnsetType = UNSET
    columns: list[str] | UnsetType = UNSET


class Axis(Section, frozen=True):
    """``[[axes]]``: one key, or several that move together, and where its entries come from."""

    key: str | UnsetType = UNSET
    keys: list[str] | UnsetType = UNSET
    values: list[Any] | UnsetType = UNSET
    range: Range | UnsetType = UNSET
    distribution: Distribution | UnsetType = UNSET
    csv: CsvSource | UnsetType = UNSET
    keep: list[int] | UnsetType = UNSET
    unit: str | list[str] | UnsetType = UNSET
    label: str | list[str] | UnsetType = UNSET


class Sampling(Section, frozen=True):
    """``[sampling]``: how entries of the axes combine into scenarios."""

    method: Literal["grid", "zip", "latin-hypercube", "sobol", "list"] = "grid"
    count: Count | UnsetType = UNSET
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    file: str | UnsetType = UNSET


class Search(Section, frozen=True):
    """``[search]``: the axes are searched, batch by batch, instead of listed."""

    # key figures of `studies.kpi.objectives`, one or more
    objectives: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]
    batches: Count  # how many chunks are asked for, each after the results of the one before
    # one per objective; all are minimized if not given
    directions: tuple[Literal["minimize", "maximize"], ...] | UnsetType = UNSET
    sampler: Literal["nsga2", "tpe"] = "nsga2"  # what asks
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0  # of the sampler


class Store(Section, frozen=True):
    """``[store]``."""

    every: Count = 10  # samples from one stored point of a trajectory to the next
    # which fields of `jaxmpc.loop.trajectory.Trajectory` to keep over time
    trajectories: tuple[Literal[STORABLE], ...] = ("cv", "mv", "setpoint")  # type: ignore[valid-type]


class Cut(Section, frozen=True):
    """An axis of the quick cut: other values, another count of the range, or only the entries at some positions."""

    values: list[Any] | UnsetType = UNSET
    count: Count | UnsetType = UNSET
    keep: list[int] | UnsetType = UNSET


class Quick(Section, frozen=True):
    """``[quick]``: what ``--quick`` replaces."""

    count: Count | UnsetType = UNSET
    batches: Count | UnsetType = UNSET
    chunk_size: Count | UnsetType = UNSET
    base: dict[str, Any] = {}
    axes: dict[str, Any] = {}


class StudyFile(Section, frozen=True):
    """The whole file; `studies.definition.sweep.settings` looks into the base."""

    study: StudySection
    base: Any = {}
    axes: tuple[Axis, ...] = ()
    sampling: Sampling = Sampling()
    search: Search | None = None
    store: Store = Store()
    quick: Quick | None = None


class DisturbanceStep(Section, frozen=True):
    """``[[base.disturbance]]``: from `time` [s] on, a disturbance is off by `offset` [its unit]."""

    time: float
    offset: float
    name: str = ""  # of the disturbance; not needed where there is one


class EventSection(Section, frozen=True):
    """``[[base.event]]``: what changes in the controller from `time` [s] on, as in `jaxmpc.loop.events.Event`."""

    time: float
    tuning: dict[str, Any] = {}
    cv_off: tuple[str, ...] = ()
    cv_on: tuple[str, ...] = ()
    mv_off: tuple[str, ...] = ()
    mv_on: tuple[str, ...] = ()

    def event(self) -> Event:
        """As loops take it."""
        return Event(**msgspec.structs.asdict(self))


class FaultSection(Section, frozen=True):
    """``[[base.sensor_fault]]``: a sensor that fails for a while, as in `jaxmpc.controller.measurement.SensorFault`."""

    cv: str
    kind: Literal[FAULTS]  # type: ignore[valid-type]
    time: float
    duration: float | UnsetType = UNSET
    size: float = 0.0

    def fault(self) -> SensorFault:
        """As loops take it."""
        return SensorFault(self.cv, self.kind, self.time, self.duration or None, self.size)


class ReferenceDefinition(Section, frozen=True):
    """``[base.reference]`` and the setpoints of a comparison; see `jaxmpc.process.reference.Reference`."""

    times: tuple[float, ...]  # change times [s]
    setpoints: tuple[tuple[float, ...], ...]  # one row per change, in CV order [CV unit]
    duration: float  # length of the run [s]

    @classmethod
    def of(cls, reference: Reference) -> ReferenceDefinition:
        """The definition of an existing reference."""
        setpoints = tuple(tuple(row) for row in reference.setpoints.tolist())
        return cls(tuple(reference.times.tolist()), setpoints, reference.duration)

    def build(self, process: Process, place: str = "") -> Reference:
        """The checked reference; `place` is the path of the table that it stands in, for errors, such as ``base.``."""
        with located(lambda field: f"{place}{field}"):
            reference = Reference(self.times, self.setpoints, self.duration)
        listed = ", ".join(f"{cv.name} [{cv.unit}]" for cv in process.cvs)
        found, expected = f"{reference.cv_count} columns", f"one per CV: {listed}"
        require(reference.cv_count == len(process.cvs), f"{place}reference.setpoints", found, expected)
        return reference
