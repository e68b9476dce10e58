"""Step-response models of a sweep study: each working point once, on the plant of the process with its own parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from identify.plants import model_of, open_plant
from identify.working_point import check_mv, own_start
from jaxmpc.check import require
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.process import Process

Point = tuple[float, ...]  # a value per MV [MV unit]; empty where the model is given


def identify_models(
    process: Process, points: Iterable[Point], *, progress: Callable[[int, int], None] | None = None
) -> dict[Point, StepResponseModel]:
    """Models of a process by working point, in the order of first appearance.

    Args:
        progress: called with ``(done, total)`` models.

    Raises:
        InputError: naming the working point, for one outside its range (the step test goes a step further) or without a
            steady state; before any model is identified.
    """
    wanted = list(dict.fromkeys(tuple(map(float, point)) for point in points))
    plant = None if process.model.given else open_plant(process, actual=False)
    steps = np.array([process.model.steps.get(mv.name, 0.0) for mv in process.mvs])
    for point in wanted if plant is not None else ():
        named = zip(process.mvs, point, strict=True)
        here = ", ".join(f"model.{mv.name} = {value:g} {mv.unit}" for mv, value in named)
        try:
            check_mv(plant, np.array(point))
            check_mv(plant, np.array(point) + steps)
        except InputError as error:
            further = ", ".join(f"{step:g} {mv.unit}" for step, mv in zip(steps, process.mvs, strict=True))
            raise InputError(here, error.value, f"{error.expected}, also {further} further") from None
        if hasattr(plant, "steady") and not np.array_equal(own_start(plant)[1], point):
            settles = plant.steady(np.array(point)).converged  # type: ignore[union-attr]
            require(settles, here, "no steady state", "a working point at which the plant settles")
    out = {}
    for point in wanted:
        out[point] = model_of(process, plant, point)
        if progress is not None:
            progress(len(out), len(wanted))
    return out
