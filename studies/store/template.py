"""The fixed part of a store (groups, columns, axes, metadata of the variables) and the bytes of one chunk.

Every variable is a plain Zarr v3 array over the slots with one Zarr chunk per study chunk and a CRC-32C behind the
data. Trajectories are compressed; the rest is a few hundred bytes per chunk and is stored as it is.
"""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.storage import MemoryStore

from jaxmpc.files import write_atomically
from studies.store.files import COMMITS, FORMAT, MANIFEST, chunk_file, text_content
from studies.store.layout import StoreLayout, Variable, is_trajectory

_TEXT = np.dtypes.StringDType()
_KEYS: Any = {"name": "default", "separator": "."}


def _variable_options(layout: StoreLayout, variable: Variable, slots: int) -> dict[str, Any]:
    shape = layout.shape(variable)
    squeeze = [ZstdCodec(level=3)] if is_trajectory(variable.dims) else []
    return {
        "shape": (slots, *shape),
        "chunks": (layout.chunk_size, *shape),
        "dtype": np.dtype(variable.dtype),
        "fill_value": variable.empty,
        "dimension_names": [layout.slot_axis, *variable.dims],
        "attributes": {"long_name": variable.long_name, "units": variable.unit},
        "compressors": [*squeeze, Crc32cCodec()],
        "chunk_key_encoding": _KEYS,
        "config": {"write_empty_chunks": True},
    }


def _plain(values: Any) -> np.ndarray:
    """Numbers as they are, everything else as text of any length."""
    values = np.asarray(values)
    return values if values.dtype.kind in "biuf" else values.astype(object).astype(_TEXT)


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
    chunks = len(layout.chunk_scenarios)
    facts = {"format": FORMAT, "name": layout.name, "title": layout.title, "study_hash": layout.study_hash}
    given = {k: v if isinstance(v, (str, float)) else json.dumps(v) for k, v in layout.provenance.items()}
    root = zarr.create_group(str(folder), attributes={**given, **facts, "identity": layout.identity})
    for name, long_name, axes in (
        ("manifest", "what this store holds, as JSON", []),
        (COMMITS, "record of each stored chunk, as JSON", ["chunk"]),
    ):
        root.create_array(
            name,
            shape=(chunks,) * len(axes),
            chunks=(1,) * len(axes),
            dtype=_TEXT,
            dimension_names=axes,
            attributes={"long_name": long_name},
            compressors=[Crc32cCodec()],
            chunk_key_encoding=_KEYS,
        )
    coords, shared = _write_fixed(root, layout)
    for variable in layout.variables:
        root.create_array(variable.name, **_variable_options(layout, variable, chunks * layout.chunk_size))
    with warnings.catch_warnings():  # that other readers may not know of it, which then read the arrays' own
        warnings.filterwarnings("ignore", "Consolidated metadata", UserWarning)
        zarr.consolidate_metadata(str(folder), zarr_format=3)  # where `xarray.open_zarr` looks
    sizes, checksums = _flushed(folder)
    body = {
        **facts,
        "identity": layout.identity,
        "chunk_size": layout.chunk_size,
        "chunk_counts": [len(c) for c in layout.chunk_scenarios],
        "contents": layout.contents,
        "rows": layout.rows,
        "columns": [column.key for column in layout.columns],
        "variables": [variable.name for variable in layout.variables],
        "coords": coords,
        "shared": shared,
        "files": sizes,
        "checksums": checksums,
    }
    write_atomically(folder / MANIFEST, text_content(body))


def _write_fixed(root: zarr.Group, layout: StoreLayout) -> tuple[list[str], list[str]]:
    """Write what belongs to no chunk; returns the names of the axes and of the shared variables."""

    def write(name: str, values: Any, dims: tuple[str, ...], attributes: dict[str, Any]) -> None:
        values = _plain(values)
        root.create_array(
            name,
            data=values,
            chunks=tuple(max(size, 1) for size in values.shape),
            dimension_names=dims,
            attributes={key: value for key, value in attributes.items() if value},
            compressors=[ZstdCodec(level=3), Crc32cCodec()],
            chunk_key_encoding=_KEYS,
            config={"write_empty_chunks": True},
        )

    rows, slot = layout.rows, (layout.slot_axis,)
    labels = layout.names or np.arange(len(layout.scenario_hashes))
    write(rows, on_slots(layout, labels, "" if layout.names else -1), slot, {"long_name": f"the {rows}"})
    hashes = on_slots(layout, layout.scenario_hashes, "")
    write(f"{rows}_hash", hashes, slot, {"long_name": f"SHA-256 of the inputs of the {rows}"})
    for column in layout.columns:
        values = _plain(column.values)
        empty = {"f": np.nan, "b": False}.get(values.dtype.kind, 0 if values.dtype.kind in "iu" else "")
        about = {"long_name": column.label, "units": column.unit}
        write(column.key, on_slots(layout, values, empty), slot, about)
    for name, (values, unit, long_name) in layout.coords.items():
        write(name, values, (name.removesuffix("_unit"),), {"long_name": long_name, "units": unit})
    shared = layout.shared()
    axes = {str(name): axis for array in shared.values() for name, axis in array.coords.items()}
    for name, array in {**shared, **axes}.items():
        write(name, array.values, tuple(map(str, array.dims)), array.attrs)
    return [*layout.coords, *axes], list(shared)


def _flushed(folder: Path) -> tuple[dict[str, int], dict[str, int]]:
    """Bring all files to the disk; their sizes, and the CRC-32C of those that do not end in it."""
    sizes, checksums = {}, {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        name = path.relative_to(folder).as_posix()
        with open(path, "rb") as file:
            content = file.read()
            os.fsync(file.fileno())
        sizes[name] = len(content)
        if path.name == "zarr.json":
            checksums[name] = google_crc32c.value(content)
    return sizes, checksums


class ChunkEncoder:
    """Turns the results of one chunk into the files that Zarr would write."""

    def __init__(self, layout: StoreLayout):
        """Prepare the encoding of every variable of a layout."""
        self._arrays: dict[str, tuple[zarr.Array, dict[str, Any]]] = {}
        for variable in layout.variables:
            memory: dict[str, Any] = {}
            options = _variable_options(layout, variable, layout.chunk_size)
            self._arrays[variable.name] = (zarr.create_array(MemoryStore(memory), **options), memory)

    def encode(self, variable: Variable, values: np.ndarray, chunk: int) -> tuple[str, bytes]:
        """Path inside the store and content of a variable's chunk.

        Args:
            values: ``"lane ..."``, only the real lanes.
        """
        array, memory = self._arrays[variable.name]
        padded = np.full(array.shape, variable.empty, dtype=array.dtype)
        padded[: len(values)] = values
        array[...] = padded
        content = memory["c.0" + ".0" * len(variable.dims)].to_bytes()
        return chunk_file(variable.name, len(variable.dims), chunk), content
