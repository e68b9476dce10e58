"""The JAX well behind the interface of a stateful plant, for loops whose controller decides on the host.

Everything that crosses between host and device at a sample goes in one array each way (`packing`).
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import numpy as np

from jaxmpc.process.plant import WellOutputs, WellPlant
from jaxmpc.programs.packing import Packing


class HostWell:
    """A well that keeps its state."""

    def __init__(self, plant: WellPlant):
        self.plant, self.dt = plant, plant.dt
        well = _with_lane(plant)
        self._of_well = Packing.of(well)
        self._well = jax.device_put(self._of_well.pack(well))  # numbers would be sent over at every sample

    def init(self) -> WellOutputs:
        """Start at the plant's working point; what it measures there."""
        state = self.plant.init()
        outputs = self.plant.measure(state)
        given = _with_lane((state, outputs.mv, 0.0))
        found = _with_lane((state, outputs))
        self._packings = self._of_well, Packing.of(given), Packing.of(found)
        self._state = given[0]
        return jax.tree.map(lambda leaf: leaf[0], found[1])

    def step(self, mv, disturbance: float = 0.0) -> WellOutputs:
        """One sample with these demands [MV unit] and offset of the reservoir pressure [bar]."""
        given = self._packings[1].pack((self._state, np.asarray(mv)[None], np.array([disturbance])))
        found = np.asarray(_advance(self._well, given, packings=self._packings))
        self._state, outputs = self._packings[2].unpack(found)
        return WellOutputs(*(leaf[0] for leaf in outputs))


def _with_lane(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64)[None], tree)


@functools.partial(jax.jit, static_argnames="packings")
def _advance(well, given, packings):
    first = lambda tree: jax.tree.map(lambda leaf: leaf[0], tree)  # noqa: E731
    plant: WellPlant = first(packings[0].unpack(well))
    state, outputs = plant.step(*first(packings[1].unpack(given)))
    return packings[2].pack(jax.tree.map(lambda leaf: leaf[None], (state, outputs)))
