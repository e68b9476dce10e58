"""The fixed part of a sweep store (groups, columns, axes, metadata of the variables) and the bytes of one chunk.

Every variable is a plain Zarr v3 array over ``slot`` with one Zarr chunk per study chunk and a CRC-32C behind the
data, so any Zarr reader notices a flipped bit. Trajectories are compressed; the rest is a few hundred bytes per
chunk and is stored as it is.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.storage import MemoryStore

from studies.store.comparison import consolidate
from studies.store.layout import StoreLayout, Variable
from studies.store.records import COMMITS, FORMAT, MANIFEST, chunk_file, mark, write_checked


def is_trajectory(dims: tuple[str, ...]) -> bool:
    """Whether a variable with these axes after the slot is large: compressed, and read only when asked for."""
    return "time" in dims


def _variable_options(layout: StoreLayout, variable: Variable, slots: int) -> dict[str, Any]:
    shape = layout.shape(variable)
    squeeze = [ZstdCodec(level=3)] if is_trajectory(variable.dims) else []
    return {
        "shape": (slots, *shape),
        "chunks": (layout.chunk_size, *shape),
        "dtype": np.dtype(variable.dtype),
        "fill_value": variable.empty,
        "dimension_names": ["slot", *variable.dims],
        "attributes": {"long_name": variable.long_name, "units": variable.unit},
        "compressors": [*squeeze, Crc32cCodec()],
        "chunk_key_encoding": {"name": "default", "separator": "."},
        "config": {"write_empty_chunks": True},
    }


def _plain(values: Any) -> np.ndarray:
    """Numbers as they are, everything else as text of any length."""
    values = np.asarray(values)
    return values if values.dtype.kind in "biuf" else values.astype(object).astype(np.dtypes.StringDType())


def on_slots(layout: StoreLayout, values: Any, empty: Any) -> np.ndarray:
    """Values by scenario number laid out on the slots of the store, `empty` in between."""
    values = _plain(values)
    result = np.full(layout.chunk_size * len(layout.chunk_scenarios), empty, dtype=values.dtype)
    for i, numbers in enumerate(layout.chunk_scenarios):
        result[i * layout.chunk_size : i * layout.chunk_size + len(numbers)] = values[numbers]
    return result


def write_template(folder: Path, layout: StoreLayout) -> None:
    """Write the store of a study with nothing computed yet into a new folder; the manifest comes last.

    Raises:
        OSError: if the disk does not take it.
    """
    slots = layout.chunk_size * len(layout.chunk_scenarios)
    facts = {"format": FORMAT, "name": layout.name, "title": layout.title, "study_hash": layout.study_hash}
    given = {k: v if isinstance(v, (str, float)) else json.dumps(v) for k, v in layout.provenance.items()}
    root = zarr.create_group(str(folder), attributes={**given, **facts, "identity": layout.identity})
    root.create_group(COMMITS, attributes={"long_name": "one record for each stored chunk"})

    def fixed(name: str, values: np.ndarray, axis: str, unit: str, long_name: str) -> None:
        root.create_array(
            name,
            data=values,
            chunks=(max(len(values), 1),),
            dimension_names=[axis],
            attributes={"long_name": long_name, **({"units": unit} if unit else {})},
            compressors=[ZstdCodec(level=3), Crc32cCodec()],
            chunk_key_encoding={"name": "default", "separator": "."},
            config={"write_empty_chunks": True},
        )

    numbers = np.arange(len(layout.scenario_hashes))
    fixed(
        "scenario",
        on_slots(layout, numbers, -1),
        "slot",
        "1",
        "number of the scenario, -1 where there is none",
    )
    hashes = on_slots(layout, np.array(layout.scenario_hashes, dtype=object), "")
    fixed("scenario_hash", hashes, "slot", "", "SHA-256 of the inputs of the scenario")
    for column in layout.columns:
        values = _plain(column.values)
        empty = {"f": np.nan, "b": False}.get(values.dtype.kind, 0 if values.dtype.kind in "iu" else "")
        fixed(column.key, on_slots(layout, values, empty), "slot", column.unit, column.label)
    for name, (values, unit, long_name) in layout.coords.items():
        fixed(name, _plain(values), name.removesuffix("_unit"), unit, long_name)
    for variable in layout.variables:
        root.create_array(variable.name, **_variable_options(layout, variable, slots))
    consolidate(folder)

    files = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        with open(path, "rb") as file:
            files[path.relative_to(folder).as_posix()] = mark(file.read())
            os.fsync(file.fileno())
    body = {
        **facts,
        "identity": layout.identity,
        "schema": layout.schema,
        "chunk_size": layout.chunk_size,
        "chunk_counts": [len(c) for c in layout.chunk_scenarios],
        "contents": layout.contents,
        "columns": [column.key for column in layout.columns],
        "variables": [variable.name for variable in layout.variables],
        "coords": list(layout.coords),
        "files": files,
    }
    write_checked(folder / MANIFEST, body)


class ChunkEncoder:
    """Turns the results of one chunk into the files that Zarr would write."""

    def __init__(self, layout: StoreLayout):
        """Prepare the encoding of every variable of a layout."""
        self._layout = layout
        self._arrays: dict[str, tuple[zarr.Array, dict[str, Any]]] = {}
        for variable in layout.variables:
            memory: dict[str, Any] = {}
            options = _variable_options(layout, variable, layout.chunk_size)
            self._arrays[variable.name] = (zarr.create_array(MemoryStore(memory), **options), memory)

    def encode(self, variable: Variable, values: np.ndarray, chunk: int) -> tuple[str, bytes]:
        """Path inside the store and content of a variable's chunk.

        Args:
            variable: of the layout.
            values: ``"lane ..."``, only the real lanes.
            chunk: number of the chunk.
        """
        array, memory = self._arrays[variable.name]
        padded = np.full(array.shape, variable.empty, dtype=array.dtype)
        padded[: len(values)] = values
        array[...] = padded
        content = memory["c.0" + ".0" * len(variable.dims)].to_bytes()
        return chunk_file(variable.name, len(variable.dims), chunk), content
