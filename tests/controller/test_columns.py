"""Blocks of each MV and integer horizons against brute force over the whole moves, by every way to finish."""

import dataclasses
import itertools
import json

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse as sp

from jaxmpc import html, status
from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.case import case_to_dict, make_case, plan_to_dict
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.plan import Planner
from jaxmpc.errors import InputError
from jaxmpc.integer.chain import chains_of
from jaxmpc.integer.followed import followed
from jaxmpc.loop.simulate import simulate
from jaxmpc.problem.blocking import sample_moves
from jaxmpc.problem.layout import Size, layout_of
from jaxmpc.problem.structure import Structure
from jaxmpc.process.reference import Reference
from jaxmpc.process.well.plant import WellPlant
from tests import problems
from tests.controller.test_plan import FINISHES, solve
from tests.five_controllers import START, tuned
from tests.oracles import steps as oracles
from tests.posed import condensed, instance_of, pose_case

OWN = {"u0": [1, 1, 2, 2], "u1": [2, 1, 3]}
COLUMNS = {  # blocks, integer horizon, integer MVs
    "own blocks": (OWN, None, {0: 2.0}),
    "own blocks, two integers": (OWN, None, {0: 2.0, 1: 0.5}),
    "horizon": ([1, 1, 2, 2], 2, {0: 2.0}),
    "horizon of one move": ([1, 1, 2, 2], 1, {0: 2.0}),
    "horizon of one MV": ([1, 1, 2, 2], {"u1": 3}, {0: 2.0, 1: 0.5}),
    "horizons within own blocks": (OWN, {"u0": 2, "u1": 3}, {0: 2.0, 1: 0.5}),
}
SITUATIONS = (
    "half_a_step_away",
    "active_cv_limits",
    "move_limits_between_steps",
    "on_the_low_limit_with_drift",
)
SLOW_SITUATIONS = sorted(set(problems.TWISTS) - set(SITUATIONS))


def columns_case(seed: int, name: str, blocking: str, *twists: str) -> dict:
    """A small random case with these blocks and horizons."""
    rng = np.random.default_rng(seed)
    blocks, horizon, integer = COLUMNS[name]
    body = problems.small_case(rng, blocks=[1, 1, 2, 2], blocking=blocking, integer=integer)
    body["structure"]["blocks"] = blocks
    if horizon is not None:
        body["structure"]["integer_horizon"] = horizon
    for twist in twists:
        problems.TWISTS[twist](body, rng)
    return body


def complaints(body: dict, finish: str) -> list[str]:
    plan = solve(body, finish)
    found = oracles.complaints(body, plan, oracles.brute_force(body))
    if plan.moves is not None:
        for mv, blocks in enumerate(oracles.read(body).lists):
            assert not plan.moves[len(blocks) :, mv].any()
    return [*found, json.dumps(body)] if found else []


@pytest.mark.parametrize("finish", FINISHES)
@pytest.mark.parametrize("blocking", ["moves", "inputs"])
@pytest.mark.parametrize("name", COLUMNS)
def test_every_way_to_finish_is_exact(name, blocking, finish):
    for seed, twist in enumerate(SITUATIONS):
        assert complaints(columns_case(seed, name, blocking, twist), finish) == []


@pytest.mark.slow
@pytest.mark.parametrize("twist", SLOW_SITUATIONS)
@pytest.mark.parametrize("name", ["horizon of one move", "horizons within own blocks"])
def test_steps_are_optimal_in_every_situation(name, twist):
    for seed, blocking in enumerate(("moves", "inputs")):
        assert complaints(columns_case(100 + seed, name, blocking, twist), "auto") == []


@pytest.mark.parametrize("blocking", ["moves", "inputs"])
def test_scip_agrees_where_moves_are_too_many_to_try(blocking):
    rng = np.random.default_rng(11)
    body = problems.small_case(rng, hp=20, hu=16, blocks=[1] * 4 + [2, 2, 4, 4], blocking=blocking)
    body["structure"]["integer_horizon"] = 6
    body["structure"]["blocks"] = {"u0": [1] * 4 + [2, 2, 4, 4], "u1": [2, 6, 8]}
    body["tuning"]["move_weight"] = [0.1 * weight for weight in body["tuning"]["move_weight"]]
    assert oracles.complaints(body, solve(body), oracles.solve_scip(body)) == []


