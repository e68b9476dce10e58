"""Numbers that captions say: how often a choke turns back, what a run settles at, and how they are written."""

from __future__ import annotations

import numpy as np
import xarray as xr

from studies.definition.presets import CHOKE, GAS, OIL
from studies.kpi import loop as kpi

LATE = 600.0  # s at the end of a stretch that stand for what it settles at


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


def deviation(data: xr.Dataset, controller: str, cv: str) -> float:
    """Mean absolute deviation from the setpoint [CV unit]."""
    run = data.sel(controller=controller, cv=cv)
    return float(np.abs(run.measurement - run.setpoint).mean())


def times(count: int) -> str:
    """How often, in words."""
    return {0: "never", 1: "once", 2: "twice"}.get(count, f"{count} times")


def signed(value: float, form: str) -> str:
    """A number with its sign, format `form`."""
    return f"{value:+{form}}".replace("-", "−")


def index_of(names: xr.DataArray, name: str) -> int:
    """Position of a name in a coordinate."""
    return [str(known) for known in names.values].index(name)


def late(data):
    """The last `LATE` seconds of results or of a variable."""
    return data.isel(time=np.flatnonzero(data.time.values > data.time.values[-1] - LATE))


def setpoint_after(data: xr.Dataset, time: float) -> dict[str, float]:
    """Setpoints of the sample at a time [s], by CV."""
    row = data.setpoint.isel(time=int(np.searchsorted(data.time.values, time)))
    return {cv: float(row.sel(cv=cv)) for cv in (GAS, OIL)}
