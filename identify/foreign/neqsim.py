"""Exports of NeqSim's ``process.mpc`` (github.com/equinor/neqsim, Apache): step responses as JSON and as CSV.

Its exporter samples at 0, 1, 2, ... intervals, so first values are S(0). It gives every response the same time constant,
unless that is set before; an import says so.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from identify.foreign.common import (
    Asked,
    Curve,
    Imported,
    Pairs,
    assemble,
    chosen,
    csv_rows,
    first_entry_of,
    foreign_names,
    number,
    read_text,
    shifted,
)
from jaxmpc.check import is_number, require
from jaxmpc.errors import InputError
from jaxmpc.files import read_json, write_atomically
from jaxmpc.model.step_response import StepResponseModel

STEP_RESPONSES, WHOLE = "step_response_model", "comprehensive_mpc_configuration"
TOP = {
    *("format", "version", "application", "controller", "generated", "sampleTime", "sampleTimeUnit"),
    *("predictionHorizon", "controlHorizon", "numCoefficients", "manipulatedVariables"),
    *("controlledVariables", "stepResponses", "header", "tuning", "variables", "model"),
}
Rows = dict[tuple[str, str], tuple[str, np.ndarray]]


def recognises(body: Any) -> bool:
    """Whether the content of a JSON file is such an export with a model in it."""
    return isinstance(body, dict) and (body.get("format") == STEP_RESPONSES or _head(body) == WHOLE)


def recognises_table(text: str) -> bool:
    """Whether the text of a CSV file is a table of step responses."""
    head = text.lstrip().split("\n", 1)[0].lower().replace(" ", "")
    return head.startswith(("step,time,", "time,")) and "/" in head


def _head(body: dict[str, Any]) -> Any:
    head = body.get("header")
    return head.get("format") if isinstance(head, dict) else None


def read(files: Sequence[Path], asked: Asked) -> Imported:
    """The model of one export, JSON or CSV.

    Raises:
        InputError: with the field or line, for names that are not there, lengths that differ and what is no number.
    """
    (path,) = files
    pairs, dt, rows = _read_csv(path, asked) if path.suffix.lower() == ".csv" else _read_json(path)
    first, said = first_entry_of(asked, 0, dict(rows.values()))
    pairs.notes.append(said)
    for (cv, of), (where, values) in rows.items():
        kept, lost = shifted(values, first, where)
        pairs.notes += [lost] if lost else []
        pairs.add(where, cv, of, Curve(dt, kept))
    return assemble(pairs, asked, "NeqSim")


def _read_json(path: Path) -> tuple[Pairs, float, Rows]:
    body = read_json("file", path)
    expected = f"an export of NeqSim with step responses: format {STEP_RESPONSES} or {WHOLE}"
    require(recognises(body), str(path), body.get("format") if isinstance(body, dict) else body, expected)
    whole = _head(body) == WHOLE
    variables = body.get("variables", {}) if whole else body
    names = ("mv", "cv", "dv") if whole else ("manipulatedVariables", "controlledVariables", "")
    mvs, cvs, dvs = (variables.get(key, []) if isinstance(variables, dict) else [] for key in names)
    pairs = Pairs(_named(path, names[1], cvs), _named(path, names[0], mvs))
    for entry in (*cvs, *mvs):
        pairs.units[entry["name"]] = str(entry.get("unit", ""))
        if is_number(entry.get("currentValue")):  # it may be NaN there
            pairs.working_point[entry["name"]] = float(entry["currentValue"])
    if dvs:
        listed = ", ".join(_named(path, "dv", dvs))
        pairs.notes.append(f"no equal: disturbances {listed}, to which the file has no responses")
    settings = body.get("tuning", {}) if whole else body
    given = settings.get("sampleTime") if isinstance(settings, dict) else None
    dt = number(given, f"{path}: sampleTime", "the sampling interval [s]")
    unit = settings.get("sampleTimeUnit", "seconds") if isinstance(settings, dict) else ""
    require(unit == "seconds" and dt > 0, f"{path}: sampleTime", f"{given} {unit}", "more than 0 seconds")
    rows = _matrix(path, body, pairs) if whole else _listed(path, body, pairs)
    pairs.notes += [f"unknown: {key} ({path})" for key in body if key not in TOP]
    left = [
        key
        for key in ("predictionHorizon", "controlHorizon")
        if isinstance(settings, dict) and key in settings
    ]
    pairs.notes.append(
        f"not part of a model: limits, weights{''.join(f', {key} {settings[key]}' for key in left)}"
    )
    return pairs, dt, rows


def _named(path: Path, key: str, listed: Any) -> list[str]:
    good = isinstance(listed, list) and all(
        isinstance(e, dict) and isinstance(e.get("name"), str) for e in listed
    )
    require(good, f"{path}: {key}", listed, "a list of objects with a name")
    return [entry["name"] for entry in listed]


def _listed(path: Path, body: dict[str, Any], pairs: Pairs) -> Rows:
    """``stepResponses``, whose names may have the prefix of tags."""
    rows: Rows = {}
    given: Any = body.get("stepResponses")
    require(isinstance(given, list) and given, f"{path}: stepResponses", given, "a list of responses")
    tags = {}
    for key in ("controlledVariables", "manipulatedVariables"):
        tags |= {str(entry.get("tag", entry["name"])): entry["name"] for entry in body.get(key, [])}
    for i, entry in enumerate(given):
        where = f"{path}: stepResponses[{i}]"
        require(isinstance(entry, dict), where, entry, "an object")
        cv, of = (str(entry.get(key)) for key in ("cv", "mv"))
        cv, of = tags.get(cv, cv), tags.get(of, of)
        for key, name, known in (("cv", cv, pairs.cvs), ("mv", of, pairs.mvs)):
            require(name in known, f"{where}.{key}", name, f"one of {', '.join(known)}")
        require((cv, of) not in rows, where, f"{of} on {cv}", "each pair once")
        rows[cv, of] = f"{where}.coefficients", _values(f"{where}.coefficients", entry.get("coefficients"))
    constants = {str(entry.get("timeConstant")) for entry in given}
    if len(constants) == 1 and len(given) > 1 and "None" not in constants:
        (constant,) = constants
        pairs.notes.append(
            f"look: every response has the time constant {constant} s, the default of NeqSim's exporter, which need not be "
            "that of the plant"
        )
    return rows


def _matrix(path: Path, body: dict[str, Any], pairs: Pairs) -> Rows:
    """``model.stepResponseCoefficients[cv][mv][n]``."""
    model = body.get("model")
    given: Any = model.get("stepResponseCoefficients") if isinstance(model, dict) else None
    where, rows = f"{path}: model.stepResponseCoefficients", Rows()
    good = isinstance(given, list) and len(given) == len(pairs.cvs)
    require(good, where, given, f"{len(pairs.cvs)} rows, one per CV")
    for i, (cv, row) in enumerate(zip(pairs.cvs, given, strict=True)):
        good = isinstance(row, list) and len(row) == len(pairs.mvs)
        require(good, f"{where}[{i}]", row, f"{len(pairs.mvs)} lists, one per MV")
        for j, (mv, values) in enumerate(zip(pairs.mvs, row, strict=True)):
            rows[cv, mv] = f"{where}[{i}][{j}]", _values(f"{where}[{i}][{j}]", values)
    return rows


def _values(where: str, given: Any) -> np.ndarray:
    require(isinstance(given, list) and given, where, given, "a list of coefficients")
    return np.array([number(value, f"{where}[{k}]", "a coefficient") for k, value in enumerate(given)])


def _read_csv(path: Path, asked: Asked) -> tuple[Pairs, float, Rows]:
    """``Step,Time,CV/MV,...``: a row per sample, times in seconds."""
    rows = csv_rows(read_text(path), path)
    head = rows[0][1] if rows else []
    kinds = [cell.lower() for cell in head]
    expected = "a head of Time and columns CV/MV, after Step if there is one"
    require("time" in kinds, f"{path}:1", ",".join(head), expected)
    time = kinds.index("time")
    columns = [k for k, name in enumerate(head) if "/" in name]
    require(columns and len(rows) > 2, f"{path}:1", ",".join(head), f"{expected}, and two rows or more")
    table = np.zeros((len(rows) - 1, len(head)))
    for i, (where, row) in enumerate(rows[1:]):
        require(len(row) == len(head), where, f"{len(row)} cells", f"{len(head)} cells, as the head has")
        table[i] = [number(cell, where, head[k]) for k, cell in enumerate(row)]
    steps = np.diff(table[:, time])
    even = (steps > 0).all() and np.ptp(steps) <= 1e-6 * steps.max()
    require(even, f"{path}: Time", steps[:3].tolist(), "times one sampling interval apart [s]")
    out: Rows = {}
    for k in columns:
        cv, _, of = head[k].partition("/")
        require(cv and of and (cv, of) not in out, f"{path}:1", head[k], "CV/MV, each pair once")
        out[cv, of] = f"{path}: {head[k]}", table[:, k]
    inputs = list(dict.fromkeys(of for _, of in out))
    chosen("--dv", asked.dvs, inputs)
    mvs = [name for name in inputs if name not in asked.dvs]
    pairs = Pairs(list(dict.fromkeys(cv for cv, _ in out)), mvs, list(asked.dvs))
    pairs.notes += [
        f"unknown: column {head[k]} ({path})"
        for k in range(len(head))
        if k not in columns and kinds[k] not in ("step", "time")
    ]
    if asked.first_entry is None and table[0, time] != 0:
        raise InputError(
            f"{path}:2",
            table[0, time],
            "time 0 in the first row",
            "Give --first-entry 1 where it is one sample",
        )
    return pairs, float(np.median(steps)), out


def write(model: StepResponseModel, path: Path, asked: Asked) -> tuple[list[Path], list[str]]:
    """An export as NeqSim writes it: JSON, or CSV where the name of the file says so; returns it and what it cannot say."""
    if asked.first_entry == 1:
        raise InputError("--first-entry", 1, "0: exports of NeqSim begin with S(0), at time 0")
    names, units, point = foreign_names(model), model.units, dict(model.working_point)
    inputs, responses = model.input_names, model.responses
    whole = np.concatenate([np.zeros_like(responses[..., :1]), responses], axis=2)
    if path.suffix.lower() == ".csv":
        listed = [(i, j) for i in range(len(model.cv_names)) for j in range(len(inputs))]
        rows = [["Step", "Time", *(f"{names[model.cv_names[i]]}/{names[inputs[j]]}" for i, j in listed)]]
        rows += [
            [k, k * model.dt, *(float(whole[i, j, k]) for i, j in listed)] for k in range(whole.shape[2])
        ]
        out = io.StringIO()
        csv.writer(out, lineterminator="\n").writerows(rows)
        lost = (
            ["units"]
            + ["the working point"] * bool(point)
            + ["which inputs are measured disturbances"] * bool(model.dv_names)
        )
        return [write_atomically(path, out.getvalue())], [f"no equal: {', '.join(lost)}, left out"]

    def told(own: Sequence[str]) -> list[dict[str, Any]]:
        entries = [
            {"index": k, "name": names[name], "tag": names[name], "unit": units[name]}
            for k, name in enumerate(own)
        ]
        return [
            e | ({"currentValue": point[name]} if name in point else {})
            for e, name in zip(entries, own, strict=True)
        ]

    body = {"format": STEP_RESPONSES, "version": "1.0", "application": "jaxmpc", "sampleTime": model.dt}
    body |= {"sampleTimeUnit": "seconds", "numCoefficients": whole.shape[2]}
    body |= {"manipulatedVariables": told(model.mv_names), "controlledVariables": told(model.cv_names)}
    body["stepResponses"] = [
        {
            "cv": names[cv],
            "mv": names[mv],
            "cvIndex": i,
            "mvIndex": j,
            "gain": float(whole[i, j, -1]),
            "coefficients": whole[i, j].tolist(),
        }
        for i, cv in enumerate(model.cv_names)
        for j, mv in enumerate(model.mv_names)
    ]
    lost = (
        [f"no equal: responses to measured disturbances ({', '.join(model.dv_names)}), left out"]
        if model.dv_names
        else []
    )
    return [write_atomically(path, json.dumps(body, indent=1) + "\n")], lost
