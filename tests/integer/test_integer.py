"""Propagation, lower bounds and the paths of the integer search, against brute force on the same rows."""

import itertools

import jax
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.integer import listing as compiled_lists
from jaxmpc.integer import lower_bound
from jaxmpc.integer import search as compiled_search
from jaxmpc.integer.chain import Chain
from jaxmpc.integer.cuts import Cuts
from jaxmpc.integer.feasible import MoveLimits, needed, propagate, satisfied, tighten, within
from jaxmpc.integer.host_search import Search
from jaxmpc.integer.lower_bound import enumerate_below, exclude
from jaxmpc.integer.nearest import nearest
from jaxmpc.integer.relaxer import Relaxer
from jaxmpc.integer.scheduling import run
from jaxmpc.integer.solve import FINISHES, solve_integers
from jaxmpc.integer.tables import Constants
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import make_tuning
from jaxmpc.programs.lanes import for_all
from jaxmpc.relaxed.problem import evaluate
from tests.posed import pose

NONE = np.zeros((0, 4)), np.zeros(0), np.zeros(0)


def random_chain(rng):
    low = rng.integers(-4, 1, size=4)
    return Chain(
        np.arange(4),
        rng.integers(1, 4, size=4),
        low,
        low + rng.integers(0, 6, size=4),
        np.array([False, *rng.integers(0, 2, size=3)], dtype=bool),
        *NONE,
    )


def test_propagation_keeps_every_feasible_move_and_the_dynamic_programme_finds_the_nearest():
    rng = np.random.default_rng(0)
    feasible_seen = infeasible_seen = 0
    for _ in range(300):
        chain = random_chain(rng)
        lower, upper = -rng.integers(0, 3, size=4), rng.integers(0, 3, size=4)
        points = np.array(
            list(itertools.product(*(range(a, b + 1) for a, b in zip(lower, upper, strict=True))))
        )
        good = points[satisfied([chain], points, lower, upper)]
        tight_low, tight_high, possible = propagate([chain], lower[None], upper[None])
        wanted = rng.normal(size=4) * 2
        found = nearest([chain], wanted, lower, upper)
        if len(good):
            assert possible[0]
            assert (good >= tight_low[0]).all()
            assert (good <= tight_high[0]).all()
            assert found is not None
            assert np.abs(found - wanted).sum() == pytest.approx(np.abs(good - wanted).sum(axis=1).min())
            feasible_seen += 1
        else:
            assert found is None
            infeasible_seen += 1
    assert min(feasible_seen, infeasible_seen) > 20


def test_propagation_with_positions_of_each_lane_keeps_every_feasible_move_and_position():
    rng = np.random.default_rng(3)
    moves = np.array(list(itertools.product(range(-2, 3), repeat=4)))
    lanes, feasible_seen, infeasible_seen, dropped = 10, 0, 0, 0
    for _ in range(60):
        chain = random_chain(rng)
        reached = np.cumsum(moves * chain.counts, axis=1)
        lower, upper = -rng.integers(0, 3, size=(lanes, 4)), rng.integers(0, 3, size=(lanes, 4))
        low = np.maximum(chain.low, rng.integers(-5, 1, size=(lanes, 4)))
        high = np.minimum(chain.high, low + rng.integers(1, 6, size=(lanes, 4)))
        given = MoveLimits(lower, upper, low, high)
        tight, possible = tighten([chain], given)
        rest = tight._replace(**dict(zip(("low", "high"), needed([chain], tight), strict=True)))
        for k in range(lanes):
            own = given.lane(k)
            good = satisfied(within([chain], own), moves, own.lower, own.upper)
            if possible[k]:  # what follows from other limits may be left out
                left = rest.lane(k)
                same = satisfied(within([chain], left), moves, left.lower, left.upper)
                np.testing.assert_array_equal(good, same)
                dropped += int((left.low < own.low).sum())
            if good.any():
                assert possible[k]
                for values, least, most in ((moves, 0, 1), (reached, 2, 3)):
                    assert (values[good] >= tight[least][k]).all()
                    assert (values[good] <= tight[most][k]).all()
                feasible_seen += 1
            else:
                infeasible_seen += 1
    assert min(feasible_seen, infeasible_seen) > 50
    assert dropped > 100


def one(tree):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], tree)


