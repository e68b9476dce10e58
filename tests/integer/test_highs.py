"""HiGHS as it is called here: its optima and bounds against enumeration. Every version before 1.16 fails some of this.

And that what is known is held against it: a solver that lies forges no proof.
"""

import importlib.metadata
import itertools
from types import SimpleNamespace

import highspy
import numpy as np
import pytest

from jaxmpc.controller.case import make_case
from jaxmpc.controller.plan import Planner
from jaxmpc.integer.chain import Chain
from jaxmpc.integer.highs import ReducedMilp, solve_milp
from tests import problems
from tests.oracles import steps as oracles


def cheapest(**options):
    """The least of 2 x + 3 y with x + y of 4.5 or more, both 0 to 10 and y whole."""
    return solve_milp(
        np.array([2.0, 3.0]),
        (np.array([0, 0]), np.array([0, 1]), np.ones(2)),
        np.array([4.5]),
        np.array([np.inf]),
        np.zeros(2),
        np.full(2, 10.0),
        np.array([False, True]),
        **options,
    )


def test_a_linear_programme_with_one_whole_variable_is_solved_to_its_optimum():
    status, point, bound = cheapest()
    assert status == "optimal"
    np.testing.assert_allclose(point, [4.5, 0.0], atol=1e-6)
    assert bound == pytest.approx(9.0, rel=1e-8)


def problem(seed):
    """A random master: `(milp, moves "point integer", values)`, infinite where a move breaks a hard row."""
    rng = np.random.default_rng(10_000 + seed)
    count = int(rng.integers(3, 7))
    wide = int(rng.integers(1, 3)) if count < 6 else 1
    lower = -np.full(count, wide) * (rng.random(count) < 0.9)
    upper = np.full(count, wide) * (rng.random(count) < 0.9)
    own = rng.uniform(0, 5, (count, max(int((upper - lower).max()), 0) + 1))
    chain = Chain(
        columns=np.arange(count),
        counts=rng.integers(1, 4, count),
        low=np.full(count, -int(rng.integers(1, 6))),
        high=np.full(count, int(rng.integers(1, 6))),
        coupled=np.r_[False, rng.random(count - 1) < 0.5],
        windows=np.zeros((0, count)),
        window_low=np.zeros(0),
        window_high=np.zeros(0),
    )
    milp = ReducedMilp([chain], lower, upper, own, unit=float(rng.choice([1.0, 100.0, 1e4])))
    root = rng.normal(size=(count, count))
    hessian, slope = root @ root.T, rng.normal(size=count) * 3
    points = np.array(
        list(itertools.product(*(range(low, high + 1) for low, high in zip(lower, upper, strict=True))))
    )
    rest = np.full(len(points), -np.inf)
    for _ in range(int(rng.integers(2, 12))):
        whole = rng.random() >= 0.5
        at = rng.integers(lower, upper + 1).astype(float) if whole else rng.uniform(-wide, wide, count)
        value, gradient = at @ hessian @ at / 2 + slope @ at, hessian @ at + slope
        milp.add_cut(value, at, gradient)
        rest = np.maximum(rest, value + (points - at) @ gradient)
    values = rest + own[np.arange(count), points - lower].sum(1)
    reached = np.cumsum(points * chain.counts, axis=1)
    allowed = ((reached >= chain.low) & (reached <= chain.high)).all(1)
    for b in np.flatnonzero(chain.coupled):
        allowed &= np.abs(points[:, b] - points[:, b - 1]) <= 1
    return milp, points, np.where(allowed, values, np.inf)


# the first are those on which a version from 1.9 to 1.15.1 returned a bound above the optimum, or missed the optimum
@pytest.mark.parametrize("seed", [58, 62, 67, 127, 236, 343, 367, 380, 424, 432, 434, 440, 511, *range(20)])
def test_bounds_of_the_reduced_problem_hold_and_its_points_are_optimal_one_after_the_other(seed):
    milp, points, values = problem(seed)
    for _ in range(3):
        bound, point, finished = milp.solve(None)
        best = values.min()
        assert finished
        if point is None:
            assert best == np.inf
            return
        assert bound <= best + 1e-9 * (1 + abs(best))
        at = int(np.flatnonzero((points == point).all(1))[0])
        assert values[at] <= best + 1e-6 * (1 + abs(best))
        milp.forbid(point)
        values[at] = np.inf


