"""Transfer functions as published and as engineers list them: gain, dead time, time constants and a lead.

Their step responses make step-response models: process files may list transfer functions in place of coefficients, and the
instances of `studies.bench` are made of published ones.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float

TERMS = 18  # of the series of the exponential, whose argument is at most 1/2


@dataclasses.dataclass(frozen=True)
class TransferFunction:
    """``gain (1 + lead s) exp(-dead_time s) / ((1 + T1 s) (1 + T2 s) ...)``; numbers are checked where they are read.

    Attributes:
        gain: [output unit per input unit]; per time unit for each integrator.
        time_constants: T1, T2, ..., which may be equal; infinite: an integrator 1/s in place of 1/(1 + T s).
        dead_time: in the time unit of the time constants, as `lead`.
        lead: of the numerator; needs a time constant.
    """

    gain: float
    time_constants: tuple[float, ...] = ()
    dead_time: float = 0.0
    lead: float = 0.0

    def step_response(self, times: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Response to a unit step at time 0; exact at every time, whether or not it is a whole number of samples."""
        after = np.maximum(times - self.dead_time, 0.0)
        # the held input, then one state per time constant, each of which follows the one before
        chain = np.zeros((len(self.time_constants) + 1,) * 2)
        for i, constant in enumerate(self.time_constants, start=1):
            integrates = math.isinf(constant)
            chain[i, i - 1] = 1.0 if integrates else 1 / constant
            chain[i, i] = 0.0 if integrates else -1 / constant
        states = _exponential(after[:, None, None] * chain)[:, :, 0]
        response = states[:, -1] + self.lead * (states @ chain[-1])
        return np.where(times < self.dead_time * (1 - 1e-12), 0.0, self.gain * response)


def _exponential(matrices: Float[np.ndarray, "n state state"]) -> Float[np.ndarray, "n state state"]:
    """Exponentials of matrices: the series of a half, quarter, ... of each, squared as often."""
    size = np.abs(matrices).sum(axis=-1).max(axis=-1)
    halved = np.maximum(np.ceil(np.log2(np.maximum(size, 1e-300))) + 1, 0).astype(int)
    small = matrices / 2.0 ** halved[:, None, None]
    out = term = np.broadcast_to(np.eye(matrices.shape[-1]), matrices.shape)
    for k in range(1, TERMS):
        term = term @ small / k
        out = out + term
    for k in range(halved.max(initial=0)):
        out = np.where((k < halved)[:, None, None], out @ out, out)
    return out
