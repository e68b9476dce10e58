"""A comparison from nothing to results: opens the plant, finds the model, runs the controllers and stores each run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from identify.plants import model_of, open_plant, plant_facts, signals_in
from identify.schedule import identify_schedule
from identify.step_test import settling_notes
from jaxmpc.errors import InputError
from jaxmpc.process.plant import closing
from studies.definition.catalogue import Comparison
from studies.run.comparison import run_comparison
from studies.store.files import RESULTS
from studies.store.writing import check_writable, locked


def run_named(
    comparison: Comparison,
    out: str | Path = "results",
    *,
    extra: Callable[[Any], Mapping[str, xr.DataArray]] = lambda plant: {},
    progress: bool = True,
    say: Callable[[str], None] = print,
) -> Path:
    """Compute and store a comparison; what is stored already with equal inputs is kept.

    Args:
        comparison: from `studies.definition.catalogue.load_comparison`.
        out: folder of all results; each study gets its own folder in it.
        extra: further variables of the results, from the plant with continuous actuators; asked for when a store is new.
        progress: whether to show bars with rate and time left.
        say: receives one line per event.

    Returns:
        The folder of the study, with ``results.zarr`` (see `studies.store.reading.open_results`) and ``model.json``.

    Raises:
        InputError: for a folder that cannot be written, or a plant that cannot be opened, before anything is computed.
        MissingToolError: if an FMU has to be built and cannot.
    """
    definition, process = comparison.definition, comparison.process
    folder = check_writable(Path(out) / definition.name)
    with locked(folder / RESULTS), closing(open_plant(process, definition.plant, actual=False)) as tested:
        model = model_of(process, tested)
        for note in settling_notes(model):
            say(f"Model: {note}.")
        model.save(folder / "model.json")
        schedule = None
        if any(controller.schedule for controller in definition.controllers):
            grid = process.model.schedule
            if not grid:
                expected = "positions of one or two MVs at which models are identified: a controller follows a schedule"
                raise InputError("model.schedule", {}, expected)
            schedule = identify_schedule(tested, grid, signals=signals_in(process))
            schedule.save(folder / "schedule.json")
        return run_comparison(
            definition,
            process,
            folder,
            model=model,
            make_plant=lambda actual: open_plant(process, definition.plant, actual=actual),
            plant_facts=plant_facts(process, tested),
            extra=lambda: extra(tested),
            others=sorted(Path(out).glob(f"*/{RESULTS}")),
            schedule=schedule,
            progress=progress,
            say=say,
        )
