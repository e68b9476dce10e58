"""Actuators, part of every plant: what becomes of the demands of a controller.

An actuator follows its demand, moves between positions one step apart, or stands at one of a list of values. Plants of every
kind move theirs with these, on the host and inside compiled programs, so that a demand means the same on all of them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.check import among, is_number
from jaxmpc.errors import InputError

KINDS = ("continuous", "stepped", "values", "on-off")
TOLERANCE = 5e-10  # of a step, so that rounding in the demand does not cost a move


@dataclasses.dataclass(frozen=True)
class Actuator:
    """What moves one MV; all numbers in its unit.

    Raises:
        InputError: naming the field that is wrong, below ``actuator``.
    """

    kind: Literal["continuous", "stepped", "values", "on-off"] = "continuous"
    low: float = -math.inf  # the demand is limited to low..high; on-off: off and on
    high: float = math.inf
    step: float = 0.0  # stepped: between two positions, which are origin + k step
    threshold: float | None = None  # stepped: how far off the demand must be; half a step if not given
    origin: float = 0.0  # stepped: one of the positions
    values: tuple[float, ...] = ()  # values: where it can stand

    def __post_init__(self):
        among("actuator.kind", self.kind, KINDS)
        object.__setattr__(self, "values", tuple(self.values))
        if any(math.isnan(limit) for limit in (self.low, self.high)) or not self.low < self.high:
            raise InputError("actuator.low", (self.low, self.high), "low below high [MV unit]")
        stepped, listed = self.kind == "stepped", self.kind == "values"
        for name, own in (("step", stepped), ("threshold", stepped), ("values", listed)):
            if not own and getattr(self, name) not in (0.0, None, ()):
                raise InputError(f"actuator.{name}", getattr(self, name), f"none for one of kind {self.kind}")
        if stepped and not (is_number(self.step) and self.step > 0):
            raise InputError("actuator.step", self.step, "a positive distance of two positions [MV unit]")
        if self.threshold is not None and not (is_number(self.threshold) and self.threshold > 0):
            raise InputError("actuator.threshold", self.threshold, "a positive distance [MV unit]")
        if not is_number(self.origin):
            raise InputError("actuator.origin", self.origin, "a position [MV unit]")
        if stepped and self._steps[0] > self._steps[1]:
            raise InputError(
                "actuator.step", self.step, f"a position from {self.low} to {self.high} [MV unit]"
            )
        increasing = all(map(is_number, self.values)) and all(np.diff(self.values) > 0)
        if listed and not (len(self.values) > 1 and increasing):
            raise InputError("actuator.values", self.values, "two or more numbers, increasing [MV unit]")
        if self.kind == "on-off" and not (is_number(self.low) and is_number(self.high)):
            raise InputError("actuator.low", (self.low, self.high), "two finite values, off and on [MV unit]")

    def move(self, position, demand):
        """Position after a demand [MV unit], elementwise; NumPy stays NumPy.

        A stepped actuator goes to the position nearest to the demand (halfway between two, to the higher one) if the demand
        is `threshold` or more away from where it stands, one with a list of values once another value is nearer.
        """
        # a loop on the host need not pay for JAX dispatch
        xp: Any = jnp if isinstance(position, jax.Array) or isinstance(demand, jax.Array) else np
        demand = xp.clip(demand, self.low, self.high)
        if self.kind == "continuous":
            return demand
        away = xp.abs(demand - position)
        if self.kind == "stepped":
            threshold = self.step / 2 if self.threshold is None else self.threshold
            count = xp.clip(xp.floor((demand - self.origin) / self.step + 0.5), *self._steps)
            nearest = self.origin + self.step * count
            return xp.where(away >= threshold - TOLERANCE * self.step, nearest, position)
        values: Any = self.listed
        nearest = values[0]
        for value in values[1:]:
            nearest = xp.where(xp.abs(demand - value) < xp.abs(demand - nearest), value, nearest)
        nearer = xp.abs(demand - nearest) < away - TOLERANCE * min(np.diff(values))
        return xp.where(nearer, nearest, position)

    @property
    def listed(self) -> tuple[float, ...] | None:
        """The values at which one of kind ``values`` or ``on-off`` can stand [MV unit]; None for the others."""
        return (self.low, self.high) if self.kind == "on-off" else self.values or None

    @property
    def _steps(self) -> tuple[float, float]:
        """Steps from the origin to the lowest and to the highest position."""
        first, last = ((limit - self.origin) / self.step for limit in (self.low, self.high))
        return np.ceil(first - TOLERANCE), np.floor(last + TOLERANCE)


@dataclasses.dataclass(frozen=True)
class Actuators:
    """The actuators of a plant, one per MV."""

    each: tuple[Actuator, ...]

    @classmethod
    def of(cls, actuators: Iterable[Actuator], count: int | None = None) -> Actuators:
        """These, or where there are none, `count` continuous ones without limits.

        Raises:
            InputError: if there are not `count`.
        """
        each = tuple(actuators) or (Actuator(),) * (count or 0)
        if count is not None and len(each) != count:
            raise InputError("actuators", f"{len(each)} actuators", f"{count}, one per MV")
        return cls(each)

    def move(self, position, demand):
        """Positions ``"... mv"`` after demands ``"... mv"`` [MV unit], see `Actuator.move`."""
        xp: Any = jnp if isinstance(position, jax.Array) or isinstance(demand, jax.Array) else np
        if all(one.kind == "continuous" for one in self.each):
            low, high = (np.array([getattr(one, name) for one in self.each]) for name in ("low", "high"))
            return xp.clip(demand, low, high)
        moved = [one.move(position[..., k], demand[..., k]) for k, one in enumerate(self.each)]
        return xp.stack(moved, axis=-1)
