"""Relaxations whose positions pay curvature along chords: never above a whole plan, solved, and tighter."""

import itertools

import clarabel
import equinox as eqx
import jax
import numpy as np
import pytest
import scipy.sparse as sp

from jaxmpc import status
from jaxmpc.integer import branch_and_bound, enumeration, lower_bound
from jaxmpc.integer.cuts import Cuts
from jaxmpc.integer.feasible import MoveLimits, needed, position_limits, satisfied, tighten, within
from jaxmpc.integer.finish import finish_steps
from jaxmpc.integer.host_search import Search
from jaxmpc.integer.lower_bound import enumerate_below
from jaxmpc.integer.relaxer import Relaxer
from jaxmpc.integer.tables import Constants
from jaxmpc.integer.tighten import LEAST, chord_weights
from jaxmpc.problem.layout import Size
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import make_tuning
from jaxmpc.relaxed.problem import evaluate
from tests.integer.test_integer import answered, one, relaxer_of
from tests.posed import pose

STEPS = {"on/off": 1, "stepped": 3}  # largest position, and move
SIZE = Size(cvs=2, mvs=2, blocks=8, horizon=32, future=32, windows=0, past=32)
ACCURACY = 1e-7  # of objectives and bounds, relative: each is right to about 1e-8


def curvatures(rng):
    """Random curvatures of full rank, with a flat direction of all positions, and with one of the last two alone."""
    factor = rng.normal(size=(6, 6)) * 10 ** rng.uniform(-1, 1, size=(6, 1))
    full = factor @ factor.T + np.diag(rng.uniform(0.0, 5.0, size=6))
    flat = factor[:, :5] @ factor[:, :5].T
    alike = factor.copy()
    alike[5] = alike[4]  # two positions that do the same
    alike[:4, 5] = 0.0
    alike[4:, :5] = 0.0
    return {"full": full, "flat": flat, "apart": alike @ alike.T + np.diag([3.0] * 4 + [0.0] * 2)}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["full", "flat", "apart"])
def test_chords_pay_all_curvature_that_leaves_the_objective_convex_but_a_tenth(kind, seed):
    curvature = curvatures(np.random.default_rng(seed))[kind]
    weight, top = chord_weights(curvature), np.diag(curvature).max()
    least = lambda weight: np.linalg.eigvalsh(curvature - 2.0 * np.diag(weight))[0]  # noqa: E731
    rounding = 1e-12 * np.trace(curvature)  # of eigenvalues
    assert (weight >= 0.0).all()
    assert least(weight) >= -rounding
    assert weight.any() == (kind != "flat")
    assert (weight[:4] > 0.0).any() == (kind != "flat")
    if weight.any():
        assert least(1.12 * weight) < -rounding  # nine tenths are taken: 1 / 0.9 = 1.111 times as much is all
    # shares below LEAST of each position are left out, whose sum is what another may be raised by
    noticeable = 1.01 * len(weight) * LEAST * top
    for raised in np.eye(len(weight)) * noticeable:
        assert least(weight / 0.9 + raised) < -rounding
    # relative; the interior-point solver stops at 1e-8, where its path may differ a little
    np.testing.assert_allclose(chord_weights(1e3 * curvature), 1e3 * weight, rtol=1e-5)


def test_no_curvature_leaves_nothing_for_chords():
    assert not chord_weights(np.zeros((3, 3))).any()


