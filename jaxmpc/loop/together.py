"""Closed loops of many mixed-integer controllers that advance together, sample by sample.

The integer search decides on the host, so that there is no compiled scan; prediction, relaxations and the wells of all
scenarios are single compiled calls. `closed_loop` is the only caller.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np

from jaxmpc.controller.batch import Lanes, map_lanes, per_lane, variant_mesh
from jaxmpc.controller.measurement import received
from jaxmpc.controller.mixed_integer import MixedIntegerControllers
from jaxmpc.loop.noise import noise_samples
from jaxmpc.process.plant import WellPlant

REPORT = 20  # samples between two progress reports


def advance_together(
    controllers: MixedIntegerControllers,
    plants: Lanes[WellPlant],
    inputs: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    told: np.ndarray,
    record: Callable[..., dict],
    tick: Callable[[int], None],
) -> dict[str, np.ndarray]:
    """Recorded fields ``"scenario sample ..."`` of a whole run.

    Args:
        controllers: one per scenario.
        plants: one well for all, or one per scenario.
        inputs: setpoints ``"scenario sample cv"``, pressure offsets ``"scenario sample"`` [bar], and noise and faults of the
            sensors ``"scenario sample cv"`` [CV unit].
        told: ``"scenario"``, whether the controller is told where the actuators stand.
        record: of ``(cv, mv, state, info)``; the fields to keep by name.
        tick: told how many scenario samples were done.
    """
    setpoints, offsets, errors, faults = inputs
    count, samples = setpoints.shape[:2]
    mesh = variant_mesh(jax.local_devices()[:1])
    at = lambda k: per_lane(np.full(count, k, dtype=np.int32))  # noqa: E731
    state, outputs = map_lanes(_start, [plants, at(0)], mesh)
    cv, mv = np.asarray(outputs.cv), np.asarray(outputs.mv)
    memory = controllers.init(cv, mv)
    controllers.prepare(memory, cv)
    tick(0)
    fields: dict[str, np.ndarray] = {}
    for k in range(samples):
        sound = cv + errors[:, k]
        arrived = received(sound, faults[:, k], np.asarray(memory.sensors.value))
        memory, info = controllers.step(memory, arrived, setpoints[:, k], np.where(told[:, None], mv, np.nan))
        arguments = [plants, per_lane(state), per_lane(np.asarray(memory.mv)), per_lane(offsets[:, k].copy())]
        state, outputs = map_lanes(WellPlant.step, arguments, mesh)
        now = record(sound, outputs.mv, memory, info)
        for name, value in now.items():
            value = np.asarray(value)
            if name not in fields:
                fields[name] = np.empty((count, samples, *value.shape[1:]), dtype=value.dtype)
            fields[name][:, k] = value
        cv, mv = np.asarray(outputs.cv), np.asarray(outputs.mv)
        if (k + 1) % REPORT == 0 or k + 1 == samples:
            tick(count * (k % REPORT + 1))
    return fields


def errors_of(deviation: np.ndarray, seeds: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Measurement noise ``"scenario sample cv"`` [CV unit].

    Args:
        deviation: standard deviations ``"scenario cv"`` [CV unit].
        seeds: seeds with streams ``"scenario 2"``.
        samples: their numbers.
    """
    return np.asarray(_errors(deviation, seeds, samples))


@jax.jit
def _errors(deviation, seeds, samples):
    return jax.vmap(lambda d, s: noise_samples(d, s[0], s[1], samples))(deviation, seeds)


def _start(plant: WellPlant, _):
    state = plant.init()
    return state, plant.measure(state)
