"""From a log to a proposal: the present model of a process with gains, dead times and times as the log says.

`jaxmpc update PROCESS LOG` calls it. What the log cannot tell keeps its present response; nothing is taken over by itself.
"""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from identify.logged.fit import WIDER
from identify.logged.identify import HELD_OUT
from identify.logged.judge import GOOD, USABLE, excitations
from identify.logged.knobs import GAIN, Case, Found, fit_knobs
from identify.logged.log import Log, read_log
from identify.logged.noise import innovations
from identify.logged.residuals import Residuals, examined
from identify.logged.tags import tags_of
from identify.logged.told import WHITE
from jaxmpc.errors import InputError
from jaxmpc.model.identification import Identification, PairVerdict, Record, Verdict
from jaxmpc.model.step_response import StepResponseModel, make_model
from jaxmpc.process.process import Process

PRESENT = "present model"  # its name among the alternatives
TOLD = 0.5  # of the standard deviation that a gain factor has beforehand: more is not told
ROWS = 10  # measurements per input that a fit takes at least
HALF = 1.96 * WIDER  # half widths of 95 % intervals in standard deviations


class _Cv(NamedTuple):
    """What was found for one CV."""

    found: Found | None  # of the inputs `places`; None where none of them acts
    places: np.ndarray  # inputs that move and have a response
    tested: Residuals | None
    predicted: np.ndarray  # by the new model alone [CV unit]
    fits: (
        tuple[float, float] | None
    )  # rms of what could not be foreseen at the end, by the present and the new model


def update_model(
    process: Process,
    model: StepResponseModel,
    path: str | Path,
    *,
    time: str | None = None,
    progress: bool = False,
) -> Identification:
    """The present model of a process with other gains, dead times and times, where a log tells them.

    Args:
        process: whose tags the columns of the log are.
        model: its present model.
        path: of a CSV or Parquet file, see `read_log`.
        time: column of the times; found if not given.
        progress: whether a bar on standard error shows how far it is, from two seconds on.

    Returns:
        The new model with 95 % bands; a verdict per pair with its factor of the gain, added dead time and factor of the
        time, which are those of `jaxmpc.process.model_plant.KNOBS`; the present responses as alternative.

    Raises:
        InputError: for what `read_log` refuses, and data that tell nothing of any pair.
    """
    tags = tags_of(process, model)
    log = read_log(path, [*tags.inputs, *tags.cv], process.dt, time, held=tags.inputs)
    longest = max(own.stop - own.start for own in log.segments)
    inputs = np.stack([log.values[name] for name in tags.inputs], axis=1)
    nominal, names = model.responses, model.input_names
    units = (*(mv.unit for mv in process.mvs), *(process.units.get(name, "1") for name in model.dv_names))
    excited = excitations(names, units, inputs, log.segments)
    cut = round((1 - HELD_OUT) * len(log.times))
    with tqdm(total=2 * len(tags.cv), desc="update", delay=2, disable=not progress) as bar:
        each = [
            _updated(nominal[i], log.values[name], inputs, log, cut, bar) for i, name in enumerate(tags.cv)
        ]
    verdicts = tuple(
        _verdict(cv, name, nominal[i, j], excited[j], each[i], j, process.dt)
        for i, cv in enumerate(model.cv_names)
        for j, name in enumerate(names)
    )
    if all(row.verdict in ("bad", "none") for row in verdicts):
        reasons = "; ".join(dict.fromkeys(row.says for row in verdicts if row.verdict == "bad"))
        raise InputError("data", str(path), "moves that tell the gain of at least one pair", reasons)
    kept = np.array([row.verdict in ("bad", "none") for row in verdicts]).reshape(nominal.shape[:2])
    steps, bands = _responses(nominal, each, kept)
    longer = (0, 0), (0, 0), (0, steps.shape[2] - nominal.shape[2])
    present = np.pad(nominal, longer, mode="edge")
    notes = [*log.notes, *_notes(model, each, log, cut, longest, nominal.shape[2])]
    measured = np.stack([log.values[name] for name in tags.cv], axis=1)
    predicted = np.stack([one.predicted for one in each], axis=1)
    record = Record(Path(path).name, log.times, inputs, measured, predicted, np.ones(len(log.times), bool))
    return Identification(
        _model(model, steps, log, Path(path).name, verdicts),
        verdicts,
        tuple(notes),
        _advice(verdicts),
        bands,
        {PRESENT: present},
        (record,),
    )


