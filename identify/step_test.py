"""Identification by step tests: thesis 4.1, (4.2)-(4.3).

The plant is settled at a working point, each MV is stepped alone and held, and the responses are divided by
the step. Any plant with `init`, `step` and `measure` will do: the JAX well and the FMU give the same model.
"""

from __future__ import annotations

import dataclasses
import datetime
import itertools
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmpc.errors import InputError
from jaxmpc.model.step_response import StepResponseModel, make_model
from jaxmpc.process.well.equations import (
    CV_NAMES,
    CV_UNITS,
    DEFAULT_CHOKE,
    DEFAULT_LIFT,
    MV_NAMES,
    MV_UNITS,
    well_hash,
)
from jaxmpc.process.well.plant import WellPlant, check_inputs

SETTLE_SAMPLES = 60  # held at the working point before a step
PIECE = 64  # samples of one call, so that all lengths are run by one program
SETTLED_SHARE = 0.01  # of the largest coefficient; a settled response moves less over its last tenth


class Settling(NamedTuple):
    """How far one response had come by the last sample.

    Attributes:
        cv, mv: names.
        settled: whether it moved by less than 1 % of its largest value over the last tenth of the samples.
        movement: that movement as a share of the largest value [1].
        gain: S(N) [CV unit per MV unit].
        peak: the coefficient that is largest in magnitude [CV unit per MV unit].
        settling_time: from when on it stays within 2 % of the peak around S(N) [s].
    """

    cv: str
    mv: str
    settled: bool
    movement: float
    gain: float
    peak: float
    settling_time: float


def settling(model: StepResponseModel) -> list[Settling]:
    """Whether each response of a model had settled by its last sample; see `Settling`."""
    found = []
    for (i, cv), (j, mv) in itertools.product(enumerate(model.cv_names), enumerate(model.mv_names)):
        s = np.asarray(model.coefficients[i, j])
        gain, peak = float(s[-1]), float(s[np.argmax(np.abs(s))])
        tail = s[-max(2, len(s) // 10) :]
        movement = float(np.ptp(tail) / max(abs(peak), 1e-300)) if len(s) > 1 else 1.0
        outside = np.flatnonzero(np.abs(s - gain) > 0.02 * abs(peak))
        time = (int(outside[-1]) + 2 if outside.size else 1) * model.dt
        found.append(Settling(cv, mv, movement < SETTLED_SHARE, movement, gain, peak, time))
    return found


def identity(plant: Any) -> tuple[str, str]:
    """What a plant is, ``jax`` or ``fmu``, and a digest of everything that decides its responses."""
    if isinstance(plant, WellPlant):
        return "jax", well_hash(plant.parameters)
    return "fmu", plant.token


def settling_notes(model: StepResponseModel) -> list[str]:
    """One sentence per response that had not settled by sample N; empty if all had."""
    return [
        f"{row.cv} after a step of {row.mv} had not settled by sample {model.samples}: it still moved by "
        f"{100 * row.movement:.1f} % of its largest value over the last tenth of the samples"
        for row in settling(model)
        if not row.settled
    ]


def apply_sequence(
    plant: Any, choke: float, lift: float, demands: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Start a plant at a working point, choke [%] and lift [m3/h], and apply demands ``"sample 2"`` to it.

    The plant is a `WellPlant`, or any on the host with ``init(choke, lift)`` and ``step(mv)``.

    Returns:
        ``(cv, mv)``: measurements and applied inputs at the end of each sample, both ``"sample 2"``.
    """
    if isinstance(plant, WellPlant):
        state, pieces = plant.init(choke, lift), []
        held = np.pad(demands, ((0, -len(demands) % PIECE), (0, 0)), mode="edge")
        for begin in range(0, len(held), PIECE):
            state, outputs = _run(plant, state, held[begin : begin + PIECE])
            pieces.append((np.asarray(outputs.cv), np.asarray(outputs.mv)))
        cv, mv = (np.concatenate(parts)[: len(demands)] for parts in zip(*pieces, strict=True))
        return cv, mv
    plant.init(choke, lift)
    outputs = [plant.step(demand) for demand in demands]
    return np.array([o.cv for o in outputs]), np.array([o.mv for o in outputs])


@jax.jit
def _run(plant, state, demands):
    return plant.run(state, demands)


def identify_step_response(
    plant: Any = None,
    choke: float = DEFAULT_CHOKE,
    lift: float = DEFAULT_LIFT,
    steps: tuple[float, float] = (2.0, 100.0),
    samples: int = 250,
) -> StepResponseModel:
    """Identify a step-response model by stepping each MV alone, (4.2)-(4.3).

    Args:
        plant: a `WellPlant` (the default) or an `identify.well_fmu.WellFmuPlant`; its `dt` is the model's.
        choke: position at the working point [%].
        lift: lift rate at the working point [m3/h].
        steps: of the choke [%] and of the lift [m3/h], not zero.
        samples: N, the number of coefficients; S(1) is the change at the first sample after the step.

    Returns:
        The model, with units, working point (MVs and settled CVs), and as provenance the kind and hash of the
        plant, the steps, the date, and a note for each response that had not settled by sample N.

    Raises:
        InputError: for inputs outside their range, before anything is simulated; or if the actuator does not
            make the step (a step choke needs at least 1.6 %, and goes to the nearest 2 % position).
    """
    plant = WellPlant() if plant is None else plant
    check_inputs(choke, lift)
    if isinstance(samples, bool) or not isinstance(samples, int) or samples < 1:
        raise InputError("samples", samples, "a whole number of 1 or more")
    if np.shape(steps) != (2,) or not np.isfinite(steps).all() or 0.0 in tuple(steps):
        raise InputError("steps", steps, "two finite steps that are not zero: choke [%] and lift [m3/h]")
    check_inputs(choke + steps[0], lift + steps[1])

    point = np.array([choke, lift], dtype=np.float64)
    responses, base = [], np.zeros(2)
    for j, step in enumerate(steps):
        demands = np.tile(point, (SETTLE_SAMPLES + samples, 1))
        demands[SETTLE_SAMPLES:, j] += step
        cv, mv = apply_sequence(plant, choke, lift, demands)
        made = mv[-1] - point
        if abs(made[j] - step) > 1e-9 * max(1.0, abs(step)):
            expected = f"a step that the actuator makes ({MV_NAMES[j]} moved {made[j]})"
            raise InputError(f"steps[{j}]", step, expected)
        base = cv[SETTLE_SAMPLES - 1]
        responses.append((cv[SETTLE_SAMPLES:] - base).T / step)
    kind, digest = identity(plant)
    facts = {
        "plant": kind,
        "plant_hash": digest,
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "steps": [float(step) for step in steps],
    }
    found = dict(zip((*MV_NAMES, *CV_NAMES), (choke, lift, *base.tolist()), strict=True))
    units: dict[str, Any] = {"cv_units": CV_UNITS, "mv_units": MV_UNITS}
    coefficients = np.stack(responses, axis=1)
    model = make_model(
        coefficients, plant.dt, CV_NAMES, MV_NAMES, **units, working_point=found, provenance=facts
    )
    notes = tuple(settling_notes(model))
    return dataclasses.replace(
        model, provenance=(*model.provenance, ("settled", not notes), ("notes", notes))
    )
