"""A gain schedule of an FMU: step tests (`identify.fmu_steps`) at a grid of working points, for ``jaxmpc identify --at``."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from identify.fmu_description import Value
from identify.fmu_steps import StepTests
from jaxmpc.check import among, is_number
from jaxmpc.controller.schedule import ModelSchedule, make_schedule
from jaxmpc.errors import InputError
from jaxmpc.model.identification import Identification


def identify_fmu_schedule(
    path: str | Path,
    mvs: Mapping[str, tuple[Value | None, float | None]],
    cvs: Sequence[str],
    dt: float,
    samples: int,
    at: Mapping[str, Sequence[Value]],
    *,
    told: Callable[[str], None] | None = None,
    **more,
) -> tuple[ModelSchedule, dict[str, Identification]]:
    """A gain schedule: models as of `identify_fmu` over a grid of one or two of the MVs, from steps up and down.

    Returns:
        The schedule, and what was found at each place of the grid, by its words.

    Raises:
        InputError: as `identify_fmu`, and for a grid that is none.
    """
    if len(at) not in (1, 2):
        raise InputError("--at", list(at), f"values of one or two of the MVs {', '.join(mvs)}")
    for mv, values in at.items():
        among("--at", mv, mvs, "one of the MVs")
        if len(values) < 2 or len(set(values)) != len(values):
            raise InputError(f"--at {mv}", list(values), "two or more distinct values")
    places = [dict(zip(at, values, strict=True)) for values in itertools.product(*at.values())]

    def tests(place: Mapping[str, Value]) -> StepTests:
        there = {mv: (place.get(mv, value), step) for mv, (value, step) in mvs.items()}
        return StepTests(path, there, cvs, dt, samples, told=told, ways=("up", "down"), **more)

    prepared = [tests(place) for place in places]  # all are checked before any is simulated
    names = [one.channel for one in prepared[0].inputs if one.variable.name in at]
    found = {}
    for number, (place, one) in enumerate(zip(places, prepared, strict=True), 1):
        one.tell(f"working point {number} of {len(places)}")
        words = ", ".join(
            f"{name} = {value:g}" if is_number(value) else f"{name} = {value}"
            for name, value in zip(names, place.values(), strict=True)
        )
        found[words] = one.identification()
    return make_schedule([one.model for one in found.values()], names), found
