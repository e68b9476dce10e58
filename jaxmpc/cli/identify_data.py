"""``jaxmpc identify FILE.csv``: a model from logged data."""

from __future__ import annotations

from jaxmpc.cli.options import Argument, Options, option
from jaxmpc.errors import InputError

DATA_OPTIONS: tuple[Argument, ...] = (option("--time", "COLUMN", "data: column of the time", str),)


def identify_data(options: Options) -> int:
    """Identify a model from logged data."""
    raise InputError("SOURCE", options.source, "an FMU or a process: logged data")
