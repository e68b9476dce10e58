"""The one-step case file: what is accepted; everything else is refused with the path of the field."""

import copy
import json
from types import SimpleNamespace

import numpy as np
import pytest

from jaxmpc.controller.case import case_to_dict, dump_case, load_case, make_case, plan_to_dict
from jaxmpc.errors import InputError
from tests import problems

NAN, INF = float("nan"), float("inf")


def valid() -> dict:
    """Two CVs, two MVs (u0 in steps of 2), Hp = 8, Hu = 6 in four blocks."""
    case = problems.small_case(np.random.default_rng(1), blocks=[1, 1, 2, 2])
    case["tuning"]["oscillation_rows"] = {"u0": True}
    case["previous_moves"] = [[2.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]
    case["limits"] = {"time_s": 10.0, "gap": 1e-4}
    return case


def at(body, path):
    """The container and the last key of a path such as ("tuning", "cv_weight", 0)."""
    for key in path[:-1]:
        body = body[key]
    return body, path[-1]


DROP = object()
ADD = object()

# path to change, new value, field in the error, words that the message must contain
REFUSED = [
    # unknown and missing fields
    (("extra",), 1, "extra", ["no such field"]),
    (("model", "name"), "x", "model.name", ["no such field", "coefficients"]),
    (("structure", "dt"), 10.0, "structure.dt", ["no such field"]),
    (("structure", "mean_move_window"), 25, "structure.mean_move_window", ["no such field"]),
    (("tuning", "cv_weights"), [1.0, 1.0], "tuning.cv_weights", ["no such field", "cv_weight"]),
    (("tuning", "bias_cutoff"), 0.05, "tuning.bias_cutoff", ["no such field"]),
    (("limits", "nodes"), 5, "limits.nodes", ["no such field", "time_s"]),
    (("model",), DROP, "model", ["missing"]),
    (("structure",), DROP, "structure", ["missing"]),
    (("tuning",), DROP, "tuning", ["missing"]),
    (("mv_now",), DROP, "mv_now", ["missing", "MV unit"]),
    (("last_move",), DROP, "last_move", ["missing", "MV unit"]),
    (("free_response",), DROP, "free_response", ["missing", "CV unit"]),
    (("setpoint",), DROP, "setpoint", ["missing", "CV unit"]),
    (("model", "dt"), DROP, "model.dt", ["missing", "[s]"]),
    (("model", "coefficients"), DROP, "model.coefficients", ["missing", "CV unit per MV unit"]),
    (("structure", "control_horizon"), DROP, "structure.control_horizon", ["missing", "samples"]),
    (("tuning", "move_weight"), DROP, "tuning.move_weight", ["missing", "1/MV unit^2"]),
    (("tuning", "mv_high"), DROP, "tuning.mv_high", ["missing", "MV unit"]),
    # the model
    (("model", "dt"), 0.0, "model.dt", ["0.0", "positive", "[s]"]),
    (("model", "dt"), -10.0, "model.dt", ["-10.0", "positive"]),
    (("model", "dt"), NAN, "model.dt", ["nan", "positive"]),
    (("model", "dt"), True, "model.dt", ["True", "a number", "[s]"]),
    (("model", "dt"), "10", "model.dt", ["'10'", "a number"]),
    (("model", "cv"), [], "model.cv", ["names"]),
    (("model", "cv"), ["y0", "y0"], "model.cv", ["y0", "distinct"]),
    (("model", "mv"), ["u0", "u0"], "model.mv", ["u0", "distinct"]),
    (("model", "mv"), ["u0", ""], "model.mv", ["non-empty"]),
    (("model", "mv"), ["u0", 3], "model.mv[1]", ["3", "text"]),
    (("model", "mv"), "u0", "model.mv", ["a list"]),
    (("model", "mv"), ["u0"], "model.coefficients", ["[2, 2, 8]", "[2][1]"]),
    (("model", "coefficients"), [], "model.coefficients", ["[2][2]"]),
    (("model", "coefficients", 0, 0), [], "model.coefficients", ["equal length"]),
    (("model", "coefficients", 0, 0), [1.0, 2.0], "model.coefficients", ["equal length"]),
    (("model", "coefficients", 1), [[], []], "model.coefficients", ["equal length"]),
    (("model", "coefficients", 0, 1, 2), NAN, "model.coefficients[0, 1, 2]", ["nan", "finite"]),
    (("model", "coefficients", 0, 1, 2), INF, "model.coefficients[0, 1, 2]", ["inf", "finite"]),
    (("model", "coefficients", 0, 1, 2), None, "model.coefficients[0][1][2]", ["None", "a number"]),
    (("model", "coefficients", 0, 1, 2), False, "model.coefficients[0][1][2]", ["False", "a number"]),
    (("model", "coefficients", 0, 1), 3.0, "model.coefficients[0][1]", ["3.0", "a list"]),
    # the structure
    (("structure", "prediction_horizon"), 0, "structure.prediction_horizon", ["0", "1 or more"]),
    (("structure", "prediction_horizon"), -8, "structure.prediction_horizon", ["-8"]),
    (("structure", "prediction_horizon"), 8.5, "structure.prediction_horizon", ["8.5", "whole", "samples"]),
    (("structure", "prediction_horizon"), True, "structure.prediction_horizon", ["True", "whole"]),
    (("structure", "prediction_horizon"), None, "structure.prediction_horizon", ["None", "whole"]),
    (("structure", "prediction_horizon"), 10**12, "structure.prediction_horizon", ["at most"]),
    (("structure", "control_horizon"), 0, "structure.control_horizon", ["0", "1 or more"]),
    (("structure", "control_horizon"), 10**12, "structure.control_horizon", ["at most"]),
    (("structure", "control_horizon"), 7, "structure.blocks", ["sum to control_horizon = 7", "6"]),
    (("structure", "first_penalised"), 0, "structure.first_penalised", ["0", "1 or more"]),
    (("structure", "first_penalised"), 9, "structure.first_penalised", ["9", "prediction_horizon = 8"]),
    (("structure", "blocks"), [1, 1, 2, 3], "structure.blocks", ["sum to control_horizon = 6", "7"]),
    (("structure", "blocks"), [1, 1, 4, 0], "structure.blocks", ["1 or more"]),
    (("structure", "blocks"), [1, 1, 5, -1], "structure.blocks", ["1 or more"]),
    (("structure", "blocks", 1), 1.5, "structure.blocks[1]", ["1.5", "whole", "samples"]),
    (("structure", "blocks", 1), True, "structure.blocks[1]", ["True", "whole"]),
    (("structure", "blocking"), "steps", "structure.blocking", ["steps", "'moves' or 'inputs'"]),
    (("structure", "blocking"), None, "structure.blocking", ["None", "text"]),
    (("structure", "integer_step"), {"choke": 2.0}, "structure.integer_step.choke", ["u0, u1"]),
    (("structure", "integer_step"), {"u0": 0.0}, "structure.integer_step.u0", ["0.0", "positive"]),
    (("structure", "integer_step"), {"u0": -2.0}, "structure.integer_step.u0", ["-2.0", "positive"]),
    (("structure", "integer_step"), {"u0": INF}, "structure.integer_step.u0", ["inf", "positive"]),
    (("structure", "integer_step"), {"u0": NAN}, "structure.integer_step.u0", ["nan", "positive"]),
    (("structure", "integer_step"), {"u0": True}, "structure.integer_step.u0", ["True", "positive"]),
    (("structure", "integer_step"), {"u0": "2"}, "structure.integer_step.u0", ["'2'", "positive"]),
    (("structure", "integer_step"), {"u0": None}, "structure.integer_step.u0", ["None", "positive"]),
    (("structure", "integer_step"), [2.0, None], "structure.integer_step", ["an object"]),
    # the tuning
    (("tuning", "cv_weight"), [1.0], "tuning.cv_weight", ["[1.0]", "2 numbers", "1/CV unit^2", "y0, y1"]),
    (("tuning", "cv_weight"), [1.0, 1.0, 1.0], "tuning.cv_weight", ["2 numbers"]),
    (("tuning", "cv_weight"), 1.0, "tuning.cv_weight", ["1.0", "a list", "1/CV unit^2"]),
    (("tuning", "cv_weight"), {"y0": 1.0, "y1": 1.0}, "tuning.cv_weight", ["a list"]),
    (("tuning", "cv_weight"), None, "tuning.cv_weight", ["None", "a list"]),
    (("tuning", "cv_weight", 1), -1e-4, "tuning.cv_weight[1]", ["-0.0001", "0 or more", "y1"]),
    (("tuning", "cv_weight", 1), NAN, "tuning.cv_weight[1]", ["nan", "1/CV unit^2"]),
    (("tuning", "cv_weight", 1), INF, "tuning.cv_weight[1]", ["inf", "finite"]),
    (("tuning", "cv_weight", 1), None, "tuning.cv_weight[1]", ["None", "a number", "1/CV unit^2"]),
    (("tuning", "cv_weight", 1), True, "tuning.cv_weight[1]", ["True", "a number"]),
    (("tuning", "cv_weight", 1), "0.1", "tuning.cv_weight[1]", ["'0.1'", "a number"]),
    (("tuning", "move_weight", 0), -1.0, "tuning.move_weight[0]", ["-1.0", "0 or more", "u0"]),
    (("tuning", "move_weight", 0), None, "tuning.move_weight[0]", ["None", "1/MV unit^2"]),
    (("tuning", "soft_quadratic", 0), -1.0, "tuning.soft_quadratic[0]", ["-1.0", "0 or more"]),
    (("tuning", "soft_quadratic", 0), None, "tuning.soft_quadratic[0]", ["None"]),
    (("tuning", "soft_linear", 0), -1.0, "tuning.soft_linear[0]", ["-1.0", "0 or more"]),
    (("tuning", "soft_linear", 0), None, "tuning.soft_linear[0]", ["None"]),
    (("tuning", "deadzone", 0), -5.0, "tuning.deadzone[0]", ["-5.0", "0 or more", "CV unit"]),
    (("tuning", "deadzone", 0), None, "tuning.deadzone[0]", ["None", "CV unit"]),
    (("tuning", "slack_weight", 0), -1.0, "tuning.slack_weight[0]", ["-1.0", "0 or more"]),
    (("tuning", "slack_weight", 0), None, "tuning.slack_weight[0]", ["None", "1/CV unit"]),
    (("tuning", "cv_low"), [1e9, 0.0], "tuning.cv_low[0]", ["1000000000.0", "at most cv_high[0]", "y0"]),
    (("tuning", "mv_low"), [0.0, 1e9], "tuning.mv_low[1]", ["1000000000.0", "at most mv_high[1]", "u1"]),
    (("tuning", "move_low"), [0.0, 1e9], "tuning.move_low[1]", ["at most move_high[1]", "per sample"]),
    (("tuning", "cv_low"), None, "tuning.cv_low", ["None", "a list"]),
    (("tuning", "mv_high", 1), NAN, "tuning.mv_high[1]", ["nan", "MV unit", "u1"]),
    (("tuning", "mv_high", 1), False, "tuning.mv_high[1]", ["False", "null"]),
    (("tuning", "mv_high"), [None], "tuning.mv_high", ["[None]", "2 numbers"]),
    (("tuning", "mv_low", 1), INF, "tuning.mv_low[1]", ["inf"]),
    (("tuning", "move_high"), [None, -INF], "tuning.move_low[1]", ["move_high[1] = -inf"]),
    (("tuning", "oscillation_rows"), {"u1": True}, "tuning.oscillation_rows.u1", ["True", "continuous"]),
    (("tuning", "oscillation_rows"), {"u9": True}, "tuning.oscillation_rows.u9", ["u0, u1"]),
    (("tuning", "oscillation_rows"), {"u0": 1}, "tuning.oscillation_rows.u0", ["1", "true or false"]),
    (("tuning", "oscillation_rows"), {"u0": None}, "tuning.oscillation_rows.u0", ["None", "true or false"]),
    (("tuning", "oscillation_rows"), [True, False], "tuning.oscillation_rows", ["an object"]),
    # the state
    (("mv_now",), [0.0], "mv_now", ["[0.0]", "2 numbers", "MV unit", "u0, u1"]),
    (("mv_now", 0), NAN, "mv_now[0]", ["nan", "finite", "MV unit"]),
    (("mv_now", 0), None, "mv_now[0]", ["None", "a number"]),
    (("mv_now", 0), True, "mv_now[0]", ["True", "a number"]),
    (("mv_now", 0), 1e6, "mv_now[0]", ["1000000.0", "mv_high[0] = ", "u0", "MV unit"]),
    (("mv_now", 1), -1e6, "mv_now[1]", ["-1000000.0", "mv_low[1] = ", "u1"]),
    (("last_move",), [0.0, 0.0, 0.0], "last_move", ["2 numbers", "MV unit"]),
    (("last_move", 1), INF, "last_move[1]", ["inf", "finite"]),
    (("last_move", 1), None, "last_move[1]", ["None"]),
    (("free_response", 7), DROP, "free_response", ["7 rows", "prediction_horizon = 8", "CV unit"]),
    (("free_response", 3), ADD, "free_response", ["9 rows", "prediction_horizon = 8"]),
    (("free_response", 3), [1.0], "free_response[3]", ["[1.0]", "2 numbers", "y0, y1"]),
    (("free_response", 3, 1), NAN, "free_response[3][1]", ["nan", "finite", "CV unit"]),
    (("free_response", 3, 1), None, "free_response[3][1]", ["None", "a number"]),
    (("free_response", 3), 1.0, "free_response[3]", ["1.0", "a list"]),
    (("setpoint",), [], "setpoint", ["0 rows", "prediction_horizon = 8"]),
    (("setpoint",), [1.0, 2.0], "setpoint[0]", ["a list"]),
    (("setpoint", 7), DROP, "setpoint", ["7 rows", "prediction_horizon = 8"]),
    (("setpoint", 0), ADD, "setpoint", ["9 rows", "prediction_horizon = 8"]),
    (("setpoint", 5, 0), INF, "setpoint[5][0]", ["inf", "finite", "CV unit"]),
    (("setpoint", 5, 0), "1", "setpoint[5][0]", ["'1'", "a number", "CV unit"]),
    (("previous_moves", 3), DROP, "previous_moves", ["3 rows", "blocks = 4", "per sample"]),
    (("previous_moves", 0), [1.0], "previous_moves[0]", ["2 numbers"]),
    (("previous_moves", 2, 1), NAN, "previous_moves[2][1]", ["nan", "finite"]),
    (("previous_moves", 2, 1), None, "previous_moves[2][1]", ["None"]),
    # the limits of the solve
    (("limits",), 60.0, "limits", ["60.0", "an object"]),
    (("limits", "time_s"), -1.0, "limits.time_s", ["-1.0", "[s]"]),
    (("limits", "time_s"), NAN, "limits.time_s", ["nan", "[s]"]),
    (("limits", "time_s"), INF, "limits.time_s", ["inf", "null"]),
    (("limits", "time_s"), "60", "limits.time_s", ["'60'", "a number"]),
    (("limits", "gap"), -1e-6, "limits.gap", ["-1e-06", "0 to 1"]),
    (("limits", "gap"), 1.5, "limits.gap", ["1.5", "0 to 1"]),
    (("limits", "gap"), NAN, "limits.gap", ["nan"]),
    (("limits", "gap"), None, "limits.gap", ["None", "a number"]),
    (("limits", "gap"), True, "limits.gap", ["True", "a number"]),
]


@pytest.mark.parametrize(
    ("path", "value", "field", "words"),
    REFUSED,
    ids=[f"{'.'.join(map(str, r[0]))}={str(r[1])[:20]}" for r in REFUSED],
)
def test_a_bad_field_is_refused_by_its_path_value_and_expectation(path, value, field, words):
    body = valid()
    container, key = at(body, path)
    if value is DROP:
        del container[key]
    elif value is ADD:
        container.insert(key, copy.deepcopy(container[key]))
    else:
        container[key] = value
    with pytest.raises(InputError) as caught:
        make_case(body)
    assert caught.value.field == field
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("body", [None, 3, "case", [], [{"model": {}}], True])
def test_a_case_that_is_no_object_is_refused(body):
    with pytest.raises(InputError, match="an object") as caught:
        make_case(body)
    assert caught.value.field == "case"


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b'{"model": }',
        b"\xff\xfe\x00\xd8",
        b"[" * 100_000,
        b'{"mv_now": ' + b"9" * 5000 + b"}",
        b"{} {}",
    ],
    ids=["empty", "cut off", "no value", "bad encoding", "deep nesting", "absurd number", "two objects"],
)
def test_text_that_is_no_json_is_refused(tmp_path, text):
    path = tmp_path / "case.json"
    path.write_bytes(text)
    with pytest.raises(InputError, match="a JSON object") as caught:
        load_case(path)
    assert caught.value.field == "case file"


