"""Runs several controllers over one reference on one plant and stores each run as soon as it is done.

A comparison is a list of scenarios with names, each a chunk of its store. `run_comparison` is given everything that
numbers depend on and asks the store which runs are missing, so a second call computes only what changed.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import xarray as xr
from tqdm import tqdm

from identify.plants import disturbance_of, fitting, load_model
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.schedule import ModelSchedule, ScheduledController
from jaxmpc.errors import InputError
from jaxmpc.files import strict_json
from jaxmpc.loop.events import Event
from jaxmpc.loop.simulate import simulate
from jaxmpc.loop.trajectory import Trajectory
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import FIELDS as TUNING
from jaxmpc.process.file import process_digest
from jaxmpc.process.plant import closing
from jaxmpc.process.process import Process
from jaxmpc.programs.clock import Clock
from studies.definition.comparison import ComparisonDefinition, ControllerDefinition
from studies.run.progress import looks
from studies.store.files import FORMAT, RESULTS, open_manifest, survey
from studies.store.fingerprint import content_hash, made_now, packages_hash, source_hash
from studies.store.layout import Column, StoreLayout, process_axes
from studies.store.reading import open_results, provenance
from studies.store.trajectories import PLAN, RUN_VARIABLES, run_fields
from studies.store.writing import Store

Say = Callable[[str], None]


def run_comparison(
    definition: ComparisonDefinition,
    process: Process,
    folder: Path,
    *,
    model: StepResponseModel,
    make_plant: Callable[[bool], Any],
    plant_facts: dict[str, Any],
    extra: Callable[[], Mapping[str, xr.DataArray]],
    others: Sequence[Path] = (),
    schedule: ModelSchedule | None = None,
    progress: bool = True,
    say: Say = print,
) -> Path:
    """Run what is missing of a comparison.

    Args:
        folder: of the study, writable and locked by the caller.
        process: that is controlled.
        make_plant: the plant in its initial state, with its actual actuators or with continuous ones.
        plant_facts: JSON-like; identifies the plant, part of every hash.
        extra: computes further variables of the results (sweep, steady-state map); called for a new store.
        others: stores of other studies, for a new store to take equal runs from.
        schedule: models of the controllers with `ControllerDefinition.schedule`; None if there are none.
    """
    code = packages_hash()
    inputs = {
        "plant": plant_facts,
        "reference": msgspec.to_builtins(definition.reference),
        "disturbance": msgspec.to_builtins(definition.disturbance),
        "model": np.asarray(model.coefficients),
        "model_dt": model.dt,
        "process": process_digest(process),
        "code": code,
    }
    scheduled: dict[str, Any] = {}
    if schedule is not None:
        scheduled["schedule"] = [np.asarray(part) for part in (*schedule.grid, schedule.coefficients)]
    models = [load_model(process, one.model) if one.model else model for one in definition.controllers]
    hashes = []
    for controller, own in zip(definition.controllers, models, strict=True):
        known = inputs | {"model": np.asarray(own.coefficients)} | (scheduled if controller.schedule else {})
        hashes.append(content_hash(known, controller.resolved(process)))
    study_hash = content_hash(FORMAT, msgspec.to_builtins(definition), hashes)
    layout = comparison_layout(definition, process, model, extra, hashes, study_hash, plant_facts, code)

    def run(i: int) -> Trajectory:
        controller = definition.controllers[i]
        given = {"schedule": schedule} if controller.schedule else {}
        return run_controller(controller, definition, process, models[i], make_plant, progress, **given)

    return run_missing(folder, layout, run, say, others)


def run_missing(
    folder: Path,
    layout: StoreLayout,
    run: Callable[[int], Trajectory],
    say: Say,
    others: Sequence[Path] = (),
) -> Path:
    """Run the controllers that a store does not hold yet, in order, and store each at once.

    Args:
        folder: of the study; its store is locked by the caller.
        layout: from `results_layout`.
        others: stores of other studies, for a new store to take equal runs from.
    """
    with Store.begin(folder / RESULTS, layout, say, others=others, lock=False) as store:
        missing = store.pending()
        for i, label in enumerate(layout.columns[0].values):
            if i not in missing:
                say(f"{label}: stored already.")
                continue
            started = time.perf_counter()
            trajectory = run(i)
            wall_time = time.perf_counter() - started
            fields = run_fields(trajectory, wall_time, layout.lengths[PLAN.dims[1]])
            store.commit(i, fields, {"wall_time": wall_time})
            say(f"{label}: {trajectory.samples} samples in {wall_time:.1f} s.")
    return folder


def is_current(definition: ComparisonDefinition, folder: Path) -> bool:
    """Whether every run of a study is stored undamaged, made from this definition by today's code."""
    try:
        store, manifest = open_manifest(folder / RESULTS)
        if len(survey(store, manifest["contents"], deep=True).records) < len(definition.controllers):
            return False
        with open_results(folder) as data:
            # a stored definition is JSON: tuples are lists
            wanted = msgspec.json.decode(msgspec.json.encode(definition))
            code = provenance(data, "code")
            return (
                provenance(data, "definition") == wanted
                and isinstance(code, dict)
                and bool(code)
                and all(source_hash(package) == known for package, known in code.items())
            )
    except InputError:
        return False


