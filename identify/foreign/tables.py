"""Transfer functions as tables: gain, dead time, time constants and lead of every pair, from CSV or TOML.

In TOML the list is that of a process file, ``transfer_functions``, with ``dt`` above it. NeqSim's tables are read, too.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from identify.foreign.common import (
    LONGEST,
    TIME_UNITS,
    Asked,
    Curve,
    Imported,
    Pairs,
    assemble,
    chosen,
    csv_rows,
    number,
    read_text,
)
from jaxmpc.check import located, require
from jaxmpc.decoding import decode
from jaxmpc.errors import InputError
from jaxmpc.model.transfer_function import TransferFunction
from jaxmpc.process.responses import TransferFunctionSection, responses_of


class TableFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table in TOML."""

    transfer_functions: tuple[TransferFunctionSection, ...]
    dt: Annotated[float, msgspec.Meta(gt=0)] | None = None  # [s]
    samples: Annotated[int, msgspec.Meta(ge=1, le=LONGEST)] | None = None
    units: dict[str, str] = {}  # by name


COLUMNS = {  # by their names without case, spaces, underscores and a number 1
    **dict.fromkeys(("cv", "output"), "cv"),
    **dict.fromkeys(("mv", "input"), "mv"),
    "dv": "dv",
    **dict.fromkeys(("gain", "k", "kp"), "gain"),
    **dict.fromkeys(("deadtime", "delay", "theta"), "dead_time"),
    **dict.fromkeys(("timeconstant", "tau", "t"), "first"),
    **dict.fromkeys(("timeconstant2", "secondtimeconstant", "tau2", "t2"), "second"),
    "lead": "lead",
    "integrating": "integrating",
    **dict.fromkeys(("cvunit", "outputunit"), "cv_unit"),
    **dict.fromkeys(("mvunit", "inputunit", "dvunit"), "input_unit"),
    "modeltype": "kind",
}
UNUSED = {"settlingtime"}  # follows from the others
TRUE, FALSE = {"1", "true", "yes", "x", "on"}, {"", "0", "false", "no", "off"}
TIME_WORDS = {
    "s": ("s", "sec", "secs", "second", "seconds"),
    "min": ("min", "mins", "minute", "minutes"),
    "h": ("h", "hr", "hrs", "hour", "hours"),
}
LEFT = 1e-3  # of the gain, which is still to come at the last coefficient
MOST = 5000  # coefficients that are made without being asked for


def recognises(text: str) -> bool:
    """Whether the text of a CSV file is such a table."""
    head = next((line for line in text.splitlines() if line.strip()), "")
    found = {_column(cell.strip(' "')) for cell in head.split(_separator(text))}
    return {"cv", "gain"} <= found and bool(found & {"mv", "dv"})


def read(files: Sequence[Path], asked: Asked) -> Imported:
    """The sampled model of a table; the sampling interval is that of the file, or as asked.

    Raises:
        InputError: with the line or field, for what is missing or cannot be.
    """
    (path,) = files
    sections, notes, units, dt, samples = (_read_toml if path.suffix.lower() == ".toml" else _read_csv)(
        path, asked
    )
    interval: Any = asked.dt or dt
    require(interval, "--dt", asked.dt, f"the sampling interval [s]: {path} has none")
    scale = TIME_UNITS[asked.time_unit]
    names = {
        key: list(dict.fromkeys(getattr(s, key) for s in sections if getattr(s, key)))
        for key in ("cv", "mv", "dv")
    }
    with located(lambda field: field.replace("model.", f"{path}: ", 1)):
        responses = responses_of(sections, names)
    functions = {(one.cv, one.of): _scaled(one.function, scale) for one in responses}
    needed = max(map(_settled, functions.values())) / interval
    count = asked.samples or samples or min(max(math.ceil(needed), 2), MOST)
    if count < needed * (1 - 1e-9):
        notes.append(
            f"look: {count} samples end before all responses have settled (at {needed:.0f}); the last value is held"
        )
    grows = [f"{of} on {cv}" for (cv, of), f in functions.items() if math.inf in f.time_constants]
    if grows:
        notes.append(f"approximated: {', '.join(grows)}: integrates; the model holds the last value")
    pairs = Pairs(names["cv"], names["mv"], names["dv"], units=units, notes=notes)
    times = interval * np.arange(1, count + 1)
    for (cv, of), function in functions.items():
        pairs.add(str(path), cv, of, Curve(float(interval), function.step_response(times)))
    if scale != 1:
        pairs.notes.append(f"dead times and time constants are in {asked.time_unit}, as asked")
    return assemble(pairs, asked, "transfer functions")


def _scaled(function: TransferFunction, scale: float) -> TransferFunction:
    """In seconds; the gain of an integrator is per unit of time."""
    integrators = sum(math.isinf(constant) for constant in function.time_constants)
    constants = tuple(scale * constant for constant in function.time_constants)
    return TransferFunction(
        function.gain / scale**integrators, constants, scale * function.dead_time, scale * function.lead
    )


