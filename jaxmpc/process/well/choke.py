"""The actuators of the well: a continuous choke or the step choke of the thesis (chapter 6), and the lift."""

from __future__ import annotations

from types import MappingProxyType

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
    if actuator not in CHOKES:
        raise InputError(path, actuator, f"one of {', '.join(CHOKES)}")
    return str(actuator)
