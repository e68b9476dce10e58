"""The relaxed problem: Newton and interior point against each other, and their bounds against arbitrary plans."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.blocking import hard_rows
from jaxmpc.condense import condense, make_instance
from jaxmpc.newton import WarmStart, refine, warm_start_of
from jaxmpc.qp import solve
from jaxmpc.relaxation import solve_relaxed
from jaxmpc.relaxed_problem import evaluate, prepare
from jaxmpc.tuning import make_tuning

LANES = 16


@pytest.fixture(scope="module")
def batch(small_structure, thesis_fields, well_like_model):
    """Relaxed problems with deadzones, active limits and CV limits that some lanes violate."""
    rng = np.random.default_rng(0)
    structure = small_structure.relaxed()
    tuning = make_tuning(structure, **(thesis_fields | {"cv_high": [12500.0, 200.0]}))
    qp = condense(structure, tuning, well_like_model.coefficients, envelope=0)
    free = (
        np.array([11000.0, 185.0])
        + rng.normal(size=(LANES, 1, 2)) * [1500.0, 12.0]
        + np.zeros((LANES, 40, 2))
    )
    target = (
        np.array([11000.0, 185.0])
        + rng.normal(size=(LANES, 1, 2)) * [2000.0, 15.0]
        + np.zeros((LANES, 40, 2))
    )
    now = np.stack(
        [rng.uniform(0, 100, LANES), rng.choice([0.0, 7500.0, 10000.0, 9999.9999998], LANES)], axis=1
    )
    make = lambda f, r, u: make_instance(  # noqa: E731
        structure, tuning, qp, free_response=f, setpoint=r, mv_now=u, last_move=jnp.zeros(2)
    )
    return structure, qp, hard_rows(structure), jax.vmap(make)(free, target, now)


@pytest.fixture(scope="module")
def solved(batch):
    _, qp, rows, instances = batch
    return jax.jit(jax.vmap(lambda i: solve_relaxed(qp, rows, i, i.lower, i.upper)))(instances)


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


def test_the_interior_point_alone_and_newton_from_nonsense_agree(batch, solved):
    _, qp, rows, instances = batch
    alone = jax.jit(jax.vmap(lambda i: solve(prepare(qp, rows, i, i.lower, i.upper))))(instances)
    np.testing.assert_allclose(alone.objective, solved.objective, rtol=1e-6)
    rng = np.random.default_rng(2)
    n, m = qp.theta.shape[1], qp.theta.shape[0]
    start = WarmStart(
        jnp.asarray(rng.normal(size=(LANES, n)) * 10),
        jnp.asarray(rng.normal(size=(LANES, m)) * 100),
        jnp.asarray(rng.normal(size=(LANES, n)) * 1e4),
        jnp.asarray(rng.normal(size=(LANES, len(rows))) * 1e4),
    )
    again = jax.jit(jax.vmap(lambda i, s: solve_relaxed(qp, rows, i, i.lower, i.upper, s)))(instances, start)
    assert (np.asarray(again.status) == status.OPTIMAL).all()
    np.testing.assert_allclose(again.objective, solved.objective, rtol=1e-6)


def test_newton_finishes_from_its_own_solution_and_never_claims_a_wrong_one(batch, solved):
    _, qp, rows, instances = batch
    finish = jax.jit(jax.vmap(lambda i, s: refine(prepare(qp, rows, i, i.lower, i.upper), s)[0]))
    own = finish(instances, warm_start_of(solved))
    claimed = np.asarray(own.status) == status.OPTIMAL
    assert claimed.mean() > 0.5  # lanes at a CV limit are left to the interior point
    np.testing.assert_allclose(own.objective[claimed], solved.objective[claimed], rtol=1e-7)
    shuffled = jax.tree.map(lambda v: jnp.roll(v, 1, axis=0), warm_start_of(solved))
    other = finish(instances, shuffled)
    claimed = np.asarray(other.status) == status.OPTIMAL
    np.testing.assert_allclose(other.objective[claimed], solved.objective[claimed], rtol=1e-7)


def test_a_batch_equals_its_lanes_and_its_permutation(batch, solved):
    _, qp, rows, instances = batch
    order = np.random.default_rng(3).permutation(LANES)
    run = jax.jit(jax.vmap(lambda i: solve_relaxed(qp, rows, i, i.lower, i.upper)))
    shuffled = run(jax.tree.map(lambda v: v[order], instances))
    np.testing.assert_allclose(shuffled.objective, solved.objective[order], rtol=1e-12)
    lean = eqx.tree_at(lambda q: q.packed, qp, None)
    one = jax.jit(lambda i: solve_relaxed(lean, rows, i, i.lower, i.upper))
    for lane in range(3):
        alone = one(jax.tree.map(lambda v, k=lane: v[k], instances))
        # another order of summation in the Newton matrix: equal to the tolerance of a solve, not to rounding
        np.testing.assert_allclose(alone.objective, solved.objective[lane], rtol=1e-7)


def test_crossed_limits_are_never_success(batch):
    _, qp, rows, instances = batch
    instance = jax.tree.map(lambda v: v[0], instances)
    got = solve_relaxed(qp, rows, instance, instance.lower.at[2].set(0.5), instance.upper.at[2].set(-0.5))
    assert int(got.status) == status.FAILED
