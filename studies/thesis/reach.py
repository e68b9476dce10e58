"""What is about the well in the results of the thesis: how far setpoints are out of its reach, and reversals near closed."""

from __future__ import annotations

import numpy as np
import xarray as xr

from studies.kpi import loop as kpi
from studies.kpi.evaluate import windows_of
from studies.thesis.well import CHOKE, WELL

NEAR_CLOSED = 50.0  # % choke, the border in the thesis's statement on oscillation


def distance_to_reach(data: xr.Dataset, refine: int = 8) -> np.ndarray:
    """How far each setpoint pair is from the steady states of the plant, in deadzone half widths.

    The smallest over the stored steady-state map (interpolated linearly, `refine` points per cell) of the
    largest |rate - setpoint| / c over the CVs, c the half width of the deadzone.

    Returns:
        ``"window"``.
    """
    rate = data.map_rate.transpose("map_choke", "map_lift", "cv").values
    for axis in (0, 1):
        n = rate.shape[axis]
        at = np.arange((n - 1) * refine + 1) / refine
        low = np.minimum(at.astype(int), n - 2)
        share = (at - low).reshape([-1 if a == axis else 1 for a in range(3)])
        rate = np.take(rate, low, axis) * (1 - share) + np.take(rate, low + 1, axis) * share
    half = data.tuning_deadzone.isel(controller=0).values
    setpoints = data.setpoint.values[[samples[0] for samples in windows_of(data)]]
    away = np.abs(rate[None] - setpoints[:, None, None, :]) / half
    return np.nanmin(away.max(axis=-1), axis=(1, 2))


def choke_moves(run: xr.Dataset) -> np.ndarray:
    """Moves of the actual choke position, ``"sample"`` [%]; none in the first sample of a part of a run."""
    choke = run.sel(mv=CHOKE)
    position, whole = choke.position.values, float(run.time.values[0]) == 0.0
    start = choke.demand.values[0] - choke.move.values[0] if whole else position[0]  # as in the key figures
    return np.asarray(kpi.moves_of(position, start))


def turns(run: xr.Dataset, segment: np.ndarray | None = None, smallest: float = 0.0) -> np.ndarray:
    """Whether the choke turns back, both moves in one segment and larger than the smallest [%], ``"sample"``."""
    return np.asarray(kpi.reversal_events(choke_moves(run), smallest, segment=segment))


def reversals_near_closed(data: xr.Dataset, controller: str) -> int:
    """Reversals of the choke in the second halves of the setpoint windows after which it stands below `NEAR_CLOSED`."""
    run, smallest = data.sel(controller=controller), WELL.mvs[WELL.mv_names.index(CHOKE)].smallest_move
    hunting = turns(run, kpi.second_halves(data.window.values), smallest)
    return int((hunting & (run.position.sel(mv=CHOKE).values < NEAR_CLOSED)).sum())
