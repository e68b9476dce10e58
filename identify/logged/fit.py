"""The fit of one CV: which noise, how segments begin, and whether it integrates, each decided by the marginal likelihood."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from identify.logged.kernel import Posterior, estimate
from identify.logged.noise import WALK, WHITE, Noise, likeliest
from identify.logged.regression import Segment, free_columns, predicted, sums

ROUNDS = 2  # of noise models estimated from residuals
GAIN = 6.0  # by which twice a log-likelihood must improve for a model with more in it
RAMP = 0.15  # of the mean slope of a response, which its end has at least where an integrating CV is tried
WIDER, NARROWEST = 1.15, 0.2  # factor of all bands; least deviation over the largest of a response
USELESS = 0.9  # of what unseen samples do: a fit that leaves as much foresees nothing
OVERRULED = (
    1.3  # times as much that is left of unseen samples, from which on a noise model is not the likeliest
)
LEAST_PRIOR = 0.3  # of the standard deviation of a CV per standard deviation of an input


@dataclasses.dataclass(frozen=True)
class Data:
    """One CV and the inputs that moved, scaled to the size of 1.

    Attributes:
        inputs: deviations from the first value of each segment, over `input_scale`.
        output: deviations from the mean, over `output_scale`; NaN where missing.
        segments: samples of each.
    """

    inputs: Float[np.ndarray, "sample input"]
    output: Float[np.ndarray, " sample"]
    segments: tuple[slice, ...]
    input_scale: Float[np.ndarray, " input"]
    output_scale: float

    def until(self, end: int) -> Data:
        """The same with the samples from `end` on left out."""
        output = np.where(np.arange(len(self.output)) < end, self.output, np.nan)
        return dataclasses.replace(self, output=output)

    def parts(self, integrating: bool) -> list[Segment]:
        """Its segments; with inputs summed over time for a CV that integrates."""
        through = (lambda u: np.cumsum(u, axis=0) / self._sum_scale) if integrating else (lambda u: u)
        return [Segment(through(self.inputs[own]), self.output[own]) for own in self.segments]

    @property
    def _sum_scale(self) -> Float[np.ndarray, " input"]:
        sums_ = np.concatenate([np.cumsum(self.inputs[own], axis=0) for own in self.segments])
        return np.maximum(sums_.std(axis=0), 1e-9)

    def to_steps(self, integrating: bool, length: int) -> Float[np.ndarray, "input n n"]:
        """What makes step responses [CV unit per input unit] of the impulse responses of a fit."""
        total = np.tril(np.ones((length, length)))
        if integrating:
            total = total @ total / self._sum_scale[:, None, None]
        return (
            self.output_scale
            / self.input_scale[:, None, None]
            * np.broadcast_to(total, (len(self.input_scale), length, length))
        )


def make_data(
    output: Float[np.ndarray, " sample"], inputs: Float[np.ndarray, "sample input"], segments: Sequence[slice]
) -> Data:
    """Scale a CV and its inputs, all of which move."""
    moved = np.concatenate([inputs[own] - inputs[own][:1] for own in segments])
    centred = np.full(len(output), np.nan)
    for own in segments:
        if np.isfinite(output[own]).any():
            centred[own] = output[own] - np.nanmean(output[own])
    scale = np.maximum(np.sqrt((moved**2).mean(axis=0)), 1e-300)
    size = float(np.nanstd(centred)) or 1.0
    return Data(moved / scale, centred / size, tuple(segments), scale, size)


@dataclasses.dataclass(frozen=True)
class Fit:
    """What was found for one CV.

    Attributes:
        posterior: impulse responses, scaled.
        noise: model of what the inputs do not explain.
        free: precision of the free responses at the beginnings; None where segments begin at rest.
        integrating: whether the CV integrates its inputs.
    """

    posterior: Posterior
    noise: Noise = WHITE
    free: float | None = None
    integrating: bool = False

    def steps(self, data: Data) -> Float[np.ndarray, "input n"]:
        """Step responses [CV unit per input unit]."""
        mean = self.posterior.mean
        return np.einsum("jnk,jk->jn", data.to_steps(self.integrating, mean.shape[1]), mean)

    def deviations(self, data: Data) -> Float[np.ndarray, "input n"]:
        """Standard deviations of the step responses [CV unit per input unit]."""
        root = self.posterior.root
        spread = np.einsum("jnk,jkp->jnp", data.to_steps(self.integrating, root.shape[1]), root)
        return np.sqrt((spread**2).sum(axis=-1))


def fitted(data: Data, length: int, like: Fit, iterations: int = 60, fresh: bool = False) -> Fit:
    """A fit with the structure of another, from its hyperparameters; from screened ones if `fresh`."""
    parts = data.parts(like.integrating)
    known = sums(parts, length, like.noise, free=like.free, slope=like.integrating)
    found = estimate(known, None if fresh else like.posterior.parameters, iterations)
    return dataclasses.replace(like, posterior=found)


def search(data: Data, length: int) -> Fit:
    """The fit whose structure makes the data of a CV the likeliest."""
    best = _searched(data, length, integrating=False)
    if climbing(best.steps(data)).any():
        other = _searched(data, length, integrating=True)
        if other.posterior.score < best.posterior.score - GAIN:
            best = other
    return best


def chosen(data: Data, length: int, cut: int) -> tuple[Fit, bool]:
    """The fit of the samples before `cut`, and whether those after it overruled the likelihood.

    The likelihood judges predictions one sample ahead. Where a CV is not linear in its inputs, that may make a drifting
    disturbance of what they do, and any response will do. It then foresees nothing of the samples after `cut` from the
    inputs alone; a fit without drift that does is taken.
    """
    training = data.until(cut)
    likely = search(training, length)
    missed, unseen = _missed(data, likely, cut), data.output[cut:]
    moved = float(np.nanvar(unseen)) * np.isfinite(unseen).sum() if np.isfinite(unseen).any() else 0.0
    if likely.noise == WHITE or missed < USELESS * moved:
        return likely, False
    level = fitted(training, length, dataclasses.replace(likely, noise=WHITE), fresh=True)
    overruled = OVERRULED * _missed(data, level, cut) < missed
    return (level if overruled else likely), overruled


def _missed(data: Data, fit: Fit, cut: int) -> float:
    """Sum of squares of the samples from `cut` on that the inputs alone do not explain, beside one offset per segment."""
    return float(np.nansum((data.output - simulated(data, fit, cut))[cut:] ** 2))


def _searched(data: Data, length: int, *, integrating: bool) -> Fit:
    blank = Posterior(np.zeros(0), np.zeros(0), 1.0, np.inf, np.zeros(0))  # pyright: ignore[reportArgumentType]
    best = fitted(data, length, Fit(blank, WHITE, None, integrating), fresh=True)
    best = _better(best, fitted(data, length, dataclasses.replace(best, noise=WALK), 30))
    for _ in range(ROUNDS):
        noise = likeliest(residuals(data, best))
        if noise == best.noise:
            break
        tried = fitted(data, length, dataclasses.replace(best, noise=noise), 30)
        if _better(best, tried) is best:
            break
        best = tried
    free = max(best.posterior.variance, 1e-12)  # a free response may be as large as the CV moves
    return _better(best, fitted(data, length, dataclasses.replace(best, free=free), 30))


def _better(simple: Fit, rich: Fit) -> Fit:
    return rich if rich.posterior.score < simple.posterior.score - GAIN else simple


def climbing(steps: Float[np.ndarray, "input n"]) -> Bool[np.ndarray, " input"]:
    """Which responses still move where they end."""
    end = max(2, steps.shape[1] // 5)
    mean = np.abs(steps).max(axis=1) / steps.shape[1]
    return np.abs(steps[:, -1] - steps[:, -end]) / end > RAMP * np.maximum(mean, 1e-300)


def residuals(data: Data, fit: Fit) -> list[Float[np.ndarray, " sample"]]:
    """What a fit does not explain of each segment, scaled; offsets and free responses are taken out."""
    out = []
    length = fit.posterior.mean.shape[1]
    for part in data.parts(fit.integrating):
        left = part.output - predicted(fit.posterior.mean, part.inputs)
        known = np.isfinite(left)
        own, _ = free_columns(len(left), length, fit.free, slope=fit.integrating)
        if known.any():
            left = left - own @ np.linalg.lstsq(own[known], left[known], rcond=None)[0]
        out.append(left)
    return out


def simulated(data: Data, fit: Fit, used: int) -> Float[np.ndarray, " sample"]:
    """The CV [scaled] by the inputs alone; samples from `used` on have an own offset per segment, as those before."""
    out = np.full(len(data.output), np.nan)
    place = np.arange(len(data.output))
    for own, part in zip(data.segments, data.parts(fit.integrating), strict=True):
        alone = predicted(fit.posterior.mean, part.inputs)
        for half in (place[own] < used, place[own] >= used):
            known = half & np.isfinite(part.output)
            offset = (part.output - alone)[known].mean() if known.any() else 0.0
            out[own] = np.where(half, alone + offset, out[own])
    return out


def bands(data: Data, fit: Fit) -> Float[np.ndarray, "input n"]:
    """Half widths of 95 % bands of the step responses [CV unit per input unit].

    A response of which the likelihood makes nothing would have no width at all; what its band is to tell is what the data
    rule out, so each prior allows at least a response that moves the CV by `LEAST_PRIOR` of how much it moves in the log.
    Hyperparameters and noise model are estimates too, which a posterior given them leaves out: `WIDER` and `NARROWEST`, by
    simulation, stand for that.
    """
    parameters = fit.posterior.parameters.copy()
    length = fit.posterior.mean.shape[1]
    size, tau, kappa = np.exp(parameters.T)
    weak = (
        fit.posterior.variance * size * np.minimum(tau, length) * np.minimum(kappa, length) < LEAST_PRIOR**2
    )
    slow = length / 5
    parameters[weak, 1], parameters[weak, 2] = np.log(slow), np.log(2 * slow)
    parameters[weak, 0] = 2 * np.log(LEAST_PRIOR / slow) - np.log(max(fit.posterior.variance, 1e-12))
    posterior = dataclasses.replace(fit.posterior, parameters=parameters)
    spread = fitted(data, length, dataclasses.replace(fit, posterior=posterior), 0).deviations(data)
    return 1.96 * WIDER * np.hypot(spread, NARROWEST * spread.max(axis=1, keepdims=True))
