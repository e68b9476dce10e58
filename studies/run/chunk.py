"""Computing the scenarios of a sweep study: one chunk in, arrays out. `run_chunk` is all that any executor calls.

A chunk is a pure function of the prepared study and its number; nothing is read or written. All chunks of a group have one
shape: the last one is filled up with copies of its last scenario.
"""

from __future__ import annotations

import dataclasses
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from identify.plants import disturbance_of, open_plant
from jaxmpc.controller.batch import Controllers
from jaxmpc.files import strict_json
from jaxmpc.loop.simulate import simulate_batches
from jaxmpc.loop.trajectory import TrajectoryBatch
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.tuning import stack_tunings
from jaxmpc.process.plant import JaxPlant, closing, lanes_of_plants
from jaxmpc.process.process import Process
from jaxmpc.programs.clock import Clock
from jaxmpc.programs.lanes import Lanes
from studies.definition.models import Point, identify_models
from studies.definition.scenarios import Scenario, Study
from studies.kpi.sweep import RECORD, batch_kpis, kpis_of, measures_of
from studies.store.fingerprint import made_now
from studies.store.layout import FLAG, StoreLayout, Variable, process_axes
from studies.store.trajectories import swept


@dataclasses.dataclass(frozen=True, eq=False)
class PreparedStudy:
    """A study with the models that its controllers need; picklable, what every worker holds."""

    study: Study
    models: Mapping[Point, StepResponseModel]


@dataclasses.dataclass(frozen=True, eq=False)
class ChunkResult:
    """What a chunk leaves behind."""

    index: int  # of the chunk
    fields: dict[str, np.ndarray]  # every stored variable, ``"lane ..."``, real lanes only
    facts: dict[str, Any]  # JSON-like: ``wall_time`` [s], compilation left out, and where it was computed


def prepare_study(study: Study, progress: Callable[[int, int], None] | None = None) -> PreparedStudy:
    """Identify the models of a study; errors of `models.identify_models`."""
    models = identify_models(study.process, study.model_points, progress=progress)
    return PreparedStudy(study, {point: jax.tree.map(np.asarray, model) for point, model in models.items()})


def run_chunk(prepared: PreparedStudy, index: int) -> ChunkResult:
    """Run the closed loops of a chunk."""
    study, chunk = prepared.study, prepared.study.chunks[index]
    fields, facts = run_scenarios(
        study,
        [study.scenario(int(k)) for k in chunk.scenarios],
        prepared.models,
        lanes=study.lanes(chunk.group),
        shared_model=len(study.groups[chunk.group].points) == 1,
        varying=study.varying_plant(chunk.group),
    )
    return ChunkResult(index, fields, facts)


