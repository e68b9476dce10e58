"""Measurement noise of a closed loop: normal, independent from sample to sample, and reproducible.

The noise of a sample follows from its seed, stream and number alone, so that neither the length of a run nor the way a sweep
is cut into pieces changes it. `jaxmpc.loop.simulate` adds it to what the plant measures.
"""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmpc.errors import InputError
from jaxmpc.programs.lanes import in_pieces

ROWS = 4096  # samples of one call, of any lanes: one program draws them all


def noise_samples(
    deviation: Float[Array, " cv"],
    seed: Int[Array, ""],
    stream: Int[Array, ""],
    samples: Int[Array, " sample"],
) -> Float[Array, "sample cv"]:
    """Noise at some samples of one run.

    Args:
        deviation: standard deviation of every CV [CV unit].
        seed, stream: together they name one sequence of noise.
    """
    key = jax.random.fold_in(jax.random.key(seed), stream)
    draw = lambda k: jax.random.normal(jax.random.fold_in(key, k), deviation.shape)  # noqa: E731
    return deviation * jax.vmap(draw)(samples)


def errors_of(deviation: np.ndarray, seeds: np.ndarray, samples: int) -> np.ndarray:
    """Measurement noise of whole runs, ``"lane sample cv"`` [CV unit].

    Args:
        deviation: standard deviations ``"lane cv"`` [CV unit].
        seeds: seeds with streams ``"lane 2"``.
    """
    if not deviation.any():
        return np.zeros((len(deviation), samples, deviation.shape[1]))
    lanes, cvs = deviation.shape
    lane, sample = (at.ravel() for at in np.indices((lanes, samples)))
    return in_pieces(_errors, ROWS, deviation[lane], seeds[lane], sample).reshape(lanes, samples, cvs)


@jax.jit
def _errors(deviation, seeds, samples):
    row = lambda d, s, k: noise_samples(d, s[0], s[1], k[None])[0]  # noqa: E731
    return jax.vmap(row)(deviation, seeds, samples)


def check_deviation(given, cvs: int) -> np.ndarray:
    """Standard deviations ``"cv"`` or ``"lane cv"`` as an array; zeros for None.

    Raises:
        InputError: for another shape, or values that are negative or not finite.
    """
    deviation = np.zeros(cvs) if given is None else np.asarray(given, dtype=np.float64)
    if (
        deviation.ndim not in (1, 2)
        or deviation.shape[-1] != cvs
        or not (np.isfinite(deviation) & (deviation >= 0)).all()
    ):
        raise InputError(
            "noise", given, f"{cvs} standard deviations, one per CV, 0 or more and finite [CV unit]"
        )
    return deviation


def check_seed(given) -> np.ndarray:
    """Seeds as an array without axes or with a lane axis.

    Raises:
        InputError: for anything but whole numbers in 0..2^32 - 1.
    """
    seed = np.asarray(given)
    if seed.dtype.kind not in "iu" or seed.ndim > 1 or (seed < 0).any() or (seed >= 2**32).any():
        raise InputError("seed", given, "a whole number from 0 to 2^32 - 1, or one per lane")
    return seed.astype(np.int64)
