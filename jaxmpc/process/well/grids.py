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

# The gas gain of the choke falls from 250 to 60 m3/h per % between 7 and 20 %, and more slowly beyond. Linear interpolation
# between these positions keeps the gains of the choke within 8 % and those of the lift within 12 % of what is
# identified in between.
SCHEDULE = {
    "choke": (4.0, 6.0, 8.0, 10.0, 13.0, 17.0, 22.0, 30.0, 45.0, 60.0, 75.0, 90.0),
    "gas_lift": (2500.0, 5000.0, 7500.0, 10_000.0),
}

LIFT_RANGES = ((0.0, 0.0), (2000.0, 10_000.0))  # m3/h: no lift, or enough of it not to slug (thesis 6.7.1)
