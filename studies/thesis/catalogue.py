"""The comparisons of the thesis (chapter 7), the scenarios around it and beyond it, by name: study files over the well.

``comparisons/*.toml`` says what each of them is. Every one has a quick variant, shorter, with the same effects.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from jaxmpc.check import among
from studies.definition.catalogue import Comparison, load_comparison
from studies.run.named import run_named
from studies.thesis.steady import steady_variables

FOLDER = Path(__file__).with_name("comparisons")
STUDIES = tuple(path.stem for path in sorted(FOLDER.glob("*.toml")))
PLANTS = "fmu", "jax"  # of the well; the thesis drives the FMU


def study_name(name: str, quick: bool, plant: str) -> str:
    """``NAME-PLANT`` or ``NAME-quick-PLANT``, as a study and its folder are called.

    Raises:
        InputError: for an unknown plant.
    """
    among("plant", plant, PLANTS)
    return f"{name}-{'quick-' if quick else ''}{plant}"


def comparison_of(name: str, quick: bool = False, plant: str = PLANTS[0]) -> Comparison:
    """A comparison of the thesis.

    Raises:
        InputError: for an unknown name or plant.
    """
    among("study", name, STUDIES)
    study_name(name, quick, plant)
    return load_comparison(name, quick=quick, plant=plant)


def run_thesis(
    name: str,
    out: str | Path = "results",
    quick: bool = False,
    plant: str = PLANTS[0],
    *,
    progress: bool = True,
    say: Callable[[str], None] = print,
) -> Path:
    """Compute and store one of `STUDIES`; the thesis run has the steady states of the well too.

    Args:
        quick: the shortened variant.
        plant: ``fmu`` as in the thesis, or ``jax`` for its JAX twin, which needs no C compiler.
        out, progress, say: as for `studies.run.named.run_named`, as are result and errors.
    """
    extra = {"extra": steady_variables} if name == "thesis" else {}
    return run_named(comparison_of(name, quick, plant), out, **extra, progress=progress, say=say)
