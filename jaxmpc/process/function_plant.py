"""Equations in JAX as a plant: two functions, of the rates of change and of what is measured, and where to start."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxmpc.check import as_floats
from jaxmpc.errors import InputError, PlantError
from jaxmpc.process.actuator import Actuator, Actuators
from jaxmpc.process.integration import runge_kutta, settle, whole_steps
from jaxmpc.process.plant import JaxPlant, Outputs, Parameter, Steady, checked_parameters

STEADY = 1e-10  # scaled change per sample below which a state counts as steady
SAMPLES = 360  # of one round of simulation on the way to a steady state
ROUNDS = 48
Equations = Callable[[Array, Array, Array, dict[str, Any]], Any]


class FunctionState(NamedTuple):
    """State of the plant."""

    x: Float[Array, " state"]
    position: Float[Array, " mv"]  # where the actuators stand [MV unit]


class FunctionPlant(JaxPlant):
    """A plant ``dx/dt = rates(x, u, d, p)``, ``y = outputs(x, u, d, p)``, integrated with held inputs.

    Both functions take the states ``"state"``, the positions of the actuators ``"mv"`` [MV unit], the disturbances
    ``"disturbance"`` and a dictionary of the parameters, and return an array or a list of numbers.

    Args:
        rates: rates of change of the states [state unit per second].
        outputs: the CVs [CV unit].
        dt: sampling interval [s].
        mv: the working point of the MVs, where it starts [MV unit].
        state: where it starts, whether steady or not; or else
        guess: from where to look for the steady state at the working point. Where it is not 0, its size counts as typical
            for its state, else 1.
        disturbance_names: all are 0 at the start, and then what the loop is given.
        parameters: what the functions find in their dictionary, by name.
        actuators: one per MV; continuous ones without limits if not given.
        substep: integration step [s]; a tenth of `dt` if not given.

    Raises:
        InputError: for arguments that do not fit together, or functions that return what does not fit.
    """

    rates: Equations = eqx.field(static=True)
    outputs: Equations = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    substep: float = eqx.field(static=True)
    disturbance_names: tuple[str, ...] = eqx.field(static=True)
    actuators: Actuators = eqx.field(static=True)
    settles: bool = eqx.field(static=True)  # whether it starts in the steady state near `start`
    table: tuple[Parameter, ...] = eqx.field(static=True)
    start: Float[np.ndarray, " state"]
    start_mv: Float[np.ndarray, " mv"]
    numbers: tuple[Any, ...]  # of the parameters, in the order of `table`

    def __init__(
        self,
        rates: Equations,
        outputs: Equations,
        *,
        dt: float,
        mv: Sequence[float],
        state: Sequence[float] | None = None,
        guess: Sequence[float] | None = None,
        disturbance_names: Sequence[str] = (),
        parameters: Sequence[Parameter] = (),
        actuators: Sequence[Actuator] = (),
        substep: float | None = None,
    ):
        if (state is None) == (guess is None):
            raise InputError(
                "plant.state", state, "where it starts, or a guess of the steady state; one of both"
            )
        self.rates, self.outputs, self.settles = rates, outputs, state is None
        self.start = _row("guess" if self.settles else "state", guess if self.settles else state)
        self.start_mv = _row("mv", mv)
        self.dt, self.substep = dt, dt / 10 if substep is None else substep
        whole_steps(self.dt, self.substep)
        self.disturbance_names, self.table = tuple(disturbance_names), tuple(parameters)
        self.numbers = tuple(float(p.checked(p.default)) for p in self.table)
        self.actuators = Actuators.of(actuators, len(self.start_mv))
        for name, size in (("rates", len(self.start)), ("outputs", None)):
            shape = jax.eval_shape(lambda x, name=name: self._of(name, x, self.start_mv), self.start).shape
            if len(shape) != 1 or shape[0] != (shape[0] if size is None else size):
                expected = "one number per CV" if size is None else f"{size} numbers, one per state"
                raise InputError(f"plant.{name}", f"shape {list(shape)}", expected)

    @property
    def parameter_table(self) -> tuple[Parameter, ...]:
        """As given."""
        return self.table

    def replaced(self, values: Mapping[str, ArrayLike]) -> Self:
        """The plant with other parameters, see `JaxPlant.replaced`; a steady state to start from is looked for anew."""
        found = checked_parameters(self.table, values)
        new = {name: value if value.ndim else float(value) for name, value in found.items()}
        numbers: Any = tuple(
            new.get(p.name, value) for p, value in zip(self.table, self.numbers, strict=True)
        )
        return eqx.tree_at(lambda p: p.numbers, self, numbers)

    def init(self) -> FunctionState:
        """Where it starts.

        Raises:
            PlantError: if no steady state is found. A lane of several plants starts where the search has led to, then.
        """
        position = jnp.asarray(self.start_mv, dtype=jnp.float64)
        if not self.settles:
            return FunctionState(jnp.asarray(self.start, dtype=jnp.float64), position)
        x, drift = _steady(self, position, self._disturbed(0.0))
        if not isinstance(drift, Tracer) and not bool(drift <= STEADY):
            raise PlantError(
                f"No steady state was found from the guess {np.asarray(self.start).tolist()} with MVs at "
                f"{np.asarray(self.start_mv).tolist()}: after {ROUNDS * SAMPLES} samples of {self.dt:g} s the states still "
                f"change by {float(drift):.1e} of their size per sample. Give another guess or working point, or the state "
                "to start from"
            )
        return FunctionState(x, position)

    def steady(self, mv: ArrayLike, disturbance: ArrayLike = 0.0) -> Steady:
        """The steady state near `start` with held MVs [MV unit]; pure and never raising."""
        position, d = jnp.asarray(mv, dtype=jnp.float64), self._disturbed(disturbance)
        x, drift = _steady(self, position, d)
        outputs = Outputs(self._of("outputs", x, position, d), position)
        return Steady(FunctionState(x, position), outputs, drift <= STEADY)

    def step(
        self, state: FunctionState, mv: Float[Array, " mv"], disturbance: ArrayLike = 0.0
    ) -> tuple[FunctionState, Outputs]:
        """One sample, see `JaxPlant.step`."""
        d = self._disturbed(disturbance)
        position = self.actuators.move(state.position, jnp.asarray(mv, dtype=jnp.float64))
        steps = whole_steps(self.dt, self.substep)
        (x,) = runge_kutta(lambda x: (self._of("rates", x[0], position, d),), (state.x,), steps, self.substep)
        return FunctionState(x, position), Outputs(self._of("outputs", x, position, d), position)

    def measure(self, state: FunctionState) -> Outputs:
        """What it measures in `state`, undisturbed."""
        return Outputs(self._of("outputs", state.x, state.position), state.position)

    def _disturbed(self, disturbance: ArrayLike) -> Array:
        """The disturbances, given as a vector or one number for all."""
        return jnp.broadcast_to(jnp.asarray(disturbance, dtype=jnp.float64), (len(self.disturbance_names),))

    def _of(self, name: str, x, position, d=None):
        """What one of the functions returns, as an array."""
        d = jnp.zeros(len(self.disturbance_names)) if d is None else d
        parameters = {p.name: value for p, value in zip(self.table, self.numbers, strict=True)}
        found = getattr(self, name)(x, position, d, parameters)
        found = jnp.stack([jnp.asarray(v) for v in found]) if isinstance(found, (list, tuple)) else found
        return jnp.asarray(found, dtype=jnp.float64)


@eqx.filter_jit
def _steady(plant: FunctionPlant, position: Array, d: Array) -> tuple[Array, Array]:
    """The steady state, and what is left of its scaled drift [1/sample]."""
    start = jnp.asarray(plant.start)
    scale = jnp.where(start == 0.0, 1.0, jnp.abs(start))
    slope = lambda x: plant._of("rates", x, position, d)  # noqa: E731

    def onward(s, wanted):
        steps = jnp.where(wanted, SAMPLES * whole_steps(plant.dt, plant.substep), 0)
        (x,) = runge_kutta(lambda x: (slope(x[0]),), (s * scale,), steps, plant.substep)
        return x / scale

    found = settle(
        lambda s: slope(s * scale) / scale,
        onward,
        start / scale,
        first_step=10 * plant.dt,
        tolerance=0.99 * STEADY / plant.dt,  # so that rounding does not take it for unsteady
        rounds=ROUNDS,
    )
    return found.state * scale, found.drift * plant.dt


def _row(name: str, values: Any) -> np.ndarray:
    """A vector of finite numbers."""
    expected = f"one or more finite numbers, one per {'MV' if name == 'mv' else 'state'}"
    row = as_floats(f"plant.{name}", values, expected)
    if row.ndim != 1 or not row.size or not np.isfinite(row).all():
        raise InputError(f"plant.{name}", row.tolist(), expected)
    return row
