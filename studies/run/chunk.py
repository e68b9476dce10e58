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

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.controller.controller import Controllers
from jaxmpc.files import strict_json
from jaxmpc.loop.simulate import simulate_batches
from jaxmpc.loop.trajectory import TrajectoryBatch
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.tuning import stack_tunings
from jaxmpc.process.well.equations import CV_NAMES, CV_UNITS, MV_NAMES, MV_UNITS
from jaxmpc.process.well.plant import WellPlant
from jaxmpc.programs.clock import Clock
from jaxmpc.programs.lanes import Lanes
from studies.definition.models import Point, identify_models
from studies.definition.scenarios import Scenario, Study
from studies.kpi.objectives import THESIS_DEADZONE
from studies.kpi.sweep import KPIS, RECORD, batch_kpis
from studies.store.fingerprint import made_now
from studies.store.layout import FLAG, StoreLayout, Variable, process_axes
from studies.store.trajectories import swept

# A CV counts as settled within the deadzone of the thesis, whatever its own: otherwise a wide deadzone settles at once.
SETTLED = THESIS_DEADZONE


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
    models = identify_models(study.model_points, progress=progress)
    return PreparedStudy(study, {point: jax.tree.map(np.asarray, model) for point, model in models.items()})


def run_chunk(prepared: PreparedStudy, index: int) -> ChunkResult:
    """Run the closed loops of a chunk."""
    study = prepared.study
    chunk = study.chunks[index]
    group, lanes = study.groups[chunk.group], study.lanes(chunk.group)
    fields, facts = run_scenarios(
        [study.scenario(int(k)) for k in chunk.scenarios],
        prepared.models,
        lanes=lanes,
        shared_model=len(group.points) == 1,
        plant_fields=study.varying_plant(chunk.group),
        points=len(stored_times(study)),
        every=study.definition.store.every,
        trajectories=study.definition.store.trajectories,
    )
    return ChunkResult(index, fields, facts)


def run_scenarios(
    scenarios: Sequence[Scenario],
    models: Mapping[Point, StepResponseModel],
    *,
    lanes: int,
    points: int,
    every: int,
    trajectories: Sequence[str],
    shared_model: bool = False,
    plant_fields: Sequence[str] = (),
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Run scenarios of one group side by side.

    Args:
        scenarios: 1 to `lanes` of them.
        lanes: of the compiled program; it is filled up with copies of the last scenario.
        points: length of the stored time axis; shorter runs end in NaN (-1 for codes).
        every: samples from one stored point to the next.
        trajectories: fields of `Trajectory` to keep.
        plant_fields: parameters of the well that may differ from lane to lane.
    """
    clock = Clock()
    filled = [*scenarios, *([scenarios[-1]] * (lanes - len(scenarios)))]
    first = filled[0]
    tunings = [s.tuning for s in filled]
    model = [models[first.model_point]] if shared_model else [models[s.model_point] for s in filled]
    controllers = Controllers(first.structure, tunings, model, count=lanes)
    references = [s.reference for s in filled]
    seeds: Any = np.array([s.seed for s in filled])
    cvs = len(CV_NAMES)

    def stacked(name: str, *shape: int) -> np.ndarray | None:
        given = [getattr(s, name) for s in filled]
        none = all(value is None for value in given)
        return None if none else np.stack([np.zeros(shape) if value is None else value for value in given])

    batches = simulate_batches(
        controllers,
        _plants(filled, plant_fields),
        references,
        samples=first.samples,
        disturbance=stacked("disturbance", first.samples),
        noise=stacked("noise", cvs),
        seed=seeds,
        faults=stacked("faults", first.samples, cvs),
        position_feedback=np.array([s.position_feedback for s in filled]),
        record=tuple(dict.fromkeys((*RECORD, *(f for f in trajectories if f != "setpoint")))),
        lanes_at_once=lanes,
    )
    (batch,) = batches
    simulated = clock.seconds
    windows = np.stack([s.reference.window(s.structure.dt, s.samples) for s in filled])
    figures = batch_kpis(batch, stack_tunings(tunings), windows, tolerance=np.array(SETTLED))
    fields = {name: values[: len(scenarios)] for name, values in figures.items()}
    fields[FLAG] = fields["finite"].astype("i1")
    for field in trajectories:
        fields[swept(field).name] = _kept(batch, field, len(scenarios), every, points)
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


def _plants(scenarios: Sequence[Scenario], fields: Sequence[str]) -> Lanes[WellPlant] | WellPlant:
    """One well per lane, parameters that do not vary within the group kept once; or one for all."""
    first = scenarios[0]
    if not fields:
        return WellPlant(parameters=first.plant, actuator=first.actuator)
    varying = {name: jnp.array([getattr(s.plant, name) for s in scenarios]) for name in fields}
    plants = WellPlant(parameters=dataclasses.replace(first.plant, **varying), actuator=first.actuator)
    places = lambda plant: [getattr(plant.parameters, name) for name in fields]  # noqa: E731
    has_lanes = eqx.tree_at(places, jax.tree.map(lambda _: False, plants), [True] * len(fields))
    return Lanes(*eqx.partition(plants, has_lanes))


def _kept(batch: TrajectoryBatch, field: str, lanes: int, every: int, points: int) -> np.ndarray:
    """A trajectory at the stored times, filled up to their number."""
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
    noise = "the column seed" if any(c.key == "seed" for c in study.columns) else study.scenario(0).seed
    return StoreLayout(
        name=study.name,
        title=study.title,
        study_hash=study.hash,
        chunk_size=study.chunk_size,
        chunk_scenarios=tuple(chunk.scenarios for chunk in study.chunks),
        scenario_hashes=study.scenario_hashes,
        columns=study.columns,
        variables=stored_variables(study.definition.store.trajectories),
        coords=process_axes(
            stored_times(study), {"cv": CV_NAMES, "mv": MV_NAMES}, {"cv": CV_UNITS, "mv": MV_UNITS}
        ),
        provenance={
            "definition": strict_json(study.definition.body),
            **({} if command is None else {"definition_file": command}),
            "folder": str(study.definition.folder),
            "quick": study.definition.is_cut,
            "seeds": {"sampling": study.definition.sampling.seed, "noise": noise},
            "settled": dict(zip(CV_NAMES, SETTLED, strict=True)),
            "work": dataclasses.asdict(study.work),
            **made_now(),
        },
    )


def stored_variables(trajectories: Sequence[str]) -> tuple[Variable, ...]:
    """Key figures, the flag of a complete run, and trajectories."""
    figures = [Variable(k.name, k.long_name, k.unit, k.dims) for k in KPIS]
    flag = Variable(FLAG, "1 where every CV and MV of the run is finite", "1", (), "i1", 0)
    return (*figures, flag, *(swept(field) for field in trajectories))
