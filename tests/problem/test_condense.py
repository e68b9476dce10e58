import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc.errors import InputError
from jaxmpc.problem.blocking import (
    hard_rows,
    oscillation_rows,
    position_rows,
    sample_moves,
    single_step_blocks,
    window_rows,
)
from jaxmpc.problem.condense import condense, dynamic_matrix, make_instance
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import make_tuning
from jaxmpc.relaxed.problem import evaluate

BLOCKS = (1, 1, 2, 3, 5)


def structure(**changes):
    base = dict(
        cv_names=("a", "b"),
        mv_names=("u", "v"),
        prediction_horizon=15,
        control_horizon=12,
        blocks=BLOCKS,
        integer_step=(2.0, None),
    )
    return Structure(**(base | changes))


def sample_by_sample(coefficients, moves, horizon):
    """y at 1..horizon by superposition of step responses, one move at a time."""
    n = coefficients.shape[-1]
    y = np.zeros((coefficients.shape[0], horizon))
    for k, move in enumerate(moves):
        for j in range(k + 1, horizon + 1):
            y[:, j - 1] += coefficients[..., min(j - k, n) - 1] @ move
    return y


@pytest.mark.parametrize("blocking", ["moves", "inputs"])
@pytest.mark.parametrize("samples", [4, 15, 40])
@pytest.mark.parametrize("horizon", [6, 15, 30])
def test_the_blocked_dynamic_matrix_superposes_step_responses(blocking, samples, horizon):
    rng = np.random.default_rng(samples)
    s = structure(blocking=blocking, prediction_horizon=horizon)
    coefficients, moves = rng.normal(size=(2, 2, samples)), rng.normal(size=(5, 2))
    theta = np.asarray(dynamic_matrix(s, jnp.asarray(coefficients)))
    got = np.einsum("cjmb,bm->cj", theta, moves)
    expected = sample_by_sample(coefficients, sample_moves(s) @ moves, horizon)
    np.testing.assert_allclose(got, expected, atol=1e-12)  # the same sums in another order


def test_blocks_of_one_are_no_blocking():
    coefficients = jnp.asarray(np.random.default_rng(1).normal(size=(2, 2, 9)))
    plain = structure(blocks=(), control_horizon=6)
    both = [
        dynamic_matrix(dataclasses.replace(plain, blocking=mode), coefficients)
        for mode in ("moves", "inputs")
    ]
    np.testing.assert_allclose(both[0], both[1], atol=1e-12)
    assert both[0].shape == (2, 15, 2, 6)


@pytest.mark.parametrize("blocking", ["moves", "inputs"])
def test_hard_rows_say_what_the_samples_do(blocking):
    """Positions at block ends and oscillation rows bound the same plans as every sample does."""
    s = structure(blocking=blocking, control_horizon=7, blocks=(1, 1, 2, 3))
    rng = np.random.default_rng(2)
    agree = {True: 0, False: 0}
    for _ in range(3000):
        d = rng.integers(-2, 3, size=4)
        samples = sample_moves(s) @ d
        by_sample = np.abs(np.cumsum(samples)).max() <= 3 and np.abs(np.diff(samples)).max() <= 1
        by_rows = (
            np.abs(position_rows(s) @ d).max() <= 3
            and np.abs(oscillation_rows(s) @ d).max(initial=0) <= 1
            and np.abs(d[single_step_blocks(s)]).max(initial=0) <= 1
        )
        assert by_sample == by_rows
        agree[by_rows] += 1
    assert min(agree.values()) > 10


def test_window_rows_sum_the_moves_of_the_window():
    s = structure(mean_move_mode="predictive", mean_move_window=3)
    d = np.random.default_rng(3).normal(size=5)
    samples = sample_moves(s) @ d
    expected = [samples[max(0, k - 2) : k + 1].sum() for k in range(12)]
    np.testing.assert_allclose(window_rows(s) @ d, expected, atol=1e-12)


def test_the_condensed_objective_is_the_objective_of_the_thesis():
    """(6.6) term by term at whole moves, envelope included, against the condensed form."""
    rng = np.random.default_rng(4)
    for envelope, widest in ((0, 3), (1, 1), (3, 3)):
        s = structure(first_penalised=3)
        t = make_tuning(
            s,
            cv_weight=[0.5, 0.0],
            move_weight=[3.0, 0.2],
            soft_quadratic=[0.0, 2.0],
            soft_linear=[1.0, 0.0],
            deadzone=[0.3, 1.0],
            cv_low=[None, -0.5],
            cv_high=[1.0, 0.7],
            slack_weight=[10.0, 5.0],
            move_low=[-6.0, -7.0],
            move_high=[6.0, 7.0],
        )
        coefficients = jnp.asarray(rng.normal(size=(2, 2, 9)))
        qp = condense(s, t, coefficients, envelope=envelope)
        free, target = rng.normal(size=(15, 2)), rng.normal(size=(15, 2))
        instance = make_instance(
            s, t, qp, free_response=free, setpoint=target, mv_now=jnp.zeros(2), last_move=jnp.zeros(2)
        )
        x = np.concatenate([rng.integers(-widest, widest + 1, size=5), rng.normal(size=5)])
        moves = (x * np.asarray(qp.scale)).reshape(2, 5).T
        y = free + sample_by_sample(np.asarray(coefficients), sample_moves(s) @ moves, 15).T
        y, e = y[2:], (y - target)[2:]
        beyond = np.maximum(np.abs(e) - [0.3, 1.0], 0)
        value = (e**2 * [0.5, 0.0] + beyond**2 * [0.0, 2.0] + beyond * [1.0, 0.0]).sum()
        value += ((sample_moves(s) @ moves) ** 2 * [3.0, 0.2]).sum()
        over, under = (
            np.maximum((y - [1.0, 0.7]).max(0), 0),
            np.maximum((np.array([-np.inf, -0.5]) - y).max(0), 0),
        )
        value += (np.array([10.0, 5.0]) * (over + under)).sum()
        assert float(evaluate(qp, instance, jnp.asarray(x))) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("drift", [-1e-10, 0.0, 1e-10])
