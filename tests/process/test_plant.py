"""The JAX plant: integration, actuators, steady states, and its behaviour over the whole input box."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmpc.errors import InputError
from jaxmpc.process.well.choke import CHOKES
from jaxmpc.process.well.equations import SHIPPED_STEADY_STATE, WellParameters
from jaxmpc.process.well.plant import WellPlant, WellState, steady_state, steady_state_of

PLANT = WellPlant()
run = jax.jit(PLANT.run)


LANES, SAMPLES = 24, 500  # of one call: sequences of any number and length are run by one program


def batch_run(demands, disturbances=None, substep=1.0):
    """Run a batch of sequences ``"lane sample 2"`` from the shipped steady state; all states and outputs."""
    lanes, samples = demands.shape[:2]
    offsets = np.zeros((lanes, samples)) if disturbances is None else disturbances
    inputs = np.concatenate([demands, offsets[..., None]], axis=-1)
    inputs = np.pad(inputs, ((0, -lanes % LANES), (0, -samples % SAMPLES), (0, 0)), mode="edge")
    found = []
    for some in np.split(inputs, inputs.shape[0] // LANES):
        state = jax.tree.map(lambda v: np.tile(v, (LANES, *(1,) * np.ndim(v))), PLANT.init())
        parts = []
        for now in np.split(some, inputs.shape[1] // SAMPLES, axis=1):
            state, part = _run(state, now, substep)
            parts.append(jax.tree.map(np.asarray, part))
        found.append(jax.tree.map(lambda *v: np.concatenate(v, axis=1), *parts))
    return jax.tree.map(lambda *v: np.concatenate(v)[:lanes, :samples], *found)


@functools.partial(jax.jit, static_argnames="substep")
def _run(state, inputs, substep):
    plant = WellPlant(substep=substep)

    def sample(state, now):
        state, outputs = plant.step(state, now[:2], now[2])
        return state, (state.x, outputs)

    return jax.vmap(lambda state, inputs: jax.lax.scan(sample, state, inputs))(state, inputs)


def random_demands(rng, lanes, samples, choke_high=100.0, lift_high=10000.0):
    """Held levels of random length, corners of the box included, and reservoir offsets."""
    demands, offsets = np.zeros((lanes, samples, 2)), np.zeros((lanes, samples))
    for lane in range(lanes):
        t = 0
        while t < samples:
            hold = int(rng.choice([1, 5, 30, 200, 1000]))
            choke = rng.choice([0.0, 2.0, choke_high, rng.uniform(0, choke_high)])
            lift = rng.choice([0.0, 300.0, 1000.0, lift_high, rng.uniform(0, lift_high)])
            demands[lane, t : t + hold] = choke, lift
            offsets[lane, t : t + hold] = rng.choice([0.0, 0.0, -10.0, -3.0, 3.0])
            t += hold
    return demands, offsets


def assert_physical(x, outputs):
    assert np.isfinite(x).all()
    assert (x[..., :5] > 10.0).all()  # kg
    assert (x[..., 5] >= 0).all()
    assert (x[..., 5] <= 1).all()
    assert all(np.isfinite(field).all() for field in outputs)
    assert (outputs.cv >= 0).all()
    for pressure in (outputs.wellhead_pressure, outputs.bottom_hole_pressure, outputs.injection_pressure):
        assert (pressure > 5).all()
        assert (pressure < 105).all()
    assert (outputs.annulus_pressure < 80.5).all()
    # The worst blow-down: a gas-filled, shut-in tubing, and the choke thrown wide open.
    assert outputs.cv[..., 0].max() < 110000


def test_default_start_is_the_shipped_steady_state():
    state = PLANT.init()
    np.testing.assert_array_equal(state.x, SHIPPED_STEADY_STATE)
    _, outputs = run(state, np.tile([50.0, 7500.0], (1000, 1)), 0.0)
    np.testing.assert_allclose(outputs.cv, np.tile(outputs.cv[0], (1000, 1)), rtol=1e-12)
    np.testing.assert_allclose(outputs.cv[0], [11012.70003, 185.004338], rtol=1e-8)


def test_one_second_steps_are_accurate_in_normal_operation():
    rng = np.random.default_rng(5)
    demands = np.repeat(rng.uniform((4, 2000), (100, 10000), (6, 12, 2)), 40, axis=1)
    coarse, fine = (batch_run(demands, substep=h)[1].cv for h in (1.0, 0.125))
    assert np.abs(coarse - fine).max(axis=(0, 1)) / np.abs(fine).max(axis=(0, 1)) == pytest.approx(
        0.0, abs=1e-5
    )


def test_one_second_steps_are_accurate_over_the_whole_input_box():
    demands, offsets = random_demands(np.random.default_rng(6), 12, 1500)
    coarse, fine = (batch_run(demands, offsets, h)[1].cv for h in (1.0, 0.125))
    assert (np.abs(coarse - fine) / np.maximum(fine, [1000.0, 20.0])).max() < 5e-3


def test_every_corner_shut_in_and_restart_stays_physical():
    before = [(0, 0), (0, 500), (0, 10000), (100, 0), (2, 0), (100, 10000)]
    after = [(c, q) for c in (2, 50, 100) for q in (0, 500, 2000, 10000)]
    demands = np.zeros((len(before) * len(after), 2400, 2))
    for i, (a, b) in enumerate((a, b) for a in before for b in after):
        demands[i, :1600], demands[i, 1600:] = a, b
    x, outputs = batch_run(demands)
    assert_physical(x, outputs)


def test_random_sequences_stay_physical():
    x, outputs = batch_run(*random_demands(np.random.default_rng(7), 16, 2000))
    assert_physical(x, outputs)


@pytest.mark.slow
def test_long_random_sequences_stay_physical():
    x, outputs = batch_run(*random_demands(np.random.default_rng(8), 100, 8000))
    assert_physical(x, outputs)


def test_flow_stops_when_the_choke_shuts_and_returns_when_it_opens():
    demands = np.zeros((1, 3000, 2))
    demands[0, :1000], demands[0, 1000:] = (0.0, 0.0), (50.0, 7500.0)
    _, outputs = batch_run(demands)
    assert outputs.cv[0, 999].max() < 1e-3
    np.testing.assert_allclose(outputs.cv[0, -1], [11012.70003, 185.004338], rtol=1e-6)


def test_restart_after_a_shut_in_with_lift_is_no_worse_than_a_blow_down_of_the_stored_gas():
    demands = np.zeros((1, 2000, 2))
    demands[0, :1000], demands[0, 1000:] = (0.0, 7500.0), (50.0, 7500.0)
    x, outputs = batch_run(demands)
    gas = outputs.cv[0, 1000:, 0]
    assert gas.max() < 40000
    stored = x[0, 999, :3].sum() / (101325 * 0.02 / (8.314462618 * 288.15))
    assert (gas[:60] * 10 / 3600).sum() < stored + 7500 * 600 / 3600 + 500


def test_inputs_are_held_over_a_sample():
    mv = np.array([60.0, 9000.0])
    short = run(PLANT.init(), np.tile(mv, (4, 1)), 0.0)[0]
    long = jax.jit(WellPlant(dt=40.0).step)(PLANT.init(), mv)[0]
    np.testing.assert_allclose(short.x, long.x, rtol=1e-13)


def test_a_batch_equals_its_lanes_one_by_one():
    rng = np.random.default_rng(9)
    x = np.asarray(SHIPPED_STEADY_STATE) * rng.uniform(0.8, 1.2, (5, 8))
    mv = rng.uniform((0, 0), (100, 10000), (5, 2))
    offset = rng.uniform(-5, 5, 5)
    parameters = jax.tree.map(lambda v: v * rng.uniform(0.95, 1.05, 5), WellParameters())

    def step(x, mv, offset, parameters):
        state = WellState(x, mv[0], mv[1])
        return WellPlant(parameters).step(state, mv, offset)

    together = jax.jit(jax.vmap(step))
    batch = jax.tree.map(np.asarray, together(x, mv, offset, parameters))
    order = np.array([3, 1, 4, 0, 2])
    permuted = together(*jax.tree.map(lambda v: v[order], (x, mv, offset, parameters)))
    for a, b in zip(jax.tree.leaves(batch), jax.tree.leaves(permuted), strict=True):
        np.testing.assert_array_equal(a[order], b)
    one_by_one = jax.jit(step)
    for lane in range(5):
        single = one_by_one(*jax.tree.map(lambda v, i=lane: v[i], (x, mv, offset, parameters)))
        for a, b in zip(jax.tree.leaves(batch), jax.tree.leaves(single), strict=True):
            np.testing.assert_allclose(a[lane], b, rtol=1e-12, atol=1e-9)


def steady(choke, lift):
    """The steady state at some inputs, by the program of a plant that starts elsewhere."""
    return steady_state_of(float(choke), float(lift), 0.0, PLANT.parameters)


def test_steady_states_agree_with_long_simulation_over_the_whole_box():
    choke, lift = (
        v.ravel() for v in np.meshgrid([0.5, 2.0, 10.0, 50.0, 100.0], [0.0, 200.0, 1000.0, 10000.0])
    )
    found = [steady(c, q) for c, q in zip(choke, lift, strict=True)]
    assert all(bool(one.converged) for one in found)
    demands = np.repeat(np.stack([choke, lift], axis=-1)[:, None], 8640, axis=1)
    _, outputs = batch_run(demands)
    cv = np.stack([one.outputs.cv for one in found])
    np.testing.assert_allclose(cv, outputs.cv[:, -1], rtol=1e-5, atol=0.05)


def test_a_lane_without_numbers_is_never_steady_in_a_large_batch():
    lanes = 800  # from about 650 on XLA's maximum leaves NaN out
    choke, lift = np.full(lanes, 50.0), np.full(lanes, 7500.0)
    lift[::2] = np.nan
    found = jax.jit(jax.vmap(lambda c, q: steady_state(c, q)))(choke, lift)
    np.testing.assert_array_equal(np.asarray(found.converged), np.isfinite(lift))


def test_a_slowly_filling_shut_well_is_reported_as_not_converged():
    found = steady(0.0, 5.0)
    assert not bool(found.converged)
    assert np.isfinite(found.x).all()


def test_a_start_elsewhere_is_steady():
    state = PLANT.init(20.0, 5000.0, -2.0)
    after, outputs = run(state, np.tile([20.0, 5000.0], (1000, 1)), -2.0)
    np.testing.assert_allclose(after.x, state.x, rtol=1e-8)
    np.testing.assert_allclose(PLANT.measure(state, -2.0).cv, outputs.cv[-1], rtol=1e-8)


@pytest.mark.parametrize(
    ("position", "demand", "expected"),
    [
        (50.0, 51.5, 50.0),
        (50.0, 51.6, 52.0),
        (50.0, 51.6 - 1e-12, 52.0),
        (50.0, 48.4, 48.0),
        (50.0, 48.41, 50.0),
        (50.0, 57.2, 58.0),
        (50.0, 130.0, 100.0),
        (50.0, -5.0, 0.0),
        (98.0, 99.6, 100.0),
        (0.0, 1.59, 0.0),
    ],
)
def test_step_choke_moves_to_the_nearest_position_once_1_6_away(position, demand, expected):
    assert float(CHOKES["step"].move(position, demand)) == expected
    assert float(CHOKES["step"].move(jnp.asarray(position), jnp.asarray(demand))) == expected


@settings(deadline=None, max_examples=200)
@given(st.integers(0, 50), st.floats(0, 100))
def test_step_choke_ends_within_reach_of_the_demand_and_stays_there(start, demand):
    position = float(CHOKES["step"].move(2.0 * start, demand))
    assert position % 2.0 == 0.0
    assert abs(position - demand) < 1.6
    assert float(CHOKES["step"].move(position, demand)) == position


def test_actuators_are_part_of_the_plant():
    mv = jnp.array([51.0, 7500.0])
    _, continuous = jax.jit(PLANT.step)(PLANT.init(), mv)
    _, stepped = jax.jit(PLANT.with_actuator("step").step)(PLANT.init(), mv)
    np.testing.assert_array_equal(continuous.mv, [51.0, 7500.0])
    np.testing.assert_array_equal(stepped.mv, [50.0, 7500.0])
    assert float(CHOKES["continuous"].move(50.0, 120.0)) == 100.0


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"dt": -1.0}, "plant.dt"),
        ({"dt": 10.5}, "plant.dt"),
        ({"substep": float("nan")}, "plant.substep"),
        ({"actuator": "stepper"}, "plant.actuator"),
        ({"parameters": WellParameters(tubing_length=-1.0)}, "plant.parameters.tubing_length"),
    ],
)
def test_bad_plants_are_refused_by_name(arguments, field):
    with pytest.raises(InputError) as caught:
        WellPlant(**arguments)
    assert caught.value.field == field


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ((101.0, 7500.0), "choke"),
        ((50.0, -1.0), "gas_lift"),
        ((50.0, float("nan")), "gas_lift"),
        (("half",), "choke"),
    ],
)
def test_bad_starts_are_refused_by_name(arguments, field):
    with pytest.raises(InputError) as caught:
        PLANT.init(*arguments)
    assert caught.value.field == field
    assert "%" in str(caught.value) or "m3/h" in str(caught.value)
