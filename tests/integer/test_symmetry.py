"""Equal actuators: some best plan is in order, and searches that look at such plans only find its value."""

import dataclasses
import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from jaxmpc.controller.case import make_case
from jaxmpc.controller.plan import Planner
from jaxmpc.integer.chain import Chain
from jaxmpc.integer.feasible import MoveLimits, position_limits, satisfied
from jaxmpc.integer.symmetry import in_order, orders_of, tighten_in_order
from tests.oracles import steps as oracles

NONE = np.zeros((0, 3)), np.zeros(0), np.zeros(0)
BLOCKS = 3


def equal_actuators(rng, counts=(1, 1, 1)):
    """Chains of three MVs of one kind that start anywhere, some with the opposite sign; what a problem knows of them."""
    reach, most, response = int(rng.integers(1, 3)), int(rng.integers(1, 3)), rng.normal(size=(4, BLOCKS))
    chains, signs, coupled = [], rng.choice([-1, 1], size=3), np.zeros(BLOCKS, dtype=bool)
    for k, sign in enumerate(signs):
        start = int(rng.integers(0, reach + 1))
        ends = np.sort([-sign * start, sign * (reach - start)])
        low, high = (np.full(BLOCKS, end) for end in ends)
        chains.append(Chain(BLOCKS * k + np.arange(BLOCKS), np.array(counts), low, high, coupled, *NONE))
    n = 3 * BLOCKS
    qp = SimpleNamespace(
        ideal=None,
        move_weight=np.full(n, float(rng.choice([0.0, 0.3]))),
        steep=(),
        response=np.concatenate([sign * response for sign in signs], axis=1),
    )
    constants = SimpleNamespace(
        qp=qp, integer=np.arange(n), scales=np.ones(n), structure=SimpleNamespace(relaxed_moves=False)
    )
    return constants, chains, np.full(n, -most), np.full(n, most)


def costs(constants, points, rng):
    """Of whole moves: any convex function of the predictions, and the squares of the moves."""
    predicted = points @ constants.qp.response.T + rng.normal(size=4)
    return np.abs(predicted).sum(axis=1) + (predicted**2).sum(axis=1) + points**2 @ constants.qp.move_weight


@pytest.mark.parametrize("counts", [(1, 1, 1), (1, 2, 1), (2, 1, 1)])
def test_some_best_plan_of_equal_actuators_is_in_order(counts):
    rng, left_out = np.random.default_rng(0), 0
    for _ in range(60):
        constants, chains, lower, upper = equal_actuators(rng, counts)
        paths = [
            own[satisfied([dataclasses.replace(chain, columns=np.arange(BLOCKS))], own, lower[:3], upper[:3])]
            for chain, own in zip(
                chains, [np.array(list(itertools.product(range(-2, 3), repeat=3)))] * 3, strict=True
            )
        ]
        chosen = itertools.product(*(range(len(path)) for path in paths))
        points = np.array(
            [np.concatenate([p[i] for p, i in zip(paths, pick, strict=True)]) for pick in chosen]
        )
        orders = orders_of(constants, chains, lower, upper)
        good, value = in_order(chains, orders, points), costs(constants, points, rng)
        assert value[good].min() == pytest.approx(value.min(), rel=1e-12, abs=1e-12)  # rounding of sums
        left_out += (~good).sum()
        limits = MoveLimits(lower, upper, *position_limits(chains))
        tight, possible = tighten_in_order(chains, orders, MoveLimits(*(v[None] for v in limits)))
        assert possible[0]
        assert (points[good] >= tight.lower[0]).all()
        assert (points[good] <= tight.upper[0]).all()
    assert (left_out > 0) == (counts[0] == 1)


@pytest.mark.parametrize("key", ["response", "weight", "reach", "move limit", "oscillation"])
def test_actuators_that_anything_tells_apart_have_no_order(key):
    rng = np.random.default_rng(1)
    constants, chains, lower, upper = equal_actuators(rng)
    assert len(orders_of(constants, chains, lower, upper)) == 2
    upper = np.full_like(upper, 1) if key == "move limit" else upper
    lower = np.full_like(lower, -1) if key == "move limit" else lower
    wide = [dataclasses.replace(c, low=c.low * 0 - 4, high=c.high * 0 + 4) for c in chains]
    assert len(orders_of(constants, wide, lower, upper)) == 2
    for k, own in enumerate(wide):
        own_columns = slice(own.columns[0], own.columns[-1] + 1)
        if key == "response":
            constants.qp.response[:, own_columns] *= 1.0 + 1e-6 * k
        if key == "weight":
            constants.qp.move_weight[own_columns] = 0.1 + 1e-6 * k
        if key == "reach":
            wide[k] = dataclasses.replace(own, high=own.high + k)
        if key == "move limit":
            lower[own_columns] -= k
            upper[own_columns] += k
        if key == "oscillation":
            wide[k] = dataclasses.replace(own, coupled=np.array([False, True, True]))
    assert orders_of(constants, wide, lower, upper) == []


@pytest.mark.parametrize("seed", range(6))
def test_equal_pumps_are_planned_as_by_brute_force(seed):
    rng = np.random.default_rng(seed)
    signs, at = rng.choice([-1.0, 1.0], size=3), rng.integers(0, 2, size=3)
    low, high = np.minimum(signs, 0.0), np.maximum(signs, 0.0)
    response = 1.0 - np.exp(-np.arange(1, 11) / rng.uniform(1.0, 5.0))
    weight = float(rng.choice([0.0, 0.02]))
    body = {
        "model": {
            "dt": 1.0,
            "cv": ["level"],
            "mv": ["a", "b", "c"],
            "coefficients": [(signs[:, None] * response).tolist()],
        },
        "structure": {
            "prediction_horizon": 10,
            "control_horizon": 4,
            "first_penalised": 1,
            "blocking": "moves",
            "blocks": [1, 1, 2],
            "integer_step": {"a": 1.0, "b": 1.0, "c": 1.0},
        },
        "tuning": {
            "cv_weight": [1.0],
            "move_weight": [weight] * 3,
            "soft_quadratic": [float(rng.choice([0.0, 3.0]))],
            "soft_linear": [0.0],
            "deadzone": [0.1],
            "cv_low": [None],
            "cv_high": [float(rng.uniform(0.5, 3.0))],
            "slack_weight": [1.0],
            "mv_low": low.tolist(),
            "mv_high": high.tolist(),
            "move_low": [None] * 3,
            "move_high": [None] * 3,
        },
        "mv_now": (signs * at).tolist(),
        "last_move": [0.0] * 3,
        "free_response": (rng.uniform(-1.0, 1.0) + 0.1 * np.arange(10)[:, None]).tolist(),
        "setpoint": np.full((10, 1), rng.uniform(0.3, 2.5)).tolist(),
    }
    best = oracles.brute_force(body)
    case = make_case(body)
    planner = Planner(case.structure, case.tuning, case.model)
    step = {key: getattr(case, key) for key in ("mv_now", "last_move", "free_response", "setpoint")}
    for finish in ("auto", "enumeration", "highs", "branch-and-bound"):
        assert oracles.complaints(body, planner.solve(**step, finish=finish), best) == [], finish
