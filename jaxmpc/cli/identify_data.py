"""``jaxmpc identify FILE.csv``: a model from logged data, its verdicts, and a page with the evidence."""

from __future__ import annotations

from pathlib import Path

from jaxmpc.cli.identify_fmu import written
from jaxmpc.cli.options import Argument, Options, option
from jaxmpc.errors import InputError
from jaxmpc.files import check_target

DATA_OPTIONS: tuple[Argument, ...] = (
    option("--time", "COLUMN", "data: column of the times (default: the first, or one called so)", str),
)


def identify_data(options: Options) -> int:
    """Identify a model from logged data, write it and its page, and print what was found.

    Raises:
        InputError: for bad options, and data that cannot be read or tell nothing; nothing is written then.
    """
    source, page = Path(options.source), options.out.with_suffix(".html")
    for target in (options.out, page):
        check_target("--out", target, [source])
    from identify.logged import identify_log
    from jaxmpc.programs.compilation import is_quiet

    for name, given in (("--mv", options.mv), ("--dv", options.dv), ("--cv", options.cv)):
        for text in given or ():
            if "=" in text:
                raise InputError(name, text, "the name of a column; values are for FMUs")
    given = {"dt": options.dt, "samples": options.samples, "time": options.time, "progress": not is_quiet()}
    found = identify_log(source, options.mv or (), options.cv or (), options.dv or (), **given)
    return written(found, options.out, page)
