"""Closed loops (thesis chapter 7): a controller, a plant and a reference make a `Trajectory`.

On a plant in JAX many samples run in one compiled call, and `simulate_batches` runs many loops side by side, some lanes and
some samples at a time. Everything else (the FMU, plans that are carried out) steps on the host with the very same programs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from jaxmpc.controller.batch import Batch, Controllers
from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError
from jaxmpc.loop.compiled import Inputs, simulate_compiled
from jaxmpc.loop.events import Event
from jaxmpc.loop.host import simulate_on_host
from jaxmpc.loop.host_lanes import simulate_host_lanes
from jaxmpc.loop.inputs import Sweep
from jaxmpc.loop.interventions import checked_sample
from jaxmpc.loop.trajectory import RECORDABLE, Trajectory, TrajectoryBatch
from jaxmpc.problem.structure import Structure
from jaxmpc.process.host import HostPlant
from jaxmpc.process.plant import JaxPlant, StatefulPlant
from jaxmpc.process.reference import Reference
from jaxmpc.programs.lanes import Lanes, for_all

LANES = 256  # of a sweep that run side by side
Progress = Callable[[int, int], None]


def simulate(
    controller: Controller,
    plant: JaxPlant | StatefulPlant,
    reference: Reference,
    *,
    samples: int | None = None,
    disturbance: Float[ArrayLike, "sample *disturbance"] | None = None,
    noise: Float[ArrayLike, " cv"] | None = None,
    seed: int = 0,
    faults: Float[ArrayLike, "sample cv"] | None = None,
    position_feedback: bool = False,
    preview: bool = False,
    events: Sequence[Event] = (),
    open_loop_from: float | None = None,
    keep_plans: bool = False,
    progress: Progress | None = None,
) -> Trajectory:
    """Close the loop from the plant's steady state at its default working point.

    Args:
        plant: in JAX, such as `WellPlant`, or one that keeps its own state, such as an FMU (`jaxmpc.process.plant`).
        reference: setpoints, covering the run.
        samples: length of the run; the whole reference if not given.
        disturbance: in every sample, ``"sample disturbance"`` in the order of the plant's `disturbance_names`; a single one
            may go without its axis; none if not given. The controller is told those that its model has as DVs.
        noise: standard deviation of the measurement noise, ``"cv"`` [CV unit]; none if not given.
        faults: errors of failing sensors ``"sample cv"``, from `measurement.fault_errors`; none if not given.
        position_feedback: whether the controller is told where the actuators stand, and predicts from there.
        preview: whether it is told the setpoints and the measured disturbances of the whole horizon; beyond the end of
            the run they stay as they are.
        events: changes of the controller during the run, in order of time.
        open_loop_from: from the plan made at this time [s] on, no measurement is used and nothing is solved: the plan is
            carried out to its end, then the MVs are held. Status, bias and objective stay those of the plan.
        keep_plans: whether `Trajectory.plan` has the planned moves of every sample.
        progress: called with ``(done, total)`` samples.

    Returns:
        `Trajectory`; its CVs are what sensors without fault measure, noise included.

    Raises:
        InputError: if sampling intervals differ, the reference has other CVs or ends before the run, the disturbance
            has not one finite value per sample and name, the noise not one standard deviation per CV, the faults not one
            error per sample and CV, the plant lacks a DV of the model, or an event does not fit.
    """
    structure = controller.structure
    if (noise is not None and np.ndim(noise) > 1) or np.ndim(seed):
        raise InputError("noise", noise, "one standard deviation per CV and one seed, for one run")
    run = Sweep.checked(
        controller.lanes,
        plant,
        [reference],
        samples=samples,
        disturbance=disturbance,
        noise=noise,
        seed=seed,
        faults=faults,
        position_feedback=bool(position_feedback),
        preview=preview,
        events=events,
    )
    setpoints, inputs, stages, blind = run.setpoints[0], run.inputs_of(np.arange(1)), run.stages, None
    if open_loop_from is not None:
        blind = checked_sample("open_loop_from", open_loop_from, structure, len(setpoints))
        if stages and stages[0][-1].first > blind:
            raise InputError("open_loop_from", open_loop_from, "a time not before the last of events [s]")
    if isinstance(plant, JaxPlant) and blind is None and controller.compiled:
        record = _one_lane(run.controllers, plant, inputs, stages, (*RECORDABLE, "plan"), progress)
    else:
        host = HostPlant(plant) if isinstance(plant, JaxPlant) else plant
        record = simulate_on_host(run.controllers, host, inputs, stages, blind, progress)
    plan = record.pop("plan")[:, : structure.block_count]
    kept = {"plan": plan} if keep_plans else {}
    return Trajectory(setpoint=setpoints, **record, **kept, **_labels(structure, len(setpoints)))


def _one_lane(controllers: Batch, plant, inputs: Inputs, stages, record, progress: Progress | None):
    """A compiled loop of one controller."""
    done, total = 0, inputs.setpoints.shape[1]

    def tick(samples: int) -> None:
        nonlocal done
        done += samples
        if progress is not None and done:
            progress(done, total)

    fields = simulate_compiled(controllers, for_all(plant), inputs, record, stages=stages, progress=tick)
    return {name: values[0] for name, values in fields.items()}


def _labels(structure: Structure, samples: int) -> dict[str, Any]:
    """The fields of a trajectory that follow from the structure."""
    return dict(
        time=np.arange(samples) * structure.dt,
        cv_names=structure.cv_names,
        mv_names=structure.mv_names,
        cv_units=structure.cv_units,
        mv_units=structure.mv_units,
        dt=structure.dt,
    )


# ------------------------------------------------------------------------------------------------------- sweeps


def simulate_batch(*arguments: Any, **options: Any) -> list[Trajectory]:
    """Many closed loops at once: arguments of `simulate_batches`, result one `Trajectory` per lane.

    All trajectories are kept, 170 bytes per sample and lane; larger sweeps consume `simulate_batches` piece by piece.
    """
    return [run for batch in simulate_batches(*arguments, **options) for run in batch.trajectories()]


def simulate_batches(
    controllers: Controllers | Controller,
    plants: Lanes[JaxPlant] | JaxPlant | Sequence[StatefulPlant],
    reference: Reference | Sequence[Reference],
    *,
    samples: int | None = None,
    disturbance: Float[ArrayLike, "*lane sample disturbance"] | None = None,
    noise: Float[ArrayLike, "*lane cv"] | None = None,
    seed: Int[ArrayLike, "*lane"] = 0,
    faults: Float[ArrayLike, "*lane sample cv"] | None = None,
    position_feedback: ArrayLike = False,
    preview: bool = False,
    events: Sequence[Event] | Sequence[Sequence[Event]] = (),
    record: Sequence[str] = RECORDABLE,
    lanes_at_once: int = LANES,
    devices: Sequence[Any] | None = None,
    progress: Progress | None = None,
) -> Iterator[TrajectoryBatch]:
    """Closed loops on plants in JAX, `lanes_at_once` side by side in one compiled program, piece by piece; or on the host.

    What is given once is shared by all lanes; anything may have one value per lane instead. A piece is complete in
    time; when the next one is asked for, nothing of it is kept here, so that memory does not grow with the sweep.
    Results depend neither on the size of the pieces nor on the number of devices.

    Args:
        controllers: one for all, or one per lane.
        plants: one, or `Lanes` of them (`lanes.per_lane`); or a list of plants that keep their own state, one per lane,
            which are closed at the end. One that fails ends its own lane (`loop.host_lanes`).
        reference: setpoints for all, or a list with one reference per lane.
        samples: length of the runs; the whole (shortest) reference if not given.
        disturbance: ``"sample disturbance"`` or ``"lane sample disturbance"``, as in `simulate`.
        noise: standard deviation of the measurement noise [CV unit], ``"cv"`` or ``"lane cv"``; none if not given.
        seed: of the noise. One number gives every lane noise of its own. With one number per lane, lanes with equal
            seeds get equal noise, which is that of `simulate` with this seed.
        faults: errors of failing sensors ``"sample cv"`` or ``"lane sample cv"``, from `measurement.fault_errors`; none if
            not given.
        position_feedback: whether the controllers are told where the actuators stand, and predict from there; one for
            all or ``"lane"``.
        preview: as in `simulate`, for all lanes.
        events: as in `simulate`, one list for all lanes or a list of them with one per lane.
        record: names of the fields of `Trajectory` to keep; the others are never stored.
        lanes_at_once: lanes of one piece; fewer where the lanes then divide evenly. Each size compiles once.
        devices: to spread the lanes over; all of this process if not given.
        progress: called with ``(done, total)`` samples of all lanes, first when compilation is over.

    Raises:
        InputError: at once, for what `simulate` refuses, lane counts that differ, or no lanes at all.
    """
    lanes = controllers.lanes if isinstance(controllers, Controller) else controllers
    if not isinstance(lanes, Batch):
        raise InputError("controllers", type(lanes).__name__, "Controllers, or a Controller for all")
    sweep = Sweep.checked(
        lanes,
        plants,
        reference,
        samples=samples,
        disturbance=disturbance,
        noise=noise,
        seed=seed,
        faults=faults,
        position_feedback=position_feedback,
        preview=preview,
        events=events,
    )
    unknown = [field for field in record if field not in RECORDABLE]
    if unknown:
        raise InputError("record", unknown[0], f"some of {', '.join(RECORDABLE)}")
    if lanes_at_once < 1:
        raise InputError("lanes_at_once", lanes_at_once, "1 or more lanes")
    return _pieces(sweep, tuple(record), lanes_at_once, list(devices or jax.local_devices()), progress)


def _pieces(sweep: Sweep, record, lanes_at_once: int, devices, progress) -> Iterator[TrajectoryBatch]:
    done = 0

    def tick(samples: int):
        nonlocal done
        done += samples
        if progress is not None:
            progress(done, sweep.count * sweep.samples)

    pieces = -(-sweep.count // lanes_at_once)
    size = -(-sweep.count // pieces)
    for begin in range(0, sweep.count, size):
        # the last piece is filled up with copies of the last lane: one shape, one compilation
        index = np.minimum(np.arange(begin, begin + size), sweep.count - 1)
        real = min(size, sweep.count - begin)
        report = tick if begin == 0 else lambda samples: tick(samples) if samples else None
        yield TrajectoryBatch(  # no name keeps it: it is gone when the caller lets go
            lanes=index[:real],
            setpoint=sweep.setpoints_of(index[:real]),
            fields=_fields(sweep, index, real, record, devices, report),
            **_labels(sweep.structure, sweep.samples),
        )


def _fields(sweep: Sweep, index: np.ndarray, real: int, record, devices, report) -> dict[str, np.ndarray]:
    """Recorded fields of some lanes, of which the first `real` count."""
    if not isinstance(sweep.plants, Lanes):
        index = index[:real]
        own, plants = sweep.controllers_of(index), [sweep.plants[k] for k in index]
        fields, _ = simulate_host_lanes(own, plants, sweep.inputs_of(index), report, sweep.stages_of(index))
        return {name: fields[name] for name in record}
    return simulate_compiled(
        sweep.controllers_of(index),
        sweep.plants.take(index),
        sweep.inputs_of(index),
        record,
        stages=sweep.stages_of(index),
        real=real,
        devices=devices,
        progress=report,
    )
