"""The knobs of a model plant by the prediction errors of a log: factor of the gain, added dead time, factor of the time.

A few numbers per pair instead of a response, near those of the present model: ``x = (gain, delay, ln scale)`` minimises

    |W (y - O z - sum_j g_j * u_j)|^2 / s^2 + sum (x - x0)^2 / deviation^2 + z P z / s^2,

W the whitening of the noise (`identify.logged.noise`), g_j the warped response of `jaxmpc.process.model_plant`, O z offsets
and free responses of the segments. With a noise model that fits, prediction errors are consistent in a closed loop, too,
whose moves follow what the noise did before (Ljung 1999, section 13.4).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from identify.logged.noise import CANDIDATES, Noise, likeliest, whitened
from identify.logged.regression import free_columns, predicted
from jaxmpc.process.model_plant import NOTHING, warped

GAIN, SCALE = (
    0.5,
    0.3,
)  # standard deviations of the factors before the data are seen, of the time in logarithms
DELAY, LEAST_DELAY = 0.3, 3.0  # likewise of the delay: share of the time to 63 %, and samples at least
MOST_SCALE = 1.1  # largest logarithm of the factor of the time
SHIFTS = (-3.0, 3.0)  # samples by which other delays are tried: prediction errors may have several valleys
ROUNDS, TRIES = 4, 10  # of noise models; evaluations of a try
DELAY_STEP, SCALE_STEP = 0.25, 0.01  # of derivatives


@dataclasses.dataclass(frozen=True)
class Case:
    """One CV with the inputs that may move it.

    Attributes:
        nominal: present step responses ``"input n"`` [CV unit per input unit].
        inputs: deviations from the first value of each segment ``"sample input"``.
        output: ``"sample"``, NaN where missing or left out [CV unit].
        segments: samples of each.
    """

    nominal: Float[np.ndarray, "input n"]
    inputs: Float[np.ndarray, "sample input"]
    output: Float[np.ndarray, " sample"]
    segments: Sequence[slice]

    @property
    def silent(self) -> Float[np.ndarray, " input"]:
        """Samples of dead time that the present responses have."""
        size = np.abs(self.nominal)
        return np.argmax(size > NOTHING * size.max(axis=1, keepdims=True), axis=1).astype(float)

    @property
    def prior(self) -> Float[np.ndarray, "input 3"]:
        """Standard deviations of `x` before the data are seen."""
        size = np.abs(self.nominal) >= 0.63 * np.abs(self.nominal).max(axis=1, keepdims=True)
        rise = np.argmax(size, axis=1) - self.silent
        delay = np.maximum(DELAY * rise, LEAST_DELAY)
        return np.stack([np.full_like(delay, GAIN), delay, np.full_like(delay, SCALE)], axis=1)

    def steps(self, x: Float[np.ndarray, "input 3"]) -> list[Float[np.ndarray, " register"]]:
        """Step responses, of lengths of their own; beyond them they stay as they end."""
        one = lambda v: np.array([[v]])  # noqa: E731
        return [
            warped(s[None, None], one(gain), one(delay), one(np.exp(scale)))[0, 0]
            for s, (gain, delay, scale) in zip(self.nominal, x, strict=True)
        ]

    def step_slopes(self, x: Float[np.ndarray, "input 3"]) -> list[Float[np.ndarray, "3 register"]]:
        """Derivatives of the step responses by `x`, of each input's own."""
        ones = np.concatenate([np.ones((len(x), 1)), x[:, 1:]], axis=1)
        found = [[s] for s in self.steps(ones)]
        for k, step in ((1, DELAY_STEP), (2, SCALE_STEP)):
            up, down = x.copy(), x.copy()
            up[:, k] += step
            down[:, k] = np.maximum(down[:, k] - step, -self.silent if k == 1 else -np.inf)
            pairs = zip(self.steps(up), self.steps(down), (up - down)[:, k], strict=True)
            for own, (high, low, wide) in zip(found, pairs, strict=True):
                own.append(np.subtract(*together([high, low])) / wide)
        return [together(own) for own in found]

    def effects(self, responses: Sequence[np.ndarray]) -> Float[np.ndarray, "sample input"]:
        """What each input does to the CV through a step response [CV unit]."""
        out = np.zeros(self.inputs.shape)
        for j, s in enumerate(responses):
            impulse = np.diff(s, prepend=0.0)[None]
            for own in self.segments:
                out[own, j] = predicted(impulse, self.inputs[own, j : j + 1])
        return out

    def explained(self, x: Float[np.ndarray, "input 3"]) -> Float[np.ndarray, " sample"]:
        """What all inputs do [CV unit]."""
        return self.effects(self.steps(x)).sum(axis=1)

    def slopes(self, x: Float[np.ndarray, "input 3"]) -> Float[np.ndarray, "sample p"]:
        """Derivatives of what is explained by `x`, in its order."""
        each = self.step_slopes(x)
        return np.stack([self.effects([own[k] for own in each]) for k in range(3)], axis=-1).reshape(
            len(self.output), -1
        )


