"""`solve_plan` against independent oracles: QP solvers for relaxed steps, brute force for integer ones.

`oracles.complaints` holds the tolerances and their reasons: hard constraints to 1e-7, the cost within 1e-6
relative of the oracle's from both sides, the stated cost equal to what the moves cost, the bound below the
optimum. Every shape is compiled, which takes seconds: the default run has few, with all situations in each.
"""

import copy
import dataclasses
import json

import numpy as np
import pytest

from jaxmpc.controller.case import make_case
from jaxmpc.controller.plan import solve_plan
from tests import problems
from tests.oracles import steps as oracles

FINISHES = ("auto", "enumeration", "highs", "branch-and-bound")
SMALL = {
    "moves": dict(blocks=[1, 1, 2, 2]),
    "inputs": dict(blocks=[1, 1, 2, 2], blocking="inputs"),
}
RELAXED = {
    "moves": dict(hp=12, hu=9, blocks=[1, 1, 1, 2, 4], integer={}),
    "inputs": dict(hp=12, hu=9, blocks=[1, 1, 1, 2, 4], blocking="inputs", integer={}),
}


def solve(body: dict, finish: str = "auto"):
    """The library's plan for the content of a case file."""
    case = make_case(body)
    return solve_plan(
        case.model,
        case.structure,
        case.tuning,
        mv_now=case.mv_now,
        last_move=case.last_move,
        free_response=case.free_response,
        setpoint=case.setpoint,
        previous_moves=case.previous_moves,
        time_limit=case.time_limit,
        gap=case.gap,
        finish=finish,
    )


def twisted(seed: int, shape: dict, *names: str) -> dict:
    """A small random case with these twists."""
    rng = np.random.default_rng(seed)
    body = problems.small_case(rng, **shape)
    for name in names:
        problems.TWISTS[name](body, rng)
    return body


def key_of(name: str) -> int:
    """A seed that belongs to a name."""
    return sum(map(ord, name))


# Situations that need programs of their own: another envelope of d^2, or no CV limits.
COMPILED_APART = {
    "wide_integer_moves",
    "no_move_limits",
    "one_sided_integer_moves",
    "forced_moves",
    "free_slack",
    "no_cv_limits",
    "forced_moves_beyond_the_limit",
}


@pytest.mark.parametrize(
    ("name", "blocking"),
    [
        pytest.param(name, blocking, marks=pytest.mark.slow)
        if blocking == "inputs" and name in COMPILED_APART
        else (name, blocking)
        for name in sorted(problems.TWISTS)
        for blocking in ("moves", "inputs")
    ],
)
def test_integer_steps_are_optimal_in_every_situation(name, blocking):
    for seed in range(2):
        body = twisted(key_of(name) + seed, SMALL[blocking], name)
        assert oracles.complaints(body, solve(body), oracles.brute_force(body)) == [], json.dumps(body)


@pytest.mark.parametrize("blocking", ["moves", "inputs"])
@pytest.mark.parametrize("name", sorted(problems.TWISTS))
def test_relaxed_steps_are_optimal_in_every_situation(name, blocking):
    for seed in range(2):
        body = twisted(key_of(name) + seed, RELAXED[blocking], name)
        assert oracles.complaints(body, solve(body), oracles.best_qp(body)) == [], json.dumps(body)


@pytest.mark.parametrize("finish", FINISHES[1:])
@pytest.mark.parametrize("blocking", ["moves", "inputs"])
@pytest.mark.parametrize(
    "name",
    [
        "active_cv_limits",
        "both_cv_limits_violated",
        "half_a_step_away",
        "just_reversed",
        "light_move_weight",
        "no_deadzone",
        "one_sided_integer_moves",
        "impossible_start",
    ],
)
def test_every_way_to_finish_is_exact_alone(name, blocking, finish):
    body = twisted(key_of(name) + 7, SMALL[blocking], name)
    plan = solve(body, finish)
    assert oracles.complaints(body, plan, oracles.brute_force(body)) == [], json.dumps(body)
    assert plan.finished_by in (finish, "relaxation", "fixing")


@pytest.mark.parametrize(("seed", "shape"), [(42, [2, 4]), (1089, [6])])
def test_relaxed_moves_that_end_on_several_whole_steps_are_not_the_optimum_by_themselves(seed, shape):
    """P |d| is less than P d^2 there: the first relaxation, made for single steps, proves no such plan."""
    body = twisted(seed, dict(blocks=shape), "wide_integer_moves")
    assert oracles.complaints(body, solve(body), oracles.brute_force(body)) == [], json.dumps(body)


def test_every_way_to_finish_is_needed_and_taken():
    """Among a few cases some are not settled by the relaxation, and then the forced path settles them."""
    for finish in FINISHES[1:]:
        taken = {
            solve(twisted(seed, SMALL["moves"], "half_a_step_away"), finish).finished_by for seed in range(12)
        }
        assert finish in taken


