"""Impulse responses by regularised least squares: kernels per pair whose hyperparameters maximise the marginal likelihood.

The impulse response of a pair is Gaussian with the covariance ``b exp(-(i + k) / 2 tau) exp(-|i - k| / kappa)``, the
diagonal-correlated kernel (Chen, Ohlsson & Ljung 2012, DC); for ``kappa = 2 tau`` it is the tuned-correlated one, TC. Its
Cholesky factor is known in closed form, so that nothing ill-conditioned is ever factored. The variance of the noise is
eliminated; what is maximised is the likelihood of the data with all responses integrated out (Pillonetto et al. 2014).
Hyperparameters of long responses are searched with late lags taken together; the responses themselves have all lags.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize

from identify.logged.regression import Sums

NUGGET = 1e-11  # of the square of the CV, which rounding makes of sums of squares
LAGS = (16, 32, 64, 96, 128, 192, 256, 384, 512, 768)  # sizes that programs are compiled for
DENSE = 32  # lags of each spacing, 1, 2, 4, ..., where hyperparameters are searched
INPUTS = (1, 2, 3, 4, 6, 8, 12, 16, 24)
SCREENED = [(tau, size) for tau in (0.03, 0.1, 0.25, 0.6) for size in (-2.0, 2.0, 6.0, 12.0)]


@dataclasses.dataclass(frozen=True)
class Posterior:
    """Impulse responses of one CV and how well they are known.

    Attributes:
        mean: ``"input n"``.
        root: ``"input n p"``, R with the covariance R R'.
        variance: of the noise.
        score: twice the negative logarithm of the marginal likelihood; smaller is likelier.
        parameters: ``"input 3"``: logarithms of b over the variance, tau and kappa.
    """

    mean: Float[np.ndarray, "input n"]
    root: Float[np.ndarray, "input n p"]
    variance: float
    score: float
    parameters: Float[np.ndarray, "input 3"]


def factors(parameters: Float[Array, "input 3"], lag: Float[Array, " n"]) -> Float[Array, "input n n"]:
    """Lower triangular L with the covariance L L' of every pair at these lags, the first of which is 0."""
    size, tau, kappa = (jnp.exp(parameters[:, k])[:, None, None] for k in range(3))
    decay = _exponential(-0.5 * (lag + 1.0) / tau[:, 0])
    apart = jnp.maximum(lag[:, None] - lag, 0)
    correlation = jnp.where(lag[:, None] >= lag, _exponential(-apart / kappa), 0.0)  # of an AR 1 process
    apart = jnp.diff(lag, prepend=-1.0)
    first = jnp.where(lag == 0, 1.0, jnp.sqrt(-jnp.expm1(-2.0 * apart / kappa)))
    return jnp.sqrt(size) * decay[:, :, None] * correlation * first


def _exponential(exponent: Array) -> Array:
    """The exponential function, 0 below 1e-26: products of the smallest numbers there are take a hundred times as long."""
    return jnp.where(exponent > -60.0, jnp.exp(jnp.maximum(exponent, -60.0)), 0.0)


def knots(length: int) -> Float[np.ndarray, " n"]:
    """Lags of `length`, ever further apart."""
    found, spacing = [], 1
    while not found or found[-1] < length - 1:
        begin = found[-1] + spacing if found else 0
        found += range(begin, begin + DENSE * spacing, spacing)
        spacing *= 2
    return np.array([*(lag for lag in found if lag < length - 1), length - 1], dtype=float)


def _solved(parameters, lag, gram, right, square):
    """``(L, Cholesky factor of I + L' G L, its solve of L' b, square that is left)``."""
    inputs, length = right.shape
    low = factors(parameters, lag)
    half = jnp.einsum("jak,jami->jkmi", low, gram)
    whole = jnp.einsum("jkmi,mil->jkml", half, low).reshape(inputs * length, -1)
    root = jnp.linalg.cholesky(jnp.eye(inputs * length) + 0.5 * (whole + whole.T))
    seen = jax.scipy.linalg.solve_triangular(root, jnp.einsum("jak,ja->jk", low, right).ravel(), lower=True)
    return low, root, seen, square - seen @ seen


def score(parameters, lag, gram, right, square, floor, count):
    """Twice the negative logarithm of the marginal likelihood, the variance of the noise eliminated."""
    _, root, _, left = _solved(parameters, lag, gram, right, square)
    value = count * jnp.log((jnp.maximum(left, 0.0) + floor) / count) + 2 * jnp.log(jnp.diag(root)).sum()
    return jnp.where(jnp.isfinite(value), value, 1e30)


