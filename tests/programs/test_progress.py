"""Long steps are seen on standard error, in commands only."""

import time

import numpy as np
import pytest

from jaxmpc.programs import compilation, progress
from jaxmpc.programs.progress import Seen, shown, watched


@pytest.fixture
def loud(monkeypatch):
    monkeypatch.setenv(compilation.QUIET, "0")
    monkeypatch.setattr(progress, "EVERY", 0.05)


def wait(seen, seconds):
    with watched(seen):
        time.sleep(seconds)


def known(seconds):
    return Seen(seconds, 2.0, 1.5, 0.25)


def test_a_long_step_of_a_command_tells_what_is_known_of_it_line_by_line(loud, capsys):
    with shown():
        wait(known, 0.4)
    said = capsys.readouterr().err
    assert said.endswith("\n")
    lines = said.splitlines()
    assert len(lines) >= 2
    assert lines[0] == "jaxmpc: 0 s: objective 2, bound 1.5, gap 2.5e-01"


def test_before_there_is_a_plan_the_bound_alone_is_told():
    assert str(Seen(4.2, np.inf, 1.5, np.nan)) == "4 s: no plan yet, bound 1.5"
    assert str(Seen(4.2, np.inf, -np.inf, np.nan)) == "4 s: no plan yet, no bound yet"


def test_nothing_is_said_of_a_short_step_nor_outside_commands_nor_where_it_is_not_wanted(
    loud, capsys, monkeypatch
):
    wait(known, 0.2)
    with shown():
        wait(known, 0.0)
        monkeypatch.setenv(compilation.QUIET, "1")
        wait(known, 0.2)
    assert capsys.readouterr().err == ""
