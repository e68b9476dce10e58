"""What a store has to know of its study: scenarios with their hashes, columns, variables and axes.

The scenarios of chunk ``i`` lie on the slots ``i * chunk_size`` to ``(i + 1) * chunk_size - 1`` of the store, so
one chunk of the study is one Zarr chunk of every variable; slots beyond the scenarios of a chunk are padding. A
comparison is a list of scenarios with names, its controllers, in chunks of one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from jaxmpc.errors import InputError
from studies.store.fingerprint import content_hash

RESERVED = ("scenario", "slot", "scenario_hash", "commits", "manifest")  # names that the store itself uses
FLAG = "complete"  # the one variable that the store also knows


def is_trajectory(dims: tuple[str, ...]) -> bool:
    """Whether a variable with these axes after the slot is large: compressed, and read only when asked for."""
    return "time" in dims


@dataclass(frozen=True)
class Column:
    """One scenario coordinate: what differs between the scenarios."""

    key: str  # full key of the definition, for example ``tuning.deadzone.NAME``
    label: str  # in words, for tables and axes
    unit: str  # ``"1"`` for a number without unit, ``""`` for text
    values: np.ndarray  # one per scenario, numbers or text


@dataclass(frozen=True)
class Variable:
    """One result per scenario."""

    name: str  # of the variable in the store
    long_name: str  # in words
    unit: str  # of the values
    # axes after ``scenario``, for example ``()``, ``("cv",)`` or ``("time", "cv")``
    dims: tuple[str, ...] = ()
    dtype: str = "f8"  # of the stored values, for example ``"f8"``
    empty: float | int = float("nan")  # value before it is computed


def process_axes(
    time: np.ndarray, names: Mapping[str, Sequence[str]], units: Mapping[str, Sequence[str]]
) -> dict[str, tuple[Any, str, str]]:
    """The axes of trajectories as `StoreLayout.coords`: times [s], names and units of the CVs and MVs."""
    return {
        "time": (time, "s", "time"),
        "cv": (list(names["cv"]), "", "controlled variable"),
        "mv": (list(names["mv"]), "", "manipulated variable"),
        "cv_unit": (list(units["cv"]), "", "unit of the CV"),
        "mv_unit": (list(units["mv"]), "", "unit of the MV"),
    }


@dataclass(frozen=True)
class StoreLayout:
    """The store of one study before anything is computed.

    Attributes:
        chunk_size: slots per chunk.
        chunk_scenarios: scenario numbers of each chunk, 1 to `chunk_size` of them.
        scenario_hashes: content hash of each scenario, by scenario number.
        columns: values by scenario number.
        variables: the results. One may be called ``complete``: 1 where the scenario ran to its end.
        coords: values, unit and long name of each axis; ``<axis>_unit`` holds the units along an axis.
        provenance: JSON-like facts, one attribute each.
        rows: what a scenario is called; another name than ``scenario`` needs `names` and chunks of one.
        names: of the scenarios, where they have names instead of numbers.
        lengths: of axes without values; results of other lengths are taken over, cut or filled up.
        shared: gives what belongs to no chunk, with the axes of its own; asked for when a store is made.
    """

    name: str
    title: str
    study_hash: str
    chunk_size: int
    chunk_scenarios: tuple[np.ndarray, ...]
    scenario_hashes: tuple[str, ...]
    columns: tuple[Column, ...]
    variables: tuple[Variable, ...]
    coords: dict[str, tuple[Any, str, str]]
    provenance: dict[str, Any]
    rows: str = "scenario"
    names: tuple[str, ...] = ()
    lengths: Mapping[str, int] = field(default_factory=dict)
    shared: Callable[[], Mapping[str, xr.DataArray]] = dict

    @property
    def slot_axis(self) -> str:
        """Name of the first axis of every variable in the store."""
        return self.rows if self.names else "slot"

    @cached_property
    def schema(self) -> str:
        """Hash of what the stored numbers mean: names, units, axes with their values, types."""
        axes = {axis for variable in self.variables for axis in variable.dims} - set(self.lengths)
        return content_hash(
            sorted(
                [v.name, v.unit, list(v.dims), np.dtype(v.dtype).str, repr(v.empty)] for v in self.variables
            ),
            {axis: np.asarray(self.coords[axis][0]).tolist() for axis in sorted(axes)},
        )

    def hashes_of(self, chunk: int) -> list[str]:
        """Scenario hashes of the lanes of a chunk."""
        return [self.scenario_hashes[k] for k in self.chunk_scenarios[chunk]]

    @cached_property
    def contents(self) -> tuple[str, ...]:
        """Content hash of every chunk."""
        return tuple(content_hash(self.hashes_of(i), self.schema) for i in range(len(self.chunk_scenarios)))

    @cached_property
    def identity(self) -> str:
        """Hash of the study and of how it is cut into chunks: a store with another one is another store."""
        return content_hash(
            self.study_hash, self.chunk_size, [list(map(int, c)) for c in self.chunk_scenarios], self.contents
        )

    def shape(self, variable: Variable) -> tuple[int, ...]:
        """Sizes of the axes of a variable after the scenario."""
        return tuple(
            self.lengths[axis] if axis in self.lengths else len(self.coords[axis][0])
            for axis in variable.dims
        )

    def check(self) -> None:
        """Refuse a layout that cannot be stored.

        Raises:
            InputError: naming the field.
        """
        count = len(self.scenario_hashes)
        numbers = [int(k) for chunk in self.chunk_scenarios for k in chunk]
        if sorted(numbers) != list(range(count)):
            raise InputError(
                "chunk_scenarios", f"{len(numbers)} numbers", f"each of the {count} scenarios exactly once"
            )
        for i, chunk in enumerate(self.chunk_scenarios):
            if not 1 <= len(chunk) <= self.chunk_size:
                raise InputError(f"chunk_scenarios[{i}]", len(chunk), f"1 to {self.chunk_size} scenarios")
        names = [column.key for column in self.columns] + [v.name for v in self.variables] + list(self.coords)
        for name in names:
            if not name or "/" in name or name.startswith((".", "__")) or name in RESERVED:
                raise InputError(
                    "variables", name, f"a name without '/' and other than {', '.join(RESERVED)}"
                )
            if names.count(name) > 1 or (name == FLAG and name not in [v.name for v in self.variables]):
                raise InputError("variables", name, "a name that no other column, variable or axis has")
        for column in self.columns:
            if np.shape(column.values) != (count,):
                raise InputError(
                    column.key, np.shape(column.values), f"one value for each of {count} scenarios"
                )
        for variable in self.variables:
            for axis in variable.dims:
                if axis not in self.coords and axis not in self.lengths:
                    raise InputError(
                        f"{variable.name}.dims", axis, f"one of the axes {', '.join(self.coords)}"
                    )
