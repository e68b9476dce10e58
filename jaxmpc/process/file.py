"""The TOML file of a process: read strictly, every error with the path of the field; and the library of shipped ones.

`load_process` is how studies, figures and the app get theirs; `jaxmpc.process.new` writes a first file from a model.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from importlib import resources, util
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from jaxmpc.check import among, as_floats, is_number, located, require
from jaxmpc.decoding import decode
from jaxmpc.files import read_named_toml
from jaxmpc.process.process import Process
from jaxmpc.process.reference import Reference
from jaxmpc.process.responses import responses_of
from jaxmpc.process.variables import Cv, KeyFigure, ModelSource, Mv, PlantSource, Positive, Variable

DEFAULT_PROCESS = "gas-lifted-well"  # of studies that name none
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,63}")
VARIABLE = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")  # of a CV, an MV, a disturbance or a key figure


class WindowsSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[references.NAME]`` and ``[disturbances.NAME]``: rows of start [s] and one value per CV or disturbance."""

    windows: tuple[tuple[float, ...], ...]
    duration: Positive | None = None  # of a reference [s]


class ProcessFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    name: str
    dt: Positive
    cv: Annotated[tuple[Cv, ...], msgspec.Meta(min_length=1)]
    mv: Annotated[tuple[Mv, ...], msgspec.Meta(min_length=1)]
    presets: dict[str, dict[str, Any]]
    references: dict[str, WindowsSection]
    title: str = ""
    source: str = ""
    disturbance: tuple[Variable, ...] = ()
    plants: dict[str, PlantSource] = msgspec.field(default_factory=lambda: {"model": PlantSource("model")})
    model: ModelSource = ModelSource()
    structure: dict[str, Any] = {}
    disturbances: dict[str, WindowsSection] = {}
    key_figure: tuple[KeyFigure, ...] = ()


def shipped_processes() -> dict[str, Path]:
    """Files of the processes that come with the package, by name."""
    folder = Path(str(resources.files("jaxmpc.process"))) / "library"
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_process(name_or_path: str | Path, folder: str | Path = ".") -> Process:
    """A shipped process by name, or any file by its path.

    Args:
        folder: that a path is relative to.

    Raises:
        InputError: for an unknown name, a file that cannot be read, and what `process_of` refuses.
    """
    path, body = read_named_toml("process", name_or_path, shipped_processes(), "a process file", folder)
    return process_of(body, path.parent)


def process_of(body: Any, folder: str | Path = ".", *, files: bool = True) -> Process:
    """The process of a file's content; everything that can be wrong in it is found here.

    Args:
        folder: that files named in it are relative to.
        files: whether they have to be there.

    Raises:
        InputError: with the path of the field.
    """
    file = decode(body, ProcessFile, name="process file", expected=_expected)
    require(
        NAME.fullmatch(file.name), "name", file.name, "a letter, then up to 63 letters, digits, '-' and '_'"
    )
    _check_names(file)
    require(file.presets, "presets", {}, "one tuning or more, each headed [presets.NAME]")
    require(file.references, "references", {}, "one reference or more, each headed [references.NAME]")
    require(file.plants, "plants", {}, "one plant or more, each headed [plants.NAME]")
    _check_model(file)
    process = Process(
        name=file.name,
        title=file.title or file.name.replace("-", " "),
        source=file.source,
        dt=file.dt,
        cvs=file.cv,
        mvs=file.mv,
        disturbances=file.disturbance,
        plants=file.plants,
        model=file.model,
        structure_fields=_structure_fields(file.structure),
        presets={name: _preset(file.presets, name) for name in file.presets},
        references={
            name: windows_reference(f"references.{name}", section.windows, section.duration, file.cv)
            for name, section in file.references.items()
        },
        courses={name: _course(name, s, len(file.disturbance)) for name, s in file.disturbances.items()},
        key_figures=file.key_figure,
        folder=str(folder),
        body=body,
    )
    if files:
        _check_plants(process)
    _check_controllers(process)
    return process


