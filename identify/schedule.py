"""Identification of a gain schedule (thesis chapter 8): step tests at many working points, in both directions.

The choke's gain falls by a third within the 2 % of one step near closed, so that the response depends on the direction: at
9 % and 5000 m3/h a step up changes the gas rate by 164, a step down by 213 m3/h per %. The controller has one model for
both. The mean of the two is the central difference, whose error is of second order in the step; the steps are as large
as those of the step choke, so that the curvature over one step is averaged and not extrapolated.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any

from identify.step_test import identify_step_response, settling_notes
from jaxmpc.controller.schedule import ModelSchedule, make_schedule
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.well.plant import WellPlant

# The gas gain of the choke falls from 250 to 60 m3/h per % between 7 and 20 %, and more slowly beyond. Linear interpolation
# between these positions keeps the gains of the choke within 8 % and those of the lift within 12 % of what is
# identified in between.
CHOKES = (4.0, 6.0, 8.0, 10.0, 13.0, 17.0, 22.0, 30.0, 45.0, 60.0, 75.0, 90.0)  # %
LIFTS = (2500.0, 5000.0, 7500.0, 10_000.0)  # m3/h


def identify_schedule(
    plant: Any = None,
    chokes: Sequence[float] = CHOKES,
    lifts: Sequence[float] = LIFTS,
    steps: tuple[float, float] = (2.0, 100.0),
    samples: int = 250,
    progress: Callable[[int, int], None] | None = None,
) -> ModelSchedule:
    """Step-response models over a grid of working points, each the mean of steps up and down.

    Args:
        plant: a `WellPlant` (the default) or an `identify.well_fmu.WellFmuPlant`.
        chokes: positions [%].
        lifts: lift rates [m3/h].
        steps: of the choke [%] and of the lift [m3/h], positive.
        samples: N, the number of coefficients.
        progress: called with ``(done, total)`` working points.

    Raises:
        InputError: for empty or repeated positions, steps that are not positive, or a step that leaves the range of an MV,
            before anything is simulated at that point.
    """
    plant = WellPlant() if plant is None else plant
    for key, values in (("chokes", chokes), ("lifts", lifts)):
        if not len(values) or len(set(values)) != len(values):
            raise InputError(key, list(values), "one or more distinct positions")
    if min(steps) <= 0:
        raise InputError("steps", steps, "two positive steps: choke [%] and lift [m3/h]")
    models, points = [], list(itertools.product(chokes, lifts))
    for choke, lift in points:
        models.append(both_ways(plant, float(choke), float(lift), steps, samples))
        if progress is not None:
            progress(len(models), len(points))
    return make_schedule(models)


def both_ways(
    plant: Any, choke: float, lift: float, steps: tuple[float, float] = (2.0, 100.0), samples: int = 250
) -> StepResponseModel:
    """The mean of the step responses up and down at one working point; arguments as in `identify_schedule`."""
    up = identify_step_response(plant, choke, lift, steps, samples)
    down = identify_step_response(plant, choke, lift, (-steps[0], -steps[1]), samples)
    mean = dataclasses.replace(up, coefficients=0.5 * (up.coefficients + down.coefficients))
    notes = settling_notes(mean)
    facts = dict(up.provenance) | {
        "steps": (*steps, -steps[0], -steps[1]),
        "settled": not notes,
        "notes": tuple(notes),
    }
    return dataclasses.replace(mean, provenance=tuple(facts.items()))
