"""Closed loops (thesis chapter 7): a controller, a plant and a reference make a `Trajectory`.

A continuous controller on the JAX well runs as one compiled scan, and `simulate_batches` runs many side by side, some lanes
and some samples at a time. Everything else (the FMU, integer moves) steps on the host with the very same controller code.
"""

from __future__ import annotations

import contextlib
import gc
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from jaxmpc.controller.batch import Lanes, for_all, place, variant_mesh
from jaxmpc.controller.continuous import ContinuousController, ControllerState
from jaxmpc.controller.measurement import received
from jaxmpc.controller.mixed_integer import MixedIntegerController, MixedIntegerControllers
from jaxmpc.errors import InputError
from jaxmpc.loop.compiled import CHUNK, even, record_of, run_piece, scan, start
from jaxmpc.loop.inputs import Sweep, check_faults, check_match, check_offsets, sampled
from jaxmpc.loop.interventions import CarriedOut, checked_changes, checked_sample, handed_over
from jaxmpc.loop.noise import check_deviation, check_seed, noise_samples
from jaxmpc.loop.reference import Reference
from jaxmpc.loop.strides import able, simulate_in_strides
from jaxmpc.loop.together import advance_together, errors_of
from jaxmpc.loop.trajectory import RECORDABLE, Trajectory, TrajectoryBatch
from jaxmpc.problem.structure import Structure
from jaxmpc.process.plant import WellPlant
from jaxmpc.process.stateful import StatefulPlant
from jaxmpc.process.well.host import HostWell

LANES = 256  # of a sweep that run side by side
Progress = Callable[[int, int], None]


def simulate(
    controller: ContinuousController | MixedIntegerController,
    plant: WellPlant | StatefulPlant,
    reference: Reference,
    *,
    samples: int | None = None,
    disturbance: Float[ArrayLike, " sample"] | None = None,
    noise: Float[ArrayLike, " cv"] | None = None,
    seed: int = 0,
    faults: Float[ArrayLike, "sample cv"] | None = None,
    position_feedback: bool = False,
    changes: Sequence[tuple[float, ContinuousController | MixedIntegerController]] = (),
    open_loop_from: float | None = None,
    keep_plans: bool = False,
    progress: Progress | None = None,
) -> Trajectory:
    """Close the loop from the plant's steady state at its default working point.

    Args:
        controller: continuous or mixed-integer.
        plant: `WellPlant`, or a stateful plant with `init()`, `step(mv, disturbance)` and `dt`, such as the FMU's.
        reference: setpoints, covering the run.
        samples: length of the run; the whole reference if not given.
        disturbance: reservoir-pressure offset per sample [bar], ``"sample"``; none if not given.
        noise: standard deviation of the measurement noise, ``"cv"`` [CV unit]; none if not given.
        seed: of the noise.
        faults: errors of failing sensors ``"sample cv"``, from `measurement.fault_errors`; none if not given.
        position_feedback: whether the controller is told where the actuators stand, and predicts from there.
        changes: times [s] and controllers of equal structure that take over then, with the state of the one before.
        open_loop_from: from the plan made at this time [s] on, no measurement is used and nothing is solved: the plan is
            carried out to its end, then the MVs are held. Status, bias and objective stay those of the plan.
        keep_plans: whether `Trajectory.plan` has the planned moves of every sample.
        progress: called with ``(done, total)`` samples.

    Returns:
        `Trajectory`; its CVs are what sensors without fault measure, noise included.

    Raises:
        InputError: if sampling intervals differ, the reference has other CVs or ends before the run, the disturbance
            has not one finite value per sample, the noise not one standard deviation per CV, the faults not one error per
            sample and CV, or a change does not fit.
    """
    structure = controller.structure
    check_match(structure, plant)
    setpoints = sampled(reference, structure, samples)
    offsets = np.zeros(len(setpoints)) if disturbance is None else np.asarray(disturbance, dtype=np.float64)
    check_offsets(offsets, (len(setpoints),))
    deviation, stream = check_deviation(noise, structure.cv_count), check_seed(seed)
    if deviation.ndim > 1 or stream.ndim:
        raise InputError("noise", noise, "one standard deviation per CV and one seed, for one run")
    errors = np.zeros((len(setpoints), structure.cv_count))
    if deviation.any():
        errors = np.asarray(_noise(deviation, stream, 0, np.arange(len(setpoints))))
    failing = np.zeros_like(setpoints) if faults is None else np.asarray(faults, dtype=np.float64)
    check_faults(failing, setpoints.shape)
    inputs, told = (setpoints, offsets, errors, failing), position_feedback
    takeovers, blind = checked_changes(controller, changes, len(setpoints)), None
    if open_loop_from is not None:
        blind = checked_sample("open_loop_from", open_loop_from, structure, len(setpoints))
        if takeovers and max(takeovers) > blind:
            raise InputError("open_loop_from", open_loop_from, "a time after the last of changes")
    plain = isinstance(plant, WellPlant) and not takeovers and blind is None
    if plain and isinstance(controller, ContinuousController):
        record = _simulate_compiled(controller, plant, inputs, told, progress, keep_plans)
    elif plain and isinstance(controller, MixedIntegerController) and able(controller.together):
        record = _simulate_in_strides(controller.together, plant, inputs, told, progress)
    else:
        record = _simulate_on_host(controller, plant, inputs, told, progress, takeovers, blind)
    if not keep_plans:
        record.pop("plan", None)
    return Trajectory(setpoint=setpoints, **record, **_labels(structure, len(setpoints)))


