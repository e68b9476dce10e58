"""Runs several controllers over one reference on one plant and stores each run as soon as it is done.

`run_comparison` is given everything that numbers depend on and asks the store which runs are missing, so a
second call computes only what changed.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import xarray as xr
from tqdm import tqdm

from jaxmpc.controller.continuous import ContinuousController
from jaxmpc.controller.mixed_integer import MixedIntegerController
from jaxmpc.controller.schedule import ModelSchedule, ScheduledController, ScheduledMixedIntegerController
from jaxmpc.errors import InputError
from jaxmpc.loop.simulate import simulate
from jaxmpc.loop.trajectory import Trajectory
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.tuning import Tuning
from jaxmpc.programs.compilation import compiled_since
from studies.definition.comparison import ComparisonDefinition, ControllerDefinition
from studies.store.comparison import (
    FORMAT,
    RESULTS,
    ResultStore,
    open_results,
    provenance,
    results_template,
    undamaged,
)
from studies.store.fingerprint import content_hash, source_hash, versions

Say = Callable[[str], None]
TUNING_AXES = {
    "cv": ("cv_weight", "soft_quadratic", "soft_linear", "deadzone", "cv_low", "cv_high", "slack_weight"),
    "mv": (
        "move_weight",
        "mv_low",
        "mv_high",
        "move_low",
        "move_high",
        "mean_move_limit",
        "oscillation_rows",
    ),
    "": ("bias_cutoff",),
}


def run_comparison(
    definition: ComparisonDefinition,
    folder: Path,
    *,
    model: StepResponseModel,
    make_plant: Callable[[str], Any],
    plant_facts: dict[str, Any],
    extra: Callable[[], dict[str, xr.DataArray]],
    others: Sequence[Path] = (),
    schedule: ModelSchedule | None = None,
    progress: bool = True,
    say: Say = print,
) -> Path:
    """Run what is missing of a comparison.

    Args:
        definition: checked with `ComparisonDefinition.check`.
        folder: of the study, writable and locked by the caller.
        model: prediction model of every controller.
        make_plant: the plant with a given actuator, in its initial state.
        plant_facts: JSON-like; identifies the plant, part of every hash.
        extra: computes further variables of the results (sweep, steady-state map); called for a new store.
        others: stores of other studies, for a new store to take equal runs from.
        schedule: models of the controllers with `ControllerDefinition.schedule`; None if there are none.
        progress: whether to show a bar with rate and time left.
        say: receives one line per event.

    Returns:
        The folder.
    """
    code = {package: source_hash(package) for package in ("jaxmpc", "identify")}
    inputs = {
        "plant": plant_facts,
        "reference": msgspec.to_builtins(definition.reference),
        "disturbance": msgspec.to_builtins(definition.disturbance),
        "model": np.asarray(model.coefficients),
        "model_dt": model.dt,
        "code": code,
    }
    scheduled: dict[str, Any] = {}
    if schedule is not None:
        parts = schedule.choke, schedule.lift, schedule.coefficients
        scheduled["schedule"] = [np.asarray(part) for part in parts]
    hashes = [
        content_hash(inputs | (scheduled if controller.schedule else {}), controller.resolved())
        for controller in definition.controllers
    ]
    study_hash = content_hash(FORMAT, msgspec.to_builtins(definition), hashes)
    store = ResultStore.begin(
        folder,
        [controller.name for controller in definition.controllers],
        study_hash,
        lambda: comparison_template(definition, model, extra(), hashes, study_hash, plant_facts, code),
        say,
        others,
    )
    for controller in definition.controllers:
        if store.complete(controller.name):
            say(f"{controller.label}: stored already.")
            continue
        started = time.perf_counter()
        given = {"schedule": schedule} if controller.schedule else {}
        trajectory = run_controller(controller, definition, model, make_plant, progress, **given)
        wall_time = time.perf_counter() - started
        store.write(controller.name, trajectory, wall_time)
        say(f"{controller.label}: {trajectory.samples} samples in {wall_time:.1f} s.")
    return folder


def is_current(definition: ComparisonDefinition, folder: Path) -> bool:
    """Whether every run of a study is stored undamaged, made from this definition by today's code.

    Args:
        definition: of the study.
        folder: its results.
    """
    if not undamaged(folder / RESULTS, range(len(definition.controllers))):
        return False
    try:
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
    model: StepResponseModel,
    make_plant: Callable[[str], Any],
    progress: bool = True,
    schedule: ModelSchedule | None = None,
) -> Trajectory:
    """One closed loop of a comparison.

    Args:
        definition: of the controller.
        comparison: gives the reference and the disturbance.
        model: prediction model.
        make_plant: the plant with a given actuator.
        progress: whether to show a bar with rate and time left.
        schedule: prediction models of a controller with a schedule.
    """
    structure = definition.structure()

    def controller(tuning: Tuning) -> ContinuousController | MixedIntegerController:
        if definition.schedule:
            if schedule is None:
                raise InputError("schedule", None, f"a gain schedule for {definition.name}")
            if definition.kind == "continuous":
                return ScheduledController(structure, tuning, schedule)
            return ScheduledMixedIntegerController(
                structure, tuning, schedule, time_limit=definition.time_limit
            )
        if definition.kind == "continuous":
            return ContinuousController(structure, tuning, model)
        return MixedIntegerController(structure, tuning, model, time_limit=definition.time_limit)

    plant = make_plant(definition.actuator)
    with progress_bar(definition.label, progress) as report, closing(plant):
        return simulate(
            controller(definition.build_tuning()),
            plant,
            comparison.reference.build(),
            disturbance=comparison.offsets(structure.dt),
            changes=[(at, controller(tuning)) for at, tuning in definition.later_tunings()],
            open_loop_from=definition.open_loop_from,
            keep_plans=True,
            progress=report,
        )


@contextlib.contextmanager
def progress_bar(label: str, show: bool) -> Iterator[Callable[[int, int], None]]:
    """A progress callback ``(done, total)`` that shows samples, rate and time left, compilation not counted."""
    often = 0.5 if sys.stderr.isatty() else 10.0  # s; a log file needs no more
    with tqdm(desc=label, unit=" samples", disable=not show, dynamic_ncols=True, mininterval=often) as bar:
        compiled = compiled_since()

        def report(done: int, total: int) -> None:
            if show:
                seconds = compiled()
                bar.start_t += seconds
                bar.last_print_t += seconds
            bar.total = total
            bar.update(done - bar.n)

        yield report


@contextlib.contextmanager
def closing(plant: Any) -> Iterator[Any]:
    """A plant, freed at the end if it holds anything outside Python."""
    try:
        yield plant
    finally:
        close = getattr(plant, "close", None)
        if close is not None:
            close()


def comparison_template(
    definition: ComparisonDefinition,
    model: StepResponseModel,
    extra: dict[str, xr.DataArray],
    hashes: list[str],
    study_hash: str,
    plant_facts: dict[str, Any],
    code: dict[str, str],
) -> xr.Dataset:
    """The results of a comparison before anything has run: setpoints, tuning, model and provenance.

    Args:
        definition: of the study.
        model: prediction model.
        extra: further variables.
        hashes: content hash of every controller's inputs.
        study_hash: of everything.
        plant_facts: identifies the plant.
        code: hash of every package that computes results.
    """
    first = definition.controllers[0].structure()
    reference = definition.reference.build()
    if model.cv_names != first.cv_names or model.mv_names != first.mv_names:
        raise InputError(
            "model.cv, model.mv",
            [*model.cv_names, *model.mv_names],
            f"the names {[*first.cv_names, *first.mv_names]} of the controllers",
        )
    if abs(model.dt - first.dt) > 1e-9:
        raise InputError("model.dt", model.dt, f"the sampling interval of the controllers, {first.dt} s")
    window = reference.window(first.dt)
    shared = {
        "setpoint": xr.DataArray(
            reference.sample(first.dt),
            dims=("time", "cv"),
            attrs={"long_name": "setpoint", "units": "cv_unit"},
        ),
        "window": xr.DataArray(
            window.astype("i4"),
            dims="time",
            attrs={"long_name": "index of the setpoint window", "units": "1"},
        ),
        "disturbance": xr.DataArray(
            definition.offsets(first.dt),
            dims="time",
            attrs={"long_name": "offset of the reservoir pressure", "units": "bar"},
        ),
        "model_coefficient": xr.DataArray(
            np.asarray(model.coefficients),
            dims=("cv", "mv", "lag"),
            coords={
                "lag": (
                    "lag",
                    first.dt * np.arange(1, model.samples + 1),
                    {"long_name": "time after the step", "units": "s"},
                )
            },
            attrs={"long_name": "step-response coefficient", "units": "cv_unit per mv_unit"},
        ),
        **_controller_variables(definition),
        **extra,
    }
    provenance = {
        "study": definition.name,
        "title": definition.title,
        "dt": first.dt,
        "definition": msgspec.to_builtins(definition),
        "structures": [dataclasses.asdict(controller.structure()) for controller in definition.controllers],
        "plant": plant_facts,
        "model": {"working_point": dict(model.working_point), "provenance": dict(model.provenance)},
        "code": code,
        "versions": versions(),
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    return results_template(
        controllers=[controller.name for controller in definition.controllers],
        labels=[controller.label for controller in definition.controllers],
        hashes=hashes,
        time=first.dt * np.arange(len(window)),
        cv_names=first.cv_names,
        mv_names=first.mv_names,
        cv_units=first.cv_units,
        mv_units=first.mv_units,
        blocks=max(controller.structure().block_count for controller in definition.controllers),
        shared=shared,
        provenance=provenance,
        study_hash=study_hash,
    )


def _controller_variables(definition: ComparisonDefinition) -> dict[str, xr.DataArray]:
    """Tuning and kind of every controller, as variables over ``controller``."""
    tunings = [controller.build_tuning() for controller in definition.controllers]
    structures = [controller.structure() for controller in definition.controllers]
    out = {}
    for axis, keys in TUNING_AXES.items():
        for key in keys:
            values = np.stack([np.asarray(getattr(tuning, key), dtype=float) for tuning in tunings])
            out[f"tuning_{key}"] = xr.DataArray(
                values,
                dims=("controller", axis) if axis else ("controller",),
                attrs={"long_name": f"tuning: {key.replace('_', ' ')}"},
            )
    most = max(structure.block_count for structure in structures)
    out["block_length"] = xr.DataArray(
        np.array([[*s.blocks, *[0] * (most - s.block_count)] for s in structures], dtype="i4"),
        dims=("controller", "block"),
        attrs={"long_name": "samples of a block, 0 beyond the last", "units": "1"},
    )
    for key in ("prediction_horizon", "control_horizon"):
        out[key] = xr.DataArray(
            np.array([getattr(structure, key) for structure in structures], dtype="i4"),
            dims="controller",
            attrs={"long_name": key.replace("_", " "), "units": "1"},
        )
    text = np.dtypes.StringDType()
    for key in ("kind", "actuator", "blocking", "tuning"):
        values = [getattr(controller, key) for controller in definition.controllers]
        name = "tuning_preset" if key == "tuning" else key
        out[name] = xr.DataArray(np.array(values, dtype=text), dims="controller")
    out["mean_move_window"] = xr.DataArray(
        np.array([structure.mean_move_window for structure in structures], dtype="i4"),
        dims="controller",
        attrs={"long_name": "samples of the mean move", "units": "1"},
    )
    return out
