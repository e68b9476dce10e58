"""Working points of the shipped well: steps of its step tests, grids of its sweeps, maps and schedules, forbidden lift."""

from __future__ import annotations

TEST_STEPS = (2.0, 100.0)  # of the choke [%] and of the lift [m3/h], as in the thesis

CHOKES = tuple(float(choke) for choke in range(2, 101, 2))  # %, the positions of the step choke
SWEEP = {"choke": CHOKES, "gas_lift": (5000.0, 7500.0, 10_000.0)}  # %, m3/h; the curves of figures 10 and 11

# The grid has the positions of the 2 % step choke, so that the map is exact there, and is finer where the gain of the lift
# changes most.
STEADY_MAP = {
    "choke": CHOKES,
    "gas_lift": (0.0, 500.0, 1000.0, 1500.0, *(1000.0 * k for k in range(2, 11))),
}

LIFT_RANGES = ((0.0, 0.0), (2000.0, 10_000.0))  # m3/h: no lift, or enough of it not to slug (thesis 6.7.1)
