"""What is to be thought of a process file and its model, before anyone tunes a controller on them.

`jaxmpc process check` prints it. Every finding is a sentence with numbers and units, and says what to do.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from identify.step_test import response_words, settling
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.process import Process, amount

NOTHING = 1e-4  # spans of a CV per span of an MV: no response
FAST, SLOW = 3, 0.9  # samples to 63 % of a gain; share of the model's length
ILL = 30.0  # condition number of the gains in spans from which on directions differ much
Level = Literal["fine", "look"]


class Finding(NamedTuple):
    """One thing that was looked at."""

    level: Level
    subject: str  # pair, MV, reference or field
    says: str


def judge(process: Process, model: StepResponseModel) -> list[Finding]:
    """Everything that is found, in the order of the file: pairs, horizons, gains, steps, references.

    Args:
        process: checked already.
        model: of the process.
    """
    found = [*_pairs(process, model), *_horizons(process, model), *_gains(process, model)]
    return [*found, *_steps(process, model), *_references(process, model)]


def _spans(process: Process) -> np.ndarray:
    """What turns gains into spans of CVs per span of MVs, ``"cv mv"``."""
    cvs, mvs = (np.array([v.span for v in own]) for own in (process.cvs, process.mvs))
    return mvs[None, :] / cvs[:, None]


def _pairs(process: Process, model: StepResponseModel) -> list[Finding]:
    out: list[Finding] = []
    s = np.concatenate([np.asarray(model.coefficients), np.asarray(model.dv_coefficients)], axis=1)
    inputs = {v.name: v for v in (*process.mvs, *process.disturbances)}
    places = {name: j for j, name in enumerate((*model.mv_names, *model.dv_names))}
    for row in settling(model):
        i, j = process.cv_names.index(row.cv), places[row.mv]
        cv, mv, subject = process.cvs[i], inputs[row.mv], f"{row.mv} on {row.cv}"
        unit = "" if cv.unit == mv.unit == "1" else f" {cv.unit} per {mv.unit}"
        peak = np.abs(s[i, j]).max()
        if peak * mv.span / cv.span < NOTHING:
            words = f"no response: at most {peak:.3g}{unit}; if there should be one, look at the model and the spans"
            out.append(Finding("look", subject, words))
            continue
        begin = int(np.argmax(np.abs(s[i, j]) > 0.02 * peak))
        rise = (int(np.argmax(np.abs(s[i, j]) >= 0.63 * abs(row.gain))) + 1 - begin) if row.gain else 0
        words = response_words(row, s[i, j], unit, model.dt)
        if not row.settled:
            slope = (s[i, j, -1] - s[i, j, -2]) / model.dt if model.samples > 1 else np.inf
            words = (
                f"not settled by sample {model.samples}: still moves {slope:.3g}{unit} per second; the prediction holds "
                "the last value, so give the model more samples, or a CV that does not integrate"
            )
            out.append(Finding("look", subject, words))
        elif rise < FAST:
            count = f"{rise} sample{'s' if rise > 1 else ''} of {model.dt:g} s"
            advice = f"reaches 63 % within {count}: what it does in between is not seen; sample faster"
            out.append(Finding("look", subject, f"{words}; {advice}"))
        elif row.gain * s[i, j, begin] < 0:
            out.append(Finding("look", subject, words))
        else:
            out.append(Finding("fine", subject, words))
    return out


def _horizons(process: Process, model: StepResponseModel) -> list[Finding]:
    structure = process.structure()
    longest = max((row.settling_time for row in settling(model) if row.settled), default=0.0)
    ahead = structure.prediction_horizon * process.dt
    subject = "prediction_horizon"
    if all(mv.actuator.kind == "on-off" for mv in process.mvs):
        if structure.prediction_horizon > 1.5 * structure.control_horizon:
            words = (
                f"{ahead:g} s, of which {structure.control_horizon * process.dt:g} s are the control horizon: what is on or "
                "off at its end stays so, and the plan is chosen by that; look less far ahead"
            )
            return [Finding("look", subject, words)]
        return [Finding("fine", subject, f"{ahead:g} s; what is on or off never settles")]
    if ahead < longest:
        words = f"{ahead:g} s; the slowest response settles after {longest:g} s: look further ahead, or expect offset"
        return [Finding("look", subject, words)]
    return [Finding("fine", subject, f"{ahead:g} s; the slowest response settles after {longest:g} s")]


def _gains(process: Process, model: StepResponseModel) -> list[Finding]:
    scaled = np.asarray(model.coefficients)[:, :, -1] * _spans(process)
    values = np.linalg.svd(scaled, compute_uv=False)
    strength = f"strongest direction {values[0]:.3g}, weakest {values[-1]:.3g} spans of CVs per span of MVs"
    if values[-1] <= 0 or values[0] / values[-1] > ILL:
        words = (
            f"{strength}: setpoints in the weak direction need large moves or cannot be reached together: "
            "weigh the CVs by what matters"
        )
        return [Finding("look", "gains", words)]
    return [Finding("fine", "gains", strength)]


def _steps(process: Process, model: StepResponseModel) -> list[Finding]:
    out = []
    gains = np.asarray(model.coefficients)[:, :, -1]
    tuning = process.tuning(process.structure())
    costs = np.asarray(tuning.cv_weight + tuning.soft_quadratic + tuning.soft_linear)
    for j in process.stepped:
        mv = process.mvs[j]
        listed = mv.actuator.listed
        step = mv.actuator.step if listed is None else float(np.diff(listed).max())
        for i, cv in enumerate(process.cvs):
            if not costs[i]:
                continue  # no setpoint counts
            effect, zone = abs(gains[i, j]) * float(step or 0.0), float(tuning.deadzone[i])
            moved, allowed = amount(effect, cv.unit), amount(zone, cv.unit)
            words = f"one step of {amount(step, mv.unit)} moves it by {moved}, deadzone +-{allowed}"
            if effect > 2 * zone:
                words += (
                    f": between two steps no position keeps it inside; rounding hunts, whole moves rest off the setpoint, "
                    f"unless the deadzone is +-{amount(effect / 2, cv.unit)}"
                )
                out.append(Finding("look", f"{mv.name} on {cv.name}", words))
            else:
                out.append(Finding("fine", f"{mv.name} on {cv.name}", words))
    return out


def _references(process: Process, model: StepResponseModel) -> list[Finding]:
    """Whether the MVs can hold the setpoints in the steady state of the model, within their limits."""
    out, tuning = [], process.tuning(process.structure())
    point = dict(model.working_point)
    y0 = np.array([point.get(name, 0.0) for name in process.cv_names])
    u0 = np.array([point.get(name, 0.0) for name in process.mv_names])
    low, high = np.asarray(tuning.mv_low) - u0, np.asarray(tuning.mv_high) - u0
    weight = 1 / process.settled
    matrix = np.asarray(model.coefficients)[:, :, -1] * weight[:, None]
    for name, reference in process.references.items():
        away = []
        for start, row in zip(reference.times, reference.setpoints, strict=True):
            found = lsq_linear(matrix, (row - y0) * weight, bounds=(low, np.maximum(high, low + 1e-9)))
            off = np.abs(found.fun).max()
            if off > 1:
                worst = int(np.abs(found.fun).argmax())
                cv = process.cvs[worst]
                miss = abs(found.fun[worst]) * process.settled[worst]
                away.append(f"from {start:g} s: {cv.name} at least {amount(miss, cv.unit)} off")
        subject = f"references.{name}"
        if away:
            words = f"{len(away)} of {len(reference.times)} setpoints cannot be held by the model: {'; '.join(away[:3])}"
            words += "; ask for others, or widen low and high of the MVs"
            out.append(Finding("look", subject, words))
        else:
            out.append(
                Finding("fine", subject, f"all {len(reference.times)} setpoints can be held by the model")
            )
    return out
