"""One closed loop of any process from the keys of studies, with key figures and every plan: what the app computes.

A run is a study without axes: its settings are a base table, checked, named and refused as in a definition file. Only
numbers change from one run to the next as long as the structure and the length stay the same, so that nothing is compiled
again. `main` prints the key figures of a run.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from figures.closed_loop import RUN, of_trajectory
from jaxmpc.errors import InputError
from jaxmpc.loop.trajectory import RECORDABLE, Trajectory, TrajectoryBatch
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.tuning import Tuning
from jaxmpc.process.file import shipped_processes
from jaxmpc.process.process import Process
from studies.definition.fields import Field, find
from studies.definition.models import Point, identify_models
from studies.definition.scenarios import Scenario, expand_sweep
from studies.definition.sections import DEFAULT_PROCESS
from studies.definition.sweep import StudyDefinition, settings
from studies.kpi.sweep import RECORD, batch_kpis, kpis_of, measures_of
from studies.rerun import close_loop

Progress = Callable[[int, int], None]
Base = Mapping[str, Any]  # the table [base] of a study

STEP, SHORT = 30, 180  # samples: when the setpoints of a short run change, and how long it is
LISTS = ("disturbance", "event", "sensor_fault")  # of a base, what happens during a run
MOST_MOVES = 64  # of stepped MVs that are left to one another without blocks; a step with more takes seconds


@dataclasses.dataclass(frozen=True, eq=False)
class Explorer:
    """A process whose loops are run, and what the runs share; made by `explorer`.

    Attributes:
        definition: a study of the process, without settings.
        models: those identified so far, by working point.
        first: the run that is there before anybody asks for it, see `studies.notebooks.launch.First`.
    """

    definition: StudyDefinition
    models: dict[Point, StepResponseModel] = dataclasses.field(default_factory=dict)
    first: list[ExploreRun] = dataclasses.field(default_factory=list)

    @property
    def process(self) -> Process:
        """That is controlled."""
        return self.definition.process

    @property
    def fields(self) -> Mapping[str, Field]:
        """The keys that a base may have, with label, unit, default and limits."""
        return self.definition.fields

    def model(self, point: Point) -> StepResponseModel:
        """The model at a working point; kept for the next run."""
        if point not in self.models:
            self.models[point] = identify_models(self.process, [point])[point]
        return self.models[point]

    def short_step(self, setpoints: Sequence[float] | None = None) -> dict[str, Any]:
        """The table ``reference`` of a short run whose setpoints change once.

        Args:
            setpoints: from then on, per CV [CV unit]; the second ones of the default reference if not given.
        """
        known = np.asarray(self.process.reference().setpoints)
        after = known[min(1, len(known) - 1)].tolist() if setpoints is None else list(setpoints)
        dt = self.process.dt
        return {"times": [0.0, STEP * dt], "setpoints": [known[0].tolist(), after], "duration": SHORT * dt}


def explorer(process: str | Path = DEFAULT_PROCESS, plant: str = "") -> Explorer:
    """A process to explore.

    Args:
        process: a shipped one by name, or a process file.
        plant: one of its plants; the first if not given.

    Raises:
        InputError: for a process or plant that does not exist or cannot be opened.
    """
    named = str(process) if str(process) in shipped_processes() else str(Path(process).resolve())
    return Explorer(
        StudyDefinition.from_dict({"study": {"name": "explored", "process": named, "plant": plant}})
    )


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """A base table from values by key."""
    out: dict[str, Any] = {}
    for key, value in values.items():
        *tables, name = key.split(".")
        inner = out
        for table in tables:
            inner = inner.setdefault(table, {})
        inner[name] = value
    return out


@dataclasses.dataclass(frozen=True, eq=False)
class ExploreRun:
    """A finished run.

    Attributes:
        definition: the study without axes that it is.
        scenario: its typed inputs.
        trajectory: every sample, with its plans.
        kpis: every key figure of `studies.kpi.sweep.kpis_of`; ``name.channel`` where it is one per CV or MV.
        model: of the controller.
        seconds: that it took, key figures included.
    """

    definition: StudyDefinition
    scenario: Scenario
    trajectory: Trajectory
    kpis: dict[str, float]
    model: StepResponseModel
    seconds: float

    @functools.cached_property
    def data(self) -> xr.Dataset:
        """The run as `studies.store.reading.open_results` would give it, with one controller `RUN`."""
        t, scenario, structure = self.trajectory, self.scenario, self.scenario.structure
        lengths = np.zeros((structure.block_count, structure.mv_count), dtype=int)
        for i in range(structure.mv_count):
            blocks = structure.blocks_of(i)
            lengths[: len(blocks), i] = blocks
        known: dict[str, Any] = {
            "plan": (("controller", "time", "block", "mv"), np.asarray(t.plan)[None]),
            "window": ("time", scenario.reference.window(t.dt, t.samples)),
            "model_coefficient": (("cv", "mv", "lag"), np.asarray(self.model.coefficients)),
            "block_length": (("controller", "block", "mv"), lengths[None]),
            "prediction_horizon": ("controller", [structure.prediction_horizon]),
            "complete": ("controller", [1]),
            "blocking": ("controller", [structure.blocking]),
        }
        if scenario.disturbance is not None:
            given, names = scenario.disturbance[: t.samples], self.definition.process.disturbance_names
            known["disturbance"] = (("time", "disturbance_name"), given)
            if self.model.dv_names:
                known["dv"] = (("time", "dv_name"), given[:, [names.index(dv) for dv in self.model.dv_names]])
                known["dv_coefficient"] = (("cv", "dv_name", "lag"), np.asarray(self.model.dv_coefficients))
        for name in ("deadzone", "soft_quadratic", "soft_linear"):
            known[f"tuning_{name}"] = (("controller", "cv"), np.asarray(getattr(scenario.tuning, name))[None])
        own = {"name": RUN, "kind": scenario.kind, "actuator": scenario.actuator, "schedule": False}
        run = of_trajectory(
            t, scenario.tuning.deadzone, scenario.kind, scenario.actuator, self.definition.process
        )
        return run.assign(known).assign_attrs(definition=json.dumps({"controllers": [own]}))


def run(explored: Explorer, base: Base | None = None, progress: Progress | None = None) -> ExploreRun:
    """Close the loop.

    Args:
        explored: the process.
        base: settings as in the table ``[base]`` of a study; a short run (`Explorer.short_step`) if it has no reference.
        progress: called with ``(done, total)`` samples.

    Raises:
        InputError: naming the key below ``base``, for settings that no controller or plant can have; before anything runs.
    """
    begin = time.perf_counter()
    process, fields = explored.process, explored.fields
    if explored.first and explored.first[0].definition.body["base"] == base:
        return explored.first[0]
    given = {"reference": explored.short_step(), **(base or {})}
    definition = dataclasses.replace(
        explored.definition,
        base=settings(given, "base", process, fields),
        body={**explored.definition.body, "base": given},
    )
    study = expand_sweep(definition)
    scenario = study.scenario(0)
    _check_size(scenario)
    model = explored.model(scenario.model_point)
    trajectory = close_loop(study, scenario, model, keep_plans=True, progress=progress)
    figures = key_figures(process, trajectory, scenario)
    return ExploreRun(definition, scenario, trajectory, figures, model, time.perf_counter() - begin)


def _check_size(scenario: Scenario) -> None:
    structure = scenario.structure
    whole = sum(structure.whole_blocks(mv) for mv in structure.integer_mvs)
    if whole > MOST_MOVES and structure.block_count == structure.control_horizon:
        expected = f"blocks, or at most {MOST_MOVES} whole moves (these are {whole})"
        hint = "Without blocks a step with whole moves takes seconds; choose blocks or another controller"
        raise InputError("base.blocking", "none", expected, hint)


def key_figures(process: Process, trajectory: Trajectory, scenario: Scenario) -> dict[str, float]:
    """Every key figure of a run by name, ``name.channel`` where it is one per CV or MV."""
    t = trajectory
    recorded = {name: np.asarray(getattr(t, name))[None] for name in RECORDABLE if name in RECORD}
    same = {name: getattr(t, name) for name in ("time", "cv_names", "mv_names", "cv_units", "mv_units", "dt")}
    batch = TrajectoryBatch(np.zeros(1, dtype=int), setpoint=t.setpoint[None], fields=recorded, **same)
    window = scenario.reference.window(t.dt, t.samples)
    values = batch_kpis(batch, scenario.tuning, window, measures_of(process))
    out: dict[str, float] = {}
    for item in kpis_of(process):
        names = {(): ("",), ("cv",): t.cv_names, ("mv",): t.mv_names}[item.dims]
        for name, value in zip(names, np.atleast_1d(values[item.name][0]), strict=True):
            out[f"{item.name}.{name}" if name else item.name] = float(value)
    return out


def shown_figures(process: Process) -> list[tuple[str, str, str]]:
    """The key figures that are shown: key, words, unit. Of stepped MVs, what wears them; of the others, their travel."""
    shown: list[tuple[str, str]] = []
    for i, mv in enumerate(process.mvs):
        wear = ("travel", "moves", "reversals") if i in process.stepped else ("travel",)
        shown += [(f"{name}.{mv.name}", f"{mv.label}, {name}") for name in wear]
    for cv in process.cvs:
        shown.append((f"mean_absolute_deviation.{cv.name}", f"{cv.label}, mean deviation"))
        shown.append((f"time_outside_deadzone.{cv.name}", f"{cv.label}, outside deadzone"))
    shown += [(figure.name, figure.label) for figure in process.key_figures]
    shown += [
        ("closed_loop_cost", "cost per sample"),
        ("solve_time_median", "solve time, median"),
        ("solve_time_max", "solve time, longest"),
        ("largest_gap", "largest gap"),
        ("not_optimal", "not optimal"),
    ]
    items, units = {item.name: item for item in kpis_of(process)}, process.units
    unit = lambda key: items[key.partition(".")[0]].unit_of(units.get(key.partition(".")[2], "1"))  # noqa: E731
    return [(key, words, unit(key)) for key, words in shown]


def written(value: float, unit: str) -> tuple[str, str]:
    """A key figure and its unit as they are printed: times below a second in ms, others as they are."""
    if unit == "s" and 0 < abs(value) < 1:
        value, unit = 1e3 * value, "ms"
    number = f"{value:,.4g}" if not abs(value) >= 1e4 else f"{value:,.0f}"
    return number, "" if unit == "1" else unit.replace("m3", "m³")


def in_force(done: ExploreRun) -> dict[str, Any]:
    """What every key was set to in a run: what was given, else what the preset, the structure or the default says."""
    base, scenario = done.definition.base, done.scenario
    out: dict[str, Any] = {}
    for key, field in done.definition.fields.items():
        out[key] = field.held(done.definition.process, scenario.tuning)
        if key in ("prediction_horizon", "control_horizon", "first_penalised", "blocks"):
            out[key] = getattr(scenario.structure, key)
        if key in base and not (key.startswith("tuning.") and field.numeric):  # which the tuning itself has
            out[key] = base[key]
    for key in LISTS:
        out[key] = base.get(key, ())
    return out


def tuning_of(explored: Explorer, preset: str) -> Tuning:
    """A preset as the sliders start with it."""
    return explored.process.tuning(explored.process.structure(), preset)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run once and print the key figures; any key of a study is an argument ``KEY=VALUE``."""
    parser = argparse.ArgumentParser(
        prog="explore", description="Close one loop and print its key figures.", allow_abbrev=False
    )
    parser.add_argument("--process", default=DEFAULT_PROCESS, help="a process file, or a shipped process")
    parser.add_argument(
        "settings",
        nargs="*",
        metavar="KEY=VALUE",
        help="any key of docs/studies.md, such as controller=continuous",
    )
    options = parser.parse_args(arguments)
    try:
        explored = explorer(options.process)
        given = {}
        for setting in options.settings:
            key, _, text = setting.partition("=")
            given[key] = find(explored.fields, key, key).parse(key, text)
        done = run(explored, nested(given))
    except InputError as error:
        parser.error(str(error))
    for key, words, unit in shown_figures(explored.process):
        number, shown = written(done.kpis[key], unit)
        print(f"{words:40} {number:>12} {shown}")
    print(f"{'this run, compilation included':40} {done.seconds:>10.3g} s")
