"""Identification of FMUs whose exact responses are known: coefficients, verdicts, and what is told or refused."""

import json
import re

import fmpy
import numpy as np
import pytest

from identify.fmu import FmuPlant
from identify.fmu_steps import identify_fmu
from identify.fmu_sweep import identify_fmu_schedule
from jaxmpc.cli.main import main
from jaxmpc.controller.schedule import ModelSchedule
from jaxmpc.errors import InputError, PlantError
from jaxmpc.model.step_response import StepResponseModel
from tests import fmus
from tests.fmu_plants import make_plant, real, whole

DT, N = 10.0, 60
T = DT * np.arange(1, N + 1)
U = real("u", 0, start=50, min=0, max=100, unit="%")
Y = real("y", 10, "output", unit="m")
LAG = {"states": 1, "rates": "d[0] = (2 * u[0] - x[0]) / 100", "outputs": "y[0] = x[0]"}
EXACT = 2 * (1 - np.exp(-T / 100))
CLOSE = 1e-5  # of a coefficient: the solvers are better, what is asked for is 5e-3


def plant(folder, variables=(U, Y), kind="CoSimulation", fmi=2, starts=0.0, step=1.0, **code):
    given = {"units": ("%", "m"), "fmi": fmi, "starts": starts, "step": step}
    return make_plant(folder, list(variables), kind, **given, **(code or LAG))


def found(path, mvs=None, cvs=("y",), samples=N, **more):
    return identify_fmu(path, mvs or {"u": (None, 1.0)}, list(cvs), DT, samples, **more)


def off(identification, exact, i=0, j=0):
    """Largest error as a share of the largest coefficient."""
    return np.abs(identification.responses[i, j] - exact).max() / np.abs(exact).max()


# -------------------------------------------------------------------------------------------------- exact coefficients


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_a_linear_plant_is_found_exactly_with_inputs_of_every_type(tmp_path, kind):
    variables = [
        U,
        whole("pump", 0, kind="Boolean", start="false"),
        whole("count", 1, start=3, min=0, max=10),
        whole("mode", 0, kind="Enumeration", declaredType="Mode", start="1"),
        real("feed", 1, start=3),
        real("tank[1].level", 10, "output", unit="m"),
        real("flow", 11, "output"),
    ]
    code = {
        "states": 2,
        "rates": "d[0] = (2 * u[0] + 5 * b[0] - 3 * n[1] - x[0]) / 100; d[1] = (x[0] - x[1]) / 30",
        "outputs": "y[0] = x[1]; y[1] = x[0] + 0.5 * n[0] + 0.3 * u[1]",
    }
    path = plant(tmp_path, variables, kind, **code)
    moved = dict.fromkeys(("u", "pump", "count", "mode"), (None, None))
    got = found(path, moved, ("tank[1].level", "flow"), dvs={"feed": (4.0, None)})
    first = 1 - np.exp(-T / 100)
    second = 1 - (100 * np.exp(-T / 100) - 30 * np.exp(-T / 30)) / 70
    gains = {0: 2, 1: 5, 2: -3}
    for j, gain in gains.items():
        assert off(got, gain * second, 0, j) < CLOSE
        assert off(got, gain * first, 1, j) < CLOSE
    assert off(got, 0.5 * np.ones(N), 1, 3) < CLOSE  # at once: S(1) is the whole gain
    assert off(got, 0.3 * np.ones(N), 1, 4) < CLOSE
    model = got.model
    assert (model.mv_names, model.dv_names) == (("u", "pump", "count", "mode"), ("feed",))
    assert (model.cv_names, model.cv_units, model.mv_units[0]) == (("tank_1_level", "flow"), ("m", "1"), "%")
    assert dict(model.working_point)["tank_1_level"] == pytest.approx(2 * 50 - 9, rel=1e-6)
    verdicts = {(row.cv, row.input): row.verdict for row in got.verdicts}
    assert verdicts["tank_1_level", "mode"] == verdicts["tank_1_level", "feed"] == "none"
    assert verdicts["flow", "u"] == verdicts["tank_1_level", "pump"] == "good"
    assert np.asarray(model.coefficients)[0, 3].max() == 0
    told = dict(model.provenance)
    steps = {name: dict(ways) for name, ways in told["steps"]}
    assert steps["u"] == {"up": 1, "down": -1, "half up": 0.5, "half down": -0.5}
    assert steps["pump"] == {"up": 1}
    assert steps["mode"] == {"up": 3, "down": -1}
    assert dict(told["variables"]) == {"tank_1_level": "tank[1].level"}
    assert StepResponseModel.from_dict(json.loads(json.dumps(model.to_dict()))).provenance == model.provenance
    assert hash(model.provenance)


