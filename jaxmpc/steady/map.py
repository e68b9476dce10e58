"""Steady states over choke and lift, (6.19b): the map that the real-time optimisation of thesis 6.7 works on.

`identify.steady_map` makes one of a plant, `optimise` optimises over it. Between its grid points it is linear over
triangles.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxmpc.check import as_floats, check_keys
from jaxmpc.errors import InputError
from jaxmpc.files import read_json, write_atomically

FORMAT = "jaxmpc/steady-map/1"
INSIDE = 1e-9  # barycentric coordinate down to which a point belongs to a triangle


@dataclasses.dataclass(frozen=True, eq=False)
class SteadyMap:
    """Steady CVs over choke and lift, (6.19b); checked on construction.

    Attributes:
        choke: ``"choke"``, increasing positions [%].
        lift: ``"lift"``, increasing rates [m3/h].
        cv: ``"cv lift choke"`` [CV unit], NaN where there is no steady state. A triangle with such a corner is left out.
        cv_names, cv_units: of the CVs.
        mv_names, mv_units: of choke and lift.
        provenance: JSON-like facts on where the numbers come from.

    Raises:
        InputError: naming the field, for wrong shapes, grids that do not increase, infinite values or no triangle at all.
    """

    choke: Float[np.ndarray, " choke"]
    lift: Float[np.ndarray, " lift"]
    cv: Float[np.ndarray, "cv lift choke"]
    cv_names: tuple[str, ...]
    mv_names: tuple[str, str] = ("choke", "gas_lift")
    cv_units: tuple[str, ...] = ()
    mv_units: tuple[str, str] = ("%", "m3/h")
    provenance: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        for key, unit in (("choke", "%"), ("lift", "m3/h")):
            grid = as_floats(f"map.{key}", getattr(self, key), f"two or more increasing values [{unit}]")
            if grid.ndim != 1 or len(grid) < 2 or not np.isfinite(grid).all() or (np.diff(grid) <= 0).any():
                raise InputError(f"map.{key}", grid.tolist(), f"two or more increasing values [{unit}]")
            object.__setattr__(self, key, grid)
        object.__setattr__(self, "cv_names", tuple(self.cv_names))
        object.__setattr__(self, "mv_names", tuple(self.mv_names))
        object.__setattr__(self, "cv_units", tuple(self.cv_units) or ("",) * len(self.cv_names))
        object.__setattr__(self, "mv_units", tuple(self.mv_units))
        names = (*self.cv_names, *self.mv_names)
        if not self.cv_names or len(self.mv_names) != 2 or len(set(names)) != len(names):
            raise InputError(
                "map.cv, map.mv", list(names), "distinct names: one or more CVs, then choke and lift"
            )
        for key, count in (("cv_units", len(self.cv_names)), ("mv_units", 2)):
            if len(getattr(self, key)) != count:
                raise InputError(f"map.{key}", list(getattr(self, key)), f"{count} units, one per name")
        shape = (len(self.cv_names), len(self.lift), len(self.choke))
        cv = as_floats("map.cv", self.cv, f"numbers of shape {list(shape)}, CV by lift by choke")
        if cv.shape != shape or np.isinf(cv).any():
            raise InputError(
                "map.cv", f"shape {list(cv.shape)}", f"numbers of shape {list(shape)}, none infinite"
            )
        object.__setattr__(self, "cv", cv)
        if not len(self.triangles):
            raise InputError(
                "map.cv", "NaN nearly everywhere", "three neighbouring points with a steady state"
            )

    @property
    def points(self) -> Float[np.ndarray, "point 2"]:
        """Choke [%] and lift [m3/h] of the grid points, choke fastest."""
        choke, lift = np.meshgrid(self.choke, self.lift)
        return np.stack([choke.ravel(), lift.ravel()], axis=1)

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
        width = len(self.choke)
        i, j = np.meshgrid(np.arange(width - 1), np.arange(len(self.lift) - 1))
        first = (i + width * j).ravel()
        corners = np.stack([first, first + 1, first + width, first + width + 1], axis=1)
        parity = (i + j).reshape(-1, 1, 1) % 2  # Union Jack: the diagonal turns from cell to cell
        halves = np.where(parity == 0, [[0, 1, 3], [0, 2, 3]], [[0, 1, 2], [1, 2, 3]])
        return np.take_along_axis(corners[:, None, :], halves, axis=2).reshape(-1, 3)

    def _unknown(self) -> Int[np.ndarray, " point"]:
        return np.flatnonzero(np.isnan(self.values).any(axis=1))

    def interpolate(self, choke, lift) -> Float[np.ndarray, "cv ..."]:
        """CVs at positions [%] and lift rates [m3/h] of any shape, linear over the triangles; NaN outside of them."""
        choke, lift = np.broadcast_arrays(np.asarray(choke, np.float64), np.asarray(lift, np.float64))
        triangles, values = self.triangles, self.values
        out = np.full((choke.size, len(self.cv_names)), np.nan)
        for k, point in enumerate(zip(choke.ravel(), lift.ravel(), strict=True)):
            shares = barycentric(self.points[triangles], np.array(point))
            inside = np.flatnonzero((shares >= -INSIDE).all(axis=1))
            if len(inside):
                out[k] = shares[inside[0]] @ values[triangles[inside[0]]]
        return np.moveaxis(out.reshape(*choke.shape, -1), -1, 0)

    def save(self, path: str | Path) -> Path:
        """Write the map as JSON, ``null`` where there is no steady state; the file is replaced in one go."""
        body = {
            "format": FORMAT,
            "choke": self.choke.tolist(),
            "lift": self.lift.tolist(),
            "cv": list(self.cv_names),
            "mv": list(self.mv_names),
            "cv_units": list(self.cv_units),
            "mv_units": list(self.mv_units),
            "provenance": dict(self.provenance),
            "values": _with_null(self.cv.tolist()),
        }
        return write_atomically(path, json.dumps(body, indent=1))

    @classmethod
    def load(cls, path: str | Path) -> SteadyMap:
        """Read a map written by `save`. Raises `InputError` naming the field that is wrong."""
        body = read_json("map file", path)
        if not isinstance(body, dict):
            raise InputError("map file", str(path), "a JSON object with choke, lift, cv and values")
        check_keys("map", body, ("choke", "lift", "cv", "values"))
        return cls(
            body["choke"],
            body["lift"],
            body["values"],
            body["cv"],
            body.get("mv", ("choke", "gas_lift")),
            body.get("cv_units", ()),
            body.get("mv_units", ("%", "m3/h")),
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
