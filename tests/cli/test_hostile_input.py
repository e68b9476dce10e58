"""Case files with any numbers, types and keys: a plan or one line, whole files only, and memory within a bound."""

import contextlib
import copy
import io
import json
import math
import resource
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxmpc.check import LARGEST
from jaxmpc.cli.main import main
from jaxmpc.controller.case import make_case
from jaxmpc.errors import InputError
from jaxmpc.integer import lower_bound as levelset
from jaxmpc.integer.chain import Chain
from jaxmpc.integer.lower_bound import LowerModel, enumerate_below
from jaxmpc.integer.nearest import UndecidedError, nearest
from jaxmpc.integer.outer_approximation import outer_approximation
from jaxmpc.integer.solve import FINISHES
from jaxmpc.problem.memory import BUDGET, check_ranges, check_size
from jaxmpc.problem.structure import Structure
from tests import problems

MOST_MEMORY = 2 * 2**30  # bytes that the process may grow by, compiled programs included


def valid() -> dict:
    """Two CVs, two MVs (u0 in steps of 2), Hp = 8, Hu = 6 in four blocks: the one structure that is compiled here."""
    return problems.small_case(np.random.default_rng(1), blocks=[1, 1, 2, 2]) | {
        "limits": {"time_s": 5.0, "gap": 1e-6}
    }


def numbers(body, path=()) -> list[tuple]:
    """Paths of all numbers that no compiled program depends on."""
    if path[:1] == ("structure",) or path == ("model", "dt"):
        return []
    if isinstance(body, dict):
        return [found for key in body for found in numbers(body[key], (*path, key))]
    if isinstance(body, list):
        return [found for i in range(len(body)) for found in numbers(body[i], (*path, i))]
    return [path] if isinstance(body, int | float) and not isinstance(body, bool) else []


def everything(body, path=()) -> list[tuple]:
    """Paths of all fields and entries."""
    children = body.items() if isinstance(body, dict) else enumerate(body) if isinstance(body, list) else ()
    return [(*path, key) for key, _ in children] + [
        found for key, child in children for found in everything(child, (*path, key))
    ]


def put(body, path, value) -> None:
    """Replace what is at a path, or every entry of a list where the path ends in None."""
    for key in path[:-1]:
        body = body[key]
    if path[-1] is None:
        body[:] = [value] * len(body)
    else:
        body[path[-1]] = value


NUMBERS = numbers(valid())
ROWS = sorted({(*path[:-1], None) for path in NUMBERS if isinstance(path[-1], int)}, key=str)
EXTREME = [
    0.0,
    5e-324,
    1e-308,
    1e-300,
    1e-30,
    1e-15,
    1e-9,
    1e9,
    1e12,
    1e15,
    1e16,
    1e20,
    1e30,
    1e100,
    1e154,
    1e200,
    1e308,
]
hostile_numbers = st.one_of(
    st.sampled_from([*EXTREME, *(-value for value in EXTREME), None]),
    st.floats(),
    st.integers(-(10**20), 10**20),
)
changes = st.lists(st.tuples(st.sampled_from(NUMBERS + ROWS), hostile_numbers), min_size=1, max_size=3)