def run_controller(
    definition: ControllerDefinition,
    comparison: ComparisonDefinition,
    process: Process,
    model: StepResponseModel,
    make_plant: Callable[[bool], Any],
    progress: bool = True,
    schedule: ModelSchedule | None = None,
) -> Trajectory:
    """One closed loop of a comparison."""
    made = definition.structure(process), definition.build_tuning(process)
    if not definition.schedule:
        controller = Controller(*made, model, time_limit=definition.time_limit)
    elif schedule is None:
        raise InputError("schedule", None, f"a gain schedule for {definition.name}")
    else:
        controller = ScheduledController(*made, schedule, time_limit=definition.time_limit)
    plant = make_plant(definition.actuator == "step")
    with progress_bar(definition.label, progress) as report, closing(plant):
        return simulate(
            controller,
            plant,
            comparison.reference.build(process),
            disturbance=disturbance_of(process, plant, comparison.offsets(process)),
            position_feedback=definition.position_feedback,
            events=[Event(change.at, change.changes) for change in definition.then],
            open_loop_from=definition.open_loop_from,
            keep_plans=True,
            progress=report,
        )


@contextlib.contextmanager
def progress_bar(label: str, show: bool) -> Iterator[Callable[[int, int], None]]:
    """A progress callback ``(done, total)`` that shows samples, rate and time left, compilation not counted."""
    with tqdm(desc=label, unit=" samples", **looks(show)) as bar:
        clock = Clock()

        def report(done: int, total: int) -> None:
            if show:
                bar.start_t = time.time() - clock.seconds
                bar.last_print_t = max(bar.last_print_t, bar.start_t)
            bar.total = total
            bar.update(done - bar.n)

        yield report


def results_layout(
    *,
    controllers: Mapping[str, str],
    hashes: Sequence[str],
    structure: Structure,
    times: np.ndarray,
    blocks: int,
    shared: Callable[[], Mapping[str, xr.DataArray]],
    provenance: dict[str, Any],
    study_hash: str,
) -> StoreLayout:
    """The store of a comparison.

    Args:
        controllers: name and label of each.
        times: of the samples [s].
        blocks: of the controller that has most.
        shared: gives the variables without a trajectory: setpoints, tuning, model, sweep.
        provenance: JSON-like facts, one attribute each, with ``study`` and ``title``.
    """
    s = structure
    return StoreLayout(
        name=provenance["study"],
        title=provenance["title"],
        study_hash=study_hash,
        chunk_size=1,
        chunk_scenarios=tuple(np.arange(i, i + 1) for i in range(len(hashes))),
        scenario_hashes=tuple(hashes),
        columns=(
            Column("label", "controller and actuator", "", np.array(list(controllers.values()), object)),
        ),
        variables=RUN_VARIABLES,
        coords=process_axes(
            times,
            {"cv": s.cv_names, "mv": s.mv_names},
            {"cv": s.cv_units, "mv": s.mv_units},
        ),
        provenance={"dt": s.dt, **provenance, **made_now()},
        rows="controller",
        names=tuple(controllers),
        lengths={PLAN.dims[1]: blocks},
        shared=shared,
    )


