"""Steps of actuators that have lists of allowed values and a minimum dwell, by every way to finish, against brute force."""

import copy
import json

import numpy as np
import pytest

from jaxmpc.controller.case import case_to_dict, make_case
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.plan import Planner, solve_plan
from jaxmpc.errors import InputError
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.values import has_gaps, positions, spacing
from tests import problems
from tests.oracles import actuators

FINISHES = ("auto", "enumeration", "highs", "branch-and-bound")
SHAPES = {
    "siso": dict(cvs=1, mvs=1, hu=4, integer={0: 1.0}),
    "two by two": dict(blocks=[1, 1, 2], hu=4),
    "two by two, inputs": dict(blocks=[1, 1, 3], hu=5, blocking="inputs"),
    "long first block": dict(blocks=[2, 1, 2], hu=5, cvs=1),
    "two integers": dict(blocks=[1, 1, 1], hu=3, integer={0: 2.0, 1: 0.5}),
}


def listed(rng, shape: str, *, ties: bool = False) -> dict:
    """A random case whose integer MVs have a list, a dwell or both; with ties, the model and all costs are whole numbers."""
    body = problems.small_case(rng, **SHAPES[shape])
    structure, tuning, names = body["structure"], body["tuning"], body["model"]["mv"]
    tuning["oscillation_rows"] = {}
    structure["integer_values"], structure["dwell"] = {}, {}
    for name, step in list(structure["integer_step"].items()):
        m, kind = names.index(name), rng.integers(3)
        if kind < 2:
            at = np.unique(np.append(rng.integers(-6, 7, rng.integers(1, 4)), [0, 3]))
            structure["integer_values"][name] = (body["mv_now"][m] + step * at).tolist()
            del structure["integer_step"][name]
            for key, side in (("mv_low", -1), ("mv_high", 1)):
                limit = body["mv_now"][m] + side * step * int(rng.integers(0, 8))
                tuning[key][m] = None if rng.random() < 0.5 else float(limit)
        if kind > 0:
            structure["dwell"][name] = int(rng.integers(2, 5))
        most = float(step * rng.integers(2, 12 if kind < 2 else 3))
        tuning["move_low"][m], tuning["move_high"][m] = -most, most
        if rng.random() < 0.2 or ties:
            tuning["move_weight"][m] = 0.0
    if rng.random() < 0.5:
        body["last_move"] = [0.0] * len(names)
    if rng.random() < 0.7:
        body["samples_since_move"] = [int(rng.integers(1, 6)) if rng.random() < 0.7 else None for _ in names]
    if ties:
        for row in body["model"]["coefficients"]:
            row[:] = [np.round(entry).tolist() for entry in row]
        body["free_response"] = np.round(body["free_response"]).tolist()
        body["setpoint"] = np.round(body["setpoint"]).tolist()
        tuning["cv_weight"] = [1.0] * len(tuning["cv_weight"])
        tuning["soft_linear"] = [0.0] * len(tuning["cv_weight"])
    return body


def solve(body: dict, finish: str = "auto"):
    """The library's plan for the content of a case file."""
    case = make_case(body)
    given = {key: getattr(case, key) for key in ("mv_now", "last_move", "free_response", "setpoint")}
    return solve_plan(
        case.model,
        case.structure,
        case.tuning,
        **given,
        samples_since_move=case.samples_since_move,
        finish=finish,
    )


@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_every_way_to_finish_finds_the_best_plan_of_list_and_dwell(shape, ties):
    restricted = 0
    for seed in range(4):
        body = listed(np.random.default_rng([seed, len(shape)]), shape, ties=ties)
        best = actuators.brute_force(body)
        for finish in FINISHES:
            plan = solve(body, finish)
            assert actuators.complaints(body, plan, best) == [], (finish, json.dumps(body))
        restricted += make_case(body).structure.has_gaps_or_dwell
    assert restricted > 1


def test_an_evenly_spaced_list_is_its_step_and_its_limits():
    rng = np.random.default_rng(5)
    for _ in range(6):
        stepped = problems.small_case(rng, blocks=[1, 1, 2, 2])
        now, step = stepped["mv_now"][0], 2.0
        ends = now - step * int(rng.integers(0, 4)), now + step * int(rng.integers(1, 4))
        even = copy.deepcopy(stepped)
        even["structure"]["integer_step"] = {}
        even["structure"]["integer_values"] = {"u0": np.arange(ends[0], ends[1] + 1.0, step).tolist()}
        even["tuning"]["mv_low"][0] = even["tuning"]["mv_high"][0] = None
        stepped["tuning"]["mv_low"][0], stepped["tuning"]["mv_high"][0] = ends
        for finish in ("auto", "branch-and-bound"):
            one, other = solve(stepped, finish), solve(even, finish)
            for key in ("status", "objective", "bound", "nodes", "finished_by"):
                assert getattr(one, key) == getattr(other, key)
            np.testing.assert_array_equal(one.moves, other.moves)


