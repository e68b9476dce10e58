"""Identification of a gain schedule (thesis chapter 8): step tests at many working points, in both directions.

Where a gain falls by a third within one step of an actuator, the response depends on the direction, and the controller has
one model for both. The mean of the two is the central difference, whose error is of second order in the step; steps as large
as those of the actuator average the curvature over one step and do not extrapolate it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from identify.step_test import identify_step_response
from identify.working_point import Values, point_of, signals_of
from jaxmpc.controller.schedule import ModelSchedule, make_schedule
from jaxmpc.errors import InputError
from jaxmpc.process.plant import Signals


def identify_schedule(
    plant: Any,
    grid: Mapping[str, Sequence[float]],
    steps: Values | None = None,
    samples: int = 250,
    *,
    working_point: Values | None = None,
    signals: Signals | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ModelSchedule:
    """Step-response models over a grid of working points, each the mean of steps up and down.

    Args:
        plant: as for `identify.step_test.identify_step_response`, as are `steps`, `samples` and `signals`.
        grid: by the name of one or two MVs, where they stand [MV unit].
        working_point: where the other MVs stand [MV unit]; as the plant has them by default.
        progress: called with ``(done, total)`` working points.

    Raises:
        InputError: for an unknown MV, empty or repeated values, or a step that leaves the range of an MV, before anything
            is simulated at that point.
    """
    signals = signals_of(plant, signals)
    names = signals.mv_names
    if not isinstance(grid, Mapping) or len(grid) not in (1, 2) or not {*grid} <= {*names}:
        raise InputError("grid", grid, f"the values of one or two of the MVs {', '.join(names)}")
    for name, values in grid.items():
        if not len(values) or len(set(values)) != len(values):
            raise InputError(f"grid.{name}", list(values), "one or more distinct values")
    point = point_of(plant, signals, working_point)
    models, places = [], list(itertools.product(*grid.values()))
    for place in places:
        point[[names.index(name) for name in grid]] = place
        models.append(identify_step_response(plant, point, steps, samples, both_ways=True, signals=signals))
        if progress is not None:
            progress(len(models), len(places))
    return make_schedule(models, [name for name in names if name in grid])
