"""What step tests of several sizes, up and down, say of a model: a verdict on every pair of CV and input.

`identify.fmu_steps` makes the tests. Every verdict is a sentence with numbers and units, and says what to do.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from identify.step_test import Settling, response_words, settling
from jaxmpc.model.identification import PairVerdict, Verdict
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.process import amount

NOTHING = 1e-7  # of the largest value of a CV: a change that is no response, unless all tests agree on it
CURVED, BENT = (
    0.05,
    0.5,
)  # of a response: differences of its tests from which on to look, and not to use the mean
GROWN = 1.05  # of a swing: from one third of a response to the next
CONSTANT = 0.02  # of a slope: two that are one
LEFT = 0.005  # of a response: error of its worst coefficient by noise, or by whole steps of a CV, from which on to look
COARSE = 0.03  # likewise by whole steps, from which on not to use it
HANGING, STUCK = 0.01, 0.2  # of a response: what stays after the way back, to look at and not to use
UNLIKE = 0.005  # of a response: differences of tests that are told
FAST = 3  # samples to 63 % of a gain


class Tests(NamedTuple):
    """What was measured.

    Attributes:
        model: the mean of full steps up and down.
        responses: by test, ``up``, ``down``, ``half up``, ``half down``; NaN where a test was not made.
        errors: standard errors of the coefficients by noise that differs from run to run.
        changes: largest change of a CV in the tests of an input [CV unit].
        scale: largest value of a CV [CV unit].
        further: largest change after a much larger step, where the tests have changed nothing; 0 elsewhere [CV unit].
        base: without steps.
        continuous: whether a CV takes every value.
        left: what stays of a response that had settled after its input has gone back, as a share.
        grid: steps in which a CV moves; 0 where it has none, or noise [CV unit].
    """

    model: StepResponseModel
    responses: Mapping[str, Float[np.ndarray, "cv input n"]]
    errors: Float[np.ndarray, "cv input"]
    changes: Float[np.ndarray, "cv input"]
    scale: Float[np.ndarray, " cv"]
    further: Float[np.ndarray, "cv input"]
    base: Float[np.ndarray, "sample cv"]
    continuous: Sequence[bool]
    left: Float[np.ndarray, "cv input"]
    grid: Float[np.ndarray, " cv"]


def judged(tests: Tests) -> tuple[tuple[PairVerdict, ...], list[str]]:
    """A verdict per pair, CV by CV, and notes on CVs and inputs that show nothing at all."""
    model, found, notes = tests.model, [], []
    inputs = (*model.mv_names, *model.dv_names)
    rows = {(row.cv, row.mv): row for row in settling(_smoothed(tests))}
    for i, cv in enumerate(model.cv_names):
        for j, name in enumerate(inputs):
            found.append(PairVerdict(cv, name, *_pair(tests, i, j, rows[cv, name])))
    for name in inputs:
        if all(row.verdict == "none" for row in found if row.input == name):
            notes.append(f"{name} has no effect on any CV: leave it out, or look at where the model uses it")
    for i, cv in enumerate(model.cv_names):
        if all(row.verdict == "none" for row in found if row.cv == cv):
            still = not np.ptp(tests.base[:, i])
            how = f"stays at {tests.base[0, i]:.6g}" if still else "moves by itself only"
            notes.append(f"{cv} answers to no input: it {how}; choose another CV")
    return tuple(found), notes


def _smoothed(tests: Tests) -> StepResponseModel:
    """The model without the noise that would hide whether it has settled."""
    model = tests.model
    width = model.samples // 20
    if not tests.errors.any() or width < 2:
        return model
    kernel = np.ones(width) / width

    def smooth(s: Any) -> Any:
        filled = np.pad(np.asarray(s), ((0, 0), (0, 0), (width // 2, width - 1 - width // 2)), mode="edge")
        return np.apply_along_axis(np.convolve, 2, filled, kernel, "valid") if np.size(s) else s

    return dataclasses.replace(
        model, coefficients=smooth(model.coefficients), dv_coefficients=smooth(model.dv_coefficients)
    )


def _pair(tests: Tests, i: int, j: int, row: Settling) -> tuple[Verdict, str]:
    model = tests.model
    s = model.responses[i, j]
    cv_unit, unit = (model.units[names[k]] for names, k in ((model.cv_names, i), (model.input_names, j)))
    per = "" if cv_unit == unit == "1" else f" {cv_unit} per {unit}".replace(" 1 per", " per")
    tested = np.stack([found[i, j] for found in tests.responses.values() if np.isfinite(found[i, j]).all()])
    error, peak = float(tests.errors[i, j]), float(np.abs(tested).max())
    expected_peak = error * math.sqrt(2 * math.log(2 * len(s) + 1))  # of noise alone
    faint = tests.changes[i, j] <= NOTHING * tests.scale[i]
    unseen = faint and _apart(tests, i, j) > CURVED
    if unseen and tests.further[i, j] > NOTHING * tests.scale[i]:
        return "bad", (
            f"no response to these steps, but a larger one moves it by {amount(tests.further[i, j], cv_unit)}: a dead band, "
            "a valve that sticks, or steps too small to be seen; step further (--mv NAME=VALUE:STEP)"
        )
    if unseen or (error and not _stands_out(s, error, expected_peak)):
        return "none", f"no response: at most {np.abs(s).max():.3g}{per}" + (
            " within the noise" if error else ""
        )
    words, looks = response_words(row, s, per, model.dt), []
    runaway, says = _moving(s, row, model.dt, per, error)
    looks += [says] if says else []
    if faint:
        part = tests.changes[i, j] / tests.scale[i]
        looks.append(
            f"it moves by {part:.1g} of its value only, which tolerances of a solver may blur: step further"
        )
    share = expected_peak / peak
    if share > LEFT:
        looks.append(f"noise leaves +-{100 * share:.2g} % of its largest value: larger steps leave less")
    coarse, says = _coarse(tests, i, j, cv_unit)
    looks += [says] if says else []
    stays = tests.left[i, j] if row.settled and not coarse else 0.0
    if stays > HANGING:
        looks.append(
            f"{100 * stays:.2g} % of it stays when {row.mv} has gone back: backlash or hysteresis within the step, "
            "or a part that is slower than the model; step further"
        )
    if not tests.continuous[i]:
        looks.append(
            f"{row.cv} takes whole values only: this is its answer to steps of this size and to no other"
        )
    movement, doubt = (float(found[i]) for found in movement_of(tests.base))
    alone = max(2 * (movement - 8 * doubt), 0.0)
    if alone > CURVED * tests.changes[i, j]:
        looks.append(
            f"without a step it moves by {amount(alone, cv_unit)} in the same time: the response is the difference of both, "
            "which is right where the plant is linear; let it settle longer (--settle), or look at what drives it"
        )
    apart, says = _sizes(tests, i, j, peak, error)
    if apart > CURVED:
        looks.append(says)
    elif apart > UNLIKE and not faint:
        words += f" ({says.partition(';')[0]})"
    unusable = runaway or apart > BENT or coarse > COARSE or stays > STUCK
    verdict: Verdict = "bad" if unusable else "look" if looks else "good"
    if not looks and row.settled and _rise(s, row.gain) < FAST:
        words += "; it is there within 3 samples: what it does in between is not seen"
    return verdict, "; ".join([words, *looks])


def _apart(tests: Tests, i: int, j: int) -> float:
    """Largest difference of all tests as a share of the response: rounding and a solver's tolerances differ by size."""
    tested = {way: found[i, j] for way, found in tests.responses.items() if np.isfinite(found[i, j]).all()}
    peak = max(np.abs(found).max() for found in tested.values())
    if not peak or all("half" not in way for way in tested):
        return math.inf
    return float(np.ptp(np.stack(list(tested.values())), axis=0).max() / peak)


