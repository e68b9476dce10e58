"""The well as a plant to control: thesis 3.1 and the plant block of its figure 9, in JAX.

`WellPlant` integrates the equations of `jaxmpc.process.well.equations` with RK4 between samples, holds its inputs over each
sample, and moves the choke the way its actuator does. Everything is pure: a batch over states, inputs,
parameters or disturbances is a `jax.vmap`. The closed loop and the identification call it; the FMU plant of
`identify.well_fmu` offers the same steps on the host.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from jaxmpc.check import as_floats
from jaxmpc.errors import InputError
from jaxmpc.process import integration
from jaxmpc.process.integration import settle, whole_steps
from jaxmpc.process.plant import JaxPlant, Parameter, checked_parameters
from jaxmpc.process.well.choke import CHOKES, LIFT, check_choke
from jaxmpc.process.well.equations import (
    DEFAULT_CHOKE,
    DEFAULT_LIFT,
    SHIPPED_STEADY_STATE,
    WellParameters,
    check_parameters,
    model,
)
from jaxmpc.process.well.parameters import PARAMETERS, in_si

# Typical sizes of the states, for tolerances [kg, kg, kg, kg, kg, 1, m3/h, Pa].
STATE_SCALE = (100.0, 100.0, 100.0, 1000.0, 1000.0, 1.0, 1000.0, 1e6)
STEADY_TOLERANCE = 1e-11  # scaled drift [1/s] below which a state counts as steady
STEADY_HOURS = 48


class JaxOps:
    """What `jaxmpc.process.well.equations.model` needs beyond arithmetic, for JAX arrays."""

    sqrt = staticmethod(jnp.sqrt)

    @staticmethod
    def positive(x):
        """The larger of x and 0."""
        return jnp.maximum(x, 0.0)


class WellState(eqx.Module):
    """State of the plant."""

    # the states of the well in the order and units of `jaxmpc.process.well.equations.STATES`
    x: Float[Array, "8"]
    position: Float[Array, ""]  # choke position after the actuator [%]
    lift: Float[Array, ""]  # lift demand that was last applied [m3/h]


class WellOutputs(NamedTuple):
    """What a plant measures; JAX arrays from `WellPlant`, NumPy values from the FMU plant."""

    cv: Any  # gas rate at standard conditions and oil rate [m3/h]
    mv: Any  # choke position after the actuator [%] and lift demand [m3/h], as applied
    wellhead_pressure: Any  # upstream of the choke [bar]
    bottom_hole_pressure: Any  # at the perforations [bar]
    annulus_pressure: Any  # at the top of the annulus [bar]
    injection_pressure: Any  # in the tubing at the gas-lift valve [bar]
    delivered_lift: Any  # what the supply delivers [m3/h]
    choke_opening: Any  # of the choke, which follows its position with a lag [%]


class SteadyState(NamedTuple):
    """Result of `steady_state`."""

    x: Float[Array, "8"]  # ``"8"``, the state (of the last iteration, where it did not converge)
    outputs: WellOutputs  # `WellOutputs` at that state
    converged: Bool[Array, ""]  # whether the scaled drift fell below `STEADY_TOLERANCE`
    drift: Float[Array, ""]  # largest scaled rate of change left [1/s]
    hours: Int[Array, ""]  # simulated on the way [h]


def rates(x: Float[Array, "8"], u: Float[Array, "3"], parameters: WellParameters) -> Float[Array, "8"]:
    """Time derivative of the well's state [state unit per second]; `u` as in `jaxmpc.process.well.equations.INPUTS`."""
    return jnp.stack(model(JaxOps, tuple(x), tuple(u), parameters)[0])


def runge_kutta(x: tuple, u: tuple, parameters: WellParameters, steps, substep: float) -> tuple:
    """Integrate over `steps` classical fourth-order Runge-Kutta steps of `substep` seconds, inputs held."""
    # Eight separate values, not one array: a batch then works on whole vectors instead of strided slices.
    return integration.runge_kutta(lambda x: model(JaxOps, x, u, parameters)[0], x, steps, substep)


