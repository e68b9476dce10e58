"""The steady map of a plant, for the real-time optimisation of thesis 6.7: steady CVs over two MVs.

`jaxmpc.steady.optimise` optimises over it. Where an MV stands on whole steps, a grid of its positions makes the map exact.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from identify.sweep import steady_sweep
from identify.working_point import Values, facts_of
from jaxmpc.process.plant import Signals
from jaxmpc.steady.map import SteadyMap


def steady_map(
    plant: Any,
    grid: Mapping[str, ArrayLike],
    *,
    working_point: Values | None = None,
    signals: Signals | None = None,
) -> SteadyMap:
    """Steady CVs over a grid of two MVs.

    Args:
        plant: one that finds its steady states, as for `identify.sweep.steady_sweep`, as are the other arguments.
        grid: by MV name two or more increasing values of two MVs [MV unit].

    Returns:
        `SteadyMap`, NaN where no steady state was found.

    Raises:
        InputError: as for `steady_sweep`, and for grids that do not increase.
    """
    sweep = steady_sweep(plant, grid, working_point=working_point, signals=signals)
    units = dict(zip(sweep.signals.mv_names, sweep.signals.mv_units, strict=False))
    facts = facts_of(plant)
    return SteadyMap(
        grid=sweep.grid,
        cv=np.where(sweep.converged, sweep.cv, np.nan),
        cv_names=sweep.signals.cv_names,
        cv_units=sweep.signals.cv_units,
        mv_units=tuple(units.get(name, "") for name in sweep.grid),
        provenance={"plant": facts["kind"], "hash": facts["hash"]},
    )
