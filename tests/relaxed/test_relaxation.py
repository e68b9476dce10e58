"""The relaxed problem: Newton's solutions against another solver's, and their bounds against arbitrary plans."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.problem.condense import condense, matrices_of
from jaxmpc.problem.instance import make_instance
from jaxmpc.problem.layout import Size, layout_of
from jaxmpc.problem.tuning import make_tuning
from jaxmpc.relaxed.newton import WarmStart, refine, warm_start_of
from jaxmpc.relaxed.problem import evaluate, prepare
from jaxmpc.relaxed.solve import cold_start, solve_relaxed
from tests.oracles.foreign import foreign_solution
from tests.oracles.kkt import dense_rows
from tests.posed import condensed, over, pose, solve_one

LANES = 16


@pytest.fixture(scope="module")
def batch(small_structure, thesis_fields, well_like_model):
    """Relaxed problems with deadzones, active limits and CV limits that some lanes violate."""
    rng = np.random.default_rng(0)
    structure = small_structure.relaxed()
    tuning = make_tuning(structure, **(thesis_fields | {"cv_high": [12500.0, 200.0]}))
    size = Size.of(structure, well_like_model.samples)
    layout, coefficients = layout_of(structure, size), over(well_like_model.coefficients, size.future)
    qp = condensed(layout, size, tuning, coefficients, envelope=0)
    free = (
        np.array([11000.0, 185.0])
        + rng.normal(size=(LANES, 1, 2)) * [1500.0, 12.0]
        + np.zeros((LANES, size.future, 2))
    )
    target = (
        np.array([11000.0, 185.0])
        + rng.normal(size=(LANES, 1, 2)) * [2000.0, 15.0]
        + np.zeros((LANES, size.future, 2))
    )
    now = np.stack(
        [rng.uniform(0, 100, LANES), rng.choice([0.0, 7500.0, 10000.0, 9999.9999998], LANES)], axis=1
    )
    none = dict(last_move=jnp.zeros(2), past_moves=jnp.zeros((size.past, 2)))
    make = lambda f, r, u: make_instance(  # noqa: E731
        layout, size, tuning, qp, free_response=f, setpoint=r, mv_now=u, **none
    )
    return structure, qp, dense_rows(structure, size), jax.jit(jax.vmap(make))(free, target, now)


@pytest.fixture(scope="module")
def solved(batch):
    _, qp, _, instances = batch
    return jax.jit(jax.vmap(lambda i: solve_relaxed(qp, i, i.lower, i.upper)))(instances)


def test_every_lane_closes_its_duality_gap_within_the_limits(batch, solved):
    _, _, rows, instances = batch
    assert (np.asarray(solved.status) == status.OPTIMAL).all()
    gap = (solved.objective - solved.bound) / np.maximum(solved.objective, 1.0)
    assert np.asarray(gap).max() <= 1e-6
    assert (solved.x >= instances.lower).all()
    assert (solved.x <= instances.upper).all()
    w = solved.x @ rows.T
    assert (w <= instances.row_high + 1e-8).all()
    assert (w >= instances.row_low - 1e-8).all()


def test_no_feasible_plan_is_better_than_the_bound(batch, solved):
    """Random feasible plans, and small steps from the solution towards them, never beat the bound."""
    _, qp, rows, instances = batch
    rng = np.random.default_rng(1)
    tried = 0
    for lane in range(LANES):
        instance = jax.tree.map(lambda v, k=lane: v[k], instances)
        x = np.asarray(solved.x[lane])
        for _ in range(20):
            other = rng.uniform(instance.lower, instance.upper) * rng.choice([0.05, 0.3, 1.0])
            w = rows @ other
            if (w > instance.row_high).any() or (w < instance.row_low).any():
                continue
            for share in (1.0, 0.1, 1e-3):
                value = float(evaluate(qp, instance, jnp.asarray(x + share * (other - x))))
                assert value >= float(solved.bound[lane]) * (1 - 1e-9)
                tried += 1
    assert tried > 200


def test_newton_finds_what_another_solver_finds_and_from_nonsense_the_same(batch, solved):
    _, qp, rows, instances = batch
    for lane in range(LANES):
        instance = jax.tree.map(lambda v, k=lane: v[k], instances)
        theirs = foreign_solution(qp, rows, instance, "piqp")
        value = float(evaluate(qp, instance, theirs.x))
        assert float(solved.objective[lane]) == pytest.approx(value, rel=1e-6)
    rng = np.random.default_rng(2)
    random = lambda like, size: jnp.asarray(rng.normal(size=like.shape) * size)  # noqa: E731
    start = WarmStart(
        x=random(instances.lower, 10),
        row_price=random(instances.offset, 100),
        envelope_price=jnp.zeros((LANES, *qp.steep.shape)),
        position_price=jnp.zeros((LANES, 0)),
        limit_price=random(instances.limit_high, 100),
        box_price=random(instances.lower, 1e4),
        hard_price=random(instances.row_low, 1e4),
    )
    again = jax.jit(jax.vmap(lambda i, s: solve_relaxed(qp, i, i.lower, i.upper, s)))(instances, start)
    assert (np.asarray(again.status) == status.OPTIMAL).all()
    np.testing.assert_allclose(again.objective, solved.objective, rtol=1e-6)


def test_newton_finishes_from_its_own_solution_and_from_those_of_others(batch, solved):
    _, qp, _, instances = batch
    finish = jax.jit(jax.vmap(lambda i, s: solve_relaxed(qp, i, i.lower, i.upper, s)))
    own = finish(instances, warm_start_of(solved))
    assert (np.asarray(own.status) == status.OPTIMAL).all()
    np.testing.assert_allclose(own.objective, solved.objective, rtol=1e-7)
    assert np.median(own.iterations) <= 2
    other = finish(instances, jax.tree.map(lambda v: jnp.roll(v, 1, axis=0), warm_start_of(solved)))
    assert (np.asarray(other.status) == status.OPTIMAL).all()
    np.testing.assert_allclose(other.objective, solved.objective, rtol=1e-7)


def test_a_batch_equals_its_lanes_and_its_permutation(batch, solved):
    _, qp, _, instances = batch
    order = np.random.default_rng(3).permutation(LANES)
    run = jax.jit(jax.vmap(lambda i: solve_relaxed(qp, i, i.lower, i.upper)))
    shuffled = run(jax.tree.map(lambda v: v[order], instances))
    np.testing.assert_allclose(shuffled.objective, solved.objective[order], rtol=1e-12)
    lean = eqx.tree_at(lambda q: q.summed, qp, None)
    one = jax.jit(lambda i: solve_relaxed(lean, i, i.lower, i.upper))
    for lane in range(3):
        alone = one(jax.tree.map(lambda v, k=lane: v[k], instances))
        # another order of summation in the Newton matrix: equal to the tolerance of a solve, not to rounding
        np.testing.assert_allclose(alone.objective, solved.objective[lane], rtol=1e-7)


def test_crossed_limits_are_never_success(batch):
    _, qp, _, instances = batch
    instance = jax.tree.map(lambda v: v[0], instances)
    got = solve_relaxed(qp, instance, instance.lower.at[2].set(0.5), instance.upper.at[2].set(-0.5))
    assert int(got.status) == status.FAILED


MIXED = 40
NOT_A_NUMBER, CROSSED, CONFLICT, FIXED_MOVES = 3, 7, 11, 15  # lanes of `mixed` that are no ordinary problems


@pytest.fixture(scope="module")
def mixed(batch):
    """Many lanes: easy ones, some at CV limits, and one of each kind that cannot be solved."""
    structure, qp, rows, instances = batch
    rng = np.random.default_rng(4)
    lanes = jax.tree.map(lambda v: np.asarray(v)[rng.integers(LANES, size=MIXED)].copy(), instances)
    lanes.offset[:] *= rng.uniform(0.5, 1.5, size=(MIXED, 1))
    lanes.offset[NOT_A_NUMBER, 5] = np.nan
    lanes.lower[CROSSED, 2], lanes.upper[CROSSED, 2] = 0.5, -0.5
    lanes.row_low[CONFLICT, 1], lanes.row_high[CONFLICT, 1] = 50.0, 60.0
    lanes.lower[FIXED_MOVES, :10] = lanes.upper[FIXED_MOVES, :10] = 0.0  # two of them are padding
    return structure, qp, rows, jax.tree.map(jnp.asarray, lanes)


@pytest.fixture(scope="module")
def mixed_solved(mixed):
    _, qp, _, lanes = mixed
    return jax.jit(jax.vmap(lambda i: solve_relaxed(qp, i, i.lower, i.upper)))(lanes)


@pytest.mark.slow
def test_a_lane_of_a_large_batch_does_not_depend_on_its_neighbours(mixed, mixed_solved):
    _, qp, _, lanes = mixed
    impossible = np.isin(np.arange(MIXED), [NOT_A_NUMBER, CROSSED, CONFLICT])
    assert (np.asarray(mixed_solved.status) == np.where(impossible, status.FAILED, status.OPTIMAL)).all()
    one = jax.jit(lambda i: solve_relaxed(qp, i, i.lower, i.upper))
    for k in range(MIXED):
        alone = one(jax.tree.map(lambda v, k=k: v[k], lanes))
        assert int(alone.status) == int(mixed_solved.status[k])
        if not impossible[k]:
            np.testing.assert_allclose(mixed_solved.objective[k], alone.objective, rtol=1e-6)
    order = np.random.default_rng(5).permutation(MIXED)
    run = jax.jit(jax.vmap(lambda i: solve_relaxed(qp, i, i.lower, i.upper)))
    shuffled = run(jax.tree.map(lambda v: v[order], lanes))
    assert np.array_equal(shuffled.status, mixed_solved.status[order])
    possible = ~impossible[order]
    np.testing.assert_allclose(
        shuffled.objective[possible], mixed_solved.objective[order][possible], rtol=1e-6
    )


def test_lanes_in_lockstep_find_what_single_lanes_find(mixed, mixed_solved):
    """What an accelerator runs: all at once."""
    _, qp, _, lanes = mixed
    lane = lambda i: refine(prepare(qp, i, i.lower, i.upper), cold_start(qp, i))  # noqa: E731
    together = jax.jit(jax.vmap(lane))(lanes)
    assert np.array_equal(together.status, mixed_solved.status)
    solved = np.asarray(together.status) == status.OPTIMAL
    np.testing.assert_allclose(together.objective[solved], mixed_solved.objective[solved], rtol=1e-6)


def test_a_batch_of_batches_is_one_batch(mixed, mixed_solved):
    _, qp, _, lanes = mixed
    fold = lambda tree: jax.tree.map(lambda v: v.reshape(2, MIXED // 2, *v.shape[1:]), tree)  # noqa: E731
    solve_lane = lambda i: solve_relaxed(qp, i, i.lower, i.upper)  # noqa: E731
    nested = jax.jit(jax.vmap(jax.vmap(solve_lane)))(fold(lanes))
    both = np.asarray(mixed_solved.status) == status.OPTIMAL
    assert np.array_equal(np.asarray(nested.status).reshape(-1) == status.OPTIMAL, both)
    np.testing.assert_allclose(nested.objective.reshape(-1)[both], mixed_solved.objective[both], rtol=1e-9)


def test_lanes_may_have_their_own_limits_inside_a_batch_of_problems(mixed):
    """Outer lanes are problems, inner lanes limits: what only one axis has must meet the right partner."""
    _, qp, _, lanes = mixed
    few = jax.tree.map(lambda v: v[:2], lanes)
    shares = jnp.linspace(0.2, 1.0, 3)
    cut = lambda i, share: solve_relaxed(qp, i, share * i.lower, share * i.upper).objective  # noqa: E731
    table = jax.jit(jax.vmap(jax.vmap(cut, in_axes=(None, 0)), in_axes=(0, None)))(few, shares)
    alone = jax.jit(cut)
    for lane in range(2):
        values = [alone(jax.tree.map(lambda v, k=lane: v[k], few), share) for share in shares]
        np.testing.assert_allclose(table[lane], values, rtol=1e-7)


@pytest.mark.slow
def test_lanes_with_models_of_their_own_are_each_solved_with_its_model(batch, thesis_fields, well_like_model):
    """Per-lane dynamic matrices: alone, and as a batch of models that each serve a batch of problems."""
    structure, _, _, instances = batch
    tuning, size = make_tuning(structure, **thesis_fields), Size.of(structure, well_like_model.samples)
    layout, coefficients = (
        layout_of(structure, size),
        jnp.asarray(over(well_like_model.coefficients, size.future)),
    )
    gains = jnp.linspace(0.7, 1.3, 3)
    few = jax.tree.map(lambda v: v[:2], instances)

    def value(gain, instance):
        matrices = matrices_of(layout, size, gain * coefficients, summed=False)
        qp = condense(layout, size, tuning, matrices, envelope=0)
        solution = solve_relaxed(qp, instance, instance.lower, instance.upper)
        return solution.objective, solution.status

    inner = jax.vmap(value, in_axes=(None, 0))
    table, codes = jax.jit(jax.vmap(inner, in_axes=(0, None)))(gains, few)
    swapped, _ = jax.jit(jax.vmap(jax.vmap(value, in_axes=(0, None)), in_axes=(None, 0)))(gains, few)
    assert (np.asarray(codes) == status.OPTIMAL).all()
    np.testing.assert_allclose(swapped.T, table, rtol=1e-7)
    alone = jax.jit(value)
    values = [alone(gain, jax.tree.map(lambda v: v[1], few))[0] for gain in gains]
    np.testing.assert_allclose(table[:, 1], values, rtol=1e-7)


def test_a_warm_batch_inside_a_scan_takes_few_steps(batch):
    _, qp, _, instances = batch
    lanes = jax.tree.map(lambda v: jnp.concatenate([v, v]), instances)

    def sample(start, share):
        run = lambda i, s: solve_relaxed(qp, i, i.lower, i.upper, s)  # noqa: E731
        solution = jax.vmap(run)(eqx.tree_at(lambda i: i.offset, lanes, share * lanes.offset), start)
        return warm_start_of(solution), (solution.status, solution.iterations)

    cold = cold_start(qp, jax.tree.map(lambda v: v[0], lanes))
    start = jax.tree.map(lambda v: jnp.repeat(v[None], 2 * LANES, axis=0), cold)
    _, (codes, steps) = jax.jit(lambda s: jax.lax.scan(sample, s, jnp.asarray([1.0, 1.0, 1.001])))(start)
    assert (np.asarray(codes) == status.OPTIMAL).all()
    assert np.median(steps[1:]) <= 2


def test_rows_that_no_move_reaches_are_constants(small_structure, thesis_fields, well_like_model):
    """Dead time, and a CV without any response: infinite penalties must not become not a number."""
    structure = small_structure.relaxed()
    coefficients = np.asarray(well_like_model.coefficients).copy()
    coefficients[..., :5] = 0.0
    coefficients[1] = 0.0
    tuning = make_tuning(structure, **thesis_fields)
    for model in (coefficients, np.zeros_like(coefficients)):
        posed = pose(
            structure,
            tuning,
            model,
            free_response=np.tile([11000.0, 185.0], (40, 1)),
            setpoint=np.tile([12500.0, 175.0], (40, 1)),
            mv_now=[50.0, 5000.0],
            envelope=0,
        )
        got = solve_one(posed.qp, posed.instance)
        assert int(got.status) == status.OPTIMAL
        assert int(got.iterations) < 15
