"""The page of an identification: one file, every pair and record on it, what was left out is told."""

import numpy as np

from figures.identification import MOST_RECORDS, write_page
from jaxmpc.model.identification import Identification, PairVerdict, Record
from jaxmpc.model.step_response import make_model

N = 30
S = 1 - np.exp(-np.arange(1, N + 1) / 5)


def identification(records=2, **more):
    coefficients = np.stack([S, 0 * S])[None]
    model = make_model(
        coefficients, 10.0, ["level"], ["valve", "<pump>"], provenance={"source": "log.csv"},
        dv_coefficients=-S[None, None], dv_names=["feed"],
    )  # fmt: skip
    measured = np.append(np.nan, S)[:, None]
    used = np.arange(N + 1) < 20
    one = Record(
        "March", 10.0 * np.arange(N + 1), np.ones((N + 1, 3)), measured, np.append(0, S)[:, None], used
    )
    verdicts = (
        PairVerdict("level", "valve", "good", "why valve"),
        PairVerdict("level", "<pump>", "none", "why not"),
        PairVerdict("level", "feed", "bad", "why feed"),
    )
    given = {
        "bands": 0.1 * np.ones((1, 3, N)),
        "alternatives": {"fit": np.ones((1, 3, N)), "up": np.full((1, 3, N), np.nan)},
    }
    return Identification(
        model, verdicts, ("a note",), ("do this next",), records=(one,) * records, **(given | more)
    )


def test_the_page_is_one_file_with_verdicts_advice_responses_records_and_notes(tmp_path):
    page = write_page(identification(), tmp_path / "page.html").read_text()
    for text in (
        "why valve",
        "&lt;pump&gt;",
        "do this next",
        "a note",
        "log.csv",
        "March",
        "left out of the model",
        "bad",
    ):
        assert text in page
    assert "<pump>" not in page
    assert page.count('src="data:image/png;base64,') == page.count("<img ") == 1 + 2
    assert "http" not in page
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_a_page_without_records_bands_and_alternatives_is_a_page(tmp_path):
    page = write_page(identification(0, bands=None, alternatives={}), tmp_path / "page.html").read_text()
    assert page.count("<img ") == 1
    assert "What was measured" not in page


def test_more_records_than_anybody_reads_are_counted(tmp_path):
    page = write_page(identification(MOST_RECORDS + 3), tmp_path / "page.html").read_text()
    assert page.count("<img ") == 1 + MOST_RECORDS
    assert "3 more are not shown" in page