UNUSUAL = dict(
    cvs=3, hp=7, hu=10, hw=3, samples=4, blocks=[2, 1, 3, 4], blocking="inputs", integer={0: 2.0, 1: 0.5}
)
TWISTS_PER_SHAPE = (
    (),
    ("active_cv_limits",),
    ("no_move_weight",),
    ("rounding_trap",),
    ("one_cv_without_weight",),
    ("heavy_soft_linear",),
)


def assert_optimal(shape: dict, seed: int, twists: tuple[str, ...]) -> None:
    """Solve one case of a shape and compare, unless it has too many plans for brute force."""
    body = twisted(seed, shape, *twists)
    if problems.plan_count(body, 2000) > 2000:
        return
    integer = bool(body["structure"]["integer_step"])
    reference = oracles.brute_force(body) if integer else oracles.best_qp(body)
    assert oracles.complaints(body, solve(body), reference) == [], json.dumps(body)


@pytest.mark.slow
@pytest.mark.parametrize("twists", TWISTS_PER_SHAPE)
def test_steps_of_an_unusual_shape_are_optimal(twists):
    """A short model, a late first penalty, moves beyond the prediction, three CVs, all MVs integer."""
    for seed in range(3):
        assert_optimal(UNUSUAL, 60 + seed, twists)


@pytest.mark.slow
@pytest.mark.parametrize("shape", problems.SHAPES)
def test_steps_of_every_shape_are_optimal(shape):
    for number, twists in enumerate((*TWISTS_PER_SHAPE, ("wide_integer_moves",), ("no_move_limits",))):
        assert_optimal(problems.SHAPES[shape], 50 + number, twists)


@pytest.mark.parametrize("blocking", ["moves", "inputs"])
@pytest.mark.parametrize("construct", [problems.reachable_case, problems.stationary_case])
def test_constructed_plans_are_found(construct, blocking):
    for seed in range(10):
        body, plan = construct(np.random.default_rng(seed), **RELAXED[blocking])
        cost = oracles.objective(body, plan)
        reference = oracles.Answer("optimal", cost, cost, plan)
        assert oracles.complaints(body, solve(body), reference) == [], json.dumps(body)


@pytest.mark.parametrize("blocking", ["moves", "inputs"])
def test_constructed_integer_plans_are_found(blocking):
    for seed in range(10):
        body, plan = problems.stationary_case(np.random.default_rng(seed), **SMALL[blocking])
        found = solve(body)
        cost = oracles.objective(body, plan)
        reference = oracles.Answer("optimal", cost, cost, plan)
        assert oracles.complaints(body, found, reference) == [], json.dumps(body)
        assert np.round(found.moves[:, 0] / 2).tolist() == (plan[:, 0] / 2).tolist()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(300))
def test_random_shapes_and_situations_are_solved_exactly(seed):
    body, what = problems.random_case(np.random.default_rng(10_000 + seed), most_plans=300)
    reference = oracles.brute_force(body) if body["structure"]["integer_step"] else oracles.best_qp(body)
    for finish in FINISHES:
        flaws = oracles.complaints(body, solve(body, finish), reference)
        assert flaws == [], (what, finish, json.dumps(body))


# ------------------------------------------------------------------------------------------- metamorphic


def same_plan(one, other, body: dict) -> None:
    """Two plans of one problem: equal costs and integer moves, continuous moves as close as the gap allows.

    The cost grows by at least P dx^2 away from the optimum, so two plans within a relative gap of 1e-6 lie
    within 2 sqrt(1e-6 J / P) of each other.
    """
    n = oracles.read(body)
    assert other.objective == pytest.approx(one.objective, rel=oracles.EXACT)
    for m in range(n.mvs):
        reach = 2 * np.sqrt(oracles.EXACT * one.objective / n.P[m])
        tolerance = 1e-9 if n.step[m] else reach
        assert np.abs(other.moves[:, m] - one.moves[:, m]).max() <= tolerance


@pytest.mark.slow
def test_blocks_of_one_are_no_blocking_in_either_mode():
    for seed in range(5):
        body = twisted(seed, dict(hu=4))
        plans = []
        for blocks, blocking in (([1] * 4, "moves"), ([], "moves"), ([1] * 4, "inputs")):
            variant = copy.deepcopy(body)
            variant["structure"].update(blocks=blocks, blocking=blocking)
            plans.append(solve(variant))
        same_plan(plans[0], plans[1], body)
        same_plan(plans[0], plans[2], body)


