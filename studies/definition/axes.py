"""Axes of a sweep study and how they combine: grid, zip, Latin hypercube, Sobol sequence, or the rows of a CSV file.

An axis is a list of entries; a linked axis has several keys whose values move together. A table of scenarios is then no more
than one entry number per scenario and axis, which stays small and quick for many scenarios.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET
from scipy.special import ndtri
from scipy.stats import qmc

from jaxmpc.errors import InputError
from studies.definition.fields import Field, find
from studies.definition.sections import Axis, Distribution, Range
from studies.definition.sweep import StudyDefinition
from studies.definition.tables import read_columns, read_rows

SOURCES = ("values", "range", "distribution", "csv")
SAMPLED = ("latin-hypercube", "sobol")
MOST = 1_000_000  # scenarios of a study, and values of a range, also of one that is confirmed
EDGE = 1e-12  # a draw of exactly 0 or 1 would be infinitely far out in a normal distribution


@dataclasses.dataclass(frozen=True, eq=False)
class Entries:
    """The entries of one axis."""

    place: str  # path of the axis in the definition, for errors
    fields: tuple[Field, ...]  # of its keys; more than one in a linked axis
    labels: tuple[str, ...]  # of its keys
    values: tuple[list[Any], ...]  # per key, one value per entry, in plain types
    # path of every entry's value, per key; one shared path where the entries are computed
    paths: tuple[list[str] | str, ...]
    drawn: bool = False  # whether the entries are draws: all drawn axes take their entries together

    def __len__(self) -> int:
        return len(self.values[0])

    def path(self, key: str, entry: int) -> str:
        """Where the value of a key comes from."""
        paths = self.paths[[field.key for field in self.fields].index(key)]
        return paths if isinstance(paths, str) else paths[entry]


@dataclasses.dataclass(frozen=True, eq=False)
class AxisTable:
    """All scenarios as entry numbers."""

    axes: tuple[Entries, ...]  # the axes, in the order of the definition
    index: np.ndarray  # "scenario axis", which entry of each axis a scenario takes

    def __len__(self) -> int:
        return len(self.index)

    def column(self, key: str) -> tuple[int, list[Any], np.ndarray] | None:
        """Axis number, entries and ``"scenario"`` entry numbers of a key; None if it is not on an axis."""
        for a, axis in enumerate(self.axes):
            for field, values in zip(axis.fields, axis.values, strict=True):
                if field.key == key:
                    return a, values, self.index[:, a]
        return None

    def blame(self, keys: Sequence[str], scenario: int) -> str:
        """Paths of the entries that give these keys their values in a scenario, ``base.key`` for the others."""
        places = []
        for key in keys:
            found = self.column(key)
            places.append(
                f"base.{key}" if found is None else self.axes[found[0]].path(key, int(found[2][scenario]))
            )
        return " with ".join(dict.fromkeys(places))


def expand_axes(definition: StudyDefinition, *, confirmed: bool = False) -> AxisTable:
    """The scenarios of a definition as entries of its axes; grids run through the last axis first.

    Axes with a distribution are drawn together; in a sampled study every combination of the other axes meets every draw.

    Raises:
        InputError: naming the path, for bad axes, and for more scenarios than ``study.confirmation_limit`` unless confirmed.
    """
    sampling = definition.sampling
    method, sampled = sampling.method, sampling.method in SAMPLED
    if (sampling.count is not UNSET) != sampled:
        expected = "a number of draws" if sampled else f"nothing: only {' and '.join(SAMPLED)} draw"
        raise InputError("sampling.count", None if sampling.count is UNSET else sampling.count, expected)
    if (sampling.file is not UNSET) != (method == "list"):
        expected = (
            "a CSV file whose columns are keys"
            if method == "list"
            else "nothing: only method 'list' reads it"
        )
        raise InputError("sampling.file", None if sampling.file is UNSET else sampling.file, expected)
    if method == "list":
        if definition.axes:
            raise InputError(
                "axes", len(definition.axes), "no axes: with method 'list' the file has all of them"
            )
        axes = [_listed(definition)]
    else:
        if not definition.axes:
            raise InputError("axes", "nothing", "one axis or more, each headed [[axes]]")
        heads = [_head(axis, place) for axis, place in zip(definition.axes, definition.places, strict=True)]
        _refuse_repeats(
            [
                (f"{place}.key", f.key)
                for place, (fields, _) in zip(definition.places, heads, strict=True)
                for f in fields
            ]
        )
        drawn = [i for i, axis in enumerate(definition.axes) if axis.distribution is not UNSET]
        if drawn and not sampled:
            expected = (
                f"values, a range or csv in method '{method}'; a distribution needs {' or '.join(SAMPLED)}"
            )
            raise InputError(f"{definition.places[drawn[0]]}.distribution", f"method '{method}'", expected)
        if sampled and not drawn:
            raise InputError("sampling.method", method, "at least one axis with a distribution to draw from")
        listed = {
            i: _listed_axis(axis, place, *heads[i], definition.folder)
            for i, (axis, place) in enumerate(zip(definition.axes, definition.places, strict=True))
            if i not in drawn
        }
        draws = int(sampling.count) if sampled else 0  # type: ignore[arg-type]
        check_count(definition, _total(method, [len(axis) for axis in listed.values()], draws), confirmed)
        points = unit_points(method, len(drawn), draws, sampling.seed) if sampled else np.zeros((0, 0))
        axes = [
            listed[i]
            if i in listed
            else _drawn_axis(definition.axes[i], definition.places[i], *heads[i], points[:, drawn.index(i)])
            for i in range(len(heads))
        ]
    check_count(definition, len(axes[0]) if method == "list" else 0, confirmed)
    return AxisTable(tuple(axes), _combine(method, axes))


def unit_points(method: str, dimensions: int, count: int, seed: int) -> np.ndarray:
    """Draws ``"draw dimension"`` in the unit cube.

    The first draws of a Sobol sequence do not depend on how many are drawn; those of a Latin hypercube do.
    """
    seeded: dict[str, Any] = {"seed": np.random.default_rng(seed)}
    if method == "sobol":
        powers = max(0, math.ceil(math.log2(count)))
        return qmc.Sobol(dimensions, **seeded).random_base2(powers)[:count]
    return qmc.LatinHypercube(dimensions, **seeded).random(count)


def draw(distribution: Distribution, points: np.ndarray) -> np.ndarray:
    """Values of a distribution at points of the unit interval, by its inverse distribution function."""
    d: Any = distribution
    with np.errstate(over="ignore", invalid="ignore"):  # the values are checked afterwards
        if distribution.kind == "normal":
            return d.mean + d.deviation * ndtri(np.clip(points, EDGE, 1 - EDGE))
        if distribution.kind == "log-uniform":
            return d.from_ * np.float64(d.to / d.from_) ** points
        return d.from_ + (d.to - d.from_) * points


def _total(method: str, lengths: list[int], draws: int) -> int:
    if method == "zip":
        return max(lengths)
    return math.prod(lengths) * (draws or 1)


def check_count(definition: StudyDefinition, count: int, confirmed: bool) -> None:
    """Refuse more scenarios than a study may have, or than were confirmed."""
    limit = definition.study.confirmation_limit
    if count > MOST:
        raise InputError("study", f"{count} scenarios", f"at most {MOST} scenarios", "Make the axes shorter")
    if count > limit and not confirmed:
        raise InputError(
            "study.confirmation_limit",
            f"{count} scenarios",
            f"at most {limit} scenarios without confirmation",
            "Confirm the run, or make the axes shorter",
        )


def _combine(method: str, axes: list[Entries]) -> np.ndarray:
    """Entry numbers "scenario axis"."""
    if method == "zip":
        for axis in axes[1:]:
            if len(axis) != len(axes[0]):
                raise InputError(
                    axis.place,
                    f"{len(axis)} entries",
                    f"{len(axes[0])} entries, as {axes[0].place}: axes are zipped",
                )
        return np.repeat(np.arange(len(axes[0]))[:, None], len(axes), axis=1)
    drawn = [axis for axis in axes if axis.drawn]
    listed = [len(axis) for axis in axes if not axis.drawn]
    shape = (*listed, len(drawn[0])) if drawn else tuple(listed)  # the draws run fastest
    grid = list(np.indices(shape).reshape(len(shape), -1))
    draws = grid.pop() if drawn else None
    columns = [draws if axis.drawn else grid.pop(0) for axis in axes]
    return np.stack(columns, axis=1)  # type: ignore[arg-type]


def _refuse_repeats(keys: list[tuple[str, str]]) -> None:
    """Refuse a key that two axes set, in either of the two ways of setting a well parameter."""
    seen: dict[str, str] = {}
    for place, key in keys:
        same = key.replace("plant_scale.", "plant.")
        if same in seen:
            raise InputError(place, key, f"a key that no other axis sets ({seen[same]} does)")
        seen[same] = place


# ------------------------------------------------------------------------------------------------------- one axis


def _head(axis: Axis, place: str) -> tuple[tuple[Field, ...], tuple[str, ...]]:
    """Fields and labels of an axis, its unit checked."""
    if (axis.key is UNSET) == (axis.keys is UNSET):
        raise InputError(
            f"{place}.key", None, "a key, or keys for several that move together (one of the two)"
        )
    keys: Any = [axis.key] if axis.keys is UNSET else axis.keys
    if not keys:
        raise InputError(f"{place}.keys", keys, "one key or more")
    where = [f"{place}.key" if axis.keys is UNSET else f"{place}.keys[{i}]" for i in range(len(keys))]
    fields = tuple(find(path, key) for path, key in zip(where, keys, strict=True))
    texts = {}
    for name in ("unit", "label"):
        given: Any = getattr(axis, name)
        listed = [None] * len(keys) if given is UNSET else [given] if isinstance(given, str) else given
        if len(listed) != len(keys):
            raise InputError(f"{place}.{name}", given, f"{len(keys)} texts, one per key")
        texts[name] = listed
    for field, unit in zip(fields, texts["unit"], strict=True):
        if unit is not None and unit != field.unit:
            expected = (
                f"{field.unit!r}, the unit of {field.key}" if field.unit else f"no unit for {field.key}"
            )
            raise InputError(f"{place}.unit", unit, expected)
    labels = tuple(given or f.label for f, given in zip(fields, texts["label"], strict=True))
    given = [name for name in SOURCES if getattr(axis, name) is not UNSET]
    if len(given) != 1:
        raise InputError(place, given or "nothing", f"exactly one of {', '.join(SOURCES)}")
    if axis.keys is not UNSET and given[0] in ("range", "distribution"):
        raise InputError(f"{place}.{given[0]}", keys, "values or csv for an axis of several keys")
    if given[0] in ("range", "distribution") and not fields[0].numeric:
        raise InputError(f"{place}.{given[0]}", fields[0].key, f"values: {fields[0].key} is not a number")
    return fields, labels


def _listed_axis(axis: Axis, place: str, fields, labels, folder: str) -> Entries:
    """An axis of values, a range, or columns of a CSV file, cut to the positions that it keeps."""
    paths: tuple[list[str] | str, ...]
    if isinstance(axis.range, Range):
        paths = (f"{place}.range",)
        values = ([fields[0].check(paths[0], v) for v in spaced(axis.range, paths[0])],)
    elif axis.csv is not UNSET:
        names = _csv_columns(axis, place, fields)
        values, paths = read_columns(Path(folder), axis.csv.file, f"{place}.csv", fields, names)  # type: ignore[union-attr]
    else:
        given: Any = axis.values
        linked = axis.keys is not UNSET
        for j, row in enumerate(given if linked else []):
            if not isinstance(row, list) or len(row) != len(fields):
                expected = f"a list of {len(fields)} values: {', '.join(f.key for f in fields)}"
                raise InputError(f"{place}.values[{j}]", row, expected)
        rows = given if linked else [[value] for value in given]
        paths = tuple(
            [f"{place}.values[{j}]" + (f"[{i}]" if linked else "") for j in range(len(rows))]
            for i in range(len(fields))
        )
        values = tuple(
            [field.check(paths[i][j], row[i]) for j, row in enumerate(rows)] for i, field in enumerate(fields)
        )
    if not len(values[0]):
        raise InputError(
            f"{place}.{next(s for s in SOURCES if getattr(axis, s) is not UNSET)}", [], "one entry or more"
        )
    if axis.keep is not UNSET:
        keep: Any = axis.keep
        seen = set[int]()
        for n, j in enumerate(keep):
            if not 0 <= j < len(values[0]) or j in seen:
                raise InputError(
                    f"{place}.keep[{n}]", j, f"positions from 0 to {len(values[0]) - 1}, each once"
                )
            seen.add(j)
        if not keep:
            raise InputError(f"{place}.keep", keep, "one position or more")
        values = tuple([column[j] for j in keep] for column in values)
        paths = tuple(p if isinstance(p, str) else [p[j] for j in keep] for p in paths)
    return Entries(place, fields, labels, values, paths)


def spaced(given: Range, path: str) -> list[float]:
    """The values of a range, ends included, rounded to 12 digits so that 0.1 steps read 0.3 and not 0.30000000000000004."""
    if given.count > MOST:
        raise InputError(f"{path}.count", given.count, f"at most {MOST} values")
    low, high = given.from_, given.to
    for name, value in (("from", low), ("to", high)):
        if not math.isfinite(value) or (given.scale == "log" and value <= 0):
            expected = (
                "a finite number above 0, for a logarithmic scale"
                if given.scale == "log"
                else "a finite number"
            )
            raise InputError(f"{path}.{name}", value, expected)
    if given.count > 1 and low == high:
        raise InputError(f"{path}.to", high, f"another value than from = {low:g} for {given.count} values")
    space = np.geomspace if given.scale == "log" else np.linspace
    with np.errstate(over="ignore", invalid="ignore"):  # the values are checked afterwards
        return [float(f"{value:.12g}") for value in space(low, high, given.count)]


def _drawn_axis(axis: Axis, place: str, fields, labels, points: np.ndarray) -> Entries:
    """An axis of draws."""
    path, given, field = f"{place}.distribution", axis.distribution, fields[0]
    assert isinstance(given, Distribution)
    if axis.keep is not UNSET:
        raise InputError(f"{place}.keep", axis.keep, "nothing: draws are cut by sampling.count")
    wanted = ("mean", "deviation") if given.kind == "normal" else ("from_", "to")
    for name in ("from_", "to", "mean", "deviation"):
        value = getattr(given, name)
        shown = f"{path}.{name.rstrip('_')}"
        if (value is not UNSET) != (name in wanted):
            names = " and ".join(n.rstrip("_") for n in wanted)
            raise InputError(
                shown, None if value is UNSET else value, f"{names} for kind '{given.kind}' [{field.unit}]"
            )
        if value is not UNSET and not math.isfinite(value):
            raise InputError(shown, value, f"a finite number [{field.unit}]")
    numbers: Any = given
    if given.kind == "normal" and numbers.deviation <= 0:
        raise InputError(f"{path}.deviation", numbers.deviation, f"a number above 0 [{field.unit}]")
    if given.kind == "log-uniform" and numbers.from_ <= 0:
        raise InputError(f"{path}.from", numbers.from_, f"a number above 0 [{field.unit}]")
    if given.kind != "normal" and numbers.to <= numbers.from_:
        raise InputError(f"{path}.to", numbers.to, f"a number above from = {numbers.from_:g} [{field.unit}]")
    if field.kind == "whole":  # every whole number of from..to equally likely
        if given.kind != "uniform":
            raise InputError(f"{path}.kind", given.kind, f"'uniform' for {field.key}, a whole number")
        field.check(f"{path}.from", numbers.from_)
        field.check(f"{path}.to", numbers.to)
        wide = Distribution("uniform", from_=numbers.from_, to=numbers.to + 1)
        values: Any = np.minimum(np.floor(draw(wide, points)), numbers.to)
    else:
        values = draw(given, points)
    checked = [field.check(path, v) for v in values.tolist()]
    return Entries(place, fields, labels, (checked,), (path,), drawn=True)


def _csv_columns(axis: Axis, place: str, fields) -> list[str]:
    source: Any = axis.csv
    if source.column is not UNSET and (source.columns is not UNSET or axis.keys is not UNSET):
        raise InputError(f"{place}.csv.column", source.column, "columns, a list, for an axis of several keys")
    if source.columns is not UNSET:
        if len(source.columns) != len(fields):
            raise InputError(f"{place}.csv.columns", source.columns, f"{len(fields)} names, one per key")
        return source.columns
    return [field.key for field in fields] if source.column is UNSET else [source.column]


def _listed(definition: StudyDefinition) -> Entries:
    """The one axis of method ``list``: every column of the file is a key."""
    name: Any = definition.sampling.file
    header, _ = read_rows(Path(definition.folder), name, "sampling.file")
    keys = [column.strip() for column in header]
    fields = tuple(find(f"sampling.file ({name}, column {i + 1})", key) for i, key in enumerate(keys))
    _refuse_repeats([(f"sampling.file ({name}, column {i + 1})", key) for i, key in enumerate(keys)])
    values, paths = read_columns(Path(definition.folder), name, "sampling.file", fields, keys)
    if not values[0]:
        raise InputError("sampling.file", name, "a header and one row or more")
    return Entries("sampling.file", fields, tuple(f.label for f in fields), values, paths)