@pytest.mark.parametrize(
    ("code", "exact"),
    [
        ({"rates": "d[0] = (u[0] - x[0]) / 100; d[1] = (u[0] - x[1]) / 20", "outputs": "y[0] = 3 * x[0] - 2 * x[1]"},
         3 * (1 - np.exp(-T / 100)) - 2 * (1 - np.exp(-T / 20))),
        # u of 35 steps ago is put in at the end of a step, for the next one: 36 s
        ({"rates": "d[0] = (2 * memory[0] - x[0]) / 100", "outputs": "y[0] = x[0]",
          "tick": "past[ticks % 4000] = u[0]; memory[0] = ticks > 35 ? past[(ticks - 35) % 4000] : u[0]"},
         np.where(T > 36, 2 * (1 - np.exp(-(T - 36) / 100)), 0.0)),
        # another mode, which is not at rest for hours, a ramp, a swing
        ({"rates": "d[0] = (2 * u[0] - x[0]) / 100; d[1] = (1000 - x[1]) / 5000", "outputs": "y[0] = x[0] + x[1]"}, EXACT),
        ({"rates": "d[0] = (2 * u[0] - x[0]) / 100; d[1] = 0.001", "outputs": "y[0] = x[0] + x[1] + sin(t / 77)"}, EXACT),
        # noise that begins anew after a reset
        ({"rates": "d[0] = (2 * u[0] - x[0]) / 100", "outputs": "y[0] = x[0] + memory[0]",
          "tick": "memory[0] = noise()", "initial": "seed = 1; memory[0] = 0"}, EXACT),
        # an FMU that cannot be reset
        ({"rates": "d[0] = (2 * u[0] - x[0]) / 100", "outputs": "y[0] = x[0]", "reset": "return 3"}, EXACT),
    ],
    ids=["inverse response", "dead time", "slow mode", "drift", "repeated noise", "no reset"],
)  # fmt: skip
def test_what_a_plant_does_besides_is_not_in_its_response(tmp_path, code, exact):
    assert off(found(plant(tmp_path, states=2, **code)), exact) < CLOSE


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_a_plant_of_either_version_is_found_from_where_its_experiment_begins(tmp_path, kind, fmi):
    # before its time it is another plant; a time event of the one for model exchange changes nothing
    early = {"rates": "d[0] = ((t < 1000 ? 9 : 2) * u[0] - x[0]) / 100", "begin": "next = 1234"}
    path = plant(tmp_path, kind=kind, fmi=fmi, starts=1000.0, **(LAG | early))
    assert off(found(path), EXACT) < CLOSE


@pytest.mark.parametrize("size", [1e-12, 1e-20])
def test_states_far_below_their_nominal_values_are_integrated_as_well(tmp_path, size):
    small = {"states": 2, "rates": f"d[0] = ({size} * u[0] - x[0]) / 100; d[1] = (x[0] - x[1]) / 30"}
    got = found(plant(tmp_path, kind="ModelExchange", outputs="y[0] = x[1]", **small))
    exact = size * (1 - (100 * np.exp(-T / 100) - 30 * np.exp(-T / 30)) / 70)
    assert off(got, exact) < CLOSE
    assert got.verdicts[0].verdict == "good"


