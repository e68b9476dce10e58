"""Thesis figures 20 and 21: a close-up of the rounded controller while it oscillates.

The stretch is found in the data: the setpoint window with most choke reversals below 50 % in its second half,
and in it the time that holds up to `SWINGS` of them.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from jaxmpc.errors import InputError
from studies.kpi import loop as kpi
from studies.kpi.evaluate import NEAR_CLOSED

SWINGS = 8  # reversals to show
MARGIN = 0.1  # of the stretch, before and after
SHORTEST = 600.0  # s


def oscillating_stretch(data: xr.Dataset, controller: str) -> tuple[float, float]:
    """Start and end [s] of the stretch to show.

    Args:
        data: results.
        controller: name of the rounded controller.

    Raises:
        InputError: if the choke never reverses there.
    """
    position = data.position.sel(controller=controller, mv="choke").values
    move = np.diff(position, prepend=position[:1])
    late = kpi.second_halves(data.window.values)
    event = np.asarray(kpi.reversal_events(move, segment=late)) & (position < NEAR_CLOSED)
    counts = np.asarray(kpi.count_by_segment(event, late, int(late.max()) + 1))
    if counts.max() == 0:
        raise InputError(
            "figure 20", controller, f"a run whose choke reverses below {NEAR_CLOSED:.0f} % in some window"
        )
    window = int(counts.argmax())
    at = np.flatnonzero(event & (late == window))[:SWINGS]
    dt = float(data.attrs["dt"])
    start, end = data.time.values[at[0]], data.time.values[at[-1]] + dt
    margin = max(MARGIN * (end - start), (SHORTEST - (end - start)) / 2)
    inside = data.time.values[data.window.values == window]
    return max(start - margin, float(inside[0])), min(end + margin, float(inside[-1]) + dt)


def stretch(data: xr.Dataset, controller: str) -> xr.Dataset:
    """The controller's results in that stretch of time."""
    start, end = oscillating_stretch(data, controller)
    inside = np.flatnonzero((data.time.values >= start) & (data.time.values < end))
    return data.sel(controller=[controller]).isel(time=inside)
