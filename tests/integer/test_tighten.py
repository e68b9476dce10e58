"""Relaxations whose positions pay curvature along chords: never above a whole plan, solved, and tighter."""

import jax
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.integer import branch_and_bound, enumeration, lower_bound
from jaxmpc.integer.cuts import Cuts
from jaxmpc.integer.feasible import MoveLimits, needed, position_limits, satisfied, within
from jaxmpc.integer.finish import finish_steps
from jaxmpc.integer.lower_bound import enumerate_below
from jaxmpc.integer.relaxer import Relaxer
from jaxmpc.integer.tighten import LEAST, chord_weights
from jaxmpc.relaxed.problem import evaluate
from tests.integer.test_integer import one
from tests.integer.tightened import SIZE, STEPS, Tightened
from tests.oracles.foreign import chorded_optimum

ACCURACY = 1e-7  # of objectives and bounds, relative: each is right to about 1e-8


def curvatures(rng):
    """Random curvatures of full rank, with one flat direction of all positions, and with flat ones of the last four."""
    factor = rng.normal(size=(8, 8)) * 10 ** rng.uniform(-1, 1, size=(8, 1))
    apart = np.zeros((8, 8))
    apart[:4, :4] = factor[:4, :4] @ factor[:4, :4].T + np.diag(rng.uniform(1.0, 5.0, size=4))
    apart[4:, 4:] = factor[4:, :2] @ factor[4:, :2].T
    full = factor @ factor.T + np.diag(rng.uniform(0.0, 5.0, size=8))
    return {"full": full, "flat": factor[:, :7] @ factor[:, :7].T, "apart": apart}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["full", "flat", "apart"])
def test_chords_pay_all_curvature_that_leaves_the_objective_convex_but_a_tenth(kind, seed):
    curvature = curvatures(np.random.default_rng(seed))[kind]
    weight, top = chord_weights(curvature), np.diag(curvature).max()
    least = lambda weight: np.linalg.eigvalsh(curvature - 2.0 * np.diag(weight))[0]  # noqa: E731
    rounding = 1e-13 * np.trace(curvature)  # of eigenvalues
    assert (weight >= 0.0).all()
    assert least(weight) >= -rounding
    assert weight.any() == (kind != "flat")
    if kind == "apart":  # flat directions of other positions take nothing away
        alone = chord_weights(curvature[:4, :4])
        np.testing.assert_allclose(
            weight[:4], alone, rtol=0.0, atol=1e-4 * top
        )  # as below, of another programme
    if (weight > 0.0).all():
        assert least(1.12 * weight) < -rounding  # nine tenths are taken: 1 / 0.9 = 1.111 times as much is all
    # shares below LEAST are left out, whose sum is what another may be raised by; the rest is what the solver leaves
    noticeable = ((weight == 0.0).sum() * LEAST + 1e-3) * top
    for raised in np.eye(len(weight)) * noticeable:
        assert least(weight / 0.9 + raised) < -rounding
    # the interior-point solver stops at 1e-8 of the sum, which is flat: single weights are less exact
    scaled = chord_weights(1e3 * curvature)
    np.testing.assert_allclose(scaled, 1e3 * weight, rtol=0.0, atol=1e3 * 1e-5 * weight.max())


def test_no_curvature_leaves_nothing_for_chords():
    assert not chord_weights(np.zeros((3, 3))).any()


@pytest.fixture(scope="module")
def problems():
    """With the values of their whole plans."""
    made = [Tightened(kind, seed) for kind in STEPS for seed in range(3)]
    made = [problem for problem in made if problem.constants.chord_weight.any()]
    assert len(made) >= 6
    return [(problem, problem.values) for problem in made]


def test_the_tightened_problem_is_the_same_at_whole_points_and_its_relaxation_in_between(problems):
    rng = np.random.default_rng(0)
    values_of = jax.jit(jax.vmap(evaluate, (None, None, 0)))
    for problem, values in problems:
        x = rng.normal(size=(len(problem.points), SIZE.moves))
        x *= problem.instance.upper > problem.instance.lower  # the others are padding
        x[:, problem.constants.integer] = problem.points
        both = [
            values_of(relaxer.problem(0), problem.instance, x) for relaxer in (problem.plain, problem.tight)
        ]
        np.testing.assert_allclose(*both, rtol=1e-11)  # rounding of some hundred terms of like size
        plain, tight = float(problem.plain_root.objective[0]), float(problem.search.root.objective[0])
        slack = ACCURACY * max(values.min(), 1.0)
        assert plain - slack <= tight <= values.min() + slack


def test_chords_close_most_of_the_gap_of_an_on_off_valve_between_two_setpoints():
    """A fast valve that is worth nothing to hold still, and a setpoint half way: the relaxation stays half open."""
    fast = np.zeros((2, 2, 30))
    fast[0, 0] = fast[1, 1] = 1.0 - 0.2 ** np.arange(1, 31)
    problem = Tightened(
        "on/off",
        0,
        response=fast,
        setpoint=[0.5, 0.0],
        mv_now=0.0,
        free_response=np.zeros((32, 2)),
        move_weight=[1e-3, 1.0],
        soft_linear=[0.0, 0.0],
        soft_quadratic=[0.0, 0.0],
    )
    best = problem.values.min()
    plain, tight = float(problem.plain_root.bound[0]), float(problem.search.root.bound[0])
    assert plain < 0.5 * best
    assert tight - plain > 0.5 * (best - plain)


