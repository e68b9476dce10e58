"""What an identification ends in: a model, a verdict on every pair, and the records that support it.

`identify` makes it from an FMU or from logged data, and `figures.identification` draws it on one page.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxmpc.model.step_response import StepResponseModel

Verdict = Literal["good", "look", "none", "bad"]  # use it; look at it first; no response; not to be used


class PairVerdict(NamedTuple):
    """What is to be thought of the response of one CV to one MV or DV.

    Attributes:
        cv, input: names, of the MV or DV that acts.
        verdict: ``good``, ``look`` (usable, with a reservation), ``none`` (no response) or ``bad`` (not to be used).
        says: why, with numbers and units.
    """

    cv: str
    input: str
    verdict: Verdict
    says: str


@dataclasses.dataclass(frozen=True)
class Record:
    """A test or a piece of logged data, and what the model makes of it.

    Attributes:
        title: for example ``valve +2 %``.
        times: [s].
        inputs: MVs, then DVs [their units].
        measured: CVs [CV unit]; NaN where there is no measurement.
        predicted: CVs by the model alone, from the inputs [CV unit].
        used: whether a sample was used for the model; the others were left out to judge it.
    """

    title: str
    times: Float[np.ndarray, " sample"]
    inputs: Float[np.ndarray, "sample input"]
    measured: Float[np.ndarray, "sample cv"]
    predicted: Float[np.ndarray, "sample cv"]
    used: Bool[np.ndarray, " sample"]


@dataclasses.dataclass(frozen=True)
class Identification:
    """A model with what supports it.

    Attributes:
        model: that was identified.
        verdicts: of every pair, CV by CV.
        notes: what was assumed or seen that concerns no single pair.
        advice: what to do next, the most useful first.
        bands: half widths of 95 % confidence bands around the coefficients, MVs then DVs; None where there is no estimate.
        alternatives: other responses of the pairs by name, such as steps of another size or a fit with dead time.
        records: tests or data with predictions.
    """

    model: StepResponseModel
    verdicts: tuple[PairVerdict, ...]
    notes: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()
    bands: Float[np.ndarray, "cv input n"] | None = None
    alternatives: Mapping[str, Float[np.ndarray, "cv input n"]] = dataclasses.field(default_factory=dict)
    records: tuple[Record, ...] = ()

    @property
    def responses(self) -> Float[np.ndarray, "cv input n"]:
        """Coefficients of the MVs, then of the DVs [CV unit per input unit]."""
        return self.model.responses

    @property
    def worst(self) -> Verdict:
        """The worst verdict of a pair; pairs without a response count as good."""
        found = {row.verdict for row in self.verdicts}
        return "bad" if "bad" in found else "look" if "look" in found else "good"
