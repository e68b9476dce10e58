"""Runs the sections of the benchmark, keeps every row as it comes, and writes what there is when it is stopped."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from jaxmpc.check import require
from jaxmpc.controller.case import case_to_dict
from jaxmpc.files import write_atomically
from jaxmpc.programs.interrupts import last_words
from studies.bench.context import FULL, QUICK, Context, Size
from studies.bench.folder import found, read, shipped, write
from studies.bench.instances import MODES
from studies.bench.peers import MIQP_PEERS, QP_PEERS, Peer
from studies.bench.rows import Report, Row, table
from studies.bench.sections import exact, foreign, growth, identification, loops, relaxed, startup, sweeps
from studies.store.fingerprint import versions

Section = Callable[[Context], Iterator[Row]]
SECTIONS: dict[str, Section] = {
    "relaxed": relaxed.one_at_a_time,
    "batch": relaxed.batches,
    "exact": exact.exact,
    "foreign": foreign.foreign,
    "loop": loops.loops,
    "growth": growth.growth,
    "startup": startup.startup,
    "sweep": sweeps.sweeps,
    "identification": identification.identification,
    "gpu": relaxed.devices,
}


def chosen_sections(only: str | None) -> list[str]:
    """Names of the sections to run, in their order, of names with commas between; None for all.

    Raises:
        InputError: for an unknown name or none at all.
    """
    names = list(SECTIONS) if only is None else [name.strip() for name in only.split(",")]
    for name in names:
        expected = f"sections with commas between, of {', '.join(SECTIONS)}"
        require(name in SECTIONS, "--only", name, expected)
    return [name for name in SECTIONS if name in names]


def run_bench(
    *,
    quick: bool = False,
    only: str | None = None,
    json_path: Path | None = None,
    folder: Path | None = None,
    certify: bool = False,
    data: Path | None = None,
    size: Size | None = None,
    peers: tuple[tuple[Peer, ...], tuple[Peer, ...]] = (QP_PEERS, MIQP_PEERS),
    say: Callable[[str], None] | None = None,
    stopped: Callable[[Report], object] | None = None,
) -> Report:
    """Measure, and return what was measured; an error ends a section early with the rows so far.

    Args:
        quick: a few problems of a short run, under two minutes.
        only: sections with commas between, see `SECTIONS`; None for all.
        json_path: file that gets every row, replaced as a whole after each section.
        folder: instances that are solved in place of the sections.
        certify: ask the other solvers too, and write a ``truth.json`` into the folder.
        data: folder with the published data of the section ``identification``; they are downloaded without.
        size: how much is measured, if neither the full nor the quick amount.
        peers: QP and MIQP solvers to compare with; ratios are to the first of each.
        say: receives lines of progress; standard error if not given.
        stopped: receives what was measured before Ctrl-C.

    Returns:
        `Report`; `complete` is False if a section ended early.

    Raises:
        InputError: for an unknown section, or a folder that cannot be read, before anything is measured.
        KeyboardInterrupt: after Ctrl-C; the rows so far are written and given to `stopped`.
    """
    sections = {name: SECTIONS[name] for name in chosen_sections(only)}
    require(folder is not None or not certify, "--certify", None, "a folder to --read")
    if folder is not None:
        instances = *read(folder), folder if certify else None
        sections = {"read": lambda context: found(context, *instances)}
    context = Context(size or (QUICK if quick else FULL), quick, say or _told(), *peers, data)
    report = Report(machine=machine(peers), options={"quick": quick, "sections": list(sections)})
    report.series = context.series

    def keep() -> str:
        _write(report, json_path)
        if stopped is not None:
            stopped(report)
        return ""

    with last_words(keep):
        ended = []
        for name, section in sections.items():
            ended.append(_section(name, section(context), context, report))
            _write(report, json_path)
    report.complete = all(ended)
    _write(report, json_path)
    return report


def write_instances(folder: Path, *, quick: bool = False, only: str | None = None) -> None:
    """Write the shipped instances with their optima (`only` "foreign", or None) or samples of the thesis run ("exact").

    Raises:
        InputError: for another section.
    """
    require(
        only in (None, "foreign", "exact"), "--only", only, "foreign or exact, which have instances to write"
    )
    if only == "exact":
        context = Context(QUICK if quick else FULL, quick, _told(), (), ())
        recorded = (context.recordings.instances("mixed-integer", mode, context.size.exact) for mode in MODES)
        cases, known = {name: body for some in recorded for name, body in some.files().items()}, {}
    else:
        shipped_cases, known = shipped()
        cases = {name: case_to_dict(case) for name, case in shipped_cases.items()}
    write(folder, cases, known)


def _told() -> Callable[[str], None]:
    """Lines of progress on standard error, with the time since now."""
    begin = time.perf_counter()
    return lambda line: print(f"[{time.perf_counter() - begin:6.1f} s] {line}", file=sys.stderr, flush=True)


def _section(name: str, rows: Iterator[Row], context: Context, report: Report) -> bool:
    """Append the rows of a section; an error ends it with a row that says so. True if it came to its end."""
    try:
        for row in rows:
            row.section = name
            report.rows.append(row)
    except Exception as error:  # one section must not cost the others their rows
        what = " ".join(f"{type(error).__name__}: {error}".split())
        context.say(f"{name} ended early: {what}")
        row = Row(name=f"{name}: ended early", section=name, status="failed", counts=False, note=what)
        report.rows.append(row)
        return False
    return True


def _write(report: Report, path: Path | None) -> None:
    if path is not None:
        write_atomically(path, report.to_json())


def wrong(report: Report) -> list[str]:
    """Names of our own rows whose solutions do not count."""
    peers = {peer.name for peer in (*QP_PEERS, *MIQP_PEERS)}
    return [row.name for row in report.rows if not row.counts and row.name.rpartition(": ")[2] not in peers]


def machine(peers: tuple[tuple[Peer, ...], ...] = ()) -> dict[str, str]:
    """Cores, load, versions and devices of this machine, by name, for the first line of the table."""
    import jax

    known = versions()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    devices = sorted({device.device_kind for device in jax.devices()})
    out = {
        "machine": f"{platform.system()} {platform.machine()}",
        "cores": str(cores),
        "load before": load,
        "device": " and ".join(devices),
        **{name: known[name] for name in ("python", "jaxmpc", "jax", "numpy", "highspy")},
    }
    for peer in dict.fromkeys(peer for group in peers for peer in group):
        if peer.package != "highspy":
            out[peer.package] = peer.version()
    return out


__all__ = ["SECTIONS", "chosen_sections", "machine", "run_bench", "table", "write_instances", "wrong"]
