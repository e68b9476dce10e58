"""What a closed loop asks of a plant that keeps its own state: an FMU, a well stepped on the host, a class of one's own.

`jaxmpc.loop.simulate` and what wraps plants take it; nothing has to inherit from it.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np


class PlantOutputs(Protocol):
    """What a plant measures at the end of a sample; more is allowed."""

    @property
    def cv(self) -> Any:
        """``"cv"``, the CVs without noise [CV unit]."""
        ...

    @property
    def mv(self) -> Any:
        """``"mv"``, where the actuators stand [MV unit]."""
        ...


class StatefulPlant(Protocol):
    """A plant that is stepped from the host."""

    @property
    def dt(self) -> float:
        """Sampling interval [s]."""
        ...

    def init(self) -> PlantOutputs:
        """Start at the plant's working point; what it measures there."""
        ...

    def step(self, mv: np.ndarray, disturbance: float, /) -> PlantOutputs:
        """One sample with these demands ``"mv"`` [MV unit] and this disturbance; what is measured at its end."""
        ...
