"""Relaxations whose positions pay curvature along chords: never above a whole plan, solved, and tighter."""

import jax
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.integer import branch_and_bound, enumeration, lower_bound
from jaxmpc.integer.branching import Branchings
from jaxmpc.integer.cuts import Cuts
from jaxmpc.integer.feasible import MoveLimits, needed, position_limits, satisfied, within
from jaxmpc.integer.finish import finish_steps
from jaxmpc.integer.lower_bound import enumerate_below
from jaxmpc.integer.nodes import Node
from jaxmpc.integer.relaxer import Relaxer
from jaxmpc.relaxed.problem import evaluate
from tests.integer.test_integer import one
from tests.integer.tightened import SIZE, STEPS, Tightened
from tests.oracles.foreign import chorded_optimum

ACCURACY = 1e-7  # of objectives and bounds, relative: each is right to about 1e-8


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
            priced = model.priced(result.hard[0][search.constants.position], own)
            listed, bounds, _ = enumerate_below(
                priced, within(search.chains, own), own.lower, own.upper, np.inf, None
            )
            value_of = {point.tobytes(): value for point, value in zip(points, there, strict=True)}
            assert len(listed) == len(points)
            assert (bounds <= np.array([value_of[point.tobytes()] for point in listed]) + slack.max()).all()
            cuts = Cuts(problem.constants)
            cuts.add(result, 0, own.lower, own.upper)
            assert (cuts.bounds(points) <= there + slack).all()


def test_what_branching_is_said_to_gain_holds_at_every_whole_point_of_both_children(problems):
    rng = np.random.default_rng(5)
    for problem, values in problems:
        search, branchings = problem.search, Branchings(problem.search)
        reached = problem.points @ branchings.rows.T
        for limits in (problem.narrowed(rng) for _ in range(12)):
            own = limits.lane(0)
            rows = needed(search.chains, limits)
            result = problem.relaxed(limits.lower, limits.upper, None, rows)
            model = search.lower_model(result, 0, own.lower, own.upper)
            inside = satisfied(within(search.chains, own), problem.points, own.lower, own.upper)
            for branching in branchings.of(Node(model.value, own, model, result.start(0))):
                down = reached[:, branching.row] <= branching.cut
                for side, gain in zip((down, ~down), branching.estimate, strict=True):
                    least = values[inside & side].min(initial=np.inf)
                    assert model.value + gain <= least + ACCURACY * max(least, 1.0)


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
        monkeypatch.setattr(branch_and_bound, "LISTED", 1)
    used, by = [], []
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
        least = 1e-6 * problem.constants.scale  # below it gaps are relative to it
        assert result.value - result.bound <= 1e-6 * max(result.value, least)
        point = np.round(result.x[problem.constants.integer]).astype(int)
        assert satisfied(problem.search.chains, point[None], problem.low, problem.high)[0]
        by.append(result.finished_by)
    assert len(used) >= len(problems) // 2
    assert by.count("branch-and-bound") >= len(problems) // 2
