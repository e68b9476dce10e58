"""What residuals say: whether they are white, independent of past inputs, and whether inputs follow them (feedback)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

LAGS = 20  # of the test of whiteness
SIGNIFICANT = (
    4.5  # standard deviations of a correlation, for some hundred of them together about one in a thousand
)
LEAST = 0.05  # correlation below which feedback or a wrong model makes no difference
EXACT = 1e-6  # share of the variance of a CV below which residuals are rounding


class Residuals(NamedTuple):
    """Results of the tests of one CV.

    Attributes:
        white: probability of residuals as correlated as these if they were white.
        past: by input, the largest correlation of a residual with an earlier move.
        feedback: by input, the largest correlation of a move with an earlier or simultaneous residual.
        limit: of the correlations, beyond which they are no chance.
    """

    white: float
    past: Float[np.ndarray, " input"]
    feedback: Float[np.ndarray, " input"]
    limit: float


def examined(
    errors: Float[np.ndarray, " sample"], inputs: Float[np.ndarray, "sample input"], segments, length: int
) -> Residuals:
    """Test the innovations of a CV.

    Args:
        errors: what could not be foreseen, in the unit of the standard deviation of the CV; NaN where missing.
        inputs: of the same samples.
        segments: samples of each segment, across which nothing is correlated.
        length: N.
    """
    count = int(np.isfinite(errors).sum())
    if count < 30 or np.nanvar(errors) < EXACT:
        nothing = np.zeros(inputs.shape[1])
        return Residuals(1.0, nothing, nothing, 1.0)
    scaled = (errors - np.nanmean(errors)) / np.nanstd(errors)
    moves = np.full(inputs.shape, np.nan)
    for own in segments:
        moves[own][1:] = np.diff(inputs[own], axis=0)
    size = np.sqrt(np.nanmean(moves**2, axis=0))
    moves = moves / np.where(size > 0, size, 1.0)
    own = np.array([_correlation(scaled, scaled, k, segments) for k in range(1, LAGS + 1)])
    white = float(chi2.sf(count * (own**2).sum(), LAGS))
    reach = min(length, 60)
    each = lambda lags, sign: np.array(  # noqa: E731
        [
            max(abs(_correlation(*((u, scaled) if sign > 0 else (scaled, u)), k, segments)) for k in lags)
            for u in moves.T
        ]
    )
    past, feedback = each(range(1, reach + 1), 1), each(range(reach + 1), -1)
    return Residuals(white, past, feedback, max(LEAST, SIGNIFICANT / np.sqrt(count)))


def _correlation(first: np.ndarray, later: np.ndarray, lag: int, segments) -> float:
    """Mean product of a signal and another one `lag` samples later, within segments."""
    total, count = 0.0, 0
    for own in segments:
        a, b = first[own], later[own]
        if len(a) <= lag:
            continue
        product = a[: len(a) - lag] * b[lag:]
        known = np.isfinite(product)
        total, count = total + float(product[known].sum()), count + int(known.sum())
    return total / count if count else 0.0
