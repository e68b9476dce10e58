"""SEPTIC applications: what each attribute becomes, that none is lost, round trips, and refusals with file and line."""

import contextlib
import tomllib

import numpy as np
import pytest

from identify.foreign import cnfg
from identify.foreign.common import Asked
from identify.foreign.septic import Choices, read_application
from identify.foreign.septic_out import export_process
from identify.judge import judge
from identify.plants import model_of
from jaxmpc.cli.main import main
from jaxmpc.errors import InputError
from jaxmpc.files import toml_text
from jaxmpc.process.file import load_process, process_of
from tests.identify.septic_example import CNFG, PAIRS, mdf, response, write


def converted(folder, asked=None, **choices):
    return read_application(folder, "control.json", "control", asked or Asked(), Choices(**choices))


def stored(made, folder):
    """The process of a conversion, from its files."""
    folder.mkdir(exist_ok=True)
    made.model.save(folder / "control.json")
    (folder / "control.toml").write_text(toml_text(made.body))
    return load_process(folder / "control.toml")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return converted(write(tmp_path_factory.mktemp("septic")))


def test_every_attribute_of_a_configuration_is_in_one_list_of_the_report(made):
    listed = sorted((row.subject, name) for row in made.report.rows for name in row.attributes)
    blocks = cnfg.parsed(CNFG)
    assert listed == sorted(
        (f"{block.kind} {block.name}", a.name) for block in blocks for a in block.attributes
    )


def test_what_is_in_no_public_description_is_unknown_with_its_line_and_not_dropped(made):
    unknown = {
        (row.subject, *row.attributes, row.place) for row in made.report.rows if row.level == "unknown"
    }
    line = CNFG[: CNFG.index("Surprise")].count("\n") + 1
    gadget = CNFG[: CNFG.index("Gadget")].count("\n") + 1
    assert unknown == {
        ("Cvr Level", "Surprise", f"control.cnfg:{line}"),
        ("Gadget New", "Size", f"control.cnfg:{gadget}"),
    }
    assert any("Surprise" in line for line in made.report.summary())


def test_passwords_are_not_in_the_report(made):
    assert "RootPwd" in made.report.text("x")
    assert "secret" not in made.report.text("x")


def test_names_units_limits_moves_and_blocks_are_those_of_the_configuration(made):
    body = made.body
    valve, pump = body["mv"]
    assert (valve["label"], valve["unit"], valve["span"]) == ("Outlet valve", "%", 20)
    assert (valve["low"], valve["high"], valve["move"]) == (10, 90, 4)
    assert not {"low", "high"} & set(pump), "limits that are off or 1e10 are none"
    level, flow = body["cv"]
    assert (level["high"], "low" in level, "high" in flow) == (150, False, False)
    preset, structure = body["presets"]["septic"], body["structure"]
    assert preset["move_high"] == {"Valve": 2, "Pump": 1}
    assert preset["move_low"] == {"Valve": -4, "Pump": -1}
    assert structure["prediction_horizon"] == 50
    assert structure["control_horizon"] == 40
    assert structure["blocks"] == [[2, 4, 8, 26], [5, 10, 25]], (
        "the count is no block; the longer list is cut"
    )
    assert structure["first_penalised"] == 3
    assert (preset["bad_limit"], preset["measurement_high"]) == ({"Level": 3}, {"Level": 200})
    assert body["dt"] == 10
    assert body["references"]["setpoints"]["windows"] == [[0, 125, 31]]
    assert preset["bias_cutoff"] == pytest.approx(1 / 20)
    assert dict(made.model.working_point) == {"Level": 120, "Flow": 30, "Valve": 50, "Pump": 45}


def test_penalties_are_scaled_by_spans_unless_asked_for_as_they_are(tmp_path, made):
    scaled = made.body["presets"]["septic"]
    assert scaled["move_weight"] == {"Valve": pytest.approx(8 / 400), "Pump": pytest.approx(2 / 100)}
    plain = converted(write(tmp_path / "plain"), weights="plain").body["presets"]["septic"]
    assert plain["move_weight"] == {"Valve": 8, "Pump": 2}
    assert any("--weights plain" in note for note in made.report.notes)
    # a violation of one span that lasts over the horizon costs the same: Hp * penalty = price * span
    assert scaled["slack_weight"]["Level"] * 10 == pytest.approx(50 * 2)


def test_a_deadband_by_calculation_becomes_a_deadzone_outside_of_which_the_weight_is_soft(made):
    preset = made.body["presets"]["septic"]
    assert preset["deadzone"] == {"Level": 1.5}
    assert preset["soft_quadratic"] == {"Level": pytest.approx(4 / 100)}
    assert preset["cv_weight"] == {"Level": 0, "Flow": 0}, "inside nothing costs; Flow has no setpoint"
    assert any("deadband of Level" in note for note in made.report.notes)