def _updated(
    nominal: np.ndarray, output: np.ndarray, inputs: np.ndarray, log: Log, cut: int, bar: tqdm
) -> _Cv:
    moved = np.concatenate([inputs[own] - inputs[own][:1] for own in log.segments])
    acts = (np.abs(nominal).max(axis=1) > 0) & (np.abs(moved).max(axis=0) > 0)
    places = np.flatnonzero(acts)
    known, least = np.isfinite(output), ROWS * max(places.size, 1)
    if not places.size or known.sum() < least:
        bar.update(2)
        return _Cv(None, places, None, np.full(len(output), np.nan), None)
    case = Case(nominal[places], moved[:, places], output, log.segments)
    found = fit_knobs(case)
    bar.update()
    fits = None
    if known[:cut].sum() >= least and known[cut:].any():
        early = np.where(np.arange(len(output)) < cut, output, np.nan)
        first = fit_knobs(dataclasses.replace(case, output=early))
        old = np.tile([1.0, 0.0, 0.0], (len(places), 1))
        left = (output - case.explained(x) for x in (old, first.x))
        late = [_unforeseen(one, first, log)[cut:] for one in left]
        before, after = (float(np.sqrt(np.nanmean(one**2))) for one in late)
        fits = before, after
    bar.update()
    alone = case.explained(found.x)
    errors = _unforeseen(output - alone, found, log)
    for own in log.segments:
        y = output[own] - alone[own]
        alone[own] += np.nanmean(y) if np.isfinite(y).any() else np.nan
    tested = examined(errors, inputs, log.segments, nominal.shape[1])
    return _Cv(found, places, tested, alone, fits)


def _unforeseen(left: np.ndarray, found: Found, log: Log) -> np.ndarray:
    """Prediction errors one sample ahead of what the inputs do not explain [CV unit]."""
    return np.concatenate([innovations(found.noise, left[own]) for own in log.segments])


def _verdict(cv: str, name: str, nominal: np.ndarray, excited, own: _Cv, j: int, dt: float) -> PairVerdict:
    """What the data say of a pair, and whether it is used."""
    stays = "its present response stays"
    if not np.abs(nominal).any():
        return PairVerdict(cv, name, "none", "no response in the present model, and none is looked for")
    if own.found is None or j not in own.places:
        why = f"{name} never moves in the log" if excited.moved == 0 else f"{cv} is hardly measured"
        return PairVerdict(cv, name, "bad", f"{why}: {stays}")
    at = int(np.flatnonzero(own.places == j)[0])
    (gain, delay, scale), deviation = own.found.x[at], own.found.deviations[at]
    half = HALF * deviation
    if excited.twin:
        return PairVerdict(cv, name, "bad", f"{name} {excited.twin}; {stays}")
    if deviation[0] > TOLD * GAIN or gain <= half[0]:
        words = (
            f"the data cannot tell: a gain of {gain:.2g} ± {half[0]:.2g} times the present one fits as well"
        )
        return PairVerdict(cv, name, "bad", f"{words}; {stays}")
    low, high = np.exp(scale - half[2]), np.exp(scale + half[2])
    says = (
        f"gain × {gain:.3g} ± {half[0]:.2g}, dead time {delay * dt:+.3g} ± {half[1] * dt:.2g} s, "
        f"time × {np.exp(scale):.3g} ({low:.2g} to {high:.2g})"
    )
    doubts = []
    if (np.abs(own.found.x[at] - [1.0, 0.0, 0.0]) <= half).all():
        doubts.append("no change within the intervals")
    share = half[0] / gain
    verdict: Verdict = "good" if share <= GOOD else "look"
    if share > USABLE:
        doubts.append(f"the gain is known within {100 * share:.0f} % only")
    tested = own.tested
    if tested is not None and tested.past[j] > tested.limit:
        verdict = "look"
        doubts.append(
            f"residuals still follow moves of {name} (correlation {tested.past[j]:.2f}): another shape, or not linear"
        )
    return PairVerdict(cv, name, verdict, "; ".join([says, *doubts]))


