"""The well model: its tables, its balances, and its parameter files."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc.errors import InputError
from jaxmpc.process.plant import lanes_of_plants
from jaxmpc.process.well.equations import (
    SHIPPED_STEADY_STATE,
    STATES,
    WellParameters,
    load_parameters,
    model,
    parameters_from_dict,
    parameters_to_dict,
    save_parameters,
    well_hash,
)
from jaxmpc.process.well.plant import JaxOps, WellPlant, rates, steady_state

CHOKES = (4.0, 10.0, 20.0, 30.0, 50.0, 70.0, 100.0)
LIFTS = (5000.0, 7500.0, 10000.0)
# Steady oil / gas [m3/h] over choke (rows) and lift (columns).
OIL = [
    (60, 65, 66),
    (106, 116, 122),
    (135, 150, 158),
    (149, 166, 175),
    (165, 185, 196),
    (173, 195, 206),
    (177, 199, 211),
]
GAS = [
    (4542, 6234, 7842),
    (6053, 8213, 10220),
    (7062, 9557, 11829),
    (7546, 10208, 12604),
    (8138, 11013, 13557),
    (8429, 11415, 14035),
    (8564, 11604, 14262),
]
# Change of the steady oil rate per % of choke [m3/h per %].
OIL_GAIN = [
    (11.6, 13.2, 14.2),
    (4.8, 5.5, 5.9),
    (1.80, 2.07, 2.21),
    (1.09, 1.26, 1.35),
    (0.60, 0.70, 0.75),
    (0.24, 0.29, 0.31),
    (0.054, 0.066, 0.071),
]


class NumpyOps:
    sqrt = staticmethod(np.sqrt)

    @staticmethod
    def positive(x):
        return np.maximum(x, 0.0)


@pytest.fixture(scope="module")
def steady():
    """Steady CVs as a function of arrays of choke, lift and disturbance."""
    solve = jax.jit(jax.vmap(lambda c, q, d: steady_state(c, q, d)))

    def rates_at(choke, lift, disturbance=0.0):
        choke, lift, disturbance = np.broadcast_arrays(*(np.float64(v) for v in (choke, lift, disturbance)))
        size = 63  # one shape, one compilation
        padded = [np.resize(v.ravel(), size) for v in (choke, lift, disturbance)]
        found = solve(*padded)
        assert bool(jnp.all(found.converged))
        return np.asarray(found.outputs.cv)[: choke.size].reshape(*choke.shape, 2)

    return rates_at


def test_steady_map_matches_the_published_table(steady):
    cv = steady(np.array(CHOKES)[:, None], np.array(LIFTS)[None, :])
    assert np.abs(cv[..., 1] - OIL).max() <= 0.55
    assert np.abs(cv[..., 0] - GAS).max() <= 0.55


def test_steady_oil_at_low_lift_matches_the_published_table(steady):
    cv = steady(np.array([4.0, 10.0, 20.0, 100.0]), 2000.0)
    assert np.abs(cv[:, 1] - [48, 79, 97, 119]).max() <= 0.55
    assert np.abs(cv[:3, 0] - [2341, 3168, 3665]).max() <= 0.55


def test_oil_gain_falls_with_the_choke_as_in_the_published_table(steady):
    choke, lift, h = np.array(CHOKES)[:, None], np.array(LIFTS)[None, :], 0.05
    up = steady(np.minimum(choke + h, 100.0), lift)[..., 1]
    down = steady(choke - h, lift)[..., 1]
    gain = (up - down) / (np.minimum(choke + h, 100.0) - choke + h)
    assert np.allclose(gain, OIL_GAIN, rtol=0.015, atol=0.006)


def test_a_3_bar_reservoir_drop_costs_9_8_and_lift_9800_restores_it(steady):
    before, after, restored = steady(50.0, np.array([7500.0, 7500.0, 9800.0]), np.array([0.0, -3.0, -3.0]))
    assert before[1] - after[1] == pytest.approx(9.8, abs=0.05)
    assert restored[1] == pytest.approx(before[1], abs=0.2)


def test_shipped_steady_state_is_steady():
    x = jnp.asarray(SHIPPED_STEADY_STATE)
    dx = rates(x, jnp.array([50.0, 7500.0, 0.0]), WellParameters())
    assert np.abs(np.asarray(dx) / np.abs(np.asarray(x))).max() < 1e-14


def test_equations_are_the_same_for_numpy_and_jax():
    rng = np.random.default_rng(0)
    x = np.array(SHIPPED_STEADY_STATE) * rng.uniform(0.6, 1.4, (50, 8))
    u = rng.uniform((0, 0, -5), (100, 10000, 5), (50, 3))
    dx, y = model(NumpyOps, tuple(x.T), tuple(u.T), WellParameters())
    dx_jax, y_jax = model(JaxOps, tuple(jnp.asarray(x.T)), tuple(jnp.asarray(u.T)), WellParameters())
    for a, b in zip([*dx, *y], [*dx_jax, *y_jax], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-9)


def test_gas_and_liquid_are_conserved():
    p = WellParameters()
    rng = np.random.default_rng(1)
    x = np.array(SHIPPED_STEADY_STATE) * rng.uniform(0.7, 1.3, (50, 8))
    dx, y = model(NumpyOps, tuple(x.T), (50.0, 7500.0, 0.0), p)
    gas_density = 101325.0 * p.molar_mass / (8.314462618 * 288.15)
    inflow = p.productivity * np.maximum(x[:, 7] - 1e5 * y[3], 0.0)
    gas_in = y[6] * gas_density / 3600 + p.gas_oil_ratio * gas_density / p.liquid_density * inflow
    gas_out = y[0] * gas_density / 3600 / p.gas_meter
    np.testing.assert_allclose(dx[0] + dx[1] + dx[2], gas_in - gas_out, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(dx[3] + dx[4], inflow - y[1] * p.liquid_density / 3600, rtol=1e-9, atol=1e-9)


def test_a_shut_choke_lets_nothing_out_and_a_dead_supply_lets_nothing_in():
    x = np.array(SHIPPED_STEADY_STATE)
    x[5] = x[6] = 0.0
    _, y = model(NumpyOps, tuple(x), (0.0, 0.0, 0.0), WellParameters())
    assert y[0] == 0.0
    assert y[1] == 0.0
    assert y[6] == 0.0


def test_robustness_terms_are_inactive_in_normal_operation(steady):
    plain = dataclasses.replace(
        WellParameters(), live_oil_share=1e-6, equalising_rate=1e6, trip_start=148e5, trip_end=149e5
    )
    choke, lift = (v.ravel() for v in np.meshgrid([2.0, 10.0, 50.0, 100.0], [2000.0, 5000.0, 10000.0]))
    found = jax.jit(jax.vmap(lambda c, q: steady_state(c, q, 0.0, plain).outputs.cv))(choke, lift)
    np.testing.assert_allclose(found, steady(choke, lift), rtol=1e-9)


def test_parameters_survive_a_file(tmp_path):
    changed = dataclasses.replace(WellParameters(), tubing_length=1000.125)
    path = save_parameters(changed, tmp_path / "well.json", note="text")
    assert parameters_to_dict(load_parameters(path)) == parameters_to_dict(changed)
    assert json.loads(path.read_text())["note"] == "text"


def test_well_hash_changes_with_any_parameter():
    digests = {well_hash(WellParameters())}
    for name, value in parameters_to_dict(WellParameters()).items():
        digests.add(well_hash(dataclasses.replace(WellParameters(), **{name: value * 1.01})))
    assert len(digests) == 1 + len(parameters_to_dict(WellParameters()))


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"tubing_lenght": 1.0}, "well.tubing_lenght"),
        ({"tubing_length": -1.0}, "well.tubing_length"),
        ({"tubing_length": float("nan")}, "well.tubing_length"),
        ({"tubing_length": "long"}, "well.tubing_length"),
        ({"trip_start": 90e5}, "well.trip_start"),
        ({"live_oil_share": 1.5}, "well.live_oil_share"),
        ([], "well"),
    ],
)
def test_bad_parameters_are_refused_by_name(body, field):
    with pytest.raises(InputError) as caught:
        parameters_from_dict(body)
    assert caught.value.field == field


def test_every_state_has_a_unit_and_a_text():
    assert len(STATES) == len(SHIPPED_STEADY_STATE)
    assert all(unit and text for _, unit, text in STATES)


# ------------------------------------------------------------------------------------------ engineering units


def test_parameters_are_listed_in_engineering_units_and_shift_back_to_the_last_bit():
    table = {p.name: p for p in WellPlant.parameter_table}
    assert (table["reservoir_pressure"].default, table["reservoir_pressure"].unit) == (78.2901, "bar")
    assert (table["productivity"].default, table["productivity"].unit) == (2.01723, "kg/s/bar")
    assert table["gas_meter"].unit == "1"
    listed = WellPlant().replaced({name: p.default for name, p in table.items()})
    assert parameters_to_dict(listed.parameters) == parameters_to_dict(WellParameters())


def test_replaced_parameters_are_those_of_the_equations():
    plant = WellPlant(actuator="step").replaced({"reservoir_pressure": 80.1, "choke_linear": -0.5})
    assert plant.parameters == WellParameters(reservoir_pressure=8010000.0, choke_linear=-0.5)
    assert plant.actuator == "step"
    lanes = lanes_of_plants(WellPlant(), {"trip_end": np.array([80.0, 81.3]), "molar_mass": 0.021})
    np.testing.assert_array_equal(lanes.each.parameters.trip_end, [8000000.0, 8130000.0])
    assert lanes.count == 2
    assert lanes.shared.parameters.molar_mass == 0.021
    assert lanes.shared.parameters.trip_end is None
    for values, told in {
        ("reservoir_presure", 80.0): "Did you mean reservoir_pressure",
        ("reservoir_pressure", -80.0): r"plant.reservoir_pressure: .* positive number \[bar\]",
        ("trip_start", 90.0): "plant.parameters.trip_start",
    }.items():
        with pytest.raises(InputError, match=told):
            WellPlant().replaced(dict([values]))