def relaxer_of(constants):
    """The compiled relaxations of one scenario."""
    return Relaxer(for_all(constants.qp), [constants])


def root_of(constants, instances, warm=None):
    """Relaxations of problems with a lane axis, from a cold start if none is given."""
    relaxer = relaxer_of(constants)
    return relaxer.solve_roots(instances, relaxer.cold(instances) if warm is None else warm)


def started(constants, instance):
    """A search whose root is solved."""
    return Search(constants, instance, root_of(constants, one(instance)), 1e-6, None)


def solve_integer(constants, instance, *, starts=(), warm=None, **options):
    """One step, from its relaxation on."""
    root = root_of(constants, one(instance), warm)
    return solve_integers(relaxer_of(constants), one(instance), root, starts=[list(starts)], **options)[0]


def answered(constants, instance, search, steps):
    """What a part of a search returns once its problems are solved."""
    return run(relaxer_of(constants), one(instance), [(0, search, steps)])[0]


@pytest.fixture(scope="module")
def problems(small_structure, small_tuning, well_like_model):
    """Twelve steps near, off and far from the setpoint, with all 3^6 whole plans solved for each."""
    rng = np.random.default_rng(1)
    plans = np.array(list(itertools.product((-1, 0, 1), repeat=6)))
    result, constants = [], None
    for k in range(12):
        spread = (0.3, 1.0, 3.0)[k % 3]
        free = np.array([11000.0, 185.0]) + np.cumsum(rng.normal(size=(40, 2)) * [60.0, 0.5], axis=0)
        target = np.tile(np.array([11000.0, 185.0]) + spread * rng.normal(size=2) * [900.0, 9.0], (40, 1))
        posed = pose(
            small_structure,
            small_tuning,
            well_like_model.coefficients,
            free_response=free,
            setpoint=target,
            mv_now=[float(rng.choice([0.0, 50.0, 98.0])), 7500.0],
            last_move=[2.0, 0.0],
        )
        instance = jax.tree.map(np.asarray, posed.instance)
        if constants is None:
            constants = Constants(small_structure, posed.size, jax.tree.map(np.asarray, posed.qp))
        search = started(constants, instance)
        low, high = (np.round(v[:6]).astype(int) for v in search.limits)
        points = plans[satisfied(search.chains, plans, low, high)]
        values = answered(constants, instance, search, search.relax(points, points)).objective
        result.append((constants, instance, points, values))
    return result


def test_a_relaxed_solve_bounds_every_whole_plan_and_fixing_loses_no_better_one(problems, monkeypatch):
    excluded = 0
    for constants, instance, points, values in problems:
        search = started(constants, instance)
        low, high = (np.round(v[:6]).astype(int) for v in search.limits)
        root = search.root
        model = search.lower_model(root, 0, low, high)
        away = points - model.center
        bound = model.value + model.excess[np.arange(6), points - low].sum(axis=1)
        bound = bound + 0.5 * np.einsum("pi,ij,pj->p", away, model.schur, away)
        slack = 1e-7 * np.maximum(values, 1.0)  # objective and bound are each right to about 1e-8
        assert (bound <= values + slack).all()
        cutoff = np.partition(values, 5)[5]  # the sixth best plan as incumbent
        tight_low, tight_high = exclude(model, cutoff)
        better = points[values < cutoff - 1e-6 * cutoff]
        assert (better >= tight_low).all()
        assert (better <= tight_high).all()
        excluded += int((tight_high - tight_low).sum() < (high - low).sum())
        found, bounds, _ = enumerate_below(model, search.chains, tight_low, tight_high, cutoff, None)
        assert {p.tobytes() for p in better} <= {p.tobytes() for p in found}
        assert (np.diff(bounds) >= 0).all()
        with monkeypatch.context() as pieces:  # one partial assignment after the other
            pieces.setattr(lower_bound, "GRID", 0)
            pieces.setattr(lower_bound, "PIECE", 1)
            again, _, _ = enumerate_below(model, search.chains, tight_low, tight_high, cutoff, None)
        assert {p.tobytes() for p in again} == {p.tobytes() for p in found}
    assert excluded > 6


@pytest.mark.parametrize("finish", FINISHES)
def test_every_path_finds_the_best_whole_plan_and_proves_it(problems, finish):
    for constants, instance, _, values in problems:
        result = solve_integer(constants, instance, finish=finish)
        best = values.min()
        assert result.status == status.OPTIMAL
        assert result.value == pytest.approx(best, rel=1e-6)
        assert result.bound <= best * (1 + 1e-8)
        if finish != "auto":
            assert result.finished_by == finish


