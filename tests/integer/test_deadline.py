"""Time limits as deadlines, and why a plan is not proven where no limit was reached."""

import math
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from jaxmpc.controller.case import make_case
from jaxmpc.controller.plan import Planner
from jaxmpc.integer import branch_and_bound, enumeration
from jaxmpc.integer.host_search import Offload
from jaxmpc.integer.scheduling import run
from jaxmpc.integer.tighten import chord_weights
from jaxmpc.programs import clock
from jaxmpc.programs.pace import CALL, Pace
from tests import problems
from tests.oracles import steps as oracles

LATE = 2e-3  # s that a step may end after its limit


def planner_of(body):
    """A planner and the arguments of one step."""
    case = make_case(body)
    step = {k: getattr(case, k) for k in ("mv_now", "last_move", "free_response", "setpoint", "gap")}
    return Planner(case.structure, case.tuning, case.model), step


def long_step(seed=0):
    """Two stepped MVs without blocking, moves of several steps: seconds of search."""
    body = problems.small_case(np.random.default_rng(seed), blocks=[1] * 6, integer={0: 2.0, 1: 0.5})
    body["tuning"]["move_low"], body["tuning"]["move_high"] = [-4.0, -1.0], [4.0, 1.0]
    return body


def test_a_pace_is_learnt_from_calls_and_tells_what_fits():
    pace = Pace(32, 512)
    careful = pace.step
    pace.took(0.1e-3 * (20 + CALL), 20)
    assert pace.step == pytest.approx(0.1e-3)
    assert pace.step < careful
    assert pace.steps_within(None) == math.inf
    assert pace.steps_within(5e-3) == 50 - CALL
    assert pace.steps_within(0.0) == pace.always > 0
    assert not pace.fits(1e-4)
    assert pace.fits(None)
    assert pace.lanes_within(10.1 * pace.lane) == 10
    pace.took(1.0, 10)  # somebody else kept the machine busy
    assert pace.step <= 0.4e-3 * (1 + 1e-9)
    for _ in range(20):
        pace.took(0.1e-3 * (20 + CALL), 20)
    assert pace.step == pytest.approx(0.1e-3, rel=1e-3)


def test_what_a_step_takes_after_its_search_is_kept_for_it():
    pace = Pace(32, 512)
    before = pace.tail
    assert pace.before_tail(None) is None
    assert pace.before_tail(0.0) == 0.0
    pace.ended(2e-3)
    assert pace.before_tail(0.1) == pytest.approx(0.1 - before - 1e-3)
    for _ in range(1000):
        pace.ended(-1e-3)
    assert pace.tail == 0.0


def test_a_step_ends_at_its_limit_with_the_best_plan_and_its_true_gap(monkeypatch):
    # of this process: others may keep the machine busy
    monkeypatch.setattr(clock, "time", SimpleNamespace(perf_counter=time.process_time))
    body = long_step()
    planner, step = planner_of(body)
    best = planner.solve(**step)
    assert best.status == "optimal"
    for limit in (0.1, 0.02, 5e-3):
        took = []
        for _ in range(8):
            plan = planner.solve(**step, time_limit=limit)
            took.append(plan.solve_time_s)
            assert plan.status in ("limit", "optimal")
            assert oracles.violation(body, plan.moves) <= oracles.FEASIBLE
            assert plan.objective >= best.objective * (1.0 - 1e-6)
            assert plan.bound <= best.objective * (1.0 + 1e-6)
            if plan.status == "limit":
                assert "time limit" in plan.reason
                assert plan.gap > 1e-6
        assert min(took) <= limit + LATE


def test_a_programme_that_does_not_fit_the_time_left_is_not_begun():
    assert chord_weights(np.eye(30), 1e-3) is None
    assert chord_weights(np.eye(6), 60.0) is not None


def test_what_is_not_stopped_by_a_time_limit_says_what_stopped_it(monkeypatch):
    planner, step = planner_of(long_step())
    monkeypatch.setattr(enumeration, "MOST", 1)
    monkeypatch.setattr(branch_and_bound, "LISTED", 1)
    monkeypatch.setattr(branch_and_bound, "HELD", 0)
    for limit in (None, 600.0):
        plan = planner.solve(**step, time_limit=limit)
        assert plan.status == "unproven"
        assert "memory" in plan.reason
        assert plan.finished_by is None
        assert plan.gap > 1e-6


def test_work_in_a_thread_that_outlasts_the_limit_is_left_alone():
    ended = threading.Event()
    search: Any = SimpleNamespace(
        spent=0.0, clock=None, stopped=False, time_limit=0.01, seconds_left=lambda: 0.01
    )

    def steps():
        answer = yield Offload(lambda: ended.wait(60.0))
        return "left alone" if answer is None else "waited for"

    nothing: Any = None
    assert run(nothing, nothing, [(0, search, steps())]) == ["left alone"]
    assert search.stopped
    ended.set()


def test_an_infeasible_step_says_so():
    rng = np.random.default_rng(1)
    body = problems.small_case(rng, blocks=[1, 1, 2, 2])
    problems.TWISTS["forced_moves_beyond_the_limit"](body, rng)
    planner, step = planner_of(body)
    plan = planner.solve(**step)
    assert plan.status == "infeasible"
    assert "no moves satisfy the hard limits" in plan.reason
