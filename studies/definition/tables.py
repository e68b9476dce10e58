"""CSV files of a study definition: their columns as checked values of keys, with the row and column of whatever is wrong."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxmpc.check import require
from jaxmpc.errors import InputError, near
from studies.definition.fields import Field


def read_rows(folder: Path, name: str, place: str) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a file, named by a key at some place of the definition; empty lines do not count."""
    try:
        with open(folder / name, newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row]
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(place, str(folder / name), f"a readable CSV file ({error})") from None
    require(rows, place, name, "a CSV file with a header and one row or more")
    return [column.strip() for column in rows[0]], rows[1:]


def read_columns(
    folder: Path, name: str, place: str, fields: Sequence[Field], columns: Sequence[str]
) -> tuple[tuple[list[Any], ...], tuple[list[str], ...]]:
    """Values and their paths per field, one per row of the file below its header, which is row 1.

    Raises:
        InputError: for columns that are missing or twice there, rows of another length, and values that are refused.
    """
    header, rows = read_rows(folder, name, place)
    expected = f"one of the columns of {name}: {', '.join(header)} (each name once)"
    for column in columns:
        if header.count(column) != 1:
            raise InputError(place, column, expected, near(column, header))
    expected = f"{len(header)} cells, as in the header"
    for n, row in enumerate(rows, start=2):
        require(len(row) == len(header), f"{place} ({name}, row {n})", row, expected)
    values, paths = [], []
    for field, column in zip(fields, columns, strict=True):
        at = header.index(column)
        paths.append([f"{place} ({name}, row {n}, column {column})" for n in range(2, len(rows) + 2)])
        values.append([field.parse(p, row[at]) for p, row in zip(paths[-1], rows, strict=True)])
    return tuple(values), tuple(paths)