def _settled(function: TransferFunction) -> float:
    """About how long it takes until `LEFT` of the gain is still to come [s]; of an integrator without the integration."""
    finite = [constant for constant in function.time_constants if math.isfinite(constant)]
    return function.dead_time + sum(finite) * -math.log(LEFT) + abs(function.lead)


def _separator(text: str) -> str:
    head = text.lstrip().split("\n", 1)[0]
    return next((mark for mark in (";", "\t") if mark in head), ",")


def _plain(head: str) -> str:
    plain = "".join(c for c in head.lower() if c.isalnum())
    return plain[:-1] if plain.endswith("1") else plain


def _column(head: str) -> str:
    return COLUMNS.get(_plain(head.partition("[")[0].partition("(")[0]), "")


def _read_csv(
    path: Path, asked: Asked
) -> tuple[list[TransferFunctionSection], list[str], dict[str, str], None, None]:
    text = read_text(path)
    separator = _separator(text)
    rows = csv_rows(text, path, separator)
    require(
        len(rows) > 1, str(path), "no rows", "a table with columns cv, mv, gain, dead_time, time_constant"
    )
    (where, told), units = rows[0], dict[str, str]()
    head = [_column(cell) for cell in told]
    require({"cv", "gain"} <= set(head), where, ",".join(told), "columns cv, mv and gain")
    for cell, name in zip(told, head, strict=True):
        found = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]", cell)
        unit = (
            found[1].lower().rstrip(".") if found and name in ("dead_time", "first", "second", "lead") else ""
        )
        agrees = unit in ("", *TIME_WORDS[asked.time_unit])
        require(
            agrees,
            where,
            cell,
            f"times in {asked.time_unit}, or another --time-unit ({', '.join(TIME_UNITS)})",
        )
    twice = sorted({name for name in head if name and head.count(name) > 1})
    require(not twice, where, twice, "each column once")
    sections = []
    for where, cells in rows[1:]:
        require(len(cells) == len(head), where, f"{len(cells)} cells", f"{len(head)} cells, as the head has")
        given = {name: cell for name, cell in zip(head, cells, strict=True) if name and cell}
        section = _section(where, given, separator == ";", asked)
        sections.append(section)
        for column, name in (("cv_unit", section.cv), ("input_unit", section.mv or section.dv)):
            units |= {name: given[column]} if column in given else {}
    chosen("--dv", asked.dvs, [section.dv for section in sections if section.dv])
    said = lambda name: "not used" if _plain(name) in UNUSED else "unknown"  # noqa: E731
    notes = [
        f"{said(cell)}: column {cell} ({path})" for cell, name in zip(told, head, strict=True) if not name
    ]
    return sections, notes, units, None, None


def _section(where: str, given: dict[str, str], comma: bool, asked: Asked) -> TransferFunctionSection:
    """One row; an input that was asked for as a DV is one."""
    kind = given.get("kind", "FOPDT").upper()
    require(kind in ("FOPDT", "SOPDT"), where, given.get("kind"), "a ModelType FOPDT or SOPDT")
    for name in ("cv", "gain"):
        require(name in given, where, None, f"a value under {name}")

    def value(name: str) -> float:
        cell = given.get(name, "0")
        return number(cell.replace(",", ".") if comma else cell, where, name.replace("_", " "))

    listed = [value(name) for name in ("first", "second")]
    for constant in listed:
        require(constant >= 0, where, constant, "a time constant of 0 or more")
    require(value("dead_time") >= 0, where, value("dead_time"), "a dead time of 0 or more")
    told = given.get("integrating", "").lower()
    require(told in TRUE | FALSE, where, told, "yes or no under integrating")
    constants = [constant for constant in listed if constant] + [math.inf] * (told in TRUE)
    require(constants or not value("lead"), where, value("lead"), "no lead where there is no time constant")
    mv, dv = given.get("mv", ""), given.get("dv", "")
    require(bool(mv) != bool(dv), where, [mv, dv], "an MV, or in its own column a DV")
    mv, dv = ("", mv) if mv in asked.dvs else (mv, dv)
    return TransferFunctionSection(
        given["cv"], value("gain"), mv, dv, tuple(constants), value("dead_time"), value("lead")
    )


def _read_toml(
    path: Path, asked: Asked
) -> tuple[list[TransferFunctionSection], list[str], dict[str, str], Any, Any]:
    try:
        body = tomllib.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError("file", str(path), f"a TOML file ({error})") from None
    with located(lambda field: f"{path}: {field}"):
        file = decode(body, TableFile, name="table")
    require(file.transfer_functions, f"{path}: transfer_functions", [], "one transfer function at least")
    return list(file.transfer_functions), [], file.units, file.dt, file.samples