def test_the_model_has_the_responses_of_the_files_zero_where_there_is_none(made):
    model = made.model
    assert (model.cv_names, model.mv_names, model.dv_names) == (
        ("Level", "Flow"),
        ("Valve", "Pump"),
        ("Feed",),
    )
    for (cv, of), _ in PAIRS.items():
        table = model.dv_coefficients if of == "Feed" else model.coefficients
        names = model.dv_names if of == "Feed" else model.mv_names
        found = np.asarray(table)[model.cv_names.index(cv), names.index(of)]
        np.testing.assert_array_equal(found, response(cv, of)[1:])
    assert not np.asarray(model.coefficients)[1, 1].any()
    assert any("Pump on Flow" in note and "no response" in note for note in made.report.notes)


def test_model_files_of_another_sampling_interval_are_resampled_to_that_of_the_configuration(tmp_path):
    folder = write(tmp_path / "app")
    gain, constant = PAIRS["Flow", "Valve"]
    fine = gain * (1 - np.exp(-5.0 * np.arange(121) / constant))
    (folder / "Flow_Valve.mdf").write_text(mdf(fine, 5))
    made = converted(folder)
    found = np.asarray(made.model.coefficients)[1, 0]
    np.testing.assert_allclose(found, response("Flow", "Valve")[1:], atol=1e-6)  # printed digits
    assert any("resampled from 5 s to 10 s: every 2. value" in note for note in made.report.notes)


def test_steps_of_an_actuator_and_the_place_of_the_first_value_are_answers_of_the_user(tmp_path):
    folder = write(tmp_path / "app")
    made = converted(folder, Asked(first_entry=1), steps={"Valve": 2.0})
    assert made.body["mv"][0]["actuator"] == {"kind": "stepped", "step": 2.0}
    np.testing.assert_array_equal(np.asarray(made.model.coefficients)[0, 0], response("Level", "Valve"))
    with pytest.raises(InputError, match="an MV of the model"):
        converted(folder, steps={"Vale": 2.0})


def test_what_has_an_equal_survives_the_way_out_and_back(tmp_path, made):
    process = stored(made, tmp_path / "one")
    out = tmp_path / "out"
    files, report = export_process(process, model_of(process), out, "", "span", Asked())
    assert out / "Level_Feed.mdf" in files
    again = converted(out)
    np.testing.assert_array_equal(again.model.coefficients, made.model.coefficients)
    np.testing.assert_array_equal(again.model.dv_coefficients, made.model.dv_coefficients)
    assert again.model.working_point == made.model.working_point
    for key in ("cv", "mv", "structure", "dt"):
        assert again.body[key] == made.body[key], key
    assert again.body["references"]["setpoints"] == made.body["references"]["setpoints"]
    before, after = made.body["presets"]["septic"], again.body["presets"]["septic"]
    for key in (
        "move_weight",
        "slack_weight",
        "bad_limit",
        "measurement_high",
        "move_high",
        "move_low",
        "bias_cutoff",
    ):
        assert after[key] == pytest.approx(before[key]), key
    lost = {row.attributes[0] for row in report.rows if row.level == "none"}
    assert {"deadzone", "plants"} <= lost
    # far outside the deadzone, the weight is the same
    assert after["cv_weight"] == pytest.approx(before["soft_quadratic"] | {"Flow": 0.0})


def test_an_ideal_value_that_is_on_is_one_here_and_comes_back(tmp_path):
    text = CNFG.replace("IvOff=  100", "IvOn=  70\n          Fulf=  6", 1)
    assert text != CNFG
    made = converted(write(tmp_path / "in", text))
    preset = made.body["presets"]["septic"]
    (valve,) = preset["ideal"]
    assert preset["ideal"] == {valve: 70.0}
    assert preset["ideal_weight"] == {valve: pytest.approx(6 / 20**2)}  # its span is 20 %
    process, out = stored(made, tmp_path / "one"), tmp_path / "out"
    export_process(process, model_of(process), out, "", "span", Asked())
    again = converted(out).body["presets"]["septic"]
    assert again["ideal"][valve] == 70.0
    assert again["ideal_weight"][valve] == pytest.approx(6 / 20**2)


def test_a_shipped_process_goes_out_and_comes_back_with_its_feed_forward(tmp_path):
    process = load_process("wood-berry")
    model = model_of(process)
    _, report = export_process(process, model, tmp_path / "out", "", "span", Asked())
    again = converted(tmp_path / "out")
    np.testing.assert_array_equal(again.model.coefficients, model.coefficients)
    np.testing.assert_array_equal(again.model.dv_coefficients, model.dv_coefficients)
    assert any("actuator" in row.attributes for row in report.rows if row.level == "none")
    with pytest.raises(InputError, match="not overwritten"):
        export_process(process, model, tmp_path / "out", "", "span", Asked())


