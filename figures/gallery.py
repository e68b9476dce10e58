"""One HTML page with every figure of the thesis that was drawn."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import xarray as xr

from figures.figure import FigureEntry
from figures.page import write_page
from figures.produce import check_asked, study_folder
from figures.registry import FIGURES
from figures.thesis.facts import about
from studies.store.reading import open_results
from studies.thesis.catalogue import PLANTS


def write_gallery(
    ids: Iterable[str] = ("all",),
    results: str | Path = "results",
    out: str | Path = "figures-out",
    quick: bool = False,
    plant: str = PLANTS[0],
) -> Path:
    """Write the page beside the figures that `figures.produce.produce` has drawn with the same arguments.

    Args:
        ids: keys of `figures.registry.FIGURES`, or ``["all"]``.
        results: folder of all results; the captions take their numbers from them.
        out: folder of the figures; the page goes there.
        quick: whether the shortened studies were drawn.
        plant: of the studies.

    Returns:
        The page, ``index.html``.

    Raises:
        InputError: for an unknown id, a figure or results that are missing, or a page of more than 10 MB; before
            anything is written.
    """
    entries = [FIGURES[id] for id in check_asked(ids, quick, plant)]
    read: dict[str | None, xr.Dataset | None] = {None: None}
    for entry in entries:
        if entry.study is not None and entry.study not in read:
            read[entry.study] = open_results(study_folder(entry.study, results, quick, plant)).load()
    options = (" --quick" if quick else "") + (f" --plant {plant}" if plant != PLANTS[0] else "")

    def command(entry: FigureEntry) -> str:
        return f"jaxmpc figures {entry.id}{options if entry.study else ''}"

    shown = [(entry, read[entry.study]) for entry in entries]
    return write_page(shown, out, "Figures", about(quick, plant), command)