def steady_state(
    choke,
    lift,
    disturbance=0.0,
    parameters: WellParameters | None = None,
    guess: Float[Array, "8"] | None = None,
) -> SteadyState:
    """Steady state for held inputs, see `jaxmpc.process.integration.settle`.

    Where the choke is shut or nearly no gas is lifted, steady states are not unique; the result is the one that
    the simulation from `guess` settles at. A well with other parameters may have an unstable steady state (casing
    heading), which the simulation circles; the shipped well has none.

    Args:
        choke: position [%], 0..100.
        lift: lift rate [m3/h], 0 or more.
        disturbance: offset of the reservoir pressure [bar].
        parameters: of the well; the shipped ones by default.
        guess: ``"8"``, where to start; the shipped steady state by default.

    Returns:
        `SteadyState`. Never raises: look at `converged`, per lane of a batch. Without convergence, `x` is the
        state after `STEADY_HOURS` of simulation.
    """
    parameters = WellParameters() if parameters is None else parameters
    u = jnp.stack([jnp.asarray(v, dtype=jnp.float64) for v in (choke, lift, disturbance)])
    scale = jnp.asarray(STATE_SCALE)
    start = jnp.asarray(SHIPPED_STEADY_STATE if guess is None else guess, dtype=jnp.float64)

    def drift(s):
        return rates(s * scale, u, parameters) / scale

    def onward(s, wanted):
        seconds = jnp.where(wanted, 3600, 0)
        return jnp.stack(runge_kutta(tuple(s * scale), tuple(u), parameters, seconds, 1.0)) / scale

    # The two actuator lags are known; the other states start where the guess has them.
    first = (start / scale).at[5].set(u[0] / 100).at[6].set(u[1] / scale[6])
    found = settle(drift, onward, first, first_step=100.0, tolerance=STEADY_TOLERANCE, rounds=STEADY_HOURS)
    x = found.state * scale
    outputs = _outputs(x, u[0], u[1], u[2], parameters)
    return SteadyState(x, outputs, found.drift <= STEADY_TOLERANCE, found.drift, found.rounds)


_steady_state = jax.jit(steady_state)


def steady_state_of(choke, lift, disturbance, parameters: WellParameters) -> SteadyState:
    """`steady_state` from the shipped one, compiled once for all numbers and plants."""
    given = choke, lift, disturbance, parameters
    # Python's numbers and arrays would be arguments of two kinds, each with a program
    return _steady_state(*jax.tree.map(lambda v: jnp.asarray(v, dtype=jnp.float64), given))


def _known(choke, lift, disturbance, parameters) -> bool:
    """Whether the shipped steady state is the answer, so that a default start compiles no solver."""
    here = (choke, lift, disturbance, *jax.tree.leaves(parameters))
    there = (DEFAULT_CHOKE, DEFAULT_LIFT, 0.0, *jax.tree.leaves(WellParameters()))
    return all(isinstance(a, (int, float)) and a == b for a, b in zip(here, there, strict=True))


@jax.jit
def _outputs(x, position, lift, disturbance, parameters) -> WellOutputs:
    _, y = model(JaxOps, tuple(x), (position, lift, disturbance), parameters)
    return WellOutputs(jnp.stack(y[:2]), jnp.stack([position, lift]), *y[2:])


