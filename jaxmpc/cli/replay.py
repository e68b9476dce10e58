"""``jaxmpc replay``: a controller of a process on logged data."""

from __future__ import annotations

from pathlib import Path

from jaxmpc.cli.options import EXIT_OPTIMAL, EXITS, Options, command, option
from jaxmpc.files import check_folder

KINDS = ("mixed-integer", "continuous")


@command(
    "replay",
    option("process", "PROCESS", "a process file, or a shipped process", str),
    option("log", "LOG", "CSV or Parquet file; its columns are the tags of the process", Path),
    option("--controller", "KIND", f"{' or '.join(KINDS)} (default: the first, if MVs are stepped)", str),
    option("--preset", "NAME", "tuning (default: the first of the process)", str),
    option("--reference", "NAME", "of the process, whose first setpoints hold where the log has none", str),
    option("--time", "COLUMN", "of the times (default: the first, or one called so)", str),
    option("--out", "DIR", "where results and figures go", Path("results")),
    epilog=f"The results open with jaxmpc explore PROCESS --store DIR/NAME. {EXITS}",
)
def replay(options: Options) -> int:
    """Say what a controller would have advised at every sample of a log, beside what was done."""
    from jaxmpc.check import among

    if options.controller is not None:
        among("--controller", options.controller, KINDS)
    check_folder("--out", options.out)
    from jaxmpc.process.file import load_process
    from jaxmpc.programs.compilation import is_quiet
    from studies.replay import write_summary
    from studies.run.replay import run_replay

    folder = run_replay(
        load_process(options.process),
        options.log,
        options.out,
        kind=options.controller or "",
        preset=options.preset or "",
        reference=options.reference or "",
        time=options.time,
        progress=not is_quiet(),
    )
    from figures.registry import draw_study

    for what, value in write_summary(folder):
        print(f"{what}: {value}")
    draw_study(folder, "replay")
    print(f"Summary: {folder / 'summary.md'}, figures: {folder / 'figures'}")
    return EXIT_OPTIMAL