def test_a_repeated_key_is_refused(tmp_path):
    path = tmp_path / "case.json"
    path.write_text(json.dumps(valid()).replace('"mv_now":', '"mv_now": [1.0, 2.0], "mv_now":'))
    with pytest.raises(InputError, match="this key once") as caught:
        load_case(path)
    assert caught.value.field == "mv_now"


@pytest.mark.parametrize("name", ["missing.json", "."])
def test_a_file_that_cannot_be_read_is_refused(tmp_path, name):
    with pytest.raises(InputError, match="a readable file"):
        load_case(tmp_path / name)


def test_a_number_beyond_float64_is_refused():
    body = valid()
    body["mv_now"][0] = 10**400
    with pytest.raises(InputError, match="finite number") as caught:
        make_case(body)
    assert caught.value.field == "mv_now[0]"


def test_a_case_reads_as_the_types_of_the_library():
    body = valid()
    case = make_case(body)
    assert case.structure.dt == case.model.dt == body["model"]["dt"]
    assert case.structure.mv_names == case.model.mv_names == ("u0", "u1")
    assert case.structure.integer_step == (2.0, None)
    assert case.structure.blocks == (1, 1, 2, 2)
    assert np.asarray(case.model.coefficients).tolist() == body["model"]["coefficients"]
    assert np.asarray(case.tuning.oscillation_rows).tolist() == [True, False]
    assert case.free_response.tolist() == body["free_response"]
    assert case.setpoint.tolist() == body["setpoint"]
    assert case.previous_moves is not None
    assert case.previous_moves.tolist() == body["previous_moves"]
    assert (case.time_limit, case.gap) == (10.0, 1e-4)


