"""Numbers that captions say: how often a choke turns back, what a run settles at, and how they are written."""

from __future__ import annotations

import numpy as np
import xarray as xr

from studies.kpi import loop as kpi
from studies.thesis.catalogue import PLANTS
from studies.thesis.well import CHOKE, GAS, OIL

LATE = 600.0  # s at the end of a stretch that stand for what it settles at


def about(quick: bool, plant: str) -> str:
    """What the figures of the thesis are of, for a page with all of them."""
    length = "shortened studies" if quick else "full studies"
    well = "an FMU of the well" if plant == PLANTS[0] else "the JAX twin of the well"
    return (
        "Model predictive control with a discrete choke on a gas-lifted oil well: the figures of the thesis, drawn from "
        f"our own runs ({length}, {well})."
    )


def oil_first(data: xr.Dataset) -> xr.Dataset:
    """The results with their CVs in the order of the thesis's panels: oil above gas."""
    return data.sel(cv=[OIL, GAS])


def choke_moves(data: xr.Dataset, controller: str) -> np.ndarray:
    """Moves of the actual choke position, ``"sample"`` [%]; none in the first sample of a part of a run."""
    run = data.sel(controller=controller, mv=CHOKE)
    position = run.position.values
    whole = float(data.time.values[0]) == 0.0
    start = run.demand.values[0] - run.move.values[0] if whole else position[0]  # as in the key figures
    return np.asarray(kpi.moves_of(position, start))


def reversals(data: xr.Dataset, controller: str) -> int:
    """How often the choke reverses."""
    return int(np.asarray(kpi.reversal_events(choke_moves(data, controller))).sum())


def turns(data: xr.Dataset, controller: str, segment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choke reversals within each segment, ``"time"``, and the position of the choke [%]."""
    position = data.position.sel(controller=controller, mv=CHOKE).values
    move = np.diff(position, prepend=position[:1])
    return np.asarray(kpi.reversal_events(move, segment=segment)), position


def times(count: int) -> str:
    """How often, in words."""
    return {0: "never", 1: "once", 2: "twice"}.get(count, f"{count} times")


def settled(data: xr.Dataset, controller: str) -> dict[str, float]:
    """Mean deviation from the setpoint in the last `LATE` seconds, by CV [CV unit]."""
    run = data.sel(controller=controller)
    away = (run.measurement - run.setpoint).isel(time=data.time.values > data.time.values[-1] - LATE)
    return {str(cv): float(away.sel(cv=cv).mean()) for cv in away.cv.values}
