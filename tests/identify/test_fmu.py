"""An FMU of any process as a plant: what is set and read, how it is stepped, what is refused, and what is told of it."""

import math

import pytest

from identify.fmu import FmuPlant
from jaxmpc.cli.main import main
from jaxmpc.errors import InputError, PlantError
from jaxmpc.process.actuator import Actuator
from tests import fmus

VARIES = 'canHandleVariableCommunicationStepSize="true"'


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """An FMU that takes steps of any size and proposes none."""
    return fmus.make_fmu(tmp_path_factory.mktemp("fmu"), fmus.describe(attributes=VARIES))


@pytest.fixture(scope="module")
def crashing(tmp_path_factory):
    """An FMU that takes steps of one size and crashes when it is loaded."""
    crash = "__attribute__((constructor)) static void f(void) { abort(); }"
    experiment = 'startTime="0" stopTime="16" stepSize="0.1"'
    return fmus.make_fmu(
        tmp_path_factory.mktemp("crash"), fmus.describe(experiment=experiment), on_load=crash
    )


# ------------------------------------------------------------------------------------------------ what is exchanged


def test_demands_are_limited_and_rounded_as_the_types_want_it_and_the_plant_says_where_they_stand(path):
    mv = {"u": (0.0, 10.0), "n": Actuator("values", values=(0.0, 4.0)), "b": None, "mode": None}
    with FmuPlant(path, mv, ["sum", "steps"], dt=10.0) as plant:
        assert plant.init().mv.tolist() == [0, 0, 0, 0]
        out = plant.step([12.5, 3.1, 0.5, 3.0])
        assert out.mv.tolist() == [10, 4, 1, 2]  # mode 3 is none; 2 is nearest
        assert out.cv.tolist() == [10 + 4 + 100 + 2000, 1]
        out = plant.step([-1.0, 1.5, 0.49, 1e9])
        assert out.mv.tolist() == [0, 0, 0, 5]
        assert out.cv[0] == 5000


def test_disturbances_are_changes_from_what_their_variables_start_with(path):
    with FmuPlant(path, ["u"], ["sum"], {"n": 3, "bias": 0.5, "mode": "auto"}, dt=10.0) as plant:
        assert plant.disturbance_names == ("n", "bias", "mode")
        assert plant.init().cv == 2003.5
        assert plant.step([1.0], [1.6, -0.25, 3.0]).cv == 1 + 5 + 0.25 + 5000
        assert plant.step([1.0], 0.0).cv == 2004.5


def test_signals_have_the_names_of_the_process_whatever_the_fmu_calls_them(path):
    variables = {"valve": "u", "load": "bias", "total": "sum"}
    given = dict(dt=10.0, variables=variables, working_point={"valve": 2.0})
    with FmuPlant(path, {"valve": (0.0, 10.0)}, ["total"], ["load"], **given) as plant:
        assert (plant.mv_names, plant.cv_names, plant.disturbance_names) == (
            ("valve",),
            ("total",),
            ("load",),
        )
        undisturbed = plant.init().cv
        assert plant.step([12.0], [0.25]).cv - undisturbed == 10.0 - 2.0 + 0.25
        assert plant.replaced({}).disturbance_names == ("load",)


def test_every_type_of_fmi_3_is_set_and_the_end_that_an_fmu_asks_for_is_told(tmp_path):
    path = fmus.make_fmu3(tmp_path)
    largest = {"Int8": 2**7 - 1, "UInt8": 2**8 - 1, "Int16": 2**15 - 1, "UInt16": 2**16 - 1}
    largest |= {"Int32": 2**31 - 1, "UInt32": 2**32 - 1, "Boolean": 1}
    with FmuPlant(
        path, [*largest, "Float64", "Float32", "Int64", "UInt64", "mode"], ["sum"], dt=10.0
    ) as plant:
        out = plant.step([*[1e12] * len(largest), 0.1, 0.5, -3.4, -2.0, 7.0]) if plant.init() else None
        assert out.mv.tolist() == [*largest.values(), 0.1, 0.5, -3, 0, 2]
        assert out.cv == pytest.approx(sum(largest.values()) + 0.6 - 3 + 2)
        low = plant.step([*[-1e12] * len(largest), 0.0, 0.0, 0.0, 0.0, 0.0])
        assert low.mv.tolist() == [-(2**7), 0, -(2**15), 0, -(2**31), 0, 0, 0, 0, 0, 0, 1]
        for _ in range(3):
            plant.step(low.mv)
        with pytest.raises(
            PlantError, match=r"during doStep at t = 50 s: it asks for the end of the simulation"
        ):
            plant.step(low.mv)


