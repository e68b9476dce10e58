"""The file of an FMU: its archive, what its model description says, and the library for this machine.

`identify.fmu_worker` reads and unpacks FMUs with it. An archive is checked before anything of it is unpacked.
"""

from __future__ import annotations

import contextlib
import re
import stat
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

# What an archive may hold; far more than FMUs have, far less than fills a disk.
MAX_FILES = 10_000
MAX_BYTES = 2 * 2**30
MAX_RATIO = 200  # unpacked to packed size: XML packs 20 : 1, a bomb 1000 : 1
MAX_DESCRIPTION_BYTES = 256 * 2**20

DESCRIPTION = "modelDescription.xml"
HARMFUL = re.compile(r"^[A-Z]+ \(line|not unique")  # of what FMPy finds: not of the schema, or ambiguous


class RefusedError(Exception):
    """The file is not an FMU that can be used: what was expected, and a hint."""

    def __init__(self, expected: str, hint: str = ""):
        super().__init__(expected)
        self.expected, self.hint = expected, hint


def check_archive(path: Path, free: int) -> None:
    """Refuse an archive that would leave its folder or fill the `free` bytes of the disk, from its table of contents.

    Unpacking stops at the sizes in the table, so that a table that lies does no harm.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile) as error:
        raise RefusedError(f"a readable FMU, which is a zip archive ({error})") from None
    if len(entries) > MAX_FILES:
        raise RefusedError(f"an archive of at most {MAX_FILES} files (it has {len(entries)})")
    for entry in entries:
        parts = entry.filename.split("/")
        if ".." in parts or not parts[0] or re.search(r"[\\:\0]", entry.filename):
            raise RefusedError(f"an archive whose files stay in its folder ({entry.filename!r} does not)")
        if stat.S_ISLNK(entry.external_attr >> 16):
            raise RefusedError(f"an archive without symbolic links ({entry.filename!r} is one)")
    size = sum(entry.file_size for entry in entries)
    if size > MAX_BYTES:
        raise RefusedError(f"an archive of at most {MAX_BYTES} bytes unpacked (it has {size})")
    if size > MAX_RATIO * path.stat().st_size:
        raise RefusedError(f"an archive that grows at most {MAX_RATIO} times when it is unpacked")
    if size > free:
        raise RefusedError(f"an archive that fits on the disk ({size} bytes unpacked, {free} bytes free)")
    sizes = {entry.filename: entry.file_size for entry in entries}
    if DESCRIPTION not in sizes:
        raise RefusedError(f"an FMU, with a {DESCRIPTION}")
    if sizes[DESCRIPTION] > MAX_DESCRIPTION_BYTES:
        raise RefusedError(f"a {DESCRIPTION} of at most {MAX_DESCRIPTION_BYTES} bytes")


def unpack(path: Path, folder: Path, names: list[str] | None = None) -> None:
    """Unpack a checked archive, or some of its files."""
    try:
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder, names)
    except Exception as error:  # a damaged archive: whatever zipfile and zlib raise
        raise RefusedError(f"an undamaged FMU ({type(error).__name__}: {error})") from None


def read_description(path: Path, folder: Path) -> tuple[Any, list[str]]:
    """FMPy's reading of the model description of an FMU of FMI 2.0 or 3.0, in a checked archive; refuses others.

    What breaks rules of the standard without any harm here is returned in words: units that are not defined, missing start
    values and the like.
    """
    from fmpy import read_model_description

    unpack(path, folder, [DESCRIPTION])
    try:
        root = ElementTree.parse(folder / DESCRIPTION).getroot()
    except ElementTree.ParseError as error:
        raise RefusedError(f"a {DESCRIPTION} that is XML ({error})") from None
    version = root.get("fmiVersion", "none")
    if not re.match(r"2\.0|3\.", version):
        raise RefusedError(f"an FMU of FMI 2.0 or 3.0 (its version is {version})")
    try:
        return read_model_description(folder), []
    except Exception as error:  # FMPy has no type of its own for most of what it finds
        flaws = getattr(error, "problems", ["units or display units that are not defined"])
        reason = " ".join(str(error).split())
    with contextlib.suppress(Exception):
        if not any(HARMFUL.search(flaw) for flaw in flaws):
            return read_model_description(folder, validate=False), flaws
    raise RefusedError(f"a {DESCRIPTION} that follows the standard ({reason})")


def facts_of(described: Any, flaws: list[str], names: Iterable[str]) -> dict[str, Any]:
    """What FMPy has read, and the names of the files of the archive, for `identify.fmu_description`."""
    from fmpy import platform, platform_tuple

    fmi3 = described.fmiVersion.startswith("3")
    slave, experiment = described.coSimulation, described.defaultExperiment
    times = {"start": "startTime", "stop": "stopTime", "step": "stepSize", "tolerance": "tolerance"}
    libraries = [name.split("/")[1] for name in names if re.fullmatch(r"binaries/[^/]+/[^/]+", name)]
    sources = ["sources"] if any(name.startswith("sources/") for name in names) else []
    return {
        "fmi": 3 if fmi3 else 2,
        "name": described.modelName or "",
        "text": described.description or "",
        "tool": described.generationTool or "",
        "token": described.guid,
        "kinds": kinds_of(described),
        "platforms": [*dict.fromkeys(libraries), *sources],
        "here": platform_tuple if fmi3 else platform,
        "variables": [_facts_of(v) for v in described.modelVariables],
        "experiment": {name: number(getattr(experiment, own, None)) for name, own in times.items()},
        "variable_steps": bool(slave and slave.canHandleVariableCommunicationStepSize),
        "flaws": flaws,
        "fixed_step": number(slave and slave.fixedInternalStepSize),
    }


def kinds_of(described: Any) -> list[str]:
    """The kinds of an FMU."""
    kinds = ("CoSimulation", "ModelExchange", "ScheduledExecution")
    return [kind for kind in kinds if getattr(described, kind[0].lower() + kind[1:]) is not None]


def _facts_of(v: Any) -> dict[str, Any]:
    kind = v.declaredType
    told = lambda name: getattr(v, name) or getattr(kind, name, None)  # noqa: E731
    return {
        "name": v.name,
        "type": v.type,
        "causality": v.causality,
        "variability": v.variability,
        "initial": v.initial,
        "unit": told("unit"),
        "start": v.start,
        "low": number(told("min")),
        "high": number(told("max")),
        "items": {item.name: int(item.value) for item in getattr(kind, "items", [])},
        "shape": v.shape or (),
        "text": v.description or "",
    }


def number(value: Any) -> float | None:
    """A number of a description; None where it has none."""
    try:
        return None if value is None else float(value)
    except ValueError:  # several, of an array
        return None


def library_of(folder: Path, description: Any) -> Path:
    """The library for this machine; refuses an FMU without."""
    from fmpy import platform, platform_tuple, sharedLibraryExtension

    name = (description.coSimulation or description.modelExchange).modelIdentifier
    here = platform_tuple if description.fmiVersion.startswith("3") else platform
    library = folder / "binaries" / here / f"{name}{sharedLibraryExtension}"
    if library.is_file():
        return library
    others = sorted(other.parent.name for other in folder.glob("binaries/*/*") if other.is_file())
    has, hint = "none", ""
    if others:
        has = f"one for {', '.join(dict.fromkeys(others))}"
    elif any(folder.glob("sources/*")):
        has, hint = "only sources", "Compile it: fmpy compile FILE.fmu"
    raise RefusedError(f"an FMU with a library for {here} (it has {has})", hint)