def process_digest(process: Process) -> str:
    """Digest of a process and of the files that it names, so that results know what they were made of."""
    found = hashlib.sha256(json.dumps(process.body, sort_keys=True, default=str).encode())
    for source in (process.model.file, *(plant.source for plant in process.plants.values())):
        path = Path(process.folder) / source if source else None
        if path is not None and path.is_file():
            found.update(path.read_bytes())
        elif ":" in source:
            own = own_module(source, process.folder)
            module = None if own else util.find_spec(source.partition(":")[0])
            origin = own or (module and module.origin)
            if origin:
                found.update(Path(origin).read_bytes())
    return found.hexdigest()[:16]


def own_module(source: str, folder: str | Path) -> Path | None:
    """The file in the folder of a process that ``module:name`` means before any installed module; None without one."""
    file = Path(folder) / f"{source.partition(':')[0]}.py"
    return file if file.is_file() else None


# -------------------------------------------------------------------------------------------------------- sections


def _expected(path: str, words: str) -> str:
    """What a field takes, with its unit."""
    unit = {
        "dt": "s",
        "duration": "s",
        "span": "unit of the variable",
        "low": "unit of the variable",
        "high": "unit of the variable",
        "settled": "CV unit",
        "move": "MV unit per sample",
        "smallest_move": "MV unit",
        "step": "MV unit",
        "threshold": "MV unit",
        "per": "s",
        "samples": "samples",
        "gain": "CV unit per MV or disturbance unit",
        "time_constants": "s",
        "dead_time": "s",
        "lead": "s",
    }.get(path.rpartition(".")[2])
    return f"{words} [{unit}]" if unit else words


def _check_names(file: ProcessFile) -> None:
    """Refuse names that are no identifiers, or that two things have."""
    seen: dict[str, str] = {}
    for table in ("cv", "mv", "disturbance", "key_figure"):
        for i, section in enumerate(getattr(file, table)):
            path, expected = f"{table}[{i}].name", "letters, digits and '_', a letter first"
            loads = [f"output.{cv.name}" for cv in file.cv] if table == "disturbance" else []
            named = VARIABLE.fullmatch(section.name) or section.name in loads
            require(named, path, section.name, expected)
            require(
                section.name not in seen,
                path,
                section.name,
                f"a name of its own ({seen.get(section.name)} has it)",
            )
            seen[section.name] = path
    channels = [s.name for s in (*file.cv, *file.mv)]
    for i, section in enumerate(file.key_figure):
        among(f"key_figure[{i}].integral_of", section.integral_of, channels, "a CV or an MV:")
    for table in ("presets", "references", "plants", "disturbances"):
        for name in getattr(file, table):
            expected = "a letter, then up to 63 letters, digits, '-' and '_'"
            require(NAME.fullmatch(name), f"{table}.{name}", name, expected)


def _check_model(file: ProcessFile) -> None:
    """Refuse a model of two sources, and names of others than the variables of the process."""
    source, cvs, mvs = file.model, [cv.name for cv in file.cv], [mv.name for mv in file.mv]
    both = source.responses and source.file
    require(not both, "model.file", source.file, "nothing: model.transfer_functions are the model")
    disturbances = [disturbance.name for disturbance in file.disturbance]
    loads = [f"output.{name}" for name in cvs]
    responses_of(source.responses, {"cv": cvs, "mv": mvs, "dv": [d for d in disturbances if d not in loads]})
    for name, values in source.schedule.items():
        among(f"model.schedule.{name}", name, mvs, "one of the MVs", values)
    for table, known, other in (
        ("working_point", [*cvs, *mvs] if source.responses else mvs, ""),
        ("steps", mvs, " other than 0"),
        ("disturbance_steps", disturbances, " other than 0"),
    ):
        for name, value in getattr(source, table).items():
            path = f"model.{table}.{name}"
            among(path, name, known, "one of", value)
            good = is_number(value) and (value != 0 or not other)
            require(good, path, value, f"a finite number{other} [MV unit]")


