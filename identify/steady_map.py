"""The steady map of a well, for the real-time optimisation of thesis 6.7: steady rates over choke and lift.

`jaxmpc.steady.optimise` optimises over it; the grid has the positions of the 2 % step choke, so that the map is exact there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from identify.step_test import identity
from identify.sweep import steady_sweep
from jaxmpc.process.well.equations import CV_NAMES, CV_UNITS, MV_NAMES, MV_UNITS
from jaxmpc.process.well.plant import WellPlant
from jaxmpc.steady.map import SteadyMap

CHOKES = np.arange(2.0, 101.0, 2.0)  # %, the positions of the step choke
LIFTS = np.r_[0.0:2000.0:500.0, 2000.0:10_001.0:1000.0]  # m3/h, finer where the gain of the lift changes most


def steady_map(
    plant: Any = None, chokes: ArrayLike | None = None, lifts: ArrayLike | None = None
) -> SteadyMap:
    """Steady gas and oil rate over a grid of choke positions and lift rates.

    Args:
        plant: a `WellPlant` (the default) or an `identify.well_fmu.WellFmuPlant`.
        chokes: two or more increasing positions [%]; 2, 4, ... 100 % by default.
        lifts: two or more increasing rates [m3/h]; 0 to 10000 by default.

    Returns:
        `SteadyMap`, NaN where no steady state was found.

    Raises:
        InputError: for inputs outside their range or grids that do not increase.
    """
    plant = WellPlant() if plant is None else plant
    chokes = np.asarray(CHOKES if chokes is None else chokes)
    lifts = np.atleast_1d(LIFTS if lifts is None else lifts)
    sweeps = [steady_sweep(plant, chokes, [lift]) for lift in lifts]  # a call of its program each
    cv = np.concatenate([np.where(sweep.converged, sweep.cv, np.nan) for sweep in sweeps], axis=1)
    kind, digest = identity(plant)
    return SteadyMap(
        choke=chokes,
        lift=lifts,
        cv=cv,
        cv_names=CV_NAMES,
        mv_names=MV_NAMES,
        cv_units=CV_UNITS,
        mv_units=MV_UNITS,
        provenance={"plant": kind, "hash": digest},
    )
