"""The same problem in other units, with another size of objective, in another order: the same plan and the same proof."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from jaxmpc.controller.case import make_case
from jaxmpc.controller.plan import Plan, Planner
from tests import problems

TWICE = 2e-6  # each of two answers is within 1e-6 of the optimum
PER_CV = {
    "cv_weight": -2,
    "soft_quadratic": -2,
    "soft_linear": -1,
    "slack_weight": -1,
}  # powers of the CV's unit
LENGTHS = ("deadzone", "cv_low", "cv_high")
MOVES = ("mv_low", "mv_high", "move_low", "move_high")
UNITS = {
    "CVs in thousandths": dict(cv=1e3),
    "CVs in thousands": dict(cv=1e-3),
    "MVs in thousandths": dict(mv=1e3),
    "MVs in thousands": dict(mv=1e-3),
    "every one in odd units": dict(cv=(2.7182e-3, 31.4, 97.0, 0.61), mv=(17.3, 9.1e-3, 271.0, 0.031)),
    "an objective of 1e-6 times the size": dict(cost=1e-6),
    "an objective of 1e6 times the size": dict(cost=1e6),
    "all at once": dict(cv=1e-3, mv=(1e3, 0.37, 1e-3, 11.0), cost=1e-6),
}
SHAPES = {
    "two by two": dict(blocks=[1, 1, 2, 2]),
    "inputs": dict(blocks=[1, 1, 2, 2], blocking="inputs"),
    "two integer MVs": dict(blocks=[1, 2, 3], integer={0: 2.0, 1: 0.5}),
    "relaxed": dict(integer={}),
    "three by three": dict(cvs=3, mvs=3, blocks=[1, 2, 3]),
}


def solve(body: dict) -> Plan:
    case = make_case(body)
    planner = Planner(case.structure, case.tuning, case.model)
    step = {k: getattr(case, k) for k in ("mv_now", "last_move", "free_response", "setpoint", "gap")}
    return planner.solve(**step)


def in_units(body: dict, cv=1.0, mv=1.0, cost=1.0) -> dict:
    """The case with CVs and MVs in units so many times smaller, and an objective so many times larger."""
    body = copy.deepcopy(body)
    names, tuning = body["model"], body["tuning"]
    cv = np.resize(cv, len(names["cv"])).astype(float)
    mv = np.resize(mv, len(names["mv"])).astype(float)
    names["coefficients"] = (np.array(names["coefficients"]) * cv[:, None, None] / mv[:, None]).tolist()
    factors = {key: cost * cv**power for key, power in PER_CV.items()} | {"move_weight": cost / mv**2}
    factors |= dict.fromkeys(LENGTHS, cv) | dict.fromkeys((*MOVES, "ideal"), mv)
    factors["ideal_weight"] = factors["move_weight"]
    for key, factor in factors.items():
        if key not in tuning:
            continue
        tuning[key] = [v if v is None else float(v * f) for v, f in zip(tuning[key], factor, strict=True)]
    for key, factor in (("mv_now", mv), ("last_move", mv), ("free_response", cv), ("setpoint", cv)):
        body[key] = (np.array(body[key]) * factor).tolist()
    steps = body["structure"].get("integer_step") or {}
    body["structure"]["integer_step"] = {
        name: float(step * mv[names["mv"].index(name)]) for name, step in steps.items()
    }
    return body


def reordered(body: dict, rng) -> dict:
    """The case with its CVs and MVs in another order."""
    body = copy.deepcopy(body)
    model, tuning = body["model"], body["tuning"]
    cvs, mvs = (np.roll(rng.permutation(len(model[key])), 1) for key in ("cv", "mv"))
    model["coefficients"] = [[model["coefficients"][c][m] for m in mvs] for c in cvs]
    for place, order, keys in (
        (model, cvs, ("cv",)),
        (model, mvs, ("mv",)),
        (tuning, cvs, (*PER_CV, *LENGTHS)),
        (tuning, mvs, ("move_weight", *MOVES)),
        (body, mvs, ("mv_now", "last_move")),
    ):
        for key in keys:
            place[key] = [place[key][k] for k in order]
    for key in ("free_response", "setpoint"):
        body[key] = np.array(body[key])[:, cvs].tolist()
    return body


def check_same(one: Plan, other: Plan, cost: float = 1.0) -> None:
    assert (other.status, other.finished_by) == (one.status, one.finished_by)
    if one.objective is not None:
        assert other.objective is not None
        assert other.objective / cost == pytest.approx(one.objective, rel=TWICE, abs=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_neither_units_nor_the_size_of_the_objective_change_a_plan_or_its_proof(shape):
    for seed in range(4):
        body = problems.small_case(np.random.default_rng(seed), **SHAPES[shape])
        plan = solve(body)
        assert plan.status == "optimal"
        for ways in UNITS.values():
            check_same(plan, solve(in_units(body, **ways)), ways.get("cost", 1.0))


@pytest.mark.parametrize("twist", ["soft_weights_alone", "no_move_weight", "continuous_mvs_without_limits"])
def test_nor_do_they_where_weights_or_limits_are_left_out(twist):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        for shape in ("relaxed", "two by two"):
            body = problems.small_case(rng, **SHAPES[shape])
            problems.TWISTS[twist](body, rng)
            plan = solve(body)
            assert plan.status == "optimal"
            for ways in UNITS.values():
                check_same(plan, solve(in_units(body, **ways)), ways.get("cost", 1.0))


@pytest.mark.parametrize("shape", ["relaxed", "two integer MVs"])
def test_nor_do_they_with_ideal_values(shape):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        body = problems.small_case(rng, **SHAPES[shape])
        problems.ideal_values(body, rng)
        plan = solve(body)
        assert plan.status == "optimal"
        for ways in UNITS.values():
            check_same(plan, solve(in_units(body, **ways)), ways.get("cost", 1.0))


def test_a_plan_that_costs_nothing_is_proven_in_any_units():
    for seed in range(4):
        for shape in ("relaxed", "two by two"):
            body, _ = problems.reachable_case(np.random.default_rng(seed), **SHAPES[shape])
            for ways in ({}, *UNITS.values()):
                assert solve(in_units(body, **ways)).status == "optimal", ways


def test_neither_does_the_order_of_mvs_and_cvs():
    rng = np.random.default_rng(0)
    for shape in SHAPES:
        for seed in range(3):
            body = problems.small_case(np.random.default_rng(seed), **SHAPES[shape])
            check_same(solve(body), solve(reordered(body, rng)))


def test_blocks_of_one_sample_are_the_same_in_both_modes():
    for seed in range(4):
        body = problems.small_case(np.random.default_rng(seed), blocks=[1] * 6)
        plan = solve(body)
        body["structure"]["blocking"] = "inputs"
        check_same(plan, solve(body))


def test_moves_that_reach_no_prediction_are_not_made_and_change_nothing():
    """With a dead time of two samples the last two moves of the horizon come too late to be seen."""
    for seed in range(4):
        body = problems.small_case(np.random.default_rng(seed), blocks=[1] * 6)
        late = np.array(body["model"]["coefficients"])
        body["model"]["coefficients"] = np.concatenate([0.0 * late[..., :2], late[..., :-2]], axis=2).tolist()
        body["structure"].update(control_horizon=6, blocks=[1] * 6)
        short = solve(body)
        body["structure"].update(control_horizon=8, blocks=[1] * 8)
        long = solve(body)
        assert (short.status, long.status) == ("optimal", "optimal")
        assert long.objective == pytest.approx(short.objective, rel=TWICE)
        assert short.moves is not None
        assert long.moves is not None
        span = np.abs(short.moves).max(axis=0) + 1.0
        assert (np.abs(long.moves[6:]) <= 1e-4 * span).all()


@pytest.mark.slow
@pytest.mark.parametrize("situation", problems.SITUATIONS)
def test_a_step_of_the_thesis_size_is_the_same_in_other_units(situation):
    for blocking in ("moves", "inputs"):
        body = problems.thesis_case(np.random.default_rng(5), situation, blocking=blocking)
        plan = solve(body)
        assert plan.status == "optimal"
        for ways in UNITS.values():
            other = solve(in_units(body, **ways))
            assert other.status == "optimal"
            assert other.objective is not None
            assert other.objective / ways.get("cost", 1.0) == pytest.approx(plan.objective, rel=TWICE)
        check_same(plan, solve(reordered(body, np.random.default_rng(0))))
