"""First order with dead time beside a step response, and the integrating one: what an engineer would read off it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

ROUNDS, POINTS = 4, 24  # of a grid that closes in


class LowOrder(NamedTuple):
    """``gain exp(-dead_time s) / (1 + lag s)``, over s where it integrates; times in samples."""

    gain: float
    lag: float
    dead_time: float
    integrating: bool

    def response(self, length: int) -> Float[np.ndarray, " n"]:
        """At 1..N samples after a unit step."""
        return self.gain * _shape(length, np.array(self.lag), np.array(self.dead_time), self.integrating)


def _shape(length: int, lag: np.ndarray, dead: np.ndarray, integrating: bool) -> np.ndarray:
    after = np.maximum(np.arange(1, length + 1) - dead[..., None], 0.0)
    rise = -np.expm1(-after / lag[..., None])
    return after - lag[..., None] * rise if integrating else rise


def low_order(
    steps: Float[np.ndarray, " n"], band: Float[np.ndarray, " n"], *, integrating: bool = False
) -> LowOrder:
    """The best one for a step response, by least squares over a grid of lag and dead time that closes in.

    Args:
        steps: S(1)..S(N).
        band: half widths, which weigh the coefficients; 2 % of the largest coefficient at least.
        integrating: whether a ramp is tried too.
    """
    found = [_searched(steps, band, ramp) for ramp in ((False, True) if integrating else (False,))]
    return min(found)[1]


def _searched(steps: np.ndarray, band: np.ndarray, integrating: bool) -> tuple[float, LowOrder]:
    """The best of one kind, and its sum of squares."""
    length = len(steps)
    weight = 1 / (np.nan_to_num(band) + 0.02 * max(np.abs(steps).max(), 1e-300))
    lags, deads = (np.log(0.05), np.log(length)), (0.0, 0.6 * length)
    best = (np.inf, 0.0, 1.0, 0.0)
    for _ in range(ROUNDS):
        lag, dead = np.meshgrid(
            np.exp(np.linspace(*lags, POINTS)), np.linspace(*deads, POINTS), indexing="ij"
        )
        shape = _shape(length, lag, dead, integrating) * weight
        gain = shape @ (steps * weight) / np.maximum((shape**2).sum(axis=-1), 1e-300)
        error = ((gain[..., None] * shape - steps * weight) ** 2).sum(axis=-1)
        at = np.unravel_index(int(np.argmin(error)), error.shape)
        best = min(best, (float(error[at]), float(gain[at]), float(lag[at]), float(dead[at])))
        reach = (lags[1] - lags[0]) / POINTS * 2, (deads[1] - deads[0]) / POINTS * 2
        lags = np.log(best[2]) - reach[0], np.log(best[2]) + reach[0]
        deads = max(0.0, best[3] - reach[1]), best[3] + reach[1]
    return best[0], LowOrder(*best[1:], integrating)
