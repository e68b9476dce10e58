"""What ``jaxmpc identify`` does with logged data: reads it, fits it, writes the model and its page, and prints the verdicts."""

from __future__ import annotations

import sys
from pathlib import Path

from jaxmpc.cli.options import EXIT_OPTIMAL, Options, option
from jaxmpc.errors import InputError
from jaxmpc.files import check_target

DATA_OPTIONS = (
    option("--time", "COLUMN", "data: the column of the times (default: the first, or one called so)", str),
)


def identify_data(options: Options) -> int:
    """Identify a step-response model from logged data.

    Args:
        options: ``source``, ``mv``, ``cv``, ``dv`` (lists of names or None), ``dt``, ``samples``, ``time`` and ``out``.

    Raises:
        InputError: for bad options, and data that cannot be read or tell nothing; nothing is written then.
    """
    source, page = Path(options.source), Path(options.out).with_suffix(".html")
    for target in (options.out, page):
        check_target("--out", target, [source])
    from figures.identification import write_page

    from identify.logged import identify_log
    from jaxmpc.programs.compilation import is_quiet

    for name, given in (("--mv", options.mv), ("--dv", options.dv), ("--cv", options.cv)):
        for text in given or ():
            if "=" in text:
                raise InputError(name, text, "the name of a column; values belong to FMUs")
    found = identify_log(
        source,
        options.mv or (),
        options.cv or (),
        options.dv or (),
        dt=options.dt,
        samples=options.samples,
        time=options.time,
        progress=not is_quiet(),
    )
    found.model.save(options.out)
    write_page(found, page)
    width = max(len(f"{row.input} on {row.cv}") for row in found.verdicts)
    for row in found.verdicts:
        print(f"{row.verdict:4}  {f'{row.input} on {row.cv}':{width}}  {row.says}")
    for note in found.notes:
        print(f"jaxmpc: {note}", file=sys.stderr)
    for words in found.advice:
        print(f"Then: {words}.")
    print(options.out)
    print(page)
    print(f"Next: jaxmpc process new --model {options.out}")
    return EXIT_OPTIMAL