def test_a_state_that_is_rounding_does_not_hold_up_the_solver(tmp_path):
    rates = "d[0] = (2 * u[0] - x[0]) / 100; d[1] = (0.1 + 0.2 - 0.3) * sin(1e6 * t)"
    got = found(plant(tmp_path, kind="ModelExchange", states=2, rates=rates, outputs="y[0] = x[0] + x[1]"))
    assert off(got, EXACT) < CLOSE


@pytest.mark.parametrize("attributes", ["", 'canHandleVariableCommunicationStepSize="true"'])
def test_steps_of_a_microsecond_in_a_default_experiment_are_taken_together(tmp_path, attributes):
    exact = {"tick": "x[0] += (2 * u[0] - x[0]) * -expm1(-h / 100)", "outputs": "y[0] = x[0]"}  # at any step
    path = make_plant(tmp_path, [U, Y], step=1e-6, units=("%", "m"), attributes=attributes, **exact)
    assert off(found(path, samples=5, settle=0.0), EXACT[:5]) < CLOSE
    with FmuPlant(path, ["u"], ["y"], dt=1e-5) as fast:
        assert fast.substep == pytest.approx(1e-6)


def test_a_plant_of_microseconds_is_found(tmp_path):
    for kind in ("CoSimulation", "ModelExchange"):
        fast = LAG | {"rates": "d[0] = (2 * u[0] - x[0]) / 1e-5"}
        if kind == "CoSimulation":  # exactly, for its solver has steps of its own
            fast = {"tick": "x[0] += (2 * u[0] - x[0]) * -expm1(-0.1)", "outputs": "y[0] = x[0]"}
        path = make_plant(tmp_path / kind, [U, Y], kind, step=1e-6, units=("%", "m"), **fast)
        got = identify_fmu(path, {"u": (None, 1.0)}, ["y"], 1e-6, N)
        assert off(got, 2 * (1 - np.exp(-0.1 * np.arange(1, N + 1)))) < CLOSE


@pytest.mark.parametrize(
    ("code", "exact"),
    [(LAG | {"initial": "x[0] = 100"}, EXACT), ({"rates": "d[0] = u[0] - 50", "outputs": "y[0] = x[0]"}, T)],
    ids=["at rest", "integrates"],
)
def test_an_fmu_whose_reset_does_nothing_is_run_in_new_processes(tmp_path, code, exact):
    got = found(plant(tmp_path, reset="return 0", **(code | {"states": 1})))
    assert off(got, exact) < CLOSE
    assert any("does not reset it" in note for note in got.notes)


@pytest.mark.parametrize(("at", "way"), [(0, "up"), (100, "down")])
def test_at_a_limit_steps_go_the_way_that_is_left(tmp_path, at, way):
    got = found(plant(tmp_path), {"u": (float(at), 2.0)})
    assert off(got, EXACT) < CLOSE
    assert any(f"stepped {way} only from {at}" in note for note in got.notes)
    assert set(got.alternatives) == {way, f"half {way}"}


PLAY = {
    "states": 1,
    "initial": "memory[0] = 50",
    "rates": "d[0] = (2 * memory[0] - x[0]) / 100",
    "outputs": "y[0] = x[0]",
    "tick": "if (fabs(u[0] - memory[0]) > PLAY) { memory[0] = u[0] - (u[0] > memory[0] ? PLAY : -PLAY); }",
}


@pytest.mark.parametrize(("play", "verdict"), [(0.01, "look"), (0.1, "bad")])
def test_backlash_within_the_step_is_seen_on_the_way_back(tmp_path, play, verdict):
    code = PLAY | {"tick": PLAY["tick"].replace("PLAY", str(play))}
    row = found(plant(tmp_path, **code)).verdicts[0]
    assert row.verdict == verdict
    stays = re.search(r"([\d.]+) % of it stays when u has gone back", row.says)
    # half a step of 0.5 moves it by 0.5 - play, and back by all but play; what still moves is taken off
    assert stays
    assert float(stays[1]) == pytest.approx(100 * play / (0.5 - play), rel=0.25)


