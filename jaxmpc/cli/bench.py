"""``jaxmpc bench``: our solvers beside others."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from jaxmpc.cli.options import EXIT_OPTIMAL, EXIT_OTHER, Options, command, option, switch
from jaxmpc.files import check_folder, check_target

SECTIONS = "relaxed, batch, exact, loop, growth, startup, sweep, gpu"
SWEEP = {"dest": "only", "action": "store_const", "const": "sweep"}
DRAWN = "where to draw time per sample over the run and rate over batch size (default: nowhere)"


@command(
    "bench",
    switch("--quick", "a few samples of a short run, about two minutes in place of twelve"),
    option("--only", "SECTION[,SECTION]", f"what to measure: {SECTIONS} (default: all)", str),
    switch("--sweep", "what a study costs beside its closed loops: the same as --only sweep", **SWEEP),
    option("--json", "FILE", "where to write every row (default: nowhere)", Path),
    option("--figures", "DIR", DRAWN, Path),
    epilog="Times are wall times [ms] or [s], rates are per second. The other solvers come with pip install "
    "'jaxmpc[bench]'; one that is not installed is named as missing. Ctrl-C prints what was measured so far. "
    "Exit status: 0 done, 2 bad input, 130 stopped by Ctrl-C, 1 ended early or one of our solutions is wrong.",
)
def bench(options: Options) -> int:
    """Time our solvers beside others on recorded samples of the thesis run, and check every solution."""
    if options.json is not None:
        check_target("--json", options.json)
    if options.figures is not None:
        check_folder("--figures", options.figures)
    from studies.bench.run import run_bench, table, wrong

    def show(report: Any) -> None:
        print(table(report), end="", flush=True)

    report = run_bench(quick=options.quick, only=options.only, json_path=options.json, stopped=show)
    show(report)
    if options.figures is not None:
        from figures.thesis.solve_time import draw_benchmark

        for path in draw_benchmark(json.loads(report.to_json()), options.figures):
            print(path, file=sys.stderr)
    return EXIT_OPTIMAL if report.complete and not wrong(report) else EXIT_OTHER