def together(responses: Sequence[np.ndarray]) -> Float[np.ndarray, "response n"]:
    """Responses of one length, those that end before stay as they end."""
    length = max(map(len, responses))
    return np.stack([np.pad(s, (0, length - len(s)), mode="edge") for s in responses])


@dataclasses.dataclass(frozen=True)
class Found:
    """What the data say of the knobs of one CV.

    Attributes:
        x: ``"input 3"``, gain, delay [samples], logarithm of the scale.
        covariance: ``"input*3 input*3"`` of it, prior included.
        noise: its model.
        variance: of the prediction errors.
    """

    x: Float[np.ndarray, "input 3"]
    covariance: Float[np.ndarray, "p p"]
    noise: Noise
    variance: float

    @property
    def deviations(self) -> Float[np.ndarray, "input 3"]:
        """Standard deviations of `x`."""
        return np.sqrt(np.diag(self.covariance)).reshape(self.x.shape)


class _Errors:
    """Prediction errors under one noise model, offsets and free responses eliminated: linear in what is not explained."""

    def __init__(self, case: Case, noise: Noise, free: float):
        self.case, self.noise, self.parts, self.constant = case, noise, [], 0.0
        for own in case.segments:
            known = np.isfinite(case.output[own])
            if not known.any():
                continue
            columns, precision = free_columns(len(known), case.nominal.shape[1], free)
            root = np.sqrt(precision)
            found = list(whitened(noise, iter([columns]), known))
            white = np.concatenate([rows for rows, _ in found])
            inner = white.T @ white + np.diag(precision)
            self.constant += sum(logs for _, logs in found) + np.linalg.slogdet(inner)[1]
            solve = np.linalg.solve(inner, white.T)
            self.parts.append((own, known, columns, white, root, solve))

    def _white(self, values: np.ndarray, known: np.ndarray) -> np.ndarray:
        return np.concatenate([rows for rows, _ in whitened(self.noise, iter([values]), known)])

    def of(self, values: Float[np.ndarray, "sample column"]) -> Float[np.ndarray, "row column"]:
        """Errors that columns leave."""
        out = []
        for own, known, _, white, root, solve in self.parts:
            rows = self._white(np.nan_to_num(values[own]), known)
            z = solve @ rows
            out += [rows - white @ z, root[:, None] * z]
        return np.concatenate(out)

    def score(self, x: Float[np.ndarray, "input 3"], slopes: Float[np.ndarray, "sample p"]) -> float:
        """Twice the negative logarithm of the likelihood of the noise, all that is estimated integrated out, near `x`."""
        case, precision = self.case, np.diag(self.case.prior.ravel() ** -2)
        rows = self.of(np.column_stack([case.output - case.explained(x), slopes]))
        left, slope, count = rows[:, 0], rows[:, 1:], int(np.isfinite(case.output).sum())
        variance = float((left**2).sum()) / count
        change = np.linalg.solve(slope.T @ slope + variance * precision, slope.T @ left)
        variance = float(((left - slope @ change) ** 2).sum()) / count
        known = np.linalg.slogdet(slope.T @ slope / variance + precision)[1]
        return count * np.log(variance) + self.constant + known

    def left(self, values: Float[np.ndarray, " sample"]) -> list[Float[np.ndarray, " sample"]]:
        """What offsets and free responses leave of a series, by segment and unfiltered."""
        out = []
        for own, known, columns, _, _, solve in self.parts:
            rows = self._white(np.nan_to_num(values[own])[:, None], known)
            out.append(np.where(known, values[own] - columns @ (solve @ rows)[:, 0], np.nan))
        return out