@pytest.mark.parametrize("actuators", ["on/off", "wide"])
def test_branch_and_bound_alone_finds_the_best_plan_of_all(well_like_model, actuators):
    """On/off valves without blocking, and valves of many steps that start off their limits."""
    rng = np.random.default_rng(5)
    wide = actuators == "wide"
    blocks = (1, 1, 1) if wide else (1,) * 8
    structure = Structure(
        cv_names=("a", "b"),
        mv_names=("u", "v") if wide else ("u",),
        dt=30.0,
        prediction_horizon=24,
        control_horizon=len(blocks),
        blocks=blocks,
        integer_step=(1.0, 1.0) if wide else (1.0,),
    )
    used = structure.mv_count
    coefficients = np.cumsum(rng.normal(size=(2, used, 30)) * np.exp(-np.arange(30) / 6.0), axis=2)
    branched = 0
    for k in range(6):
        tuning = make_tuning(
            structure,
            cv_weight=[1.0, 0.5],
            move_weight=[(0.0, 0.01, 0.3)[k % 3]] * used,
            mv_low=[0.0] * used,
            mv_high=[5.0 if wide else 1.0] * used,
            cv_high=[2.0, 1.5],
            cv_low=[-2.0, -1.5],
            slack_weight=[5.0, 5.0],
        )
        posed = pose(
            structure,
            tuning,
            coefficients,
            free_response=np.cumsum(rng.normal(size=(40, 2)) * 0.3, axis=0),
            setpoint=np.tile(rng.normal(size=2) * (3.0 if wide else 1.0), (40, 1)),
            mv_now=[float(rng.integers(0, 6 if wide else 2))] * used,
            envelope=0 if wide else 1,
        )
        instance = jax.tree.map(np.asarray, posed.instance)
        constants = Constants(structure, posed.size, jax.tree.map(np.asarray, posed.qp))
        search = started(constants, instance)
        low, high = (np.round(v[constants.integer]).astype(int) for v in search.limits)
        reached = itertools.product(range(6 if wide else 2), repeat=len(blocks))
        start = -int(search.chains[0].low[0])
        of_one = np.diff(np.array(list(reached)), axis=1, prepend=start)
        pairs = itertools.product(of_one, repeat=used)
        points = np.array([np.concatenate(pair) for pair in pairs])
        points = points[satisfied(search.chains, points, low, high)]
        values = np.array(
            jax.vmap(evaluate, (None, None, 0))(posed.qp, posed.instance, widened(points, constants))
        )
        result = solve_integer(constants, instance, finish="branch-and-bound")
        assert result.status == status.OPTIMAL
        assert result.value == pytest.approx(values.min(), rel=1e-6)
        assert result.bound <= values.min() * (1 + 1e-8)
        branched += result.nodes > 3
    assert branched > 0


def widened(points, constants):
    """Scaled moves of all MVs with these whole ones."""
    x = np.zeros((len(points), constants.size.moves))
    x[:, constants.integer] = points
    return x


