"""What readers of foreign files share: text of any encoding, numbers with their place, names, and a model from pairs.

Every reader collects a `Curve` per pair and calls `assemble`, which says what it had to assume or change.
"""

from __future__ import annotations

import csv
import dataclasses
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from identify.names import legal_names
from jaxmpc.check import LARGEST, among, is_count, is_number, require
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import StepResponseModel, make_model

LONGEST = 100_000  # coefficients of a response, beyond which a number cannot be meant
TIME_UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0}


@dataclasses.dataclass(frozen=True)
class Asked:
    """What a file may leave open, as the user has answered it; None and empty where there is no answer.

    Attributes:
        cvs, mvs, dvs: names as the files have them.
        dt: sampling interval of the model [s].
        samples: coefficients of the model.
        first_entry: sample at which the first value of a response stands, 0 or 1.
        which: of the two responses of a SEPTIC model file.
        time_unit: of dead times and time constants.
    """

    cvs: tuple[str, ...] = ()
    mvs: tuple[str, ...] = ()
    dvs: tuple[str, ...] = ()
    dt: float | None = None
    samples: int | None = None
    first_entry: int | None = None
    which: Literal["A", "B"] = "A"
    time_unit: str = "s"

    def check(self) -> None:
        """Refuse numbers that cannot be."""
        for option, names in (("--cv", self.cvs), ("--mv", self.mvs), ("--dv", self.dvs)):
            require(len(set(names)) == len(names), option, list(names), "each name once")
        good = self.dt is None or (is_number(self.dt) and self.dt > 0)
        require(good, "--dt", self.dt, "a positive sampling interval [s]")
        good = self.samples is None or (is_count(self.samples) and self.samples <= LONGEST)
        require(good, "--samples", self.samples, f"1 to {LONGEST} coefficients")


class Imported(NamedTuple):
    """A model, and what was assumed, changed or left out on the way to it."""

    model: StepResponseModel
    notes: tuple[str, ...]


class Curve(NamedTuple):
    """The response of a pair: S(1), S(2), ... every `dt` seconds."""

    dt: float
    values: Float[np.ndarray, " n"]


@dataclasses.dataclass
class Pairs:
    """Responses by CV and input as a file has them, with the names in its order."""

    cvs: list[str]
    mvs: list[str]
    dvs: list[str] = dataclasses.field(default_factory=list)
    curves: dict[tuple[str, str], Curve] = dataclasses.field(default_factory=dict)
    units: dict[str, str] = dataclasses.field(default_factory=dict)
    working_point: dict[str, float] = dataclasses.field(default_factory=dict)
    provenance: dict[str, Any] = dataclasses.field(default_factory=dict)
    notes: list[str] = dataclasses.field(default_factory=list)

    def add(self, where: str, cv: str, of: str, curve: Curve) -> None:
        """A response; refused where there is one already."""
        if (cv, of) in self.curves:
            raise InputError(where, f"{of} on {cv}", "each pair once")
        self.curves[cv, of] = curve


