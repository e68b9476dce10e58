"""Step responses as NumPy arrays: ``.npz`` with the keys of our model file, or ``.npy`` with names from the command line."""

from __future__ import annotations

import zipfile
import zlib
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
    shifted,
)
from jaxmpc.check import is_number, require, sound
from jaxmpc.errors import InputError
from jaxmpc.files import write_atomically
from jaxmpc.model.step_response import StepResponseModel

KINDS = ("cv", "mv", "dv")
KNOWN = {"coefficients", "dv_coefficients", "dt", *KINDS, *(f"{kind}_units" for kind in KINDS)}


def read(files: Sequence[Path], asked: Asked) -> Imported:
    """The model of ``coefficients[cv, mv, n]``; names, units and ``dt`` beside it, or as asked.

    Raises:
        InputError: for arrays of another shape, no names, and what is not finite.
    """
    (path,) = files
    held = _held(path)
    require("coefficients" in held, str(path), sorted(held), "an array coefficients[cv, mv, n]")
    pairs, arrays = Pairs([], []), {"mv": _array(path, held, "coefficients")}
    if "dv_coefficients" in held:
        arrays["dv"] = _array(path, held, "dv_coefficients")
    lengths = {"cv": len(arrays["mv"]), **{kind: array.shape[1] for kind, array in arrays.items()}}
    for kind, count in lengths.items():
        own = getattr(asked, f"{kind}s") or tuple(map(str, np.atleast_1d(held.get(kind, ()))))
        require(
            len(own) == count, f"--{kind}", list(own), f"{count} names, as many as {path} has {kind.upper()}s"
        )
        getattr(pairs, f"{kind}s").extend(own)
        units = np.atleast_1d(held.get(f"{kind}_units", ()))
        if len(units):
            require(len(units) == count, f"{path}: {kind}_units", units.tolist(), f"{count} units")
            pairs.units |= dict(zip(own, map(str, units), strict=True))
    interval = np.atleast_1d(held.get("dt", asked.dt or ()))
    good = interval.size == 1 and np.issubdtype(interval.dtype, np.number) and is_number(interval[0])
    require(
        good and interval[0] > 0, "--dt", interval.tolist(), "the sampling interval [s]", f"{path} has none"
    )
    dt = float(interval[0])
    firsts = {
        f"{path}: {kind} {i}, {j}": row[j]
        for kind, a in arrays.items()
        for i, row in enumerate(a)
        for j in range(a.shape[1])
    }
    first, said = first_entry_of(asked, 1, firsts)
    for kind, array in arrays.items():
        for i, cv in enumerate(pairs.cvs):
            for j, of in enumerate(getattr(pairs, f"{kind}s")):
                kept, lost = shifted(array[i, j], first, f"{path}: {of} on {cv}")
                pairs.notes += [lost] if lost else []
                pairs.add(str(path), cv, of, Curve(dt, kept))
    pairs.notes += [said, *(f"unknown: {key} ({path})" for key in held if key not in KNOWN)]
    return assemble(pairs, asked, "NumPy")


def _held(path: Path) -> dict[str, Any]:
    """The arrays of a file by name."""
    try:
        given = np.load(path, allow_pickle=False)
        if isinstance(given, np.ndarray):
            return {"coefficients": given}
        with given:
            return {key: given[key] for key in given.files}
    except (OSError, ValueError, EOFError, KeyError, OverflowError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError("file", str(path), f"NumPy arrays without Python objects ({error})") from None


def _array(path: Path, held: dict[str, Any], key: str) -> np.ndarray:
    array = held[key]
    number = np.issubdtype(array.dtype, np.number) and not np.iscomplexobj(array)
    require(
        number and array.ndim == 3 and array.size,
        f"{path}: {key}",
        f"shape {list(array.shape)}",
        "numbers [cv, input, n]",
    )
    array = np.asarray(array, dtype=np.float64)
    if not sound(array).all():
        where = [int(k) for k in np.argwhere(~sound(array))[0]]
        raise InputError(f"{path}: {key}{where}", float(array[tuple(where)]), "a finite number")
    return array


def write(model: StepResponseModel, path: Path, asked: Asked) -> tuple[list[Path], list[str]]:
    """An ``.npz`` with everything but working point and provenance."""
    names, units, responses = foreign_names(model), model.units, model.responses
    if asked.first_entry == 0:
        responses = np.concatenate([np.zeros_like(responses[..., :1]), responses], axis=2)
    mvs = len(model.mv_names)
    held: dict[str, Any] = {"coefficients": responses[:, :mvs], "dt": model.dt}
    for kind in KINDS:
        own = getattr(model, f"{kind}_names")
        if own:
            held |= {kind: [names[name] for name in own], f"{kind}_units": [units[name] for name in own]}
    if model.dv_names:
        held["dv_coefficients"] = responses[:, mvs:]

    def fill(to: str) -> None:
        with open(to, "wb") as file:
            np.savez_compressed(file, **held)

    notes = ["no equal: the working point, left out"] if model.working_point else []
    return [write_atomically(path, fill)], [
        *notes,
        f"first values are S({1 if asked.first_entry is None else asked.first_entry})",
    ]