def test_what_a_tightened_relaxation_proves_holds_at_every_whole_point_of_its_limits(problems):
    rng = np.random.default_rng(4)
    for problem, values in problems:
        search = problem.search
        whole = MoveLimits(*(v[None] for v in (problem.low, problem.high, *position_limits(search.chains))))
        for limits in (whole, *(problem.narrowed(rng) for _ in range(12))):
            own = limits.lane(0)
            rows = needed(search.chains, limits)
            result = (
                search.root if limits is whole else problem.relaxed(limits.lower, limits.upper, None, rows)
            )
            inside = satisfied(within(search.chains, own), problem.points, own.lower, own.upper)
            points, there = problem.points[inside], values[inside]
            slack = ACCURACY * np.maximum(there, 1.0)
            assert len(points)
            model = search.lower_model(result, 0, own.lower, own.upper)
            away = points - model.center
            bound = model.value + 0.5 * np.einsum("pi,ij,pj->p", away, model.schur, away)
            bound += model.excess[np.arange(len(own.lower)), points - own.lower].sum(axis=1)
            assert (bound <= there + slack).all()
            assert bound.min() >= result.bound[0] - slack.max()  # and it is no looser than the relaxation
            priced = model.priced(result.warm.hard_price[0][search.position_rows], own)
            listed, bounds, _ = enumerate_below(
                priced, within(search.chains, own), own.lower, own.upper, np.inf, None
            )
            value_of = {point.tobytes(): value for point, value in zip(points, there, strict=True)}
            assert len(listed) == len(points)
            assert (bounds <= np.array([value_of[point.tobytes()] for point in listed]) + slack.max()).all()
            cuts = Cuts(problem.constants)
            cuts.add(result, 0, own.lower, own.upper)
            assert (cuts.bounds(points) <= there + slack).all()


def test_cuts_of_tightened_problems_at_whole_points_hold_at_all_and_touch_their_own(problems):
    for problem, values in problems:
        some = problem.points[:: max(len(problem.points) // 6, 1)]
        result, cuts = problem.relaxed(some, some), Cuts(problem.constants)
        for lane, point in enumerate(some):
            cuts.add(result, lane, point, point)
        bounds, slack = cuts.bounds(problem.points), ACCURACY * np.maximum(values, 1.0)
        assert (bounds <= values + slack).all()
        own = [int(np.flatnonzero((problem.points == point).all(axis=1))[0]) for point in some]
        # a solved lane may be off by the gap it is accepted with
        assert bounds[own] == pytest.approx(values[own], rel=1e-6, abs=1e-6)


def test_the_tightened_relaxation_is_solved_and_another_solver_agrees():
    for seed in range(4, 16):
        problem = Tightened(list(STEPS)[seed % 3], seed)
        root = problem.search.root
        assert root.status[0] == status.OPTIMAL
        gap = float(root.objective[0] - root.bound[0])
        assert gap <= 1e-6 * max(float(root.objective[0]), 1e-6 * problem.constants.scale)  # what is accepted
        # both are within 1e-6 at most
        found = chorded_optimum(problem.tight.problem(0), problem.posed.rows, problem.instance)
        assert found == pytest.approx(float(root.objective[0]), rel=2e-6, abs=1e-6)


@pytest.mark.parametrize("lists", ["none at the root", "none at all"])
def test_where_lists_are_too_long_the_tightened_tree_finds_the_best_plan_and_proves_it(
    problems, monkeypatch, lists
):
    monkeypatch.setattr(lower_bound, "GRID", 0)
    monkeypatch.setattr(enumeration, "MOST", 1)
    if lists == "none at all":
        monkeypatch.setattr(branch_and_bound, "LISTED", 0)
    used = []
    with_chords = Relaxer.with_chords
    monkeypatch.setattr(Relaxer, "with_chords", lambda *own: used.append(own) or with_chords(*own))
    for problem, values in problems:
        best, slack = values.min(), ACCURACY * max(values.min(), 1.0)
        result = finish_steps(
            lambda widest, problem=problem: problem.plain,
            one(problem.instance),
            problem.plain_root,
            previous_moves=np.zeros((1, SIZE.blocks, SIZE.mvs)),
            gap=1e-6,
            time_limit=None,
            finish="auto",
        )[0]
        assert result.status == status.OPTIMAL
        assert result.value == pytest.approx(best, rel=1e-6, abs=slack)
        assert result.bound <= best + slack
        assert result.value - result.bound <= 1e-6 * max(
            result.value, 1e-6 * problem.constants.scale
        )  # the gap
        point = np.round(result.x[problem.constants.integer]).astype(int)
        assert satisfied(problem.search.chains, point[None], problem.low, problem.high)[0]
    assert len(used) >= len(problems) // 2