def _structure_fields(given: Mapping[str, Any]) -> dict[str, Any]:
    """Lists as tuples; the values are checked where structures are built."""
    names = {"cv_names", "mv_names", "dt", "cv_units", "mv_units", "integer_step", "integer_values"}
    for key, value in given.items():
        require(key not in names, f"structure.{key}", value, "nothing: it follows from [[cv]] and [[mv]]")
    frozen = lambda v: tuple(map(frozen, v)) if isinstance(v, list) else v  # noqa: E731
    return {key: frozen(value) for key, value in given.items()}


def _preset(
    presets: Mapping[str, Mapping[str, Any]], name: str, seen: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Fields of a preset on those of its base."""
    own = dict(presets[name])
    base = own.pop("base", None)
    if base is None:
        return own
    path, known = f"presets.{name}.base", [other for other in presets if other not in (*seen, name)]
    among(path, base, known, "another preset that is not made of this one:")
    return {**_preset(presets, base, (*seen, name)), **own}


def _rows(path: str, given: Any, columns: int, what: str) -> np.ndarray:
    expected = f"rows of {columns + 1} numbers: start [s], then {what}"
    require(isinstance(given, (list, tuple)) and given, path, given, expected)
    for i, row in enumerate(given):
        good = isinstance(row, (list, tuple)) and len(row) == columns + 1
        require(good, f"{path}[{i}]", row, expected)
    return as_floats(path, given, expected)


def windows_reference(path: str, windows: Any, duration: Any, cvs: tuple[Cv, ...]) -> Reference:
    """Setpoints from rows of start [s] and one value per CV, which hold until the next, and the length of the run [s].

    Args:
        path: of the table that has them, for errors.

    Raises:
        InputError: naming the row or the field.
    """
    at = f"{path}." if path else ""
    listed = ", ".join(f"{cv.name} [{cv.unit}]" for cv in cvs)
    rows = _rows(f"{at}windows", windows, len(cvs), f"setpoints of {listed}")
    require(duration is not None, f"{at}duration", None, "the length of the run [s]")
    with located(lambda field: field.replace("reference.", at, 1)):
        return Reference(rows[:, 0], rows[:, 1:], duration)


def _course(name: str, section: WindowsSection, disturbances: int) -> np.ndarray:
    path = f"disturbances.{name}"
    require(disturbances, path, "windows", "nothing: there is no [[disturbance]]")
    rows = _rows(f"{path}.windows", section.windows, disturbances, "one value per disturbance")
    require(
        section.duration is None,
        f"{path}.duration",
        section.duration,
        "nothing: the reference has the duration",
    )
    increasing = len(rows) and rows[0, 0] >= 0 and (np.diff(rows[:, 0]) > 0).all() and np.isfinite(rows).all()
    require(
        increasing, f"{path}.windows", rows[:, 0].tolist(), "finite rows at increasing times of 0 s or more"
    )
    return rows


def _check_plants(process: Process) -> None:
    for name, plant in process.plants.items():
        path, kind = f"plants.{name}.source", plant.kind
        if kind in ("jax", "python"):
            require(
                ":" in plant.source, path, plant.source, "'module:name' of a function that makes the plant"
            )
        elif kind == "fmu" or plant.source:
            found = (Path(process.folder) / plant.source).is_file() and plant.source
            require(found, path, plant.source, f"a file, relative to {process.folder}")
        else:
            expected = f"a model file, or transfer_functions: plants.{name} is that model"
            require(process.model.given, "model.file", "", expected)
    file = process.model.file
    if file:
        found = (Path(process.folder) / file).is_file()
        require(found, "model.file", file, f"a model file, relative to {process.folder}")


def _check_controllers(process: Process) -> None:
    """Build structures and tunings once, so that what is wrong in them is found here."""
    for integer in (False, True) if process.stepped else (False,):
        structure = process.structure(integer=integer)
        for name in process.presets:
            with located(lambda field, name=name: field.replace("tuning", f"presets.{name}", 1)):
                process.tuning(structure, name)
