"""Numbers that captions say: how often a choke turns back, what a run settles at, and how they are written."""

from __future__ import annotations

import xarray as xr

from studies.thesis.catalogue import PLANTS
from studies.thesis.claims.record import late_deviation
from studies.thesis.reach import turns
from studies.thesis.well import GAS, OIL


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


def reversals(data: xr.Dataset, controller: str) -> int:
    """How often the choke reverses."""
    return int(turns(data.sel(controller=controller)).sum())


def times(count: int) -> str:
    """How often, in words."""
    return {0: "never", 1: "once", 2: "twice"}.get(count, f"{count} times")


def settled(data: xr.Dataset, controller: str) -> dict[str, float]:
    """`late_deviation` of a run by CV [CV unit]."""
    away = late_deviation(data.sel(controller=controller)).tolist()
    return dict(zip(map(str, data.cv.values), away, strict=True))
