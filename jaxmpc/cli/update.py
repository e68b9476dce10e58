"""``jaxmpc update``: the model of a process with gains, dead times and times as logged data say."""

from __future__ import annotations

from pathlib import Path

from jaxmpc.cli.options import EXIT_OPTIMAL, EXITS, Options, command, option
from jaxmpc.files import check_target


@command(
    "update",
    option("process", "PROCESS", "a process file, or a shipped process", str),
    option("log", "LOG", "CSV or Parquet file; its columns are the tags of the process", Path),
    option("--time", "COLUMN", "of the times (default: the first, or one called so)", str),
    option(
        "--out",
        "MODEL.json",
        "the new model; page, process and study are written beside it",
        Path("updated.json"),
    ),
    epilog=f"Nothing is taken over by itself: the files are a proposal. {EXITS}",
)
def update(options: Options) -> int:
    """Estimate gains, dead times and times of a process's model from logged data, also of a closed loop, beside the present
    ones.
    """
    from identify.logged.proposal import proposal_files, write_proposal

    files = proposal_files(options.out)
    for target in (options.out, *files.values()):
        check_target("--out", target, [options.process, options.log])
    from identify.logged.update import update_model
    from identify.plants import model_of
    from jaxmpc.process.file import load_process
    from jaxmpc.programs.compilation import is_quiet

    process = load_process(options.process)
    present = model_of(process)
    found = update_model(process, present, options.log, time=options.time, progress=not is_quiet())
    from figures.identification import write_page
    from jaxmpc.cli.identify_fmu import said

    write_page(found, files["page"])
    said(found)
    for path in (*write_proposal(process, present, found.model, options.out), files["page"]):
        print(path)
    print(f"Next: jaxmpc study run {files['study']}")
    return EXIT_OPTIMAL
