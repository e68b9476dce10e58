"""A first process file from a model: it loads, nothing in it has to be mended, and what no process may have is refused."""

import tomllib

import numpy as np
import pytest

from identify.judge import judge
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import make_model
from jaxmpc.process.file import process_of
from jaxmpc.process.new import new_process

SHAPE = 1 - np.exp(-np.arange(1, 41) / 6)  # of a first-order response over samples


def model(names=("flow", "pressure"), **more):
    gains = np.array([[0.6, 1.2], [-0.25, 0.5]])
    return make_model(gains[:, :, None] * SHAPE, 10.0, names, ["valve", "pump"], **more)


def made(of, **more):
    text, guesses = new_process(of, "model.json", "mine", **more)
    return process_of(tomllib.loads(text), files=False), guesses


@pytest.mark.parametrize(
    "more", [{}, {"steps": {"valve": 2.0}}, {"steps": {"valve": 7.0}}, {"switches": ["valve"]}]
)
@pytest.mark.parametrize(
    "units", [{}, {"mv_units": ("%", "Hz"), "working_point": {"valve": 100, "pump": 45}}]
)
def test_a_file_made_from_a_model_has_nothing_that_its_check_would_mend(units, more):
    process, _ = made(model(**units), **more)
    assert [finding for finding in judge(process, model(**units)) if finding.level != "fine"] == []


def test_a_switch_stands_at_one_end_and_its_moves_are_priced_by_that():
    process, guesses = made(model(), switches=["valve"])
    assert process.mvs[0].actuator.listed == (0.0, 1.0)
    assert process.tuning_fields()["move_weight"]["valve"] == 0.1  # a tenth of a span of the CVs
    assert "the range of valve: 0 to 1, one or the other" in guesses


def test_what_the_model_does_not_say_is_among_the_guesses():
    _, bare = made(model())
    _, full = made(model(cv_units=("m3/h", "bar"), mv_units=("%", "Hz"), working_point={"valve": 50}))
    for word in ("all units", "working point"):
        assert any(word in guess for guess in bare)
        assert not any(word in guess for guess in full)


@pytest.mark.parametrize(
    ("field", "of", "more"),
    [
        ("model.cv", {"names": ("21PT1234.PV", "flow")}, {}),
        ("--step", {}, {"steps": {"vale": 2.0}}),
        ("--step", {}, {"steps": {"valve": -2.0}}),
        ("--step", {}, {"steps": {"valve": 2.0}, "switches": ["valve"]}),
        ("--on-off", {}, {"switches": ["vale"]}),
    ],
)
def test_names_and_steps_that_no_process_could_have_are_refused(field, of, more):
    with pytest.raises(InputError) as caught:
        made(model(**of), **more)
    assert caught.value.field == field


def test_what_an_fmu_says_of_its_inputs_is_taken_and_the_fmu_is_the_first_plant():
    provenance = {
        "actuators": {"valve": {"kind": "values", "values": [0, 1, 4]}, "pump": {"kind": "on-off"}},
        "ranges": {"valve": [0, 4], "pump": [0, 1]},
        "variables": {"flow": "line[1].flow"},
        "start": {"mode": "auto", "open": True, "size": 2},
        "settle": 600.0,
        "stops": True,
    }
    process, guesses = made(
        model(provenance=provenance, working_point={"valve": 1, "pump": 0}), fmu="plants/mine.fmu"
    )
    assert [(name, plant.kind, plant.source) for name, plant in process.plants.items()] == [
        ("fmu", "fmu", "plants/mine.fmu"),
        ("model", "model", ""),
    ]
    options = process.plants["fmu"].options
    assert options["start"] == {"mode": "auto", "open": True, "size": 2}
    assert options["variables"] == {"flow": "line[1].flow"}
    assert options["working_point"] == {"valve": 1, "pump": 0}
    assert (options["settle"], options["stop_time"]) == (600, 1e7)
    assert [mv.actuator.listed for mv in process.mvs] == [(0.0, 1.0, 4.0), (0.0, 1.0)]
    assert process.disturbance_names == ()
    assert not any("the range of" in guess for guess in guesses)
