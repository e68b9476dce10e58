"""The columns of a CSV or Parquet file as numbers: separators, decimal commas, units, texts that stand for no value.

What is no number, no time and no known word for a missing value is refused with its column and row: guessing would put
wrong numbers into a model.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from identify.logged.stamps import is_clock, is_day, is_stamp, seconds
from jaxmpc.errors import InputError, near

WORDS = (
    "nan na n/a null none bad - -- --- ? no_data nodata invalid questionable uncertain offline error shutdown"
)
SENTENCES = (
    "no data, bad input, i/o timeout, not connect, scan off, pt created, out of serv, calc failed, arc off-line, intf shut, "
    "comm fail, over range, under range, no sample, equip fail, no result, configure, #n/a, #value!, #ref!, #div/0!, #num!, "
    "<null>"
)
CODED = re.compile(r"^\[-\d+\]")  # an error number and words of it
PAIRS = ("off on", "false true", "no yes", "closed open", "stopped running", "stop run", "inactive active")
TRUTHS = {word: float(k) for pair in PAIRS for k, word in enumerate(pair.split())}
MISSING = frozenset(("", *WORDS.split(), *SENTENCES.split(", ")))
UNIT = re.compile(r"^(.*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\))$")  # NAME [UNIT] or NAME (UNIT)
GROUPED = re.compile(r"^[+-]?\d{1,3}(\.\d{3})*(,\d+)?([eE][+-]?\d+)?$|^[+-]?\d*,?\d+([eE][+-]?\d+)?$")


class Table(NamedTuple):
    """Columns of a file.

    Attributes:
        stamps: [s], since 1970 where the file says; None without a column of times.
        begin: the first stamp as it stands in the file.
        columns: by name, NaN where there is no value.
        units: by name, of those that have one.
        notes: what was assumed.
    """

    stamps: Float[np.ndarray, " row"] | None
    begin: str
    columns: dict[str, Float[np.ndarray, " row"]]
    units: dict[str, str]
    notes: tuple[str, ...]


def read_table(path: str | Path, names: Sequence[str], time: str | None) -> Table:
    """Read the named columns and the times.

    Args:
        path: of a ``.csv`` (or ``.txt``, ``.tsv``) or ``.parquet`` file.
        names: of the columns that are read, with or without a unit in brackets.
        time: column of the times; the first one if it is none of the named.

    Raises:
        InputError: for a file that cannot be read, a missing column, or a text that is no number, with its column and row.
    """
    parquet = Path(path).suffix.lower() == ".parquet"
    heads, rows, first = _parquet(path) if parquet else _csv(path, names)
    places, units = _places(heads, names)
    dated = [k for k, column in enumerate(rows) if getattr(column, "dtype", np.dtype("O")).kind == "M"]
    at = _time_column(heads, places, time, dated)
    decimal, unit_row, notes = False, False, []
    if not parquet:
        decimal = first[1]
        if first[0] > 2:
            notes.append(f"{first[0] - 2} lines above the names were passed over")
        unit_row = bool(rows[0]) and _is_unit_row([rows[places[name]][0] for name in names], decimal)
        if unit_row:
            units |= {name: str(rows[places[name]][0]).strip() for name in names}
            rows = [column[1:] for column in rows]
            notes.append("the row below the names was taken for units")
        if decimal:
            notes.append("numbers have a decimal comma")
    line = (first[0] if not parquet else 1) + unit_row
    columns = {}
    for name in names:
        columns[name], said = _numbers(name, rows[places[name]], line, decimal)
        notes += said
    if not len(next(iter(columns.values()))):
        raise InputError("data", str(path), "rows of values below the names")
    stamps, begin = None, ""
    if at is not None and len(rows[at]):
        given, clock = rows[at], _clock_column(rows, places, at)
        if clock is not None:
            given = [f"{day} {time}" for day, time in zip(given, rows[clock], strict=True)]
            notes.append(f"times are the columns {heads[at]} and {heads[clock]} together")
        stamps, said = seconds(heads[at], given, line, decimal)
        begin, notes = str(rows[at][0]).strip(), [*notes, *said]
        if len(stamps) > 1 and not np.ptp(stamps):
            expected = "times that go on; where date and time are two columns, make one of them"
            raise InputError(f"column {heads[at]}", begin, expected)
    return Table(stamps, begin, columns, {k: v for k, v in units.items() if v}, tuple(notes))


def _csv(path: str | Path, names: Sequence[str]) -> tuple[list[str], list[list[str]], tuple[int, bool]]:
    """Names, columns of texts, and ``(line of the first row, whether commas are decimal)``."""
    try:
        raw = Path(path).read_bytes()
    except OSError as error:
        raise InputError("data", str(path), f"a file that can be read ({error.strerror or error})") from None
    text = _decoded(raw).replace("\0", "").replace("\r\n", "\n").replace("\r", "\n")
    lines = [line for line in text.splitlines()[:50] if line.strip()]
    if not lines:
        raise InputError("data", str(path), "a row of names and rows of values; the file is empty")
    head = next((line for line in lines if all(name in line for name in names)), lines[0])
    above = text.index(head)
    skipped, text = text[:above].count("\n"), text[above:]
    separator = max(";\t,|", key=lambda mark: (head.count(mark), mark == ";"))
    table = [row for row in csv.reader(io.StringIO(text), delimiter=separator) if any(map(str.strip, row))]
    heads = [name.strip().lstrip("\ufeff") for name in table[0]]
    while heads and not heads[-1]:
        heads.pop()
    for k, row in enumerate(table[1:], start=2 + skipped):
        if len(row) < len(heads):
            raise InputError(f"row {k}", separator.join(row), f"{len(heads)} values, one per name")
    columns = [list(column) for column in zip(*(row[: len(heads)] for row in table[1:]), strict=True)]
    columns = columns or [[] for _ in heads]
    sample = [text.strip() for column in columns for text in column[:200]]
    decimal = separator != "," and any("," in t and GROUPED.match(t) for t in sample)
    return heads, columns, (2 + skipped, decimal)


def _decoded(raw: bytes) -> str:
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return raw.decode("utf-16", errors="replace")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")


def _parquet(path: str | Path) -> tuple[list[str], list[Any], tuple[int, bool]]:
    try:
        from pyarrow import parquet
    except ImportError:
        expected = "a CSV file: reading Parquet needs pip install 'jaxmpc[parquet]'"
        raise InputError("data", str(path), expected) from None
    try:
        table = parquet.read_table(path)
    except Exception as error:
        raise InputError("data", str(path), f"a readable Parquet file ({error})") from None
    columns = []
    for column in table.columns:
        values = column.to_pandas() if hasattr(column, "to_pandas") else column.to_pylist()
        zoned = getattr(getattr(values, "dtype", None), "tz", None) is not None
        columns.append(np.asarray(values, dtype="datetime64[ns]" if zoned else None))  # in UTC
    return [str(name) for name in table.column_names], columns, (1, False)


def _places(heads: Sequence[str], names: Sequence[str]) -> tuple[dict[str, int], dict[str, str]]:
    """Where each named column stands, and its unit if its head has one."""
    known: dict[str, list[tuple[int, str]]] = {}
    for k, head in enumerate(heads):
        known.setdefault(head, []).append((k, ""))
        if found := UNIT.match(head):
            known.setdefault(found[1], []).append((k, found[2] or found[3] or ""))
            known[head][-1] = k, found[2] or found[3] or ""
    for name in names:
        if name not in known:
            expected = f"a column of the file: {', '.join(heads)}"
            raise InputError("column", name, expected, near(name, known))
        if len(known[name]) > 1:
            raise InputError("column", name, "a name that one column has, not several")
    if len(set(names)) < len(names):
        raise InputError("column", list(names), "distinct names: one column is one MV, CV or DV")
    return {name: known[name][0][0] for name in names}, {name: known[name][0][1] for name in names}


def _time_column(
    heads: Sequence[str], places: dict[str, int], time: str | None, dated: Sequence[int]
) -> int | None:
    if time is not None:
        found, _ = _places(heads, [time])
        if found[time] in places.values():
            raise InputError("--time", time, "a column that is no MV, CV or DV")
        return found[time]
    named = re.compile(r"(date|time|stamp|zeit|datum|uhrzeit|ts|t)\b|.*(time|stamp)$", re.IGNORECASE)
    free = [k for k in range(len(heads)) if k not in places.values()]
    likely = [k for k in dated if k in free] or [k for k in free if k == 0 or named.match(heads[k])]
    return next(iter(likely), None)


def _clock_column(rows: Sequence[Any], places: dict[str, int], at: int) -> int | None:
    """The column with the times of day that belong to a column of dates; None if they have times themselves."""
    texts = [str(entry).strip() for entry in rows[at][:50]]
    if not all(map(is_day, texts)):
        return None
    free = [k for k in range(len(rows)) if k != at and k not in places.values()]
    return next((k for k in free if all(is_clock(str(entry).strip()) for entry in rows[k][:50])), None)


def _is_unit_row(texts: Iterable[str], decimal: bool) -> bool:
    """Whether none of them is a number or a known word, and one has a letter, a percent sign or a degree."""
    texts = [str(text).strip() for text in texts]
    plain = [t for t in texts if t.lower() not in MISSING | TRUTHS.keys() or t == "-"]
    return (
        bool(plain) and all(_number(t, decimal) is None and not is_stamp(t) for t in plain) and plain != ["-"]
    )


def _number(text: str, decimal: bool) -> float | None:
    if decimal and "," in text:
        text = text.replace(".", "").replace(",", ".")
    try:
        return float(text.replace("_", "x"))
    except ValueError:
        return None


def _numbers(
    name: str, texts: Sequence[Any], line: int, decimal: bool
) -> tuple[Float[np.ndarray, " row"], list[str]]:
    """A column as floats, NaN for what stands for no value, and what was assumed."""
    notes = []
    if isinstance(texts, np.ndarray) and texts.dtype.kind in "biuf":
        out = texts.astype(float)
    else:
        out = np.empty(len(texts))
        try:
            if decimal:
                raise ValueError
            out[:] = np.array(texts, dtype=float)
        except (ValueError, TypeError):
            words = {"" if text is None else str(text).strip().lower() for text in texts}
            truths = TRUTHS if words - MISSING and words - MISSING <= TRUTHS.keys() else {}
            if truths:
                one = ", ".join(sorted(word for word in words - MISSING if truths[word]))
                notes.append(f"{name}: {one or 'nothing'} was taken for 1, the other for 0")
            for k, text in enumerate(texts):
                known = truths.get(str(text).strip().lower())
                out[k] = _value(name, text, line + k, decimal) if known is None else known
    return np.where(np.abs(out) < 1e30, out, np.nan), notes


def _value(name: str, text: Any, row: int, decimal: bool) -> float:
    if text is None or str(text).strip().lower() in MISSING or CODED.match(str(text)):
        return np.nan
    value = _number(str(text).strip(), decimal)
    if value is None:
        expected = 'a number, or one of "", NaN, null, Bad, No Data, ... where there is none'
        raise InputError(f"column {name}, row {row}", text, expected)
    return value
