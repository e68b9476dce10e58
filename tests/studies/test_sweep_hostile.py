"""Study files that nobody means: they are taken or refused in one line, soon and with nothing written."""

import copy
import tomllib
import tracemalloc

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from jaxmpc.errors import InputError
from jaxmpc.process.well.plant import WellPlant
from studies.definition.axes import MOST
from studies.definition.fields import study_fields
from studies.definition.sweep import StudyDefinition, load_definition
from studies.load import expand
from studies.thesis.well import WELL

KEYS = tuple(study_fields(WELL, WellPlant().parameter_table))
WEIGHT = "tuning.move_weight.choke"
BODY = tomllib.loads("""
[study]
name = "made"
chunk_size = 4
confirmation_limit = 100
[base]
reference = { times = [0, 300], setpoints = [[11013, 185], [9640, 152]], duration = 600 }
blocks = [1, 2, 4]
prediction_horizon = 30
[base.tuning.deadzone]
gas_rate = 800
[[base.disturbance]]
time = 100
offset = -1.5
[sampling]
method = "sobol"
count = 4
seed = 3
[[axes]]
key = "tuning.move_weight.choke"
unit = "1/%^2"
range = { from = 60, to = 1000, count = 3, scale = "log" }
keep = [0, 2]
[[axes]]
keys = ["controller", "soft"]
values = [["continuous", true], ["mixed-integer", false]]
[[axes]]
key = "plant.reservoir_pressure"
distribution = { kind = "uniform", from = 77, to = 80 }
[store]
every = 5
trajectories = ["cv", "mv"]
[quick]
count = 2
[quick.axes]
"tuning.move_weight.choke" = { count = 3 }
""")

NUMBERS = st.one_of(
    st.integers(-3, 40),
    st.sampled_from([10**6, 10**9, 10**12, 2**63, 10**30, 10**400, -(10**400), 10**4000]),
    st.floats(),
    st.sampled_from([1e308, -1e308, 5e-324]),
)
WORDS = st.one_of(
    st.text(max_size=8),
    st.sampled_from(
        [
            *KEYS,
            "",
            ".",
            "\x00",
            "\ud800",
            "\u202e",
            "x" * 5000,
            "tuning",
            "inf",
            "list",
            "normal",
        ]
    ),
)
LEAVES = st.one_of(st.none(), st.booleans(), NUMBERS, WORDS)
THINGS = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS, inner, max_size=3),
    max_leaves=6,
)


def places(body, path=()):
    """Every place of a body, as keys from the top."""
    entries = body.items() if isinstance(body, dict) else enumerate(body) if isinstance(body, list) else ()
    return [found for key, value in entries for found in [(*path, key), *places(value, (*path, key))]]


@st.composite
def bodies(draw):
    """The body above with one to three things replaced, removed or added."""
    body = copy.deepcopy(BODY)
    for _ in range(draw(st.integers(1, 3))):
        *above, last = draw(st.sampled_from(places(body)))
        holder = body
        for key in above:
            holder = holder[key]
        change = draw(st.sampled_from(["replace", "replace", "remove", "add"]))
        if change == "replace":
            holder[last] = draw(THINGS)
        elif change == "remove":
            del holder[last]
        elif isinstance(holder, dict):
            holder[draw(WORDS)] = draw(THINGS)
        else:
            holder.append(draw(THINGS))
        if not places(body):
            break
    return body


def taken_or_refused(make):
    """The study, or the error in one printable line; anything else is a failure."""
    try:
        return make()
    except InputError as error:
        refused = error
    assert str(refused).isprintable()
    return refused


QUIETLY = settings(
    deadline=None,
    max_examples=150,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@QUIETLY
@given(body=bodies(), quick=st.booleans())
def test_a_changed_definition_is_taken_or_refused_and_writes_nothing(body, quick, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = taken_or_refused(lambda: expand(StudyDefinition.from_dict(body), quick=quick))
    if not isinstance(found, InputError):
        assert found.count <= 100
        assert str(found.describe())
    assert list(tmp_path.iterdir()) == []


@QUIETLY
@example(body="\ud800")
@given(body=THINGS)
def test_anything_in_place_of_a_definition_is_refused(body):
    assert isinstance(taken_or_refused(lambda: expand(StudyDefinition.from_dict(body))), InputError)


@QUIETLY
@given(
    text=st.one_of(
        st.binary(max_size=60),
        st.text(alphabet=st.characters(codec="utf-8"), max_size=60).map(str.encode),
        st.lists(
            st.sampled_from(["[", "[[", "]]", "]", "{", "a.", "a", " = ", "1", '"', "\n", "axes", "-"]),
            max_size=40,
        )
        .map("".join)
        .map(str.encode),
    )
)
def test_any_file_is_read_or_refused(text, tmp_path):
    path = tmp_path / "any.toml"
    path.write_bytes(text)
    assert isinstance(taken_or_refused(lambda: expand(load_definition(path))), InputError)
    assert list(tmp_path.iterdir()) == [path]


RANGE = '[[axes]]\nkey = "tuning.move_weight.choke"\nrange = {{ from = 1, to = 2, count = {} }}\n'
DRAWS = """[[axes]]
key = "tuning.move_weight.choke"
distribution = { kind = "uniform", from = 1, to = 2 }
"""
LARGE = {
    "values of a range": RANGE.format(10**12),
    "values of a range of which one is kept": RANGE.format(10**8) + "keep = [0]",
    "combinations": RANGE.format(10**5)
    + RANGE.format(10**5).replace("move_weight.choke", "move_weight.gas_lift"),
    "draws": f'[sampling]\nmethod = "sobol"\ncount = {10**12}\n{DRAWS}',
    "batches": f'[search]\nobjectives = ["travel.choke"]\nbatches = {10**12}\n{DRAWS}',
    "digits": RANGE.format("9" * 5000),
    "a horizon": f"[base]\nprediction_horizon = {10**12}\n{RANGE.format(2)}",
    "a block": f"[base]\nblocks = [{10**9}]\nprediction_horizon = {10**9}\n{RANGE.format(2)}",
    "a long run": "[base.reference]\ntimes = [0]\nsetpoints = [[1, 1]]\nduration = 1e15\n" + RANGE.format(2),
    "nested lists": "a = " + "[" * 5000 + "]" * 5000,
    "nested tables": "[base]\n" + ".".join("a" * 1500) + " = 1",
    "nested values": '[[axes]]\nkey = "seed"\nvalues = ' + "[" * 40 + "]" * 40,
}


@pytest.mark.parametrize("text", LARGE.values(), ids=LARGE)
def test_what_is_too_large_is_refused_in_little_memory_even_when_it_is_confirmed(text, tmp_path):
    path = tmp_path / "large.toml"
    head = f'[study]\nname = "large"\nconfirmation_limit = {10**15}\n'
    path.write_text(text if text.startswith("a =") else head + text)
    tracemalloc.start()
    try:
        found = taken_or_refused(lambda: expand(load_definition(path), confirmed=True))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert isinstance(found, InputError)
    assert peak < 100e6


def test_the_largest_range_is_named(tmp_path):
    body = {
        "study": {"name": "x"},
        "axes": [{"key": WEIGHT, "range": {"from": 1, "to": 2, "count": MOST + 1}}],
    }
    with pytest.raises(
        InputError, match=rf"axes\[0\].range.count: got {MOST + 1}, expected at most {MOST} values"
    ):
        expand(StudyDefinition.from_dict(body))
