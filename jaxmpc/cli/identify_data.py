"""``jaxmpc identify FILE.csv``: a model from logged data, its verdicts, and a page with the evidence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxmpc.cli.identify_fmu import written
from jaxmpc.cli.options import Argument, Options, option
from jaxmpc.errors import InputError
from jaxmpc.files import check_target

DATA_OPTIONS: tuple[Argument, ...] = (
    option("--time", "COLUMN", "data: column of the times (default: the first, or one called so)", str),
    option("--process", "FILE.toml", "data: process whose names and tags are those of --mv, --cv, --dv", str),
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
    mv, cv, dv = (list(given or ()) for given in (options.mv, options.cv, options.dv))
    given = {"dt": options.dt, "samples": options.samples, "time": options.time, "progress": not is_quiet()}
    if options.process is not None:
        from jaxmpc.process.file import load_process

        process = load_process(options.process)
        kinds = (process.mvs, process.cvs, process.disturbances)
        mv, cv, dv = (_of_process(own, kind) for own, kind in zip((mv, cv, dv), kinds, strict=True))
        mv, cv = mv or list(process.mv_names), cv or list(process.cv_names)
        given["columns"] = {variable.name: variable.column for kind in kinds for variable in kind}
        given["units"] = {variable.name: variable.unit for kind in kinds for variable in kind}
        given["dt"] = process.dt if options.dt is None else options.dt
    found = identify_log(source, mv, cv, dv, **given)
    return written(found, options.out, page)


def _of_process(given: Sequence[str], variables: Sequence[Any]) -> list[str]:
    """Names of variables that are given by their name or their tag; others are columns."""
    known = {variable.tag: variable.name for variable in variables if variable.tag}
    return [known.get(name, name) for name in given]
