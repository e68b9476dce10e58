"""Models from files of other tools: round trips, what is assumed and said, and what is refused with its place."""

import json

import numpy as np
import pytest

from identify.foreign import mdf
from identify.foreign.common import Asked, Curve, resampled
from identify.foreign.formats import WRITTEN, export_model, import_model
from jaxmpc.cli.main import main
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import StepResponseModel, make_model
from tests.identify.septic_example import mdf as mdf_text

SUFFIX = {"septic": "", "lightweight": ".json", "neqsim": ".json", "numpy": ".npz"}
AFTER = 10.0 * np.arange(1, 31)


def example(**more) -> StepResponseModel:
    gains = np.array([[0.7, -1.3], [2.0, 0.1]])
    return make_model(
        gains[:, :, None] * (1 - np.exp(-AFTER / 70)),
        10.0,
        ["top", "bottom_level"],
        ["reflux", "steam_flow"],
        **{"cv_units": ["degC", "cm"], "mv_units": ["t/h", "%"], **more},
    )


def with_feed() -> StepResponseModel:
    feed = np.array([[0.2], [0.9]])[:, :, None] * (1 - np.exp(-AFTER / 30))
    return example(dv_coefficients=feed, dv_names=["feed"], dv_units=["t/h"])


def names(model):
    return {"cvs": model.cv_names, "mvs": model.mv_names, "dvs": model.dv_names}


# ------------------------------------------------------------------------------------------------------ round trips


@pytest.mark.parametrize("form", WRITTEN)
def test_a_model_that_is_written_comes_back_to_the_last_digit(tmp_path, form):
    model, out = example(), tmp_path / f"out{SUFFIX[form]}"
    export_model(model, form, out)
    asked = Asked(dt=10.0 if form == "lightweight" else None, **(names(model) if form == "septic" else {}))
    found, again = import_model([out], "", asked)
    assert found == form
    np.testing.assert_array_equal(again.model.coefficients, model.coefficients)
    assert (again.model.cv_names, again.model.mv_names, again.model.dt) == (
        model.cv_names,
        model.mv_names,
        10.0,
    )
    if form != "septic":  # whose model files have no units
        assert (again.model.cv_units, again.model.mv_units) == (model.cv_units, model.mv_units)


def test_a_table_of_step_responses_comes_back_with_its_measured_disturbance(tmp_path):
    model = with_feed()
    export_model(model, "neqsim", tmp_path / "out.csv")
    form, again = import_model([tmp_path / "out.csv"], "", Asked(dvs=("feed",)))
    assert form == "neqsim"
    np.testing.assert_array_equal(again.model.coefficients, model.coefficients)
    np.testing.assert_array_equal(again.model.dv_coefficients, model.dv_coefficients)


@pytest.mark.parametrize("form", ["septic", "numpy"])
def test_measured_disturbances_come_back_where_the_format_has_them(tmp_path, form):
    model, out = with_feed(), tmp_path / f"out{SUFFIX[form]}"
    export_model(model, form, out)
    _, again = import_model([out], "", Asked(**names(model)))
    np.testing.assert_array_equal(again.model.dv_coefficients, model.dv_coefficients)
    assert again.model.dv_names == ("feed",)


@pytest.mark.parametrize("form", ["lightweight", "neqsim"])
def test_what_a_format_cannot_say_is_said_on_the_way_out(tmp_path, form):
    _, notes = export_model(with_feed(), form, tmp_path / "out.json")
    assert any("feed" in note and "no equal" in note for note in notes)


def test_model_files_keep_every_printed_digit_there_and_back(tmp_path):
    printed = "0.0 0.1 0.30000000000000004 12345.678901234567 -1e-07 2.5"
    text = f"Nsecs= 10\nAmodl= 6\n{printed}\n"
    (tmp_path / "y_u.mdf").write_text(text)
    _, (model, _) = import_model([tmp_path / "y_u.mdf"])
    export_model(model, "septic", tmp_path / "out")
    values = mdf.read_file(tmp_path / "out" / "y_u.mdf").responses["A"]
    assert " ".join(map(repr, values.tolist())) == printed


