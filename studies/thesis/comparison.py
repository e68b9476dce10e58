"""A comparison on the well from nothing to results, that of the thesis (chapter 7) among them.

`run_definition` builds the plant, identifies the step-response model from it, sweeps the steady state over the choke
(4.1.1), runs the controllers and stores each run when it is done. `catalogue` calls it for the named comparisons.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from identify.schedule import identify_schedule
from identify.step_test import identify_step_response, identity, settling_notes
from identify.sweep import steady_sweep
from identify.well_fmu import WellFmuPlant, build_fmu
from jaxmpc.process.well.plant import WellPlant
from studies.definition.comparison import PLANTS, ComparisonDefinition, PlantKind
from studies.definition.refusing import require
from studies.run.comparison import closing, labelled, run_comparison
from studies.store.files import RESULTS
from studies.store.writing import check_writable, locked

# Grid of the steady-state map: finer where the choke's gain is large.
MAP_CHOKE = np.r_[1.0:10.0:1.0, 10.0:30.0:2.0, 30.0:101.0:5.0]  # %
MAP_LIFT = np.r_[0.0:10_001.0:1000.0]  # m3/h


def study_name(name: str, quick: bool, plant: PlantKind) -> str:
    """``NAME-PLANT`` or ``NAME-quick-PLANT``, as the study and its folder are called.

    Raises:
        InputError: for an unknown plant.
    """
    require(plant in PLANTS, "plant", plant, f"one of {', '.join(PLANTS)}")
    return f"{name}-{'quick-' if quick else ''}{plant}"


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
        definition: of the study; an `InputError` for one that cannot be run comes before anything is computed.
        steady: whether the results hold the steady states of `steady_variables`.
        out, progress, say: as for `studies.thesis.catalogue.run_named`, as are result and errors.
    """
    definition.check()
    folder = check_writable(Path(out) / definition.name)
    with locked(folder / RESULTS):
        make_plant, facts = plant_factory(definition.plant, say)
        with closing(make_plant("continuous")) as tested:
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


def plant_factory(
    kind: PlantKind, say: Callable[[str], None] = print
) -> tuple[Callable[[str], Any], dict[str, Any]]:
    """How to make the plant with a given actuator, and the facts that identify it."""
    if kind == "jax":
        known, digest = identity(WellPlant())
        return (lambda actuator: WellPlant(actuator=actuator)), {"kind": known, "hash": digest}
    path = build_fmu()
    say(f"FMU: {path}")
    with WellFmuPlant(path) as built:
        facts = {"kind": "fmu", "hash": built.token, "fmi": built.fmi}
    return (lambda actuator: WellFmuPlant(path, actuator=actuator)), facts


def steady_variables(plant: Any) -> dict[str, xr.DataArray]:
    """Steady states of the well for the results: the sweep of 4.1.1 and a map over choke and lift.

    Returns:
        ``sweep_coefficient`` over ``cv, sweep_lift, sweep_choke`` (figures 10 and 11) and ``map_rate`` over
        ``cv, map_lift, map_choke``, NaN where no steady state was found.
    """
    sweep, grid = steady_sweep(plant), steady_sweep(plant, MAP_CHOKE, MAP_LIFT)
    found = sweep.converged[:, 1:] & sweep.converged[:, :-1]
    change = np.where(found, sweep.coefficient, np.nan)
    words = "steady change of the CV per choke change, from here to the next position"
    rate = np.where(grid.converged, grid.cv, np.nan)
    return {
        "sweep_coefficient": over_inputs(
            "sweep", sweep.choke[:-1], sweep.lift, change, words, "cv_unit per %"
        ),
        "map_rate": over_inputs("map", grid.choke, grid.lift, rate, "steady CV", "cv_unit"),
    }


def over_inputs(
    prefix: str, choke: np.ndarray, lift: np.ndarray, values: np.ndarray, words: str, unit: str
) -> xr.DataArray:
    """Values ``"cv lift choke"`` of the results over axes of their own, ``PREFIX_lift`` [m3/h] and ``PREFIX_choke`` [%]."""
    x, y = f"{prefix}_choke", f"{prefix}_lift"
    axes = {x: (choke, "choke", "%"), y: (lift, "gas lift", "m3/h")}
    return labelled(values, ("cv", y, x), words, unit, **axes)
