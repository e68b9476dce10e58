"""The gas-lifted oil well: one set of equations, written once, for every simulator.

It stands in for the proprietary simulator of the thesis (3.2). The model follows the published line of
gas-lift models (annulus gas, tubing gas and liquid, valve equations: Eikrem, Aamo, Imsland and Foss;
Jahanshahi and Skogestad; Krishnamoorthy et al.) with two tubing sections, phase slip, a near-well pressure
and a drooping lift supply. `model` uses nothing but arithmetic and the two functions in `ops`, so that
`jaxmpc.process.well.plant` runs it with `jax.numpy` and the FMU source is generated from it with SymPy.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import math
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from jaxmpc.check import among, as_floats
from jaxmpc.errors import InputError
from jaxmpc.files import read_json, write_atomically

GRAVITY = 9.81  # m/s2
GAS_CONSTANT = 8.314462618  # J/(mol K)
STANDARD_PRESSURE = 101325.0  # Pa
STANDARD_TEMPERATURE = 288.15  # K
BAR = 1e5  # Pa
SUPPLY_ROUNDING = 5 * BAR  # how softly the supply meets its limit

CV_NAMES, CV_UNITS = ("gas_rate", "oil_rate"), ("m3/h", "m3/h")
MV_NAMES, MV_UNITS = ("choke", "gas_lift"), ("%", "m3/h")

STATES = (
    ("annulus_gas", "kg", "mass of lift gas in the annulus"),
    ("lower_gas", "kg", "mass of gas in the lower tubing section"),
    ("upper_gas", "kg", "mass of gas in the upper tubing section"),
    ("lower_liquid", "kg", "mass of liquid in the lower tubing section"),
    ("upper_liquid", "kg", "mass of liquid in the upper tubing section"),
    ("choke_opening", "1", "opening of the production choke, 0 to 1"),
    ("lift_rate", "m3/h", "lift gas rate that the supply is asked for, at standard conditions"),
    ("near_well_pressure", "Pa", "reservoir pressure near the well"),
)
INPUTS = (
    ("choke", "%", "position of the production choke, 0 to 100"),
    ("gas_lift", "m3/h", "lift gas rate demand at standard conditions"),
    ("reservoir_pressure_offset", "bar", "change of the reservoir pressure"),
)
OUTPUTS = (
    ("gas_rate", "m3/h", "measured gas production rate at standard conditions"),
    ("oil_rate", "m3/h", "oil production rate"),
    ("wellhead_pressure", "bar", "pressure upstream of the production choke"),
    ("bottom_hole_pressure", "bar", "pressure at the perforations"),
    ("annulus_pressure", "bar", "pressure at the top of the annulus"),
    ("injection_pressure", "bar", "tubing pressure at the gas-lift valve"),
    ("delivered_lift", "m3/h", "lift gas rate that the supply delivers, at standard conditions"),
    ("choke_opening", "%", "opening of the production choke"),
)

DEFAULT_CHOKE, DEFAULT_LIFT = 50.0, 7500.0  # the working point of the thesis (4.1.1)
# Steady state of the shipped parameters at the working point; `identify` and the FMU start from it.
SHIPPED_STEADY_STATE = (
    386.4003156826528,
    209.79313856251358,
    153.52453504757838,
    3949.0305762958233,
    2533.4486628836275,
    0.5,
    7500.0,
    6678430.068267889,
)


class WellParameters(eqx.Module):
    """Parameters of the well; every one is a number, so that a batch of wells is a batch of these.

    The defaults are the shipped well, fitted to published step responses at 50 % choke and 7500 m3/h lift.
    Lengths, volumes and depths are effective values.
    """

    tubing_length: Any = 908.867  # from the gas-lift valve to the wellhead [m]
    tubing_diameter: Any = 0.195001  # inner diameter [m]
    annulus_volume: Any = 12.8651  # [m3]
    perforation_depth: Any = 52.2201  # of the perforations below the gas-lift valve [m]
    liquid_density: Any = 820.0  # [kg/m3]
    molar_mass: Any = 0.020  # of the gas [kg/mol]
    tubing_temperature: Any = 350.0  # [K]
    annulus_temperature: Any = 340.0  # [K]
    reservoir_pressure: Any = 78.2901e5  # [Pa]
    productivity: Any = 2.01723e-5  # inflow per pressure difference [kg/s/Pa]
    near_well_resistance: Any = 0.550781  # share of the drawdown that the near-well zone takes [1]
    near_well_time: Any = 578.897  # time constant of the near-well pressure [s]
    gas_oil_ratio: Any = 26.0494  # of the inflow, gas at standard conditions per liquid [m3/m3]
    choke_conductance: Any = 0.0251143  # of the fully open choke [m2]
    choke_linear: Any = -0.866551  # first shape coefficient of the choke characteristic [1]
    choke_quick: Any = 0.990681  # shape coefficient of its quick opening [1]
    manifold_pressure: Any = 13.37e5  # downstream of the choke [Pa]
    friction_factor: Any = 0.0181771  # Darcy factor of the tubing [1]
    injection_conductance: Any = 7.19577e-4  # of the gas-lift valve [m2]
    supply_pressure: Any = 67.6273e5  # annulus pressure scale of the lift supply [Pa]
    supply_droop: Any = 26.5168e5  # how far the annulus pressure rises before the supply gives way [Pa]
    supply_limit: Any = 150e5  # discharge pressure of the supply [Pa]
    slip_base: Any = 0.700001  # gas-to-liquid velocity ratio at high flow [1]
    slip_velocity: Any = 4.13283  # drift velocity, which raises the ratio at low flow [m/s]
    slip_floor: Any = 1.21735  # flow velocity at which that rise levels off [m/s]
    choke_time: Any = 17.6966  # time constant of the choke [s]
    lift_time: Any = 47.222  # time constant of the lift rate [s]
    # pressure difference below which valves and tubing flow less than the square root [Pa]
    root_width: Any = 5e4
    gas_meter: Any = 0.894551  # ratio of measured to true gas rate [1]
    live_oil_share: Any = 0.3  # gas share of a section below which dissolved gas softens its pressure [1]
    equalising_rate: Any = 2.0  # fastest rate at which the two sections equalise their pressures [1/s]
    trip_start: Any = 70e5  # annulus pressure from which the supply is throttled back [Pa]
    trip_end: Any = 80e5  # annulus pressure at which it is shut [Pa]


def model(ops, x: Sequence, u: Sequence, p) -> tuple[list, list]:
    """Time derivatives and measurements of the well.

    Three terms keep it stable with steps of 1 s and physical from shut-in to full opening: dissolved gas
    softens nearly full sections (`live_oil_share`), two such sections equalise at a bounded rate
    (`equalising_rate`), and the supply throttles back as the annulus fills (`trip_start`, `trip_end`). Each
    is C1, and exactly inactive in every steady state with 2000 m3/h of lift and 2 % choke or more, and on the
    way there from the working point.

    Args:
        ops: functions beyond arithmetic: ``sqrt(x)`` and ``positive(x)`` = max(x, 0).
        x: the eight states in the order and units of `STATES`.
        u: choke position [%], lift demand [m3/h], reservoir-pressure offset [bar].
        p: parameters, any object with the attributes of `WellParameters`.

    Returns:
        ``(dx, y)``: derivatives of the states per second, and measurements in the order of `OUTPUTS`.
    """
    m_ga, m_g1, m_g2, m_l1, m_l2, z, q, p_nw = x
    choke, lift, offset = u
    area = math.pi / 4 * p.tubing_diameter * p.tubing_diameter
    height = p.tubing_length / 2  # of one section
    volume = area * height
    weight = GRAVITY * height / 2  # half a section of density rho weighs weight * rho
    r_tubing = GAS_CONSTANT * p.tubing_temperature / p.molar_mass
    r_annulus = GAS_CONSTANT * p.annulus_temperature / p.molar_mass
    rho_s = STANDARD_PRESSURE * p.molar_mass / (GAS_CONSTANT * STANDARD_TEMPERATURE)
    friction = p.friction_factor * height / (2 * p.tubing_diameter * area * area)

    def root(d, width):
        # One-way and C1: d^2 / (d^2 + width^2)^(3/4) for d > 0, which is sqrt(d) well above the width.
        s = ops.positive(d)
        s = s * s
        r = ops.sqrt(s + width * width)
        return s / (r * ops.sqrt(r))

    def gas_space(m_l):
        # Dissolved gas comes out of a nearly full section when its pressure falls, so the section stores more
        # gas than its free volume holds. Beyond the share where that starts, storage equals the free volume.
        free = volume - m_l / p.liquid_density
        start = p.live_oil_share * volume
        short = ops.positive(start - free)
        return free + short * short / (start + short)

    def phase_flows(m_g, m_l, space, flow):  # mass flows of gas and liquid in a volume flow, with slip
        slip = p.slip_base + p.slip_velocity * area / (flow + p.slip_floor * area)
        gas_share = slip * space / (slip * space + m_l / p.liquid_density)
        return m_g / space * gas_share * flow, p.liquid_density * (1 - gas_share) * flow

    # annulus and gas-lift valve
    rho_a = m_ga / p.annulus_volume
    p_at = rho_a * (r_annulus - GRAVITY * p.tubing_length / 2)
    p_ab = rho_a * (r_annulus + GRAVITY * p.tubing_length / 2)

    # pressures in the tubing
    space_1, space_2 = gas_space(m_l1), gas_space(m_l2)
    p_1, p_2 = r_tubing * m_g1 / space_1, r_tubing * m_g2 / space_2
    rho_1, rho_2 = (m_g1 + m_l1) / volume, (m_g2 + m_l2) / volume
    p_wi = p_1 + rho_1 * weight
    p_bh = p_wi + p.liquid_density * GRAVITY * p.perforation_depth
    w_inj = p.injection_conductance * ops.sqrt(p_ab / r_annulus) * root(p_ab - p_wi, p.root_width)

    # flow from the lower to the upper section, and through the choke
    # Without inertia, two nearly full sections would equalise within a fraction of a second. The root's slope
    # is at most 0.79 / sqrt(width), so this width keeps that below `equalising_rate` per second.
    slope = 0.79 * (p_1 / space_1 + p_2 / space_2) / p.equalising_rate
    width_1 = p.root_width + ops.positive(slope * slope / (friction * rho_1) - p.root_width)
    q_1 = root(p_1 - p_2 - (rho_1 + rho_2) * weight, width_1) / ops.sqrt(friction * rho_1)
    w_g1, w_l1 = phase_flows(m_g1, m_l1, space_1, q_1)
    shut = 1 - z
    conductance = (
        p.choke_conductance * z * (1 + p.choke_linear * shut + p.choke_quick * (shut * shut) * (shut * shut))
    )
    q_2 = (
        conductance
        * root(p_2 - rho_2 * weight - p.manifold_pressure, p.root_width)
        / ops.sqrt(rho_2 * (1 + friction / 2 * conductance * conductance))
    )
    p_wh = p_2 - rho_2 * weight - friction / 2 * rho_2 * q_2 * q_2
    w_g2, w_l2 = phase_flows(m_g2, m_l2, space_2, q_2)

    # inflow from the reservoir; without it the near-well zone returns to the reservoir's pressure
    drawdown = ops.positive(p_nw - p_bh)
    w_r = p.productivity * drawdown
    w_rg = p.gas_oil_ratio * rho_s / p.liquid_density * w_r
    dp_nw = (
        p.reservoir_pressure + BAR * offset - p_nw - p.near_well_resistance * drawdown
    ) / p.near_well_time

    # lift supply: droops with the annulus pressure
    s = (p_at - p.supply_pressure + p.supply_droop) / (2 * p.supply_droop)
    margin = ops.positive(p.supply_limit - p_at)
    # A shut-in well would otherwise charge to the discharge pressure, and blow down at ten times its rate.
    left, over = ops.positive(p.trip_end - p_at), ops.positive(p_at - p.trip_start)
    trip = left * left / (left * left + over * over)
    w_lift = (
        q
        * rho_s
        / 3600
        / (1 + s + s * s / 2)
        * margin
        / ops.sqrt(margin * margin + SUPPLY_ROUNDING * SUPPLY_ROUNDING)
        * trip
    )

    dx = [
        w_lift - w_inj,
        w_inj + w_rg - w_g1,
        w_g1 - w_g2,
        w_r - w_l1,
        w_l1 - w_l2,
        (choke / 100 - z) / p.choke_time,
        (lift - q) / p.lift_time,
        dp_nw,
    ]
    y = [
        p.gas_meter * 3600 * w_g2 / rho_s,
        3600 * w_l2 / p.liquid_density,
        p_wh / BAR,
        p_bh / BAR,
        p_at / BAR,
        p_wi / BAR,
        3600 * w_lift / rho_s,
        100 * z,
    ]
    return dx, y


SIGNED = frozenset(("choke_linear", "choke_quick", "perforation_depth"))  # parameters that may be negative


def check_parameters(parameters: WellParameters, path: str = "well") -> WellParameters:
    """Refuse parameters that are not finite or have no physical meaning.

    Raises:
        InputError: naming the first field that is wrong and its unit.
    """
    for field in fields(parameters):
        value = as_floats(f"{path}.{field.name}", getattr(parameters, field.name), "a number")
        if not np.isfinite(value).all() or (field.name not in SIGNED and not (value > 0).all()):
            kind = "finite" if field.name in SIGNED else "finite and positive"
            raise InputError(f"{path}.{field.name}", value.tolist(), f"a {kind} number (SI units)")
    if not np.all(np.asarray(parameters.trip_start) < np.asarray(parameters.trip_end)):
        raise InputError(f"{path}.trip_start", parameters.trip_start, "a pressure [Pa] below trip_end")
    if not np.all(np.asarray(parameters.live_oil_share) < 1):
        raise InputError(f"{path}.live_oil_share", parameters.live_oil_share, "a share below 1")
    return parameters


def parameters_from_dict(body: Any, path: str = "well") -> WellParameters:
    """Parameters from a mapping of names to numbers; names left out keep the shipped value.

    Raises:
        InputError: naming the field, for an unknown name or a value that is not a physical number.
    """
    if not isinstance(body, dict):
        raise InputError(path, body, "a mapping of parameter names to numbers")
    known = [field.name for field in fields(WellParameters)]
    for name, value in body.items():
        among(f"{path}.{name}", name, known, "one of", value)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InputError(f"{path}.{name}", value, "a number (SI units)")
    return check_parameters(WellParameters(**{k: float(v) for k, v in body.items()}), path)


def parameters_to_dict(parameters: WellParameters) -> dict[str, float]:
    """Names and values of the parameters of one well."""
    return {field.name: float(getattr(parameters, field.name)) for field in fields(parameters)}


def load_parameters(path: str | Path) -> WellParameters:
    """Read parameters written by `save_parameters`. Raises `InputError` naming the field that is wrong."""
    body = read_json("parameter file", path)
    return parameters_from_dict(body.get("parameters", body) if isinstance(body, dict) else body)


def save_parameters(parameters: WellParameters, path: str | Path, **facts: Any) -> Path:
    """Write the parameters of one well, and further facts, as JSON; the file is replaced in one go."""
    body = {"format": "jaxmpc/well/1", **facts, "parameters": parameters_to_dict(parameters)}
    return write_atomically(path, json.dumps(body, indent=1))


def well_hash(parameters: WellParameters) -> str:
    """Digest of the equations and of the parameters of one well, which names the plant in results."""
    body = inspect.getsource(model) + json.dumps(parameters_to_dict(parameters), sort_keys=True)
    return hashlib.sha256(body.encode()).hexdigest()[:16]
