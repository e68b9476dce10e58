"""What is to be thought of each pair that was identified from a log, and which pairs the log cannot tell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmpc.model.identification import PairVerdict, Verdict
from jaxmpc.process.process import amount

GOOD, USABLE = 0.15, 0.5  # half width of the band over the largest coefficient
SEEN = 1.5  # half widths that a coefficient is away from zero, of a response that is there
NOTHING, HARDLY = 0.05, 0.01  # shares of the range of a CV that make no response
TOO_SMALL = 0.01  # of its level, or of 100 %: moves of an input that tell nothing of larger ones
COLLINEAR, ALIKE = 0.995, 0.95  # share of the variance of an input that the other inputs explain
TOGETHER = 5  # samples by which inputs that move together may be apart


class Excitation(NamedTuple):
    """How one input moves in a log.

    Attributes:
        moved: highest less lowest value [input unit].
        level: where it is at the median [input unit].
        unit: its unit.
        alike: share of its variance that the others explain [1].
        other: the one that moves most like it.
    """

    moved: float
    level: float
    unit: str
    alike: float
    other: str

    @property
    def twin(self) -> str:
        """Words for an input that moves like another; empty for one that does not."""
        if self.alike <= COLLINEAR:
            return ""
        share = f"{100 * self.alike:.3g} % of its variance"
        return f"moves like {self.other} ({share}): the data cannot tell which of the two acts"

    @property
    def small(self) -> bool:
        """Whether its moves are small for an input of its kind."""
        return self.moved < TOO_SMALL * (100.0 if self.unit == "%" else abs(self.level))


def excitations(names, units, values: Float[np.ndarray, "sample input"], segments) -> list[Excitation]:
    """Of every input."""
    moved = np.concatenate([values[own] - values[own].mean(axis=0) for own in segments])
    size = moved.std(axis=0)
    scaled = moved / np.where(size > 0, size, 1.0)
    out = []
    for j in range(len(names)):
        others = [k for k in range(len(names)) if k != j and size[k] > 0]
        alike, other = 0.0, ""
        if others and size[j] > 0:
            past = [np.roll(scaled[:, k], lag) for k in others for lag in range(-TOGETHER, TOGETHER + 1)]
            columns = np.stack(past, axis=1)
            gram = columns.T @ columns + 1e-9 * len(columns) * np.eye(len(past))
            right = columns.T @ scaled[:, j]
            alike = float(right @ np.linalg.solve(gram, right) / len(columns))
            near = np.abs(right.reshape(len(others), -1)).max(axis=1)
            other = names[others[int(np.argmax(near))]]
        ptp = float(np.ptp(values[:, j])) if len(values) else 0.0
        out.append(Excitation(ptp, float(np.median(values[:, j])), units[j], min(alike, 1.0), other))
    return out


def verdict_of(
    cv: str,
    cv_unit: str,
    cv_range: float,
    name: str,
    excited: Excitation,
    steps: Float[np.ndarray, " n"],
    band: Float[np.ndarray, " n"],
    doubts: list[str],
) -> PairVerdict:
    """The verdict of one pair.

    Args:
        cv_range: range of the CV in the log [CV unit].
        steps: S(1)..S(N) [CV unit per input unit].
        band: half widths of its 95 % bands.
        doubts: reservations that come from elsewhere.
    """
    per = f"{cv_unit} per {excited.unit}".strip() if cv_unit or excited.unit else "CV unit per input unit"
    verdict: Verdict
    if excited.moved == 0:
        return PairVerdict(cv, name, "bad", f"{name} never moves in the log: step it, or leave it out")
    peak, half = float(np.abs(steps).max()), float(band.max())
    span = amount(excited.moved, excited.unit)
    if excited.twin:
        return PairVerdict(cv, name, "bad", f"{name} {excited.twin}; move one without the other")
    if (peak + half) * excited.moved <= HARDLY * cv_range and not excited.small:
        words = f"no response: moves of {span} change {cv} by {amount((peak + half) * excited.moved, cv_unit)} at most"
        return PairVerdict(cv, name, "none", words)
    if not (np.abs(steps) > SEEN * band).any():
        if excited.small:
            words = f"{name} moves by {span} only: no response is seen, which tells nothing of larger moves"
            return PairVerdict(cv, name, "bad", words)
        if half * excited.moved <= NOTHING * cv_range:
            words = f"no response: 0 within ±{half:.3g} {per}, so that moves of {span} change {cv} by "
            return PairVerdict(cv, name, "none", words + f"{amount(half * excited.moved, cv_unit)} at most")
        words = f"cannot tell: {steps[-1]:.3g} ± {half:.3g} {per}, zero within the band; "
        return PairVerdict(cv, name, "bad", f"{words}larger or more moves of {name} are needed")
    share = half / peak
    gain = f"gain {steps[-1]:.4g} ± {band[-1]:.2g} {per}"
    if share > USABLE:
        words = f"{gain}: known within {100 * share:.0f} % of its largest value only; more moves of {name} are needed"
        return PairVerdict(cv, name, "bad", words)
    verdict = "good" if share <= GOOD and not doubts else "look"
    words = [gain]
    if share > GOOD:
        words.append(f"known within {100 * share:.0f} % of its largest value")
    if excited.alike > ALIKE:
        verdict = "look"
        words.append(f"{name} moves much like {excited.other} ({100 * excited.alike:.3g} %)")
    return PairVerdict(cv, name, verdict, "; ".join([*words, *doubts]))
