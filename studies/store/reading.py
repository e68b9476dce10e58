"""The results of a study as an `xarray.Dataset` over its scenarios, or the controllers of a comparison, with names and
units, and the key figures of a sweep as a table. Padding is hidden, trajectories are read when they are used, and what
is missing or damaged reads as empty with ``complete`` 0, never as a number.
"""

from __future__ import annotations

import itertools
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from jaxmpc.errors import InputError
from studies.store.files import RESULTS, DamagedError, Survey, checked, chunk_file, open_manifest, survey
from studies.store.layout import FLAG, is_trajectory


def open_results(path: str | Path) -> xr.Dataset:
    """Open the results of a comparison.

    Returns:
        As `open_study`, over ``controller``, with the variables that belong to all runs: setpoints, tuning, model.

    Raises:
        InputError: if there are no results or they cannot be read.
    """
    path = Path(path)
    return open_study(path if path.suffix == ".zarr" else path / RESULTS)


def provenance(data: xr.Dataset, key: str) -> Any:
    """A JSON fact from the attributes of a result, decoded; `None` if it is not there."""
    value = data.attrs.get(key)
    try:
        return json.loads(value) if isinstance(value, str) else value
    except json.JSONDecodeError:
        return value


def open_study(path: str | Path) -> xr.Dataset:
    """Open the results of a study.

    Args:
        path: of the store, ending in ``.zarr``, or of the folder that holds it as ``study.zarr`` or ``results.zarr``.

    Returns:
        A data set over ``scenario`` (the scenario number) with every column as a coordinate (those of a search are
        empty where nothing is stored yet), the key figures, and
        the trajectories over ``time`` [s] and ``cv`` or ``mv``, which are read when they are used. ``complete`` is
        1 where the scenario is stored (and ran to its end, if the study says so); other rows are empty (NaN, -1).
        JSON facts on where the numbers come from are in the attributes (`provenance` decodes one).

    Raises:
        InputError: if there is no store or its fixed files are damaged. Damage found in a trajectory while it is
            read raises it then.

    Warns:
        UserWarning: naming damaged files of chunks; their scenarios read as empty.
    """
    import zarr  # a tenth of a second; everything that knows of stores imports this module

    store, manifest = open_manifest(path)
    root = zarr.open_group(str(store), mode="r", zarr_format=3)
    rows, variables = manifest["rows"], manifest["variables"]
    arrays: dict[str, Any] = {n: root[n] for key in ("columns", "coords", "shared") for n in manifest[key]}
    arrays |= {name: root[name] for name in (rows, f"{rows}_hash", *variables)}
    dims = {name: tuple(array.metadata.dimension_names) for name, array in arrays.items()}
    attrs = {name: dict(array.attrs) for name, array in arrays.items()}
    labels = _fixed(arrays[rows])
    numbered = labels.dtype.kind == "i"
    slots = np.flatnonzero(labels >= 0 if numbered else labels != "")
    if numbered:
        slots = slots[np.argsort(labels[slots])]

    found = survey(store, manifest["contents"])
    tables = read_small(store, found, {name: arrays[name] for name in variables})
    if found.damaged:
        warnings.warn(
            f"Damaged in {store}: {', '.join(found.damage)}. These scenarios read as empty; give the command of "
            "the study again to compute them again",
            stacklevel=2,
        )
    stored = np.isin(slots // manifest["chunk_size"], list(found.records))

    data = {name: xr.Variable(dims[name], _fixed(arrays[name]), attrs[name]) for name in manifest["shared"]}
    for name in variables:
        if name in tables:
            values = tables[name][slots]
        else:
            values = indexing.LazilyIndexedArray(_StoredRows(store, arrays[name], slots, stored))
        data[name] = xr.Variable((rows, *dims[name][1:]), values, attrs[name])
    flag = stored if FLAG not in data else stored & (data[FLAG].values > 0)
    about = attrs.get(FLAG, {"long_name": "1 once the scenario is computed and stored", "units": "1"})
    data[FLAG] = xr.Variable(rows, flag.astype("i1"), about)
    coords: dict[str, Any] = {
        name: (rows, _fixed(arrays[name])[slots], attrs[name])
        for name in (rows, f"{rows}_hash", *manifest["columns"])
    }
    for name, texts in json.loads(str(root.attrs.get("tuned", "{}"))).items():
        coords[name] = _tuned(data.pop(name), texts)
    for name in manifest["coords"]:
        coords[name] = (dims[name], _fixed(arrays[name]), attrs[name])
    return xr.Dataset(data, coords, dict(root.attrs))


def kpi_frame(path: str | Path) -> pd.DataFrame:
    """The scenarios as a table: a row each, the columns of the study, then its key figures, then ``complete``.

    A key figure with an axis gives one column per channel, ``<name>.<channel>``. For a comparison the controllers are the
    rows and what is known of each of them the columns. Arguments and errors as for `open_study`.
    """
    data = open_study(path)
    rows = str(data[FLAG].dims[0])
    table: dict[str, Any] = {
        str(name): c.values
        for name, c in data.coords.items()
        if c.dims == (rows,) and name not in (rows, f"{rows}_hash")
    }
    for name, variable in data.data_vars.items():
        axes = [str(axis) for axis in variable.dims[1:]]
        if variable.dims[0] != rows or is_trajectory(tuple(axes)):
            continue
        for place in itertools.product(*(range(variable.sizes[axis]) for axis in axes)):
            labels = [str(data[axis].values[i]) for axis, i in zip(axes, place, strict=True)]
            table[".".join([str(name), *labels])] = variable.values[(slice(None), *place)]
    table[FLAG] = table.pop(FLAG)
    return pd.DataFrame(table, index=pd.Index(data[rows].values, name=rows))


def chunk_facts(path: str | Path) -> dict[int, dict[str, Any]]:
    """Facts given with the commit of each stored chunk: wall time [s], worker, device.

    Raises:
        InputError: if there is no store or its fixed files are damaged.
    """
    store, manifest = open_manifest(path)
    return {i: record["facts"] for i, record in survey(store, manifest["contents"]).records.items()}


def _tuned(values: xr.Variable, texts: list[str] | None) -> xr.Variable:
    """A tuned value of a search, stored as a result, as the coordinate that it is; texts are stored by position."""
    if texts is None:
        return values
    return xr.Variable(values.dims, np.array([*texts, ""], dtype=object)[values.values], values.attrs)


def _fixed(array: Any) -> np.ndarray:
    """A column or axis; text as plain strings, which select and print better than the stored type."""
    values = np.asarray(array[...])
    return values if values.dtype.kind in "biuf" else values.astype(object)


def read_small(store: Path, found: Survey, arrays: dict[str, Any]) -> dict[str, np.ndarray]:
    """Everything but the trajectories, whole and by slot; chunks that are not stored are empty.

    The files are uncompressed and read directly: thousands of them through Zarr take seconds.

    Args:
        found: stored chunks; one with a damaged file moves to its `damaged`.
    """
    arrays = {n: a for n, a in arrays.items() if not is_trajectory(tuple(a.metadata.dimension_names[1:]))}
    tables = {name: np.full(a.shape, a.fill_value, dtype=a.dtype) for name, a in arrays.items()}
    for chunk, record in list(found.records.items()):
        rows = slice(chunk * record["chunk_size"], (chunk + 1) * record["chunk_size"])
        wrong, values = {}, {}
        for name, array in arrays.items():
            file = chunk_file(name, array.ndim - 1, chunk)
            try:
                content = checked((store / file).read_bytes())
                values[name] = np.frombuffer(content, array.dtype.newbyteorder("<")).reshape(array.chunks)
            except DamagedError as error:
                wrong[file] = str(error)
        if wrong:
            found.damaged[chunk] = wrong
            del found.records[chunk]
        for name, value in ({} if wrong else values).items():
            tables[name][rows] = value
    return tables


class _StoredRows(BackendArray):
    """A trajectory by scenario: only stored rows are read, the others are empty."""

    def __init__(self, store: Path, array: Any, slots: np.ndarray, stored: np.ndarray):
        self.store, self.array, self.slots, self.stored = store, array, slots, stored
        self.shape, self.dtype = (len(slots), *array.shape[1:]), np.dtype(array.dtype)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.OUTER, self._read)

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        rows = np.atleast_1d(np.arange(len(self.slots))[key[0]])
        result = np.full((len(rows), *self.shape[1:]), self.array.fill_value, dtype=self.dtype)
        stored = self.stored[rows]
        if stored.any():
            try:
                result[stored] = self.array.oindex[self.slots[rows][stored]]
            except (OSError, ValueError, RuntimeError) as error:
                raise InputError(
                    self.array.basename,
                    str(self.store),
                    f"undamaged files ({error})",
                    "Give the command of the study again: what is damaged is computed again",
                ) from error
        for axis in reversed(range(1, len(key))):  # from the last axis on, as a number drops its axis
            result = result[(slice(None),) * axis + (key[axis],)]
        return result if np.ndim(np.arange(len(self.slots))[key[0]]) else result[0]