@pytest.mark.parametrize(
    ("offset", "verdict"), [(1e4, "good"), (1e6, "look"), (1e7, "bad")], ids=["fine", "coarse", "too coarse"]
)
def test_a_cv_in_single_precision_is_not_trusted_beyond_its_resolution(tmp_path, offset, verdict):
    got = found(plant(tmp_path, **(LAG | {"outputs": f"y[0] = (float)(x[0] + {offset})"})))
    row = got.verdicts[0]
    assert row.verdict == verdict
    assert ("moves in steps of" in row.says) == (verdict != "good")
    if verdict == "good":
        assert off(got, EXACT) < 1e-3  # half of 2^-10 on 2


def test_a_cv_that_follows_at_once_is_not_taken_for_one_that_moves_in_steps(tmp_path):
    assert found(plant(tmp_path, outputs="y[0] = 2 * u[0]")).verdicts[0].verdict == "good"


def test_noise_is_averaged_and_what_it_leaves_is_told(tmp_path):
    noisy = LAG | {"outputs": "y[0] = x[0] + 0.01 * noise()"}
    got = found(plant(tmp_path, **noisy))
    assert off(got, EXACT) < 5e-3
    assert got.bands is not None
    share = got.bands.max() / 2
    assert 0.0005 < share < 0.004
    assert got.verdicts[0].verdict == "good"
    # beyond what repetitions can do: 1 on a response of 0.02
    loud = found(
        plant(tmp_path / "loud", **(noisy | {"outputs": "y[0] = x[0] + noise()"})),
        {"u": (None, 0.01)},
        samples=10,
    )
    assert loud.verdicts[0].verdict in ("look", "none", "bad")
    assert "noise" in loud.verdicts[0].says


# ------------------------------------------------------------------------------------------------------------- verdicts


@pytest.mark.parametrize(
    ("code", "verdict", "says"),
    [
        ({"rates": "d[0] = ((u[0] > 50 ? 3 : 1) * (u[0] - 50) - x[0]) / 100"}, "bad", "gain 2.993 up, 0.9975 down"),
        ({"rates": "d[0] = (fabs(u[0] - 50) - x[0]) / 100"}, "bad", "differ by 200 %"),
        ({"rates": "d[0] = (u[0] * u[0] / 50 - x[0]) / 100"}, "look", "differ by 18.2 %"),
        ({"rates": "d[0] = 0.002 * (u[0] - 50)"}, "look", "it integrates: at the end it moves 0.002 m per %"),
        ({"rates": "d[0] = 0.002 * (u[0] - 49)"}, "look", "it integrates: at the end it moves 0.002 m per %"),
        ({"rates": "d[0] = (2 * u[0] - x[0]) / 1000"}, "look", "not settled by sample 60"),
        ({"rates": "d[0] = 0.01 * (x[0] + u[0] - 50)"}, "bad", "it is unstable"),
        ({"rates": "d[0] = -x[0]"}, "none", "no response"),
        ({"rates": "d[0] = x[1]; d[1] = 0.01 * (u[0] - 50 - x[0]) - 0.003 * x[1]"}, "look", "it still swings at sample 60"),
        ({"rates": "d[0] = x[1]; d[1] = 0.01 * (u[0] - 50 - x[0]) + 0.003 * x[1]"}, "bad", "it swings ever more"),
    ],
    ids=[
        *("asymmetric", "turns", "curved", "integrator", "drifting integrator", "slow", "unstable", "none"),
        *("swings", "swings ever more"),
    ],
)  # fmt: skip
def test_a_pair_that_is_not_simply_linear_says_so(tmp_path, code, verdict, says):
    path = plant(tmp_path, states=2, outputs="y[0] = x[0]", **code)
    row = found(path, {"u": (None, 10.0)}).verdicts[0]
    assert (row.verdict, says in row.says) == (verdict, True), row


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_a_response_that_is_small_beside_the_value_of_its_cv_is_found_and_to_be_looked_at(tmp_path, kind):
    small = {"states": 1, "rates": "d[0] = (1e-6 * u[0] - x[0]) / 100", "outputs": "y[0] = x[0] + 1000"}
    got = found(plant(tmp_path, kind=kind, **small))
    assert off(got, EXACT / 2e6) < 1e-3  # CVode follows a change of 1e-6 in a state of 5e-5
    assert got.verdicts[0].verdict == "look"
    assert "of its value only" in got.verdicts[0].says