_noise = jax.jit(noise_samples)


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


# ------------------------------------------------------------------------------------------------ compiled


_run_chunk: Any = eqx.filter_jit(scan)


def _simulate_compiled(controller, plant, inputs, told: bool, progress: Progress | None, keep_plans: bool):
    recorded = (*RECORDABLE, "plan") if keep_plans else RECORDABLE
    carry = start(controller, plant)
    total, parts = len(inputs[0]), []
    ready: set[int] = set()
    for begin in range(0, total, CHUNK):
        now = jax.tree.map(lambda leaf, at=begin: leaf[at : at + CHUNK], inputs)
        count = len(now[0])
        if count not in ready:  # compile before the clock starts
            _run_chunk.lower(controller, plant, carry, now, jnp.asarray(told), recorded).compile()
            ready.add(count)
        started = time.perf_counter()
        carry, record = jax.block_until_ready(
            _run_chunk(controller, plant, carry, now, jnp.asarray(told), recorded)
        )
        # a compiled loop has no clock: every sample of a chunk gets the chunk's mean, plant included
        mean = (time.perf_counter() - started) / count
        parts.append(jax.tree.map(np.asarray, record) | {"solve_time": np.full(count, mean)})
        if progress is not None:
            progress(begin + count, total)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def _simulate_in_strides(
    controllers: MixedIntegerControllers, plant, inputs, told: bool, progress: Progress | None
):
    """A single mixed-integer controller."""
    done, total = 0, len(inputs[0])

    def tick(samples: int):
        nonlocal done
        done += samples
        if progress is not None and done:
            progress(done, total)

    fields = simulate_in_strides(
        controllers, for_all(plant), tuple(v[None] for v in inputs), np.array([told]), tick
    )
    return {name: values[0] for name, values in fields.items()}


# ------------------------------------------------------------------------------------------------- on the host


