"""Steady-state step coefficients over the choke range: thesis 4.1.1, figures 10 and 11.

For each lift rate, the gain of a 2 % choke step from each choke position, computed from steady states. On the
JAX well all steady states are solved in one batch; on the FMU each is settled by simulation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxmpc.errors import InputError
from jaxmpc.process.plant import STATE_SCALE, WellPlant, check_inputs, rates, steady_state
from jaxmpc.process.well.equations import CV_NAMES, WellParameters

LIFTS = (5000.0, 7500.0, 10000.0)  # m3/h, the three curves of figures 10 and 11


class SteadySweep(NamedTuple):
    """Steady states and step coefficients over choke and lift.

    Attributes:
        choke: ``"choke"``, positions [%].
        lift: ``"lift"``, rates [m3/h].
        cv: ``"cv lift choke"``, steady gas and oil rates [m3/h].
        coefficient: ``"cv lift choke-1"``, change of the steady CV from each position to the next
            [m3/h per % choke]; entry i belongs to a step from `choke[i]`.
        converged: ``"lift choke"``, whether the steady state was found.
        cv_names: names of the CVs.
    """

    choke: np.ndarray
    lift: np.ndarray
    cv: np.ndarray
    coefficient: np.ndarray
    converged: np.ndarray
    cv_names: tuple[str, ...] = CV_NAMES


class Stability(NamedTuple):
    """How the well returns to its steady states, from the linearised model.

    Attributes:
        choke: ``"choke"``, positions [%].
        lift: ``"lift"``, rates [m3/h].
        growth: ``"lift choke"``, of the slowest mode [1/s]; above zero the steady state is unstable.
        frequency: ``"lift choke"``, of the least damped oscillation [rad/s]; 0 where nothing oscillates.
        damping: ``"lift choke"``, its damping ratio [1]; 1 where nothing oscillates.
    """

    choke: np.ndarray
    lift: np.ndarray
    growth: np.ndarray
    frequency: np.ndarray
    damping: np.ndarray


@jax.jit
def _linearise(choke, lift, parameters):
    scale = jnp.asarray(STATE_SCALE)

    def one(choke, lift):
        found = steady_state(choke, lift, 0.0, parameters)
        u = jnp.stack([choke, lift, 0.0])
        return jax.jacfwd(lambda s: rates(s * scale, u, parameters) / scale)(found.x / scale), found.converged

    return jax.vmap(one)(choke, lift)


def stability_map(
    parameters: WellParameters | None = None, chokes: ArrayLike | None = None, lifts: ArrayLike | None = None
) -> Stability:
    """Where the well oscillates, and whether an oscillation grows (casing heading, thesis 6.7).

    The shipped well has no growing oscillation. After a disturbance it swings back: from 2000 m3/h of lift on
    the least damping ratio is 0.55, and it falls to 0.41 at 500 m3/h with the choke fully open, where one
    swing takes 44 minutes.

    Args:
        parameters: of the well; the shipped ones by default.
        chokes: positions [%] above 0.
        lifts: rates [m3/h] above 0; a shut or unlifted well has no unique steady state.

    Raises:
        InputError: for inputs outside their range, or where no steady state was found.
    """
    parameters = WellParameters() if parameters is None else parameters
    chokes = np.array([2, 5, 10, 20, 30, 50, 70, 100.0]) if chokes is None else np.asarray(chokes, np.float64)
    lifts = np.array([200, 500, 1000, 2000, 5000, 1e4]) if lifts is None else np.asarray(lifts, np.float64)
    choke, lift = _grid(chokes, lifts)
    matrices, converged = _linearise(jnp.asarray(choke), jnp.asarray(lift), parameters)
    if not np.all(converged):
        where = int(np.argmin(converged))
        raise InputError(
            "choke, gas_lift", (choke[where], lift[where]), "inputs [%, m3/h] with a steady state"
        )
    modes = np.linalg.eigvals(np.asarray(matrices))
    swinging = np.abs(modes.imag) > 1e-3 * np.abs(modes)
    ratio = np.where(swinging, -modes.real / np.abs(modes), 1.0)
    least = np.argmin(ratio, axis=1)[:, None]
    frequency = np.take_along_axis(np.where(swinging, np.abs(modes.imag), 0.0), least, axis=1)
    found = modes.real.max(axis=1), frequency, ratio.min(axis=1)
    return Stability(chokes, lifts, *(values.reshape(len(lifts), len(chokes)) for values in found))


def _grid(chokes: np.ndarray, lifts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choke and lift of every point of a grid that is within their ranges, lift by lift."""
    check_inputs(chokes, lifts)
    lift, choke = np.meshgrid(lifts, chokes, indexing="ij")
    return choke.ravel(), lift.ravel()


@jax.jit
def _steady(choke, lift, parameters):
    found = jax.vmap(lambda c, q: steady_state(c, q, 0.0, parameters))(choke, lift)
    return found.outputs.cv, found.converged


def steady_sweep(plant: Any = None, chokes: ArrayLike | None = None, lifts: ArrayLike = LIFTS) -> SteadySweep:
    """Steady states over a grid, and the step coefficients between neighbouring choke positions.

    Args:
        plant: a `WellPlant` (the default) or an `identify.fmu.FmuPlant`.
        chokes: increasing positions [%], two or more; by default 2, 4, ... 100 %.
        lifts: rates [m3/h]; by default 5000, 7500 and 10000.

    Raises:
        InputError: for inputs outside their range or chokes that do not increase.
    """
    plant = WellPlant() if plant is None else plant
    chokes = np.arange(2.0, 101.0, 2.0) if chokes is None else np.asarray(chokes, dtype=np.float64)
    lifts = np.atleast_1d(np.asarray(lifts, dtype=np.float64))
    choke, lift = _grid(chokes, lifts)
    if chokes.ndim != 1 or len(chokes) < 2 or (np.diff(chokes) <= 0).any():
        raise InputError("chokes", chokes.tolist(), "two or more increasing positions [%]")
    if isinstance(plant, WellPlant):
        cv, converged = _steady(jnp.asarray(choke), jnp.asarray(lift), plant.parameters)
    else:
        settled = [
            (plant.init(float(c), float(q)).cv, plant.settled) for c, q in zip(choke, lift, strict=True)
        ]
        cv, converged = zip(*settled, strict=True)
    shape = len(lifts), len(chokes)
    cv = np.moveaxis(np.asarray(cv).reshape(*shape, 2), -1, 0)
    coefficient = np.diff(cv, axis=-1) / np.diff(chokes)
    return SteadySweep(chokes, lifts, cv, coefficient, np.asarray(converged).reshape(shape))
