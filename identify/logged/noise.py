"""Noise of a log, white noise of the measurement and a disturbance that drifts, and how both leave a regression.

A CV is what the inputs do plus ``v(t) = x(t) + w(t)``, ``x(t+1) = phi x(t) + e(t)``, the variances of ``w`` and ``e`` in the
ratio 1 to ``drift``. The Kalman filter of ``x`` turns rows of a regression into rows with independent errors, also where
measurements are missing, for its gains are the same for all columns (Harvey 1989, section 3.4). For ``phi = 1`` the
disturbance is a random walk, the differenced or integrated-noise model.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

CHUNK = 2048  # rows that are filtered at once


class Noise(NamedTuple):
    """A noise model.

    Attributes:
        phi: of the disturbance from sample to sample [1]; 1 for a random walk.
        drift: variance of its increments over that of the white noise [1]; 0 for white noise alone.
        white: variance of the white noise in the same unit: 1, or 0 for none.
    """

    phi: float = 0.0
    drift: float = 0.0
    white: float = 1.0

    def __str__(self) -> str:
        if not self.drift:
            return "white"
        if self.phi == 1:
            return "a random walk" + (" and white noise" if self.white else "")
        return f"a drifting disturbance (AR 1, {self.phi:g})" + (" and white noise" if self.white else "")


WHITE, WALK = Noise(), Noise(1.0, 1.0, 0.0)
CANDIDATES = [
    *(
        Noise(phi, drift)
        for phi in (0.3, 0.6, 0.8, 0.9, 0.95, 0.98, 0.99, 0.997, 1.0)
        for drift in 10.0 ** np.arange(-4.0, 2.1, 0.5)
    ),
    *(Noise(phi, 1.0, 0.0) for phi in (0.3, 0.6, 0.8, 0.9, 0.95, 0.98, 0.99, 0.997, 1.0)),
]


def gains(
    noise: Noise, known: Bool[np.ndarray, " sample"]
) -> tuple[Float[np.ndarray, " sample"], Float[np.ndarray, " sample"]]:
    """Kalman gains, and variances of the innovations, where there is a measurement (gain 0 elsewhere)."""
    phi, drift, white = noise
    p = drift / max(1 - phi**2, 1e-12) if phi < 1 else drift
    gain, variance = np.zeros(len(known)), np.ones(len(known))
    for t, measured in enumerate(known):
        if measured:
            f = p + white
            gain[t], variance[t] = p / f, f
            p = p * white / f
        p = phi**2 * p + drift
    return gain, variance


def whitened(
    noise: Noise, blocks: Iterator[Float[np.ndarray, "row column"]], known: Bool[np.ndarray, " sample"]
) -> Iterator[tuple[Float[np.ndarray, "row column"], float]]:
    """Rows of a regression of one segment with independent errors of equal variance.

    Args:
        noise: its model.
        blocks: rows of consecutive samples, all columns alike filtered.
        known: whether there is a measurement at each sample of the segment.

    Yields:
        Rows with a measurement, and the logarithms of the variances of their innovations, summed.
    """
    if not noise.drift:
        begin = 0
        for block in blocks:
            yield block[known[begin : begin + len(block)]], 0.0
            begin += len(block)
        return
    gain, variance = gains(noise, known)
    state, begin = None, 0
    for block in blocks:
        out = np.empty_like(block)
        state = np.zeros(block.shape[1]) if state is None else state
        for k, row in enumerate(block):
            np.subtract(row, state, out=out[k])
            state += gain[begin + k] * out[k]
            state *= noise.phi
        own = slice(begin, begin + len(block))
        rows = known[own]
        yield out[rows] / np.sqrt(variance[own][rows, None]), float(np.log(variance[own][rows]).sum())
        begin += len(block)


def likeliest(residuals: list[Float[np.ndarray, " sample"]]) -> Noise:
    """The candidate of which residuals, by segment and NaN where missing, are the likeliest."""
    phi, drift, white = np.array(CANDIDATES).T
    total, squares, count = np.zeros(len(phi)), np.zeros(len(phi)), 0
    for series in residuals:
        known = np.isfinite(series)
        if known.sum() < 2:
            continue
        series = series - series[known].mean()
        p = np.where(phi < 1, drift / np.maximum(1 - phi**2, 1e-12), 1e6 * (drift + white))
        x = np.zeros(len(phi))
        for value, measured in zip(series, known, strict=True):
            if measured:
                f = p + white
                error = value - x
                squares += error**2 / f
                total += np.log(f)
                x = x + p / f * error
                p = p * white / f
            x, p = phi * x, phi**2 * p + drift
        count += int(known.sum())
    if count < 4:
        return WHITE
    score = total + count * np.log(np.maximum(squares, 1e-300))
    return CANDIDATES[int(np.argmin(score))]


def innovations(noise: Noise, series: Float[np.ndarray, " sample"]) -> Float[np.ndarray, " sample"]:
    """What one segment of residuals has that could not be foreseen; NaN where there is no measurement."""
    known = np.isfinite(series)
    out = np.full(len(series), np.nan)
    if known.any():
        filled = np.where(known, series - series[known].mean(), 0.0)[:, None]
        rows = [block for block, _ in whitened(noise, iter([filled]), known)]
        out[known] = np.concatenate(rows)[:, 0]
        if noise.drift:
            out[np.argmax(known)] = np.nan  # of where the drift begins nothing is known
    return out
