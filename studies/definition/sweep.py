"""What a sweep study is, as typed data read from TOML: strict, with the full path of whatever is wrong.

`load_definition` reads a shipped name or a file, `StudyDefinition.from_dict` the same content as a Python dictionary;
`studies.definition.scenarios.load_study` also expands it. `docs/studies.md` explains every key.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import UNSET
from msgspec.structs import replace

from identify.plants import parameters_of
from jaxmpc.check import among, require
from jaxmpc.controller.measurement import FAULTS
from jaxmpc.decoding import decode
from jaxmpc.errors import InputError
from jaxmpc.files import read_named_toml
from jaxmpc.process.file import load_process, shipped_processes
from jaxmpc.process.process import Process
from studies.definition.fields import Field, find, study_fields
from studies.definition.sections import (
    STORABLE,
    Axis,
    Cut,
    DisturbanceStep,
    EventSection,
    FaultSection,
    Quick,
    Range,
    ReferenceDefinition,
    Sampling,
    Search,
    Store,
    StudyFile,
    StudySection,
)

T = TypeVar("T")


@dataclasses.dataclass(frozen=True, eq=False)
class StudyDefinition:
    """A sweep study as written, every section decoded."""

    study: StudySection
    process: Process
    fields: Mapping[str, Field]  # the keys that base and axes may have
    # settings by key (`fields`), only those that are given; besides, reference may be an
    # `ReferenceDefinition`, disturbance is a tuple of `DisturbanceStep`, event one of `EventSection` and sensor_fault one of
    # `FaultSection`
    base: dict[str, Any]
    axes: tuple[Axis, ...]
    sampling: Sampling
    store: Store
    quick: Quick | None
    places: tuple[str, ...]  # path of every axis in the file, for errors
    folder: str = "."  # that CSV files are relative to
    body: dict[str, Any] = dataclasses.field(default_factory=dict)  # of the file, as `from_dict` takes it
    is_cut: bool = False  # whether this is the quick version of it
    search: Search | None = None  # what is sought along the axes; None for a study that lists its scenarios

    @classmethod
    def from_dict(cls, body: dict[str, Any], folder: str | Path = ".") -> StudyDefinition:
        """Decode the content of a definition file.

        Args:
            body: nested dictionaries and lists, as TOML decodes them.
            folder: that CSV files are relative to.

        Raises:
            InputError: naming the path of the field, for unknown or missing keys and wrong types.
        """
        require(isinstance(body, dict), "study definition", body, "a table")
        _check_plain(body)
        file = _convert({"study": {}} | body, StudyFile, "")
        named = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}", file.study.name)
        expected = "up to 100 letters, digits, '-', '_' and '.': it names the folder of the results"
        require(named, "study.name", file.study.name, expected)
        if file.search is not None and "sampling" in body:
            raise InputError("sampling", body["sampling"], "no such table: [search] draws from the axes")
        process, fields = process_fields(file.study, folder)
        out = cls(
            study=file.study,
            process=process,
            fields=fields,
            base=settings(file.base, "base", process, fields),
            axes=file.axes,
            sampling=file.sampling,
            store=file.store,
            quick=file.quick,
            places=tuple(f"axes[{i}]" for i in range(len(file.axes))),
            folder=str(folder),
            body=body,
            search=file.search,
        )
        kept = file.store.trajectories
        for i, name in enumerate(kept):
            require(name not in kept[:i], f"store.trajectories[{i}]", name, "each trajectory once")
        if file.quick is not None:
            out.cut()  # so that a mistake in it is found by every run
        return out

    def cut(self) -> StudyDefinition:
        """The quick version: what ``[quick]`` says replaces the rest, and the name ends in ``-quick``.

        Raises:
            InputError: if there is no ``[quick]`` or it does not fit the axes.
        """
        quick = self.quick
        if quick is None:
            raise InputError("quick", "nothing", "a table [quick]: this study has no quick version")
        known = [str(axis.key if axis.keys is UNSET else (axis.keys or [UNSET])[0]) for axis in self.axes]
        axes, places = list(self.axes), list(self.places)
        for key, body in quick.axes.items():
            place = f'quick.axes."{key}"'
            among(place, key, known, "the (first) key of an axis:", body)
            i, change = known.index(key), _convert(body, Cut, place)
            given = {
                name: value for name, value in msgspec.structs.asdict(change).items() if value is not UNSET
            }
            require(len(given) == 1, place, list(given) or "nothing", "exactly one of values, count and keep")
            if "values" in given:
                given |= dict.fromkeys(("range", "distribution", "csv", "keep"), UNSET)
                places[i] = place
            elif "count" in given:
                whole = axes[i].range
                if not isinstance(whole, Range):
                    raise InputError(f"{place}.count", change.count, "values or keep: this axis has no range")
                given = {"range": replace(whole, **given)}
            axes[i] = replace(axes[i], **given)
        sampling, study, search = self.sampling, self.study, self.search
        if quick.count is not UNSET:
            counted = sampling.count is not UNSET
            require(counted, "quick.count", quick.count, "nothing: [sampling] has no count either")
            sampling = replace(sampling, count=quick.count)
        if quick.batches is not UNSET:
            if search is None:
                raise InputError("quick.batches", quick.batches, "nothing: there is no [search]")
            search = replace(search, batches=quick.batches)
        if quick.chunk_size is not UNSET:
            study = replace(study, chunk_size=quick.chunk_size)
        return dataclasses.replace(
            self,
            study=replace(study, name=f"{study.name}-quick"),
            base={**self.base, **settings(quick.base, "quick.base", self.process, self.fields)},
            axes=tuple(axes),
            places=tuple(places),
            sampling=sampling,
            quick=None,
            is_cut=True,
            search=search,
        )


def load_definition(name_or_path: str | Path, process: str | Path | None = None) -> StudyDefinition:
    """Read a shipped definition by name (see `shipped_studies`), or any file by its path.

    Args:
        process: a process file (from here) or a shipped process, in place of that of the definition.

    Raises:
        InputError: for an unknown name, a file that cannot be read, text that is not TOML, and what `from_dict` refuses.
    """
    path, body = read_named_toml("study", name_or_path, shipped_studies(), "a definition file")
    if process is not None and isinstance(body.get("study"), dict):
        own = str(process) if str(process) in shipped_processes() else str(Path(process).resolve())
        body["study"] = body["study"] | {"process": own}
    return StudyDefinition.from_dict(body, path.parent)


def shipped_studies() -> dict[str, Path]:
    """Definitions that come with the package, by name: of the well, then one for each other process of the library."""
    root = Path(str(resources.files("studies")))
    return {path.stem: path for folder in (root, root / "library") for path in sorted(folder.glob("*.toml"))}


# ------------------------------------------------------------------------------------------------------- decoding

DEEPEST = 16  # tables and lists within each other; no key needs more than five
LARGEST_WHOLE = 2**63 - 1  # as TOML has them


def _check_plain(body: dict[str, Any]) -> None:
    """Refuse what no TOML file holds, or no study needs, before anything looks closer: it could not even be printed."""
    level: list[tuple[str, Any]] = [("", body)]
    for _ in range(DEEPEST):
        inner: list[tuple[str, Any]] = []
        for path, value in level:
            if isinstance(value, dict):
                for key in value:
                    printable = isinstance(key, str) and key.isprintable()
                    require(printable, path or "study definition", key, "keys of printable text")
                inner += [(f"{path}.{key}".lstrip("."), entry) for key, entry in value.items()]
            elif isinstance(value, (list, tuple)):
                inner += [(f"{path}[{i}]", entry) for i, entry in enumerate(value)]
            elif isinstance(value, str):
                try:
                    value.encode()
                except UnicodeEncodeError:
                    raise InputError(path, value, "text of whole Unicode characters") from None
            elif isinstance(value, int) and abs(value) > LARGEST_WHOLE:
                raise InputError(path, f"{value.bit_length()} bits", "a whole number of at most 63 bits")
        level = inner
    if level:
        raise InputError(level[0][0], "tables or lists", f"no more than {DEEPEST} of them within each other")


def process_fields(study: StudySection, folder: str | Path) -> tuple[Process, dict[str, Field]]:
    """The process of a study, and the keys that it may have.

    Raises:
        InputError: for a process or a plant that does not exist, or cannot be opened.
    """
    try:
        process = load_process(study.process, folder)
    except InputError as error:
        if error.field == "process":
            raise InputError("study.process", error.value, error.expected, error.hint) from None
        raise
    if study.plant:
        among("study.plant", study.plant, process.plants)
    return process, study_fields(process, parameters_of(process, study.plant))


def settings(body: Any, path: str, process: Process, fields: Mapping[str, Field]) -> dict[str, Any]:
    """A base table as settings by key, each of its own type; `InputError` with the full path otherwise."""
    require(isinstance(body, dict), path, body, "a table of settings")
    out: dict[str, Any] = {}

    def walk(table: dict[str, Any], prefix: str) -> None:
        for name, value in table.items():
            key = f"{prefix}{name}"
            where = f"{path}.{key}"
            below = [known for known in fields if known.startswith(key + ".")]
            if key in _EVENTS:
                out[key] = _events(value, key, where, process, fields)
            elif key == "reference" and isinstance(value, dict):
                out[key] = _convert(value, ReferenceDefinition, where)
                out[key].build(process, f"{path}.")
            elif key in fields:
                out[key] = fields[key].check(where, value)
            elif below and isinstance(value, dict):
                walk(value, key + ".")
            elif below:
                names = dict.fromkeys(known[len(key) + 1 :].partition(".")[0] for known in below)
                raise InputError(where, value, f"a table with {', '.join(names)}")
            else:
                if isinstance(value, dict) and value:  # name the whole key that was meant
                    inner = next(iter(value))
                    key, value, where = f"{key}.{inner}", value[inner], f"{where}.{inner}"
                find(fields, where, key, value)

    walk(body, "")
    return out


def _events(
    value: Any, table: str, where: str, process: Process, fields: Mapping[str, Field]
) -> tuple[Any, ...]:
    """What ``[[base.disturbance]]`` or ``[[base.sensor_fault]]`` lists, each number checked by its key."""
    kind, what = _EVENTS[table]
    require(isinstance(value, list), where, value, f"{what}, each headed [[{where}]]")
    events = tuple(_convert(event, kind, f"{where}[{i}]") for i, event in enumerate(value))
    for i, event in enumerate(events):
        for name in ("time", "offset", "duration", "size"):
            if (given := getattr(event, name, UNSET)) is not UNSET:
                key = "sensor_fault.time" if table == "event" else f"{table}.{name}"
                fields[key].check(f"{where}[{i}].{name}", given)
        if table == "event":
            continue
        if table == "sensor_fault":
            among(f"{where}[{i}].cv", event.cv, process.cv_names)
            continue
        names = process.disturbance_names
        require(names, where, value, f"nothing: {process.name} has no disturbances")
        known = event.name in names or (not event.name and len(names) == 1)
        require(known, f"{where}[{i}].name", event.name, f"one of {', '.join(names)}")
        earlier = [other.time for other in events[:i] if other.name == event.name]
        if earlier:
            expected = f"a time after the step before it, {earlier[-1]:g} s"
            require(event.time > earlier[-1], f"{where}[{i}].time", event.time, expected)
    return events


_EVENTS: dict[str, tuple[Any, str]] = {
    "disturbance": (DisturbanceStep, "steps of disturbances"),
    "event": (EventSection, "changes of the controller"),
    "sensor_fault": (FaultSection, "faults of sensors"),
}
_EXPECTED = {
    "axes": "a list of tables, each headed [[axes]]",
    "quick.axes": "a table of keys",
    "study.name": "text in quotes, the name of the study",
    "chunk_size": "a whole number of 1 or more [scenarios]",
    "confirmation_limit": "a whole number of 1 or more [scenarios]",
    "count": "a whole number of 1 or more [scenarios or values]",
    "sampling.seed": "a whole number of 0 or more",
    "batches": "a whole number of 1 or more [batches]",
    "search.objectives": "a list of key figures, one or more, such as travel.NAME or deviation",
    "search.directions": "a list of 'minimize' and 'maximize', one per objective",
    "search.sampler": "one of nsga2, tpe",
    "search.seed": "a whole number of 0 or more",
    "every": "a whole number of 1 or more [samples]",
    "trajectories": f"a list of some of {', '.join(STORABLE)}",
    "sampling.method": "one of grid, zip, latin-hypercube, sobol, list",
    "scale": "'linear' or 'log'",
    "kind": "one of uniform, log-uniform, normal",
    "keep": "a list of positions, the first is 0",
    "values": "a list of values",
    "sensor_fault.cv": "the name of a CV",
    "sensor_fault.kind": f"one of {', '.join(FAULTS)}",
    "time": "a time [s]",
    "offset": "a change of the disturbance [its unit]",
    "times": "a list of times [s]",
    "setpoints": "a list of rows, one number per CV [CV unit]",
    "duration": "a length of the run [s]",
}


def _convert(body: Any, section: type[T], path: str) -> T:
    """The decoded section, or an InputError with the path of what is wrong, below `path`."""
    return decode(body, section, path, name="study definition", expected=_expected)


def _expected(path: str, words: str) -> str:
    """What a key takes, found by its whole path or by the end of it."""
    ends = [path, *(".".join(path.split(".")[-parts:]) for parts in (2, 1))]
    return next((_EXPECTED[end] for end in ends if end in _EXPECTED), words)
