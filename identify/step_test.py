"""Identification by step tests: thesis 4.1, (4.2)-(4.3).

The plant is settled at a working point, each MV is stepped alone and held, and the responses are divided by
the step. Any plant will do: a `JaxPlant` runs in compiled pieces, any other is stepped on the host
(`identify.working_point` lists what a plant may have beyond `init` and `step`).
"""

from __future__ import annotations

import dataclasses
import datetime
import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from identify.working_point import Values, check_mv, facts_of, in_order, point_of, signals_of, start, units_of
from jaxmpc.check import is_count, is_number
from jaxmpc.errors import InputError, near
from jaxmpc.model.step_response import StepResponseModel, make_model
from jaxmpc.process.plant import JaxPlant, Signals, disturbances_of

SETTLE_SAMPLES = 60  # held at the working point before a step
PIECE = 64  # samples of one call, so that all lengths are run by one program
SETTLED_SHARE = 0.01  # of the largest coefficient; a settled response moves less over its last tenth


class Settling(NamedTuple):
    """How far one response had come by the last sample.

    Attributes:
        cv, mv: names, of the MV or DV that was stepped.
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
    responses = model.responses
    for (i, cv), (j, mv) in itertools.product(enumerate(model.cv_names), enumerate(model.input_names)):
        s = responses[i, j]
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


def response_words(row: Settling, s: Float[np.ndarray, " n"], per: str, dt: float) -> str:
    """Gain, dead time and settling time of a response in words, and whether it starts in the other direction.

    Args:
        row: how far it has come.
        s: S(1)..S(N) [CV unit per input unit].
        per: that unit, with a space before it.
        dt: sampling interval [s].
    """
    begin = int(np.argmax(np.abs(s) > 0.02 * np.abs(s).max()))
    ends = f"settled after {row.settling_time:g} s" if row.settled else f"at {row.gain:.4g}{per} in the end"
    gain = f"gain {row.gain:.4g}{per}, " if row.settled else ""
    inverse = "; it starts in the other direction (inverse response)" if row.gain * s[begin] < 0 else ""
    return f"{gain}dead time {begin * dt:g} s, {ends}{inverse}"


def apply_sequence(
    plant: Any,
    state: Any,
    demands: Float[np.ndarray, "sample mv"],
    disturbances: Float[np.ndarray, "sample disturbance"],
) -> tuple[Float[np.ndarray, "sample cv"], Float[np.ndarray, "sample mv"]]:
    """Apply demands [MV unit] and disturbances to a plant, from the state of a `JaxPlant`; any other goes on from its own.

    Returns:
        ``(cv, mv)``: measurements and applied inputs at the end of each sample.
    """
    if isinstance(plant, JaxPlant):
        pieces = []
        filled = ((0, -len(demands) % PIECE), (0, 0))
        held, off = np.pad(demands, filled, mode="edge"), np.pad(disturbances, filled)
        for begin in range(0, len(held), PIECE):
            own = slice(begin, begin + PIECE)
            state, outputs = _run(plant, state, held[own], off[own])
            pieces.append((np.asarray(outputs.cv), np.asarray(outputs.mv)))
        cv, mv = (np.concatenate(parts)[: len(demands)] for parts in zip(*pieces, strict=True))
        return cv, mv
    given = (
        disturbances if hasattr(plant, "disturbance_names") else disturbances[:, 0]
    )  # a number where it has no names
    outputs = [plant.step(demand, off) for demand, off in zip(demands, given, strict=True)]
    return np.array([o.cv for o in outputs]), np.array([o.mv for o in outputs])


@jax.jit
def _run(plant, state, demands, disturbances):
    return plant.run(state, demands, disturbances)


def identify_step_response(
    plant: Any,
    working_point: Values | None = None,
    steps: Values | None = None,
    samples: int = 250,
    *,
    both_ways: bool = False,
    disturbance_steps: Mapping[str, float] | None = None,
    signals: Signals | None = None,
) -> StepResponseModel:
    """Identify a step-response model by stepping each MV and disturbance alone, (4.2)-(4.3).

    Args:
        plant: a `JaxPlant` or a stateful one; its `dt` is the model's.
        working_point: the MVs where the steps begin [MV unit], by name or in MV order; the plant's own by default.
        steps: of the MVs [MV unit], by name or in MV order, not zero; the plant's `test_steps` by default.
        samples: N, the number of coefficients; S(1) is the change at the first sample after the step.
        both_ways: whether each input is stepped in both directions and the model is the mean of both, the central difference
            with an error of second order in the step.
        disturbance_steps: by name, of the disturbances of the plant that are measured disturbances (DVs) of the model; not
            zero.
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
        raise InputError(
            f"steps.{signals.mv_names[j]}", 0.0, f"a step that is not zero [{units_of(signals)[j]}]"
        )
    sizes = _disturbance_sizes(plant, disturbance_steps or {})
    ways = (1.0, -1.0) if both_ways else (1.0,)
    for way in ways:
        check_mv(plant, point + way * change)
    tests = [_responses(plant, signals, point, way * change, way * sizes, samples) for way in ways]
    base = tests[0][0]
    coefficients = tests[0][1] if len(tests) == 1 else 0.5 * (tests[0][1] + tests[1][1])
    known, dvs = facts_of(plant), np.flatnonzero(sizes)
    units = signals.disturbance_units
    facts = {
        "plant": known["kind"],
        "plant_hash": known["hash"],
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "steps": np.concatenate([way * np.append(change, sizes[dvs]) for way in ways]).tolist(),
    }
    names, values = (*signals.mv_names, *signals.cv_names), (*point.tolist(), *base.tolist())
    model = make_model(
        coefficients[:, : len(change)],
        plant.dt,
        signals.cv_names,
        signals.mv_names,
        cv_units=signals.cv_units,
        mv_units=signals.mv_units,
        working_point=dict(zip(names, values, strict=True)),
        provenance=facts,
        dv_coefficients=coefficients[:, len(change) :],
        dv_names=[disturbances_of(plant)[k] for k in dvs],
        dv_units=[units[k] for k in dvs] if units else (),
    )
    notes = tuple(settling_notes(model))
    return dataclasses.replace(
        model, provenance=(*model.provenance, ("settled", not notes), ("notes", notes))
    )


