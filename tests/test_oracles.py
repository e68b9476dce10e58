"""The judges judged: other people's solvers and constructed optima agree with each other."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests import problems
from tests.oracles import steps as oracles

SHAPES = (
    dict(hp=10, blocks=[1, 1, 2, 2]),
    dict(hp=12, blocks=[1, 1, 2, 2], blocking="inputs"),
    dict(cvs=3, mvs=2, hp=10, hu=4, integer={}),
    dict(cvs=1, mvs=1, hp=9, hu=5),
    dict(hp=10, blocks=[1, 2, 3], integer={0: 2.0, 1: 0.5}),
)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("shape", SHAPES)
def test_the_response_to_a_plan_costs_nothing_as_a_setpoint(shape, seed):
    case, plan = problems.reachable_case(np.random.default_rng(seed), **shape)
    assert oracles.violation(case, plan) == 0
    assert oracles.objective(case, plan) < 1e-12  # squares of rounding errors


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("shape", SHAPES)
def test_a_constructed_stationary_plan_is_what_two_solvers_find(shape, seed):
    case, plan = problems.stationary_case(np.random.default_rng(seed), **shape)
    cost = oracles.objective(case, plan)
    assert oracles.violation(case, plan) < 1e-12
    for solver in ("clarabel", "piqp"):
        found = oracles.solve_qp(case, solver)
        assert found.objective == pytest.approx(cost, rel=1e-7)  # measured: below 1e-9 over 300 cases
        assert found.bound == pytest.approx(cost, rel=1e-7)


def test_constructed_plans_move_and_pay_for_slack():
    cases = [problems.stationary_case(np.random.default_rng(seed), **SHAPES[0]) for seed in range(20)]
    assert sum(np.abs(plan).max() > 0 for _, plan in cases) == 20
    for case, plan in cases:
        n, y = oracles.read(case), oracles.predict(case, plan)
        assert (y - n.yhi).max() > 0


@pytest.mark.parametrize("seed", range(30))
def test_three_qp_solvers_agree_on_relaxed_cases(seed):
    case, _ = problems.random_case(np.random.default_rng(1000 + seed))
    case["structure"]["integer_step"], case["tuning"]["oscillation_rows"] = {}, {}
    answers = [oracles.solve_qp(case, solver) for solver in ("clarabel", "piqp", "daqp")]
    if not oracles.hard_feasible(case):
        assert {answer.status for answer in answers} == {"infeasible"}
        return
    best = min(answer.objective for answer in answers)
    for answer in answers:
        assert answer.status == "optimal"
        assert answer.objective <= best + 1e-6 * max(best, 1e-3)  # interior points stop at 1e-10 scaled
        assert oracles.violation(case, answer.moves) < 1e-7


@pytest.mark.parametrize("seed", range(25))
def test_brute_force_and_scip_agree_on_small_cases(seed):
    case, _ = problems.random_case(np.random.default_rng(2000 + seed), most_plans=150)
    brute, scip = oracles.brute_force(case), oracles.solve_scip(case, 30)
    assert brute.status == scip.status
    if brute.status == "optimal":
        scale = max(brute.objective, 1e-3)
        assert abs(brute.objective - scip.objective) <= 1e-6 * scale  # the gap that SCIP is asked for is 1e-7
        assert scip.bound <= brute.objective + 1e-6 * scale
        assert oracles.violation(case, brute.moves) < 1e-7


def stated(case: dict, moves) -> SimpleNamespace:
    """A flawless plan file with these moves."""
    n, moves = oracles.read(case), np.asarray(moves, dtype=float)
    y = oracles.predict(case, moves)
    cost = oracles.objective(case, moves)
    return SimpleNamespace(
        status="optimal",
        objective=cost,
        bound=cost,
        gap=0.0,
        moves=moves,
        mv=n.u0 + np.cumsum(oracles.sample_moves(case, moves), axis=0),
        cv=y,
        eps_high=np.maximum(0, (y - n.yhi).max(axis=0)),
        eps_low=np.maximum(0, (n.ylo - y).max(axis=0)),
    )


def test_the_judge_accepts_the_optimum_and_finds_every_flaw():
    case, moves = problems.stationary_case(np.random.default_rng(1), **SHAPES[0])
    best = oracles.brute_force(case)
    assert best.objective == pytest.approx(oracles.objective(case, moves), rel=1e-6)
    assert oracles.complaints(case, stated(case, best.moves), best) == []

    def flaws(plan=best.moves, reference=best, **changes):
        return oracles.complaints(case, SimpleNamespace(**(vars(stated(case, plan)) | changes)), reference)

    zero = np.zeros_like(best.moves)
    assert any("more than" in text for text in flaws(zero))
    assert any("hard constraint" in text for text in flaws(best.moves + [[1e-5, 0.0]] * 4))
    assert any("hard constraint" in text for text in flaws(best.moves + [[0.0, 1e3]] * 4))
    assert any("states the objective" in text for text in flaws(objective=best.objective * (1 + 1e-7)))
    assert any("above the reachable" in text for text in flaws(bound=best.objective * 1.01))
    assert any(
        "less than the optimum" in text
        for text in flaws(reference=oracles.Answer("optimal", best.objective * 1.01))
    )
    assert any(
        "oracle's bound" in text
        for text in flaws(reference=oracles.Answer("limit", np.inf, best.objective * 1.01))
    )
    assert any("gap" in text for text in flaws(gap=1e-3))
    assert any("gap" in text for text in flaws(gap=np.nan))
    assert any("status limit" in text for text in flaws(status="limit"))
    assert any("status infeasible" in text for text in flaws(status="infeasible"))
    assert any("infeasible" in text for text in flaws(reference=oracles.Answer("infeasible")))
    assert any("not finite" in text for text in flaws(moves=zero * np.nan))
    assert any("of shape" in text for text in flaws(moves=best.moves[:2]))
    for key in ("cv", "mv", "eps_high", "eps_low"):
        assert any(
            f"another {key}" in text for text in flaws(**{key: getattr(stated(case, best.moves), key) + 1e-3})
        )


@pytest.mark.parametrize("name", sorted(problems.TWISTS))
def test_every_twist_leaves_a_case_that_can_be_judged(name):
    rng = np.random.default_rng(7)
    case = problems.small_case(rng, **problems.SHAPES["two by two"])
    problems.TWISTS[name](case, rng)
    assert oracles.read(case).hp == 8
    assert np.isfinite(oracles.objective(case, np.zeros((4, 2))))


@pytest.mark.parametrize("blocking", ["moves", "inputs"])
def test_violation_counts_every_sample(blocking):
    """One step up in a block of three: three moves in `moves`, one and two zeros in `inputs`."""
    case = problems.small_case(np.random.default_rng(3), blocks=[3, 1, 2], blocking=blocking)
    case["tuning"].update(
        mv_low=[0.0, None], mv_high=[4.0, None], move_low=[-4.0, -1.0], move_high=[4.0, 1.0]
    )
    case["tuning"]["oscillation_rows"] = {"u0": True}
    case["mv_now"], case["last_move"] = [0.0, 0.0], [problems.TRAP, 0.0]
    up = np.array([[2.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    down_last = np.array([[0.0, 0.0], [0.0, 0.0], [-2.0, 0.0]])
    two = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 0.0]])
    assert oracles.violation(case, np.zeros((3, 2))) == 0  # the past move is one step, not a little more
    assert oracles.violation(case, up) == pytest.approx(1.0)  # reversal; in `moves` also 6 > 4, by half
    assert oracles.violation(case, down_last) == pytest.approx(4.0 if blocking == "moves" else 2.0)
    assert oracles.violation(case, two) == pytest.approx(1.0)  # two steps at once after none
    case["tuning"]["oscillation_rows"] = {}
    assert oracles.violation(case, up) == pytest.approx(0.5 if blocking == "moves" else 0.0)
    assert oracles.violation(case, two) == 0
    case["tuning"]["move_low"][0] = 2.0
    case["tuning"]["mv_high"][0] = None
    climbing = np.full((3, 2), [2.0, 0.0])
    assert oracles.violation(case, climbing) == (
        0 if blocking == "moves" else 1.0
    )  # zero moves are too small


TIGHT = (
    "forced_moves",
    "forced_moves_beyond_the_limit",
    "no_whole_step_between_move_limits",
    "last_move_of_many_steps",
    "just_reversed",
    "rounding_trap",
    "one_sided_integer_moves",
)


@pytest.mark.parametrize("name", TIGHT)
@pytest.mark.parametrize("blocking", ["moves", "inputs"])
def test_feasibility_is_what_enumeration_and_a_solver_say(name, blocking):
    for seed in range(8):
        rng = np.random.default_rng(seed)
        case = problems.small_case(rng, blocks=[1, 1, 2, 2], blocking=blocking)
        problems.TWISTS[name](case, rng)
        structure = {**case["structure"], "integer_step": {}}
        relaxed = {**case, "structure": structure, "tuning": {**case["tuning"], "oscillation_rows": {}}}
        continuous = oracles.solve_qp(relaxed, "clarabel").status == "optimal"
        assert oracles.hard_feasible(relaxed) == continuous
        # With the continuous MV free, enumeration of the integer one decides alone.
        problems.TWISTS["continuous_mvs_without_limits"](case, rng)
        assert oracles.hard_feasible(case) == bool(oracles.integer_plans(case, 0))


def test_forced_moves_and_reversals_can_be_infeasible():
    outcomes = set()
    for name in TIGHT:
        rng = np.random.default_rng(1)
        case = problems.small_case(rng, blocks=[1, 1, 2, 2])
        problems.TWISTS[name](case, rng)
        outcomes.add(oracles.hard_feasible(case))
    assert outcomes == {True, False}