def fit_knobs(case: Case) -> Found:
    """The likeliest knobs of one CV with their covariance."""
    count = int(np.isfinite(case.output).sum())
    size = float(np.nanvar(case.output)) or 1.0
    x0 = np.tile([1.0, 0.0, 0.0], (len(case.nominal), 1))
    x, noise, variance = x0, None, size
    errors = _Errors(case, Noise(), 1.0)
    for turn in range(ROUNDS):
        alone = case.output - case.explained(x)
        now = likeliest(errors.left(alone))
        if now == noise:
            break
        noise, errors = now, _likeliest_near(case, now, variance / size, x)
        variance = max(float((errors.of(alone[:, None]) ** 2).sum()) / count, 1e-12 * size)
        x = _least(case, errors, x, x0, variance, shifts=SHIFTS if turn == 0 else ())
        alone = case.output - case.explained(x)
        variance = max(float((errors.of(alone[:, None]) ** 2).sum()) / count, 1e-12 * size)
    information = errors.of(case.slopes(x))
    information = information.T @ information / variance + np.diag(case.prior.ravel() ** -2)
    return Found(x, np.linalg.inv(information), errors.noise, variance)


def _likeliest_near(case: Case, noise: Noise, free: float, x: np.ndarray) -> _Errors:
    """The likeliest noise beside a first guess, which is that of residuals and takes what was fitted for none of it."""
    grid = [sorted({one[k] for one in CANDIDATES}) for k in range(2)]
    slopes, tried = case.slopes(x), {}

    def score(one: Noise) -> float:
        if one not in tried:
            errors = _Errors(case, one, free)
            tried[one] = errors.score(x, slopes), errors
        return tried[one][0]

    def beside(one: Noise, other: Noise) -> bool:
        apart = [abs(own.index(one[k]) - own.index(other[k])) for k, own in enumerate(grid)]
        return one.white == other.white and max(apart) <= 1

    while noise in CANDIDATES:
        best = min((one for one in CANDIDATES if beside(noise, one)), key=score)
        if best == noise:
            break
        noise = best
    return tried[noise][1] if noise in tried else _Errors(case, noise, free)


def _least(
    case: Case, errors: _Errors, x: np.ndarray, x0: np.ndarray, variance: float, shifts: Sequence[float]
) -> np.ndarray:
    """The least sum of squares from a start, and from starts with other delays of single inputs."""
    prior, shape, deviation = case.prior, x.shape, np.sqrt(variance)
    low, high = np.full(shape, -np.inf), np.full(shape, np.inf)
    low[:, 1], low[:, 2], high[:, 2] = -case.silent - 1e-9, -MOST_SCALE, MOST_SCALE
    bounds = low.ravel(), high.ravel()

    def residuals(flat: np.ndarray) -> np.ndarray:
        at = flat.reshape(shape)
        alone = case.output - case.explained(at)
        return np.concatenate([errors.of(alone[:, None])[:, 0] / deviation, ((at - x0) / prior).ravel()])

    def slopes(flat: np.ndarray) -> np.ndarray:
        own = errors.of(case.slopes(flat.reshape(shape)))
        return np.concatenate([-own / deviation, np.diag(1 / prior.ravel())])

    def solved(start: np.ndarray, tries: int):
        start = np.clip(start.ravel(), *bounds)
        given: dict[str, Any] = dict(jac=slopes, bounds=bounds, x_scale=prior.ravel())
        return least_squares(residuals, start, **given, max_nfev=tries, xtol=1e-6)

    best = solved(x, 3 * TRIES)
    for j in range(len(x)):
        for shift in shifts:
            other = best.x.reshape(shape).copy()
            other[j, 1] += shift
            found = solved(other, TRIES)
            if found.cost < best.cost * (1 - 1e-6):
                best = found
    return best.x.reshape(shape)