def _disturbance_sizes(plant: Any, steps: Mapping[str, float]) -> Float[np.ndarray, " disturbance"]:
    """Step of each disturbance of the plant, 0 for those that are not stepped."""
    names = disturbances_of(plant)
    sizes = np.zeros(len(names))
    for name, size in steps.items():
        field = f"disturbance_steps.{name}"
        if name not in names:
            expected = f"one of the disturbances of the plant: {', '.join(names) or 'it has none'}"
            raise InputError(field, size, expected, near(name, names))
        if not is_number(size) or size == 0.0:
            raise InputError(field, size, "a finite step that is not zero")
        sizes[names.index(name)] = size
    return sizes


def _responses(
    plant: Any, signals: Signals, point: np.ndarray, changes: np.ndarray, sizes: np.ndarray, samples: int
) -> tuple[Float[np.ndarray, " cv"], Float[np.ndarray, "cv input n"]]:
    """CVs settled at a working point, and S(1)..S(N) from a step of each MV, then of each disturbance with a size, alone."""
    responses, base = [], np.zeros(0)
    count, steps = len(point), np.append(changes, sizes)
    for j in np.flatnonzero(steps):
        state, settled = start(plant, point)
        hold = SETTLE_SAMPLES if settled else SETTLE_SAMPLES + samples
        inputs = np.tile(np.append(point, np.zeros_like(sizes)), (hold + samples, 1))
        inputs[hold:, j] += steps[j]
        cv, mv = apply_sequence(plant, state, inputs[:, :count], inputs[:, count:])
        made = mv[-1] - point
        if j < count and abs(made[j] - steps[j]) > 1e-9 * max(1.0, abs(steps[j])):
            name = signals.mv_names[j]
            expected = f"a step that the actuator makes ({name} moved {made[j]})"
            raise InputError(f"steps.{name}", float(steps[j]), expected)
        base = cv[hold - 1]
        responses.append((cv[hold:] - base).T / steps[j])
    return base, np.stack(responses, axis=1)
