"""Chains with lists of allowed positions and a dwell: what is kept, propagated, listed and found, against every point."""

import dataclasses
import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jaxmpc.integer.actuators import LONG_AGO, Actuator, actuators_of, samples_since
from jaxmpc.integer.chain import Chain, chains_of, resting
from jaxmpc.integer.feasible import MoveLimits, around, position_limits, propagate, satisfied, tighten, within
from jaxmpc.integer.lower_bound import LowerModel, enumerate_below
from jaxmpc.integer.nearest import fastest_return, nearest
from jaxmpc.problem.layout import Size
from jaxmpc.problem.structure import Structure
from tests.oracles.actuators import kept

MOVES = np.array(list(itertools.product(range(-3, 4), repeat=4)))
BLOCKS = {"single": (1, 1, 1, 1), "long": (1, 2, 1, 3)}


def structure_of(blocks, blocking, **more):
    return Structure(
        cv_names=("y",),
        mv_names=("u",),
        prediction_horizon=4,
        control_horizon=sum(blocks),
        blocks=blocks,
        blocking=blocking,
        **more,
    )


def random_chain(rng, blocks, blocking):
    """A chain with a list, a dwell or both, and the case that the oracle reads."""
    positions = np.unique(np.append(rng.integers(-6, 7, rng.integers(1, 5)), [0, 4]))
    values = tuple((2.0 * positions).tolist()) if rng.random() < 0.7 else None
    dwell = int(rng.integers(1, 4))
    given = dict(integer_values=(values,)) if values else dict(integer_step=(2.0,))
    structure = structure_of(blocks, blocking, **given, dwell=(dwell,))
    size = Size.of(structure, 4)
    step, since = structure.steps[0], np.array([rng.integers(1, 5)])
    actuators = actuators_of(structure, np.zeros(1), since) or [Actuator()]
    low, high = np.full(size.rows, -np.inf), np.full(size.rows, np.inf)
    ends = (
        (values[0], values[-1]) if values else (-np.inf, np.inf)
    )  # which the limits of the tuning are held to
    low[: len(blocks)] = np.maximum(np.floor(-rng.integers(0, 14, len(blocks)) / step), ends[0] / step)
    high[: len(blocks)] = np.minimum(np.ceil(rng.integers(0, 14, len(blocks)) / step), ends[1] / step)
    instance: Any = SimpleNamespace(row_low=low, row_high=high)
    (chain,) = chains_of(structure, size, instance, actuators)
    body = {
        "model": {"mv": ["u"]},
        "structure": {
            "blocks": list(blocks),
            "blocking": blocking,
            "integer_step": {} if values else {"u": 2.0},
            "integer_values": {"u": list(values)} if values else {},
            "dwell": {"u": dwell},
        },
        "mv_now": [0.0],
        "last_move": [0.0],
        "samples_since_move": [int(since[0])],
    }
    return structure, chain, actuators[0], body, (low[: len(blocks)], high[: len(blocks)])


def cases(count=60):
    """Chains of all kinds, with the points that are feasible by the words of list, dwell and limits."""
    rng = np.random.default_rng(11)
    for blocks, blocking in itertools.product(BLOCKS.values(), ("moves", "inputs")):
        for _ in range(count):
            structure, chain, actuator, body, (low, high) = random_chain(rng, blocks, blocking)
            at = np.cumsum(MOVES * chain.counts, axis=1)
            good = ((at >= low) & (at <= high)).all(axis=1)
            good[good] = [kept(body, 0, point) for point in MOVES[good].tolist()]
            still = resting(structure, actuator, 0)
            yield rng, chain, np.where(still, 0, -3), np.where(still, 0, 3), MOVES[good]


def test_exactly_the_plans_that_keep_list_dwell_and_limits_satisfy_a_chain():
    seen = 0
    for _, chain, lower, upper, good in cases():
        np.testing.assert_array_equal(MOVES[satisfied([chain], MOVES, lower, upper)], good)
        seen += chain.restricted and 1 < len(good) < 300
    assert seen > 100


def test_propagation_keeps_every_feasible_plan_and_the_dynamic_programme_finds_the_nearest():
    for rng, chain, lower, upper, good in cases():
        tight, possible = tighten(
            [chain], MoveLimits(*(v[None] for v in (lower, upper, *position_limits([chain]))))
        )
        wanted = rng.normal(size=4) * 2
        found = nearest([chain], wanted, lower, upper)
        if not len(good):
            assert found is None
            continue
        assert possible[0]
        at = np.cumsum(good * chain.counts, axis=1)
        for values, least, most in ((good, tight.lower, tight.upper), (at, tight.low, tight.high)):
            assert (values >= least).all()
            assert (values <= most).all()
        assert found is not None
        assert (good == found).all(axis=1).any()
        assert np.abs(found - wanted).sum() == pytest.approx(np.abs(good - wanted).sum(axis=1).min())


