"""Steady states over two MVs, (6.19b): the map that the real-time optimisation of thesis 6.7 works on.

`identify.steady_map` makes one of a plant, `optimise` optimises over it. Between its grid points it is linear over
triangles.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxmpc.check import as_floats, check_keys
from jaxmpc.errors import InputError
from jaxmpc.files import read_json, write_atomically

FORMAT, OLD_FORMAT = "jaxmpc/steady-map/2", "jaxmpc/steady-map/1"
OLD_KEYS = ("format", "cv", "mv", "cv_units", "mv_units", "provenance", "values")
INSIDE = 1e-9  # barycentric coordinate down to which a point belongs to a triangle


@dataclasses.dataclass(frozen=True, eq=False)
class SteadyMap:
    """Steady CVs over two MVs, (6.19b); checked on construction.

    Attributes:
        grid: by the name of each MV, its increasing values [MV unit].
        cv: ``"cv second first"`` [CV unit], over the second and the first MV of the grid; NaN where there is no steady
            state. A triangle with such a corner is left out.
        cv_names, cv_units: of the CVs.
        mv_units: of the MVs.
        provenance: JSON-like facts on where the numbers come from.

    Raises:
        InputError: naming the field, for wrong shapes, grids that do not increase, infinite values or no triangle at all.
    """

    grid: Mapping[str, Float[np.ndarray, " value"]]
    cv: Float[np.ndarray, "cv second first"]
    cv_names: tuple[str, ...]
    cv_units: tuple[str, ...] = ()
    mv_units: tuple[str, ...] = ()
    provenance: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "cv_names", tuple(self.cv_names))
        object.__setattr__(self, "cv_units", tuple(self.cv_units) or ("",) * len(self.cv_names))
        object.__setattr__(self, "mv_units", tuple(self.mv_units) or ("", ""))
        object.__setattr__(self, "grid", _checked(self.grid, self.mv_units))
        names = (*self.cv_names, *self.mv_names)
        if not self.cv_names or len(set(names)) != len(names):
            raise InputError("map.cv, map.grid", list(names), "distinct names: one or more CVs, then two MVs")
        for key, of in (("cv_units", self.cv_names), ("mv_units", self.mv_names)):
            if len(getattr(self, key)) != len(of):
                raise InputError(f"map.{key}", list(getattr(self, key)), f"{len(of)} units, one per name")
        first, second = self.grid.values()
        shape = (len(self.cv_names), len(second), len(first))
        expected = f"numbers of shape {list(shape)}, CV by {' by '.join(reversed(self.mv_names))}"
        cv = as_floats("map.cv", self.cv, expected)
        if cv.shape != shape or np.isinf(cv).any():
            raise InputError("map.cv", f"shape {list(cv.shape)}", f"{expected}, none infinite")
        object.__setattr__(self, "cv", cv)
        if not len(self.triangles):
            raise InputError(
                "map.cv", "NaN nearly everywhere", "three neighbouring points with a steady state"
            )

    @property
    def mv_names(self) -> tuple[str, ...]:
        """The two MVs of the grid."""
        return tuple(self.grid)

    @property
    def points(self) -> Float[np.ndarray, "point 2"]:
        """MVs of the grid points [MV unit], the first one fastest."""
        first, second = np.meshgrid(*self.grid.values())
        return np.stack([first.ravel(), second.ravel()], axis=1)

    @property
    def values(self) -> Float[np.ndarray, "point cv"]:
        """CVs of the grid points [CV unit]."""
        return self.cv.reshape(len(self.cv_names), -1).T

    @property
    def triangles(self) -> Int[np.ndarray, "triangle 3"]:
        """Corners of the triangles, as rows of `points`: two per cell, the diagonals turning from cell to cell."""
        possible = self._possible_triangles()
        return possible[~np.isin(possible, self._unknown()).any(axis=1)]

    @property
    def loose_edges(self) -> Int[np.ndarray, "edge 2"]:
        """Edges that have two steady states but no triangle left."""
        edges = lambda triangles: {  # noqa: E731
            tuple(sorted((int(t[a]), int(t[b])))) for t in triangles for a, b in ((0, 1), (0, 2), (1, 2))
        }
        unknown = set(self._unknown().tolist())
        loose = edges(self._possible_triangles()) - edges(self.triangles)
        return np.array(sorted(e for e in loose if not unknown & set(e)), dtype=int).reshape(-1, 2)

    def _possible_triangles(self) -> Int[np.ndarray, "triangle 3"]:
        """All triangles, those without a steady state too."""
        width, height = map(len, self.grid.values())
        i, j = np.meshgrid(np.arange(width - 1), np.arange(height - 1))
        first = (i + width * j).ravel()
        corners = np.stack([first, first + 1, first + width, first + width + 1], axis=1)
        parity = (i + j).reshape(-1, 1, 1) % 2  # Union Jack: the diagonal turns from cell to cell
        halves = np.where(parity == 0, [[0, 1, 3], [0, 2, 3]], [[0, 1, 2], [1, 2, 3]])
        return np.take_along_axis(corners[:, None, :], halves, axis=2).reshape(-1, 3)

    def _unknown(self) -> Int[np.ndarray, " point"]:
        return np.flatnonzero(np.isnan(self.values).any(axis=1))

    def interpolate(self, first, second) -> Float[np.ndarray, "cv ..."]:
        """CVs at values of both MVs [MV unit] of any shape, linear over the triangles; NaN outside of them."""
        first, second = np.broadcast_arrays(np.asarray(first, np.float64), np.asarray(second, np.float64))
        triangles, values = self.triangles, self.values
        out = np.full((first.size, len(self.cv_names)), np.nan)
        for k, point in enumerate(zip(first.ravel(), second.ravel(), strict=True)):
            shares = barycentric(self.points[triangles], np.array(point))
            inside = np.flatnonzero((shares >= -INSIDE).all(axis=1))
            if len(inside):
                out[k] = shares[inside[0]] @ values[triangles[inside[0]]]
        return np.moveaxis(out.reshape(*first.shape, -1), -1, 0)

    def save(self, path: str | Path) -> Path:
        """Write the map as JSON, ``null`` where there is no steady state; the file is replaced in one go."""
        body = {
            "format": FORMAT,
            "cv": list(self.cv_names),
            "grid": {name: values.tolist() for name, values in self.grid.items()},
            "cv_units": list(self.cv_units),
            "mv_units": list(self.mv_units),
            "provenance": dict(self.provenance),
            "values": _with_null(self.cv.tolist()),
        }
        return write_atomically(path, json.dumps(body, indent=1))

    @classmethod
    def load(cls, path: str | Path) -> SteadyMap:
        """Read a map written by `save`. Raises `InputError` naming the field that is wrong."""
        body: Any = read_json("map file", path)
        if not isinstance(body, dict):
            raise InputError("map file", str(path), "a JSON object with grid, cv and values")
        if body.get("format") == OLD_FORMAT:  # the values of the MVs are what has no name of the format
            check_keys("map", body, ("mv",))
            values = [value for key, value in body.items() if key not in OLD_KEYS]
            body["grid"] = dict(zip(body["mv"], values, strict=False))
        check_keys("map", body, ("grid", "cv", "values"))
        return cls(
            body["grid"],
            body["values"],
            body["cv"],
            body.get("cv_units", ()),
            body.get("mv_units", ()),
            body.get("provenance", {}),
        )


def barycentric(
    corners: Float[np.ndarray, "triangle 3 2"], point: Float[np.ndarray, " 2"]
) -> Float[np.ndarray, "triangle 3"]:
    """Shares of a point in the corners of triangles: they sum to 1, and none is negative inside."""
    edges = corners[:, 1:] - corners[:, :1]
    away = point - corners[:, 0]
    size = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    second = (away[:, 0] * edges[:, 1, 1] - away[:, 1] * edges[:, 1, 0]) / size
    third = (edges[:, 0, 0] * away[:, 1] - edges[:, 0, 1] * away[:, 0]) / size
    return np.stack([1.0 - second - third, second, third], axis=1)


def _with_null(values):
    """Nested lists with None in place of NaN, for JSON."""
    if isinstance(values, list):
        return [_with_null(value) for value in values]
    return None if np.isnan(values) else values


def _checked(grid: Any, units: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The increasing values of two MVs, or an `InputError` that names the MV."""
    if not isinstance(grid, Mapping) or len(grid) != 2:
        raise InputError("map.grid", grid, "two MVs by name, each with its increasing values [MV unit]")
    found = {}
    for name, unit in itertools.zip_longest(grid, units[:2], fillvalue=""):
        expected = f"two or more increasing values [{unit or 'MV unit'}]"
        values = as_floats(f"map.grid.{name}", grid[name], expected)
        if (
            values.ndim != 1
            or len(values) < 2
            or not np.isfinite(values).all()
            or (np.diff(values) <= 0).any()
        ):
            raise InputError(f"map.grid.{name}", values.tolist(), expected)
        found[name] = values
    return found