def test_start_values_and_parameters_hold_from_the_first_moment_in_every_run_and_can_be_replaced(path):
    start = {"gain": 2.0, "mode": "manual", "b": True, "level": 7.0}
    with FmuPlant(path, ["u"], ["sum", "level"], dt=10.0, start=start) as plant:
        for _ in range(2):
            assert plant.init().cv.tolist() == [2 * 5100, 7]
            assert plant.step([1.0]).cv.tolist() == pytest.approx([2 * 5101, 7 + (2 * 5101 - 7) / 6])
        with pytest.raises(InputError, match=r"plant.gain: got 11.0, expected a number from 0 to 10"):
            plant.replaced({"gain": 11.0})
        with pytest.raises(InputError, match=r"plant.level: .* a parameter of the plant: gain, bias"):
            plant.replaced({"level": 1.0})
        assert [(p.name, p.default) for p in plant.parameter_table] == [("gain", 2.0), ("bias", 0.0)]
        with plant.replaced({"gain": 3.0}) as other, plant.replaced({}) as same:
            assert other.init().cv.tolist() == [3 * 5100, 7]
            assert plant.step([1.0]).cv[0] == 2 * 5101
            assert same.facts() == plant.facts()
            assert other.facts()["hash"] != plant.facts()["hash"]
            assert plant.facts()["kind"] == "fmu"


def test_a_plant_settles_at_its_working_point_before_it_is_handed_over(path):
    point = {"u": 6.0, "mode": "off"}
    with FmuPlant(path, ["u", "mode"], ["level"], dt=10.0, working_point=point, settle=3600.0) as plant:
        out = plant.init()
        assert out.mv.tolist() == [6, 0]
        assert out.cv == pytest.approx(6.0, rel=1e-9)
        assert plant.step(out.mv).cv == pytest.approx(6.0, rel=1e-9)


def test_an_output_of_the_fmu_can_tell_where_an_actuator_stands(path):
    with FmuPlant(path, ["n", "u"], ["sum"], dt=10.0, positions={"u": "level"}) as plant:
        plant.init()
        assert plant.step([1.0, 6.0]).mv.tolist() == [1.0, pytest.approx(7.0 / 6)]


# ------------------------------------------------------------------------------------------------------- its steps


@pytest.mark.parametrize(
    ("attributes", "step", "substep", "steps"),
    [
        (VARIES, None, None, 1),
        (VARIES, 0.5, None, 20),
        (VARIES, 0.3, None, 34),  # 33.3 of them would be too long
        (VARIES, 0.5, 2.5, 4),
        (VARIES, 60.0, None, 1),
        ("", None, None, 1),
        ("", 0.1, None, 100),
    ],
)
def test_a_sample_is_made_of_the_steps_of_the_fmu(tmp_path, attributes, step, substep, steps):
    experiment = "" if step is None else f'stepSize="{step}"'
    path = fmus.make_fmu(tmp_path, fmus.describe(attributes=attributes, experiment=experiment))
    with FmuPlant(path, ["u"], ["steps", "time"], dt=10.0, substep=substep) as plant:
        plant.init()
        for k in (1, 2):
            assert plant.step([0.0]).cv.tolist() == [k * steps, pytest.approx(k * 10.0, rel=1e-14)]


def test_an_fmu_that_ends_with_its_default_experiment_says_so_and_goes_on_when_it_is_told_another_end(
    tmp_path,
):
    path = fmus.make_fmu(tmp_path, fmus.describe(attributes=VARIES, experiment='stopTime="16"'), ends="16")
    with FmuPlant(path, ["u"], ["sum"], dt=4.0) as plant:
        plant.init()
        for _ in range(4):
            plant.step([0.0])
        with pytest.raises(PlantError, match=r"t = 16 s: .*experiment ends at 16 s: give a later stop_time"):
            plant.step([0.0])
    with FmuPlant(path, ["u"], ["time"], dt=4.0, stop_time=1e6) as plant:
        plant.init()
        assert [plant.step([0.0]).cv for _ in range(10)][-1] == 40.0