def test_limits_that_leave_one_plan_leave_it_or_nothing():
    """A leaf of a tree is known to be impossible by its limits, also where a block only passes what is not allowed."""
    left = 0
    for rng, chain, lower, upper, good in cases(20):
        for point in MOVES[rng.integers(0, len(MOVES), 20)]:
            possible = propagate([chain], *(np.clip(point, lower, upper)[None],) * 2)[2]
            wanted = (good == np.clip(point, lower, upper)).all(axis=1).any()
            assert possible[0] == wanted
            left += wanted
    assert left > 20


def test_lists_hold_every_feasible_plan_below_the_cutoff_and_no_other():
    for rng, chain, lower, upper, good in cases(20):
        root = np.tril(rng.normal(size=(4, 4))) * 0.3
        model = LowerModel(
            value=1.0,
            center=rng.normal(size=4),
            lower=lower,
            upper=upper,
            excess=np.where(np.arange(7) <= (upper - lower)[:, None], rng.random((4, 7)), np.inf),
            schur=root.T @ root,
            radius=np.full(4, np.inf),
            order=np.arange(4),
            leading=root,
        )
        bounds = 1.0 + 0.5 * (((good - model.center) @ root.T) ** 2).sum(axis=1)
        bounds = bounds + model.excess[np.arange(4), good - lower].sum(axis=1)
        cutoff = np.median(bounds) + 1e-9 if len(bounds) else 2.0
        found = enumerate_below(model, [chain], lower, upper, cutoff, None)
        assert found is not None
        points = found[0][satisfied([chain], found[0], lower, upper)]
        assert {tuple(p) for p in points.tolist()} == {tuple(p) for p in good[bounds < cutoff].tolist()}
        assert len(points) == len(found[0])


def test_points_around_a_plan_are_feasible_and_reach_the_next_allowed_values():
    rng, seen = np.random.default_rng(0), 0
    for _, chain, lower, upper, good in cases(20):
        if len(good) < 2:
            continue
        point = good[rng.integers(len(good))]
        found = around([chain], point, lower, upper)
        assert (found == point).all(axis=1).any()
        known = {tuple(p) for p in good.tolist()}
        assert {tuple(p) for p in found.tolist()} <= known
        seen += len(found) > 1
    assert seen > 20


def test_an_mv_outside_its_limits_gets_room_for_its_shortest_way_back_and_no_more():
    structure = structure_of((1,) * 4, "moves", integer_values=((0.0, 10.0, 25.0, 60.0, 100.0),))
    size = Size.of(structure, 4)
    low, high = np.full(size.rows, -np.inf), np.full(size.rows, np.inf)
    low[:4], high[:4] = -20, -10  # from 100 to 50 or less
    actuators = actuators_of(structure, np.array([100.0]), np.array([LONG_AGO]))
    instance: Any = SimpleNamespace(row_low=low, row_high=high)
    (chain,) = chains_of(structure, size, instance, actuators)
    lower, upper = np.full(4, -9), np.zeros(4, dtype=int)  # 45 at once, and 50 is not allowed
    assert nearest([chain], np.zeros(4), lower, upper) is None
    widened = fastest_return(chain, lower, upper)
    assert widened is not None
    np.testing.assert_array_equal(widened[1], [-8, -15, -15, -15])  # 60, then 25 or less
    np.testing.assert_array_equal(widened[0], chain.low)


def test_limits_of_a_node_are_those_of_its_chains():
    for _, chain, lower, upper, good in cases(5):
        limits = MoveLimits(lower, upper, *position_limits([chain]))
        (own,) = within([chain], limits)
        same = [f.name for f in dataclasses.fields(Chain)]
        assert all(
            np.array_equal(getattr(own, name), getattr(chain, name)) for name in same if name != "apart"
        )
        np.testing.assert_array_equal(MOVES[satisfied([own], MOVES, lower, upper)], good)


def test_half_a_step_is_a_move_and_what_is_less_is_none():
    structure = structure_of((1, 1), "moves", integer_step=(2.0,), dwell=(3,))
    past = np.array([[0.0], [-2.0], [0.0], [0.9]])
    assert samples_since(structure, past).tolist() == [3]
    assert samples_since(structure, np.array([[0.0], [1.0]])).tolist() == [1]
    assert samples_since(structure, np.zeros((5, 1))).tolist() == [LONG_AGO]


def test_an_mv_in_manual_has_nothing_to_keep():
    structure = structure_of((1, 1), "moves", integer_values=((0.0, 1.0, 5.0),), dwell=(3,))
    (held,) = actuators_of(structure, np.array([2.3]), np.array([1]), np.array([True]))
    assert held == Actuator()