def test_names_that_a_process_may_not_have_are_changed_and_come_back(tmp_path):
    body = {
        "model": {"n_CV": 1, "n_MV": 2, "N": 3},
        "CV": [{"output": "Gas rate", "init": 1.0, "unit": "m3/h", "S": [[1, 2, 3], [0.5]]}],
        "MV": [
            {"input": "21PT1.PV", "init": 2.0, "unit": "%"},
            {"input": "Gas-rate", "init": 0.0, "unit": ""},
        ],
    }
    (tmp_path / "in.json").write_text(json.dumps(body))
    _, (model, notes) = import_model([tmp_path / "in.json"], "", Asked(dt=60.0))
    assert (model.cv_names, model.mv_names) == (("Gas_rate",), ("v_21PT1_PV", "Gas_rate_2"))
    assert sum("renamed" in note for note in notes) == 3
    np.testing.assert_array_equal(model.coefficients, [[[1, 2, 3], [0.5, 0.5, 0.5]]])
    assert any("extended with its last value" in note for note in notes)
    export_model(model, "lightweight", tmp_path / "out.json")
    again = json.loads((tmp_path / "out.json").read_text())
    assert [cv["output"] for cv in again["CV"]] == ["Gas rate"]
    assert [mv["input"] for mv in again["MV"]] == ["21PT1.PV", "Gas-rate"]
    export_model(model, "septic", tmp_path / "files")
    listed = sorted(path.name for path in (tmp_path / "files").iterdir())
    assert listed == ["Gas_rate_21PT1.PV.mdf", "Gas_rate_Gas-rate.mdf"], "names of files are single words"


# ------------------------------------------------------------------------------------- sampling, first values, A and B


def test_every_second_value_is_exact_and_what_lies_between_is_linear():
    curve = Curve(5.0, np.array([1.0, 3.0, 4.0, 4.5, 4.6]))
    coarse, said = resampled(curve, 10.0)
    np.testing.assert_array_equal(coarse.values, [3.0, 4.5, 4.6])
    assert "every 2. value" in said
    fine, said = resampled(curve, 2.5)
    np.testing.assert_allclose(fine.values[:4], [0.5, 1.0, 2.0, 3.0])
    assert fine.values[-1] == 4.6
    assert "linear" in said


def test_first_values_are_at_time_0_unless_one_of_them_is_not_0(tmp_path):
    (tmp_path / "y_u.mdf").write_text(mdf_text([0.0, 1.0, 2.0]))
    _, (model, notes) = import_model([tmp_path])
    np.testing.assert_array_equal(model.coefficients, [[[1.0, 2.0]]])
    assert any("assumed: first values are S(0); --first-entry 1" in note for note in notes)
    (tmp_path / "y_v.mdf").write_text(mdf_text([0.5, 1.0, 2.0]))
    _, (model, notes) = import_model([tmp_path])
    np.testing.assert_array_equal(model.coefficients, [[[0.0, 1.0, 2.0], [0.5, 1.0, 2.0]]])
    assert any("assumed: first values are S(1)" in note and "y_v.mdf" in note for note in notes)
    _, (model, notes) = import_model([tmp_path], "", Asked(first_entry=0))
    np.testing.assert_array_equal(model.coefficients, [[[1.0, 2.0], [1.0, 2.0]]])
    assert any("0.5, is left out" in note for note in notes)