def _simulate_on_host(
    controller, plant, inputs, told: bool, progress: Progress | None, takeovers: dict, blind: int | None
):
    setpoints, offsets, errors, faults = inputs
    host = HostWell(plant) if isinstance(plant, WellPlant) else plant
    outputs = host.init()
    now = np.asarray(outputs.cv)
    steppers, states = {}, {}
    for k, one in {0: controller, **takeovers}.items():
        steppers[k] = _BatchOfOne(one.together) if isinstance(one, MixedIntegerController) else _Compiled(one)
        states[k] = steppers[k].init(now, np.asarray(outputs.mv))
        steppers[k].prepare(states[k], now)  # compile before the clock starts
    stepper, state = steppers[0], states[0]
    records, carried = [], None
    with _undisturbed():
        for k in range(len(setpoints)):
            cv = np.asarray(outputs.cv) + errors[k]
            if k in takeovers:
                stepper, state = steppers[k], handed_over(state, states[k])
            if carried is None or blind is None:
                mv = np.asarray(outputs.mv) if told else None
                state, record = stepper.step(state, cv, faults[k], setpoints[k], mv)
                carried = CarriedOut(controller.structure, record) if k == blind else None
            else:
                record = carried.record(k - blind, cv)
            outputs = host.step(record["mv_demand"], float(offsets[k]))
            records.append(record | {"mv": np.asarray(outputs.mv)})
            if progress is not None and ((k + 1) % 20 == 0 or k + 1 == len(setpoints)):
                progress(k + 1, len(setpoints))
    return {name: np.stack([record[name] for record in records]) for name in records[0]}


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """No search for garbage among what is there already: compiled programs would keep it busy for a fifth of a second."""
    if gc.get_freeze_count():  # the caller's business
        yield
        return
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


class _Compiled:
    """A continuous controller that is stepped from the host, with a clock."""

    def __init__(self, controller: ContinuousController):
        self.init, self._decided = controller.init, controller.step  # binding a method takes a while

    def prepare(self, state, cv) -> None:
        jax.block_until_ready(self._decided(state, cv, cv))

    def step(self, state, cv, fault, setpoint, mv):
        arrived = received(cv, fault, np.asarray(state.sensors.value))
        begin = time.perf_counter()
        state, info = jax.block_until_ready(self._decided(state, arrived, setpoint, mv))
        record = record_of(cv, info.mv, state, info) | {"solve_time": time.perf_counter() - begin}
        return state, {name: np.asarray(value) for name, value in record.items()}


class _BatchOfOne:
    """One mixed-integer controller, its state kept with the scenario axis."""

    def __init__(self, controllers: MixedIntegerControllers):
        self.controllers, self.prepare = controllers, lambda state, cv: controllers.prepare(state, cv[None])

    def init(self, cv, mv) -> ControllerState:
        return self.controllers.init(cv[None], mv[None])

    def step(self, state, cv, fault, setpoint, mv):
        arrived = received(cv[None], fault[None], np.asarray(state.sensors.value))
        position = None if mv is None else mv[None]
        state, info = self.controllers.step(state, arrived, setpoint[None], position)
        record = record_of(cv[None], info.mv, state, info) | {"solve_time": info.solve_time}
        return state, {name: value[0] for name, value in record.items()}


# ------------------------------------------------------------------------------------------------------- sweeps


def simulate_batch(*arguments: Any, **options: Any) -> list[Trajectory]:
    """Many closed loops at once: arguments of `simulate_batches`, result one `Trajectory` per lane.

    All trajectories are kept, 170 bytes per sample and lane; larger sweeps consume `simulate_batches` piece by piece.
    """
    return [run for batch in simulate_batches(*arguments, **options) for run in batch.trajectories()]


