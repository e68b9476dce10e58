"""What is to be thought of a process file and its model, before anyone tunes a controller on them.

`jaxmpc process check` prints it. Every finding is a sentence with numbers and units, and says what to do.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from identify.step_test import response_words, settling
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import FIELDS, Tuning
from jaxmpc.process.process import Process, amount

NOTHING = 1e-4  # spans of a CV per span of an MV: no response
FAST, SLOW = 3, 0.9  # samples to 63 % of a gain; share of the model's length
GIVES_WAY = 0.5  # spans that setpoints may be off at least while CV limits come before them
ILL = 30.0  # condition number of the gains in spans from which on directions differ much
Level = Literal["fine", "look"]


class Finding(NamedTuple):
    """One thing that was looked at."""

    level: Level
    subject: str  # pair, MV, reference or field
    says: str


def judge(process: Process, model: StepResponseModel) -> list[Finding]:
    """Everything that is found, in the order of the file: pairs, horizons, gains, steps, priorities, references.

    Args:
        process: checked already.
        model: of the process.
    """
    found = [*_told(model), *_pairs(process, model), *_horizons(process, model), *_gains(process, model)]
    found += [*_steps(process, model), *_limits(process, model), *_ideals(process)]
    return [*found, *_references(process, model)]


def _told(model: StepResponseModel) -> list[Finding]:
    """What the identification of the model had reservations about."""
    return [
        Finding("look", f"{name} on {cv}", f"{verdict} when it was identified: {says}")
        for cv, name, verdict, says in dict(model.provenance).get("verdicts", ())
        if verdict in ("look", "bad")
    ]


def _spans(process: Process) -> np.ndarray:
    """What turns gains into spans of CVs per span of MVs, ``"cv mv"``."""
    cvs, mvs = (np.array([v.span for v in own]) for own in (process.cvs, process.mvs))
    return mvs[None, :] / cvs[:, None]


def _pairs(process: Process, model: StepResponseModel) -> list[Finding]:
    out: list[Finding] = []
    s = model.responses
    inputs = {v.name: v for v in (*process.mvs, *process.disturbances)}
    places = {name: j for j, name in enumerate(model.input_names)}
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


def limit_prices(
    structure: Structure, tuning: Tuning, gains: np.ndarray, cv_span: np.ndarray, mv_span: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The `slack_weight` from which on a CV limit is kept before anything else is, ``"cv"`` [1/CV unit].

    An exact penalty keeps a limit if its price is above the sum of the limit's multipliers over the horizon, which is what
    keeping it by one unit costs elsewhere. This bounds it for a steady state in which the MV does it that costs least.

    Args:
        gains: ``"cv mv"`` [CV unit per MV unit].
        cv_span, mv_span: how far all CVs are off their setpoints, and the MVs off their ideal values.

    Returns:
        ``(fixed, by_span)``: the part that does not depend on how far they are off, and the rest; infinite where no MV moves
        the CV.
    """
    samples = structure.prediction_horizon - structure.first_penalised + 1
    curved = 2.0 * samples * np.asarray(tuning.cv_weight + tuning.soft_quadratic) * cv_span
    straight = samples * np.asarray(tuning.soft_linear)
    rest = 2.0 * samples * np.asarray(tuning.ideal_weight) * mv_span
    size = np.abs(gains)
    moves = size * mv_span > NOTHING * cv_span[:, None]
    # MV units per unit of the CV; what that costs by every MV, and by the cheapest
    needed = np.where(moves, 1.0 / np.where(moves, size, 1.0), np.inf)
    fixed, by_span = (
        needed * np.where(np.isinf(needed), 1.0, cost) for cost in (straight @ size, curved @ size + rest)
    )
    cheapest = np.arange(len(size)), np.argmin(fixed + by_span, axis=1)
    return fixed[cheapest], by_span[cheapest]


def _limits(process: Process, model: StepResponseModel) -> list[Finding]:
    """Whether the limits of the CVs come before their setpoints."""
    structure = process.structure()
    tuning, out = process.tuning(structure), []
    spans = (np.array([v.span for v in own]) for own in (process.cvs, process.mvs))
    fixed, by_span = limit_prices(structure, tuning, np.asarray(model.coefficients)[:, :, -1], *spans)
    for i, cv in enumerate(process.cvs):
        if not np.isfinite([tuning.cv_low[i], tuning.cv_high[i]]).any():
            continue
        subject = f"limits of {cv.name}"
        unit = "" if cv.unit == "1" else f" {FIELDS['slack_weight'].unit_of(cv.unit)}"
        price, needed = float(tuning.slack_weight[i]), fixed[i] + by_span[i]
        if not np.isfinite(needed):
            out.append(Finding("look", subject, "no MV moves it: nothing keeps it within its limits"))
            continue
        words = (
            f"slack_weight {price:.4g}{unit}; {needed:.3g} keeps them while setpoints are off by their spans"
        )
        share = 1.0 if price >= needed else max(price - fixed[i], 0.0) / max(by_span[i], 1e-300)
        if share < GIVES_WAY:
            words += f", this one up to {share:.2g} of them: setpoints farther off come before these limits"
        out.append(Finding("look" if share < GIVES_WAY else "fine", subject, words))
    return out


def _ideals(process: Process) -> list[Finding]:
    """Whether the MVs can be at their ideal values, in every preset."""
    out = []
    for preset in process.presets:
        tuning = process.tuning(process.structure(), preset)
        for i, mv in enumerate(process.mvs):
            if not tuning.ideal_weight[i]:
                continue
            ideal, low, high = (float(v[i]) for v in (tuning.ideal, tuning.mv_low, tuning.mv_high))
            words, level = f"{amount(ideal, mv.unit)}, limits {low:g} to {high:g}", "fine"
            if not low <= ideal <= high:
                level, words = "look", words + ": out of reach; it pulls to the nearer limit all the time"
            out.append(Finding(level, f"presets.{preset}.ideal.{mv.name}", words))
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