# ------------------------------------------------------------------------------------------ the integer horizon


def test_a_plan_says_how_far_its_moves_are_whole():
    body = columns_case(1, "horizons within own blocks", "moves")
    plan = solve(body)
    assert plan.integer_until.tolist() == [2, 3]
    steps = plan.moves / [2.0, 0.5]
    assert np.abs(steps - np.round(steps))[[0, 1, 0, 1], [0, 0, 1, 1]].max() < 1e-9
    assert plan_to_dict(plan)["integer_until"] == [2, 3]
    assert "whole in the first 2 of 6 samples only" in html.plan(plan)


def test_a_plan_without_relaxed_moves_says_nothing_of_them():
    plan = solve(columns_case(1, "own blocks", "moves"))
    assert plan.integer_until is None
    assert "integer_until" not in plan_to_dict(plan)
    assert "whole in the first" not in html.plan(plan)


@pytest.mark.parametrize("horizon", [5, 6, 300])
def test_a_horizon_that_no_block_begins_after_leaves_nothing_relaxed(horizon):
    body = columns_case(2, "own blocks, two integers", "moves", "half_a_step_away")
    whole = solve(body)
    body["structure"]["integer_horizon"] = horizon
    same = solve(body)
    assert same.integer_until is None
    np.testing.assert_array_equal(same.moves, whole.moves)
    assert same.objective == whole.objective


def test_objectives_rise_with_the_horizon_from_the_relaxed_to_the_whole_problem():
    found = []
    for horizon in (1, 2, 3, 5):
        body = columns_case(3, "own blocks, two integers", "moves", "half_a_step_away")
        body["structure"]["integer_horizon"] = horizon
        found.append(solve(body).objective)
    whole = solve(columns_case(3, "own blocks, two integers", "moves", "half_a_step_away")).objective
    relaxed = columns_case(3, "own blocks, two integers", "moves", "half_a_step_away")
    relaxed["structure"]["integer_step"] = {}
    relaxed["tuning"]["oscillation_rows"] = {}
    values = [solve(relaxed).objective, *found, whole]
    assert (np.diff(values) >= -2e-6 * whole).all()
    assert values[-1] > values[0] * (1 + 1e-3)


def test_whole_moves_leave_what_the_relaxed_ones_after_them_need():
    """Moves up are forced from the start, and the relaxed ones have no room to come back: few whole steps fit."""
    body = columns_case(4, "horizon", "moves")
    tuning, now = body["tuning"], body["mv_now"][0]
    tuning["move_low"][0], tuning["move_high"][0] = 0.7, 4.0  # of steps of 2: one whole step at least
    tuning["mv_low"][0], tuning["mv_high"][0] = now - 1.0, now + 7.5  # 0.7 in each of four relaxed samples
    tuning["oscillation_rows"] = {}
    posed = pose_case(body)
    (chain,) = chains_of(make_case(body).structure, posed.size, posed.instance)
    assert chain.high.tolist() == [3, 2]
    for finish in FINISHES:
        assert complaints(body, finish) == []
    tuning["mv_high"][0] = now + 6.0
    assert solve(body).status == "infeasible"


def test_oscillation_rows_end_with_the_whole_moves():
    for seed in range(6):
        body = columns_case(seed, "horizon of one move", "moves", "light_move_weight", "half_a_step_away")
        body["tuning"]["oscillation_rows"] = {"u0": True}
        assert complaints(body, "auto") == []