def run(body, finish: str = "auto") -> tuple[int, str, dict | None]:
    """Exit status, standard error and plan of ``jaxmpc plan --out``; the folder holds nothing but the files."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()) as said:
        case, out = Path(folder, "case.json"), Path(folder, "plan.json")
        case.write_text(json.dumps(body))
        status = main(["plan", str(case), "--out", str(out), "--finish", finish])
        plan = json.loads(out.read_text(), parse_constant=pytest.fail) if out.exists() else None
        assert {entry.name for entry in Path(folder).iterdir()} <= {"case.json", "plan.json"}
    return status, said.getvalue(), plan


# ---------------------------------------------------------------------------------------------- numbers that are solved


@settings(max_examples=80, deadline=None, derandomize=True)
@given(changes=changes, finish=st.sampled_from(FINISHES))
@example(changes=[(("model", "coefficients", 1, 0, 3), -1e30)], finish="auto")
@example(changes=[(("last_move", None), 1e30)], finish="auto")
@example(
    changes=[(("tuning", "slack_weight", None), 1e30), (("tuning", "deadzone", None), 1e5)], finish="highs"
)
@example(
    changes=[(("tuning", "move_weight", None), 5e-324), (("tuning", "cv_weight", None), 0.0)], finish="auto"
)
@example(
    changes=[(("free_response", 0, None), 1e30), (("setpoint", 0, None), -1e30)], finish="branch-and-bound"
)
def test_any_numbers_end_in_a_plan_or_in_one_line_that_names_the_field(changes, finish):
    body = valid()
    for path, value in changes:
        put(body, path, value)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    status, said, plan = run(body, finish)
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < MOST_MEMORY
    assert said.startswith("jaxmpc: ")
    assert said.count("\n") == 1
    assert status in (0, 1, 2, 3, 4)
    assert (plan is None) == (status == 2)
    if plan is None:
        assert ": got " in said
        assert "expected " in said
    elif status in (0, 4):
        assert all(math.isfinite(x) for key in ("moves", "mv", "cv") for row in plan[key] for x in row)
        assert plan["bound"] <= plan["objective"]


@pytest.mark.parametrize(
    ("path", "value", "field"),
    [
        (("structure", "integer_step", "u0"), 1e308, "structure.integer_step.u0"),
        (("structure", "integer_step", "u0"), 1e-300, "structure.integer_step.u0"),
        (("structure", "integer_step", "u0"), 5e-324, "structure.integer_step.u0"),
        (("model", "coefficients", 0, 1, 2), -1e200, "model.coefficients[0, 1, 2]"),
        (("tuning", "move_weight", 0), 1e308, "tuning.move_weight[0]"),
        (("tuning", "mv_high", 1), 1e300, "tuning.mv_high[1]"),
        (("free_response", 3, 1), 1e160, "free_response[3][1]"),
        (("last_move", 0), -1e100, "last_move[0]"),
    ],
)
def test_a_number_whose_square_overflows_is_refused_with_the_largest_that_is_not(path, value, field):
    body = valid()
    put(body, path, value)
    with pytest.raises(InputError, match=r"1e\+30") as caught:
        make_case(body)
    assert caught.value.field == field


def test_the_largest_number_is_a_number():
    body = valid()
    body["tuning"]["cv_high"][0] = LARGEST
    assert make_case(body).tuning.cv_high[0] == LARGEST


# --------------------------------------------------------------------------------------------------- what cannot fit


@pytest.mark.parametrize(
    "change",
    [
        {("structure", "integer_step", "u0"): 1e-9},
        {
            ("tuning", "move_low", 0): -1e9,
            ("tuning", "move_high", 0): 1e9,
            ("tuning", "mv_low", 0): -1e9,
            ("tuning", "mv_high", 0): 1e9,
        },
    ],
    ids=["step of 1e-9", "range of 1e9"],
)
def test_whole_moves_that_cannot_be_listed_are_refused_with_the_bytes_they_need(change):
    body = valid()
    for path, value in change.items():
        put(body, path, value)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    status, said, plan = run(body)
    assert (status, plan) == (2, None)
    assert said.startswith("jaxmpc: structure.integer_step.u0: got ")
    assert "GiB of the 4 GiB" in said
    assert "tuning.move_low" in said
    assert said.count("\n") == 1
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < MOST_MEMORY


def integers(blocks: int = 4) -> Structure:
    """Two integer MVs."""
    return Structure(
        cv_names=("y",),
        mv_names=("a", "b"),
        prediction_horizon=10,
        control_horizon=blocks,
        blocks=(1,) * blocks,
        integer_step=(0.5, 2.0),
    )


def test_the_mv_with_the_widest_range_is_named():
    low, high = np.zeros((1, 8)), np.full((1, 8), 3.0)
    check_ranges(integers(), low, high)
    high[0, 5] = 1e9
    with pytest.raises(InputError, match=r"got 2\.0.*GiB") as caught:
        check_ranges(integers(), low, high)
    assert caught.value.field == "structure.integer_step.b"


@pytest.mark.parametrize("scenarios", [1, 1000])
def test_the_widest_range_that_is_let_through_takes_the_budget(scenarios):
    per_move = 8 * (24 + scenarios) * 8
    low, high = np.zeros((scenarios, 8)), np.zeros((scenarios, 8))
    high[0, 0] = BUDGET // per_move - 1
    check_ranges(integers(), low, high)
    high[0, 0] += 1
    with pytest.raises(InputError, match="4 GiB"):
        check_ranges(integers(), low, high)


def test_limits_that_leave_no_move_are_not_a_range():
    check_ranges(integers(), np.full((1, 8), 1e40), np.full((1, 8), -1e40))


@pytest.mark.parametrize("far", [1e13, -1e13])
def test_moves_beyond_what_whole_numbers_hold_are_refused(far):
    with pytest.raises(InputError, match="whole moves"):
        check_ranges(integers(), np.full((1, 8), far), np.full((1, 8), far + 1))


def test_horizons_and_blocks_that_cannot_fit_are_refused_with_the_bytes_they_need():
    check_size(integers(500))
    with pytest.raises(InputError, match=r"GiB.*GiB") as caught:
        check_size(
            Structure(
                cv_names=("y",),
                mv_names=("a",),
                prediction_horizon=100_000,
                control_horizon=100_000,
                blocks=(),
            )
        )
    assert caught.value.field == "structure.blocks"


def wide_chain(width: int) -> tuple[list[Chain], np.ndarray, np.ndarray]:
    """One MV with two blocks of two moves each that have to end one step away: impossible."""
    one, none = np.ones(2, dtype=int), np.zeros(0)
    chain = Chain(np.arange(2), 2 * one, one * 0 - width * 4, one * width * 4, one > 1, none, none, none)
    chain.low[1] = chain.high[1] = 1
    return [chain], np.full(2, -width), np.full(2, width)


def test_moves_that_no_one_can_look_at_are_undecided_and_not_infeasible():
    chains, low, high = wide_chain(100)
    assert nearest(chains, np.zeros(2), low, high) is None
    chains, low, high = wide_chain(1_000_000)
    with pytest.raises(UndecidedError):
        nearest(chains, np.zeros(2), low, high)


def test_the_nearest_moves_in_a_wide_range_are_found_around_the_wanted_ones():
    chains, low, high = wide_chain(1_000_000)
    chains[0].low[1] = chains[0].high[1] = 14
    assert nearest(chains, np.array([3.2, 3.1]), low, high).tolist() in ([3, 4], [4, 3])


def flat_model(moves: int, width: int) -> tuple[LowerModel, list[Chain]]:
    """A bound that tells no moves apart."""
    counts, none = np.ones(moves, dtype=int), np.zeros(0)
    far = counts * moves * width
    chain = Chain(np.arange(moves), counts, -far, far, counts > 1, none, none, none)
    zeros = np.zeros((moves, moves))
    low, high = counts * 0, counts * (width - 1)
    excess = np.zeros((moves, width))
    return LowerModel(0.0, np.zeros(moves), low, high, excess, zeros, none, np.arange(moves), zeros), [chain]


def test_a_list_that_does_not_fit_is_given_up_and_a_beam_stays_narrow(monkeypatch):
    model, chains = flat_model(4, 50)
    for cells, fits in ((50**4, True), (50**4 - 1, False)):
        monkeypatch.setattr(levelset, "CELLS", cells)
        found = enumerate_below(model, chains, model.lower, model.upper, 1.0, None)
        assert (found is not None) == fits
    monkeypatch.setattr(levelset, "CELLS", 500)
    points, _, _ = enumerate_below(model, chains, model.lower, model.upper, np.inf, None, beam=400)
    assert len(points) == 400
    monkeypatch.setattr(levelset, "CELLS", 10)  # fewer than one move has values
    points, _, _ = enumerate_below(model, chains, model.lower, model.upper, np.inf, None, beam=40)
    assert len(points) == 40


def test_a_master_with_too_many_values_is_not_built():
    class Search:
        root_bound = 3.0

    wide = outer_approximation(Search(), None, None, np.zeros(2), np.full(2, 1e6), None)
    with pytest.raises(StopIteration) as ended:
        next(wide)
    assert ended.value.value == (False, 3.0)


# ------------------------------------------------------------------------------------------- types, keys and shapes

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(codec=None), max_size=4),
    lambda children: (
        st.lists(children, max_size=3) | st.dictionaries(st.text(max_size=4), children, max_size=3)
    ),
    max_leaves=5,
)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(data=st.data())
def test_any_types_keys_and_shapes_are_read_or_refused_by_name(data):
    body = copy.deepcopy(valid())
    for _ in range(data.draw(st.integers(1, 3))):
        path = data.draw(st.sampled_from(everything(body)))
        container = body
        for key in path[:-1]:
            container = container[key]
        match data.draw(st.sampled_from(["replace", "drop", "add"])):
            case "replace":
                container[path[-1]] = data.draw(json_values)
            case "drop":
                del container[path[-1]]
            case "add" if isinstance(container, list):
                container.insert(path[-1], data.draw(json_values))
            case "add":
                container[data.draw(st.text(max_size=4))] = data.draw(json_values)
        if not everything(body):
            return
    refused = None
    try:
        make_case(json.loads(json.dumps(body)))
    except InputError as error:
        refused = error
    assert refused is None or refused.field


@given(body=json_values)
@settings(max_examples=100, deadline=None, derandomize=True)
def test_any_json_is_read_or_refused_by_name(body):
    with pytest.raises(InputError):
        make_case(body)


@pytest.mark.parametrize("name", ["\ud800", "y\udfff0"])
def test_half_a_character_in_a_name_is_refused_in_one_line(name):
    body = valid()
    body["model"]["cv"][0] = name
    status, said, plan = run(body)
    assert (status, plan) == (2, None)
    assert said.startswith("jaxmpc: model.cv: got ")
    assert said.count("\n") == 1
