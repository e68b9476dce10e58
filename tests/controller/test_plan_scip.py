"""Steps of the thesis's size against SCIP on the full form, and the relaxed ones against two QP solvers.

SCIP may stop at its time limit: then its plan must not beat ours, and its bound must not exceed our cost,
both by more than 1e-6 relative (`oracles.complaints`). SCIP holds rows to 1e-8 in scaled units, which costs
its bound some 1e-6 relative, on the safe side.
"""

import numpy as np
import pytest

from tests import problems
from tests.controller.test_plan import FINISHES, solve
from tests.oracles import steps as oracles

BLOCKING = ("moves", "inputs")


def published():
    """Published step responses, or a skip."""
    response = problems.published_response()
    if response is None:
        pytest.skip(f"the published step responses are not there: {problems.PUBLISHED.name}")
    return response


@pytest.mark.parametrize(
    ("situation", "blocking", "seed"), [("step", "inputs", 3), ("saturated", "inputs", 5)]
)
def test_a_step_of_the_thesis_size_is_no_worse_than_scips(situation, blocking, seed):
    body = problems.thesis_case(np.random.default_rng(seed), situation, blocking=blocking)
    reference = oracles.solve_scip(body, 20)
    assert oracles.complaints(body, solve(body), reference) == []


@pytest.mark.parametrize("situation", problems.SITUATIONS)
def test_a_relaxed_step_of_the_thesis_size_is_what_two_solvers_find(situation):
    body = problems.thesis_case(np.random.default_rng(1), situation)
    body["structure"]["integer_step"], body["tuning"]["oscillation_rows"] = {}, {}
    assert oracles.complaints(body, solve(body), oracles.best_qp(body)) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("blocking", BLOCKING)
@pytest.mark.parametrize("situation", problems.SITUATIONS)
def test_steps_on_the_published_responses_are_no_worse_than_scips(situation, blocking, seed):
    weight = (250.0, 1000.0, 62.5, 250.0)[seed]
    body = problems.thesis_case(
        np.random.default_rng(100 + seed),
        situation,
        blocking=blocking,
        response=published(),
        choke_weight=weight,
    )
    reference = oracles.solve_scip(body, 60)
    for finish in FINISHES:
        assert oracles.complaints(body, solve(body, finish), reference) == [], finish


@pytest.mark.slow
@pytest.mark.parametrize(
    "twist",
    [
        "active_cv_limits",
        "cv_limits_between_response_and_setpoint",
        "both_cv_limits_violated",
        "without_soft_mpc",
        "rounding_trap",
        "just_reversed",
        "wide_integer_moves",
        "no_move_limits",
        "light_move_weight",
        "half_a_step_away",
        "at_setpoint",
    ],
)
@pytest.mark.parametrize("blocking", BLOCKING)
def test_awkward_steps_of_the_thesis_size_are_no_worse_than_scips(twist, blocking):
    rng = np.random.default_rng(sum(map(ord, twist)))
    body = problems.thesis_case(rng, "step", blocking=blocking)
    problems.TWISTS[twist](body, rng)
    assert oracles.complaints(body, solve(body), oracles.solve_scip(body, 60)) == []


@pytest.mark.slow
@pytest.mark.parametrize("blocking", BLOCKING)
def test_a_step_without_blocking_is_no_worse_than_scips(blocking):
    body = problems.thesis_case(np.random.default_rng(7), "step", blocking=blocking)
    body["structure"].update(blocks=[1] * 40, control_horizon=40)
    body["limits"] = {"time_s": 60.0}
    plan, reference = solve(body), oracles.solve_scip(body, 120)
    flaws = oracles.complaints(body, plan, reference)
    if plan.status == "limit":  # honest: everything but status and gap has to hold
        flaws = [flaw for flaw in flaws if not flaw.startswith(("status limit", "states a gap"))]
    assert flaws == []