_score = jax.jit(score)
_scored = jax.jit(jax.value_and_grad(score))
_screened = jax.jit(jax.vmap(score, in_axes=(0, *[None] * 6)))


@jax.jit
def _posterior(parameters, lag, gram, right, square, floor, count):
    low, root, seen, left = _solved(parameters, lag, gram, right, square)
    back = jax.scipy.linalg.solve_triangular(root, jnp.eye(len(root)), lower=True)  # C^-1
    inputs, length = right.shape
    spread = jnp.einsum("jak,pjk->jap", low, back.reshape(-1, inputs, length))  # L (C')^-1
    variance = (jnp.maximum(left, 0.0) + floor) / count
    return jnp.einsum("jap,p->ja", spread, seen), jnp.sqrt(variance) * spread, variance


def padded(data: Sums, lags: Float[np.ndarray, " n"] | None = None) -> tuple[Array, ...]:
    """Lags and sums in one of few sizes; what is added has no effect on likelihood and responses.

    Args:
        data: with all lags.
        lags: that responses are interpolated from; all if not given.
    """
    gram, right = data.gram, data.right
    every = np.arange(right.shape[1], dtype=float)
    if lags is None:
        lags = every
    else:
        shapes = np.stack([np.interp(every, lags, unit) for unit in np.eye(len(lags))], axis=1)
        gram, right = np.einsum("jami,ak,il->jkml", gram, shapes, shapes, optimize=True), right @ shapes
    inputs, length = right.shape
    more = (
        next((k for k in INPUTS if k >= inputs), inputs) - inputs,
        next((k for k in LAGS if k >= length), length) - length,
    )
    extra = [(0, more[0]), (0, more[1])]
    beyond = np.concatenate([lags, lags[-1] + 1 + np.arange(more[1])])
    arrays = beyond, np.pad(gram, extra * 2), np.pad(right, extra)
    numbers = data.square, NUGGET * max(data.square, 1e-300), float(data.count)
    return tuple(map(jnp.asarray, (*arrays, *numbers)))


def estimate(
    data: Sums, start: Float[np.ndarray, "input 3"] | None = None, iterations: int = 60
) -> Posterior:
    """Impulse responses with the hyperparameters that make the data the likeliest.

    Args:
        data: of one CV, with inputs and CV of the size of 1.
        start: hyperparameters to begin from; screened over equal ones of all pairs if not given.
        iterations: of L-BFGS-B at most; 0 keeps those of the start.
    """
    inputs, length = data.right.shape
    arrays = padded(data)
    searched = padded(data, knots(length)) if iterations and length > 3 * DENSE else arrays
    size = arrays[2].shape[0]
    bounds = [
        (-16.0, float(np.log(1e13 / max(data.count, 1)))),
        (np.log(0.3), np.log(3.0 * length)),
        (-1.2, 8.0),
    ]
    low, high = np.array(bounds).T
    if start is None:
        each = [
            (amount - np.log(tau * length), np.log(tau * length), np.log(2 * tau * length))
            for tau, amount in SCREENED
        ]
        tried = np.repeat(np.clip(each, low, high)[:, None], size, axis=1)
        begin = tried[int(np.argmin(_screened(jnp.asarray(tried), *searched)))][:inputs]
    else:
        begin = start
    x = np.zeros((size, 3))
    x[:inputs] = np.clip(begin, low, high)

    def value(free: np.ndarray) -> tuple[float, np.ndarray]:
        x[:inputs] = free.reshape(inputs, 3)
        found, slope = _scored(jnp.asarray(x), *searched)
        return float(found), np.asarray(slope)[:inputs].ravel()

    if iterations:
        options = {"maxiter": iterations, "ftol": 1e-6}
        found = minimize(
            value, x[:inputs].ravel(), jac=True, method="L-BFGS-B", bounds=bounds * inputs, options=options
        )
        x[:inputs] = found.x.reshape(inputs, 3)
    final = float(_score(jnp.asarray(x), *arrays)) + data.constant
    mean, root, variance = _posterior(jnp.asarray(x), *arrays)
    kept = np.asarray(root)[:inputs, :length]
    return Posterior(np.asarray(mean)[:inputs, :length], kept, float(variance), final, x[:inputs].copy())
