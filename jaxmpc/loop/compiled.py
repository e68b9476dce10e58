"""Closed loops of continuous controllers as compiled programs: one, or many lanes of a sweep on several cores or devices.

`closed_loop` is the only caller; it knows what runs may be asked for, this module how they are compiled and cut into parts.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxmpc.controller.batch import Lanes, for_all, map_lanes, per_lane, place
from jaxmpc.controller.continuous import ContinuousController, ControllerState, StepInfo
from jaxmpc.controller.measurement import received
from jaxmpc.loop.inputs import Sweep
from jaxmpc.loop.noise import noise_samples
from jaxmpc.loop.trajectory import RECORDABLE
from jaxmpc.process.plant import WellPlant
from jaxmpc.programs.threads import parts_of, side_by_side

CHUNK = 300  # samples between two progress reports of a compiled loop
SIDE_BY_SIDE = 16  # lanes of one compiled call, on a CPU


def record_of(cv, mv, state: ControllerState, info: StepInfo) -> dict[str, Any]:
    """What a sample leaves behind, by the names of `Trajectory`; a compiled loop has no solve time yet."""
    return dict(
        cv=cv,
        mv_demand=info.mv,
        mv=mv,
        move=info.move,
        plan=info.moves,
        bias=state.bias,
        bias_raw=state.bias_raw,
        quality=info.quality,
        off=info.off,
        status=info.status,
        fallback=info.fallback,
        objective=info.objective,
        bound=info.bound,
        gap=info.gap,
        nodes=info.nodes,
        finished_by=info.finished_by,
    )


def start(controller: ContinuousController, plant: WellPlant):
    """States of controller and plant at the plant's steady state, and what it measures there."""
    plant_state = plant.init()
    outputs = plant.measure(plant_state)
    return controller.init(outputs.cv, outputs.mv), plant_state, outputs.cv, outputs.mv


def scan(
    controller: ContinuousController,
    plant: WellPlant,
    carry,
    inputs,
    told: Bool[Array, ""],
    recorded=RECORDABLE,
):
    """Some samples of a compiled loop: measure, decide, advance the plant.

    Args:
        controller, plant: of one lane.
        carry: from `start` or the samples before.
        inputs: setpoints, pressure offsets, noise and faults of the sensors, ``"sample ..."``.
        told: whether the controller is told where the actuators stand.
        recorded: fields to keep.
    """

    def one(carry, inputs):
        state, plant_state, cv, mv = carry
        setpoint, offset, error, fault = inputs
        sound = cv + error
        arrived = received(sound, fault, state.sensors.value)
        state, info = controller.step(state, arrived, setpoint, jnp.where(told, mv, jnp.nan))
        plant_state, outputs = plant.step(plant_state, state.mv, offset)
        record = record_of(sound, outputs.mv, state, info)
        return (state, plant_state, outputs.cv, outputs.mv), {
            k: v for k, v in record.items() if k in recorded
        }

    return jax.lax.scan(one, carry, inputs)


def even(total: int, most: int, multiple: int = 1) -> int:
    """Size of equal pieces of at most `most` (or `multiple`), a multiple of `multiple`, that cover `total`."""
    most = max(most // multiple, 1)
    units = -(-total // multiple)
    return multiple * -(-units // -(-units // most))


def run_piece(sweep: Sweep, whole, common, index, real: int, record, mesh, tick) -> dict[str, np.ndarray]:
    """Recorded fields "lane sample ..." of the first `real` of some lanes; on one CPU, parts of them on several cores."""
    parts = parts_of(len(index), SIDE_BY_SIDE) if mesh.size == 1 else [np.arange(len(index))]
    ready = [_Part(sweep, whole, common, index[part], record, mesh) for part in parts]
    if index[0] == 0:  # compile before the clock starts
        ready[0].compile()
        tick(0)
    lock = threading.Lock()

    def run(k: int, stopped: Callable[[], bool]) -> dict[str, np.ndarray]:
        its = min(max(real - int(parts[k][0]), 0), len(parts[k]))

        def count(samples: int) -> None:
            with lock:
                tick(its * samples)

        return {name: values[:its] for name, values in ready[k].run(count, stopped).items()}

    fields = side_by_side(run, range(len(parts)))
    if len(fields) == 1:
        return fields[0]
    return {name: np.concatenate([f.pop(name) for f in fields]) for name in list(fields[0])}


class _Part:
    """Some lanes of a sweep that share every compiled call.

    Args:
        sweep: all of it.
        whole: its controllers and plants.
        common: what these share, on the devices.
        index: lanes.
        record: fields to keep.
        mesh: devices.
    """

    def __init__(self, sweep: Sweep, whole, common, index, record, mesh):
        self.put = lambda lanes: place(lanes, mesh)
        own = [lanes.take(index).each for lanes in whole]
        self.loop = [self.put(Lanes(each, shared)) for each, shared in zip(own, common, strict=True)]
        self.noise = [self.put(per_lane(v[index])) for v in (sweep.seeds, sweep.deviation)]
        self.setpoints, self.offsets = sweep.setpoints_of(index), sweep.offsets_of(index)
        self.faults = sweep.faults_of(index)
        self.told = self.put(per_lane(jnp.asarray(sweep.position_feedback[index])))
        self.samples, self.lanes, self.record, self.mesh = sweep.samples, len(index), record, mesh
        self.length = even(sweep.samples, CHUNK)

    def _arguments(self, carry, begin: int):
        # samples beyond the end are simulated and dropped, for the sake of one shape
        now = np.minimum(np.arange(begin, begin + self.length), self.samples - 1)
        inputs = self.put(per_lane((self.setpoints[:, now], self.offsets[:, now], self.faults[:, now])))
        which = self.put(for_all(jnp.asarray(begin)))
        return [*self.loop, per_lane(carry), inputs, *self.noise, which, self.told, for_all(self.record)]

    def compile(self) -> None:
        """Compile what `run` calls."""
        carry = map_lanes(start, self.loop, self.mesh)
        map_lanes.lower(_window, self._arguments(carry, 0), self.mesh).compile()

    def run(self, tick: Callable[[int], None], stopped: Callable[[], bool]) -> dict[str, np.ndarray]:
        """Recorded fields "lane sample ..." of all lanes."""
        carry = map_lanes(start, self.loop, self.mesh)
        fields: dict[str, np.ndarray] = {}
        for begin in range(0, self.samples, self.length):
            if stopped():
                break
            arguments, count = self._arguments(carry, begin), min(self.length, self.samples - begin)
            started = time.perf_counter()
            carry, part = jax.block_until_ready(map_lanes(_window, arguments, self.mesh))
            # as in one compiled loop: every sample gets the mean of its chunk, and lanes share the time equally
            mean = (time.perf_counter() - started) / (self.length * self.lanes)
            part = {name: np.asarray(value) for name, value in part.items()}
            if "solve_time" in self.record:
                part["solve_time"] = np.full((self.lanes, self.length), mean)
            for name, value in part.items():
                if name not in fields:
                    fields[name] = np.empty((self.lanes, self.samples, *value.shape[2:]), dtype=value.dtype)
                fields[name][:, begin : begin + count] = value[:, :count]
            tick(count)
        return fields


def _window(controller, plant, carry, inputs, seed, deviation, begin, told, record):
    """Some samples of one lane, the first of them number `begin`; `told` as in `scan`."""
    setpoints, offsets, faults = inputs
    errors = noise_samples(deviation, seed[0], seed[1], begin + jnp.arange(len(setpoints)))
    return scan(controller, plant, carry, (setpoints, offsets, errors, faults), told, record)
