"""The choke actuators, part of every plant: a continuous choke, and the step choke of the thesis (chapter 6).

A step choke has positions 2 % apart and moves only once the demand is far enough from where it stands.
`jaxmpc.process.well.plant` and the FMU plant call these, so that a demand means the same on both.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.errors import InputError

ACTUATORS = ("continuous", "step")
STEP = 2.0  # % between two positions
THRESHOLD = 1.6  # % from the present position at which the choke moves
TOLERANCE = 1e-9  # %, so that rounding in the demand does not cost a move


def _numeric(*values):  # NumPy stays NumPy: a loop on the host need not pay for JAX dispatch
    return jnp if any(isinstance(value, jax.Array) for value in values) else np


def step_choke(position, demand):
    """Position of the step choke [%] after a demand [%], which is limited to 0..100.

    It goes to the position (a multiple of 2 %) nearest to the demand if that is 1.6 % or more away from where
    the choke stands, and stays there otherwise. Halfway between two positions, the more open one is nearest.
    """
    xp = _numeric(position, demand)
    demand = xp.clip(demand, 0.0, 100.0)
    nearest = STEP * xp.floor(demand / STEP + 0.5)
    return xp.where(xp.abs(demand - position) >= THRESHOLD - TOLERANCE, nearest, position)


def move_choke(actuator: str, position, demand):
    """Position of the choke [%] after a demand [%], for either actuator.

    Args:
        actuator: ``continuous`` (follows the demand within 0..100 %) or ``step`` (see `step_choke`).
    """
    if actuator == "step":
        return step_choke(position, demand)
    return _numeric(position, demand).clip(demand, 0.0, 100.0)


def check_actuator(actuator: object, path: str = "actuator") -> str:
    """Return the actuator's name, or raise `InputError` if there is no such actuator."""
    if actuator not in ACTUATORS:
        raise InputError(path, actuator, f"one of {', '.join(ACTUATORS)}")
    return str(actuator)