def test_the_other_response_of_a_file_is_taken_where_asked_and_a_difference_is_told(tmp_path):
    path = tmp_path / "y_u.mdf"
    path.write_text("Nsecs= 10\nAmodl= 3\n0 1 2\nBmodl= 3\n0 3\n4\n")
    _, (model, notes) = import_model([path])
    np.testing.assert_array_equal(model.coefficients, [[[1, 2]]])
    assert any("A and B differ" in note for note in notes)
    _, (model, _) = import_model([path], "", Asked(which="B"))
    np.testing.assert_array_equal(model.coefficients, [[[3, 4]]])
    path.write_text("Nsecs= 10\nAmodl= 3\n0 1 2\nBmodl= 0\n")
    with pytest.raises(InputError, match="no response B"):
        import_model([path], "", Asked(which="B"))


def test_intervals_that_differ_need_an_answer(tmp_path):
    (tmp_path / "y_u.mdf").write_text(mdf_text([0.0, 1.0, 2.0, 2.5], 5))
    (tmp_path / "y_v.mdf").write_text(mdf_text([0.0, 1.0, 2.0], 10))
    with pytest.raises(InputError, match="5 s, 10 s"):
        import_model([tmp_path])
    _, (model, _) = import_model([tmp_path], "", Asked(dt=10.0))
    np.testing.assert_array_equal(model.coefficients, [[[2.0, 2.5], [1.0, 2.0]]])


def test_names_with_underscores_are_taken_apart_by_names_that_are_known(tmp_path):
    (tmp_path / "oil_rate_gas_lift.mdf").write_text(mdf_text([0.0, 1.0]))
    with pytest.raises(InputError, match="Name every CV, MV and DV"):
        import_model([tmp_path])
    _, (model, _) = import_model([tmp_path], "", Asked(cvs=("oil_rate",), mvs=("gas_lift",)))
    assert (model.cv_names, model.mv_names) == (("oil_rate",), ("gas_lift",))
    (tmp_path / "oil_rat_gas_lift.mdf").write_text(mdf_text([0.0, 1.0]))
    with pytest.raises(InputError, match="Did you mean oil_rate_gas_lift"):
        import_model([tmp_path], "", Asked(cvs=("oil_rate",), mvs=("gas_lift",)))


# ------------------------------------------------------------------------------------------------ transfer functions


def exact(t, gain, constants, dead=0.0, lead=0.0):
    """Step response by partial fractions."""
    t = np.maximum(t - dead, 0.0)
    if len(constants) == 1:
        (a,) = constants
        return gain * (1 - (1 - lead / a) * np.exp(-t / a)) * (t > 0)
    a, b = constants
    return gain * (1 - ((a - lead) * np.exp(-t / a) - (b - lead) * np.exp(-t / b)) / (a - b)) * (t > 0)


def test_a_table_of_transfer_functions_is_sampled_exactly(tmp_path):
    (tmp_path / "t.csv").write_text(
        "CV;MV;Gain;Time constant [s];Time_constant_2;Dead time;Lead\ny;u;2,5;100;;15;\ny;v;-1,5;80;40;0;20\n"
    )
    form, (model, _) = import_model([tmp_path / "t.csv"], "", Asked(dt=10.0))
    assert form == "transfer-functions"
    t = 10.0 * np.arange(1, model.samples + 1)
    found = np.asarray(model.coefficients)[0]
    np.testing.assert_allclose(found[0], exact(t, 2.5, [100], 15), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found[1], exact(t, -1.5, [80, 40], 0, 20), rtol=1e-12, atol=1e-12)
    assert abs(found[0, -1] - 2.5) < 2.5e-3, "until all but a thousandth has come"


@pytest.mark.parametrize(("unit", "asked"), [("min", "s"), ("s", "min"), ("days", "s"), ("Hours", "h")])
def test_times_in_other_units_than_asked_for_are_refused(tmp_path, unit, asked):
    path = tmp_path / "table.csv"
    path.write_text(f"cv,mv,gain,dead time [{unit}],time constant\ny,u,2,3,10\n")
    wanted = Asked(dt=60.0, samples=20, time_unit=asked, dvs=())
    if unit.lower().startswith(asked):
        assert import_model([path], "", wanted)[1][0].samples == 20
        return
    with pytest.raises(
        InputError, match=rf"table.csv:1: got 'dead time \[{unit}\]', expected times in {asked}"
    ):
        import_model([path], "", wanted)


