"""Time estimates of sweep studies: the table before the first chunk, measured chunks of every group afterwards."""

import copy
import re
import time

import pytest

from jaxmpc.programs.clock import _heard
from studies.definition.estimate import MODEL_SECONDS, Pace, Work, chunk_seconds, readable
from studies.definition.sweep import StudyDefinition
from studies.load import expand
from studies.run import comparison
from studies.run.chunk import study_layout
from studies.run.progress import progress_bar
from studies.run.status import status
from tests.sweep_hazards import BODY
from tests.sweep_synthetic import WEIGHT, grid, numbers, write

# two chunks of a continuous group, three and one of mixed-integer groups
WORK = Work(
    groups=[0, 0, 1, 1, 1, 2], kinds=["continuous", "mixed-integer", "mixed-integer"], seconds=[5, 10, 40]
)


def took(seconds):
    return {"wall_time": seconds, "host": "here", "process": 1}


def test_before_the_first_chunk_the_table_decides():
    assert WORK.costs({}) == [5, 10, 40]
    assert WORK.rest({}) == 2 * 5 + 3 * 10 + 40


def test_a_group_is_judged_by_its_own_chunks():
    done = {0: took(8), 1: took(6), 2: took(90), 3: took(50), 4: took(70)}
    continuous, integer, _ = WORK.costs(done)
    assert continuous == 7
    assert integer == 70


def test_a_group_without_chunks_goes_by_groups_of_its_kind():
    measured = {0: took(5), 1: took(5), 2: took(30), 3: took(30)}
    assert WORK.costs(measured)[2] == 3 * 40
    speed_of_the_machine = 2
    assert WORK.costs({0: took(10)})[2] == speed_of_the_machine * 40


def test_chunks_that_were_taken_over_are_done_but_measure_nothing():
    taken = {"taken_over_from": ["older.zarr"]}
    assert WORK.costs({0: taken}) == WORK.costs({})
    assert WORK.rest({0: taken}) == WORK.rest({}) - 5


def test_the_rest_is_what_the_missing_chunks_cost():
    done = {0: took(5), 1: took(5), 2: took(20), 3: took(20)}
    assert WORK.rest(done) == 20 + 2 * 40
    assert WORK.rest(dict.fromkeys(range(6), took(1))) == 0


@pytest.mark.parametrize("workers", [1, 2])
def test_the_time_left_of_a_run_counts_workers_that_run_at_once(workers):
    now = [0.0]
    pace = Pace(WORK, {0: took(5), 1: took(5)}, clock=lambda: now[0])
    assert pace.left != pace.left  # nothing is known yet
    now[0] = 60 / workers
    pace.add(2, took(30))
    pace.add(3, took(30))
    assert pace.left == pytest.approx((30 + 3 * 40) / workers)


def test_a_bar_shows_the_time_left_by_group_and_what_the_run_adds(capsys, monkeypatch):
    monkeypatch.setattr(Pace, "left", property(lambda self: 600.0 if self._computed else float("nan")))
    with progress_bar("wear", 12, 4, WORK, {0: took(5)}, show=True) as bar:
        bar.add(1, took(5), 2, "3 on the front")
    *begun, last = capsys.readouterr().err.split("\r")
    assert any("4/12 scenarios" in line and "known after the first chunk" in line for line in begun)
    assert re.search(r"6/12 scenarios \[.*about 10\.0 min left, .* per second, 3 on the front\]", last)


def test_bars_do_not_count_the_time_in_which_something_is_compiled(capsys):
    with progress_bar("wear", 12, 0, WORK, {}, show=True) as bar:
        time.sleep(0.2)
        _heard("/jax/core/compile/backend_compile_duration", 0.2)
        bar.add(0, took(5), 2)
    (rate,) = set(re.findall(r"([\d.e+]+) per second", capsys.readouterr().err))
    assert float(rate) > 2 / 0.2
    with comparison.progress_bar("runs", True) as report:
        time.sleep(2.0)
        _heard("/jax/core/compile/backend_compile_duration", 2.0)
        report(1, 100)
    last = capsys.readouterr().err.rpartition("\r")[2]
    assert re.search(r"1/100 \[00:0[01]<", last), last


def test_a_hidden_bar_writes_nothing(capsys):
    with progress_bar("wear", 12, 0, WORK, {}, show=False) as bar:
        bar.add(0, took(5), 2)
    with comparison.progress_bar("runs", False) as report:
        report(1, 100)
    assert capsys.readouterr().err == ""


def test_a_dry_run_adds_identification_and_what_the_table_says_of_every_group():
    body = copy.deepcopy(BODY)
    body["axes"] = [{"keys": ["controller", "seed"], "values": [["continuous", k] for k in range(4)]}]
    body["axes"][0]["values"].append(["mixed-integer", 0])
    study = expand(StudyDefinition.from_dict(body))
    assert [len(group.scenarios) for group in study.groups] == [4, 1]
    assert [study.lanes(group) for group in (0, 1)] == [3, 1]
    continuous, integer = chunk_seconds("continuous", 30, 3), chunk_seconds("mixed-integer", 30, 1)
    wanted = MODEL_SECONDS + 2 * continuous + integer
    assert study.describe().seconds == pytest.approx(wanted)


def test_status_estimates_the_rest_by_group_from_what_the_store_says_of_its_chunks(tmp_path):
    study = expand(StudyDefinition.from_dict(BODY))
    assert study_layout(study).provenance["work"]["groups"] == [0, 0, 0]
    values = numbers(24)
    path = write(tmp_path / "a.zarr", [WEIGHT], grid(list(range(24))), values, skip=(1, 2))
    assert "for the rest" not in str(status(path))  # a store without the table of its chunks
    work = {"groups": [0, 1, 1], "kinds": ["continuous", "mixed-integer"], "seconds": [10.0, 60.0]}
    path = write(
        tmp_path / "b.zarr", [WEIGHT], grid(list(range(24))), values, skip=(1, 2), provenance={"work": work}
    )
    found = status(path)
    assert found.seconds_left == 2 * 60 * (1.0 / 10)  # chunk 0 took 1 s in place of 10
    assert "it needs about 12 s for the rest" in str(found)
    whole = write(tmp_path / "c.zarr", [WEIGHT], grid(list(range(24))), values, provenance={"work": work})
    assert "for the rest" not in str(status(whole))


def test_times_are_written_for_a_person():
    assert [readable(s) for s in (3.2, 119, 120, 3600, 7200, 200000)] == [
        "3 s",
        "119 s",
        "2.0 min",
        "60.0 min",
        "2.0 h",
        "2.3 d",
    ]
