"""What a search may ask for: the axes of its definition as parameters, and points of them as ordinary studies."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET

from jaxmpc.errors import InputError
from studies.definition.axes import expand_axes
from studies.definition.fields import Field
from studies.definition.scenarios import Study, expand_sweep
from studies.definition.sections import Distribution, Sampling
from studies.definition.sweep import StudyDefinition

CORNERS = 1024  # combinations of extremes up to which all of them are checked beforehand

Point = tuple[tuple[Any, ...], ...]  # of one scenario: per axis one value per key


@dataclasses.dataclass(frozen=True)
class Parameter:
    """What one axis may be."""

    place: str  # of the axis in the definition
    fields: tuple[Field, ...]  # of its keys; more than one where several move together
    # of an axis with values, per entry one value per key; empty for an axis with a distribution
    entries: Point = ()
    low: float = 0.0  # end of a distribution, included
    high: float = 0.0  # the other end
    log: bool = False  # whether its logarithm is even
    whole: bool = False  # whether only whole numbers are drawn

    @property
    def name(self) -> str:
        """The first of its keys."""
        return self.fields[0].key

    @property
    def extremes(self) -> list[tuple[Any, ...]]:
        """Both ends, or all entries."""
        return list(self.entries) or [(self.low,), (self.high,)]

    def texts(self, i: int) -> list[str] | None:
        """Distinct texts of its key i in the order of the entries; None for numbers."""
        if self.fields[i].numeric:
            return None
        return list(dict.fromkeys(self.fields[i].column([row[i] for row in self.entries]).tolist()))


def parameter_of(definition: StudyDefinition, i: int) -> Parameter:
    """An axis as a parameter; what is wrong with it alone has the path of the definition."""
    axis, place = definition.axes[i], definition.places[i]
    given = axis.distribution
    for source in ("range", "csv"):
        if getattr(axis, source) is not UNSET:
            expected = "a distribution to search, or values to choose from: a search does not list its points"
            raise InputError(f"{place}.{source}", axis.key, expected)
    drawn = isinstance(given, Distribution)
    if drawn and given.kind == "normal":
        expected = "'uniform' or 'log-uniform': a search needs bounds"
        raise InputError(f"{place}.distribution.kind", given.kind, expected)
    sampling = Sampling(method="sobol", count=1) if drawn else Sampling()
    alone = dataclasses.replace(definition, axes=(axis,), places=(place,), sampling=sampling, search=None)
    (entries,) = expand_axes(alone, confirmed=True).axes
    for field in entries.fields:
        if field.shape:
            expected = "a key that does not change the compiled program: kind, structure and length stay"
            raise InputError(f"{place}.key", field.key, expected, "Run one search per value")
        if drawn and field.key.startswith("model."):
            expected = "values: a model is identified for each of them"
            raise InputError(f"{place}.distribution", field.key, expected)
    if not drawn:
        return Parameter(place, entries.fields, tuple(zip(*entries.values, strict=True)))
    whole, ends = entries.fields[0].kind == "whole", (given.from_, given.to)
    low, high = (int(end) if whole else float(end) for end in ends)  # type: ignore[arg-type]
    return Parameter(place, entries.fields, (), low, high, given.kind == "log-uniform", whole)


def extremes_of(parameters: Sequence[Parameter]) -> list[Point]:
    """The first point, every other extreme of one axis with the rest as there, and all combinations if they are few."""
    choices = [parameter.extremes for parameter in parameters]
    first = tuple(choice[0] for choice in choices)
    points = [first]
    for a, choice in enumerate(choices):
        points += [(*first[:a], extreme, *first[a + 1 :]) for extreme in choice[1:]]
    if np.prod([float(len(choice)) for choice in choices]) <= CORNERS:
        points += itertools.product(*choices)
    return list(dict.fromkeys(points))


def listed(definition: StudyDefinition, parameters: Sequence[Parameter], points: Sequence[Point]) -> Study:
    """The ordinary study of some points; errors name the axes."""
    axes = []
    for a, (axis, parameter) in enumerate(zip(definition.axes, parameters, strict=True)):
        linked = axis.keys is not UNSET
        values = [list(point[a]) if linked else point[a][0] for point in points]
        sources = dict.fromkeys(("distribution", "keep"), UNSET)
        assert len(parameter.fields) == 1 or linked
        axes.append(msgspec.structs.replace(axis, values=values, **sources))
    plain = dataclasses.replace(definition, axes=tuple(axes), sampling=Sampling(method="zip"), search=None)
    try:
        return expand_sweep(plain, confirmed=True)
    except InputError as error:
        where = re.sub(r"\.values\[\d+\](\[\d+\])?", "", error.field)
        raise InputError(where, error.value, error.expected, error.hint) from None


def check_one_group(study: Study, parameters: Sequence[Parameter], points: Sequence[Point]) -> None:
    """Refuse points that need more than one compiled program, naming the axes that differ."""
    if len(study.groups) == 1:
        return
    first, other = (points[int(group.scenarios[0])] for group in study.groups[:2])
    differ = [a for a in range(len(parameters)) if first[a] != other[a]]
    expected = "values that share one compiled program: the same limits finite"
    raise InputError(
        " with ".join(parameters[a].place for a in differ),
        ", ".join(
            f"{f.key} {v}" for a in differ for f, v in zip(parameters[a].fields, other[a], strict=True)
        ),
        expected,
    )