def test_minutes_integrators_and_unknown_columns_are_said(tmp_path):
    (tmp_path / "t.csv").write_text(
        "cv,mv,gain,tau,integrating,remark,cv_unit\nlevel,valve,0.6,0,yes,look,cm\nflow,valve,2,3,,,\n"
    )
    asked = Asked(dt=60.0, samples=20, time_unit="min", dvs=())
    _, (model, notes) = import_model([tmp_path / "t.csv"], "", asked)
    minutes = np.arange(1, 21)
    np.testing.assert_allclose(model.coefficients[0, 0], 0.6 * minutes, rtol=1e-9)  # 0.6 cm per minute
    np.testing.assert_allclose(model.coefficients[1, 0], exact(minutes, 2, [3]), rtol=1e-9)
    assert any("valve on level: integrates" in note for note in notes)
    assert any("unknown: column remark" in note for note in notes)
    assert model.cv_units == ("cm", "1")


def test_the_tables_of_neqsim_are_read(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("CV,MV,Gain,TimeConstant,DeadTime,SettlingTime\nP,Valve,-0.25,60.00,5.00,190.00\n")
    _, (model, notes) = import_model([path], "", Asked(dt=5.0))
    t = 5.0 * np.arange(1, model.samples + 1)
    np.testing.assert_allclose(model.coefficients[0, 0], exact(t, -0.25, [60], 5), atol=1e-12)
    assert any("not used: column SettlingTime" in note for note in notes)


def test_a_toml_list_is_that_of_a_process_file(tmp_path):
    (tmp_path / "t.toml").write_text(
        'dt = 10\nsamples = 8\nunits = { y = "bar" }\n'
        'transfer_functions = [{ cv = "y", mv = "u", gain = 2, time_constants = [50] }, { cv = "y", dv = "d", gain = 1 }]\n'
    )
    _, (model, _) = import_model([tmp_path / "t.toml"])
    np.testing.assert_allclose(model.coefficients[0, 0], exact(10.0 * np.arange(1, 9), 2, [50]), rtol=1e-12)
    assert (model.dv_names, model.cv_units) == (("d",), ("bar",))


# -------------------------------------------------------------------------------------------------------- NeqSim, NumPy


def test_a_whole_configuration_of_neqsim_gives_its_model_and_working_point(tmp_path):
    t = 60.0 * np.arange(40)
    body = {
        "header": {"format": "comprehensive_mpc_configuration"},
        "tuning": {"sampleTime": 60.0, "predictionHorizon": 20},
        "variables": {
            "mv": [
                {"name": "Valve.opening", "unit": "", "currentValue": 0.5, "limits": {"low": float("-inf")}}
            ],
            "cv": [{"name": "Sep.pressure", "unit": "bara", "currentValue": 50.0}],
            "dv": [{"name": "Feed.flow"}],
        },
        "model": {"stepResponseCoefficients": [[(3 * (1 - np.exp(-t / 300))).tolist()]]},
    }
    (tmp_path / "n.json").write_text(json.dumps(body))
    form, (model, notes) = import_model([tmp_path / "n.json"])
    assert form == "neqsim"
    np.testing.assert_allclose(model.coefficients[0, 0], 3 * (1 - np.exp(-t[1:] / 300)), rtol=1e-12)
    assert dict(model.working_point) == {"Sep_pressure": 50.0, "Valve_opening": 0.5}
    assert any("Feed.flow" in note for note in notes)


def test_one_time_constant_for_all_responses_is_pointed_out(tmp_path):
    common = {"cv": "y", "timeConstant": 60.0}
    pairs = [{**common, "mv": f"u{i}", "gain": i, "coefficients": [0, i / 2, i]} for i in (1, 2)]
    body = {"format": "step_response_model", "sampleTime": 10, "controlledVariables": [{"name": "y"}]}
    body |= {"manipulatedVariables": [{"name": "u1"}, {"name": "u2"}], "stepResponses": pairs}
    (tmp_path / "n.json").write_text(json.dumps(body))
    _, (model, notes) = import_model([tmp_path / "n.json"])
    np.testing.assert_array_equal(model.coefficients, [[[0.5, 1], [1, 2]]])
    assert any("60.0 s, the default of NeqSim's exporter" in note for note in notes)


def test_a_bare_array_takes_names_and_interval_from_the_command_line(tmp_path, capsys):
    np.save(tmp_path / "a.npy", np.asarray(example().coefficients))
    words = ["model", "import", str(tmp_path / "a.npy"), "--out", str(tmp_path / "m.json"), "--dt", "10"]
    assert main(words) == 2
    assert "--cv" in capsys.readouterr().err
    assert not (tmp_path / "m.json").exists()
    words += ["--cv", "top", "--cv", "bottom", "--mv", "reflux", "--mv", "steam"]
    assert main(words) == 0
    model = StepResponseModel.load(tmp_path / "m.json")
    np.testing.assert_array_equal(model.coefficients, example().coefficients)
    said = capsys.readouterr().out
    assert "assumed: first values are S(1)" in said
    assert f"Next: jaxmpc process new --model {tmp_path / 'm.json'}" in said
    assert any("first values" in note for note in dict(model.provenance)["notes"]), "the file remembers it"


# ------------------------------------------------------------------------------------------------------- refusals

MALFORMED = {  # content of a file, the place that is named, what is said
    "y_u.mdf truncated": ("Nsecs= 10\nAmodl= 4\n0 1\n2\n", ":2", "4 numbers"),
    "y_u.mdf too many": ("Nsecs= 10\nAmodl= 2\n0 1\n2\n", ":2", "2 numbers"),
    "y_u.mdf no number": ("Nsecs= 10\nAmodl= 3\n0 1\n2,5\n", ":4", "a value of Amodl"),
    "y_u.mdf not finite": ("Nsecs= 10\nAmodl= 3\n0 1\nnan\n", ":4", "a value of Amodl"),
    "y_u.mdf no count": ("Nsecs= 10\nAmodl= many\n0 1\n", ":2", "how many numbers"),
    "y_u.mdf twice": ("Nsecs= 10\nNsecs= 5\nAmodl= 1\n1\n", ":2", "each key once"),
    "y_u.mdf interval": ("Nsecs= -1\nAmodl= 2\n0 1\n", ":1", "positive sampling interval"),
    "y_u.mdf no interval": ("Amodl= 2\n0 1\n", "", "Give --dt"),
    "y_u.mdf nothing": ("hello\n", ":1", "Key= value"),
    "y_u.mdf none": ("Nsecs= 10\n", "", "a SEPTIC model file"),
    "y_u.pdf document": ("%PDF-1.4\n", "", "a text file"),
    "t.csv no gain": ("cv,mv\ny,u\n", ":1", "columns cv, mv, gain"),
    "t.csv no number": ("cv,mv,gain,tau\ny,u,1,10\ny,v,two,10\n", ":3", "a number: gain"),
    "t.csv cells": ("cv,mv,gain,tau\ny,u,1\n", ":2", "4 cells"),
    "t.csv negative": ("cv,mv,gain,tau\ny,u,1,-3\n", ":2", "a time constant of 0 or more"),
    "t.csv pair twice": ("cv,mv,gain,tau\ny,u,1,3\ny,u,2,3\n", "transfer_functions[1]", "each pair once"),
    "s.csv uneven": ("Time,y/u\n0,0\n10,1\n25,2\n", ": Time", "one sampling interval apart"),
    "s.csv start": ("Time,y/u\n10,1\n20,2\n30,2\n", ":2", "time 0 in the first row"),
    "l.json counts": (
        '{"model": {"n_CV": 2, "n_MV": 1, "N": 1}, "CV": [{"output": "y"}], "MV": [{"input": "u"}]}',
        "model.n_CV",
        "got 2",
    ),
    "l.json long": (
        '{"model": {"n_CV": 1, "n_MV": 1, "N": 1}, "CV": [{"output": "y", "S": [[1, 2]]}], "MV": [{"input": "u"}]}',
        "CV[0].S[0]",
        "1 to N = 1",
    ),
    "o.json other": ('{"a": 1}', "FILE", "Light-weight-MPC or an export of NeqSim"),
    "o.json broken": ('{"a": ', "file", "readable JSON"),
    "t.toml key": ("dt = 10\nfunctions = []\n", "functions", "no such field"),
    "x.npz none": ("not a zip", "file", "NumPy arrays"),
    "x.foo unknown": ("", "FILE", "a known format"),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_a_malformed_file_is_refused_with_its_place(tmp_path, case):
    text, place, says = MALFORMED[case]
    path = tmp_path / case.split()[0]
    path.write_text(text)
    asked = Asked(dt=None if path.suffix in (".mdf", ".toml") else 10.0)
    with pytest.raises(InputError) as caught:
        import_model([path], "", asked)
    assert place in caught.value.field
    assert says in str(caught.value)


@pytest.mark.parametrize("end", range(0, 200, 13))
def test_a_model_file_that_ends_anywhere_is_read_or_refused(tmp_path, end):
    path = tmp_path / "y_u.mdf"
    path.write_text(mdf_text(np.linspace(0, 1, 20))[:end])
    try:
        _, (model, _) = import_model([path])
    except InputError:
        return
    assert model.samples == 19


def test_folders_of_model_files_pass_over_documents_and_refuse_what_is_not_there(tmp_path):
    (tmp_path / "y_u.mdf").write_text(mdf_text([0.0, 1.0]))
    (tmp_path / "figure.pdf").write_bytes(b"%PDF-1.7 ...")
    _, (model, _) = import_model([tmp_path])
    assert model.cv_names == ("y",)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="model files"):
        import_model([tmp_path / "empty"])
    with pytest.raises(InputError, match="that is there"):
        import_model([tmp_path / "absent.mdf"])
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "Y_u.pdf").write_text(mdf_text([0.0, 1.0]))
    with pytest.raises(InputError, match="each pair once"):
        import_model([tmp_path, tmp_path / "more"], "", Asked(cvs=("y",), mvs=("u",)))


