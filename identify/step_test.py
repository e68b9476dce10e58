"""Identification by step tests: thesis 4.1, (4.2)-(4.3).

The plant is settled at a working point, each MV is stepped alone and held, and the responses are divided by
the step. Any plant will do: a `JaxPlant` runs in compiled pieces, any other is stepped on the host
(`identify.working_point` lists what a plant may have beyond `init` and `step`).
"""

from __future__ import annotations

import dataclasses
import datetime
import itertools
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from identify.working_point import Values, check_mv, identity, in_order, point_of, signals_of, start
from jaxmpc.check import is_count
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import StepResponseModel, make_model
from jaxmpc.process.plant import JaxPlant, Signals, disturbances_of

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


def settling_notes(model: StepResponseModel) -> list[str]:
    """One sentence per response that had not settled by sample N; empty if all had."""
    return [
        f"{row.cv} after a step of {row.mv} had not settled by sample {model.samples}: it still moved by "
        f"{100 * row.movement:.1f} % of its largest value over the last tenth of the samples"
        for row in settling(model)
        if not row.settled
    ]


def apply_sequence(
    plant: Any, state: Any, demands: Float[np.ndarray, "sample mv"]
) -> tuple[Float[np.ndarray, "sample cv"], Float[np.ndarray, "sample mv"]]:
    """Apply demands [MV unit] to a plant, from the state of a `JaxPlant`; any other goes on from where it stands.

    Returns:
        ``(cv, mv)``: measurements and applied inputs at the end of each sample.
    """
    if isinstance(plant, JaxPlant):
        pieces = []
        held = np.pad(demands, ((0, -len(demands) % PIECE), (0, 0)), mode="edge")
        for begin in range(0, len(held), PIECE):
            state, outputs = _run(plant, state, held[begin : begin + PIECE])
            pieces.append((np.asarray(outputs.cv), np.asarray(outputs.mv)))
        cv, mv = (np.concatenate(parts)[: len(demands)] for parts in zip(*pieces, strict=True))
        return cv, mv
    undisturbed = np.zeros(len(disturbances_of(plant)))
    outputs = [plant.step(demand, undisturbed) for demand in demands]
    return np.array([o.cv for o in outputs]), np.array([o.mv for o in outputs])


@jax.jit
def _run(plant, state, demands):
    return plant.run(state, demands)


def identify_step_response(
    plant: Any,
    working_point: Values | None = None,
    steps: Values | None = None,
    samples: int = 250,
    *,
    both_ways: bool = False,
    signals: Signals | None = None,
) -> StepResponseModel:
    """Identify a step-response model by stepping each MV alone, (4.2)-(4.3).

    Args:
        plant: a `JaxPlant` or a stateful one; its `dt` is the model's.
        working_point: the MVs where the steps begin [MV unit], by name or in MV order; the plant's own by default.
        steps: of the MVs [MV unit], by name or in MV order, not zero; the plant's `test_steps` by default.
        samples: N, the number of coefficients; S(1) is the change at the first sample after the step.
        both_ways: whether each MV is stepped in both directions and the model is the mean of both, the central difference
            with an error of second order in the step.
        signals: names and units; the plant's own by default.

    Returns:
        The model, with units, working point (MVs and settled CVs), and as provenance the kind and hash of the
        plant, the steps, the date, and a note for each response that had not settled by sample N.

    Raises:
        InputError: for inputs outside their range, before anything is simulated; or if the actuator does not
            make the step (one that moves in whole steps goes to the nearest position).
    """
    signals = signals_of(plant, signals)
    point = point_of(plant, signals, working_point)
    if not is_count(samples):
        raise InputError("samples", samples, "a whole number of 1 or more")
    change = in_order("steps", getattr(plant, "test_steps", None) if steps is None else steps, signals)
    if not change.all():
        j = int(np.argmin(np.abs(change)))
        raise InputError(f"steps.{signals.mv_names[j]}", 0.0, "a step that is not zero")
    ways = [change, -change] if both_ways else [change]
    for way in ways:
        check_mv(plant, point + way)
    tests = [_responses(plant, signals, point, way, samples) for way in ways]
    coefficients = tests[0][1] if len(tests) == 1 else 0.5 * (tests[0][1] + tests[1][1])
    kind, digest = identity(plant)
    facts = {
        "plant": kind,
        "plant_hash": digest,
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "steps": np.concatenate(ways).tolist(),
    }
    names, values = (*signals.mv_names, *signals.cv_names), (*point.tolist(), *tests[0][0].tolist())
    model = make_model(
        coefficients,
        plant.dt,
        signals.cv_names,
        signals.mv_names,
        cv_units=signals.cv_units,
        mv_units=signals.mv_units,
        working_point=dict(zip(names, values, strict=True)),
        provenance=facts,
    )
    notes = tuple(settling_notes(model))
    return dataclasses.replace(
        model, provenance=(*model.provenance, ("settled", not notes), ("notes", notes))
    )


def _responses(
    plant: Any, signals: Signals, point: np.ndarray, steps: np.ndarray, samples: int
) -> tuple[Float[np.ndarray, " cv"], Float[np.ndarray, "cv mv n"]]:
    """CVs settled at a working point, and S(1)..S(N) from a step of each MV alone."""
    responses, base = [], np.zeros(0)
    for j, (name, step) in enumerate(zip(signals.mv_names, steps, strict=True)):
        state, settled = start(plant, point)
        hold = SETTLE_SAMPLES if settled else SETTLE_SAMPLES + samples
        demands = np.tile(point, (hold + samples, 1))
        demands[hold:, j] += step
        cv, mv = apply_sequence(plant, state, demands)
        made = mv[-1, j] - point[j]
        if abs(made - step) > 1e-9 * max(1.0, abs(step)):
            raise InputError(
                f"steps.{name}", float(step), f"a step that the actuator makes ({name} moved {made})"
            )
        base = cv[hold - 1]
        responses.append((cv[hold:] - base).T / step)
    return base, np.stack(responses, axis=1)
