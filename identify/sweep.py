"""Steady-state step coefficients over the choke range: thesis 4.1.1, figures 10 and 11.

For each lift rate, the gain of a 2 % choke step from each choke position, computed from steady states. On the
JAX well steady states are solved in batches; on the FMU each is settled by simulation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxmpc.errors import InputError
from jaxmpc.process.well.equations import CV_NAMES
from jaxmpc.process.well.plant import WellPlant, check_inputs, steady_state
from jaxmpc.programs.lanes import in_pieces

LIFTS = (5000.0, 7500.0, 10000.0)  # m3/h, the three curves of figures 10 and 11
POINTS = 50  # of one call, so that all grids are solved by one program


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


def _steady(choke, lift, parameters):
    """Steady CVs ``"point cv"`` and whether they were found."""
    return in_pieces(lambda *some: _some_steady(*some, parameters), POINTS, choke, lift)


@jax.jit
def _some_steady(choke, lift, parameters):
    found = jax.vmap(lambda c, q: steady_state(c, q, 0.0, parameters))(choke, lift)
    return found.outputs.cv, found.converged


def steady_sweep(plant: Any = None, chokes: ArrayLike | None = None, lifts: ArrayLike = LIFTS) -> SteadySweep:
    """Steady states over a grid, and the step coefficients between neighbouring choke positions.

    Args:
        plant: a `WellPlant` (the default) or an `identify.well_fmu.WellFmuPlant`.
        chokes: increasing positions [%], two or more; by default 2, 4, ... 100 %.
        lifts: rates [m3/h]; by default 5000, 7500 and 10000.

    Raises:
        InputError: for inputs outside their range or chokes that do not increase.
    """
    plant = WellPlant() if plant is None else plant
    chokes = np.arange(2.0, 101.0, 2.0) if chokes is None else np.asarray(chokes, dtype=np.float64)
    lifts = np.atleast_1d(np.asarray(lifts, dtype=np.float64))
    check_inputs(chokes, lifts)
    lift, choke = (grid.ravel() for grid in np.meshgrid(lifts, chokes, indexing="ij"))  # lift by lift
    if chokes.ndim != 1 or len(chokes) < 2 or (np.diff(chokes) <= 0).any():
        raise InputError("chokes", chokes.tolist(), "two or more increasing positions [%]")
    if isinstance(plant, WellPlant):
        cv, converged = _steady(choke, lift, plant.parameters)
    else:
        settled = [
            (plant.init(float(c), float(q)).cv, plant.settled) for c, q in zip(choke, lift, strict=True)
        ]
        cv, converged = zip(*settled, strict=True)
    shape = len(lifts), len(chokes)
    cv = np.moveaxis(np.asarray(cv).reshape(*shape, 2), -1, 0)
    coefficient = np.diff(cv, axis=-1) / np.diff(chokes)
    return SteadySweep(chokes, lifts, cv, coefficient, np.asarray(converged).reshape(shape))