def _coarse(tests: Tests, i: int, j: int, unit: str) -> tuple[float, str]:
    """Error of a coefficient by the steps in which a CV moves, as a share of the response, and words for it."""
    both = all(np.isfinite(tests.responses[way][i, j]).all() for way in ("up", "down"))
    share = float(tests.grid[i] / tests.changes[i, j]) / (2 if both else 1)
    # where tests of all sizes agree, the steps are those of the tests: a valve that opens at once
    if share <= LEFT or _apart(tests, i, j) < 0.1 * share:
        return 0.0, ""
    return share, (
        f"{tests.model.cv_names[i]} moves in steps of {amount(tests.grid[i], unit)}, which leaves +-{100 * share:.2g} % of "
        "the response: step further (--mv NAME=VALUE:STEP)"
    )


def grid_of(values: np.ndarray) -> float:
    """The step of which all differences of some values are multiples; 0 if there is none."""
    gaps = np.diff(np.unique(values))
    if not gaps.size:
        return 0.0
    multiples = gaps / gaps.min()
    return float(gaps.min()) if (np.abs(multiples - np.rint(multiples)) < 1e-3).all() else 0.0


def back_share(change: Float[np.ndarray, "sample cv"], noise: Float[np.ndarray, " cv"]) -> np.ndarray:
    """What stays of the changes by a step at the end of as long a way back, beyond what noise and a settled rest explain."""
    count = len(change) // 2 + 1
    tenth = max(count // 10, 1)
    there, back = change[:count], change[-tenth:].mean(axis=0)
    moving = np.abs(there[-tenth:].mean(axis=0) - there[-2 * tenth : -tenth].mean(axis=0))
    beyond = np.abs(back) - 3 * moving - 6 * noise / math.sqrt(tenth)
    return np.maximum(np.nan_to_num(beyond), 0.0) / np.maximum(np.abs(there).max(axis=0), 1e-300)


def _stands_out(s: np.ndarray, error: float, expected: float) -> bool:
    """Whether a response is more than noise: in one sample, or in the mean of its last quarter."""
    tail = s[-max(len(s) // 4, 1) :]
    return bool(np.abs(s).max() > 1.5 * expected or abs(tail.mean()) > 5 * error / math.sqrt(len(tail)))


def movement_of(cv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """By how much the second half of a record differs from the first in the mean, and the error of that by noise."""
    half = len(cv) // 2
    movement = np.abs(cv[half:].mean(axis=0) - cv[:half].mean(axis=0))
    noise = np.diff(cv, n=2, axis=0).std(axis=0) / math.sqrt(6)
    return movement, noise / math.sqrt(len(cv))


def _moving(s: np.ndarray, row: Settling, dt: float, per: str, error: float) -> tuple[bool, str]:
    """Whether a response runs away, and what is to be said of one that still moves at its end."""
    if row.settled or len(s) < 8:
        return False, "" if row.settled else f"not settled by sample {len(s)}: give more samples"
    if not error and (swings := _swinging(s)):
        return swings
    quarter = len(s) // 4
    ends = [len(s) - k * quarter for k in (2, 1, 0)]
    slopes = [np.polyfit(np.arange(quarter) * dt, s[end - quarter : end], 1)[0] for end in ends]
    doubt = 3 * error * math.sqrt(12 / quarter**3) / dt
    first, before, last = map(float, slopes)
    if error and abs(last) <= doubt:
        return False, ""
    if abs(last - before) <= CONSTANT * abs(last) + doubt:
        return False, (
            f"it integrates: at the end it moves {last:.4g}{per} each second, for ever; the prediction holds the last "
            "value, so control it with a horizon within the model, or take a CV that settles"
        )
    if last * before > 0 and abs(last) > abs(before):
        if before * first > 0 and last / before > 0.9 * before / first > 0.9:
            return (
                True,
                "it runs away, faster and faster: it is unstable, and a step response cannot model that; stabilise it first",
            )
        return False, f"not settled by sample {len(s)}, and still faster and faster: give more samples"
    left = -math.log(0.01) * quarter / max(math.log(max(abs(before), 1e-300) / max(abs(last), 1e-300)), 1e-3)
    more = f"; about {math.ceil(left / 50) * 50:d} samples would show it all" if 0 < left < 1e5 else ""
    return False, f"not settled by sample {len(s)}: it still moves {last:.3g}{per} each second{more}"


def _swinging(s: np.ndarray) -> tuple[bool, str] | None:
    """The same of a response that swings up to its end; None of one that does not."""
    third = len(s) // 3
    before, last = s[third : 2 * third], s[-third:]
    if min(np.count_nonzero(np.diff(np.sign(np.diff(part)))) for part in (before, last)) < 2:
        return None
    ratio = float(np.ptp(last) / np.ptp(before))
    if ratio > GROWN:
        return (
            True,
            "it swings ever more: it is unstable, and a step response cannot model that; stabilise it first",
        )
    more = (
        f"; about {math.ceil(third * math.log(0.01) / math.log(ratio) / 50) * 50:d} samples would show it all"
    )
    return (
        False,
        f"it still swings at sample {len(s)}{more if ratio < 1 / GROWN else ', and hardly less and less'}",
    )


def _sizes(tests: Tests, i: int, j: int, peak: float, error: float) -> tuple[float, str]:
    """The largest difference of tests as a share of the response, beyond what noise makes, and words for it."""
    tested = {way: found[i, j] for way, found in tests.responses.items() if np.isfinite(found[i, j]).all()}
    halves = [found for way, found in tested.items() if "half" in way]
    fulls = [found for way, found in tested.items() if "half" not in way]
    noise = error * math.sqrt(2 * math.log(2 * tests.model.samples + 1)) * 1.5
    worst, says = 0.0, ""
    if len(fulls) == 2:
        apart = max(np.abs(fulls[0] - fulls[1]).max() - 2 * noise, 0.0) / peak
        up, down = float(fulls[0][-1]), float(fulls[1][-1])
        worst, says = (
            apart,
            (
                f"a step up and one down differ by {100 * apart:.3g} %: gain {up:.4g} up, {down + 0.0:.4g} down; smaller "
                "steps, or a gain schedule (--at)"
            ),
        )
    if halves:
        apart = max(np.abs(np.mean(halves, axis=0) - np.mean(fulls, axis=0)).max() - 4 * noise, 0.0) / peak
        if apart > worst:
            worst, says = (
                apart,
                (
                    f"steps of half the size differ by {100 * apart:.3g} %: gain {float(np.mean(halves, axis=0)[-1]):.4g}; "
                    "step as far as the controller will move it"
                ),
            )
    return worst, says


def _rise(s: np.ndarray, gain: float) -> int:
    """Samples to 63 % of a gain."""
    begin = int(np.argmax(np.abs(s) > 0.02 * np.abs(s).max()))
    return int(np.argmax(s * np.sign(gain) >= 0.63 * abs(gain))) + 1 - begin


def advice_of(verdicts: Sequence[PairVerdict], model: StepResponseModel) -> tuple[str, ...]:
    """What to do next, the most useful first."""
    says = " ".join(row.says for row in verdicts)
    found = []
    bad = [f"{row.input} on {row.cv}" for row in verdicts if row.verdict == "bad"]
    if bad:
        found.append(f"Do not use {', '.join(bad)} as it is: its verdict says why, and what to do.")
    if "would show it all" in says or "give more samples" in says:
        found.append(
            f"Give more samples than {model.samples} (--samples), or a longer sampling interval (--dt)."
        )
    hidden = {"noise leaves": "noise", "moves in steps of": "the steps of a CV", "has gone back": "backlash"}
    if by := [what for words, what in hidden.items() if words in says]:
        found.append(f"Give larger steps (--mv NAME=VALUE:STEP), which {' and '.join(by)} hide less.")
    if "it integrates" in says:
        found.append("Leave out CVs that integrate, or control them with a horizon that the model covers.")
    return tuple(found)
