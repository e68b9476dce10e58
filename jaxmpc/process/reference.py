"""Setpoints over time (thesis 7): piecewise constant, all CVs together, checked before a run starts.

`jaxmpc.loop.simulate.simulate` samples it; studies define it and cut their key figures at its changes.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxmpc.check import as_floats, is_number
from jaxmpc.errors import InputError


@dataclasses.dataclass(frozen=True, eq=False)
class Reference:
    """Setpoints that change at given times and hold until the next change; checked on construction.

    Attributes:
        times: ``"change"``, when the setpoints change [s]: increasing, from 0, all before `duration`.
        setpoints: ``"change cv"``, one row per change, in CV order [CV unit].
        duration: length of the run [s].

    Raises:
        InputError: naming the field, for wrong shapes, fewer setpoints than times, NaN, unsorted times, a
            first change after 0 or a change that the run never reaches.
    """

    times: Any
    setpoints: Any
    duration: float

    def __post_init__(self):
        times = _numbers("reference.times", self.times, 1, "change times [s]")
        setpoints = _numbers(
            "reference.setpoints", self.setpoints, 2, "one row per change, one column per CV"
        )
        if len(times) == 0 or times[0] != 0:
            raise InputError(
                "reference.times[0]",
                times[0] if len(times) else "nothing",
                "0 s: the setpoints must be known from the start of the run",
            )
        if len(setpoints) != len(times):
            raise InputError(
                "reference.setpoints", f"{len(setpoints)} rows", f"{len(times)} rows, one per change time"
            )
        if setpoints.shape[1] == 0:
            raise InputError("reference.setpoints", f"shape {list(setpoints.shape)}", "at least one CV")
        early = np.flatnonzero(np.diff(times) <= 0)
        if early.size:
            i = int(early[0]) + 1
            raise InputError(
                f"reference.times[{i}]", times[i], f"a time after the change before it, {times[i - 1]:g} s"
            )
        duration = self.duration
        if not is_number(duration):
            raise InputError("reference.duration", duration, "a finite length of the run [s]")
        if duration <= times[-1]:
            raise InputError(
                "reference.duration", duration, f"more than the last change time, {times[-1]:g} s"
            )
        times.setflags(write=False)
        setpoints.setflags(write=False)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "setpoints", setpoints)
        object.__setattr__(self, "duration", float(duration))

    @classmethod
    def from_samples(cls, setpoints, dt: float) -> Reference:
        """The reference that has row k of `setpoints` (``"sample cv"``) from k dt to (k + 1) dt [s]."""
        setpoints = _numbers("reference.setpoints", setpoints, 2, "one row per sample, one column per CV")
        changed = np.r_[True, np.any(np.diff(setpoints, axis=0) != 0, axis=1)][: len(setpoints)]
        starts = np.flatnonzero(changed)
        return cls(starts * float(dt), setpoints[starts], len(setpoints) * float(dt))

    def cut(self, duration: float) -> Reference:
        """The first `duration` [s] of it, at most all; changes that are not reached are left out.

        Raises:
            InputError: for a duration that is not positive, or longer than this.
        """
        if not is_number(duration) or not 0 < duration <= self.duration:
            expected = f"more than 0 s and at most the reference's {self.duration:g} s"
            raise InputError("duration", duration, expected)
        kept = self.times < duration
        return Reference(self.times[kept], self.setpoints[kept], float(duration))

    def filtered(self, time_constant, dt: float) -> Reference:
        """These setpoints behind a first-order lag, which starts at the first of them.

        Args:
            time_constant: one for all CVs or ``"cv"`` [s]; 0 leaves the setpoints of a CV as they are.
            dt: sampling interval, at which the new setpoints change [s].
        """
        constants = self._of_cvs("time_constant", time_constant, "s")
        stays = np.exp(-dt / np.where(constants > 0.0, constants, 1.0)) * (constants > 0.0)
        return self._followed(dt, lambda wanted, now: wanted + stays * (now - wanted))

    def ramped(self, rate, dt: float) -> Reference:
        """These setpoints at a limited rate of change, from the first of them on.

        Args:
            rate: largest one, one for all CVs or ``"cv"`` [CV unit/s]; infinite leaves the setpoints of a CV as they are.
            dt: sampling interval, at which the new setpoints change [s].
        """
        most = self._of_cvs("rate", rate, "CV unit/s", infinite=True) * dt
        return self._followed(dt, lambda wanted, now: now + np.clip(wanted - now, -most, most))

    def _followed(self, dt: float, step: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Reference:
        """Setpoints that follow these at every sample by a step from the wanted and the present ones."""
        wanted = self.sample(dt)
        rows = list(itertools.accumulate(wanted[1:], lambda now, new: step(new, now), initial=wanted[0]))
        return Reference.from_samples(rows, dt)

    def _of_cvs(self, field: str, given: Any, unit: str, *, infinite: bool = False) -> np.ndarray:
        """One value per CV, or an InputError."""
        values = as_floats(field, given, f"numbers [{unit}]")
        positive = (values >= 0.0) & (np.isfinite(values) | infinite)
        if values.shape not in ((), (self.cv_count,)) or not positive.all():
            least = "0 or more" if infinite else "0 or more and finite"
            raise InputError(
                field, given, f"a number {least}, or one for each of {self.cv_count} CVs [{unit}]"
            )
        return np.broadcast_to(values, self.cv_count)

    @property
    def cv_count(self) -> int:
        """Number of CVs."""
        return self.setpoints.shape[1]

    def samples(self, dt: float) -> int:
        """Whole samples of `dt` [s] in the run."""
        if not is_number(dt) or dt <= 0:
            raise InputError("dt", dt, "a positive sampling interval [s]")
        return int(np.floor(self.duration / dt + 1e-9))

    def window(self, dt: float, samples: int | None = None) -> np.ndarray:
        """Index of the setpoint row at each sample, ``"sample"``: the last change at or before k dt.

        Raises:
            InputError: if the run is shorter than `samples`.
        """
        available = self.samples(dt)
        samples = available if samples is None else samples
        if samples > available:
            raise InputError(
                "reference.duration",
                self.duration,
                f"at least {samples * dt:g} s of setpoints for a run of {samples} samples of {dt:g} s",
            )
        time = np.arange(samples) * dt
        return np.searchsorted(self.times, time + 1e-9 * dt, side="right") - 1

    def sample(self, dt: float, samples: int | None = None) -> np.ndarray:
        """Setpoints at every sample, ``"sample cv"`` [CV unit]; arguments and errors of `window`."""
        return self.setpoints[self.window(dt, samples)]


def _numbers(field: str, given, dimensions: int, expected: str) -> np.ndarray:
    """A finite float array of so many dimensions, or an InputError that names the first bad entry."""
    array = as_floats(field, given, f"{expected}, rows of equal length")
    if array.ndim != dimensions:
        raise InputError(field, f"shape {list(array.shape)}", f"{dimensions} dimensions: {expected}")
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        where = tuple(int(i) for i in bad[0])
        raise InputError(f"{field}{''.join(f'[{i}]' for i in where)}", array[where], "a finite number")
    return array
