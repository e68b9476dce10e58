"""Padding is exact, and structures of one size share their programs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.controller.case import make_case
from jaxmpc.controller.plan import solve_plan
from jaxmpc.integer.search import decide
from jaxmpc.integer.tables import Constants
from jaxmpc.problem.layout import Size
from jaxmpc.problem.tuning import make_tuning
from jaxmpc.relaxed.solve import cold_start
from tests import problems
from tests.posed import pose, pose_case, solve_one

MODES = {
    "moves": {},
    "inputs": dict(blocking="inputs"),
    "moves, windows": dict(mean_move_mode="predictive", mean_move_window=6),
    "inputs, windows": dict(blocking="inputs", mean_move_mode="predictive", mean_move_window=6),
}
LARGER = Size(cvs=2, mvs=2, blocks=16, horizon=64, future=128, windows=32, past=128)
_decide = jax.jit(decide)


def both(mode: str, structure, fields, model, seed: int):
    """One problem with active CV limits in arrays that nothing pads, and in larger ones."""
    structure = dataclasses.replace(structure, **MODES[mode])
    limits = dict(cv_high=[11500.0, 188.0], mean_move_limit=[0.55, 60.0])
    tuning = make_tuning(structure, **(fields | limits), oscillation_rows={"choke": True})
    predictive = structure.mean_move_mode == "predictive"
    own = Size(
        cvs=2,
        mvs=2,
        blocks=structure.block_count,
        horizon=structure.horizon_count,
        future=model.samples,
        windows=structure.control_horizon if predictive else 0,
        past=structure.mean_move_window,
    )
    rng = np.random.default_rng(seed)
    free = np.array([11300.0, 187.0]) + np.cumsum(rng.normal(size=(40, 2)) * [60.0, 0.5], axis=0)
    step = dict(
        free_response=free,
        setpoint=np.tile([11000.0, 185.0] + rng.normal(size=2) * [2500.0, 20.0], (40, 1)),
        mv_now=[50.0, 7500.0],
        last_move=[2.0, 0.0],
        past_moves=rng.choice([0.0, 2.0], (structure.mean_move_window, 1)) * [1.0, 0.0],
    )
    return structure, [
        pose(structure, tuning, model.coefficients, **step, size=size) for size in (own, LARGER)
    ]


def without_padding(values, posed, structure):
    """Moves of the real blocks, the others being zero."""
    by_mv = np.asarray(values).reshape(posed.size.mvs, -1)
    assert not by_mv[:, structure.block_count :].any()
    return by_mv[:, : structure.block_count]


@pytest.mark.parametrize("mode", MODES)
def test_a_problem_in_larger_arrays_has_the_same_relaxation(
    mode, small_structure, thesis_fields, well_like_model
):
    active = 0
    for seed in range(6):
        structure, posed = both(mode, small_structure, thesis_fields, well_like_model, seed)
        one, other = (solve_one(p.qp, p.instance) for p in posed)
        assert int(one.status) == int(other.status) == status.OPTIMAL
        # the last steps are among rounding, and their number is not the same
        assert float(other.objective) == pytest.approx(float(one.objective), rel=1e-9)
        moves = [without_padding(s.x, p, structure) for s, p in zip((one, other), posed, strict=True)]
        np.testing.assert_allclose(moves[1], moves[0], rtol=1e-9, atol=1e-9)
        active += int(np.abs(one.limit_price).max() > 0.0)
    assert active >= 3


@pytest.mark.parametrize("mode", ["moves", "inputs"])
def test_a_search_in_larger_arrays_ends_with_the_same_moves(
    mode, small_structure, thesis_fields, well_like_model
):
    closed = 0
    for seed in range(6):
        structure, posed = both(mode, small_structure, thesis_fields, well_like_model, seed)
        found = []
        for p, integers in zip(posed, (structure.block_count, 16), strict=True):
            tables = Constants(structure, p.size, jax.tree.map(np.asarray, p.qp)).tables(integers)
            found.append(_decide(p.qp, tables, p.instance, cold_start(p.qp, p.instance), jnp.asarray(1e-6)))
        assert bool(found[0].closed) == bool(found[1].closed)
        if found[0].closed:
            assert float(found[1].value) == pytest.approx(float(found[0].value), rel=1e-9)
            assert int(found[1].nodes) == int(found[0].nodes)
            moves = [without_padding(f.x, p, structure) for f, p in zip(found, posed, strict=True)]
            np.testing.assert_allclose(moves[1], moves[0], rtol=1e-9, atol=1e-9)
            closed += 1
    assert closed >= 4


# -------------------------------------------------------------------------------------------- one program per size

COMPILED: list[str] = []  # programs by name, but for copies of arrays to the device


def _heard(event: str, _: float, **more) -> None:
    if event.endswith("backend_compile_duration") and more.get("fun_name") != "jit(stage)":
        COMPILED.append(str(more.get("fun_name")))


jax.monitoring.register_event_duration_secs_listener(_heard)
ONE_SIZE = (  # four to a rung of blocks, 32 to one of samples
    dict(blocks=[1, 1, 2, 2]),
    dict(hp=20, hu=17, hw=3, samples=11, blocks=[1, 8, 8], blocking="inputs", integer={1: 0.5}),
    dict(hp=4, hu=8, samples=30, blocks=[1, 1, 2, 4], integer={0: 4.0, 1: 0.5}),
)


def body_of(shape: dict, seed: int) -> dict:
    return problems.small_case(np.random.default_rng(seed), **shape)


def test_relaxed_problems_of_one_size_are_solved_by_one_program():
    shapes = (*ONE_SIZE, dict(hp=12, hu=9, blocks=[1, 2, 2, 4], integer={}))
    solve = lambda shape, seed: solve_one(*pose_case(body_of(shape, seed))[2::2])  # noqa: E731
    assert int(solve(shapes[0], 0).status) == status.OPTIMAL
    before = len(COMPILED)
    for seed, shape in enumerate(shapes):
        assert int(solve(shape, seed).status) == status.OPTIMAL
    assert COMPILED[before:] == []


def test_steps_of_structures_of_one_size_are_planned_by_one_program():
    def solve(shape, seed):
        case = make_case(body_of(shape, seed))
        step = ("mv_now", "last_move", "free_response", "setpoint")
        return solve_plan(
            case.model, case.structure, case.tuning, **{name: getattr(case, name) for name in step}
        )

    # the list of the first step compiles whatever a search on the host may need
    assert solve(ONE_SIZE[0], 0).status == "optimal"
    before = len(COMPILED)
    for seed, shape in enumerate(ONE_SIZE):
        assert solve(shape, seed).status == "optimal"
    assert COMPILED[before:] == []