def test_held_demands_give_what_as_many_steps_give(path):
    with FmuPlant(path, {"u": (0.0, 10.0), "n": None}, ["level", "steps"], dt=10.0) as plant:
        plant.init()
        stepped = [plant.step([12.0, 1.4]).cv.tolist() for _ in range(5)]
        plant.init()
        assert plant.hold([12.0, 1.4], 2).tolist() == stepped[:2]
        assert plant.hold([12.0, 1.4], 3).tolist() == stepped[2:]
        assert plant.measure().mv.tolist() == [10, 1]


# -------------------------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("change", "field", "reason"),
    [
        ({"mv": ["uu"]}, "plant.mv", "Did you mean u"),
        ({"mv": ["sum"]}, "plant.mv", "an input or a tunable parameter .*this is Real, continuous output"),
        ({"mv": ["gain"]}, "plant.mv", "this is Real, fixed parameter"),
        ({"mv": []}, "plant.mv", "names of variables"),
        ({"mv": ["u", "u"]}, "plant.mv", "each once"),
        ({"mv": {"u": (1.0, 0.0)}}, "plant.mv.u", "low below high"),
        ({"cv": ["summ"]}, "plant.cv", "Did you mean sum"),
        ({"cv": ["u"]}, "plant.cv", "an output or a local variable"),
        ({"cv": ["text"]}, "plant.cv", "that holds a number .*String"),
        ({"cv": "sum"}, "plant.cv", "names of variables"),
        ({"disturbances": ["u"]}, "plant.disturbances", "that is no MV"),
        ({"disturbances": {"n": 1.5}}, "plant.disturbances.n", "a whole number from -2147483648"),
        ({"start": {"gian": 1.0}}, "plant.start", "Did you mean gain"),
        ({"start": {"sum": 1.0}}, "plant.start", "a start value or a parameter"),
        ({"start": {"gain": 11.0}}, "plant.start.gain", "a finite number from 0 to 10"),
        ({"start": {"mode": "on"}}, "plant.start.mode", "one of off, auto, manual"),
        ({"start": {"b": "yes"}}, "plant.start.b", "true or false"),
        ({"working_point": {"n": 1}}, "plant.working_point", "one of the MVs u"),
        ({"working_point": {"u": math.nan}}, "plant.working_point.u", r"a finite number \[m3/h\]"),
        ({"positions": {"u": "n"}}, "plant.positions", "an output"),
        ({"dt": 0.0}, "plant.dt", "seconds"),
        ({"dt": 10.05}, "plant.dt", "whole number of steps of 0.1 s"),
        ({"substep": 3.0}, "plant.substep", "divides dt, 10 s"),
        ({"settle": -1.0}, "plant.settle", "0 or more"),
        ({"stop_time": 0.0}, "plant.stop_time", "seconds"),
    ],
)
def test_a_plant_that_the_fmu_cannot_be_is_refused_before_anything_of_the_fmu_runs(
    crashing, change, field, reason
):
    given = {"mv": ["u"], "cv": ["sum"], "dt": 10.0} | change
    with pytest.raises(InputError, match=reason) as caught:
        FmuPlant(crashing, **given)
    assert caught.value.field == field