@pytest.mark.parametrize("finish", FINISHES)
def test_mean_moves_over_whole_and_relaxed_moves_are_kept(finish):
    """The windows of the predictive limit couple whole moves with the relaxed ones that follow."""
    for seed, (low, high, limit) in enumerate([(-2.0, 2.0, 1.0), (0.4, 4.0, 2.1), (-4.0, 4.0, 1.5)]):
        body = columns_case(seed, "horizon", "moves", "light_move_weight")
        body["tuning"]["oscillation_rows"] = {}
        body["tuning"]["move_low"][0], body["tuning"]["move_high"][0] = low, high
        body["tuning"]["mv_high"][0] = body["mv_now"][0] + 30.0
        body["setpoint"] = (np.array(body["setpoint"]) + 5.0).tolist()
        case, past = make_case(body), np.array([[2.0, 0.0], [0.0, 0.0]])
        structure = dataclasses.replace(case.structure, mean_move_mode="predictive", mean_move_window=3)
        tuning = dataclasses.replace(case.tuning, mean_move_limit=np.array([limit, np.inf]))
        planner = Planner(structure, tuning, case.model)
        known = dict(mv_now=case.mv_now, last_move=case.last_move)
        known |= dict(free_response=case.free_response, setpoint=case.setpoint)
        plan = planner.solve(**known, past_moves=past, finish=finish)
        assert plan.status == "optimal"
        made = np.concatenate([past[:, 0], oracles.sample_moves(body, plan.moves)[:, 0]])
        assert np.abs(np.convolve(made, np.ones(3), "valid")).max() <= 3 * limit + 1e-6
        assert oracles.violation(body, plan.moves) <= oracles.FEASIBLE
        assert plan.objective == pytest.approx(_windowed_optimum(body, past[:, 0], 3, limit), rel=2e-6)


def test_whole_moves_can_be_followed_where_a_linear_programme_over_samples_says_so():
    """Windows that move blocks straddle, positions and limits of the relaxed moves, against their samples."""
    body = columns_case(1, "horizon", "moves")
    body["structure"] |= {"control_horizon": 9, "blocks": [1, 1, 2, 2, 3]}
    body["tuning"] |= {"oscillation_rows": {}}
    body["tuning"]["move_low"][0], body["tuning"]["move_high"][0] = -4.0, -0.9
    body["tuning"]["mv_low"][0] = body["mv_now"][0] - 17.0
    case = make_case(body)
    structure = dataclasses.replace(case.structure, mean_move_mode="predictive", mean_move_window=4)
    tuning = dataclasses.replace(case.tuning, mean_move_limit=np.array([2.2, np.inf]))
    size = Size.of(structure, 8)
    layout, none = layout_of(structure, size), np.zeros((size.past, 2))
    qp = condensed(layout, size, tuning, np.zeros((2, 2, size.future)))
    step = dict(free_response=none, setpoint=none, mv_now=case.mv_now, last_move=np.zeros(2), past_moves=none)
    instance = instance_of(layout, size, tuning, qp, **step)
    samples, answers = sample_moves(structure), []
    for d in itertools.product((-2.0, -1.0), repeat=2):
        made = np.cumsum(samples[:, :2] @ d) * 2.0
        windows = np.array([made[k] - (made[k - 4] if k > 3 else 0.0) for k in range(9)])
        tail = samples[:, 2:]
        position = np.cumsum(tail, axis=0)
        shares = position - np.concatenate([np.zeros((4, 3)), position[:-4]])
        rows = np.concatenate([position, -position, shares, -shares])
        limits = np.concatenate([0.0 * made + 1e9, made + 17.0, 8.8 - windows, 8.8 + windows])
        found = scipy.optimize.linprog(np.zeros(3), rows, limits, bounds=[(-4.0, -0.9)] * 3)
        answers.append(found.status == 0)
        assert followed(structure, size, qp.rows, instance, np.array(d)) == answers[-1]
    assert len(set(answers)) == 2


