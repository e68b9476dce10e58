import dataclasses

import jax
import numpy as np
import pytest

from jaxmpc.errors import InputError
from jaxmpc.problem.blocking import sample_moves, single_step_blocks, window_rows
from jaxmpc.problem.condense import Rows, condense, dynamic_matrix, matrices_of
from jaxmpc.problem.layout import Size, layout_of
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import make_tuning
from jaxmpc.relaxed.problem import evaluate
from tests.oracles.kkt import dense_rows
from tests.posed import over, pose

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


_matrix = jax.jit(dynamic_matrix)
_matrices = jax.jit(matrices_of, static_argnames="size")
_rows = jax.jit(Rows.of_layout)
_along = jax.jit(jax.vmap(Rows.of, in_axes=(None, 0)))
_value = jax.jit(evaluate)


def matrix_of(s: Structure, coefficients):
    """The dynamic matrix of a structure at j = 1..Hp, without its padding."""
    size = Size.of(s, coefficients.shape[-1])
    theta = np.asarray(
        _matrix(layout_of(s, size), over(coefficients, size.future), np.arange(1, size.horizon + 1))
    )
    return theta[:, : s.prediction_horizon, :, : s.block_count]


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
    theta = matrix_of(s, coefficients)
    got = np.einsum("cjmb,bm->cj", theta, moves)
    expected = sample_by_sample(coefficients, sample_moves(s) @ moves, horizon)
    np.testing.assert_allclose(got, expected, atol=1e-12)  # the same sums in another order


def test_blocks_of_one_are_no_blocking():
    coefficients = np.random.default_rng(1).normal(size=(2, 2, 9))
    plain = structure(blocks=(), control_horizon=6)
    both = [
        matrix_of(dataclasses.replace(plain, blocking=mode), coefficients) for mode in ("moves", "inputs")
    ]
    np.testing.assert_allclose(both[0], both[1], atol=1e-12)
    assert both[0].shape == (2, 15, 2, 6)


@pytest.mark.parametrize("blocking", ["moves", "inputs"])
def test_hard_rows_say_what_the_samples_do(blocking):
    """Positions at block ends and oscillation rows bound the same plans as every sample does."""
    s = structure(
        blocking=blocking, control_horizon=7, blocks=(1, 1, 2, 3), mv_names=("u",), integer_step=(2.0,)
    )
    layout, rows = layout_of(s, Size.of(s, 9)), rows_of(s, Size.of(s, 9))
    rng = np.random.default_rng(2)
    agree = {True: 0, False: 0}
    moves = rng.integers(-2, 3, size=(3000, 4))
    for d, along in zip(moves, np.asarray(_along(rows, moves.astype(float))), strict=True):
        samples = sample_moves(s) @ d
        by_sample = np.abs(np.cumsum(samples)).max() <= 3 and np.abs(np.diff(samples)).max() <= 1
        by_rows = (
            np.abs(along[:4]).max() <= 3
            and np.abs(along[4:][layout.coupled]).max(initial=0) <= 1
            and np.abs(d[single_step_blocks(s)]).max(initial=0) <= 1
        )
        assert by_sample == by_rows
        agree[by_rows] += 1
    assert min(agree.values()) > 10


def rows_of(s: Structure, size: Size) -> Rows:
    """The hard rows of a structure in arrays of a size."""
    return _rows(layout_of(s, size))


ROWS = {
    "moves": {},
    "inputs": dict(blocking="inputs"),
    "windows": dict(mean_move_mode="predictive", mean_move_window=3),
    "windows, inputs": dict(mean_move_mode="predictive", mean_move_window=4, blocking="inputs"),
    "windows of all samples": dict(mean_move_mode="predictive", mean_move_window=40),
    "three MVs, one block": dict(mv_names=("u", "v", "w"), integer_step=(), blocks=(12,)),
}


@pytest.mark.parametrize("room", [False, True])
@pytest.mark.parametrize("name", ROWS)
def test_products_of_hard_rows_are_those_of_the_dense_matrix(name, room):
    """By structure and by every sample; in arrays of the structure's own size and of a larger one."""
    s = structure(**ROWS[name])
    size = Size.of(s, 9)
    if room:
        size = size._replace(blocks=16, horizon=64, windows=64 if size.windows else 0)
    rows, dense, rng = rows_of(s, size), dense_rows(s, size), np.random.default_rng(6)
    x, prices, weights = (
        rng.normal(size=size.moves),
        rng.normal(size=len(dense)),
        rng.uniform(size=len(dense)),
    )
    along, pulled, squared, sizes = _products(rows, x, prices, weights)
    close = dict(rtol=1e-12, atol=1e-12)  # the same sums in another order
    np.testing.assert_allclose(along, dense @ x, **close)
    np.testing.assert_allclose(pulled, dense.T @ prices, **close)
    np.testing.assert_allclose(squared, dense.T @ (weights[:, None] * dense), **close)
    np.testing.assert_allclose(sizes, (dense**2).sum(axis=1), **close)
    for share in (0.0, 0.2, 1.0):
        free = (rng.uniform(size=size.moves) < share).astype(float)
        np.testing.assert_array_equal(_touched(rows, free), np.abs(dense) @ free > 0.0)


@jax.jit
def _products(rows: Rows, x, prices, weights):
    mvs = prices.shape[0] // rows.size.shape[0]
    return rows.of(x), rows.pull(prices), rows.square(weights), rows.spread(rows.size, mvs)