def run_scenarios(
    study: Study,
    scenarios: Sequence[Scenario],
    models: Mapping[Point, StepResponseModel],
    *,
    lanes: int,
    shared_model: bool = False,
    varying: Sequence[str] = (),
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Run scenarios of one group of a study side by side: their stored variables, and facts of the run.

    Args:
        scenarios: 1 to `lanes` of them.
        lanes: of the compiled program; it is filled up with copies of the last scenario.
        varying: parameters of the plant that may differ from lane to lane.
    """
    clock, process, kept = Clock(), study.process, study.definition.store
    filled = [*scenarios, *([scenarios[-1]] * (lanes - len(scenarios)))]
    first = filled[0]
    tunings = [s.tuning for s in filled]
    model = [models[first.model_point]] if shared_model else [models[s.model_point] for s in filled]
    controllers = Controllers(first.structure, tunings, model, count=lanes)
    cvs = len(process.cvs)

    def stacked(name: str, *shape: int) -> np.ndarray | None:
        given = [getattr(s, name) for s in filled]
        none = all(value is None for value in given)
        return None if none else np.stack([np.zeros(shape) if value is None else value for value in given])

    plants = _plants(process, study.definition.study.plant, filled, varying)
    shared = plants.shared if isinstance(plants, Lanes) else plants[0] if isinstance(plants, list) else plants
    offsets = stacked("disturbance", first.samples, len(process.disturbances))
    (batch,) = simulate_batches(
        controllers,
        plants,
        [s.reference for s in filled],
        samples=first.samples,
        disturbance=None if offsets is None else disturbance_of(process, shared, offsets),
        noise=stacked("noise", cvs),
        seed=np.array([s.seed for s in filled]),
        faults=stacked("faults", first.samples, cvs),
        position_feedback=np.array([s.position_feedback for s in filled]),
        preview=first.preview,
        events=first.events,
        record=tuple(dict.fromkeys((*RECORD, *(f for f in kept.trajectories if f != "setpoint")))),
        lanes_at_once=lanes,
    )
    simulated = clock.seconds
    windows = np.stack([s.windows.window(s.structure.dt, s.samples) for s in filled])
    figures = batch_kpis(
        batch, stack_tunings(tunings), windows, measures_of(process), tolerance=process.settled
    )
    fields = {name: values[: len(scenarios)] for name, values in figures.items()}
    fields[FLAG] = fields["finite"].astype("i1")
    points = len(stored_times(study))
    for field in kept.trajectories:
        fields[swept(field).name] = _kept(batch, field, len(scenarios), kept.every, points)
    facts = {
        "wall_time": clock.seconds,
        "simulation_time": simulated,
        "lanes": lanes,
        "scenarios": len(scenarios),
        "device": jax.devices()[0].device_kind,
        "host": platform.node(),
        "process": os.getpid(),
    }
    return fields, facts


def _plants(
    process: Process, name: str, scenarios: Sequence[Scenario], varying: Sequence[str]
) -> Lanes[JaxPlant] | JaxPlant | list[Any]:
    """One plant per lane, parameters that do not vary within the group kept once; or one for all. A list on the host."""
    first = scenarios[0]
    shared = {key: value for key, value in first.plant.items() if key not in varying}
    plant = open_plant(process, name, actual=first.actuator == "step", parameters=shared)
    if not isinstance(plant, JaxPlant):
        with closing(plant):
            if hasattr(plant, "replaced"):  # an FMU is looked into once
                return [plant.replaced({key: s.plant[key] for key in varying}) for s in scenarios]
        return [open_plant(process, name, actual=first.actuator == "step") for _ in scenarios]
    if not varying:
        return plant
    return lanes_of_plants(plant, {key: np.array([s.plant[key] for s in scenarios]) for key in varying})


def _kept(batch: TrajectoryBatch, field: str, lanes: int, every: int, points: int) -> np.ndarray:
    """A trajectory at the stored times, filled up to their number: shorter runs end in NaN (-1 for codes)."""
    variable = swept(field)
    values = np.asarray(batch.setpoint if field == "setpoint" else batch[field])[:lanes, ::every]
    out = np.full((lanes, points, *values.shape[2:]), variable.empty, dtype=variable.dtype)
    out[:, : values.shape[1]] = values
    return out


def stored_times(study: Study) -> np.ndarray:
    """Times of the stored points of the longest run [s]."""
    longest = max(study.groups, key=lambda group: group.samples)
    return np.arange(0, longest.samples, study.definition.store.every) * longest.structure.dt


def study_layout(study: Study, command: str | None = None) -> StoreLayout:
    """What the store has to know of a study.

    Args:
        command: words after ``jaxmpc study run`` that give it: a shipped name or a file, and ``--quick``.
    """
    process = study.process
    noise = "the column seed" if any(c.key == "seed" for c in study.columns) else study.scenario(0).seed
    return StoreLayout(
        name=study.name,
        title=study.title,
        study_hash=study.hash,
        chunk_size=study.chunk_size,
        chunk_scenarios=tuple(chunk.scenarios for chunk in study.chunks),
        scenario_hashes=study.scenario_hashes,
        columns=study.columns,
        variables=stored_variables(process, study.definition.store.trajectories),
        coords=process_axes(
            stored_times(study),
            {"cv": process.cv_names, "mv": process.mv_names},
            {"cv": tuple(v.unit for v in process.cvs), "mv": tuple(v.unit for v in process.mvs)},
        ),
        provenance={
            "definition": strict_json(study.definition.body),
            **({} if command is None else {"definition_file": command}),
            "folder": str(study.definition.folder),
            "quick": study.definition.is_cut,
            "seeds": {"sampling": study.definition.sampling.seed, "noise": noise},
            "process": strict_json(process.body),
            "work": dataclasses.asdict(study.work),
            **made_now(),
        },
    )


def stored_variables(process: Process, trajectories: Sequence[str]) -> tuple[Variable, ...]:
    """Key figures, the flag of a complete run, and trajectories."""
    figures = [Variable(k.name, k.long_name, k.unit, k.dims) for k in kpis_of(process)]
    flag = Variable(FLAG, "1 where every CV and MV of the run is finite", "1", (), "i1", 0)
    return (*figures, flag, *(swept(field) for field in trajectories))
