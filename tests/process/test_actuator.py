"""Actuators of every kind: where they go, when they stay, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmpc.errors import InputError
from jaxmpc.process.actuator import Actuator, Actuators

STEPPED = Actuator("stepped", low=-3.0, high=11.0, step=2.5, threshold=2.0, origin=1.0)
VALUES = Actuator("values", values=(0.0, 10.0, 25.0, 60.0))
SWITCH = Actuator("on-off", low=0.0, high=4.0)


@pytest.mark.parametrize(
    ("actuator", "position", "demand", "expected"),
    [
        (Actuator(low=-1.0), 0.0, -2.0, -1.0),
        (Actuator(low=-1.0), 0.0, 1e9, 1e9),
        (STEPPED, 1.0, 2.9, 1.0),
        (STEPPED, 1.0, 3.0, 3.5),
        (STEPPED, 8.5, 20.0, 11.0),
        (STEPPED, 1.0, -20.0, -1.5),  # -4 is a position below the limit
        (Actuator("stepped", low=0.0, high=9.0, step=2.0), 8.0, 9.0, 8.0),  # so is 10 above it
        (Actuator("stepped", step=2.0), 0.0, 1.0, 2.0),  # halfway to the next, by half a step if not given
        (VALUES, 10.0, 17.4, 10.0),
        (VALUES, 10.0, 17.5, 10.0),  # as near to where it stands as to the next
        (VALUES, 10.0, 17.6, 25.0),
        (VALUES, 25.0, 17.5, 25.0),
        (VALUES, 0.0, 1000.0, 60.0),
        (VALUES, 12.0, 11.5, 12.0),  # where it starts need not be in the list
        (VALUES, 12.0, 10.5, 10.0),
        (SWITCH, 0.0, 2.0, 0.0),
        (SWITCH, 0.0, 2.1, 4.0),
        (SWITCH, 4.0, 2.0, 4.0),
        (SWITCH, 4.0, -7.0, 0.0),
    ],
)
def test_an_actuator_goes_where_its_kind_says(actuator, position, demand, expected):
    assert float(actuator.move(position, demand)) == expected
    assert float(jax.jit(actuator.move)(position, demand)) == expected


@settings(deadline=None, max_examples=100)
@given(st.lists(st.tuples(*[st.integers(-200, 800)] * 4), min_size=2, max_size=5))
def test_all_actuators_of_a_plant_move_as_each_does_by_itself_and_then_stay(rows):
    each = Actuator(high=50.0), STEPPED, VALUES, SWITCH
    position = np.zeros(4)
    for demand in np.array(rows) / 10:
        moved = Actuators.of(each).move(position, demand)
        np.testing.assert_array_equal(
            moved, [a.move(p, d) for a, p, d in zip(each, position, demand, strict=True)]
        )
        np.testing.assert_array_equal(
            jnp.asarray(moved), Actuators.of(each).move(jnp.asarray(position), demand)
        )
        np.testing.assert_array_equal(Actuators.of(each).move(moved, demand), moved)
        position = moved


def test_a_batch_of_positions_moves_as_one_by_one():
    rng = np.random.default_rng(0)
    actuators = Actuators.of((STEPPED, VALUES))
    position, demand = rng.choice([1.0, 3.5], (7, 2)), rng.uniform(-5, 70, (7, 2))
    one_by_one = [actuators.move(p, d) for p, d in zip(position, demand, strict=True)]
    np.testing.assert_array_equal(jax.vmap(actuators.move)(position, demand), one_by_one)
    free = Actuators.of((), 2)
    np.testing.assert_array_equal(free.move(position, demand), demand)


@pytest.mark.parametrize(
    ("given", "field"),
    [
        ({"kind": "steped"}, "actuator.kind"),
        ({"low": 1.0, "high": 1.0}, "actuator.low"),
        ({"kind": "stepped"}, "actuator.step"),
        ({"kind": "stepped", "step": -1.0}, "actuator.step"),
        ({"kind": "stepped", "step": 5.0, "low": 1.0, "high": 4.0}, "actuator.step"),
        ({"kind": "stepped", "step": 5.0, "threshold": 0.0}, "actuator.threshold"),
        ({"step": 5.0}, "actuator.step"),
        ({"kind": "values", "values": (1.0,)}, "actuator.values"),
        ({"kind": "values", "values": (1.0, 3.0, 3.0)}, "actuator.values"),
        ({"kind": "on-off", "low": 0.0}, "actuator.low"),
    ],
)
def test_an_actuator_that_cannot_be_is_refused_by_name(given, field):
    with pytest.raises(InputError) as caught:
        Actuator(**given)
    assert caught.value.field == field


def test_a_plant_has_one_actuator_per_mv():
    with pytest.raises(InputError, match="2, one per MV"):
        Actuators.of([SWITCH], 2)