def read_text(path: Path) -> str:
    """The text of a file in UTF-8, UTF-16 with its mark, or else Latin-1; ends of lines as they are.

    Raises:
        InputError: for a file that cannot be read, or that is none of text.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError("file", str(path), f"a readable file ({error.strerror or error})") from None
    marked = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    for encoding in ("utf-16",) if marked else ("utf-8-sig", "latin-1"):
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" not in text and not text.startswith("%PDF-"):
            return text
    raise InputError("file", str(path), "a text file")


def csv_rows(text: str, path: Path, separator: str = ",") -> list[tuple[str, list[str]]]:
    """The rows of a table that have something in them, without spaces around cells, by ``file:line``."""
    rows, out = csv.reader(text.splitlines(), delimiter=separator), []
    try:
        for row in rows:
            cells = [cell.strip() for cell in row]
            if any(cells) and not cells[0].startswith("#"):
                out.append((f"{path}:{rows.line_num}", cells))
    except csv.Error as error:
        raise InputError(f"{path}:{rows.line_num}", str(error), "a row of a table") from None
    return out


def number(text: Any, where: str, what: str) -> float:
    """A finite number, from its text or from JSON.

    Args:
        where: it stands, such as ``file:line``.
        what: it is, with its unit, for errors.
    """
    try:
        value = float(text) if not isinstance(text, bool) else math.nan
    except (TypeError, ValueError):
        value = math.nan
    if not is_number(value) or abs(value) > LARGEST or (isinstance(text, str) and "_" in text):
        raise InputError(where, text, f"a number: {what}")
    return value


def shifted(
    values: Float[np.ndarray, " n"], first_entry: int, where: str
) -> tuple[Float[np.ndarray, " n"], str]:
    """S(1), S(2), ... of values that begin with S(first_entry), and a remark on an S(0) that is lost."""
    if first_entry == 1:
        return values, ""
    if len(values) < 2:
        raise InputError(where, values.tolist(), "two values or more: S(0), S(1), ...")
    lost = values[0] != 0 and abs(values[0]) > 1e-9 * np.abs(values).max()
    said = (
        f"{where}: its first value, {values[0]:.6g}, is left out as S(0), which is 0 in any sampled process"
    )
    return values[1:], said if lost else ""


def first_entry_of(
    asked: Asked, default: int, firsts: Mapping[str, Float[np.ndarray, " n"]]
) -> tuple[int, str]:
    """Which sample the first values stand at, and what was assumed.

    Args:
        default: what is assumed unless a first value is not 0, as S(0) always is.
        firsts: responses as the files have them, by where they stand.
    """
    if asked.first_entry is not None:
        return asked.first_entry, f"first values are S({asked.first_entry}), as asked"
    off = [w for w, v in firsts.items() if len(v) and abs(v[0]) > 1e-9 * np.abs(v).max() > 0]
    if default == 0 and off:
        return 1, (
            f"assumed: first values are S(1), one sample after the step, because that of {off[0]} is not 0; "
            "--first-entry 0 takes them as S(0)"
        )
    return (
        default,
        f"assumed: first values are S({default}); --first-entry {1 - default} takes them as S({1 - default})",
    )


def resampled(curve: Curve, dt: float) -> tuple[Curve, str]:
    """A response at other times: values of the file where they coincide, between them linear; and what that was."""
    ratio = dt / curve.dt
    if abs(ratio - 1) < 1e-9:
        return curve, ""
    whole = abs(ratio - round(ratio)) < 1e-9 * ratio and round(ratio) >= 1
    ratio = round(ratio) if whole else ratio
    count = max(math.ceil(len(curve.values) / ratio - 1e-9), 1)
    require(
        count <= LONGEST,
        "--dt",
        dt,
        f"an interval that makes no more than {LONGEST} coefficients of {curve.dt:g} s",
    )
    at = np.arange(1, count + 1) * ratio
    values = np.interp(at, np.arange(len(curve.values) + 1), np.concatenate([[0.0], curve.values]))
    how = f"every {round(ratio)}. value" if whole else "linear between values"
    return Curve(dt, values), f"resampled from {curve.dt:g} s to {dt:g} s: {how}"


def assemble(found: Pairs, asked: Asked, origin: str) -> Imported:
    """The model of collected responses.

    Args:
        origin: format, for the provenance.

    Raises:
        InputError: for sampling intervals that differ and no answer which to take, and for what no model may be.
    """
    notes = list(found.notes)
    if not found.curves:
        raise InputError("model", "no response", "one response of a CV to an MV or DV at least")
    intervals = sorted({curve.dt for curve in found.curves.values()})
    if asked.dt is None and len(intervals) > 1:
        listed = ", ".join(f"{dt:g} s" for dt in intervals)
        raise InputError("--dt", None, f"a sampling interval: the responses have {listed}", "Give --dt")
    dt = intervals[0] if asked.dt is None else asked.dt
    curves, said = {}, dict[str, list[str]]()
    for (cv, of), curve in found.curves.items():
        curves[cv, of], how = resampled(curve, dt)
        if how:
            said.setdefault(how, []).append(f"{of} on {cv}")
    samples = asked.samples or max(len(curve.values) for curve in curves.values())
    inputs = [*found.mvs, *found.dvs]
    table = np.zeros((len(found.cvs), len(inputs), samples))
    for i, cv in enumerate(found.cvs):
        for j, of in enumerate(inputs):
            values = curves[cv, of].values if (cv, of) in curves else None
            if values is None:
                said.setdefault("no response in the files, so none in the model", []).append(f"{of} on {cv}")
                continue
            if len(values) != samples:
                how = "cut" if len(values) > samples else "extended with its last value"
                said.setdefault(f"{how} from {len(values)} to {samples} samples", []).append(f"{of} on {cv}")
            table[i, j] = values[np.minimum(np.arange(samples), len(values) - 1)]
    notes += [f"{', '.join(pairs)}: {how}" for how, pairs in said.items()]
    own = [*found.cvs, *inputs]
    twice = next((name for name in own if own.count(name) > 1), None)
    if twice is not None:
        raise InputError("model", twice, "a name of its own for every CV, MV and DV")
    names = legal_names(own)
    renamed = {old: new for old, new in names.items() if old != new}
    notes += [f"renamed: {old!r} is {new}" for old, new in renamed.items()]
    mvs, unit = len(found.mvs), lambda own: tuple(found.units.get(name, "") or "1" for name in own)
    told = bool(found.units)
    provenance = {"source": origin, **found.provenance, "notes": notes}
    if renamed:
        provenance["names"] = {new: old for old, new in renamed.items()}
    model = make_model(
        table[:, :mvs],
        dt,
        [names[cv] for cv in found.cvs],
        [names[mv] for mv in found.mvs],
        cv_units=unit(found.cvs) if told else (),
        mv_units=unit(found.mvs) if told else (),
        working_point={names[k]: v for k, v in found.working_point.items()},
        provenance=provenance,
        dv_coefficients=table[:, mvs:] if found.dvs else (),
        dv_names=[names[dv] for dv in found.dvs],
        dv_units=unit(found.dvs) if told and found.dvs else (),
    )
    return Imported(model, tuple(notes))


def foreign_names(model: StepResponseModel) -> dict[str, str]:
    """Names as the file of the model had them, by ours."""
    known = dict(dict(model.provenance).get("names", ()))
    return {name: known.get(name, name) for name in (*model.cv_names, *model.input_names)}


def single_words(model: StepResponseModel) -> dict[str, str]:
    """As `foreign_names`, and ours where those are no single word, which names of files and of SEPTIC's objects are."""
    return {
        name: old if re.fullmatch(r"\w[\w.-]*", old) else name for name, old in foreign_names(model).items()
    }


def chosen(option: str, asked: Sequence[str], known: Iterable[str]) -> None:
    """Refuse names of an option that the file does not have."""
    known = list(known)
    for name in asked:
        among(option, name, known)