def test_elements_of_arrays_are_variables_and_whole_arrays_are_none(tmp_path):
    path = fmus.make_fmu3(tmp_path)
    start = {"table[1,1]": 10.0, "table[2,3]": 20.0, "row[1]": 0.5}
    with FmuPlant(
        path, ["row[2]", "row[1]"], ["table[1,1]", "table[2,3]", "sum"], dt=1.0, start=start
    ) as plant:
        assert plant.init().mv.tolist() == [0, 0.5]
        assert plant.step([3.0, 4.0]).cv.tolist() == [10, 20, 10 + 20 + 3 + 4]
        assert plant.working_point.tolist() == [0, 0.5]
    with pytest.raises(InputError, match=r"such as table\[1,1\] \(it is an array of 2 x 3\)"):
        FmuPlant(path, ["row[1]"], ["table"], dt=1.0)
    for name in ("row[3]", "row[0]", "row[1,1]", "sum[1]"):
        with pytest.raises(InputError, match="a variable of the FMU"):
            FmuPlant(path, ["row[1]"], [name], dt=1.0)


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda p: p.step([1.0, math.nan]), "mv"),
        (lambda p: p.step([1.0]), "mv"),
        (lambda p: p.step([1.0, 2.0], [math.inf]), "bias"),
        (lambda p: p.step([1.0, 2.0], [1.0, 2.0]), "disturbance"),
    ],
)
def test_bad_demands_and_disturbances_are_refused_and_move_nothing(path, call, field):
    with FmuPlant(path, ["u", "n"], ["sum", "time"], ["bias"], dt=10.0) as plant:
        with pytest.raises(InputError, match="after init"):
            plant.step([1.0, 2.0])
        plant.init()
        before = plant.step([1.0, 2.0])
        with pytest.raises(InputError) as caught:
            call(plant)
        assert caught.value.field == field
        assert plant.measure().cv.tolist() == before.cv.tolist()
        assert plant.measure().mv.tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("if (t == 20) { r[4] = NAN; }", "the FMU gives nan for sum"),
        ("if (t == 20) { abort(); }", "ended its process with signal SIGABRT during doStep at t = 20 s"),
        ("if (t == 20) { for (;;); }", "did not come back from doStep at t = 20 s within 1 s"),
    ],
)
def test_an_fmu_that_fails_during_a_run_is_a_plant_that_fails(tmp_path, code, reason):
    path = fmus.make_fmu(tmp_path, fmus.describe(attributes=VARIES), do_step=code)
    with FmuPlant(path, ["u"], ["sum"], dt=10.0, time_limit=1.0) as plant:
        plant.init()
        plant.step([0.0])
        plant.step([0.0])
        with pytest.raises(PlantError, match=reason):
            plant.step([0.0])


# ------------------------------------------------------------------------------------------------------ what is told


def test_fmu_info_lists_what_an_fmu_is_without_loading_it(tmp_path, capsys):
    experiment = 'startTime="0" stopTime="16" stepSize="0.1"'
    crash = "__attribute__((constructor)) static void f(void) { abort(); }"
    description = fmus.describe("ModelExchange", experiment=experiment)
    assert main(["fmu", "info", str(fmus.make_fmu(tmp_path, description, on_load=crash))]) == 0
    told = capsys.readouterr().out
    lines = [" ".join(line.split()) for line in told.splitlines()]
    assert "FMI 2.0, model exchange" in lines
    assert "experiment start 0 s, stop 16 s, step 0.1 s" in lines
    assert "u Real m3/h input continuous 0" in lines
    assert "mode Enumeration input discrete 0 (off) 0 off, 2 auto, 5 manual" in lines
    assert "gain Real parameter fixed 1 0..10" in lines
    assert "bias Real parameter tunable 0 added to the sum" in lines
    assert main(["fmu", "info", str(fmus.make_fmu3(tmp_path))]) == 0
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "row Float64[2] input continuous 0 0" in lines
    assert "steps all of one size, its own are of 0.5 s" in lines


def test_fmu_info_of_what_is_no_fmu_ends_with_status_two_and_one_line(tmp_path, capsys):
    (tmp_path / "text.fmu").write_text("text")
    assert main(["fmu", "info", str(tmp_path / "text.fmu")]) == 2
    out, error = capsys.readouterr()
    assert out == ""
    assert error.startswith("jaxmpc: FMU: got")
    assert error.count("\n") == 1


def test_a_step_of_fmi_3_that_returns_early_is_gone_on_with(tmp_path):
    path = fmus.make_fmu3(tmp_path, do_step="if (h > 0.3) { h = 0.2; *early = true; } x[40] += h")
    with FmuPlant(path, ["Float64"], ["sum"], dt=1.0) as plant:
        plant.init()
        assert plant.step([0.0]).cv[0] == pytest.approx(1.0)
