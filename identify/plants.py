"""The plants and the model of a process: opened from where its file says they come from.

A step-response model is its own plant, a JAX function and a Python class are imported, an FMU runs in a process of its own.
Studies, the command line and the app open theirs here.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from identify.step_test import identify_step_response
from identify.working_point import facts_of
from jaxmpc.check import among
from jaxmpc.errors import InputError, near
from jaxmpc.model.step_response import StepResponseModel, make_model
from jaxmpc.process.actuator import Actuator
from jaxmpc.process.file import own_module, process_digest
from jaxmpc.process.model_plant import ModelPlant
from jaxmpc.process.plant import Parameter, Signals, closing, disturbances_of
from jaxmpc.process.process import PlantSource, Process


def open_plant(
    process: Process,
    name: str = "",
    *,
    actual: bool = True,
    parameters: Mapping[str, Any] | None = None,
) -> Any:
    """A plant of a process, at its working point.

    Args:
        name: of the plant; the first if not given.
        actual: whether MVs move as their actuators do; otherwise they take every value within their limits.
        parameters: that are not the plant's own, by name, in the units of its `parameter_table`.

    Returns:
        A `JaxPlant` or a stateful plant; one that has `close` is to be closed.

    Raises:
        InputError: for an unknown name, a module or function that is not there, and a plant that is not one of the process:
            another sampling interval, or without its disturbances.
    """
    name = name or next(iter(process.plants))
    among("plant", name, process.plants)
    source, path = process.plants[name], f"plants.{name}"
    plant = _made(process, source, path, process.actuators(actual))
    if abs(plant.dt - process.dt) > 1e-9 * process.dt:
        raise InputError(
            path, f"a sampling interval of {plant.dt:g} s", f"dt = {process.dt:g} s of the process"
        )
    own = disturbances_of(plant)
    for i, name in enumerate(process.disturbance_names):
        among(f"disturbance[{i}].name", name, own, f"a disturbance of {path}:")
    return plant.replaced(parameters) if parameters else plant


def disturbance_of(process: Process, plant: Any, given: np.ndarray) -> np.ndarray:
    """Disturbances ``"... disturbance"`` of a process in the order of its plant; what else that has is 0."""
    own = disturbances_of(plant)
    out = np.zeros((*given.shape[:-1], len(own)))
    out[..., [own.index(name) for name in process.disturbance_names]] = given
    return out


def parameters_of(process: Process, name: str = "") -> tuple[Parameter, ...]:
    """Parameters of a plant of a process that studies may vary."""
    with closing(open_plant(process, name)) as plant:
        return tuple(getattr(plant, "parameter_table", ()))


def plant_facts(process: Process, plant: Any) -> dict[str, Any]:
    """JSON-like facts that identify a plant of a process, for hashes and provenance."""
    found = facts_of(plant)
    return found if found["hash"] else found | {"hash": process_digest(process)}


def _made(process: Process, source: PlantSource, path: str, actuators: Sequence[Actuator]) -> Any:
    folder = Path(process.folder)
    if source.kind == "model":
        return ModelPlant(load_model(process, source.source), actuators=tuple(actuators), **source.options)
    if source.kind == "fmu":
        from identify.fmu import FmuPlant

        mvs = dict(zip(process.mv_names, actuators, strict=True))
        named = process.cv_names, process.disturbance_names
        return FmuPlant(folder / source.source, mvs, *named, dt=process.dt, **source.options)
    make = imported(source.source, folder, f"{path}.source")
    return make(actuators=tuple(actuators), **source.options)


def imported(source: str, folder: Path, path: str) -> Any:
    """What ``module:name`` names; the module is installed, or a file in the folder of the process.

    Raises:
        InputError: if it is not there, at `path`.
    """
    module, _, name = source.partition(":")
    try:
        file = own_module(source, folder)
        if file is not None:
            spec: Any = importlib.util.spec_from_file_location(f"jaxmpc_process_{module}", file)
            found = importlib.util.module_from_spec(spec)
            sys.modules[spec.name] = found  # so that what it defines can be sent to workers
            spec.loader.exec_module(found)
        else:
            found = importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            path, source, f"a module that can be imported, or a file in {folder} ({error})"
        ) from None
    if not hasattr(found, name):
        raise InputError(path, source, f"a name in {module}", near(name, vars(found)))
    return getattr(found, name)


def load_model(process: Process, file: str = "") -> StepResponseModel:
    """The model of a process whose file names it or lists its transfer functions, or another model file.

    Args:
        file: in place of the model of the process; it has the CVs and MVs of the process in its order.

    Raises:
        InputError: naming the field that does not fit.
    """
    if not file and process.model.responses:
        return _sampled(process)
    file = file or process.model.file
    return fitting(process, StepResponseModel.load(Path(process.folder) / file), f"{file}: ")


def fitting(process: Process, model: StepResponseModel, place: str) -> StepResponseModel:
    """A model as it is, if it has the CVs and MVs of a process in its order, and its sampling interval.

    Raises:
        InputError: naming what does not fit, after `place`.
    """
    for key, names in (("cv", process.cv_names), ("mv", process.mv_names)):
        found = getattr(model, f"{key}_names")
        if found != names:
            raise InputError(f"{place}{key}", list(found), f"those of the process: {', '.join(names)}")
    if abs(model.dt - process.dt) > 1e-9 * process.dt:
        raise InputError(f"{place}dt", model.dt, f"dt = {process.dt:g} s of the process")
    return model


def _sampled(process: Process) -> StepResponseModel:
    """The transfer functions of a process, sampled."""
    source, units = process.model, process.units
    times = process.dt * np.arange(1, source.samples + 1)
    found = {(one.cv, one.of): one.function.step_response(times) for one in source.responses}
    measured = [d for d in process.disturbance_names if any(one.of == d for one in source.responses)]

    def table(inputs: Sequence[str]) -> list[list[np.ndarray]]:
        return [[found.get((cv, of), 0.0 * times) for of in inputs] for cv in process.cv_names]

    return make_model(
        table(process.mv_names),
        process.dt,
        process.cv_names,
        process.mv_names,
        cv_units=[cv.unit for cv in process.cvs],
        mv_units=[mv.unit for mv in process.mvs],
        working_point=source.working_point,
        dv_coefficients=table(measured) if measured else (),
        dv_names=measured,
        dv_units=[units[name] for name in measured],
    )


def signals_in(process: Process) -> Signals:
    """Names and units of a process, as its plants say them."""
    units = [tuple(v.unit for v in own) for own in (process.cvs, process.mvs, process.disturbances)]
    return Signals(process.cv_names, process.mv_names, *units)


def model_samples(process: Process) -> int:
    """Coefficients of the model of a process."""
    return load_model(process).samples if process.model.given else process.model.samples


def model_of(
    process: Process, plant: Any = None, working_point: Sequence[float] = (), samples: int | None = None
) -> StepResponseModel:
    """The step-response model of a process: its file, its transfer functions, or a step test on its plant.

    Args:
        plant: for the step test; the first one of the process if not given.
        working_point: of the step test, one value per MV [MV unit]; that of the process if not given.
        samples: coefficients; those of the process if not given.

    Raises:
        InputError: for a working point from which the steps cannot be made.
    """
    if process.model.given:
        return load_model(process)
    point = dict(zip(process.mv_names, map(float, working_point), strict=True)) if working_point else {}
    if plant is not None:
        return identified(process, plant, point, samples=samples)
    with closing(open_plant(process, actual=False)) as own:
        return identified(process, own, point, samples=samples)


def identified(
    process: Process,
    plant: Any,
    point: Mapping[str, float] | None = None,
    steps: Mapping[str, float] | None = None,
    samples: int | None = None,
) -> StepResponseModel:
    """A model from a step test on a plant of a process, whatever its file says of a model.

    Args:
        point, steps: by MV, where they are not those of the process [MV unit].
        samples: coefficients; those of the process if not given.

    Raises:
        InputError: for a working point from which the steps cannot be made.
    """
    at = process.model.working_point | dict(point or {})
    sizes = process.model.steps | dict(steps or {})
    return identify_step_response(
        plant,
        at or None,
        sizes or None,
        samples or process.model.samples,
        disturbance_steps=process.model.disturbance_steps,
        signals=signals_in(process),
    )
