"""Results of a sweep study as one file for other programs: a table (CSV, Parquet) or the whole data set (netCDF)."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import xarray as xr

from jaxmpc.errors import InputError, MissingToolError
from jaxmpc.files import check_target, write_atomically
from studies.store.files import store_path
from studies.store.reading import kpi_frame, open_study

FORMATS = {".csv": "csv", ".parquet": "parquet", ".nc": "netcdf"}
_INT32 = np.iinfo(np.int32)


def export(path: str | Path, target: str | Path, format: str | None = None, overwrite: bool = False) -> Path:
    """Write the results of a study to a file, in one go.

    ``csv`` and ``parquet`` hold a row for each scenario with columns and key figures (`kpi_frame`); ``parquet``
    needs pyarrow. ``netcdf`` holds everything that `open_study` gives as netCDF 3 with 64-bit offsets, which any
    netCDF program reads: text becomes character arrays, integers 32 bits, one variable may take up to 4 GB, and the
    whole data set goes through memory.

    Args:
        target: the file; its suffix ``.csv``, ``.parquet`` or ``.nc`` gives the format.
        format: ``"csv"``, ``"parquet"`` or ``"netcdf"`` for another suffix.
        overwrite: replace the file if it exists.

    Raises:
        InputError: if the format is not known, the file exists, it cannot be written, the store cannot be read,
            or netCDF 3 cannot hold a variable.
        MissingToolError: if pyarrow is missing for Parquet.
    """
    target = Path(target)
    kind = format or FORMATS.get(target.suffix.lower())
    if kind not in FORMATS.values():
        raise InputError(
            "target" if format is None else "format",
            str(target) if format is None else format,
            f"a file ending in {', '.join(FORMATS)}, or one of the formats {', '.join(FORMATS.values())}",
        )
    check_target("target", target, [store_path(path)])
    if target.is_file() and not overwrite:
        raise InputError(
            "target",
            str(target),
            "a file that does not exist yet",
            "Give another name, or --overwrite (overwrite=True) to replace it",
        )
    if kind == "parquet" and importlib.util.find_spec("pyarrow") is None:
        raise MissingToolError(
            "Parquet files need pyarrow, which is not installed: pip install 'jaxmpc[parquet]'. CSV and netCDF need nothing."
        )
    if kind == "netcdf":
        data = _netcdf_ready(open_study(path))
    else:
        table = kpi_frame(path)

    def content(temporary: str) -> None:
        if kind == "csv":
            table.to_csv(temporary)
        elif kind == "parquet":
            table.to_parquet(temporary, engine="pyarrow")
        else:
            data.to_netcdf(temporary, engine="scipy", format="NETCDF3_64BIT")

    return write_atomically(target, content)


# where a type has no counterpart in netCDF 3, by kind and bytes
_TYPES = {"b1": "i1", "i2": "i4", "i8": "i4", "u1": "i2", "u2": "i4", "u4": "i4", "u8": "i4", "f2": "f4"}


def _netcdf_ready(data: xr.Dataset) -> xr.Dataset:
    """Everything in memory, in types that netCDF 3 has."""
    data = data.load().copy()
    for name, variable in data.variables.items():
        kind, values = f"{variable.dtype.kind}{variable.dtype.itemsize}", variable.values
        stored = str if kind[0] == "O" else _TYPES.get(kind)
        if stored is None:
            continue
        if stored == "i4" and values.size and (values.min() < _INT32.min or values.max() > _INT32.max):
            raise InputError(str(name), "integers beyond 32 bits", "integers that netCDF 3 holds", "Use CSV")
        replaced = {name: xr.Variable(variable.dims, values.astype(stored), variable.attrs)}
        data = data.assign_coords(replaced) if name in data.coords else data.assign(replaced)
    return data
