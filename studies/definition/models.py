"""Step-response models of a sweep study: identified on the nominal well, each working point once."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from identify.step_test import identify_step_response
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.well.equations import WellParameters
from jaxmpc.process.well.grids import TEST_STEPS
from jaxmpc.process.well.plant import WellPlant, check_inputs, steady_state_of
from studies.definition.refusing import require

Point = tuple[float, float]
STEPS = TEST_STEPS  # of the choke [%] and of the gas lift [m3/h]
SAMPLES = 250  # coefficients of a model


def identify_models(
    points: Iterable[Point], samples: int = SAMPLES, *, progress: Callable[[int, int], None] | None = None
) -> dict[Point, StepResponseModel]:
    """Models of the shipped well by working point ``(choke [%], gas lift [m3/h])``, in the order of first appearance.

    Args:
        samples: number of coefficients N.
        progress: called with ``(done, total)`` models.

    Raises:
        InputError: naming the working point, for one outside its range (the step test goes 2 % and 100 m3/h further) or
            without a steady state; before any model is identified.
    """
    wanted = list(dict.fromkeys((float(choke), float(lift)) for choke, lift in points))
    for choke, lift in wanted:
        here = f"model.choke = {choke:g} %, model.lift = {lift:g} m3/h"
        try:
            check_inputs(choke, lift)
            check_inputs(choke + STEPS[0], lift + STEPS[1])
        except InputError as error:
            expected = f"{error.expected}, also {STEPS[0]:g} % and {STEPS[1]:g} m3/h further"
            raise InputError(here, error.value, expected) from None
        settles = steady_state_of(choke, lift, 0.0, WellParameters()).converged
        require(settles, here, "no steady state", "a working point at which the well settles")
    out = {}
    for choke, lift in wanted:
        out[choke, lift] = identify_step_response(WellPlant(), (choke, lift), STEPS, samples)
        if progress is not None:
            progress(len(out), len(wanted))
    return out
