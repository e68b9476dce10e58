"""Figures from nothing: the studies that they need are run if their results are missing, then all are drawn.

`write_gallery` puts what was drawn on one HTML page.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import xarray as xr

from figures.figure import FigureEntry
from figures.page import write_page
from figures.registry import FIGURES, check_ids, draw
from figures.thesis.facts import about
from studies.run.comparison import is_current as stored_as
from studies.store.reading import open_results
from studies.store.writing import check_writable
from studies.thesis import catalogue


def produce(
    ids: Iterable[str],
    results: str | Path = "results",
    out: str | Path = "figures-out",
    quick: bool = False,
    plant: str = catalogue.PLANTS[0],
    say: Callable[[str], None] = print,
) -> list[Path]:
    """Draw figures, and first run what is missing of the studies that they read.

    Args:
        ids: keys of `figures.registry.FIGURES`, or ``["all"]``.
        results: folder of all results; each study has its own folder in it.
        out: folder for the figures.
        quick: read and run the shortened studies.
        plant: one of `studies.thesis.catalogue.PLANTS`.
        say: receives one line per event.

    Returns:
        The files written, PNG and PDF of each figure.

    Raises:
        InputError: for an unknown id or plant or a folder that cannot be written, before anything runs.
        MissingToolError: if an FMU is needed and cannot be built.
    """
    ids = check_asked(ids, quick, plant)
    check_writable(out)
    studies = list(dict.fromkeys(FIGURES[id].study for id in ids))
    folders: dict[str | None, Path | None] = {None: None}
    for study in filter(None, studies):
        folders[study] = study_folder(study, results, quick, plant)
        if is_current(study, results, quick, plant):
            say(f"{folders[study]}: complete.")
        else:
            folders[study] = catalogue.run_thesis(study, results, quick, plant, say=say)
    drawn = [draw([id for id in ids if FIGURES[id].study == study], folders[study], out) for study in studies]
    return [path for paths in drawn for path in paths]


def write_gallery(
    ids: Iterable[str] = ("all",),
    results: str | Path = "results",
    out: str | Path = "figures-out",
    quick: bool = False,
    plant: str = catalogue.PLANTS[0],
) -> Path:
    """Write one HTML page, ``index.html``, beside the figures that `produce` has drawn with the same arguments.

    The captions take their numbers from the results.

    Returns:
        The page.

    Raises:
        InputError: for an unknown id, a figure or results that are missing, or a page of more than 10 MB; before
            anything is written.
    """
    entries = [FIGURES[id] for id in check_asked(ids, quick, plant)]
    read: dict[str | None, xr.Dataset | None] = {None: None}
    for study in filter(None, dict.fromkeys(entry.study for entry in entries)):
        read[study] = open_results(study_folder(study, results, quick, plant)).load()
    options = (" --quick" if quick else "") + (f" --plant {plant}" if plant != catalogue.PLANTS[0] else "")

    def command(entry: FigureEntry) -> str:
        return f"jaxmpc figures {entry.id}{options if entry.study else ''}"

    shown = [(entry, read[entry.study]) for entry in entries]
    return write_page(shown, out, "Figures", about(quick, plant), command)


def check_asked(ids: Iterable[str], quick: bool, plant: str) -> list[str]:
    """The ids that are asked for, each once, or an `InputError` for an unknown id or plant."""
    ids = check_ids(ids)
    catalogue.study_name("", quick, plant)
    return ids


def study_folder(study: str, results: str | Path, quick: bool, plant: str) -> Path:
    """Where the results of a study of the thesis are."""
    return Path(results) / catalogue.study_name(study, quick, plant)


def is_current(study: str, results: str | Path, quick: bool, plant: str) -> bool:
    """Whether every run of a study of the thesis is stored, made from today's definition by today's code."""
    definition = catalogue.comparison_of(study, quick, plant).definition
    return stored_as(definition, study_folder(study, results, quick, plant))