def test_float_drift_at_a_limit_does_not_cost_a_step(drift):
    s = structure()
    t = make_tuning(
        s, cv_weight=1.0, move_weight=1.0, mv_low=0.0, mv_high=100.0, move_low=-2.0, move_high=2.0
    )
    qp = condense(s, t, jnp.ones((2, 2, 5)))
    zero = jnp.zeros((15, 2))
    instance = make_instance(
        s,
        t,
        qp,
        free_response=zero,
        setpoint=zero,
        mv_now=jnp.asarray([98.0 + drift, 50.0]),
        last_move=jnp.asarray([-2.000000465, 0.0]),
    )
    rows = slice(0, 5)
    assert np.array_equal(instance.row_high[rows], np.ones(5))
    assert np.array_equal(instance.lower[:5], -np.ones(5))


def test_the_past_move_enters_the_oscillation_rows_rounded():
    """Thesis 6.5: -2.000000465 is one step down, and no move must remain possible at the lower limit."""
    s = structure()
    t = make_tuning(
        s,
        cv_weight=1.0,
        move_weight=1.0,
        mv_low=0.0,
        mv_high=100.0,
        move_low=-2.0,
        move_high=2.0,
        oscillation_rows={"u": True},
    )
    qp = condense(s, t, jnp.ones((2, 2, 5)))
    zero = jnp.zeros((15, 2))
    instance = make_instance(
        s,
        t,
        qp,
        free_response=zero,
        setpoint=zero,
        mv_now=jnp.asarray([0.0, 50.0]),
        last_move=jnp.asarray([-2.000000465, 0]),
    )
    assert (float(instance.lower[0]), float(instance.upper[0])) == (0.0, 0.0)
    assert hard_rows(s).shape[0] == len(instance.row_low)


def test_an_mv_outside_its_limits_may_return_the_shortest_way():
    s = structure(control_horizon=5, blocks=())
    t = make_tuning(
        s, cv_weight=1.0, move_weight=1.0, mv_low=0.0, mv_high=100.0, move_low=-2.0, move_high=2.0
    )
    qp = condense(s, t, jnp.ones((2, 2, 5)))
    zero = jnp.zeros((15, 2))
    instance = make_instance(
        s,
        t,
        qp,
        free_response=zero,
        setpoint=zero,
        mv_now=jnp.asarray([106.0, 103.0]),
        last_move=jnp.zeros(2),
        recover=True,
    )
    assert np.array_equal(instance.row_high[:5], [-1, -2, -3, -3, -3])  # steps of 2 %
    lift = instance.row_high[5 + 4 : 5 + 4 + 5] * 2.0
    np.testing.assert_allclose(lift, [-2, -3, -3, -3, -3])


def test_batched_weights_share_one_program():
    s = structure()
    make = lambda w: condense(s, make_tuning(s, cv_weight=1.0, move_weight=1.0), jnp.ones((2, 2, 5)) * w)  # noqa: E731
    both = jax.vmap(make)(jnp.asarray([1.0, 2.0]))
    np.testing.assert_allclose(
        both.theta[1][:26], 2.0 * both.theta[0][:26] * (both.scale[1] / both.scale[0]), rtol=1e-12
    )


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"blocks": (1, 2)}, "structure.blocks"),
        ({"blocks": (0, 12)}, "structure.blocks"),
        ({"blocking": "both"}, "structure.blocking"),
        ({"first_penalised": 16}, "structure.first_penalised"),
        ({"prediction_horizon": 0}, "structure.prediction_horizon"),
        ({"control_horizon": 2.5}, "structure.control_horizon"),
        ({"integer_step": (0.0, None)}, "structure.integer_step.u"),
        ({"integer_step": (1.0,)}, "structure.integer_step"),
        ({"dt": float("nan")}, "structure.dt"),
    ],
)
def test_a_bad_structure_names_the_field(changes, field):
    with pytest.raises(InputError) as error:
        structure(**changes)
    assert error.value.field == field


def test_tunings_share_the_response_of_their_model():
    """A vmap over tunings alone leaves what the Newton matrices are made of without a batch axis."""
    s = structure()
    coefficients = jnp.asarray(np.random.default_rng(7).normal(size=(2, 2, 9)))

    def constants(weight, limit):
        tuning = make_tuning(
            s, cv_weight=[1.0, 2.0], move_weight=1.0, move_low=-4.0, move_high=4.0, mv_low=0.0, mv_high=9.0
        )
        tuning = dataclasses.replace(
            tuning, cv_weight=weight * tuning.cv_weight, move_high=limit * tuning.move_high
        )
        qp = condense(s, tuning, coefficients)
        return (qp.response, qp.summed), qp.scale, qp.theta

    # `out_axes=None` is refused for anything that has a batch axis
    over = jax.vmap(constants, in_axes=(0, 0), out_axes=(None, 0, 0))
    (response, summed), scale, theta = over(jnp.asarray([1.0, 3.0]), jnp.asarray([1.0, 2.0]))
    assert response.shape == (30 + 5, 10)
    assert np.shape(summed) == (30, 55)
    assert not np.allclose(scale[0], scale[1])
    np.testing.assert_allclose(theta[1], response * scale[1], rtol=1e-15)
    np.testing.assert_array_equal(theta[1][30:, :5], np.eye(5))