def test_the_command_writes_process_model_and_report_which_the_check_accepts(tmp_path, capsys):
    folder = write(tmp_path / "app")
    out = tmp_path / "mine.toml"
    assert main(["process", "new", "--septic", str(folder), "--out", str(out), "--step", "Valve=2"]) == 0
    said = capsys.readouterr().out
    assert "Unknown, not used: 2" in said
    assert "Surprise" in said
    assert (
        (tmp_path / "mine-septic.md").read_text().startswith("# mine: what became of the SEPTIC application")
    )
    process = load_process(out)
    assert not [
        f
        for f in judge(process, model_of(process))
        if "cannot be held" in f.says and "setpoints" not in f.subject
    ]
    assert main(["process", "new", "--septic", str(folder), "--out", str(out)]) == 2, "nothing is overwritten"
    assert main(["process", "new", "--model", str(tmp_path / "mine.json"), "--weights", "plain"]) == 2
    assert "--weights: got 'plain', expected nothing: it is of --septic" in capsys.readouterr().err
    assert main(["process", "export", str(out), "--to", "septic", "--out", str(tmp_path / "back")]) == 0
    assert (tmp_path / "back" / "mine.cnfg").is_file()


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "utf-8-sig", "utf-16"])
def test_encodings_ends_of_lines_and_tabs_are_read_alike(tmp_path, encoding, made):
    folder = write(tmp_path / "app")
    text = CNFG.replace("Outlet valve", "Utløp").replace("\n", "\r\n").replace("  ", "\t")
    (folder / "control.cnfg").write_bytes(text.encode(encoding))
    body = converted(folder).body
    assert body["mv"][0].pop("label") == "Utløp"
    assert body["mv"][0] == {k: v for k, v in made.body["mv"][0].items() if k != "label"}
    assert body["presets"] == made.body["presets"]


REFUSED = {  # what is changed in the file, the line of the error in it, and what it says
    "count": ("Blocking=  4    2", "Blocking=  5    2", "Blocking", "5 numbers after their count"),
    "no count": ("Blocking=  3    5", "Blocking=  3.5    5", "Blocking=  3", "how many follow"),
    "no number": ("MaxUp=  2", "MaxUp=  two", "MaxUp", "a number: largest move up"),
    "text": ("MaxUp=  2", 'MaxUp=  "2"', "MaxUp", "one number: largest move up"),
    "sign": ("MaxDn=  -4", "MaxDn=  4", "MaxDn", "a move of 0 or less"),
    "limits": ("LowOn=  10", "LowOn=  95", "LowOn", "less than the high limit 90"),
    "twice": ("Span=  20", "Span=  20\n Span=  21", "Span=  21", "Span once"),
    "both": ("SetPntOn=  125", "SetPntOn=  125\n SetPntOff=  1", "SetPntOff=  1", "SetPnt once"),
    "block twice": (
        "Mvr:           Pump",
        "Mvr:           Valve",
        'Mvr:           Valve\n          Unit=  "Hz',
        "a name of its own",
    ),
    "quote": ('"Outlet valve"', '"Outlet valve', "Outlet valve", "a quote that ends"),
    "orphan": ("  System:", "Span= 1\n  System:", "Span= 1", "a block first"),
    "stray": ("  System: ", "stray\n  System: ", "stray", "'Type:  Name'"),
    "template": ("Mvr:           Pump", "Mvr:           {{ Pump }}", "{{", "not a template"),
    "horizon": ("Npred=  50", "Npred=  0", "Npred", "1 or more: Npred"),
    "weight": ("Fulf=  4", "Fulf=  -4", "Fulf", "0 or more"),
    "span": ("Span=  20", "Span=  0", "Span=  0", "a span above 0"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_malformed_configuration_is_refused_with_file_and_line(tmp_path, case):
    old, new, at, says = REFUSED[case]
    assert CNFG.count(old) == 1 or case == "span"
    text = CNFG.replace(old, new, 1)
    folder = write(tmp_path / "app", text)
    with pytest.raises(InputError, match=says) as caught:
        converted(folder)
    line = text[: text.index(at)].count("\n") + 1
    assert caught.value.field == f"{folder / 'control.cnfg'}:{line}"


def test_a_configuration_that_ends_anywhere_is_read_or_refused_and_never_crashes(tmp_path):
    for end in range(0, len(CNFG), 37):
        with contextlib.suppress(InputError):
            cnfg.parsed(CNFG[:end], "file")


def test_one_of_several_applications_is_named_and_the_rest_is_in_the_report(tmp_path):
    head = CNFG.index("  MPCAppl:")
    both = CNFG + CNFG[head : CNFG.index("  ExprModl")].replace("Control\n", "Other\n").replace(
        "Valve", "Gate"
    )
    folder = write(tmp_path / "app", both)
    with pytest.raises(InputError, match="one of Control, Other"):
        converted(folder)
    made = converted(folder, application="Control")
    assert any(row.subject == "Mvr Gate" and "another application" in row.says for row in made.report.rows)
    count = sum(len(row.attributes) for row in made.report.rows)
    assert count == sum(len(block.attributes) for block in cnfg.parsed(both))


def test_blocks_that_are_written_are_read_again():
    blocks = cnfg.parsed(CNFG)
    again = cnfg.parsed(cnfg.written(blocks))
    plain = lambda all: [(b.kind, b.name, [(a.name, a.values) for a in b.attributes]) for b in all]  # noqa: E731
    assert plain(again) == plain(blocks)


def test_every_process_file_that_is_made_is_one(made):
    assert process_of(tomllib.loads(toml_text(made.body)), files=False).default_preset == "septic"
