"""The parameters of the well in engineering units, as studies and plants take them; the equations have SI units."""

from __future__ import annotations

import dataclasses
from decimal import Decimal

from jaxmpc.process.plant import Parameter
from jaxmpc.process.well.equations import SIGNED, WellParameters

_PRESSURES = ("reservoir_pressure", "manifold_pressure", "supply_pressure", "supply_droop", "supply_limit")
_IN_UNIT = {
    "bar": (*_PRESSURES, "trip_start", "trip_end", "root_width"),
    "kg/s/bar": ("productivity",),
    "m": ("tubing_length", "tubing_diameter", "perforation_depth"),
    "m2": ("choke_conductance", "injection_conductance"),
    "m3": ("annulus_volume",),
    "m3/m3": ("gas_oil_ratio",),
    "m/s": ("slip_velocity", "slip_floor"),
    "s": ("near_well_time", "choke_time", "lift_time"),
    "1/s": ("equalising_rate",),
    "K": ("tubing_temperature", "annulus_temperature"),
    "kg/m3": ("liquid_density",),
    "kg/mol": ("molar_mass",),
}
UNITS = {name: unit for unit, names in _IN_UNIT.items() for name in names}  # of the others: 1
SI_POWERS = {"bar": 5, "kg/s/bar": -5}  # of ten, of the units that are no SI units


def in_si(name: str, value: float) -> float:
    """A parameter in SI units; shifting the decimal point keeps 78.2901 bar equal to 7829010 Pa."""
    return _shifted(value, SI_POWERS.get(UNITS.get(name, "1"), 0))


def _shifted(value: float, power: int) -> float:
    return float(Decimal(repr(float(value))).scaleb(power)) if power else float(value)


def _table() -> tuple[Parameter, ...]:
    def parameter(name: str, value: float) -> Parameter:
        unit, label = UNITS.get(name, "1"), f"{name.replace('_', ' ')} of the well"
        default = _shifted(value, -SI_POWERS.get(unit, 0))
        return Parameter(name, unit, default, label, positive=name not in SIGNED)

    names = [field.name for field in dataclasses.fields(WellParameters)]
    return tuple(parameter(name, getattr(WellParameters(), name)) for name in names)


PARAMETERS = _table()
