"""A tank that a stream and an on/off pump fill, and that drains through a pipe by gravity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from jaxmpc.process.actuator import Actuator
from jaxmpc.process.function_plant import FunctionPlant
from jaxmpc.process.plant import Parameter

PARAMETERS = (
    Parameter("area", "m2", 10.0, "area of the tank", positive=True),
    Parameter("pump", "m3/s", 0.03, "flow of the pump", positive=True),
    Parameter("stream", "m3/s", 0.015, "flow of the stream", low=0.0),
    Parameter("drain", "m2.5/s", 0.03, "flow of the drain at 1 m", positive=True),
)


def rates(x: Any, u: Any, d: Any, p: dict[str, Any]) -> list[Any]:
    """Of the level [m/s]; the pump is off at 0 and on at 1, the stream is off by `d` [m3/s]."""
    out = p["drain"] * jnp.sqrt(jnp.maximum(x[0], 0.0))
    return [(p["pump"] * u[0] + p["stream"] + d[0] - out) / p["area"]]


def level(x: Any, u: Any, d: Any, p: dict[str, Any]) -> Any:
    """The level [m]."""
    return x


def plant(actuators: Sequence[Actuator] = ()) -> FunctionPlant:
    """The plant of the process file: at rest with the pump off."""
    return FunctionPlant(
        rates,
        level,
        dt=20.0,
        mv=[0.0],
        guess=[0.25],
        disturbance_names=("stream_offset",),
        parameters=PARAMETERS,
        actuators=actuators,
    )
