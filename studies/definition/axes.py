"""Axes of a sweep study and how they combine: grid, zip, Latin hypercube, Sobol sequence, or the rows of a CSV file.

An axis is a list of entries; a linked axis has several keys whose values move together. A table of scenarios is then no more
than one entry number per scenario and axis, which stays small and quick for many scenarios.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET

from jaxmpc.check import require
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
    values: tuple[list[Any], ...] = ()  # per key, one value per entry, in plain types
    paths: tuple[
        list[str] | str, ...
    ] = ()  # per key, those of its values; one where the entries are computed
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
    """The scenarios of a definition as entries of its axes; grids run through the last axis first, no axes give one.

    Axes with a distribution are drawn together; in a sampled study every combination of the other axes meets every draw.

    Raises:
        InputError: naming the path, for bad axes, and for more scenarios than ``study.confirmation_limit`` unless confirmed.
    """
    sampling, axes, places = definition.sampling, definition.axes, definition.places
    method, sampled, listed = sampling.method, sampling.method in SAMPLED, sampling.method == "list"
    counted = "a number of draws" if sampled else f"nothing: only {' and '.join(SAMPLED)} draw"
    filed = "a CSV file whose columns are keys" if listed else "nothing: only method 'list' reads it"
    for name, wanted, expected in (("count", sampled, counted), ("file", listed, filed)):
        given = getattr(sampling, name)
        require((given is not UNSET) == wanted, f"sampling.{name}", _shown(given), expected)
    if listed:
        require(not axes, "axes", len(axes), "no axes: with method 'list' the file has all of them")
        entries = [_listed(definition)]
        check_count(definition, len(entries[0]), confirmed)
        return AxisTable(tuple(entries), _combine(method, entries))
    if not axes and method == "grid":  # nothing varies: the base alone
        return AxisTable((), np.zeros((1, 0), dtype=int))
    require(axes, "axes", "nothing", "one axis or more, each headed [[axes]]")
    heads = [_head(axis, place, definition.fields) for axis, place in zip(axes, places, strict=True)]
    _refuse_repeats([(f"{head.place}.key", field.key) for head in heads for field in head.fields])
    drawn = [axis.distribution is not UNSET for axis in axes]
    if any(drawn) and not sampled:
        place = f"{places[drawn.index(True)]}.distribution"
        expected = f"values, a range or csv in method '{method}'; a distribution needs {' or '.join(SAMPLED)}"
        raise InputError(place, f"method '{method}'", expected)
    expected = "at least one axis with a distribution to draw from"
    require(any(drawn) or not sampled, "sampling.method", method, expected)
    fixed = {
        i: _listed_axis(axis, heads[i], definition.folder) for i, axis in enumerate(axes) if not drawn[i]
    }
    lengths, draws = [len(axis) for axis in fixed.values()], int(sampling.count) if sampled else 1  # type: ignore[arg-type]
    check_count(definition, max(lengths) if method == "zip" else math.prod(lengths) * draws, confirmed)
    points = iter(unit_points(method, sum(drawn), draws, sampling.seed).T if sampled else ())
    entries = [
        fixed[i] if i in fixed else _drawn_axis(axis, heads[i], next(points)) for i, axis in enumerate(axes)
    ]
    return AxisTable(tuple(entries), _combine(method, entries))


def unit_points(method: str, dimensions: int, count: int, seed: int) -> np.ndarray:
    """Draws ``"draw dimension"`` in the unit cube.

    The first draws of a Sobol sequence do not depend on how many are drawn; those of a Latin hypercube do.
    """
    from scipy.stats import qmc  # half a second that only draws need

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
            from scipy.special import ndtri

            return d.mean + d.deviation * ndtri(np.clip(points, EDGE, 1 - EDGE))
        if distribution.kind == "log-uniform":
            return d.from_ * np.float64(d.to / d.from_) ** points
        return d.from_ + (d.to - d.from_) * points


def check_count(definition: StudyDefinition, count: int, confirmed: bool) -> None:
    """Refuse more scenarios than a study may have, or than were confirmed."""
    limit, found = definition.study.confirmation_limit, f"{count} scenarios"
    require(count <= MOST, "study", found, f"at most {MOST} scenarios", "Make the axes shorter")
    expected, hint = (
        f"at most {limit} scenarios without confirmation",
        "Confirm the run, or make the axes shorter",
    )
    require(count <= limit or confirmed, "study.confirmation_limit", found, expected, hint)


def _combine(method: str, axes: list[Entries]) -> np.ndarray:
    """Entry numbers "scenario axis"."""
    if method == "zip":
        for axis in axes[1:]:
            expected = f"{len(axes[0])} entries, as {axes[0].place}: axes are zipped"
            require(len(axis) == len(axes[0]), axis.place, f"{len(axis)} entries", expected)
        return np.repeat(np.arange(len(axes[0]))[:, None], len(axes), axis=1)
    drawn = [axis for axis in axes if axis.drawn]
    listed = [len(axis) for axis in axes if not axis.drawn]
    shape = (*listed, len(drawn[0])) if drawn else tuple(listed)  # the draws run fastest
    grid = list(np.indices(shape).reshape(len(shape), -1))
    draws = grid.pop() if drawn else None
    columns = [draws if axis.drawn else grid.pop(0) for axis in axes]
    return np.stack(columns, axis=1)  # type: ignore[arg-type]


def _refuse_repeats(keys: list[tuple[str, str]]) -> None:
    """Refuse a key that two axes set, in either of the two ways of setting a parameter of the plant."""
    seen: dict[str, str] = {}
    for place, key in keys:
        same = key.replace("plant_scale.", "plant.")
        if same in seen:
            raise InputError(place, key, f"a key that no other axis sets ({seen[same]} does)")
        seen[same] = place


# ------------------------------------------------------------------------------------------------------- one axis


def _shown(given: Any) -> Any:
    """What an error says was given."""
    return None if given is UNSET else given


def _head(axis: Axis, place: str, known: Mapping[str, Field]) -> Entries:
    """The axis without its entries: fields and labels, its unit checked."""
    linked = axis.keys is not UNSET
    expected = "a key, or keys for several that move together (one of the two)"
    require((axis.key is UNSET) == linked, f"{place}.key", None, expected)
    keys: Any = axis.keys if linked else [axis.key]
    require(keys, f"{place}.keys", keys, "one key or more")
    fields = tuple(
        find(known, f"{place}.keys[{i}]" if linked else f"{place}.key", key) for i, key in enumerate(keys)
    )
    texts = {}
    for name in ("unit", "label"):
        given: Any = getattr(axis, name)
        texts[name] = [None] * len(keys) if given is UNSET else [given] if isinstance(given, str) else given
        require(len(texts[name]) == len(keys), f"{place}.{name}", given, f"{len(keys)} texts, one per key")
    for field, unit in zip(fields, texts["unit"], strict=True):
        expected = f"{field.unit!r}, the unit of {field.key}" if field.unit else f"no unit for {field.key}"
        require(unit is None or unit == field.unit, f"{place}.unit", unit, expected)
    labels = tuple(given or field.label for field, given in zip(fields, texts["label"], strict=True))
    sources = [name for name in SOURCES if getattr(axis, name) is not UNSET]
    require(len(sources) == 1, place, sources or "nothing", f"exactly one of {', '.join(SOURCES)}")
    if sources[0] in ("range", "distribution"):
        path, key = f"{place}.{sources[0]}", fields[0].key
        require(not linked, path, keys, "values or csv for an axis of several keys")
        require(fields[0].numeric, path, key, f"values: {key} is not a number")
    return Entries(place, fields, labels)


def _listed_axis(axis: Axis, head: Entries, folder: str) -> Entries:
    """An axis of values, a range, or columns of a CSV file, cut to the positions that it keeps."""
    place, fields = head.place, head.fields
    paths: tuple[list[str] | str, ...]
    if isinstance(axis.range, Range):
        source, paths = "range", (f"{place}.range",)
        values = ([fields[0].check(paths[0], v) for v in spaced(axis.range, paths[0])],)
    elif axis.csv is not UNSET:
        source, names = "csv", _csv_columns(axis, head)
        values, paths = read_columns(Path(folder), axis.csv.file, f"{place}.csv", fields, names)  # type: ignore[union-attr]
    else:
        source, linked, rows = "values", axis.keys is not UNSET, axis.values
        expected = f"a list of {len(fields)} values: {', '.join(field.key for field in fields)}"
        for j, row in enumerate(rows if linked else []):  # type: ignore[arg-type]
            require(isinstance(row, list) and len(row) == len(fields), f"{place}.values[{j}]", row, expected)
        rows = rows if linked else [[value] for value in rows]  # type: ignore[union-attr]
        ends = [f"[{i}]" if linked else "" for i in range(len(fields))]
        paths = tuple([f"{place}.values[{j}]{end}" for j in range(len(rows))] for end in ends)  # type: ignore[arg-type]
        values = tuple(
            [field.check(path, row[i]) for path, row in zip(paths[i], rows, strict=True)]  # type: ignore[arg-type]
            for i, field in enumerate(fields)
        )
    require(values[0], f"{place}.{source}", [], "one entry or more")
    if axis.keep is not UNSET:
        keep: Any = axis.keep
        left, expected = set(range(len(values[0]))), f"positions from 0 to {len(values[0]) - 1}, each once"
        for n, j in enumerate(keep):
            require(j in left, f"{place}.keep[{n}]", j, expected)
            left.remove(j)
        require(keep, f"{place}.keep", keep, "one position or more")
        values = tuple([column[j] for j in keep] for column in values)
        paths = tuple(p if isinstance(p, str) else [p[j] for j in keep] for p in paths)
    return dataclasses.replace(head, values=values, paths=paths)


def spaced(given: Range, path: str) -> list[float]:
    """The values of a range, ends included, rounded to 12 digits so that 0.1 steps read 0.3 and not 0.30000000000000004."""
    require(given.count <= MOST, f"{path}.count", given.count, f"at most {MOST} values")
    low, high, log = given.from_, given.to, given.scale == "log"
    for name, value in (("from", low), ("to", high)):
        expected = "a finite number" + (" above 0, for a logarithmic scale" if log else "")
        require(math.isfinite(value) and not (log and value <= 0), f"{path}.{name}", value, expected)
    expected = f"another value than from = {low:g} for {given.count} values"
    require(given.count == 1 or low != high, f"{path}.to", high, expected)
    space = np.geomspace if log else np.linspace
    with np.errstate(over="ignore", invalid="ignore"):  # the values are checked afterwards
        return [float(f"{value:.12g}") for value in space(low, high, given.count)]


def _drawn_axis(axis: Axis, head: Entries, points: np.ndarray) -> Entries:
    """An axis of draws."""
    given: Any = axis.distribution
    path, field, kind = f"{head.place}.distribution", head.fields[0], given.kind
    keep, unit = _shown(axis.keep), f"[{field.unit}]"
    require(keep is None, f"{head.place}.keep", keep, "nothing: draws are cut by sampling.count")
    wanted = ("mean", "deviation") if kind == "normal" else ("from", "to")
    for name in ("from", "to", "mean", "deviation"):
        value = _shown(getattr(given, "from_" if name == "from" else name))
        expected = f"{' and '.join(wanted)} for kind '{kind}' {unit}"
        require((value is not None) == (name in wanted), f"{path}.{name}", value, expected)
        require(value is None or math.isfinite(value), f"{path}.{name}", value, f"a finite number {unit}")
    if kind == "normal":
        require(given.deviation > 0, f"{path}.deviation", given.deviation, f"a number above 0 {unit}")
    else:
        require(kind == "uniform" or given.from_ > 0, f"{path}.from", given.from_, f"a number above 0 {unit}")
        expected = f"a number above from = {given.from_:g} {unit}"
        require(given.to > given.from_, f"{path}.to", given.to, expected)
    if field.kind == "whole":  # every whole number of from..to equally likely
        require(kind == "uniform", f"{path}.kind", kind, f"'uniform' for {field.key}, a whole number")
        field.check(f"{path}.from", given.from_)
        field.check(f"{path}.to", given.to)
        wide = Distribution("uniform", from_=given.from_, to=given.to + 1)
        values = np.minimum(np.floor(draw(wide, points)), given.to)
    else:
        values = draw(given, points)
    checked = [field.check(path, v) for v in values.tolist()]
    return dataclasses.replace(head, values=(checked,), paths=(path,), drawn=True)


def _csv_columns(axis: Axis, head: Entries) -> list[str]:
    source: Any = axis.csv
    column, columns, count = source.column, source.columns, len(head.fields)
    path = f"{head.place}.csv.column"
    if column is not UNSET:
        alone = columns is UNSET and axis.keys is UNSET
        require(alone, path, column, "columns, a list, for an axis of several keys")
        return [column]
    if columns is UNSET:
        return [field.key for field in head.fields]
    require(len(columns) == count, f"{path}s", columns, f"{count} names, one per key")
    return columns


def _listed(definition: StudyDefinition) -> Entries:
    """The one axis of method ``list``: every column of the file is a key."""
    name: Any = definition.sampling.file
    header, _ = read_rows(Path(definition.folder), name, "sampling.file")
    places = [f"sampling.file ({name}, column {i + 1})" for i in range(len(header))]
    fields = tuple(find(definition.fields, place, key) for place, key in zip(places, header, strict=True))
    _refuse_repeats(list(zip(places, header, strict=True)))
    values, paths = read_columns(Path(definition.folder), name, "sampling.file", fields, header)
    require(values[0], "sampling.file", name, "a header and one row or more")
    return Entries("sampling.file", fields, tuple(field.label for field in fields), values, paths)
