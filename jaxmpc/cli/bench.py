"""``jaxmpc bench``: our solvers beside others."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from jaxmpc.cli.options import EXIT_OPTIMAL, EXIT_OTHER, Options, command, option, switch
from jaxmpc.files import check_folder, check_target

SECTIONS = "relaxed, batch, exact, foreign, loop, growth, startup, sweep, identification, gpu"
SWEEP = {"dest": "only", "action": "store_const", "const": "sweep"}
DRAWN = "where to draw time per sample, rate over batch size and performance profiles (default: nowhere)"
WRITTEN = "write instances as case files with their optima, and measure nothing: those of --only foreign (default) or exact"
READ = "solve the case files of a folder, and hold the answers against its truth.json"


@command(
    "bench",
    switch("--quick", "a few samples of a short run, about two minutes in place of half an hour"),
    option("--only", "SECTION[,SECTION]", f"what to measure: {SECTIONS} (default: all)", str),
    switch("--sweep", "what a study costs beside its closed loops: the same as --only sweep", **SWEEP),
    option("--json", "FILE", "where to write every row (default: nowhere)", Path),
    option("--figures", "DIR", DRAWN, Path),
    option("--write", "DIR", WRITTEN, Path),
    option("--read", "DIR", READ, Path),
    option("--data", "DIR", "published data for identification (default: downloaded into the cache)", Path),
    switch("--certify", "with --read: ask the other solvers too, and write truth.json"),
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
    if options.write is not None:
        check_folder("--write", options.write)
    if options.read is not None and options.certify:
        check_folder("--read", options.read)
    from studies.bench.run import run_bench, table, write_instances, wrong

    if options.write is not None:
        write_instances(options.write, quick=options.quick, only=options.only)
        return EXIT_OPTIMAL

    def show(report: Any) -> None:
        print(table(report), end="", flush=True)

    given = {"quick": options.quick, "only": options.only, "json_path": options.json, "data": options.data}
    report = run_bench(**given, folder=options.read, certify=options.certify, stopped=show)
    show(report)
    if options.figures is not None:
        from figures.thesis.solve_time import draw_benchmark

        for path in draw_benchmark(json.loads(report.to_json()), options.figures):
            print(path, file=sys.stderr)
    return EXIT_OPTIMAL if report.complete and not wrong(report) else EXIT_OTHER