def test_optional_fields_may_be_left_out():
    body = valid()
    for table, key in (
        (body, "previous_moves"),
        (body, "limits"),
        (body["structure"], "integer_step"),
        (body["structure"], "blocks"),
        (body["tuning"], "oscillation_rows"),
    ):
        del table[key]
    case = make_case(body)
    assert case.previous_moves is None
    assert (case.time_limit, case.gap) == (None, 1e-6)
    assert case.structure.integer_mvs == ()
    assert case.structure.blocks == (1,) * 6
    assert not np.asarray(case.tuning.oscillation_rows).any()


def test_an_empty_integer_step_means_the_relaxed_problem():
    body = valid()
    body["structure"]["integer_step"] = {}
    body["tuning"]["oscillation_rows"] = {"u0": False}
    assert make_case(body).structure.integer_mvs == ()


def test_null_in_a_limit_vector_is_infinite():
    body = valid()
    for key in ("cv_low", "cv_high", "mv_low", "mv_high", "move_low", "move_high"):
        body["tuning"][key] = [None, None]
    tuning = make_case(body).tuning
    for key in ("cv", "mv", "move"):
        assert np.asarray(getattr(tuning, f"{key}_low")).tolist() == [-INF, -INF]
        assert np.asarray(getattr(tuning, f"{key}_high")).tolist() == [INF, INF]


