"""Relaxed problems with active CV limits, from cold starts: Newton solves all of them, by the judge and another solver."""

import jax
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.problem.layout import Size
from tests import problems
from tests.oracles.foreign import foreign_solution
from tests.oracles.kkt import kkt_residuals
from tests.posed import pose_case, solve_one

SIZE = Size(cvs=2, mvs=2, blocks=8, horizon=32, future=32, windows=0, past=32)
SHAPES = {
    "moves": dict(hp=12, blocks=[1, 1, 2, 2], integer={}),
    "inputs": dict(hp=12, blocks=[1, 1, 2, 2], integer={}, blocking="inputs"),
    "envelope": dict(hp=10, blocks=[1, 1, 2, 2], integer={0: 2.0}),
    "five blocks": dict(hp=12, hu=9, blocks=[1, 1, 1, 2, 4], integer={}),
}
LIMITS = ("active_cv_limits", "cv_limits_between_response_and_setpoint", "both_cv_limits_violated")
COSTS = (
    "plain",
    "soft_linear_only",
    "heavy_soft_linear",
    "light_move_weight",
    "no_move_weight",
    "costly_slack",
)
_residuals = jax.jit(kkt_residuals)


def assert_solved(posed) -> bool:
    """Solve, judge and compare; returns whether a limit is priced."""
    solution = solve_one(posed.qp, posed.instance)
    residuals = _residuals(posed.qp, posed.rows, posed.instance, solution)
    assert int(solution.status) == status.OPTIMAL, f"gap {float(solution.residual):.1e}"
    assert float(residuals.worst) <= 1e-6
    theirs = foreign_solution(posed.qp, posed.rows, posed.instance, "any")
    # their moves are only nearly within the limits, so that they may be a little below the optimum
    value = _value(posed, theirs.x)
    assert float(solution.objective) == pytest.approx(value, rel=1e-6, abs=1e-6 * _scale(posed))
    return bool(np.abs(solution.limit_price).max() > 0.0)


def _value(posed, x) -> float:
    """The objective, term by term."""
    qp, instance = jax.tree.map(np.asarray, (posed.qp, posed.instance))
    t, x = qp.theta @ np.asarray(x) + instance.offset, np.asarray(x)
    beyond = np.maximum(np.abs(t) - qp.deadzone, 0.0)
    value = (qp.quadratic * t**2 + qp.soft_quadratic * beyond**2 + qp.soft_linear * beyond).sum()
    value += (qp.move_weight * x**2).sum() + (qp.steep * np.abs(x)).sum()  # an envelope of one level
    for over in (t - instance.limit_high, instance.limit_low - t):
        value += qp.slack_weight @ np.maximum(over.reshape(2, -1).max(axis=1), 0.0)
    return float(value)


def _scale(posed) -> float:
    """What one move costs."""
    return float(np.diagonal(posed.qp.curvature).max())


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("cost", COSTS)
def test_small_problems_with_active_limits_are_all_solved(shape, cost):
    active = 0
    for seed in range(12):
        rng = np.random.default_rng(seed + 7)
        body = problems.small_case(rng, **SHAPES[shape])
        problems.TWISTS[LIMITS[seed % 3]](body, rng)
        if cost != "plain":
            problems.TWISTS[cost](body, rng)
        active += assert_solved(pose_case(body, size=SIZE))
    assert active >= 6


@pytest.mark.parametrize("shape", SHAPES)
def test_constructed_problems_that_pay_for_slack_are_all_solved(shape):
    for seed in range(40):
        body, _ = problems.stationary_case(np.random.default_rng(seed), **SHAPES[shape])
        assert assert_solved(pose_case(body, size=SIZE))


def limited(seed: int, integer: bool) -> dict:
    """A step of the thesis's size, far from its setpoint, with limits in the way and slack of any price."""
    rng = np.random.default_rng(seed)
    body = problems.thesis_case(rng)
    working = np.array([11013.0, 185.0])
    high = working * [0.85 + 0.3 * rng.random(), 0.9 + 0.2 * rng.random()]
    low = high * [0.7 + 0.25 * rng.random(), 0.8 + 0.15 * rng.random()]
    prices = [10 ** rng.uniform(-1, 3), 10 ** rng.uniform(0, 3)]
    body["tuning"].update(cv_high=high.tolist(), cv_low=low.tolist(), slack_weight=prices)
    target = working * [0.7 + 0.6 * rng.random(), 0.7 + 0.5 * rng.random()]
    body["setpoint"] = np.tile(target, (250, 1)).tolist()
    body["free_response"] = (working + np.cumsum(rng.normal(0, [8, 0.12], (250, 2)), axis=0)).tolist()
    body.update(mv_now=[50.0, 7500.0], last_move=[0.0, 0.0])
    if not integer:
        body["structure"]["integer_step"], body["tuning"]["oscillation_rows"] = {}, {}
    return body


@pytest.mark.parametrize("integer", [False, True])
def test_problems_of_the_thesis_size_with_active_limits_are_all_solved(integer):
    assert sum(assert_solved(pose_case(limited(seed, integer))) for seed in range(30)) >= 25