@pytest.mark.parametrize(
    ("tick", "verdict"),
    [
        ("if (fabs(u[0] - memory[0]) > 2.5) { memory[0] = u[0]; }", "bad"),
        # so far away it fails: the tests are what they are
        ("if (fabs(u[0] - 50) > 2.5) { abort(); }", "none"),
    ],
)
def test_an_input_that_shows_nothing_is_stepped_further(tmp_path, tick, verdict):
    sticks = {"states": 1, "initial": "memory[0] = 50", "rates": "d[0] = (2 * memory[0] - x[0]) / 100"}
    row = found(plant(tmp_path, outputs="y[0] = x[0]", tick=tick, **sticks)).verdicts[0]
    assert row.verdict == verdict
    assert ("a larger one moves it by 19.9 m" in row.says) == (verdict == "bad")


def test_a_start_value_out_of_its_range_is_refused_as_such(tmp_path):
    path = plant(tmp_path, [real("u", 0, start=150, min=0, max=100), Y])
    with pytest.raises(InputError, match=r"--mv u: got 150.0, expected .* from 0 to 100.* start value"):
        found(path)


def test_inputs_and_cvs_without_any_response_are_named(tmp_path):
    variables = [U, real("v", 1, start=1), Y, real("fixed", 11, "output")]
    got = found(plant(tmp_path, variables, **(LAG | {"outputs": "y[0] = x[0]; y[1] = 7"})),
                dict.fromkeys("uv", (None, None)), ("y", "fixed"))  # fmt: skip
    assert any(note.startswith("v has no effect on any CV") for note in got.notes)
    assert any(note.startswith("fixed answers to no input: it stays at 7") for note in got.notes)


def test_an_output_of_whole_values_is_to_be_looked_at(tmp_path):
    variables = [U, whole("alarm", 1, "output", kind="Boolean")]
    path = plant(tmp_path, variables, **(LAG | {"outputs": "b[1] = x[0] > 101"}))
    row = found(path, {"u": (None, 5.0)}, ("alarm",)).verdicts[0]
    assert row.verdict in ("look", "bad")
    assert "whole values only" in row.says


def test_an_fmu_that_ends_after_its_tests_is_identified_without_the_way_back(tmp_path):
    code = LAG | {"initial": "x[0] = 100", "tick": "if (t > 900) { return 3; }"}
    got = found(plant(tmp_path, **code))
    assert off(got, EXACT) < CLOSE
    assert got.verdicts[0].verdict == "good"


def test_every_test_is_a_record_and_those_of_half_size_were_left_out(tmp_path):
    got = found(plant(tmp_path))
    assert [record.title for record in got.records] == ["u +1 %", "u -1 %", "u +0.5 %", "u -0.5 %"]
    assert [bool(record.used.all()) for record in got.records] == [True, True, False, False]
    for record in got.records:
        np.testing.assert_allclose(record.predicted, record.measured, rtol=1e-7)
        assert record.inputs[0, 0] == 50


# --------------------------------------------------------------------------------------------------- model exchange


def test_time_events_are_met_at_their_time(tmp_path):
    code = LAG | {
        "rates": "d[0] = memory[0]",
        "begin": "next = 37",
        "update": "if (t >= next - 1e-9) { memory[0] = 1 - memory[0]; next = t + 37; }",
    }
    with FmuPlant(plant(tmp_path, kind="ModelExchange", **code), ["u"], ["y"], dt=DT) as plant_:
        plant_.init()
        got = [float(plant_.step([50.0]).cv[0]) for _ in range(12)]
    # the slope is 1 from 37 s to 74 s, and again from 111 s on
    times = DT * np.arange(1, 13)
    exact = np.clip(times - 37, 0, 37) + np.clip(times - 111, 0, None)
    np.testing.assert_allclose(got, exact, atol=1e-6)