def _responses(nominal: np.ndarray, each: Sequence[_Cv], kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Step responses ``"cv input n"`` and their bands; those that are kept have none."""
    shown: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
    for i, own in enumerate(each):
        if own.found is None:
            continue
        x = own.found.x
        covariance = own.found.covariance.reshape(*x.shape, *x.shape)
        case = Case(nominal[i][own.places], np.zeros((0, len(x))), np.zeros(0), ())
        for at, (j, middle, slope) in enumerate(
            zip(own.places, case.steps(x), case.step_slopes(x), strict=True)
        ):
            if not kept[i, j]:
                spread = np.einsum("kn,kl,ln->n", slope, covariance[at, :, at], slope)
                shown[i, int(j)] = middle, HALF * np.sqrt(np.maximum(spread, 0))
    length = max([nominal.shape[2], *(len(part) for pair in shown.values() for part in pair)])
    longer = lambda v: np.pad(v, (0, length - len(v)), mode="edge")  # noqa: E731
    steps = np.stack([[longer(s) for s in row] for row in nominal])
    bands = np.full(steps.shape, np.nan)
    for place, (middle, half) in shown.items():
        steps[place], bands[place] = longer(middle), longer(half)
    return steps, bands


def _notes(
    model: StepResponseModel, each: Sequence[_Cv], log: Log, cut: int, longest: int, samples: int
) -> list[str]:
    notes = []
    if longest < samples:
        notes.append(
            f"the longest stretch of the log ({longest} samples) is shorter than the responses ({samples} samples)"
        )
    for name, own in zip(model.cv_names, each, strict=True):
        if own.found is None:
            continue
        notes.append(f"{name}: the noise is {own.found.noise}")
        if own.fits is not None:
            old, new = own.fits
            notes.append(
                f"{name}: of the last {len(log.times) - cut} samples, which a first fit did not see, what cannot be "
                f"foreseen one sample ahead is {new:.3g}, with the present model {old:.3g} (rms)"
            )
        if own.tested is not None and own.tested.white < WHITE:
            notes.append(
                f"{name}: residuals are not white (p = {own.tested.white:.1g}): intervals may be too narrow"
            )
    return notes


def _advice(verdicts: Sequence[PairVerdict]) -> tuple[str, ...]:
    bad = list(dict.fromkeys(row.input for row in verdicts if row.verdict == "bad"))
    out = ["Nothing is taken over by itself: run the study that compares both models first"]
    if bad:
        out.append(f"More moves of {', '.join(bad)} that do not depend on the CVs would tell the others")
    return tuple(out)


def _model(
    model: StepResponseModel, steps: np.ndarray, log: Log, name: str, verdicts: Sequence[PairVerdict]
) -> StepResponseModel:
    facts = dict(model.provenance) | {
        "source": name,
        "method": "present model with gains, dead times and times by prediction errors on logged data",
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "begin": log.begin,
        "samples_used": len(log.times),
        "verdicts": [list(row) for row in verdicts],
    }
    mvs = len(model.mv_names)
    return make_model(
        steps[:, :mvs],
        model.dt,
        model.cv_names,
        model.mv_names,
        cv_units=model.cv_units,
        mv_units=model.mv_units,
        working_point=model.working_point,
        provenance=facts,
        dv_coefficients=steps[:, mvs:] if model.dv_names else (),
        dv_names=model.dv_names,
        dv_units=model.dv_units,
    )
