"""What is said of an identification from a log: a verdict on every pair, how it was made, and what to do next."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from identify.logged.fit import Data, Fit, climbing
from identify.logged.judge import verdict_of
from identify.logged.log import Log
from identify.logged.low_order import LowOrder
from identify.logged.residuals import Residuals
from jaxmpc.model.identification import PairVerdict

SPREAD = 6.9  # median deviations from 1 % to 99 % of a normal distribution
CLOSED = 0.85  # correlation with what disturbs the CV from which on an input tells nothing of its own
WHITE = 0.001  # probability below which residuals are not white


class CvResult(NamedTuple):
    """What was found for one CV, responses with all inputs, those that never move at 0."""

    data: Data
    final: Fit
    fit: float  # % of the part that was left out
    low_fit: float  # % by the low-order responses
    low: list[LowOrder | None]
    steps: np.ndarray  # "input n" [CV unit per input unit]
    band: np.ndarray
    predicted: np.ndarray  # " sample" [CV unit]
    tested: Residuals
    overruled: bool  # whether the part that was left out has decided against the likeliest noise


def pair_verdict(cv: str, log: Log, name: str, excited, found: CvResult, j: int) -> PairVerdict:
    """What is to be thought of the response of a CV to its input `j`, by how that was `excited` and what was `found`."""
    doubts, tested = [], found.tested
    s, unit = found.steps[j], log.units.get(cv, "")
    if found.final.integrating and climbing(s[None])[0]:
        slope = (s[-1] - s[-max(2, len(s) // 5)]) / (max(2, len(s) // 5) - 1) / log.dt
        doubts.append(
            f"integrates: still rises by {slope:.3g} {unit} per second at sample {len(s)}, where the model holds it"
        )
    elif _unsettled(s, found.band[j]):
        doubts.append(f"has not settled by sample {len(s)}: more --samples, or a larger --dt")
    if found.overruled:
        doubts.append(f"depends on what is taken for noise of {cv}, which its inputs do not move linearly")
    if tested.past[j] > tested.limit:
        doubts.append(
            f"residuals still follow moves of {name} (correlation {tested.past[j]:.2f}): slower or not linear"
        )
    if tested.feedback[j] > tested.limit:
        doubts.append(f"{name} follows what disturbs {cv} (feedback, correlation {tested.feedback[j]:.2f})")
    values = log.values[cv]
    span = float(np.nanpercentile(values, 99) - np.nanpercentile(values, 1)) or float(
        np.nanmax(values) - np.nanmin(values)
    )
    # a single large transient is not what the CV does in the log
    usual = SPREAD * float(np.nanmedian(np.abs(values - np.nanmedian(values))))
    row = verdict_of(cv, unit, min(span, usual or span), name, excited, s, found.band[j], doubts)
    closed = tested.feedback[j] > max(CLOSED, tested.limit) and row.verdict in ("good", "look")
    return row._replace(verdict="bad") if closed else row


def _unsettled(steps: np.ndarray, band: np.ndarray) -> bool:
    end = max(2, len(steps) // 10)
    moved = abs(float(steps[-1] - steps[-end]))
    return moved > 0.03 * np.abs(steps).max() and moved > 0.5 * float(np.nanmax(band))


def method_notes(
    log: Log, found: dict[str, CvResult], inputs: Sequence[str], samples: int, cut: int
) -> list[str]:
    """How the model was made of `samples` coefficients, with the first `cut` samples of the log at first, by CV."""
    kept = len(log.times) - cut
    notes = [
        f"the first {cut} samples made a first model, which was judged on the last {kept}; then all made the model in the "
        "file, and the predictions that are drawn are those of the first",
        "before each segment the inputs were taken to have stood at their first values",
    ]
    for name, own in found.items():
        if np.isnan(own.fit):
            notes.append(
                f"{name}: no input moves in the part that was left out, which therefore judges nothing"
            )
        else:
            off = own.low_fit - own.fit
            better = "as well" if abs(off) < 0.5 else "better" if off > 0 else "less well"
            words = f"{name}: {own.fit:.1f} % of the part that was left out is predicted (its level is not: one offset was "
            notes.append(
                f"{words}fitted); first order and dead time predict it {better} ({own.low_fit:.1f} %)"
            )
        words = f"{name}: the noise is {own.final.noise}"
        if own.final.free is not None:
            words += "; segments do not begin at rest, so that a free response was fitted at each beginning"
        notes.append(words)
        if own.overruled:
            notes.append(
                f"{name}: with a drifting disturbance, likelier one sample ahead, the part that was left out is predicted "
                "far worse; bands are too narrow"
            )
        p = own.tested.white
        if p < WHITE:
            notes.append(f"{name}: residuals are not white (p = {p:.1g}): bands may be too narrow")
        fed = [j for j in range(len(inputs)) if own.tested.feedback[j] > own.tested.limit]
        if fed:
            names = ", ".join(inputs[j] for j in fed)
            words = f"{name}: later moves of {names} follow its residuals: a controller or an operator closed the loop. "
            notes.append(
                f"{words}Feedback may bias the responses; moves that do not depend on the CV tell more"
            )
    return notes


def advice(verdicts: Sequence[PairVerdict], log: Log, samples: int) -> tuple[str, ...]:
    """What to do next, for a model of `samples` coefficients."""
    out = []
    bad = list(dict.fromkeys(row.input for row in verdicts if row.verdict == "bad"))
    if bad:
        length = samples * log.dt
        out.append(
            f"Step {', '.join(bad)}, one at a time, up and down, some steps held for {length:g} s, and identify again"
        )
    if any(row.verdict == "look" for row in verdicts):
        out.append(
            "Look at the responses with the verdict look, and at the predictions, before you use the model"
        )
    return tuple(out)
