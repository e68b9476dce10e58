"""References of the shipped studies: the 22-hour run of the thesis (chapter 7) on our well, and a short cut.

Gas and oil setpoints change together. Most targets lie between two choke positions on purpose: a controller
that knows nothing of the step choke then hunts between the two.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

from jaxmpc.process.reference import Reference

# start [s], gas rate [m3/h], oil rate [m3/h]
THESIS_WINDOWS = (
    (0, 11013, 185),  # the working point
    (6000, 12600, 175),  # about 30 % / 10000 m3/h
    (12000, 14000, 205),  # large choke, high lift
    (18000, 8430, 173),  # about 70 % / 5000
    (24000, 9640, 152),  # 21 % / 7500
    (30000, 6995, 133),  # 19 % / 5000
    (36000, 8160, 166),  # 51 % / 5000
    (42000, 7000, 170),  # out of reach together
    (48000, 5870, 100.6),  # near closed, 9 % / 5000
    (54000, 5445, 88),  # nearly closed, 7 % / 5000
    (60000, 10260, 167),  # 31 % / 7500
    (66000, 9000, 185),  # out of reach together
    (72000, 16500, 230),  # saturates both inputs
)
THESIS_DURATION = 78_000.0

# Closes to 21 %, then to 9 %, where rounding hunts; then a target that saturates both inputs, so that the
# choke opens all the way under the mean-move limit.
QUICK_WINDOWS = ((0, 9640, 152), (3600, 5870, 100.6), (8400, 16500, 230))
QUICK_DURATION = 12_000.0

REGION_DURATION = 18_000.0
REGIONS = {  # three targets of the thesis run with the choke in one part of its range, of equal length
    "wide-open": ((0, 8430, 173), (6000, 14000, 205), (12000, 16500, 230)),  # 70 % and more
    "mid-choke": ((0, 12600, 175), (6000, 8160, 166), (12000, 10260, 167)),  # 30 to 51 %
    "nearly-closed": ((0, 6995, 133), (6000, 5870, 100.6), (12000, 5445, 88)),  # 19 % down to 7 %
}


def from_windows(windows: Sequence[Sequence[float]], duration: float) -> Reference:
    """A reference from rows of start [s] and one setpoint per CV."""
    return Reference([row[0] for row in windows], [row[1:] for row in windows], duration)


def thesis() -> Reference:
    """The thesis run: 13 windows of 6,000 s, 7,800 samples of 10 s; CV order gas, oil [m3/h]."""
    return from_windows(THESIS_WINDOWS, THESIS_DURATION)


def quick() -> Reference:
    """Three windows, 1,200 samples of 10 s, that show the same effects; CV order gas, oil [m3/h]."""
    return from_windows(QUICK_WINDOWS, QUICK_DURATION)


# What a study definition calls them.
NAMED: dict[str, Callable[[], Reference]] = {
    "thesis": thesis,
    "quick": quick,
    **{name: functools.partial(from_windows, rows, REGION_DURATION) for name, rows in REGIONS.items()},
}
