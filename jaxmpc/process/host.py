"""A plant in JAX behind the interface of a stateful plant, for loops whose controller decides on the host.

Everything that crosses between host and device at a sample goes in one array each way (`packing`).
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import numpy as np

from jaxmpc.process.plant import JaxPlant
from jaxmpc.programs.packing import Packing


class HostPlant:
    """A JAX plant that keeps its state."""

    def __init__(self, plant: JaxPlant):
        self.plant, self.dt = plant, plant.dt
        self.disturbance_names = plant.disturbance_names
        lane = _with_lane(plant)
        self._of_plant = Packing.of(lane)
        self._plant = jax.device_put(self._of_plant.pack(lane))  # numbers would be sent over at every sample

    def init(self) -> Any:
        """Start at the plant's working point; what it measures there."""
        state = self.plant.init()
        outputs = self.plant.measure(state)
        given = _with_lane((state, outputs.mv, np.zeros(len(self.disturbance_names))))
        found = _with_lane((state, outputs))
        self._packings = self._of_plant, Packing.of(given), Packing.of(found)
        self._state = given[0]
        return jax.tree.map(lambda leaf: leaf[0], found[1])

    def step(self, mv, disturbance=0.0) -> Any:
        """One sample with these demands [MV unit] and disturbances, one for each of `disturbance_names` or a number."""
        rows = np.broadcast_to(np.asarray(disturbance, dtype=np.float64), (1, len(self.disturbance_names)))
        given = self._packings[1].pack((self._state, np.asarray(mv)[None], rows))
        found = np.asarray(_advance(self._plant, given, packings=self._packings))
        self._state, outputs = self._packings[2].unpack(found)
        return jax.tree.map(lambda leaf: leaf[0], outputs)


def _with_lane(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64)[None], tree)


@functools.partial(jax.jit, static_argnames="packings")
def _advance(packed, given, packings):
    first = lambda tree: jax.tree.map(lambda leaf: leaf[0], tree)  # noqa: E731
    plant: JaxPlant = first(packings[0].unpack(packed))
    state, outputs = plant.step(*first(packings[1].unpack(given)))
    return packings[2].pack(jax.tree.map(lambda leaf: leaf[None], (state, outputs)))
