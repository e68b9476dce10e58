"""Measurements judged before they are used: a bad one is left out, and its CV is predicted open loop (2.29)-(2.31).

A measurement is bad that is not a number, lies outside its validation limits, or has not changed for too long. The bias of
its CV is kept or fades, the other CVs go on; after so many in a row the CV is switched off, and the first good
one brings it back. `Core.observe` judges every sample; `fault_errors` makes sensors fail in closed loops.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxmpc.check import among, is_number
from jaxmpc.errors import InputError
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning

IMPLAUSIBLE = 1e12  # CV unit; from here on double precision leaves too few digits for what the moves do

QUALITY = ("good", "missing", "outside", "frozen")  # of a measurement, by its code
GOOD, MISSING, OUTSIDE, FROZEN = range(len(QUALITY))

FAULTS = ("missing", "spike", "frozen")
STUCK = np.inf  # error of a sensor that repeats what it measured before


class Sensors(eqx.Module):
    """What is remembered of the measurements.

    Attributes:
        value: the last ones, good or bad [CV unit].
        counts: `repeated`, `bad`, `quality` and `off` in one array, as every array takes time at every step.
    """

    value: Float[Array, " cv"]
    counts: Int[Array, "4 cv"]

    @property
    def repeated(self) -> Int[Array, " cv"]:
        """How often in a row the measurement has been the same [samples]."""
        return self.counts[..., 0, :]

    @property
    def bad(self) -> Int[Array, " cv"]:
        """How many in a row were left out [samples]."""
        return self.counts[..., 1, :]

    @property
    def quality(self) -> Int[Array, " cv"]:
        """Code of the last one in `QUALITY`."""
        return self.counts[..., 2, :]

    @property
    def off(self) -> Bool[Array, " cv"]:
        """Whether the CV is switched off."""
        return self.counts[..., 3, :] > 0

    @classmethod
    def fresh(cls, cv: Float[Array, " cv"]) -> Sensors:
        """After a first good measurement [CV unit]."""
        return cls(value=cv, counts=jnp.zeros((4, *cv.shape), dtype=int))

    def judged(self, tuning: Tuning, cv: Float[Array, " cv"]) -> Sensors:
        """After another measurement [CV unit], which may be anything."""
        repeated = jnp.where(cv == self.value, self.repeated + 1, 0)
        known = jnp.abs(cv) < IMPLAUSIBLE  # false for what is not a number
        inside = (cv >= tuning.measurement_low) & (cv <= tuning.measurement_high)
        moving = repeated < tuning.frozen_limit
        quality = jnp.where(inside, jnp.where(moving, GOOD, FROZEN), OUTSIDE)
        quality = jnp.where(known, quality, MISSING)
        bad = jnp.where(quality == GOOD, 0, self.bad + 1)
        off = bad >= tuning.bad_limit
        return Sensors(value=cv, counts=jnp.stack([repeated, bad, quality, off]).astype(int))


@dataclasses.dataclass(frozen=True)
class SensorFault:
    """A sensor that fails for a while, for closed loops.

    Attributes:
        cv: name of the CV.
        kind: ``missing`` (nothing arrives), ``spike`` (off by `size`) or ``frozen`` (repeats its last value).
        time: of the first bad sample [s].
        duration: how long [s]; one sample if not given.
        size: of a spike [CV unit].
    """

    cv: str
    kind: Literal["missing", "spike", "frozen"]
    time: float
    duration: float | None = None
    size: float = 0.0


def fault_errors(
    structure: Structure, samples: int, faults: Sequence[SensorFault], *, path: str = "faults"
) -> Float[np.ndarray, "sample cv"]:
    """Errors of the sensors, for `jaxmpc.simulate`: NaN where nothing arrives, `STUCK` where the last value is repeated.

    Args:
        faults: where two meet, the later one in the list holds.

    Raises:
        InputError: naming the fault and the field, for unknown CVs and kinds, and times outside the run.
    """
    errors = np.zeros((samples, structure.cv_count))
    for i, fault in enumerate(faults):
        at, length = f"{path}[{i}]", samples * structure.dt
        among(f"{at}.cv", fault.cv, structure.cv_names, "one of the CVs")
        among(f"{at}.kind", fault.kind, FAULTS)
        if not is_number(fault.time) or not 0 <= fault.time < length:
            raise InputError(f"{at}.time", fault.time, f"a time within the run, 0 to less than {length:g} s")
        duration = structure.dt if fault.duration is None else fault.duration
        if not is_number(duration) or duration <= 0:
            raise InputError(f"{at}.duration", duration, "a positive duration [s]")
        if not is_number(fault.size):
            raise InputError(f"{at}.size", fault.size, "a finite size [CV unit]")
        error = {"missing": np.nan, "spike": fault.size, "frozen": STUCK}[fault.kind]
        first, last = (int(np.ceil(t / structure.dt - 1e-9)) for t in (fault.time, fault.time + duration))
        errors[first:last, structure.cv_names.index(fault.cv)] = error
    return errors


def received(sound: ArrayLike, fault: ArrayLike, before: ArrayLike) -> Any:
    """What arrives from sensors, ``"... cv"`` [CV unit]; NumPy's where all arguments are.

    Args:
        sound: what they would measure without fault, ``"... cv"`` [CV unit].
        before: what arrived one sample ago, ``"... cv"`` [CV unit].
    """
    xp: Any = np if all(isinstance(v, np.ndarray) for v in (sound, fault, before)) else jnp
    return xp.where(xp.asarray(fault) == STUCK, before, xp.add(sound, fault))
