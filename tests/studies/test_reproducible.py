"""Every study of the documentation run twice from nothing: the same numbers, but for times."""

import dataclasses
import json

import msgspec
import numpy as np
import pytest

from studies.run.named import run_named
from studies.store.reading import open_results
from studies.thesis import catalogue, claims_study, rto
from studies.thesis.claims import ROWS

pytestmark = pytest.mark.slow

QUIET = {"progress": False, "say": lambda line: None}
CLOCK = {"solve_time", "wall_time"}
TIMED = {row.id for row in ROWS if row.measure.startswith("cost.")} - {"blocking-unknowns", "blocking-alike"}


def assert_same(folders):
    first, second = (open_results(folder).load() for folder in folders)
    assert set(first.data_vars) == set(second.data_vars) >= CLOCK
    for name in set(first.data_vars) - CLOCK:
        np.testing.assert_array_equal(first[name].values, second[name].values, err_msg=name)


def test_claims_and_the_results_that_they_are_measured_on(tmp_path):
    outs = [tmp_path / "first", tmp_path / "second"]
    rows = []
    for out in outs:
        body = json.loads((claims_study.run_claims(out, True, "jax", **QUIET) / "claims.json").read_text())
        rows.append([row for row in body["claims"] if row["id"] not in TIMED])
    assert rows[0] == rows[1]
    for study in claims_study.NEEDED:
        name = catalogue.comparison_of(study, True, "jax").definition.name
        assert_same([out / name for out in outs])


@pytest.mark.parametrize("study", sorted(set(catalogue.STUDIES) - set(claims_study.NEEDED)))
def test_a_study_beyond_the_thesis_where_no_clock_stops_a_step(study, tmp_path):
    comparison = catalogue.comparison_of(study, True, "jax")
    unlimited = tuple(one for one in comparison.definition.controllers if one.time_limit is None)
    definition = msgspec.structs.replace(comparison.definition, controllers=unlimited)
    comparison = dataclasses.replace(comparison, definition=definition)
    assert_same([run_named(comparison, tmp_path / which, **QUIET) for which in "ab"])


def test_the_real_time_optimisation(tmp_path):
    folders = [rto.run_rto(tmp_path / which, quick=True, **QUIET) for which in "ab"]
    assert_same(folders)
    first, second = ((folder / "summary.md").read_text() for folder in folders)
    assert first == second
    table = [line.split(" | ") for line in first.splitlines() if line.startswith("| ")][1:]
    assert [row[1] for row in table[-2:]] == [rto.LABELS[rto.WITHOUT], rto.LABELS[rto.WITH]]
    assert float(table[-2][3]) < 2000.0 < float(table[-1][3])