def reordered(body: dict, cv_unit, mv_unit) -> dict:
    """The same step with CVs and MVs in reverse order, in other units: new value = old value x factor."""
    new = copy.deepcopy(body)
    cv, mv = np.asarray(cv_unit, dtype=float), np.asarray(mv_unit, dtype=float)
    new["model"]["cv"], new["model"]["mv"] = body["model"]["cv"][::-1], body["model"]["mv"][::-1]
    S = np.array(body["model"]["coefficients"]) * cv[:, None, None] / mv[None, :, None]
    new["model"]["coefficients"] = S[::-1, ::-1].tolist()
    steps = dict(zip(body["model"]["mv"], mv, strict=True))
    new["structure"]["integer_step"] = {
        name: float(step * steps[name]) for name, step in body["structure"]["integer_step"].items()
    }
    powers = {
        "cv_weight": -2,
        "soft_quadratic": -2,
        "soft_linear": -1,
        "slack_weight": -1,
        "move_weight": -2,
    }
    for key, values in body["tuning"].items():
        if key != "oscillation_rows":
            unit = mv if key.startswith(("mv", "move")) else cv
            scaled = [
                None if value is None else float(value * u ** powers.get(key, 1))
                for value, u in zip(values, unit, strict=True)
            ]
            new["tuning"][key] = scaled[::-1]
    for key, unit in (("mv_now", mv), ("last_move", mv), ("free_response", cv), ("setpoint", cv)):
        new[key] = (np.array(body[key]) * unit)[..., ::-1].tolist()
    return new


@pytest.mark.slow
def test_neither_order_nor_units_of_the_variables_change_the_plan():
    for seed in range(6):
        body = twisted(seed, SMALL["moves"], *(["active_cv_limits"] if seed % 2 else []))
        mv_unit = np.array([0.1, 60.0])
        other = reordered(body, [1e-3, 500.0], mv_unit)
        one, two = solve(body), solve(other)
        two = dataclasses.replace(two, moves=two.moves[:, ::-1] / mv_unit)
        same_plan(one, two, body)
        assert two.cv[:, ::-1] / [1e-3, 500.0] == pytest.approx(
            oracles.predict(body, two.moves), rel=1e-9, abs=1e-9
        )


@pytest.mark.parametrize("factor", [1e-9, 1e-6, 1e6, 1e9])
def test_the_currency_of_the_cost_does_not_change_the_plan(factor):
    """All weights times one factor: the cost follows, the plan stays (seed 38 converges slowly)."""
    for seed in (0, 1, 2, 38):
        body = twisted(seed, RELAXED["moves"])
        other = copy.deepcopy(body)
        for key in ("cv_weight", "move_weight", "soft_quadratic", "soft_linear", "slack_weight"):
            other["tuning"][key] = [factor * value for value in body["tuning"][key]]
        one, two = solve(body), solve(other)
        assert two.status == "optimal"
        same_plan(one, dataclasses.replace(two, objective=two.objective / factor), body)


@pytest.mark.parametrize("name", ["impossible_start", "plausible_start"])
def test_where_the_search_starts_does_not_change_the_answer(name):
    for seed in range(6):
        body = twisted(seed, SMALL["moves"], "half_a_step_away")
        started = copy.deepcopy(body)
        problems.TWISTS[name](started, np.random.default_rng(seed))
        assert solve(started).objective == pytest.approx(solve(body).objective, rel=oracles.EXACT)


# ----------------------------------------------------------------------------------- limits of the solve


def test_a_time_limit_returns_a_feasible_plan_with_its_true_gap():
    seen = set()
    for seed in range(12):
        body = twisted(seed, SMALL["moves"], "half_a_step_away")
        body["limits"] = {"time_s": 0.0}
        plan, best = solve(body), oracles.brute_force(body)
        seen.add(plan.status)
        assert plan.status in ("limit", "optimal")
        assert oracles.violation(body, plan.moves) <= oracles.FEASIBLE
        cost = oracles.objective(body, plan.moves)
        assert plan.objective == pytest.approx(cost, rel=oracles.SAME)
        assert plan.bound <= best.objective * (1 + oracles.EXACT) <= cost * (1 + 2 * oracles.EXACT)
        assert plan.gap == pytest.approx((plan.objective - plan.bound) / plan.objective, abs=1e-12)
        if plan.status == "limit":
            assert plan.finished_by is None
            assert plan.gap > oracles.EXACT
    assert "limit" in seen


def test_a_wide_gap_ends_the_search_with_a_valid_bound():
    for seed in range(6):
        body = twisted(seed, SMALL["moves"], "half_a_step_away")
        body["limits"] = {"gap": 0.5}
        plan, best = solve(body), oracles.brute_force(body)
        assert plan.status == "optimal"
        assert plan.gap <= 0.5
        assert plan.bound <= best.objective * (1 + oracles.EXACT)
        assert plan.objective >= best.objective * (1 - oracles.EXACT)


@pytest.mark.parametrize("shape", [SMALL["moves"], SMALL["inputs"], RELAXED["moves"]])
@pytest.mark.parametrize("finish", FINISHES)
def test_limits_that_nothing_meets_are_reported_as_infeasible(shape, finish):
    body = twisted(3, shape, "forced_moves_beyond_the_limit")
    plan = solve(body, finish)
    assert plan.status == "infeasible"
    assert plan.objective is None
    assert plan.moves is None
    assert plan.finished_by is None