def simulate_batches(
    controllers: Lanes[ContinuousController] | ContinuousController | MixedIntegerControllers,
    plants: Lanes[WellPlant] | WellPlant,
    reference: Reference | Sequence[Reference],
    *,
    samples: int | None = None,
    disturbance: Float[ArrayLike, "*lane sample"] | None = None,
    noise: Float[ArrayLike, "*lane cv"] | None = None,
    seed: Int[ArrayLike, "*lane"] = 0,
    faults: Float[ArrayLike, "*lane sample cv"] | None = None,
    position_feedback: ArrayLike = False,
    record: Sequence[str] = RECORDABLE,
    lanes_at_once: int = LANES,
    devices: Sequence[Any] | None = None,
    progress: Progress | None = None,
) -> Iterator[TrajectoryBatch]:
    """Closed loops on the JAX well, `lanes_at_once` side by side in one compiled program, piece by piece.

    What is given once is shared by all lanes; anything may have one value per lane instead. A piece is complete in
    time; when the next one is asked for, nothing of it is kept here, so that memory does not grow with the sweep.
    Results depend neither on the size of the pieces nor on the number of devices.

    Args:
        controllers: one, or `Lanes` such as those of `batch.controller_batch`; or `MixedIntegerControllers`, which advance
            together, all in one piece.
        plants: one well, or `Lanes` of wells (`batch.per_lane`).
        reference: setpoints for all, or a list with one reference per lane.
        samples: length of the runs; the whole (shortest) reference if not given.
        disturbance: reservoir-pressure offset [bar], ``"sample"`` or ``"lane sample"``; none if not given.
        noise: standard deviation of the measurement noise [CV unit], ``"cv"`` or ``"lane cv"``; none if not given.
        seed: of the noise. One number gives every lane noise of its own. With one number per lane, lanes with equal
            seeds get equal noise, which is that of `simulate` with this seed.
        faults: errors of failing sensors ``"sample cv"`` or ``"lane sample cv"``, from `measurement.fault_errors`; none if
            not given.
        position_feedback: whether the controllers are told where the actuators stand, and predict from there; one for
            all or ``"lane"``.
        record: names of the fields of `Trajectory` to keep; the others are never stored.
        lanes_at_once: lanes of one piece; fewer where the lanes then divide evenly. Each size compiles once.
        devices: to spread the lanes over; all of this process if not given.
        progress: called with ``(done, total)`` samples of all lanes, first when compilation is over.

    Returns:
        Iterator of `TrajectoryBatch`, in lane order.

    Raises:
        InputError: at once, for what `simulate` refuses, lane counts that differ, or no lanes at all.
    """
    sweep = Sweep.checked(
        controllers, plants, reference, samples, disturbance, noise, seed, faults, position_feedback
    )
    unknown = [field for field in record if field not in RECORDABLE]
    if unknown:
        raise InputError("record", unknown[0], f"some of {', '.join(RECORDABLE)}")
    if lanes_at_once < 1:
        raise InputError("lanes_at_once", lanes_at_once, "1 or more lanes")
    return _pieces(sweep, tuple(record), lanes_at_once, variant_mesh(devices), progress)


def _pieces(sweep: Sweep, record, lanes_at_once: int, mesh, progress) -> Iterator[TrajectoryBatch]:
    done = 0

    def tick(samples: int):
        nonlocal done
        done += samples
        if progress is not None:
            progress(done, sweep.count * sweep.samples)

    if isinstance(sweep.controllers, MixedIntegerControllers):
        everyone = np.arange(sweep.count)
        errors = errors_of(sweep.deviation, sweep.seeds, np.arange(sweep.samples))
        inputs = (
            sweep.setpoints_of(everyone),
            sweep.offsets_of(everyone),
            errors,
            sweep.faults_of(everyone),
        )
        told = sweep.position_feedback
        if able(sweep.controllers):
            together = simulate_in_strides(sweep.controllers, sweep.plants, inputs, told, tick)
            yield TrajectoryBatch(
                lanes=everyone,
                setpoint=inputs[0],
                fields={name: together[name] for name in record},
                **_labels(sweep.structure, sweep.samples),
            )
            return

        def keep(cv, mv, state, info):
            fields = record_of(cv, mv, state, info) | {"solve_time": info.solve_time}
            return {name: value for name, value in fields.items() if name in record}

        yield TrajectoryBatch(
            lanes=everyone,
            setpoint=inputs[0],
            fields=advance_together(sweep.controllers, sweep.plants, inputs, told, keep, tick),
            **_labels(sweep.structure, sweep.samples),
        )
        return
    size = even(sweep.count, lanes_at_once, mesh.size)
    whole = sweep.controllers, sweep.plants
    common = [place(for_all(lanes.shared), mesh).shared for lanes in whole]
    for begin in range(0, sweep.count, size):
        # the last piece is filled up with copies of the last lane: one shape, one compilation
        index = np.minimum(np.arange(begin, begin + size), sweep.count - 1)
        real = min(size, sweep.count - begin)
        yield TrajectoryBatch(  # no name keeps it: it is gone when the caller lets go
            lanes=index[:real],
            setpoint=sweep.setpoints_of(index[:real]),
            fields=run_piece(sweep, whole, common, index, real, record, mesh, tick),
            **_labels(sweep.structure, sweep.samples),
        )