def test_an_export_never_overwrites_an_application(tmp_path):
    export_model(example(), "septic", tmp_path)
    with pytest.raises(InputError, match="not overwritten"):
        export_model(example(), "septic", tmp_path)


def test_wrong_formats_and_names_of_files_are_refused_before_anything_is_written(tmp_path):
    with pytest.raises(InputError, match="one of septic"):
        export_model(example(), "septik", tmp_path / "x")
    with pytest.raises(InputError, match=r"ends in \.json or \.csv"):
        export_model(example(), "neqsim", tmp_path / "x.txt")
    with pytest.raises(InputError, match="begin with S"):
        export_model(example(), "lightweight", tmp_path / "x.json", Asked(first_entry=0))
    assert list(tmp_path.iterdir()) == []


def test_names_that_could_leave_the_folder_do_not(tmp_path):
    body = {
        "model": {"n_CV": 1, "n_MV": 1, "N": 2},
        "CV": [{"output": "../up", "S": [[1, 2]]}],
        "MV": [{"input": "/etc/u"}],
    }
    (tmp_path / "in.json").write_text(json.dumps(body))
    _, (model, _) = import_model([tmp_path / "in.json"], "", Asked(dt=1.0))
    files, _ = export_model(model, "septic", tmp_path / "out")
    assert [path.name for path in files] == ["up_etc_u.mdf"]