def test_whole_numbers_count_as_numbers():
    body = valid()
    body["tuning"]["cv_weight"] = [1, 0]
    assert np.asarray(make_case(body).tuning.cv_weight).tolist() == [1.0, 0.0]


@pytest.mark.parametrize("drift", [1e-10, -1e-10, 4.65e-7, -4.65e-7])
@pytest.mark.parametrize("side", ["mv_low", "mv_high"])
def test_a_start_outside_its_limit_by_rounding_is_accepted(side, drift):
    body = valid()
    body["mv_now"][0] = body["tuning"][side][0] + drift
    assert make_case(body).mv_now[0] == body["mv_now"][0]


@pytest.mark.parametrize(("side", "excess"), [("mv_low", -1e-4), ("mv_high", 1e-4)])
def test_a_start_outside_its_limit_by_more_than_rounding_is_refused(side, excess):
    body = valid()
    body["tuning"]["mv_low"][0], body["tuning"]["mv_high"][0] = 0.0, 10.0
    body["mv_now"][0] = body["tuning"][side][0] + excess
    with pytest.raises(InputError) as caught:
        make_case(body)
    assert caught.value.field == "mv_now[0]"


@pytest.mark.parametrize("seed", range(20))
def test_a_case_that_is_written_reads_back_the_same(tmp_path, seed):
    body, _ = problems.random_case(np.random.default_rng(seed))
    case = make_case(body)
    again = load_case(dump_case(case, tmp_path / "case.json"))
    assert case_to_dict(again) == case_to_dict(case)
    assert again.structure == case.structure
    for key in ("mv_now", "last_move", "free_response", "setpoint"):
        assert case_to_dict(case)[key] == body[key]
    for key, value in body["tuning"].items():
        assert case_to_dict(case)["tuning"][key] == value