def test_state_events_are_met_where_an_indicator_crosses_zero(tmp_path):
    code = {
        "states": 1,
        "indicators": 1,
        "rates": "d[0] = memory[0] ? -0.1 : 0.1",
        "crossings": "z[0] = memory[0] ? x[0] - 1 : 3 - x[0]",
        "update": "if (x[0] >= 3 - 1e-6) { memory[0] = 1; } else if (x[0] <= 1 + 1e-6) { memory[0] = 0; }",
        "outputs": "y[0] = x[0]",
    }
    with FmuPlant(plant(tmp_path, kind="ModelExchange", **code), ["u"], ["y"], dt=7.0) as plant_:
        plant_.init()
        got = [float(plant_.step([50.0]).cv[0]) for _ in range(20)]
    # up from 0 to 3 in 30 s, then down to 1 and up again, 20 s each
    t = 7.0 * np.arange(1, 21)
    exact = np.interp(t, [0, 30, 50, 70, 90, 110, 130, 150], [0, 3, 1, 3, 1, 3, 1, 3])
    np.testing.assert_allclose(got, exact, atol=1e-5)


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ({"rates": "d[0] = u[0] > 50 ? 0.0 / 0.0 : 0"}, "the derivative of state 1 is -?nan at t = "),
        ({"rates": "d[0] = 0", "rate_call": "if (u[0] > 50) { return 3; }"}, "fmi2GetDerivatives failed with status 3"),
        ({"rates": "if (u[0] > 50) { for (;;); }"}, "did not come back from the integration at t = .* within 1 s"),
        ({"rates": "if (u[0] > 50) { abort(); }"}, "signal SIGABRT during the integration"),
    ],
)  # fmt: skip
def test_a_model_exchange_fmu_that_fails_is_a_plant_that_fails(tmp_path, code, says, capfd):
    path = plant(tmp_path, kind="ModelExchange", states=1, outputs="y[0] = x[0]", **code)
    with pytest.raises(PlantError, match=says):
        found(path, time_limit=1.0)
    assert "ERROR" not in capfd.readouterr().err  # CVode keeps what it has to say for the message


# --------------------------------------------------------------------------------------------------- the command


def run(path, *more, out):
    return main(
        [
            "identify",
            str(path),
            "--mv",
            "u=50:1",
            "--cv",
            "y",
            "--dt",
            "10",
            "--samples",
            str(N),
            "--out",
            str(out),
            *more,
        ]
    )


def test_an_fmu_becomes_a_model_a_page_and_a_process_with_both_as_plants(tmp_path, capsys):
    variables = [
        U,
        whole("pump", 0, kind="Boolean", start="false"),
        real("feed", 1, start=3),
        real("tank.y", 10, "output"),
    ]
    code = LAG | {"rates": "d[0] = (2 * u[0] + 5 * b[0] + u[1] - x[0]) / 100"}
    path, out = plant(tmp_path, variables, **code), tmp_path / "model.json"
    options = [
        "--mv",
        "u=40:1",
        "--mv",
        "pump",
        "--cv",
        "tank.y",
        "--dv",
        "feed=4:1",
        "--dt",
        "10",
        "--samples",
        "60",
    ]
    assert main(["identify", str(path), *options, "--out", str(out)]) == 0
    told = capsys.readouterr().out
    assert "good  u on tank_y     gain 1.995 per %" in told
    assert f"Next: jaxmpc process new --model {out}" in told
    page = (tmp_path / "model.html").read_text()
    assert page.count("<img ") == 1 + 4 + 1 + 4
    assert "http" not in page
    assert "tank.y is called tank_y here" in page
    assert main(["process", "new", "--model", str(out)]) == 0
    from identify.plants import load_model, open_plant
    from jaxmpc.process.file import load_process

    process = load_process(tmp_path / "model.toml")
    assert list(process.plants) == ["fmu", "model"]
    assert process.plants["fmu"].options["start"] == {"feed": 4}
    model = load_model(process)
    with open_plant(process) as plant_:
        start = plant_.init()
        assert start.mv.tolist() == [40, 0]
        assert start.cv[0] == pytest.approx(2 * 40 + 4, rel=1e-6)
        after = [plant_.step([40.0, 1.0], [0.0]).cv[0] for _ in range(5)][-1]
        assert after - start.cv[0] == pytest.approx(float(model.coefficients[0, 1, 4]), rel=1e-5)
    path.unlink()
    (tmp_path / "model.toml").unlink()
    assert main(["process", "new", "--model", str(out)]) == 0
    assert "Without the FMU as a plant" in capsys.readouterr().out
    assert list(load_process(tmp_path / "model.toml").plants) == ["model"]


