"""What a closed loop asks of a plant: a JAX plant is a pure function of its state, any other keeps its own.

`JaxPlant` runs inside compiled loops, many lanes side by side. A `StatefulPlant`, an FMU or a class of one's own, is
stepped from the host; nothing has to inherit from it. Disturbances are a vector in the order of `disturbance_names`.
Plants list their parameters, and any of these may vary from lane to lane (`lanes_of_plants`).
"""

import contextlib
import dataclasses
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxmpc.check import as_floats
from jaxmpc.errors import InputError, near
from jaxmpc.programs.lanes import Lanes, for_all


class Outputs(NamedTuple):
    """What a plant measures, without noise."""

    cv: Any  # ``"cv"`` [CV unit]
    mv: Any  # ``"mv"``, where the actuators stand [MV unit]


class Signals(NamedTuple):
    """Names and units of what goes into and out of a plant, in the order of its vectors; units may be left out."""

    cv_names: tuple[str, ...]
    mv_names: tuple[str, ...]
    cv_units: tuple[str, ...] = ()
    mv_units: tuple[str, ...] = ()
    disturbance_units: tuple[str, ...] = ()  # in the order of the plant's `disturbance_names`


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


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A number of a plant that may be replaced."""

    name: str
    unit: str  # "1" without unit
    default: float  # what the plant has where nothing is given
    label: str = ""  # for legends and tables
    low: float = -np.inf
    high: float = np.inf
    positive: bool = False  # whether 0 is too little

    @property
    def expected(self) -> str:
        """What a value must be, in words, with the unit."""
        if self.positive:
            return f"a finite positive number [{self.unit}]"
        if np.isfinite((self.low, self.high)).all():
            return f"a number from {self.low:g} to {self.high:g} [{self.unit}]"
        return f"a finite number [{self.unit}]" + (f", {self.low:g} or more" if self.low > -np.inf else "")

    def checked(self, value: Any) -> np.ndarray:
        """The value, or one per lane, as floats. Raises `InputError` for what is not finite or out of range."""
        numbers = as_floats(f"plant.{self.name}", value, self.expected)
        good = np.isfinite(numbers) & (numbers >= self.low) & (numbers <= self.high)
        if numbers.ndim > 1 or not numbers.size or not (good & (not self.positive or numbers > 0)).all():
            raise InputError(f"plant.{self.name}", np.asarray(value).tolist(), self.expected)
        return numbers


def checked_parameters(table: Sequence[Parameter], values: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Values by name, numbers or one per lane.

    Raises:
        InputError: at ``plant.NAME`` for a name that is not in the table, or a value that cannot be; for unequal lanes.
    """
    known = {parameter.name: parameter for parameter in table}
    for name in values:
        if name not in known:
            expected = (
                f"a parameter of the plant: {', '.join(known)}" if known else "nothing: it has no parameters"
            )
            raise InputError(f"plant.{name}", values[name], expected, near(name, known))
    found = {name: known[name].checked(value) for name, value in values.items()}
    counts = {name: len(value) for name, value in found.items() if value.ndim}
    if len(set(counts.values())) > 1:
        raise InputError("plant", counts, "one number of lanes in all parameters that have lanes")
    return found


class JaxPlant(eqx.Module):
    """A plant in JAX, sampled every `dt` seconds; its methods are pure and may be vmapped."""

    dt: eqx.AbstractVar[float]
    disturbance_names: eqx.AbstractVar[tuple[str, ...]]
    parameter_table: ClassVar[tuple[Parameter, ...]] = ()  # what `replaced` takes; others may have a property

    def replaced(self, values: Mapping[str, ArrayLike]) -> Self:
        """The plant with other parameters, numbers or ``"lane"`` arrays; see `lanes_of_plants` for the latter.

        Raises:
            InputError: naming the parameter, for one that is not in `parameter_table` or a value that cannot be.
        """
        checked_parameters(self.parameter_table, values)
        return self

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


@contextlib.contextmanager
def closing(plant: Any) -> Iterator[Any]:
    """A plant, freed at the end if it holds anything outside Python."""
    try:
        yield plant
    finally:
        close = getattr(plant, "close", None)
        if close is not None:
            close()


def disturbances_of(plant: Any) -> tuple[str, ...]:
    """Names of the disturbances of a plant of any kind."""
    return tuple(getattr(plant, "disturbance_names", ("disturbance",)))


def lanes_of_plants(plant: JaxPlant, values: Mapping[str, ArrayLike]) -> Lanes[JaxPlant]:
    """Variants of a plant: parameters given as ``"lane"`` arrays vary, numbers hold for all, and the rest is kept once.

    Raises:
        InputError: as `JaxPlant.replaced`.
    """
    numbers = {name: value for name, value in values.items() if not np.ndim(value)}
    plant = plant.replaced(numbers) if numbers else plant
    varying = {name: value for name, value in values.items() if name not in numbers}
    if not varying:
        return for_all(plant)
    plants = plant.replaced(varying)
    has_lanes = jax.tree.map(lambda new, old: np.ndim(new) > np.ndim(old), plants, plant)
    return Lanes(*eqx.partition(plants, has_lanes))
