"""Every figure by its id: which study it reads and which function draws it; the entries stand in their own modules."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import xarray as xr

from figures import style
from figures.entry import FigureEntry
from figures.thesis import extensions, scenario_entries, thesis_entries, unblocked
from jaxmpc.errors import InputError
from studies.kpi.evaluate import completed
from studies.store.comparison import open_results


def _order(entry: FigureEntry) -> tuple[bool, int]:
    return not entry.id.isdigit(), int(entry.id) if entry.id.isdigit() else 0


FIGURES: dict[str, FigureEntry] = {
    entry.id: entry
    for entry in sorted(
        [*thesis_entries.ENTRIES, *scenario_entries.ENTRIES, unblocked.ENTRY, *extensions.ENTRIES], key=_order
    )
}


def check_ids(ids: Iterable[str]) -> list[str]:
    """The ids that are asked for, each once.

    Args:
        ids: keys of `FIGURES`, or ``["all"]``.

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
    ids = check_ids(ids) if ids else []  # a study may have no figures
    studies = list(dict.fromkeys(FIGURES[id].study for id in ids if FIGURES[id].study is not None))
    if len(studies) > 1:
        raise InputError("figure", ids, f"figures of one study, not of {', '.join(map(str, studies))}")
    if studies and results is None:
        raise InputError("results", None, f"results of the study {studies[0]}")
    data = None
    if studies:
        data = results if isinstance(results, xr.Dataset) else open_results(results)  # type: ignore[arg-type]
        data = data.load()
        _check_finished(ids, data)
    paths = []
    for id in ids:
        with FIGURES[id].draw(data) as drawn:
            paths += style.save(drawn, out, FIGURES[id].name)
    return paths


def _check_finished(ids: list[str], data: xr.Dataset) -> None:
    finished = (
        {str(name) for name in completed(data).controller.values}
        if any(FIGURES[i].needs for i in ids)
        else set()
    )
    for id in ids:
        missing = [name for name in FIGURES[id].needs if name not in finished]
        if missing:
            raise InputError(
                f"figure {id}",
                ", ".join(missing),
                "finished runs in the results",
                "Run the study again to finish them",
            )