def test_a_sweep_gives_a_gain_schedule_and_its_map(tmp_path, capsys):
    curved = LAG | {"rates": "d[0] = (u[0] * u[0] / 50 - x[0]) / 20"}
    out = tmp_path / "model.json"
    assert run(plant(tmp_path, **curved), "--at", "u=20,50,80", out=out) == 0
    schedule = ModelSchedule.load(tmp_path / "model.schedule.json")
    np.testing.assert_allclose(np.asarray(schedule.coefficients)[:, 0, 0, -1], [0.8, 2.0, 3.2], rtol=1e-6)
    told = capsys.readouterr().out
    assert "gain of u on y at u = 20: 0.8; u = 50: 2; u = 80: 3.2" in told
    assert "at u = 80, u on y is good: gain 3.2 m per %, dead time 0 s, settled after 80 s" in told
    assert "u = 80: 3.2" in (tmp_path / "model.html").read_text()
    with pytest.raises(InputError, match="one of the MVs u"):
        identify_fmu_schedule(tmp_path / "plant.fmu", {"u": (None, None)}, ["y"], DT, N, {"w": [1.0, 2.0]})


@pytest.mark.parametrize(
    ("options", "field", "says"),
    [
        (["--mv", "w=1"], "--mv", "Did you mean|a variable of the FMU"),
        (["--mv", "y"], "--mv", "an input or a tunable parameter"),
        (["--cv", "z"], "--cv", "a variable of the FMU"),
        (["--cv", "u"], "--cv", "an output or a local variable"),
        (["--dv", "u"], "--dv", "that is no MV"),
        (["--mv", "v=1:0"], "--mv v", "not zero"),
        (["--mv", "v=1:many"], "--mv", "NAME=NUMBER"),
        (["--mv", "v=101"], "--mv v", "from 0 to 100"),
        (["--mv", "v=50:60"], "--mv v", "a step to a finite number from 0 to 100"),
        (["--mv", "k=3:1.5"], "--mv k", "a step to a whole number"),
        (["--set", "u"], "--set", "NAME=VALUE"),
        (["--set", "w=1"], "--set", "a variable of the FMU"),
        (["--settle", "-1"], "--settle", "0 or more"),
        (["--dt", "10.5"], "--dt", "a whole number of steps of 1 s"),
        (["--samples", "1"], "--samples", "2 or more"),
        (["--at", "v=1,2"], "--at", "one of the MVs u"),
        (["--at", "u=1"], "--at u", "two or more"),
        (["--time", "t"], "--time", "not for an FMU"),
        (["--step", "u=1"], "--step", "not for an FMU"),
        (["--plant", "fmu"], "--plant", "not for an FMU"),
    ],
)  # fmt: skip
def test_what_cannot_be_asked_of_an_fmu_is_refused_by_the_name_of_the_option(
    tmp_path_factory, options, field, says, capsys
):
    folder = tmp_path_factory.getbasetemp() / "refusals"
    variables = [U, real("v", 1, start=1, min=0, max=100), whole("k", 0, start=3, min=0, max=10), Y]
    path = folder / "plant.fmu"
    if not path.exists():
        plant(folder, variables, **(LAG | {"tick": "abort()"}))  # nothing of it runs
    given = [] if options[0] == "--dt" else ["--dt", "10"]
    assert (
        main(
            [
                "identify",
                str(path),
                "--mv",
                "u=50:1",
                "--cv",
                "y",
                *given,
                *options,
                "--out",
                str(folder / "m.json"),
            ]
        )
        == 2
    )
    error = capsys.readouterr().err
    assert error.startswith(f"jaxmpc: {field}: got"), error
    assert re.search(says, error), error
    assert not list(folder.glob("m.*"))


