"""Blocks of each MV in matrices, rows and limits: what the samples do, one after the other."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc.errors import InputError
from jaxmpc.problem.blocking import counts_by_mv, coupled_blocks, moves_of_samples, window_rows
from jaxmpc.problem.condense import Rows
from jaxmpc.problem.layout import Size, layout_of
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import make_tuning
from tests.posed import pose, solve_one
from tests.problem.test_condense import matrix_of, sample_by_sample

LISTS = ((1, 1, 2, 3), (3, 4))
MODES = {
    "moves": {},
    "inputs": dict(blocking="inputs"),
    "windows": dict(mean_move_mode="predictive", mean_move_window=3),
    "windows of inputs": dict(mean_move_mode="predictive", mean_move_window=3, blocking="inputs"),
}


def structure(**changes) -> Structure:
    """Two MVs whose blocks begin at different samples."""
    names = dict(cv_names=("y0", "y1"), mv_names=("u0", "u1"))
    return Structure(
        **(
            names
            | dict(prediction_horizon=12, control_horizon=7, blocks=LISTS, integer_step=(2.0, None))
            | changes
        )
    )


def planned(rng, s: Structure) -> np.ndarray:
    """Moves with zeros beyond the blocks of an MV."""
    return np.where(counts_by_mv(s) > 0, rng.normal(size=(s.block_count, 2)), 0.0)


@pytest.mark.parametrize("mode", MODES)
def test_the_dynamic_matrix_superposes_the_step_responses_of_every_sample(mode):
    rng, s = np.random.default_rng(3), structure(**MODES[mode])
    coefficients, moves = rng.normal(size=(2, 2, 9)), planned(rng, s)
    got = np.einsum("cjmb,bm->cj", matrix_of(s, coefficients), moves)
    expected = sample_by_sample(coefficients, moves_of_samples(s, moves), 12)
    np.testing.assert_allclose(got, expected, atol=1e-12)


def test_samples_have_the_moves_of_their_blocks():
    moves = np.array([[1.0, 5.0], [2.0, 6.0], [3.0, 0.0], [4.0, 0.0]])
    by_moves = moves_of_samples(structure(), moves)
    assert by_moves.T.tolist() == [[1, 2, 3, 3, 4, 4, 4], [5, 5, 5, 6, 6, 6, 6]]
    by_inputs = moves_of_samples(structure(blocking="inputs"), moves)
    assert by_inputs.T.tolist() == [[1, 2, 3, 0, 4, 0, 0], [5, 0, 0, 6, 0, 0, 0]]


def dense(s: Structure, size: Size) -> np.ndarray:
    """The hard rows of the moves, MV after MV, from the moves of samples."""
    out = np.zeros((2 * size.rows, size.moves))
    for column in np.argwhere(counts_by_mv(s).T):
        mv, block = column
        unit = np.zeros((s.block_count, 2))
        unit[block, mv] = 1.0
        samples = moves_of_samples(s, unit)[:, mv]
        part = out[mv * size.rows : (mv + 1) * size.rows, mv * size.blocks + block]
        ends = np.cumsum(s.blocks_of(mv)) - 1
        part[: len(ends)] = np.cumsum(samples)[ends]
        part[size.blocks + block] = 1.0
        if block + 1 < len(ends):
            part[size.blocks + block + 1] = -1.0
        if s.mean_move_mode == "predictive":
            for k in range(s.control_horizon):
                part[2 * size.blocks + k] = samples[max(k + 1 - s.mean_move_window, 0) : k + 1].sum()
    return out


@pytest.mark.parametrize("mode", MODES)
def test_hard_rows_and_their_products_are_those_of_the_samples(mode):
    rng, s = np.random.default_rng(4), structure(**MODES[mode])
    size = Size.of(s, 9)
    rows, W = Rows.of_layout(layout_of(s, size)), dense(s, size)
    there = np.abs(W).sum(axis=1) > 0  # rows of padding are limited by nothing
    real = np.concatenate([np.arange(size.blocks) < len(s.blocks_of(mv)) for mv in range(2)])
    x, prices = rng.normal(size=size.moves) * real, rng.normal(size=2 * size.rows) * there
    weights = rng.uniform(size=2 * size.rows) * there
    np.testing.assert_allclose(rows.of(jnp.asarray(x))[there], (W @ x)[there], atol=1e-12)
    np.testing.assert_allclose(rows.pull(jnp.asarray(prices))[real], (W.T @ prices)[real], atol=1e-12)
    square = np.asarray(rows.square(jnp.asarray(weights)))
    np.testing.assert_allclose(
        square[np.ix_(real, real)], (W.T * weights @ W)[np.ix_(real, real)], atol=1e-12
    )
    np.testing.assert_allclose(rows.spread(rows.size, 2)[there], (W**2).sum(axis=1)[there], atol=1e-12)
    free = np.zeros(size.moves)
    free[1] = 1.0
    assert (np.asarray(rows.touch(jnp.asarray(free)))[there] == (np.abs(W) @ free > 0)[there]).all()


def test_oscillation_couplings_and_windows_are_those_of_each_list():
    s = structure(blocking="inputs", **{k: v for k, v in MODES["windows"].items()})
    for mv, blocks in enumerate(LISTS):
        alone = dataclasses.replace(s, blocks=blocks)
        np.testing.assert_array_equal(coupled_blocks(s, mv), coupled_blocks(alone))
        np.testing.assert_array_equal(window_rows(s, mv), window_rows(alone))


def problem_of(s: Structure, fields, **options):
    """A problem of one sample with limits of every kind."""
    rng = np.random.default_rng(5)
    coefficients = np.cumsum(rng.normal(size=(2, 2, 9)), axis=2)
    tuning = make_tuning(
        s, **(fields | dict(mean_move_limit=[1.5, 60.0])), oscillation_rows={"u0": True, "u1": False}
    )
    return pose(
        s,
        tuning,
        coefficients,
        free_response=1e3 * rng.normal(size=(12, 2)),
        setpoint=np.zeros((12, 2)),
        mv_now=[50.0, 7500.0],
        last_move=[2.0, 0.0],
        past_moves=np.full((3, 2), [1.0, 30.0]),
        **options,
    )


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("recover", [False, True])
def test_the_same_blocks_for_each_mv_pose_the_problem_of_one_list(mode, recover, thesis_fields):
    s = structure(blocks=LISTS[0], **MODES[mode])
    size = Size.of(s, 9)
    limits = dict(mv_high=[40.0, 10000.0]) if recover else {}
    one, each = (
        problem_of(s, thesis_fields | limits, size=own, recover=recover)
        for own in (size, size._replace(own_blocks=True))
    )
    assert each.layout.count.shape == (2, size.blocks)
    np.testing.assert_array_equal(one.qp.theta, each.qp.theta)
    np.testing.assert_array_equal(one.qp.hessian, each.qp.hessian)
    for name in ("lower", "upper", "row_low", "row_high", "offset"):
        np.testing.assert_allclose(
            getattr(one.instance, name), getattr(each.instance, name), rtol=1e-14, err_msg=name
        )
    if not recover:
        values = [float(solve_one(posed.qp, posed.instance).objective) for posed in (one, each)]
        assert values[0] == pytest.approx(values[1], rel=1e-9)


def test_equal_lists_are_one_list():
    one, each = structure(blocks=(1, 2, 4)), structure(blocks=((1, 2, 4), (1, 2, 4)))
    assert one == each
    assert not each.own_blocks
    empty = structure(blocks=((), (3, 4)))
    assert empty.blocks == ((1,) * 7, (3, 4))
    assert empty.block_count == 7


def test_a_plan_one_sample_later_keeps_the_positions_of_each_mv():
    s = structure(blocks=((1, 1, 1, 1, 1, 1, 1), (1, 2, 4)))
    moves = np.array([[1, 1], [2, 2], [3, 4], [4, 0], [5, 0], [6, 0], [7, 0], [0, 0]], dtype=float)
    later = np.asarray(jax.jit(lambda layout: layout.shifted(moves))(layout_of(s, Size.of(s, 9))))
    assert later[:7, 0].tolist() == [2, 3, 4, 5, 6, 7, 0]
    assert later[:3, 1].tolist() == [
        2,
        3,
        3,
    ]  # the means of samples 1, 2 to 3 and 4 to 6, the last of them zero


@pytest.mark.parametrize(
    ("blocks", "field", "expected"),
    [
        (((1, 6),), "structure.blocks", "2 lists, one per MV"),
        (((1, 6), 7), "structure.blocks", "2 lists, one per MV"),
        (((1, 6), (3, 3)), "structure.blocks.u1", "sum to control_horizon = 7"),
        (((1, 6), (8, -1)), "structure.blocks.u1", "1 or more"),
    ],
)
def test_lists_that_do_not_fit_are_refused(blocks, field, expected):
    with pytest.raises(InputError, match=expected) as caught:
        structure(blocks=blocks)
    assert caught.value.field == field
