"""The quadruple-tank process: two pumps, each of which fills a lower tank and the upper tank across from it.

Equations and numbers as in Johansson, IEEE Transactions on Control Systems Technology 8 (2000) 456-465, at the operating
point P- where the zeros are in the left half plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from jaxmpc.process.actuator import Actuator
from jaxmpc.process.function_plant import FunctionPlant
from jaxmpc.process.plant import Parameter

AREAS = 28.0, 32.0, 28.0, 32.0  # of the tanks [cm2]
OUTLETS = 0.071, 0.057, 0.071, 0.057  # cross-sections of the outlet holes [cm2]
GRAVITY = 981.0  # cm/s2
LEVELS = 12.4, 12.7, 1.8, 1.4  # at P- [cm]
VOLTAGES = 3.0, 3.0  # at P- [V]
PARAMETERS = (
    Parameter("pump_gain_1", "cm3/(V s)", 3.33, "flow per voltage of pump 1", positive=True),
    Parameter("pump_gain_2", "cm3/(V s)", 3.35, "flow per voltage of pump 2", positive=True),
    # the sum of both decides where the zero is: in the right half plane below 1
    Parameter("share_1", "1", 0.70, "share of pump 1 that goes to tank 1", low=0.0, high=1.0),
    Parameter("share_2", "1", 0.60, "share of pump 2 that goes to tank 2", low=0.0, high=1.0),
    *(
        Parameter(f"outlet_{i + 1}", "cm2", area, f"outlet of tank {i + 1}", positive=True)
        for i, area in enumerate(OUTLETS)
    ),
)


def rates(x: Any, u: Any, d: Any, p: dict[str, Any]) -> list[Any]:
    """Of the levels of tanks 1 to 4 [cm/s]; the pumps have voltages [V], tank 1 a further inflow [cm3/s]."""
    out = [p[f"outlet_{i + 1}"] * jnp.sqrt(2 * GRAVITY * jnp.maximum(x[i], 0.0)) for i in range(4)]
    flow_1, flow_2 = p["pump_gain_1"] * u[0], p["pump_gain_2"] * u[1]
    into = (
        out[2] + p["share_1"] * flow_1 + d[0],
        out[3] + p["share_2"] * flow_2,
        (1 - p["share_2"]) * flow_2,
        (1 - p["share_1"]) * flow_1,
    )
    return [(a - b) / area for a, b, area in zip(into, out, AREAS, strict=True)]


def levels(x: Any, u: Any, d: Any, p: dict[str, Any]) -> Any:
    """Of the two lower tanks [cm]."""
    return x[:2]


def plant(actuators: Sequence[Actuator] = ()) -> FunctionPlant:
    """The plant of the process file."""
    return FunctionPlant(
        rates,
        levels,
        dt=10.0,
        mv=VOLTAGES,
        guess=LEVELS,
        disturbance_names=("inflow",),
        parameters=PARAMETERS,
        actuators=actuators,
    )