# ------------------------------------------------------------------------------------ a solver that lies


def posed_step(seed):
    """A step with two stepped MVs, small enough for brute force, and its least objective."""
    body = problems.small_case(np.random.default_rng(seed), blocks=[1, 2, 3], integer={0: 2.0, 1: 0.5})
    return body, oracles.brute_force(body).objective


def finished_by_highs(body):
    """The plan where HiGHS alone has to close what fixing leaves."""
    case = make_case(body)
    planner = Planner(case.structure, case.tuning, case.model)
    step = {k: getattr(case, k) for k in ("mv_now", "last_move", "free_response", "setpoint", "gap")}
    return planner.solve(**step, finish="highs")


def too_high(milp, seconds, honest):
    bound, point, finished = honest(milp, seconds)
    return (bound if np.isfinite(bound) else 1.0) * 3.0 + 10.0 * milp.unit, point, finished


def nothing_feasible(milp, seconds, honest):
    return np.inf, None, True


def breaks_rows(milp, seconds, honest):
    bound, _, _ = honest(milp, seconds)
    return bound, milp.upper + 1, True


@pytest.mark.parametrize("lie", [too_high, nothing_feasible, breaks_rows])
def test_a_solver_that_lies_is_told_of_and_does_not_change_the_answer(lie, monkeypatch, capsys):
    honest, told = ReducedMilp.solve, 0
    for seed in range(6):
        body, best = posed_step(seed)
        calls = []

        def lying(own, seconds, calls=calls):
            calls.append(seconds)
            return lie(own, seconds, honest)

        monkeypatch.setattr(ReducedMilp, "solve", lying)
        plan = finished_by_highs(body)
        said = capsys.readouterr().err
        assert plan.status in ("optimal", "unproven")
        assert plan.bound <= best * (1.0 + 1e-6)
        if plan.status == "optimal":
            assert plan.objective == pytest.approx(best, rel=1e-6)
        if calls:
            assert plan.finished_by == "branch-and-bound"
            assert f"highspy {importlib.metadata.version('highspy')}" in said
            told += 1
    assert told >= 3


def test_an_honest_solver_is_believed(capsys):
    for seed in range(6):
        body, best = posed_step(seed)
        plan = finished_by_highs(body)
        assert plan.status == "optimal"
        assert plan.objective == pytest.approx(best, rel=1e-6)
        assert "highspy" not in capsys.readouterr().err


class Lying:
    """HiGHS with another status, bound or point."""

    def __init__(self, state=None, bound=None, point=None):
        self.own, self.state, self.bound, self.point = highspy.Highs(), state, bound, point

    def __getattr__(self, name):
        return getattr(self.own, name)

    def getModelStatus(self):
        return self.own.getModelStatus() if self.state is None else self.state

    def getInfo(self):
        info = self.own.getInfo()
        bound = info.mip_dual_bound if self.bound is None else self.bound
        return SimpleNamespace(mip_dual_bound=bound, primal_solution_status=info.primal_solution_status)

    def getSolution(self):
        return self.own.getSolution() if self.point is None else SimpleNamespace(col_value=self.point)


@pytest.mark.parametrize(
    ("lie", "known"),
    [
        (dict(bound=9.5), None),  # above its own point
        (
            dict(bound=12.5, point=[2.0, 3.0]),
            [4.5, 0.0],
        ),  # a point that is not the best, with its value as the bound
        (dict(point=[2.0, 2.0]), None),  # breaks the row
        (dict(point=[4.0, 0.5]), None),  # not whole
        (dict(state=highspy.HighsModelStatus.kInfeasible), [4.5, 0.0]),
    ],
)
def test_an_answer_that_contradicts_itself_or_what_is_known_is_a_failure(lie, known, monkeypatch, capsys):
    def silent():
        highs = Lying(**lie)
        highs.setOptionValue("output_flag", False)
        return highs

    monkeypatch.setattr("jaxmpc.integer.highs._silent_highs", silent)
    status, point, bound = cheapest(known=None if known is None else np.array(known))
    assert (status, point, bound) == ("failed", None, -np.inf)
    assert "highspy" in capsys.readouterr().err
