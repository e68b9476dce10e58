"""HiGHS as it is called here: its optima and bounds against enumeration. Every version before 1.16 fails some of this."""

import itertools

import numpy as np
import pytest

from jaxmpc.integer.feasible import Chain
from jaxmpc.integer.highs import ReducedMilp, solve_milp


def test_a_linear_programme_with_one_whole_variable_is_solved_to_its_optimum():
    status, point, bound = solve_milp(
        np.array([2.0, 3.0]),
        (np.array([0, 0]), np.array([0, 1]), np.ones(2)),
        np.array([4.5]),
        np.array([np.inf]),
        np.zeros(2),
        np.full(2, 10.0),
        np.array([False, True]),
    )
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