def test_options_of_fmus_are_refused_for_a_process(tmp_path, capsys):
    assert main(["identify", "--settle", "3", "--out", str(tmp_path / "m.json")]) == 2
    assert "--settle: got 3.0, expected none: it is not for a process" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"modelDescription.xml": None}, "with a modelDescription.xml"),
        ({"modelDescription.xml": fmus.describe().replace('Version="2.0"', 'Version="1.0"')}, "its version is 1.0"),
        ({"library": None, "binaries/win32/sum.dll": "x"}, "it has one for win32"),
        ({"library": None, "sources/sum.c": "int x;"}, "only sources"),
        ({}, "can be loaded"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_fmu_for_here_ends_with_status_two_and_its_own_reason(
    tmp_path, content, says, capsys
):
    library = f"binaries/{fmpy.platform}/sum{fmpy.sharedLibraryExtension}"
    parts = {"modelDescription.xml": fmus.describe(), "library": "text"} | content
    named = {library if name == "library" else name: data for name, data in parts.items() if data is not None}
    path = fmus.pack(tmp_path / "test.fmu", named)
    out = tmp_path / "m.json"
    assert main(["identify", str(path), "--mv", "u=1:1", "--cv", "sum", "--dt", "10", "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxmpc: SOURCE: got")
    assert re.search(says, error), error
    assert "jaxmpc-fmu-" not in error
    assert not out.exists()


def test_a_file_that_is_no_archive_or_not_there_ends_with_status_two(tmp_path, capsys):
    (tmp_path / "text.fmu").write_text("text")
    for name, says in (("text.fmu", "zip archive"), ("none.fmu", "an existing .fmu file")):
        assert run(tmp_path / name, out=tmp_path / "m.json") == 2
        assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ({"outputs": "y[0] = u[0] > 50 ? 0.0 / 0.0 : 1"}, "the FMU gives -?nan for y"),
        ({"outputs": "y[0] = u[0] > 50 ? 1 / 0.0 : 1"}, "the FMU gives inf for y"),
        ({"tick": "if (u[0] > 50) { abort(); }"}, "signal SIGABRT during doStep"),
        ({"tick": "if (u[0] > 50) { for (;;); }"}, "did not come back from doStep"),
        ({"tick": "if (u[0] > 50) { return 3; }"}, "failed during doStep"),
    ],
)  # fmt: skip
def test_an_fmu_that_fails_in_a_test_ends_with_status_one_and_writes_nothing(tmp_path, code, says, capsys):
    path = plant(tmp_path, **code)
    assert run(path, "--time-limit", "1", out=tmp_path / "out" / "m.json") == 1
    assert re.search(says, capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


def test_an_fmu_is_told_the_end_that_its_tests_need(tmp_path):
    description = fmus.describe(
        attributes='canHandleVariableCommunicationStepSize="true"', experiment='stopTime="16"'
    )
    path = fmus.make_fmu(tmp_path, description, ends="16")
    got = identify_fmu(path, {"u": (6.0, 1.0)}, ["level"], DT, 40, start={"gain": 2.0})
    assert off(got, 2 * (1 - (5 / 6) ** np.arange(1, 41))) < 1e-9  # one Euler step of 10 s, lag of 60 s
