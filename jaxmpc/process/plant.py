"""What a closed loop asks of a plant: a JAX plant is a pure function of its state, any other keeps its own.

`JaxPlant` runs inside compiled loops, many lanes side by side. A `StatefulPlant`, an FMU or a class of one's own, is
stepped from the host; nothing has to inherit from it. Disturbances are a vector in the order of `disturbance_names`.
"""

from abc import abstractmethod
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float


class Outputs(NamedTuple):
    """What a plant measures, without noise."""

    cv: Any  # ``"cv"`` [CV unit]
    mv: Any  # ``"mv"``, where the actuators stand [MV unit]


class Signals(NamedTuple):
    """Names and units of the CVs and MVs of a plant, in the order of its vectors; units may be empty."""

    cv_names: tuple[str, ...]
    mv_names: tuple[str, ...]
    cv_units: tuple[str, ...] = ()
    mv_units: tuple[str, ...] = ()


class Steady(NamedTuple):
    """A steady state of a plant with held MVs."""

    state: Any  # of a `JaxPlant`; None where the plant keeps its own, and stands there then
    outputs: Any  # what it measures there, as `Outputs`
    converged: Any  # whether it is one; else the last state on the way to it


class PlantOutputs(Protocol):
    """What a plant measures at the end of a sample; more than `Outputs` is allowed."""

    @property
    def cv(self) -> Any:
        """``"cv"``, the CVs without noise [CV unit]."""
        ...

    @property
    def mv(self) -> Any:
        """``"mv"``, where the actuators stand [MV unit]."""
        ...


class JaxPlant(eqx.Module):
    """A plant in JAX, sampled every `dt` seconds; its methods are pure and may be vmapped."""

    dt: eqx.AbstractVar[float]
    disturbance_names: eqx.AbstractVar[tuple[str, ...]]

    @abstractmethod
    def init(self) -> Any:
        """The steady state at the plant's working point."""

    @abstractmethod
    def step(
        self, state: Any, mv: Float[Array, " mv"], disturbance: Float[Array, " disturbance"]
    ) -> tuple[Any, Any]:
        """One sample: move the actuators, hold the inputs for `dt`, and measure at the end.

        Args:
            state: from `init` or the step before.
            mv: demands [MV unit].
            disturbance: during the sample, in the order of `disturbance_names`.

        Returns:
            ``(state, outputs)``; the outputs have `cv` and `mv` as `Outputs` has.
        """

    @abstractmethod
    def measure(self, state: Any) -> Any:
        """What the plant measures in `state`, without advancing it and undisturbed."""

    def run(
        self, state: Any, mv: Float[ArrayLike, "sample mv"], disturbance: ArrayLike = 0.0
    ) -> tuple[Any, Any]:
        """Apply a sequence of inputs, one row per sample.

        Args:
            mv: ``"sample mv"``, demands [MV unit].
            disturbance: one number for all, one per sample, or ``"sample disturbance"``.

        Returns:
            ``(state, outputs)``: the state after the last sample, and outputs with a leading sample axis.
        """
        mv = jnp.asarray(mv, dtype=jnp.float64)
        given = jnp.asarray(disturbance, dtype=jnp.float64)
        given = given[:, None] if given.ndim == 1 else given
        rows = jnp.broadcast_to(given, (mv.shape[0], len(self.disturbance_names)))
        return jax.lax.scan(lambda s, now: self.step(s, now[0], now[1]), state, (mv, rows))


class StatefulPlant(Protocol):
    """A plant that is stepped from the host; without `disturbance_names` it has a single disturbance."""

    @property
    def dt(self) -> float:
        """Sampling interval [s]."""
        ...

    def init(self) -> PlantOutputs:
        """Start at the plant's working point; what it measures there."""
        ...

    def step(self, mv: np.ndarray, disturbance: Any, /) -> PlantOutputs:
        """One sample with these demands ``"mv"`` [MV unit] and disturbances; what is measured at its end."""
        ...


def disturbances_of(plant: Any) -> tuple[str, ...]:
    """Names of the disturbances of a plant of any kind."""
    return tuple(getattr(plant, "disturbance_names", ("disturbance",)))
