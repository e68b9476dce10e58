"""The README: its examples run as typed, its commands exist, and `.ci/run` tests what it tells users to test."""

import argparse
import json
import re
import shlex
import tomllib
from pathlib import Path

import pytest

import jaxmpc
from jaxmpc.cli import main as cli
from jaxmpc.cli.options import parser as make_parser
from studies.definition.sweep import StudyDefinition
from studies.load import expand

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)


def blocks(language: str, word: str = "") -> list[str]:
    """Code blocks of a language that contain a word."""
    return [text for name, text in BLOCKS if name == language and word in text]


def options_of(words: list[str]) -> set[str]:
    """Options of a command by its words, an error if there is no such command."""
    parser = make_parser(cli.COMMANDS)
    for word in words:
        groups = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
        parser = groups[0].choices[word]
    return {name for action in parser._actions for name in action.option_strings}


def test_the_example_runs_as_typed(capsys):
    (example,) = blocks("python", "Controller(")
    exec(compile(example, "README.md", "exec"), {"__name__": "__main__"})
    assert re.fullmatch(r"one hour: choke travel \d+ %, largest gap \de-\d\d\n", capsys.readouterr().out)


def test_the_study_is_accepted_as_typed():
    (text,) = blocks("toml")
    study = expand(StudyDefinition.from_dict(tomllib.loads(text)))
    assert (study.name, study.count) == ("wear", 32)
    for key in ("tuning.move_weight.choke", "soft"):
        assert key in [column.key for column in study.columns]
        assert f'"{key}"' in "".join(blocks("python", "kpi_frame"))


def test_the_case_is_solved_as_typed(tmp_path, capsys):
    (case,) = blocks("json")
    path = tmp_path / "case.json"
    path.write_text(case)
    assert cli.main(["plan", str(path)]) == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["status"] == "optimal"
    said = README[README.index("The answer has") :]
    for field in plan:
        if field in ("moves", "mv", "cv", "status", "objective", "bound", "gap"):
            assert f"`{field}" in said, field


def test_every_command_of_the_table_exists_with_its_options_and_none_is_left_out():
    rows = re.findall(r"^\| `jaxmpc ([^`]+)` \|[^|]*\| (.*) \|$", README, re.MULTILINE)
    found = set()
    for command, listed in rows:
        words = [word for word in re.sub(r"\[.*\]", "", command).split() if word.isalpha() and word.islower()]
        found.add(" ".join(words))
        options = set(re.findall(r"`(--[a-z-]+)", listed))
        assert options <= options_of(words), command
        assert options == options_of(words) - {"-h", "--help"}, command
    assert found == set(cli.COMMANDS)


def test_setting_up_is_one_command_for_the_main_job_and_one_for_the_tests_which_ci_runs():
    main, tests = (text.strip() for text in blocks("sh"))
    assert main.endswith("&& .venv/bin/jaxmpc study run thesis")
    assert options_of(shlex.split(main)[-3:-1]) >= {"--quick", "--plant"}
    assert tests.endswith("&& .venv/bin/pytest")
    lines = (ROOT / ".ci" / "run").read_text().rstrip().splitlines()
    assert lines[-1] == tests
    assert (ROOT / ".ci" / "run").stat().st_mode & 0o100, ".ci/run can be executed"


def test_pictures_and_links_are_in_the_checkout_and_small():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        path = ROOT / target
        assert path.is_file(), target
        assert path.stat().st_size < 200_000, target


def test_every_public_name_of_the_package_can_be_taken_from_it():
    for name in jaxmpc._HOME_OF:
        assert getattr(jaxmpc, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = jaxmpc.nothing


def test_editors_see_every_public_name_of_the_package():
    stub = (ROOT / "jaxmpc" / "__init__.pyi").read_text()
    lines = re.findall(r"^from jaxmpc\.([\w.]+) import (\w+) as (\w+)$", stub, re.MULTILINE)
    assert {name: home for home, name, same in lines if same == name} == jaxmpc._HOME_OF
