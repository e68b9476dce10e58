"""The regression of a CV on past inputs, as sums of squares whose size does not depend on the length of the log.

``y(t) = c + sum_j sum_k g_j(k) u_j(t-k) + v(t)``, k = 1..N, per segment an own offset c. Before a segment the inputs are
taken to have stood at their first values; what they did otherwise shows in the first N samples as a free response, for which
each segment may get columns of its own: tents on knots that lie closer where it begins. Offsets and free responses are
eliminated segment by segment (Schur complements), so that sums over the impulse responses alone remain.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from identify.logged.noise import CHUNK, Noise, whitened

FLAT = 1e-8  # precision of offsets and slopes over that of the noise


@dataclasses.dataclass(frozen=True)
class Segment:
    """One segment of the data of a CV, scaled.

    Attributes:
        inputs: deviations from their first values; the sums of them over time for CVs that integrate.
        output: NaN where it is missing or left out.
    """

    inputs: Float[np.ndarray, "sample input"]
    output: Float[np.ndarray, " sample"]


@dataclasses.dataclass(frozen=True)
class Sums:
    """What is known of impulse responses: ``g`` has the likelihood ``exp(-(square - 2 b g + g G g) / 2 s)``, s the variance.

    Attributes:
        gram: ``"input lag input lag"``, G.
        right: ``"input lag"``, b.
        square: of the CV that offsets and free responses do not explain.
        count: of measurements.
        constant: what a likelihood has beyond the impulse responses: twice the negative logarithm.
    """

    gram: Float[np.ndarray, "input n input n"]
    right: Float[np.ndarray, "input n"]
    square: float
    count: int
    constant: float


def tents(samples: int, length: int) -> Float[np.ndarray, "sample knot"]:
    """Piecewise linear functions that begin at 0, 1, 2, 3, 5, 8, ... and have all ended after `length` samples."""
    knots = [0]
    while knots[-1] < length:
        knots.append(max(knots[-1] + 1, round(1.5 * knots[-1])))
    knots[-1] = max(length, knots[-2] + 1 if len(knots) > 1 else 1)
    t = np.arange(samples)
    return np.stack([np.interp(t, knots, unit, right=0.0) for unit in np.eye(len(knots))[:-1]], axis=1)


def sums(
    segments: list[Segment], length: int, noise: Noise, *, free: float | None = None, slope: bool = False
) -> Sums:
    """Sums of squares and products of all segments.

    Args:
        segments: of one CV.
        length: N, lags of each input.
        noise: that whitens the rows.
        free: precision of free responses over that of the noise; None for segments that begin at rest.
        slope: whether each segment has a slope besides its offset, for CVs that integrate.
    """
    inputs = segments[0].inputs.shape[1]
    width = inputs * length
    total = np.zeros((width + 1, width + 1))
    count, constant = 0, 0.0
    for segment in segments:
        known = np.isfinite(segment.output)
        if not known.any():
            continue
        own, precision = free_columns(len(known), length, free, slope=slope)
        square = np.zeros((own.shape[1] + width + 1,) * 2)
        for rows, logs in whitened(noise, _rows(segment, own, length), known):
            square += rows.T @ rows
            constant += logs
        z = own.shape[1]
        inner = square[:z, :z] + np.diag(precision)
        factor = np.linalg.cholesky(inner)
        part = np.linalg.solve(factor, square[:z, z:])
        total += square[z:, z:] - part.T @ part
        constant += 2 * np.log(np.diag(factor)).sum() - np.log(precision).sum()
        count += int(known.sum())
    shape = (inputs, length)
    return Sums(
        total[:-1, :-1].reshape(*shape, *shape),
        total[:-1, -1].reshape(shape),
        float(total[-1, -1]),
        count,
        constant,
    )


def free_columns(
    samples: int, length: int, free: float | None, *, slope: bool = False
) -> tuple[Float[np.ndarray, "sample column"], Float[np.ndarray, " column"]]:
    """Columns that one segment has for itself, and their precisions."""
    columns, precision = [np.ones((samples, 1))], [FLAT]
    if slope:
        columns.append(np.linspace(-1, 1, samples)[:, None])
        precision.append(FLAT)
    if free is not None:
        shown = tents(samples, length)
        shown = shown[:, np.abs(shown).sum(axis=0) > 0]
        columns.append(shown)
        precision += [free] * shown.shape[1]
    return np.concatenate(columns, axis=1), np.array(precision)


def _rows(segment: Segment, own: np.ndarray, length: int) -> Iterator[np.ndarray]:
    """Rows ``[own columns, past inputs, CV]`` in blocks; past inputs as ``"input lag"``, lag 1 first."""
    samples, inputs = segment.inputs.shape
    past = np.concatenate([np.zeros((length, inputs)), segment.inputs[:-1]])
    windows = np.lib.stride_tricks.sliding_window_view(past, length, axis=0)[:, :, ::-1]
    output = np.nan_to_num(segment.output)[:, None]
    for begin in range(0, samples, CHUNK):
        at = slice(begin, begin + CHUNK)
        flat = windows[at].reshape(len(output[at]), inputs * length)
        yield np.concatenate([own[at], flat, output[at]], axis=1)


def predicted(
    impulse: Float[np.ndarray, "input n"], inputs: Float[np.ndarray, "sample input"]
) -> Float[np.ndarray, " sample"]:
    """What past inputs make of a CV, without its offset: the sum over inputs and lags 1..N."""
    samples = len(inputs)
    out = np.zeros(samples)
    for response, signal in zip(impulse, inputs.T, strict=True):
        size = 1 << int(np.ceil(np.log2(samples + len(response))))
        product = np.fft.rfft(signal, size) * np.fft.rfft(response, size)
        out[1:] += np.fft.irfft(product, size)[: samples - 1]
    return out
