"""Named comparisons, ready to run: the thesis run (chapter 7), the scenarios around it, and comparisons beyond the thesis.

``comparisons.toml`` says what each of them is. `run_named` computes one of `STUDIES` from nothing to stored results; figures
and the command line ask for them by name. Every study has a quick variant, shorter, with the same effects.
"""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from studies.definition import references
from studies.definition.comparison import ComparisonDefinition, PlantKind, ReferenceDefinition
from studies.definition.refusing import require
from studies.thesis.comparison import run_definition, study_name

INTEGER = {"kind": "mixed-integer", "actuator": "step"}  # of a controller that says nothing else


def _definition(
    name: str, told: dict[str, Any], quick: bool = False, plant: PlantKind = "fmu"
) -> ComparisonDefinition:
    """A comparison from what ``comparisons.toml`` tells of it."""
    told = {"name": study_name(name, quick, plant), "plant": plant, **told}
    short = told.pop("quick")
    runs = [INTEGER | one for one in told["controllers"]]
    if quick:
        asked = short.get("controllers", [one["name"] for one in runs])
        runs = [one for one in runs if one["name"] in asked]
        told |= {"title": f"{told['title']}, shortened", **short}
    windows, duration, known = (told.pop(key, None) for key in ("windows", "duration", "reference"))
    reference = references.from_windows(windows, duration) if windows else references.NAMED[str(known)]()
    told |= {"controllers": runs, "reference": ReferenceDefinition.of(reference)}
    return msgspec.convert(told, ComparisonDefinition)


STUDIES: dict[str, Callable[[bool, PlantKind], ComparisonDefinition]] = {
    name: functools.partial(_definition, name, told)
    for name, told in tomllib.loads(Path(__file__).with_name("comparisons.toml").read_text("utf-8")).items()
}


def run_named(
    name: str,
    out: str | Path = "results",
    quick: bool = False,
    plant: PlantKind = "fmu",
    *,
    progress: bool = True,
    say: Callable[[str], None] = print,
) -> Path:
    """Compute and store a study of the catalogue; what is stored already with equal inputs is kept.

    Args:
        name: a key of `STUDIES`.
        out: folder of all results; each study gets its own folder in it, ``NAME-PLANT`` or ``NAME-quick-PLANT``.
        quick: the shortened variant.
        plant: ``fmu`` as in the thesis, or ``jax`` for its JAX twin, which needs no C compiler.
        progress: whether to show bars with rate and time left.
        say: receives one line per event.

    Returns:
        The folder of the study, with ``results.zarr`` (see `studies.store.reading.open_results`) and ``model.json``.

    Raises:
        InputError: for an unknown name or plant or a folder that cannot be written, before anything is computed.
        MissingToolError: if the FMU cannot be built.
    """
    require(name in STUDIES, "study", name, f"one of {', '.join(STUDIES)}")
    definition = STUDIES[name](quick, plant)
    return run_definition(definition, out, steady=name == "thesis", progress=progress, say=say)
