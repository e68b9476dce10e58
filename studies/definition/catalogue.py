"""Comparisons by name or file: the one for any process, those of the thesis (chapter 7), and a user's own.

A comparison is a TOML file with ``[[controllers]]``: keys of `ControllerDefinition`, mixed-integer MPC on the actual
actuators unless they say otherwise. ``reference`` names one of the process, or ``windows`` and ``duration`` [s] give one.
``[quick]`` replaces keys in the shortened variant; its ``controllers`` name those that run.
"""

from __future__ import annotations

import dataclasses
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec

from jaxmpc.check import require
from jaxmpc.decoding import decode
from jaxmpc.errors import InputError
from jaxmpc.files import read_named_toml
from jaxmpc.process.file import load_process, windows_reference
from jaxmpc.process.process import Process
from studies.definition.comparison import ComparisonDefinition, ReferenceDefinition

FOLDERS = "comparisons", "thesis/comparisons"
INTEGER = {"kind": "mixed-integer", "actuator": "step"}  # of a controller that says nothing else


@dataclasses.dataclass(frozen=True, eq=False)
class Comparison:
    """A comparison, checked, and the process that it is of."""

    kind: str  # name of its file, by which figures and summaries know it
    definition: ComparisonDefinition
    process: Process


def shipped_comparisons() -> dict[str, Path]:
    """Files of the comparisons that come with the package, by name."""
    root = Path(str(resources.files("studies")))
    return {path.stem: path for folder in FOLDERS for path in sorted((root / folder).glob("*.toml"))}


def is_comparison(name_or_path: str | Path) -> bool:
    """Whether it is a shipped comparison, or a file that lists controllers."""
    if str(name_or_path) in shipped_comparisons():
        return True
    try:
        return "controllers" in tomllib.loads(Path(name_or_path).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False


def load_comparison(
    name_or_path: str | Path, *, quick: bool = False, plant: str = "", process: str | Path = ""
) -> Comparison:
    """A shipped comparison by name, or a file by its path.

    Args:
        quick: the shortened variant.
        plant: of the process; that of the file, or the first one, if not given.
        process: name or file; that of the comparison if not given.

    Raises:
        InputError: naming the path of the field.
    """
    path, told = read_named_toml("study", name_or_path, shipped_comparisons(), "the file of a comparison")
    return _comparison(path, told, quick, plant, process)


def _comparison(path: Path, told: dict[str, Any], quick: bool, plant: str, given: str | Path) -> Comparison:
    of_file = told.pop("process", "")
    require(
        given or of_file,
        "--process",
        "nothing",
        "a process file or a shipped process: this comparison names none",
    )
    if given and of_file and Path(path).stem in shipped_comparisons():
        require(
            str(given) == of_file, "--process", str(given), f"nothing, or {of_file}: this comparison is of it"
        )
    process = load_process(given) if given else load_process(of_file, path.parent)
    plant = plant or told.get("plant", "") or next(iter(process.plants))
    own = "" if of_file else f"{process.name}-"
    name = f"{own}{told.pop('name', path.stem)}-{'quick-' if quick else ''}{plant}"
    short, controllers = told.pop("quick", {}), told.get("controllers")
    if not isinstance(controllers, list) or not controllers:
        raise InputError("controllers", controllers, "one table or more, each headed [[controllers]]")
    usual = INTEGER | {"blocking": process.structure().blocking}
    runs = [usual | one if isinstance(one, dict) else one for one in controllers]
    if quick:
        asked = short.get("controllers", [one["name"] for one in runs])
        runs = [one for one in runs if one["name"] in asked]
        told |= {"title": f"{told.get('title', path.stem)}, shortened", **short}
    if quick and not of_file and "quick" in process.references:
        told.setdefault("reference", "quick")
    windows, duration, known = (told.pop(key, None) for key in ("windows", "duration", "reference"))
    reference = windows_reference("", windows, duration, process.cvs) if windows else process.reference(known)
    if not windows and duration is not None:
        reference = reference.cut(duration)
    told |= {
        "name": name,
        "process": process.name,
        "plant": plant,
        "controllers": runs,
        "reference": msgspec.to_builtins(ReferenceDefinition.of(reference)),
    }
    definition = decode(told, ComparisonDefinition, name="comparison")
    definition.check(process)
    return Comparison(path.stem, definition, process)
