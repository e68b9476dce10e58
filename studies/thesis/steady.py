"""Steady states of the well for the results of the thesis run: the sweep over the choke (4.1.1), and a map of its reach."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from identify.sweep import steady_sweep
from jaxmpc.process.well.grids import SWEEP
from studies.run.comparison import labelled
from studies.thesis.well import CHOKE, LIFT

# Grid of the steady-state map: finer where the choke's gain is large.
MAP_CHOKE = np.r_[1.0:10.0:1.0, 10.0:30.0:2.0, 30.0:101.0:5.0]  # %
MAP_LIFT = np.r_[0.0:10_001.0:1000.0]  # m3/h


def steady_variables(plant: Any) -> dict[str, xr.DataArray]:
    """Steady states of the well for the results: the sweep of 4.1.1 and a map over choke and lift.

    Returns:
        ``sweep_coefficient`` over ``cv, sweep_lift, sweep_choke`` (figures 10 and 11) and ``map_rate`` over
        ``cv, map_lift, map_choke``, NaN where no steady state was found.
    """
    sweep, grid = steady_sweep(plant, SWEEP), steady_sweep(plant, {CHOKE: MAP_CHOKE, LIFT: MAP_LIFT})
    found = sweep.converged[:, 1:] & sweep.converged[:, :-1]
    change = np.where(found, sweep.coefficient, np.nan)
    words = "steady change of the CV per choke change, from here to the next position"
    rate = np.where(grid.converged, grid.cv, np.nan)
    from_here = sweep.grid | {CHOKE: sweep.grid[CHOKE][:-1]}
    return {
        "sweep_coefficient": over_inputs("sweep", from_here, change, words, "cv_unit per %"),
        "map_rate": over_inputs("map", grid.grid, rate, "steady CV", "cv_unit"),
    }


def over_inputs(
    prefix: str, grid: Mapping[str, np.ndarray], values: np.ndarray, words: str, unit: str
) -> xr.DataArray:
    """Values ``"cv lift choke"`` of the results over axes of their own, ``PREFIX_lift`` [m3/h] and ``PREFIX_choke`` [%]."""
    x, y = f"{prefix}_choke", f"{prefix}_lift"
    axes = {x: (grid[CHOKE], "choke", "%"), y: (grid[LIFT], "gas lift", "m3/h")}
    return labelled(values, ("cv", y, x), words, unit, **axes)