def on_off() -> dict:
    """A pump that is on or off, with a dwell of three samples."""
    body = problems.small_case(np.random.default_rng(3), cvs=1, mvs=1, hu=6, integer={0: 1.0})
    body["structure"] |= {"integer_step": {}, "integer_values": {"u0": [0.0, 1.0]}, "dwell": {"u0": 3}}
    body["tuning"] |= {"oscillation_rows": {}, "mv_low": [None], "mv_high": [None], "move_weight": [0.0]}
    body["tuning"] |= {"cv_low": [None], "cv_high": [None], "deadzone": [0.0], "soft_linear": [0.0]}
    body |= {"mv_now": [0.0], "last_move": [0.0]}
    body["model"]["coefficients"] = [[[1.0] * 8]]
    body["free_response"] = [[0.0]] * 8
    body["setpoint"] = [[1.0], [0.0], [1.0], [0.0], [1.0], [0.0], [1.0], [0.0]]  # without dwell it is met
    return body


def test_a_pump_stays_on_or_off_for_its_dwell_and_remembers_the_past():
    body = on_off()
    plan = solve(body)
    at = np.flatnonzero(plan.moves[:, 0])
    assert len(at)
    assert (np.diff(at) >= 3).all()
    assert actuators.complaints(body, plan, actuators.brute_force(body)) == []
    for since, first in ((1, 2), (2, 1), (3, 0)):
        plan = solve(body | {"samples_since_move": [since]})
        assert (plan.moves[:first] == 0).all()
    held = solve(body | {"mv_now": [1.0], "last_move": [1.0]})  # it has just moved, whatever else is said
    assert (held.moves[:2] == 0).all()
    del body["structure"]["dwell"]
    assert solve(body).objective < plan.objective


def test_past_moves_count_for_the_dwell():
    # on for four samples: no other plan costs as little
    case = make_case(on_off() | {"setpoint": [[1.0]] * 4 + [[0.0]] * 4})
    planner = Planner(case.structure, case.tuning, case.model)
    given = {key: getattr(case, key) for key in ("mv_now", "last_move", "free_response", "setpoint")}
    plan = planner.solve(**given, past_moves=np.array([[1.0], [-1.0], [0.0]]))
    assert plan.moves is not None
    assert plan.moves[0, 0] == 0
    assert planner.solve(**given, past_moves=np.array([[-1.0], [0.0], [0.0]])).moves[0, 0] != 0  # pyright: ignore


def test_a_case_with_lists_and_dwell_is_written_and_read_again():
    body = listed(np.random.default_rng(8), "two integers")
    body["structure"]["integer_values"]["u0"] = [v + body["mv_now"][0] for v in (-4.0, 0.0, 6.0)]
    body["structure"]["integer_step"].pop("u0", None)
    body["structure"]["dwell"] = {"u0": 2, "u1": 1}
    body["samples_since_move"] = [2, None]
    case = make_case(body)
    again = make_case(json.loads(json.dumps(case_to_dict(case))))
    assert again.structure == case.structure
    assert again.samples_since_move == (2, None)
    assert case.structure.dwell == (2, 1)


REFUSED = [
    ("integer_values", {"u0": [0.0]}, "structure.integer_values.u0", ["two or more", "MV unit"]),
    ("integer_values", {"u0": 4.0}, "structure.integer_values.u0", ["two or more"]),
    ("integer_values", {"u0": [0.0, 0.0, 1.0]}, "structure.integer_values.u0[1]", ["more than 0"]),
    ("integer_values", {"u0": [0.0, float("nan")]}, "structure.integer_values.u0[1]", ["finite"]),
    ("integer_values", {"u0": [0.0, True]}, "structure.integer_values.u0[1]", ["finite"]),
    ("integer_values", {"u0": [0.0, 1.0, 1.00001]}, "structure.integer_values.u0", ["5000 points", "Round"]),
    ("integer_values", {"u0": None}, "structure.integer_values.u0", ["a list of values"]),
    ("integer_values", {"x": [0.0, 1.0]}, "structure.integer_values.x", ["u0, u1"]),
    ("dwell", {"u0": 0}, "structure.dwell.u0", ["1 or more"]),
    ("dwell", {"u0": 2.5}, "structure.dwell.u0", ["whole number of samples"]),
    ("dwell", {"u1": 3}, "structure.dwell.u1", ["continuous"]),
    ("dwell", {"x": 3}, "structure.dwell.x", ["u0, u1"]),
    ("dwell", {"u0": None}, "structure.dwell.u0", ["whole number of samples"]),
]


