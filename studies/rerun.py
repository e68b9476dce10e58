"""One scenario of a stored sweep, run again with everything recorded: to look closely at a point of a plot."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import xarray as xr

from identify.plants import disturbance_of, open_plant
from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError
from jaxmpc.files import from_strict_json, write_atomically
from jaxmpc.loop.simulate import simulate
from jaxmpc.loop.trajectory import AXES, Trajectory
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.plant import closing
from jaxmpc.process.process import Process
from studies.definition.models import identify_models
from studies.definition.scenarios import Scenario, Study
from studies.definition.sweep import StudyDefinition
from studies.load import expand
from studies.search.study import SearchStudy
from studies.store.reading import open_study, provenance


@dataclasses.dataclass(frozen=True, eq=False)
class Rerun:
    """A scenario that was run again.

    Attributes:
        trajectory: every sample of it.
        deadzone: ``"cv"``, of its tuning [CV unit].
        title: study, number and the values of its axes.
        kind: of its controller.
        actuator: of its MVs, ``step`` or ``continuous``.
        process: that it controls.
    """

    trajectory: Trajectory
    deadzone: np.ndarray
    title: str
    kind: str
    actuator: str
    process: Process

    def save(self, folder: Path) -> Path:
        """Write the trajectory as netCDF; returns the file."""
        t = self.trajectory
        fields = {}
        for axis, names in AXES.items():
            for name in names:
                if name != "time":
                    values = np.asarray(getattr(t, name))
                    values = values.astype("i4") if values.dtype.kind in "bui" else values
                    # an axis and a field may not have one name
                    key = f"{name}_value" if name in ("cv", "mv") else name
                    fields[key] = (("time", axis) if axis else ("time",), values)
        coords = {
            "time": ("time", t.time, {"units": "s"}),
            "cv": ("cv", list(t.cv_names)),
            "mv": ("mv", list(t.mv_names)),
        }
        data = xr.Dataset(fields, coords, {"title": self.title})
        return write_atomically(folder / "trajectory.nc", lambda path: data.to_netcdf(path, engine="scipy"))


def study_of(store: Path) -> Study:
    """The study that a store was made from, expanded again from the definition that is stored with it.

    Raises:
        InputError: if there is no store, or a file that the definition needs is gone.
    """
    with open_study(store) as data:
        body, folder = provenance(data, "definition"), provenance(data, "folder")
        quick = provenance(data, "quick")
    if not isinstance(body, dict) or "study" not in body:
        expected = (
            "the store of a sweep; a comparison has every sample of its runs already, and figures of them"
        )
        raise InputError("store", str(store), expected)
    definition = StudyDefinition.from_dict(from_strict_json(body), folder or ".")
    made = expand(definition, quick=bool(quick), confirmed=True)
    return made.evaluated(store) if isinstance(made, SearchStudy) else made


def rerun(store: Path, number: int) -> Rerun:
    """Run a scenario again, alone.

    Args:
        store: of a sweep study.
        number: of the scenario.

    Raises:
        InputError: for a store or a number that does not exist.

    Warns:
        UserWarning: if definition files or code have changed since, so that the run may differ from the stored one.
    """
    study = study_of(store)
    scenario = study.scenario(number)
    with open_study(store) as data:
        stored = data.scenario_hash.values
    if number >= len(stored) or str(stored[number]) != study.scenario_hash(number):
        warnings.warn(
            f"scenario {number} was stored by other code or inputs; it may differ now", stacklevel=2
        )
    process, trajectory = study.process, close_loop(study, scenario)
    shown = lambda value: f"{value:g}" if isinstance(value, float) else value  # noqa: E731
    values = [
        f"{c.key} = {shown(c.values[number])}{f' {c.unit}' if c.unit not in ('', '1') else ''}"
        for c in study.columns
    ]
    title = f"{study.name}, scenario {number}: {', '.join(values)}"
    return Rerun(
        trajectory, np.asarray(scenario.tuning.deadzone), title, scenario.kind, scenario.actuator, process
    )


def close_loop(
    study: Study,
    scenario: Scenario,
    model: StepResponseModel | None = None,
    *,
    keep_plans: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Trajectory:
    """Run one scenario of a study, alone.

    Args:
        model: that of its working point; identified if not given.
        keep_plans, progress: as in `jaxmpc.loop.simulate.simulate`.

    Raises:
        InputError: for a plant that cannot be opened, or a working point without a model.
    """
    process, offsets = study.process, scenario.disturbance
    if model is None:
        model = identify_models(process, [scenario.model_point])[scenario.model_point]
    # arrays: no program of its own for every scenario
    parameters = {name: np.float64(value) for name, value in scenario.plant.items()}
    actual = scenario.actuator == "step"
    opened = open_plant(process, study.definition.study.plant, actual=actual, parameters=parameters)
    with closing(opened) as plant:
        return simulate(
            Controller(scenario.structure, scenario.tuning, model),
            plant,
            scenario.reference,
            samples=scenario.samples,
            disturbance=None if offsets is None else disturbance_of(process, plant, offsets),
            noise=scenario.noise,
            faults=scenario.faults,
            position_feedback=scenario.position_feedback,
            preview=scenario.preview,
            events=scenario.events,
            seed=scenario.seed,
            keep_plans=keep_plans,
            progress=progress,
        )
