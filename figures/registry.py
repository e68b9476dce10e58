"""Every figure of the thesis by its id, those of any comparison, and drawing them; the modules that draw have the entries.

The command line (`jaxmpc figures`, `jaxmpc study run` of a comparison) and `figures.produce` call it.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import xarray as xr

from figures import replay, style
from figures.comparison import overview, tracking, wear
from figures.comparison import summary as comparison_summary
from figures.figure import FigureEntry
from figures.page import write_page
from figures.thesis import (
    coefficients,
    events,
    gain_scheduling,
    integer_example,
    mean_move,
    open_loop,
    plans,
    runs,
    soft,
    solve_time,
    summary,
    time_limit,
    unblocked,
)
from jaxmpc.errors import InputError
from studies.kpi.evaluate import completed
from studies.store.process import process_in
from studies.store.reading import open_results

_NUMBERED = (integer_example, coefficients, soft, runs, plans, open_loop, events, solve_time)
_NAMED = (summary, unblocked, gain_scheduling, mean_move, time_limit)

FIGURES: dict[str, FigureEntry] = {
    entry.id: entry
    for entry in (
        *sorted((entry for module in _NUMBERED for entry in module.ENTRIES), key=lambda entry: int(entry.id)),
        *(entry for module in _NAMED for entry in module.ENTRIES),
    )
}


def check_ids(ids: Iterable[str]) -> list[str]:
    """The ids that are asked for, each once: keys of `FIGURES`, or ``["all"]``.

    Raises:
        InputError: for an unknown id, or none at all.
    """
    ids = list(dict.fromkeys(ids))
    if ids == ["all"]:
        return list(FIGURES)
    for id in ids or [None]:
        if id not in FIGURES:
            raise InputError("figure", id, f"one of {', '.join(FIGURES)}, or all")
    return ids


def draw(ids: Iterable[str], results: str | Path | xr.Dataset | None, out: str | Path) -> list[Path]:
    """Draw figures of one study as PNG and PDF.

    Args:
        ids: keys of `FIGURES`; those that read results must read the same study.
        results: a study folder, its store, or an open data set; None for figures that read none.
        out: folder for the files.

    Returns:
        The files written.

    Raises:
        InputError: for an unknown id, ids of several studies, or a figure whose runs are not finished; before
            anything is drawn.
    """
    ids = list(ids)
    entries = [FIGURES[id] for id in (check_ids(ids) if ids else [])]  # a study may have no figures
    studies = list(dict.fromkeys(entry.study for entry in entries if entry.study is not None))
    if len(studies) > 1:
        raise InputError("figure", ids, f"figures of one study, not of {', '.join(studies)}")
    data = None
    if studies:
        if results is None:
            raise InputError("results", None, f"results of the study {studies[0]}")
        data = (results if isinstance(results, xr.Dataset) else open_results(results)).load()
        _check_finished(entries, data)
    return _drawn(entries, data, out)


def draw_study(folder: str | Path, kind: str) -> list[Path]:
    """Draw every figure of a comparison into the ``figures`` folder of its folder, and all on one page there.

    Args:
        folder: of its results.
        kind: `studies.definition.catalogue.Comparison.kind`; those of the thesis have their own figures, any other the ones
            of `comparison_figures`; ``replay`` has one of its own.

    Returns:
        The files written.

    Raises:
        InputError: if no run of it is finished, or not one that a figure needs.
    """
    data, out = open_results(folder).load(), Path(folder) / "figures"
    entries = [entry for entry in FIGURES.values() if entry.study == kind] or other_figures(data, kind)
    _check_finished(entries, data)
    shown = [(entry, data) for entry in entries]
    title, process = str(data.attrs.get("title", "")), process_in(data)
    about = "a controller on logged data" if kind == replay.STUDY else "every run of one comparison"
    return [*_drawn(entries, data, out), write_page(shown, out, title, f"{process.title}: {about}.")]


def other_figures(data: xr.Dataset, kind: str) -> list[FigureEntry]:
    """Those of a replay, or of a comparison of any process."""
    return list(replay.ENTRIES) if kind == replay.STUDY else comparison_figures(data)


def comparison_figures(data: xr.Dataset) -> list[FigureEntry]:
    """The figures of a comparison of any process: of all its runs, then of each finished one."""
    return [
        *comparison_summary.ENTRIES,
        *overview.ENTRIES,
        *wear.ENTRIES,
        *tracking.entries(data),
    ]


def _drawn(entries: Iterable[FigureEntry], data: xr.Dataset | None, out: str | Path) -> list[Path]:
    return [path for entry in entries for path in style.save(entry.draw(data), out, entry.name)]


def _check_finished(entries: list[FigureEntry], data: xr.Dataset) -> None:
    needed = any(entry.needs for entry in entries)
    finished = set(map(str, completed(data).controller.values)) if needed else set()
    for entry in entries:
        missing = ", ".join(name for name in entry.needs if name not in finished)
        if missing:
            hint = "Run the study again to finish them"
            raise InputError(f"figure {entry.id}", missing, "finished runs in the results", hint)
