"""The thesis comparison (chapter 7): three controllers, one reference, one well, from nothing to results.

`run_thesis` builds the plant, identifies the step-response model from it, sweeps the steady state over the
choke (4.1.1), runs the controllers and stores each run when it is done. `jaxmpc study run thesis` calls it
and then draws the figures.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from identify.fmu import FmuPlant, build_fmu
from identify.schedule import identify_schedule
from identify.step_test import identify_step_response, settling_notes
from identify.sweep import steady_sweep
from jaxmpc.errors import InputError
from jaxmpc.process.plant import WellPlant
from jaxmpc.process.well.equations import well_hash
from studies.definition import references
from studies.definition.comparison import (
    PLANTS,
    ComparisonDefinition,
    ControllerDefinition,
    PlantKind,
    ReferenceDefinition,
)
from studies.run.comparison import run_comparison
from studies.store.comparison import RESULTS, check_writable, locked

CONTROLLERS = (
    ControllerDefinition(
        "continuous-choke", "continuous MPC, continuous choke", kind="continuous", actuator="continuous"
    ),
    ControllerDefinition("step-choke", "continuous MPC, step choke", kind="continuous", actuator="step"),
    ControllerDefinition(
        "mixed-integer", "mixed-integer MPC, step choke", kind="mixed-integer", actuator="step"
    ),
)
# Grid of the steady-state map: finer where the choke's gain is large.
MAP_CHOKE = np.r_[1.0:10.0:1.0, 10.0:30.0:2.0, 30.0:101.0:5.0]  # %
MAP_LIFT = np.r_[0.0:10_001.0:1000.0]  # m3/h


def thesis_definition(quick: bool = False, plant: PlantKind = "fmu") -> ComparisonDefinition:
    """The study as data.

    Args:
        quick: the shortened reference.
        plant: ``fmu`` as in the thesis, or its JAX twin.
    """
    name = f"thesis-{'quick-' if quick else ''}{plant}"
    title = "Thesis comparison" + (", shortened reference" if quick else "")
    reference = references.quick() if quick else references.thesis()
    return ComparisonDefinition(name, title, plant, CONTROLLERS, ReferenceDefinition.of(reference))


def run_thesis(
    out: str | Path = "results",
    quick: bool = False,
    plant: PlantKind = "fmu",
    *,
    progress: bool = True,
    say: Callable[[str], None] = print,
) -> Path:
    """Compute and store the thesis comparison; what is stored already with equal inputs is kept.

    Args:
        out: folder of all results; this study gets its own folder in it.
        quick: the shortened reference, 1,200 instead of 7,800 samples.
        plant: ``fmu``, or ``jax`` for its JAX twin, which needs no C compiler.
        progress: whether to show bars with rate and time left.
        say: receives one line per event.

    Returns:
        The folder of the study, with ``results.zarr`` (see `studies.store.comparison.open_results`) and ``model.json``.

    Raises:
        InputError: for an unknown plant or a folder that cannot be written, before anything is computed.
        MissingToolError: if the FMU cannot be built.
    """
    if plant not in PLANTS:
        raise InputError("plant", plant, f"one of {', '.join(PLANTS)}")
    return run_definition(thesis_definition(quick, plant), out, steady=True, progress=progress, say=say)


def run_definition(
    definition: ComparisonDefinition,
    out: str | Path = "results",
    *,
    steady: bool = False,
    progress: bool = True,
    say: Callable[[str], None] = print,
) -> Path:
    """Build the plant, identify the model, and compute what is missing of a comparison.

    Args:
        definition: of the study.
        out: folder of all results; this study gets its own folder in it, named like the study.
        steady: whether the results hold the steady states of `steady_variables`.
        progress: whether to show bars with rate and time left.
        say: receives one line per event.

    Returns:
        The folder of the study, as from `run_thesis`; errors too.
    """
    definition.check()
    folder = check_writable(Path(out) / definition.name)
    with locked(folder):
        make_plant, facts = plant_factory(definition.plant, say)
        tested = make_plant("continuous")
        try:
            model = identify_step_response(tested)
            for note in settling_notes(model):
                say(f"Identification: {note}.")
            model.save(folder / "model.json")
            schedule = None
            if any(controller.schedule for controller in definition.controllers):
                schedule = identify_schedule(tested)
                schedule.save(folder / "schedule.json")
            return run_comparison(
                definition,
                folder,
                model=model,
                make_plant=make_plant,
                plant_facts=facts,
                extra=lambda: steady_variables(tested) if steady else {},
                others=sorted(Path(out).glob(f"*/{RESULTS}")),
                schedule=schedule,
                progress=progress,
                say=say,
            )
        finally:
            if isinstance(tested, FmuPlant):
                tested.close()


def plant_factory(
    kind: PlantKind, say: Callable[[str], None] = print
) -> tuple[Callable[[str], Any], dict[str, Any]]:
    """How to make the plant with a given actuator, and the facts that identify it.

    Args:
        kind: ``fmu`` or ``jax``.
        say: receives a line about the FMU.
    """
    if kind == "jax":
        return (lambda actuator: WellPlant(actuator=actuator)), {
            "kind": "jax",
            "hash": well_hash(WellPlant().parameters),
        }
    path = build_fmu()
    say(f"FMU: {path}")
    with FmuPlant(path) as built:
        facts = {"kind": "fmu", "hash": built.token, "fmi": built.fmi}
    return (lambda actuator: FmuPlant(path, actuator=actuator)), facts


def steady_variables(plant: Any) -> dict[str, xr.DataArray]:
    """Steady states of the well for the results: the sweep of 4.1.1 and a map over choke and lift.

    Args:
        plant: a `WellPlant` or an `FmuPlant`.

    Returns:
        ``sweep_coefficient`` over ``cv, sweep_lift, sweep_choke`` (figures 10 and 11) and ``map_rate`` over
        ``cv, map_lift, map_choke``, NaN where no steady state was found.
    """
    sweep = steady_sweep(plant)
    found = sweep.converged[:, 1:] & sweep.converged[:, :-1]
    grid = steady_sweep(plant, MAP_CHOKE, MAP_LIFT)

    def coords(prefix: str, choke: np.ndarray, lift: np.ndarray) -> dict[str, Any]:
        return {
            f"{prefix}_choke": (f"{prefix}_choke", choke, {"long_name": "choke", "units": "%"}),
            f"{prefix}_lift": (f"{prefix}_lift", lift, {"long_name": "gas lift", "units": "m3/h"}),
        }

    return {
        "sweep_coefficient": xr.DataArray(
            np.where(found, sweep.coefficient, np.nan),
            dims=("cv", "sweep_lift", "sweep_choke"),
            coords=coords("sweep", sweep.choke[:-1], sweep.lift),
            attrs={
                "long_name": "steady change of the CV per choke change, from here to the next position",
                "units": "cv_unit per %",
            },
        ),
        "map_rate": xr.DataArray(
            np.where(grid.converged, grid.cv, np.nan),
            dims=("cv", "map_lift", "map_choke"),
            coords=coords("map", grid.choke, grid.lift),
            attrs={"long_name": "steady CV", "units": "cv_unit"},
        ),
    }