def test_a_written_case_holds_no_infinity_or_nan(tmp_path):
    body = valid()
    problems.TWISTS["no_mv_limits"](body, None)
    text = dump_case(make_case(body), tmp_path / "case.json").read_text()
    assert "Infinity" not in text
    assert "NaN" not in text


def plan(**fields):
    """A plan with the attributes that a plan file needs."""
    return SimpleNamespace(
        **{
            "status": "optimal",
            "objective": np.float64(2.5),
            "bound": np.float64(2.5),
            "gap": np.float64(0.0),
            "moves": np.zeros((4, 2)),
            "mv": np.zeros((6, 2)),
            "cv": np.ones((8, 2)),
            "eps_high": np.zeros(2),
            "eps_low": np.zeros(2),
            "nodes": np.int64(3),
            "solve_time_s": 0.01,
            "finished_by": "fixing",
        }
        | fields
    )


def test_a_plan_file_has_the_fields_of_the_interface():
    body = json.loads(json.dumps(plan_to_dict(plan()), allow_nan=False))
    assert list(body) == [
        "status",
        "objective",
        "bound",
        "gap",
        "moves",
        "mv",
        "cv",
        "eps_high",
        "eps_low",
        "nodes",
        "solve_time_s",
        "finished_by",
    ]
    assert (body["status"], body["objective"], body["nodes"], body["finished_by"]) == (
        "optimal",
        2.5,
        3,
        "fixing",
    )
    assert (len(body["moves"]), len(body["mv"]), len(body["cv"])) == (4, 6, 8)


def test_numbers_that_are_not_finite_become_null_in_a_plan_file():
    body = plan_to_dict(
        plan(
            status="infeasible",
            objective=np.inf,
            bound=-np.inf,
            gap=np.nan,
            moves=np.full((2, 1), np.nan),
            finished_by=None,
        )
    )
    assert (body["objective"], body["bound"], body["gap"], body["finished_by"]) == (None, None, None, None)
    assert body["moves"] == [[None], [None]]
    json.dumps(body, allow_nan=False)