def _windowed_optimum(body: dict, past, window: int, limit: float) -> float:
    """The least cost over whole moves of u0 with a limit of the mean of its moves in every window."""
    form, n = oracles.full_form(body), oracles.read(body)
    rows, low, high = [], [], []
    for k in range(n.hu):
        row, before = np.zeros(len(form.c)), past[len(past) - max(window - 1 - k, 0) :].sum()
        for sample in range(max(k + 1 - window, 0), k + 1):
            row[2 * sample] = form.units[0]  # moves of the samples come first, MV by MV
        rows.append(row)
        low.append(-window * limit - before)
        high.append(window * limit - before)
    form = dataclasses.replace(
        form,
        A=sp.csr_matrix(sp.vstack([form.A, np.array(rows)])),
        row_low=np.concatenate([form.row_low, low]),
        row_high=np.concatenate([form.row_high, high]),
    )
    best = np.inf
    for plan in oracles.integer_plans(body, 0):
        found = oracles.solve_qp(body, "clarabel", np.array(plan), form)
        best = min(best, found.objective if found.status == "optimal" else np.inf)
    return best


def test_horizons_of_one_size_are_lanes_of_one_batch(small_structure, well_like_model, thesis_fields):
    change = dataclasses.replace
    structures = [
        small_structure,
        change(small_structure, integer_horizon=3),
        change(small_structure, blocks=((1, 1, 2, 4, 4, 8), (2, 6, 12)), integer_horizon=1),
        change(small_structure, blocks=((2, 2, 16), (1, 1, 2, 4, 12)), blocking="inputs"),
    ]
    tunings = [tuned(s, thesis_fields, move_weight=[1.0, 0.2]) for s in structures]
    together = Controllers(structures, tunings, well_like_model)
    setpoint = START[0] + np.array([900.0, 6.0])
    state = together.init(*(np.tile(start, (4, 1)) for start in START))
    alone = [Controller(s, t, well_like_model) for s, t in zip(structures, tunings, strict=True)]
    states = [single.init(*START) for single in alone]
    for k in range(4):
        measured = START[0] + np.array([150.0, -2.0]) * np.sin(0.5 * k)
        state, info = together.step(state, np.tile(measured, (4, 1)), np.tile(setpoint, (4, 1)))
        for lane, single in enumerate(alone):
            states[lane], own = single.step(states[lane], measured, setpoint)
            assert info.status[lane] == own.status == status.OPTIMAL
            assert info.objective[lane] == pytest.approx(own.objective, rel=3e-6)
            assert info.mv[lane, 0] == pytest.approx(own.mv[0], abs=1e-9)
            steps = info.moves[lane][:, 0] / 2.0
            whole = structures[lane].whole_blocks(0)
            assert np.abs(steps - np.round(steps))[:whole].max() < 1e-9


@pytest.mark.parametrize("blocking", ["moves", pytest.param("inputs", marks=pytest.mark.slow)])
def test_a_loop_moves_by_whole_steps_and_its_plans_end_relaxed(
    small_structure, well_like_model, thesis_fields, blocking
):
    structure = dataclasses.replace(
        small_structure, blocking=blocking, blocks=((1, 1, 2, 4, 4, 8), (4, 4, 12)), integer_horizon=2
    )
    tuning = tuned(structure, thesis_fields, move_weight=[1.0, 0.2])
    reference = Reference([0.0, 40.0], START[0] + np.array([[0.0, 0.0], [900.0, 6.0]]), 200.0)
    controller = Controller(structure, tuning, well_like_model)
    run = simulate(controller, WellPlant(actuator="step"), reference, keep_plans=True)
    assert (run.status == status.OPTIMAL).all()
    assert (run.gap <= 1e-6).all()
    steps = run.move[:, 0] / 2.0
    assert np.abs(steps).max() > 0.5
    assert np.abs(steps - np.round(steps)).max() < 1e-9
    later = run.plan[:, 2:, 0] / 2.0
    assert np.abs(later - np.round(later)).max() > 1e-3
    assert not run.plan[:, 3:, 1].any()


# -------------------------------------------------------------------------------------------- blocks of each MV