class Plain:
    """A small problem, its tightened relaxation, and the value of every whole plan (continuous moves optimal)."""

    def __init__(self, kind: str, seed: int, **changes):
        rng = np.random.default_rng(seed)
        most = STEPS[kind]
        blocks = (1,) * 6 if kind == "on/off" else (1, 2, 1)
        structure = Structure(
            cv_names=("a", "b"),
            mv_names=("u", "v"),
            dt=30.0,
            prediction_horizon=24,
            control_horizon=sum(blocks),
            blocks=blocks,
            integer_step=(1.0, None),
        )
        response = np.cumsum(rng.normal(size=(2, 2, 30)) * np.exp(-np.arange(30) / 3.0), axis=2)
        fields = dict(
            cv_weight=[1.0, 0.5],
            move_weight=[(0.0, 0.01, 0.3)[seed % 3], 1.0],
            mv_low=[0.0, -2.0],
            mv_high=[float(most), 2.0],
            cv_high=[2.0, 1.5],
            cv_low=[-2.0, -1.5],
            slack_weight=[5.0, 5.0],
            soft_quadratic=[0.3, 0.0],
            soft_linear=[0.2, 0.2],
            deadzone=[0.5, 0.5],
        )
        fields |= {key: value for key, value in changes.items() if key in fields}
        free = np.cumsum(rng.normal(size=(32, 2)) * 0.3, axis=0)
        self.posed = pose(
            structure,
            make_tuning(structure, **fields),
            changes.get("response", response),
            free_response=changes.get("free_response", free),
            setpoint=np.tile(changes.get("setpoint", rng.normal(size=2) * most), (32, 1)),
            mv_now=[changes.get("mv_now", float(rng.integers(0, most + 1))), 0.0],
            size=SIZE,
            envelope=3,
        )
        self.instance = jax.tree.map(np.asarray, self.posed.instance)
        self.constants = Constants(structure, SIZE, jax.tree.map(np.asarray, self.posed.qp))
        self.plain = relaxer_of(self.constants)
        self.tight = self.plain.with_chords(0)
        self.plain_root, root = (self.root_of(relaxer) for relaxer in (self.plain, self.tight))
        self.search = Search(self.constants, self.instance, root, 1e-6, None)
        own = self.constants.integer
        self.low, self.high = (np.round(limits[own]).astype(int) for limits in self.search.limits)
        points = np.array(
            list(itertools.product(*(range(a, b + 1) for a, b in zip(self.low, self.high, strict=True))))
        )
        self.points = points[satisfied(self.search.chains, points, self.low, self.high)]

    def root_of(self, relaxer):
        return relaxer.solve_roots(one(self.instance), relaxer.cold(one(self.instance)))

    @property
    def values(self):
        """Of all whole plans, by the plain problem."""
        search = Search(self.constants, self.instance, self.plain_root, 1e-6, None)
        result = answered(self.constants, self.instance, search, search.relax(self.points, self.points))
        assert (result.status == status.OPTIMAL).all()
        return result.objective

    def relaxed(self, *arguments):
        """Tightened relaxations within these limits, as a search asks for them."""
        from jaxmpc.integer.scheduling import run

        steps = self.search.relax(*arguments)
        return run(self.tight, one(self.instance), [(0, self.search, steps)])[0]


@pytest.fixture(scope="module")
def problems():
    """With the values of their whole plans."""
    made = [Plain(kind, seed) for kind in STEPS for seed in range(4)]
    made = [problem for problem in made if problem.constants.chord_weight.any()]
    assert len(made) >= 6
    return [(problem, problem.values) for problem in made]


def test_the_tightened_problem_is_the_same_at_whole_points_and_its_relaxation_in_between(problems):
    rng = np.random.default_rng(0)
    values_of = jax.jit(jax.vmap(evaluate, (None, None, 0)))
    for problem, values in problems:
        x = rng.normal(size=(len(problem.points), SIZE.moves))
        x[:, 14:] = 0.0
        x[:, : SIZE.blocks] = 0.0
        x[:, problem.constants.integer] = problem.points
        both = [values_of(relaxer.problem(0), problem.instance, x) for relaxer in (problem.plain, problem.tight)]
        np.testing.assert_allclose(*both, rtol=1e-11)  # rounding of some hundred terms of like size
        plain, tight = float(problem.plain_root.objective[0]), float(problem.search.root.objective[0])
        slack = ACCURACY * max(values.min(), 1.0)
        assert plain - slack <= tight <= values.min() + slack


def test_chords_close_most_of_the_gap_of_an_on_off_valve_between_two_setpoints():
    """A fast valve that is worth nothing to hold still, and a setpoint half way: the relaxation stays half open."""
    fast = np.zeros((2, 2, 30))
    fast[0, 0] = fast[1, 1] = 1.0 - 0.2 ** np.arange(1, 31)
    problem = Plain(
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


def narrowed(problem, rng):
    """Limits of moves and positions as a tree has them: between two whole plans, tightened by the hard rows."""
    pair = problem.points[rng.integers(len(problem.points), size=2)]
    reached = np.round(pair @ problem.constants.reached.T).astype(int)
    low, high = position_limits(problem.search.chains)
    some = rng.random(len(low)) < 0.5
    moves = rng.random(len(low)) < 0.5
    limits = MoveLimits(
        np.where(moves, pair.min(axis=0), problem.low),
        np.where(moves, pair.max(axis=0), problem.high),
        np.where(some, reached.min(axis=0), low),
        np.where(some, reached.max(axis=0), high),
    )
    tight, possible = tighten(problem.search.chains, MoveLimits(*(values[None] for values in limits)))
    assert possible[0]
    return tight


def test_what_a_tightened_relaxation_proves_holds_at_every_whole_point_of_its_limits(problems):
    rng = np.random.default_rng(4)
    for problem, values in problems:
        search = problem.search
        whole = MoveLimits(*(v[None] for v in (problem.low, problem.high, *position_limits(search.chains))))
        for limits in (whole, *(narrowed(problem, rng) for _ in range(6))):
            own = limits.lane(0)
            rows = needed(search.chains, limits)
            result = search.root if limits is whole else problem.relaxed(limits.lower, limits.upper, None, rows)
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