_touched = jax.jit(Rows.touch)


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
        coefficients = rng.normal(size=(2, 2, 9))
        free, target = rng.normal(size=(15, 2)), rng.normal(size=(15, 2))
        posed = pose(
            s, t, coefficients, free_response=free, setpoint=target, mv_now=[0.0, 0.0], envelope=envelope
        )
        qp, instance = posed.qp, posed.instance
        x = np.zeros((2, posed.size.blocks))  # what follows the five blocks is padding
        x[:, :5] = [rng.integers(-widest, widest + 1, size=5), rng.normal(size=5)]
        moves = (x * np.asarray(qp.scale).reshape(2, -1))[:, :5].T
        y = free + sample_by_sample(coefficients, sample_moves(s) @ moves, 15).T
        y, e = y[2:], (y - target)[2:]
        beyond = np.maximum(np.abs(e) - [0.3, 1.0], 0)
        value = (e**2 * [0.5, 0.0] + beyond**2 * [0.0, 2.0] + beyond * [1.0, 0.0]).sum()
        value += ((sample_moves(s) @ moves) ** 2 * [3.0, 0.2]).sum()
        over, under = (
            np.maximum((y - [1.0, 0.7]).max(0), 0),
            np.maximum((np.array([-np.inf, -0.5]) - y).max(0), 0),
        )
        value += (np.array([10.0, 5.0]) * (over + under)).sum()
        assert float(_value(qp, instance, x.reshape(-1))) == pytest.approx(value, rel=1e-12)


def steady(s: Structure, tuning, **step):
    """The problem of a step at its setpoint, of responses of one."""
    zero = np.zeros((15, 2))
    return pose(s, tuning, np.ones((2, 2, 5)), free_response=zero, setpoint=zero, **step)


@pytest.mark.parametrize("drift", [-1e-10, 0.0, 1e-10])
def test_float_drift_at_a_limit_does_not_cost_a_step(drift):
    s = structure()
    t = make_tuning(
        s, cv_weight=1.0, move_weight=1.0, mv_low=0.0, mv_high=100.0, move_low=-2.0, move_high=2.0
    )
    posed = steady(s, t, mv_now=[98.0 + drift, 50.0], last_move=[-2.000000465, 0.0])
    instance = posed.instance
    assert np.array_equal(instance.row_high[:5], np.ones(5))
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
    posed = steady(s, t, mv_now=[0.0, 50.0], last_move=[-2.000000465, 0.0])
    instance = posed.instance
    assert (float(instance.lower[0]), float(instance.upper[0])) == (0.0, 0.0)
    assert posed.rows.shape[0] == len(instance.row_low)


def test_an_mv_outside_its_limits_may_return_the_shortest_way():
    s = structure(control_horizon=5, blocks=())
    t = make_tuning(
        s, cv_weight=1.0, move_weight=1.0, mv_low=0.0, mv_high=100.0, move_low=-2.0, move_high=2.0
    )
    posed = steady(s, t, mv_now=[106.0, 103.0], recover=True)
    instance, rows = posed.instance, posed.size.rows
    assert np.array_equal(instance.row_high[:5], [-1, -2, -3, -3, -3])  # steps of 2 %
    lift = instance.row_high[rows : rows + 5] * 2.0
    np.testing.assert_allclose(lift, [-2, -3, -3, -3, -3])


def test_batched_weights_share_one_program():
    s = structure()
    size, tuning = Size.of(s, 5), make_tuning(s, cv_weight=1.0, move_weight=1.0)
    layout = layout_of(s, size)
    ones = np.ones((2, 2, size.future))

    def make(gain):
        return condense(layout, size, tuning, matrices_of(layout, size, gain * ones))

    both = jax.jit(jax.vmap(make))(np.array([1.0, 2.0]))
    both = jax.tree.map(np.asarray, both)
    np.testing.assert_allclose(
        both.theta[1], 2.0 * both.theta[0] * (both.scale[1] / both.scale[0]), rtol=1e-12
    )
    assert np.abs(both.theta[0]).max() > 0.0


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
    size = Size.of(s, 9)
    layout = layout_of(s, size)
    coefficients = over(np.random.default_rng(7).normal(size=(2, 2, 9)), size.future)
    matrices = _matrices(layout, size, coefficients)

    def constants(weight, limit):
        tuning = make_tuning(
            s, cv_weight=[1.0, 2.0], move_weight=1.0, move_low=-4.0, move_high=4.0, mv_low=0.0, mv_high=9.0
        )
        tuning = dataclasses.replace(
            tuning, cv_weight=weight * tuning.cv_weight, move_high=limit * tuning.move_high
        )
        qp = condense(layout, size, tuning, matrices)
        return (qp.response, qp.summed), qp.scale, qp.theta

    # `out_axes=None` is refused for anything that has a batch axis
    over_tunings = jax.jit(jax.vmap(constants, in_axes=(0, 0), out_axes=(None, 0, 0)))
    (response, summed), scale, theta = jax.tree.map(
        np.asarray, over_tunings(np.array([1.0, 3.0]), np.array([1.0, 2.0]))
    )
    assert response.shape == (size.cvs * size.horizon, size.moves)
    assert np.shape(summed) == (size.cvs * size.horizon, size.moves * (size.moves + 1) // 2)
    assert not np.allclose(scale[0], scale[1])
    np.testing.assert_allclose(theta[1], response * scale[1], rtol=1e-15)
