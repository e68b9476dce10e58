"""The actuators of the well: a continuous choke or the step choke of the thesis (chapter 6), and the lift."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from types import MappingProxyType

from jaxmpc.check import among
from jaxmpc.errors import InputError
from jaxmpc.process.actuator import Actuator

CHOKES = MappingProxyType(
    {
        "continuous": Actuator(low=0.0, high=100.0),
        "step": Actuator("stepped", low=0.0, high=100.0, step=2.0, threshold=1.6),
    }
)
LIFT = Actuator(low=0.0)


def check_choke(actuator: object, path: str = "actuator") -> str:
    """Return the name of a choke actuator, or raise `InputError` if there is none of that name."""
    among(path, actuator, CHOKES)
    return str(actuator)


def kind_of(actuators: Sequence[Actuator] = ()) -> str:
    """The key of `CHOKES` that the actuators of a process file mean, choke and lift; a step choke without any.

    Raises:
        InputError: for another actuator of the choke, or one of the lift that is not continuous.
    """
    choke, lift = actuators or (CHOKES["step"], LIFT)
    for name, one in CHOKES.items():
        if dataclasses.replace(choke, low=one.low, high=one.high) == one and lift.kind == "continuous":
            return name
    expected = (
        "a choke that is continuous, or moves in steps of 2 % beyond 1.6 %, and a lift that is continuous"
    )
    raise InputError("mv.actuator", [choke, lift], expected)