@pytest.mark.parametrize(("key", "value", "field", "words"), REFUSED, ids=str)
def test_lists_and_dwells_that_make_no_sense_are_refused(key, value, field, words):
    body = problems.small_case(np.random.default_rng(1), blocks=[1, 1, 2, 2])
    body["structure"][key] = value
    if key == "integer_values":
        body["structure"]["integer_step"] = {}
        body["tuning"]["oscillation_rows"] = {}
    with pytest.raises(InputError) as caught:
        make_case(body)
    assert caught.value.field == field
    assert all(word in str(caught.value) for word in words), caught.value


def test_what_does_not_fit_a_list_or_a_dwell_is_refused_with_the_nearest_values():
    body = problems.small_case(np.random.default_rng(1), blocks=[1, 1, 2, 2])
    values = [body["mv_now"][0] + v for v in (-10.0, 0.0, 6.0, 40.0)]
    listed = copy.deepcopy(body)
    listed["structure"] |= {"integer_step": {}, "integer_values": {"u0": values}}

    def refused(body, field, *words):
        with pytest.raises(InputError) as caught:
            make_case(body)
        assert caught.value.field == field
        assert all(word in str(caught.value) for word in words), caught.value

    refused(
        listed | {"tuning": listed["tuning"] | {"oscillation_rows": {"u0": True}}},
        "tuning.oscillation_rows.u0",
        "uneven",
    )
    listed["tuning"]["oscillation_rows"] = {}
    listed["tuning"]["mv_high"][0] = None
    make_case(listed)
    off = body["mv_now"][0] + 2.0
    near = f"{values[1]:g} or {values[2]:g}"
    refused(listed | {"mv_now": [off, body["mv_now"][1]]}, "mv_now[0]", near, "integer_values.u0", "MV unit")
    refused(listed | {"samples_since_move": [1]}, "samples_since_move", "u0, u1")
    refused(listed | {"samples_since_move": [0, None]}, "samples_since_move[0]", "1 or more")
    both = copy.deepcopy(listed)
    both["structure"]["integer_step"] = {"u0": 2.0}
    refused(both, "structure.integer_values.u0", "integer_step (2)")
    still = copy.deepcopy(listed)
    still["structure"] |= {"blocks": [2, 2, 2], "dwell": {"u0": 2}}
    refused(still, "structure.dwell.u0", "could never move")
    still["structure"]["blocking"] = "inputs"
    make_case(still)


@pytest.mark.parametrize(
    ("values", "step", "at", "gaps"),
    [
        ((0.0, 10.0, 25.0, 60.0, 100.0), 5.0, [0, 2, 5, 12, 20], True),
        ((0.0, 1.0), 1.0, [0, 1], False),
        ((0.1, 0.4, 0.6), 0.1, [0, 3, 5], True),
        (tuple(k / 3 for k in range(5)), 1 / 3, [0, 1, 2, 3, 4], False),
        ((-7.5, 0.0, 5.0), 2.5, [0, 3, 5], True),
        ((1e6, 1.5e6, 3e6), 5e5, [0, 1, 4], True),
    ],
)
def test_a_list_is_a_grid_of_the_greatest_common_step_of_its_decimals(values, step, at, gaps):
    assert spacing(values) == pytest.approx(step, rel=1e-12)
    assert positions(values).tolist() == at
    assert has_gaps(values) == gaps


def test_a_structure_without_lists_and_dwell_is_the_one_it_was():
    given = dict(cv_names=("y",), mv_names=("u", "v"), prediction_horizon=4, control_horizon=2, blocks=(1, 1))
    plain = Structure(**given, integer_step=(2.0, None))
    assert plain == Structure(**given, integer_step=(2.0, None), integer_values=(None, None), dwell=(1, 1))
    assert plain.steps == (2.0, None)
    assert not plain.has_gaps_or_dwell
    lists = Structure(**given, integer_values=((0, 2, 6), None), dwell=(3, 1))
    assert lists.integer_mvs == (0,)
    assert lists.relaxed() == Structure(**given)
    assert Controller(Structure(**given), *_tuning_and_model(given)).core.layout.values is None


def _tuning_and_model(given):
    from jaxmpc.model.step_response import make_model
    from jaxmpc.problem.tuning import make_tuning

    structure = Structure(**given)
    model = make_model([[[1.0], [1.0]]], structure.dt, ["y"], ["u", "v"])
    return make_tuning(structure, cv_weight=1.0, move_weight=1.0), model
