"""Published data in the benchmark: told by their numbers, read from a folder, and judged on the half that was not seen."""

import gzip
import hashlib

import numpy as np
import pytest

from jaxmpc.errors import InputError
from studies.bench.context import QUICK, Context
from studies.bench.sections import published as published_module
from studies.bench.sections.published import Published, foreseen, published, values

U = np.repeat([0.0, 1.0, 0.0, 2.0, 1.0, 0.0, 1.0, 3.0], 10)
Y = 5 + 2 * np.append(0.0, U[:-1])  # all of it one sample later
NUMBERS = np.column_stack([U, Y])
OWN = Published(
    "own", "https://nowhere/own.csv.gz", hashlib.sha256(NUMBERS.astype("<f8").tobytes()).hexdigest(),
    (0, 1), (1, 2), 3,
)  # fmt: skip


def text(mark, end="\n", head=""):
    return (head + end.join(mark.join(map(str, row)) for row in NUMBERS.tolist())).encode()


@pytest.mark.parametrize(
    "content", [text(",", "\r", "u,y\r"), text("\t"), text(";", "\r\n"), gzip.compress(text("  "))]
)
def test_a_data_set_is_told_by_its_numbers_whatever_parts_them(content):
    np.testing.assert_array_equal(values(OWN, content), NUMBERS)


def test_other_numbers_than_the_published_ones_are_refused():
    with pytest.raises(InputError, match="own: got 'numbers with the SHA-256"):
        values(OWN, text(",").replace(b"3.0", b"3.1"))


def test_a_row_tells_how_much_of_the_half_that_was_not_seen_is_foreseen(tmp_path, monkeypatch):
    lines = [f"{name} = {list(v) if isinstance(v, tuple) else v!r}" for name, v in OWN._asdict().items()]
    (tmp_path / "own.toml").write_text("\n".join(["[[set]]", *lines]))
    monkeypatch.setattr(published_module, "SETS", tmp_path / "own.toml")
    context = Context(QUICK, True, lambda line: None, (), (), tmp_path)
    methods = {"exact": lambda y, u, lags: np.full((1, lags), 2.0), "SIPPY": None}
    (missing,) = published(context, methods)
    assert missing.status == "missing"
    assert "--data FOLDER has it" in missing.note
    (tmp_path / "own.csv").write_bytes(text(","))  # unpacked, beside where a packed one is looked for
    found, other = published(context, methods)
    assert found.note.startswith("100.0 % of the second half is foreseen")
    assert other.status == "missing"
    # half the gain leaves half of what the inputs do
    assert foreseen(np.full((1, 3), 1.0), Y, U[:, None], 40) == pytest.approx(50, abs=1e-9)