def comparison_layout(
    definition: ComparisonDefinition,
    process: Process,
    model: StepResponseModel,
    extra: Callable[[], Mapping[str, xr.DataArray]],
    hashes: Sequence[str],
    study_hash: str,
    plant_facts: dict[str, Any],
    code: dict[str, str],
) -> StoreLayout:
    """The store of a comparison: setpoints, tuning, model and provenance."""
    first = definition.controllers[0].structure(process)
    reference = definition.reference.build(process)
    fitting(process, model, "model.")
    structures = [controller.structure(process) for controller in definition.controllers]
    return results_layout(
        controllers={controller.name: controller.label for controller in definition.controllers},
        hashes=hashes,
        structure=first,
        times=first.dt * np.arange(reference.samples(first.dt)),
        blocks=max(structure.block_count for structure in structures),
        shared=lambda: {
            **shared_variables(
                process,
                model,
                definition.controllers,
                reference.sample(first.dt),
                reference.window(first.dt),
                definition.offsets(process),
            ),
            **extra(),
        },
        provenance={
            "study": definition.name,
            "title": definition.title,
            "definition": msgspec.to_builtins(definition),
            "process": strict_json(process.body),
            "structures": [dataclasses.asdict(structure) for structure in structures],
            "plant": plant_facts,
            "model": {"working_point": dict(model.working_point), "provenance": dict(model.provenance)},
            "code": code,
        },
        study_hash=study_hash,
    )


def labelled(values: Any, dims: Sequence[str], long_name: str, unit: str, **axes: Any) -> xr.DataArray:
    """A variable of the results; `axes` are the values, long name and unit of axes of its own."""
    coords = {name: (name, at, {"long_name": what, "units": of}) for name, (at, what, of) in axes.items()}
    return xr.DataArray(values, coords, dims, attrs={"long_name": long_name, "units": unit})


def shared_variables(
    process: Process,
    model: StepResponseModel,
    controllers: Sequence[ControllerDefinition],
    setpoint: np.ndarray,
    window: np.ndarray,
    disturbance: np.ndarray,
) -> dict[str, xr.DataArray]:
    """Setpoints, disturbance, model and the controllers' tuning.

    Args:
        setpoint: ``"sample cv"`` [CV unit].
        window: ``"sample"``, index of the setpoint window.
        disturbance: ``"sample disturbance"``.
    """
    lag = model.dt * np.arange(1, model.samples + 1), "time after the step", "s"
    coefficients = np.asarray(model.coefficients)
    return {
        "setpoint": labelled(setpoint, ("time", "cv"), "setpoint", "cv_unit"),
        "window": labelled(window.astype("i4"), ("time",), "index of the setpoint window", "1"),
        "disturbance": labelled(
            disturbance,
            ("time", "disturbance_name"),
            "disturbances",
            "unit of the disturbance",
            disturbance_name=(list(process.disturbance_names), "disturbance", ""),
        ),
        "model_coefficient": labelled(
            coefficients, ("cv", "mv", "lag"), "step-response coefficient", "cv_unit per mv_unit", lag=lag
        ),
        **_controller_variables(controllers, process),
    }


def _controller_variables(
    controllers: Sequence[ControllerDefinition], process: Process
) -> dict[str, xr.DataArray]:
    """Tuning and kind of every controller, as variables over ``controller``."""
    tunings = [controller.build_tuning(process) for controller in controllers]
    structures = [controller.structure(process) for controller in controllers]
    out = {}
    for key, field in TUNING.items():
        values = np.stack([np.asarray(getattr(tuning, key), dtype=float) for tuning in tunings])
        attrs = {"long_name": f"tuning: {key.replace('_', ' ')}"}
        dims = ("controller", field.of) if field.of else ("controller",)
        out[f"tuning_{key}"] = xr.DataArray(values, dims=dims, attrs=attrs)
    most = max(structure.block_count for structure in structures)
    lengths = np.array([[*s.blocks_of(0), *[0] * (most - s.block_count)] for s in structures], dtype="i4")
    what = "samples of a block, 0 beyond the last"
    out["block_length"] = labelled(lengths, ("controller", "block"), what, "1")
    for key, what in {
        "prediction_horizon": "prediction horizon",
        "control_horizon": "control horizon",
        "mean_move_window": "samples of the mean move",
    }.items():
        values = np.array([getattr(structure, key) for structure in structures], dtype="i4")
        out[key] = labelled(values, ("controller",), what, "1")
    for key in ("kind", "actuator", "blocking", "tuning"):
        values = np.array([getattr(controller, key) for controller in controllers], dtype=object)
        values = np.where(values == "", process.default_preset, values) if key == "tuning" else values
        out["tuning_preset" if key == "tuning" else key] = xr.DataArray(values, dims="controller")
    return out
