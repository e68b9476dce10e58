"""Closed loops (thesis chapter 7): a controller, a plant and a reference make a `Trajectory`.

A continuous controller on the JAX well runs as one compiled scan, and `simulate_batch` runs many at once. Everything else
(the FMU, integer moves) steps on the host with the very same controller code.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.controller import ContinuousController, ControllerState, MixedIntegerController, StepInfo
from jaxmpc.errors import InputError
from jaxmpc.plant import WellPlant
from jaxmpc.reference import Reference
from jaxmpc.trajectory import Trajectory

CHUNK = 300  # samples between two progress reports of a compiled loop
Progress = Callable[[int, int], None]


def simulate(
    controller: ContinuousController | MixedIntegerController,
    plant: Any,
    reference: Reference,
    *,
    samples: int | None = None,
    disturbance=None,
    progress: Progress | None = None,
) -> Trajectory:
    """Close the loop from the plant's steady state at its default working point.

    Args:
        controller: continuous or mixed-integer.
        plant: `WellPlant`, or a stateful plant with `init()`, `step(mv, disturbance)` and `dt`, such as the FMU's.
        reference: setpoints, covering the run.
        samples: length of the run; the whole reference if not given.
        disturbance: reservoir-pressure offset per sample [bar], ``"sample"``; none if not given.
        progress: called with ``(done, total)`` samples.

    Returns:
        `Trajectory`.

    Raises:
        InputError: if sampling intervals differ, the reference has other CVs or ends before the run, or the disturbance
            has not one finite value per sample.
    """
    structure = controller.structure
    if abs(plant.dt - structure.dt) > 1e-9 * structure.dt:
        raise InputError("plant.dt", plant.dt, f"the controller's sampling interval {structure.dt} s")
    if reference.cv_count != structure.cv_count:
        raise InputError(
            "reference.setpoints",
            f"{reference.cv_count} columns",
            f"one per CV: {', '.join(structure.cv_names)}",
        )
    setpoints = reference.sample(structure.dt, samples)
    offsets = np.zeros(len(setpoints)) if disturbance is None else np.asarray(disturbance, dtype=np.float64)
    if offsets.shape != (len(setpoints),) or not np.isfinite(offsets).all():
        raise InputError(
            "disturbance",
            f"shape {list(offsets.shape)}",
            f"{len(setpoints)} finite offsets [bar], one per sample",
        )
    if isinstance(plant, WellPlant) and isinstance(controller, ContinuousController):
        record = _simulate_compiled(controller, plant, setpoints, offsets, progress)
    else:
        record = _simulate_on_host(controller, plant, setpoints, offsets, progress)
    return _trajectory(structure, setpoints, record)


def _step_loop(controller: ContinuousController, plant: WellPlant, carry, inputs):
    """One sample of a compiled loop: measure, decide, advance the plant."""
    state, plant_state, cv = carry
    setpoint, offset = inputs
    state, info = controller.step(state, cv, setpoint)
    plant_state, outputs = plant.step(plant_state, state.mv, offset)
    record = (cv, outputs.mv, state.bias, state.bias_raw, eqx.tree_at(lambda i: i.moves, info, None))
    return (state, plant_state, outputs.cv), record


@eqx.filter_jit
def _run_chunk(controller: ContinuousController, plant: WellPlant, carry, setpoints, offsets):
    return jax.lax.scan(lambda c, i: _step_loop(controller, plant, c, i), carry, (setpoints, offsets))


def _start(controller: ContinuousController, plant: WellPlant):
    plant_state = plant.init()
    outputs = plant.measure(plant_state)
    return controller.init(outputs.cv, outputs.mv), plant_state, outputs.cv


def _simulate_compiled(controller, plant, setpoints, offsets, progress: Progress | None):
    carry = _start(controller, plant)
    total, parts = len(setpoints), []
    ready: set[int] = set()
    for begin in range(0, total, CHUNK):
        inputs = setpoints[begin : begin + CHUNK], offsets[begin : begin + CHUNK]
        count = len(inputs[0])
        if count not in ready:  # compile before the clock starts
            _run_chunk.lower(controller, plant, carry, *inputs).compile()
            ready.add(count)
        started = time.perf_counter()
        carry, record = jax.block_until_ready(_run_chunk(controller, plant, carry, *inputs))
        # a compiled loop has no clock: every sample of a chunk gets the chunk's mean, plant included
        mean = (time.perf_counter() - started) / count
        record = jax.tree.map(np.asarray, record)
        parts.append(eqx.tree_at(lambda r: r[4].solve_time, record, np.full(count, mean)))
        if progress is not None:
            progress(begin + count, total)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


class _HostWell:
    """The JAX well behind the interface of a stateful plant."""

    def __init__(self, plant: WellPlant):
        self.plant, self.dt = plant, plant.dt
        self._step = eqx.filter_jit(WellPlant.step)

    def init(self):
        self.state = self.plant.init()
        return self.plant.measure(self.state)

    def step(self, mv, disturbance: float = 0.0):
        self.state, outputs = self._step(self.plant, self.state, jnp.asarray(mv), jnp.asarray(disturbance))
        return outputs


_jitted_step: Any = eqx.filter_jit(ContinuousController.step)


def _simulate_on_host(controller, plant, setpoints, offsets, progress: Progress | None):
    host = _HostWell(plant) if isinstance(plant, WellPlant) else plant
    outputs = host.init()
    state: ControllerState = controller.init(np.asarray(outputs.cv), np.asarray(outputs.mv))
    compiled = isinstance(controller, ContinuousController)
    if compiled:  # compile before the clock starts
        jax.block_until_ready(_jitted_step(controller, state, np.asarray(outputs.cv), setpoints[0]))
    records = []
    for k in range(len(setpoints)):
        cv = np.asarray(outputs.cv)
        begin = time.perf_counter()
        if compiled:
            state, info = jax.block_until_ready(_jitted_step(controller, state, cv, setpoints[k]))
            elapsed = time.perf_counter() - begin
        else:
            state, info = controller.step(state, cv, setpoints[k])
            elapsed = float(info.solve_time)
        outputs = host.step(np.asarray(state.mv), float(offsets[k]))
        info: StepInfo = eqx.tree_at(lambda i: (i.moves, i.solve_time), info, (None, np.float64(elapsed)))
        records.append(
            jax.tree.map(np.asarray, (cv, np.asarray(outputs.mv), state.bias, state.bias_raw, info))
        )
        if progress is not None and ((k + 1) % 20 == 0 or k + 1 == len(setpoints)):
            progress(k + 1, len(setpoints))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *records)


def _trajectory(structure, setpoints, record) -> Trajectory:
    cv, mv, bias, bias_raw, info = record
    return Trajectory(
        time=np.arange(len(setpoints)) * structure.dt,
        setpoint=setpoints,
        cv=cv,
        mv_demand=info.mv,
        mv=mv,
        move=info.move,
        bias=bias,
        bias_raw=bias_raw,
        status=info.status,
        fallback=info.fallback,
        objective=info.objective,
        bound=info.bound,
        gap=info.gap,
        nodes=info.nodes,
        solve_time=info.solve_time,
        finished_by=info.finished_by,
        cv_names=structure.cv_names,
        mv_names=structure.mv_names,
        cv_units=structure.cv_units,
        mv_units=structure.mv_units,
        dt=structure.dt,
    )


def simulate_batch(
    controllers: ContinuousController,
    plants: WellPlant,
    reference: Reference,
    *,
    batched: tuple[bool, bool] = (True, False),
    samples: int | None = None,
    progress: Progress | None = None,
) -> list[Trajectory]:
    """Many continuous closed loops on the JAX well at once, in one compiled and vmapped program.

    Args:
        controllers: a batch of controllers of one structure, made with `eqx.filter_vmap` (arrays have a first batch axis).
        plants: one well, or a batch of wells.
        reference: setpoints, the same for all.
        batched: whether the controllers and the plants have a batch axis.
        samples: length of the run; the whole reference if not given.
        progress: called with ``(done, total)`` samples.

    Returns:
        One `Trajectory` per lane.
    """
    structure = controllers.structure
    setpoints = reference.sample(structure.dt, samples)
    axes = tuple(eqx.if_array(0) if flag else None for flag in batched)
    carry = eqx.filter_vmap(_start, in_axes=axes)(controllers, plants)
    run = eqx.filter_jit(eqx.filter_vmap(_run_chunk, in_axes=(*axes, eqx.if_array(0), None, None)))
    parts, total = [], len(setpoints)
    for begin in range(0, total, CHUNK):
        started = time.perf_counter()
        part = setpoints[begin : begin + CHUNK]
        carry, record = jax.block_until_ready(run(controllers, plants, carry, part, np.zeros(len(part))))
        record = jax.tree.map(np.asarray, record)
        lanes = record[0].shape[0]
        mean = np.full((lanes, len(part)), (time.perf_counter() - started) / (len(part) * lanes))
        parts.append(eqx.tree_at(lambda r: r[4].solve_time, record, mean))
        if progress is not None:
            progress(begin + len(part), total)
    whole = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *parts)
    lanes = whole[0].shape[0]
    return [_trajectory(structure, setpoints, jax.tree.map(lambda v, i=i: v[i], whole)) for i in range(lanes)]