def test_cuts_at_solved_plans_bound_every_plan_and_touch_their_own(problems):
    for constants, instance, points, values in problems:
        search = started(constants, instance)
        some = points[:: max(len(points) // 5, 1)]
        result = answered(constants, instance, search, search.relax(some, some))
        cuts = Cuts(constants)
        for lane, point in enumerate(some):
            cuts.add(result, lane, point, point)
        bounds = cuts.bounds(points)
        slack = 1e-7 * np.maximum(values, 1.0)  # objective and bound are each right to about 1e-8
        assert (bounds <= values + slack).all()
        own = [int(np.flatnonzero((points == p).all(axis=1))[0]) for p in some]
        assert bounds[own] == pytest.approx(values[own], rel=1e-6, abs=1e-6)
        assert (bounds > values.min() * 0.5).mean() > 0.2  # they say something about the other plans, too


def test_scenarios_solved_together_get_the_answers_they_get_alone(problems):
    constants = problems[0][0]
    instances = jax.tree.map(lambda *leaves: np.stack(leaves), *(p[1] for p in problems))
    root = root_of(constants, instances)
    for finish in FINISHES:
        together = solve_integers(
            relaxer_of(constants), instances, root, starts=[[] for _ in problems], finish=finish
        )
        for result, (*_, values) in zip(together, problems, strict=True):
            assert result.status == status.OPTIMAL
            assert result.value == pytest.approx(values.min(), rel=1e-6)
            assert result.bound <= values.min() * (1 + 1e-8)


def test_a_start_or_prices_from_elsewhere_never_change_the_answer(problems):
    rng = np.random.default_rng(2)
    other = solve_integer(*problems[0][:2]).root
    for constants, instance, _, values in problems[1:6]:
        starts = [rng.normal(size=6) * 5]
        result = solve_integer(constants, instance, starts=starts, warm=one(other))
        assert result.status == status.OPTIMAL
        assert result.value == pytest.approx(values.min(), rel=1e-6)


def test_an_expired_time_limit_returns_a_feasible_plan_with_its_true_gap(problems):
    seen = set()
    for constants, instance, _, values in problems:
        result = solve_integer(constants, instance, time_limit=0.0, finish="branch-and-bound")
        assert result.x is not None
        assert result.value >= values.min() * (1 - 1e-8)
        assert result.bound <= values.min() * (1 + 1e-8)
        seen.add(result.status)
    assert status.LIMIT in seen


INTEGERS = 8  # room for the six integer moves


@pytest.fixture
def searched():
    """What the compiled search finds for one of `problems`; compiled after constants of it were changed, and forgotten."""
    jax.clear_caches()
    decide = jax.jit(lambda *arguments: compiled_search.decide(*arguments))

    def search(problem):
        constants, instance, _, _ = problem
        cold = jax.tree.map(lambda leaf: leaf[0], relaxer_of(constants).cold(one(instance)))
        return decide(constants.qp, constants.tables(INTEGERS), instance, cold, 1e-6)

    yield search
    jax.clear_caches()


@pytest.mark.parametrize("free", [compiled_lists.GRID_FREE, 0])
def test_the_compiled_search_finds_the_best_whole_plan_and_proves_it(searched, problems, monkeypatch, free):
    """From the grid of all combinations, and from the list that is made move by move."""
    monkeypatch.setattr(compiled_lists, "GRID_FREE", free)
    closed = 0
    for problem in problems:
        found = searched(problem)
        if found.closed:
            best = problem[3].min()
            assert float(found.value) == pytest.approx(best, rel=1e-6, abs=1e-9)
            assert float(found.bound) <= best * (1.0 + 1e-9) + 1e-12
            assert float(found.value - found.bound) <= 1e-6 * max(best, 1e-6 * problem[0].scale)
            closed += 1
    assert closed >= 10  # the others are left to the host, which solves all of them


def test_a_list_that_does_not_fit_is_not_claimed_to_be_done(searched, problems, monkeypatch):
    monkeypatch.setattr(compiled_lists, "GRID_FREE", 0)
    monkeypatch.setattr(compiled_lists, "LONGEST", 256)
    monkeypatch.setattr(compiled_search, "MOST_SOLVED", 2)
    for problem in problems:
        found = searched(problem)
        if found.closed:
            assert float(found.value) == pytest.approx(problem[3].min(), rel=1e-6, abs=1e-9)


@pytest.mark.slow
def test_a_batch_of_compiled_searches_in_lockstep_is_each_alone(searched, problems, monkeypatch):
    """What an accelerator runs for scenarios of one controller."""
    constants = problems[0][0]
    relaxer, tables = relaxer_of(constants), constants.tables(INTEGERS)
    instances = jax.tree.map(lambda *leaves: np.stack(leaves), *[problem[1] for problem in problems])
    alone = [searched(problem) for problem in problems]
    monkeypatch.setattr("jax.default_backend", lambda: "gpu")  # all lanes in lockstep
    decide = lambda *arguments: compiled_search.decide(*arguments)  # noqa: E731
    together = jax.jit(jax.vmap(decide, in_axes=(None, None, 0, 0, None)))(
        constants.qp, tables, instances, relaxer.cold(instances), 1e-6
    )
    for k, found in enumerate(alone):
        assert bool(together.closed[k]) == bool(found.closed)
        if found.closed:
            np.testing.assert_allclose(together.value[k], found.value, rtol=1e-6)
            assert int(together.finished_by[k]) == int(found.finished_by)