@pytest.mark.parametrize("blocking", ["moves", "inputs"])
def test_splitting_blocks_of_an_mv_whose_moves_are_forced_equal_changes_nothing(blocking):
    body = columns_case(6, "own blocks", blocking, "half_a_step_away")
    held = 0.0 if blocking == "inputs" else 0.01
    body["tuning"]["move_low"][1] = body["tuning"]["move_high"][1] = held
    body["tuning"]["mv_low"][1] = body["tuning"]["mv_high"][1] = None
    plans = []
    for blocks in ([6], [2, 1, 3], [1] * 6):
        body["structure"]["blocks"] = {"u0": [1, 1, 2, 2], "u1": blocks}
        plans.append(solve(body))
    assert len({plan.moves[:4, 0].tobytes() for plan in plans}) == 1
    assert [plan.objective for plan in plans] == pytest.approx([plans[0].objective] * 3, rel=1e-9)


def test_finer_blocks_of_one_mv_never_cost():
    values = []
    for blocks in ([6], [2, 4], [2, 1, 3], [1, 1, 1, 1, 1, 1]):
        body = columns_case(7, "own blocks", "moves")
        body["structure"]["blocks"] = {"u0": [1, 1, 2, 2], "u1": blocks}
        values.append(solve(body).objective)
    assert (np.diff(values) <= 2e-6 * values[0]).all()
    assert values[-1] < values[0]


# --------------------------------------------------------------------------------------------------- case files


@pytest.mark.parametrize("name", COLUMNS)
def test_a_case_file_reads_back_as_it_was_written(name):
    case = make_case(columns_case(8, name, "moves", "plausible_start"))
    again = make_case(json.loads(json.dumps(case_to_dict(case))))
    assert again.structure == case.structure
    assert ("integer_horizon" in case_to_dict(case)["structure"]) == (COLUMNS[name][1] is not None)


@pytest.mark.parametrize(
    ("key", "given", "field", "expected"),
    [
        ("blocks", {"u0": [1, 5]}, "structure.blocks.u1", ["its own", "samples"]),
        ("blocks", {"u0": [1, 5], "u2": [6]}, "structure.blocks.u2", ["u0, u1"]),
        ("blocks", {"u0": [1, 5], "u1": [2, 3]}, "structure.blocks.u1", ["control_horizon = 6", "5"]),
        ("blocks", {"u0": [1, 5], "u1": [2, 4.5]}, "structure.blocks.u1[1]", ["a whole number", "samples"]),
        ("blocks", {"u0": [1, 5], "u1": 6}, "structure.blocks.u1", ["a list", "samples"]),
        ("blocks", [[1, 5], [6]], "structure.blocks[0]", ["a whole number", "samples"]),
        ("blocks", 6, "structure.blocks", ["a list", "samples"]),
        ("integer_horizon", 0, "structure.integer_horizon.u0", ["1 or more"]),
        ("integer_horizon", 1.5, "structure.integer_horizon", ["a whole number", "samples"]),
        ("integer_horizon", {"u0": True}, "structure.integer_horizon.u0", ["whole number of samples"]),
        ("integer_horizon", {"u0": None}, "structure.integer_horizon.u0", ["leave an MV out"]),
        ("integer_horizon", {"u1": 2}, "structure.integer_horizon.u1", ["integer_step", "u0"]),
    ],
)
def test_blocks_and_horizons_that_make_no_sense_are_refused(key, given, field, expected):
    body = columns_case(9, "horizon", "moves")
    body["structure"][key] = given
    with pytest.raises(InputError) as caught:
        make_case(body)
    assert caught.value.field == field
    assert all(words in str(caught.value) for words in expected), str(caught.value)


def test_horizons_of_continuous_mvs_say_nothing():
    names = dict(cv_names=("y",), mv_names=("u0", "u1"), control_horizon=4, blocks=(1, 3))
    structure = Structure(**names, integer_step=(2.0, None), integer_horizon=1)
    assert structure.integer_horizon == (1, None)
    assert structure.integer_until == (1, 0)
    assert structure.relaxed() == Structure(**names)
    with pytest.raises(InputError, match="2 entries, one per MV"):
        Structure(**names, integer_horizon=(1, 2, 3))
    with pytest.raises(InputError, match="a whole number of samples"):
        Structure(**names, integer_horizon=True)
