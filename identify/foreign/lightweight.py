"""Systems of Light-weight-MPC (github.com/gotvinne/Light-weight-MPC, BSD): step coefficients in JSON, no sampling time.

Its matrices begin with ``S[0]`` as the response one sample after the step, so first values are S(1).
"""

from __future__ import annotations

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
    first_entry_of,
    foreign_names,
    number,
    shifted,
)
from jaxmpc.check import require
from jaxmpc.errors import InputError
from jaxmpc.files import read_json, write_atomically
from jaxmpc.model.step_response import StepResponseModel

KNOWN = {
    "": {"model", "CV", "MV"},
    "model": {"n_CV", "n_MV", "N"},
    "CV": {"output", "init", "unit", "S"},
    "MV": {"input", "init", "unit"},
}


def recognises(body: Any) -> bool:
    """Whether the content of a JSON file is such a system."""
    return isinstance(body, dict) and {"model", "CV", "MV"} <= set(body)


def read(files: Sequence[Path], asked: Asked) -> Imported:
    """The model of a system file; the sampling interval must be asked for.

    Raises:
        InputError: with the field, for counts and lengths that do not fit, as its own reader refuses them.
    """
    (path,) = files
    body = read_json("file", path)
    require(
        recognises(body), str(path), type(body).__name__, "a system of Light-weight-MPC: model, CV and MV"
    )
    require(asked.dt, "--dt", asked.dt, "the sampling interval [s]: files of Light-weight-MPC have none")
    tables = {key: _table(path, body, key) for key in ("CV", "MV")}
    head = body["model"] if isinstance(body["model"], dict) else {}
    for key in ("CV", "MV"):
        count = head.get(f"n_{key}")
        require(
            count == len(tables[key]), f"{path}: model.n_{key}", count, f"{len(tables[key])}, as {key} has"
        )
    longest: Any = head.get("N")
    require(isinstance(longest, int), f"{path}: model.N", longest, "the number of coefficients")
    outputs, inputs = [cv["output"] for cv in tables["CV"]], [mv["input"] for mv in tables["MV"]]
    pairs = Pairs(outputs, inputs)
    rows: dict[tuple[str, str], tuple[str, np.ndarray]] = {}
    for i, cv in enumerate(tables["CV"]):
        where = f"{path}: CV[{i}].S"
        listed: Any = cv.get("S")
        good = isinstance(listed, list) and len(listed) == len(inputs)
        require(good, where, listed, f"{len(inputs)} lists of coefficients, one per MV")
        for j, values in enumerate(listed):
            at = f"{where}[{j}]"
            good = isinstance(values, list) and 0 < len(values) <= longest
            require(good, at, values, f"1 to N = {longest} coefficients")
            read_values = np.array([number(v, f"{at}[{k}]", "a coefficient") for k, v in enumerate(values)])
            rows[outputs[i], inputs[j]] = at, read_values
    first, said = first_entry_of(asked, 1, dict(rows.values()))
    for (cv, of), (where, values) in rows.items():
        kept, lost = shifted(values, first, where)
        pairs.notes += [lost] if lost else []
        pairs.add(where, cv, of, Curve(float(asked.dt or 0), kept))
    for kind, name in (("CV", "output"), ("MV", "input")):
        for i, entry in enumerate(tables[kind]):
            pairs.units[entry[name]] = str(entry.get("unit", ""))
            if "init" in entry:
                at = f"{path}: {kind}[{i}].init"
                pairs.working_point[entry[name]] = number(entry["init"], at, "the initial value")
    pairs.notes += [
        said,
        f"sampling interval {asked.dt:g} s, as asked: the file has none",
        *_unknown(path, body),
    ]
    return assemble(pairs, asked, "Light-weight-MPC")


def _table(path: Path, body: dict[str, Any], key: str) -> list[dict[str, Any]]:
    name = {"CV": "output", "MV": "input"}[key]
    listed = body[key]
    good = isinstance(listed, list) and listed and all(isinstance(entry, dict) for entry in listed)
    require(good, f"{path}: {key}", listed, f"a list of objects with {name}, init and unit")
    for i, entry in enumerate(listed):
        named = isinstance(entry.get(name), str) and entry[name]
        require(named, f"{path}: {key}[{i}].{name}", entry.get(name), "a name")
    return listed


def _unknown(path: Path, body: dict[str, Any]) -> list[str]:
    parts = [("", "", body), ("model", "model.", body["model"])]
    parts += [(kind, f"{kind}[{i}].", one) for kind in ("CV", "MV") for i, one in enumerate(body[kind])]
    return [
        f"unknown: {at}{key} ({path})" for kind, at, one in parts for key in one if key not in KNOWN[kind]
    ]


def write(model: StepResponseModel, path: Path, asked: Asked) -> tuple[list[Path], list[str]]:
    """A system file; returns it and what it cannot say."""
    if asked.first_entry == 0:
        raise InputError("--first-entry", 0, "1: files of Light-weight-MPC begin with S(1)")
    names, units, point = foreign_names(model), model.units, dict(model.working_point)
    rows = np.asarray(model.coefficients).tolist()

    def told(name: str) -> dict[str, Any]:
        return {"init": point.get(name, 0.0), "unit": units[name]}

    body = {
        "model": {"n_CV": len(model.cv_names), "n_MV": len(model.mv_names), "N": model.samples},
        "CV": [
            {"output": names[cv], **told(cv), "S": row} for cv, row in zip(model.cv_names, rows, strict=True)
        ],
        "MV": [{"input": names[mv], **told(mv)} for mv in model.mv_names],
    }
    notes = [f"no equal: the sampling interval of {model.dt:g} s, which the file has no place for"]
    if model.dv_names:
        notes.append(f"no equal: responses to measured disturbances ({', '.join(model.dv_names)}), left out")
    return [write_atomically(path, json.dumps(body, indent=1) + "\n")], notes