class WellPlant(JaxPlant):
    """The well with its actuators, sampled every `dt` seconds.

    Attributes:
        parameters: of the well; batch them to batch wells.
        dt: sampling interval [s].
        substep: integration step [s]; `dt` is a whole number of these.
        actuator: ``continuous`` or ``step``.
    """

    disturbance_names: ClassVar[tuple[str, ...]] = ("reservoir_pressure_offset",)
    parameter_table: ClassVar[tuple[Parameter, ...]] = PARAMETERS
    parameters: WellParameters = WellParameters()
    dt: float = eqx.field(static=True, default=10.0)
    substep: float = eqx.field(static=True, default=1.0)
    actuator: str = eqx.field(static=True, default="continuous")

    def __check_init__(self):
        whole_steps(self.dt, self.substep)
        check_choke(self.actuator, "plant.actuator")
        if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(self.parameters)):
            check_parameters(self.parameters, "plant.parameters")

    def replaced(self, values: Mapping[str, ArrayLike]) -> WellPlant:
        """The well with other parameters in engineering units, see `JaxPlant.replaced`."""
        found = checked_parameters(PARAMETERS, values)
        si = {
            name: np.array([in_si(name, v) for v in value]) if value.ndim else in_si(name, float(value))
            for name, value in found.items()
        }
        return dataclasses.replace(self, parameters=dataclasses.replace(self.parameters, **si))

    @property
    def steps(self) -> int:
        """Number of integration steps in one sample."""
        return round(self.dt / self.substep)

    def init(self, choke=DEFAULT_CHOKE, lift=DEFAULT_LIFT, disturbance=0.0) -> WellState:
        """Steady state at the given inputs; the stored one for the shipped well at its working point.

        Args:
            choke: position [%], 0..100 (the step choke starts wherever this is).
            lift: lift rate [m3/h], 0 or more.
            disturbance: offset of the reservoir pressure [bar].

        Raises:
            InputError: for inputs outside their range (not when they are traced).
        """
        check_inputs(choke, lift, disturbance)
        if _known(choke, lift, disturbance, self.parameters):
            x = jnp.asarray(SHIPPED_STEADY_STATE, dtype=jnp.float64)
        else:
            x = steady_state_of(choke, lift, disturbance, self.parameters).x
        return WellState(x, jnp.asarray(choke, dtype=jnp.float64), jnp.asarray(lift, dtype=jnp.float64))

    def step(
        self, state: WellState, mv: Float[Array, "2"], disturbance: ArrayLike = 0.0
    ) -> tuple[WellState, WellOutputs]:
        """One sample: move the actuators, hold the inputs for `dt`, and measure at the end.

        Args:
            mv: choke demand [%] (limited to 0..100 by the choke) and lift demand [m3/h] (0 or more).
            disturbance: offset of the reservoir pressure during the sample [bar].

        Returns:
            ``(state, outputs)`` at the end of the sample. Not a number in gives not a number out.
        """
        mv = jnp.asarray(mv, dtype=jnp.float64)
        position = CHOKES[self.actuator].move(state.position, mv[0])
        lift = LIFT.move(state.lift, mv[1])
        offset = jnp.asarray(disturbance, dtype=jnp.float64).reshape(())
        u = (position, lift, offset)
        x = jnp.stack(runge_kutta(tuple(state.x), u, self.parameters, self.steps, self.substep))
        return WellState(x, position, lift), _outputs(x, position, lift, offset, self.parameters)

    def measure(self, state: WellState, disturbance=0.0) -> WellOutputs:
        """What the plant measures in `state`, without advancing it."""
        offset = jnp.asarray(disturbance, dtype=jnp.float64)
        return _outputs(state.x, state.position, state.lift, offset, self.parameters)

    def with_actuator(self, actuator: str) -> WellPlant:
        """The same well with another choke actuator."""
        return dataclasses.replace(self, actuator=actuator)


def check_inputs(choke, lift, disturbance=0.0) -> None:
    """Refuse inputs that are not finite or outside their range; traced values pass.

    Raises:
        InputError: naming the input, its value, and the range with its unit.
    """
    limits = (
        ("choke", choke, 0.0, 100.0, "a position in 0..100 %"),
        ("gas_lift", lift, 0.0, np.inf, "a lift rate of 0 m3/h or more, finite"),
        ("reservoir_pressure_offset", disturbance, -np.inf, np.inf, "a finite pressure change [bar]"),
    )
    for name, value, low, high, expected in limits:
        if isinstance(value, Tracer):
            continue
        number = as_floats(name, value, expected)
        if not np.isfinite(number).all() or (number < low).any() or (number > high).any():
            raise InputError(name, value, expected)
