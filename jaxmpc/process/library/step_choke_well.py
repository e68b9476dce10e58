"""The gas-lifted well with its choke as the only MV: any actuator moves it, and the lift is a disturbance.

The equations are those of `jaxmpc.process.well.equations`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jaxmpc.process.actuator import Actuator
from jaxmpc.process.function_plant import FunctionPlant
from jaxmpc.process.well.equations import DEFAULT_LIFT, SHIPPED_STEADY_STATE, WellParameters, model
from jaxmpc.process.well.parameters import PARAMETERS, SI_POWERS, UNITS
from jaxmpc.process.well.plant import JaxOps

CHOKE = 20.0  # where it starts [%]


def _well(x: Any, u: Any, d: Any, p: dict[str, Any]) -> tuple[list, list]:
    """Rates of change and measurements; `d` are the changes of the lift [m3/h] and of the reservoir pressure [bar]."""
    si = {name: value * 10.0 ** SI_POWERS.get(UNITS.get(name, "1"), 0) for name, value in p.items()}
    return model(JaxOps, tuple(x), (u[0], DEFAULT_LIFT + d[0], d[1]), WellParameters(**si))


def rates(x: Any, u: Any, d: Any, p: dict[str, Any]) -> list[Any]:
    """Of the states of the well [SI units]."""
    return _well(x, u, d, p)[0]


def gas_rate(x: Any, u: Any, d: Any, p: dict[str, Any]) -> list[Any]:
    """At standard conditions [m3/h]."""
    return _well(x, u, d, p)[1][:1]


def plant(actuators: Sequence[Actuator] = ()) -> FunctionPlant:
    """The plant of the process file."""
    return FunctionPlant(
        rates,
        gas_rate,
        dt=10.0,
        mv=[CHOKE],
        guess=SHIPPED_STEADY_STATE,
        disturbance_names=("gas_lift", "reservoir_pressure"),
        parameters=PARAMETERS,
        actuators=actuators,
    )
