"""Every figure by its id: which study it reads and which function draws it."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable
from pathlib import Path

import xarray as xr
from matplotlib.figure import Figure

from figures import closeup, step_coefficients, style, summary, tracking
from jaxmpc.errors import InputError
from studies.evaluate import completed
from studies.store import open_results

SMOOTH, ROUNDED, INTEGER = "continuous-choke", "step-choke", "mixed-integer"


@dataclasses.dataclass(frozen=True)
class FigureEntry:
    """One figure.

    Attributes:
        id: ``10`` for thesis figure 10, or a name.
        title: what it shows.
        study: the study whose results it reads.
        name: of its files.
        needs: controllers whose runs must be finished.
        draw: makes it from the results.
    """

    id: str
    title: str
    study: str
    name: str
    needs: tuple[str, ...]
    draw: Callable[[xr.Dataset], contextlib.AbstractContextManager[Figure]]


def _close(panel: Callable) -> Callable:
    return lambda data: panel(closeup.stretch(data, ROUNDED), ROUNDED)


def _of(panel: Callable, controller: str) -> Callable:
    return lambda data: panel(data, controller)


def _entries() -> list[FigureEntry]:
    study = "thesis"
    out = [
        FigureEntry(
            "10",
            "oil rate: steady-state step coefficients over the choke",
            study,
            "figure_10_oil_coefficients",
            (),
            lambda data: step_coefficients.draw(data, "oil_rate"),
        ),
        FigureEntry(
            "11",
            "gas rate: steady-state step coefficients over the choke",
            study,
            "figure_11_gas_coefficients",
            (),
            lambda data: step_coefficients.draw(data, "gas_rate"),
        ),
    ]
    kinds = (
        ("rates", "oil and gas rate", tracking.rates),
        ("inputs", "choke and gas lift", tracking.inputs),
        ("bias", "output bias", tracking.bias),
    )
    for first, controller, words in (
        (14, SMOOTH, "continuous MPC, continuous choke"),
        (17, ROUNDED, "continuous MPC, step choke"),
        (22, INTEGER, "mixed-integer MPC"),
    ):
        for i, (kind, what, panel) in enumerate(kinds):
            name = f"figure_{first + i}_{kind}_{controller.replace('-', '_')}"
            out.append(
                FigureEntry(
                    str(first + i), f"{what}: {words}", study, name, (controller,), _of(panel, controller)
                )
            )
    for id, (kind, what, panel) in zip(("20", "21"), kinds[:2], strict=True):
        name = f"figure_{id}_{kind}_oscillating"
        title = f"{what} while the rounded controller oscillates"
        out.append(FigureEntry(id, title, study, name, (ROUNDED,), _close(panel)))
    out.append(
        FigureEntry("summary", "one-page summary", study, "summary", (SMOOTH, ROUNDED, INTEGER), summary.draw)
    )
    return sorted(out, key=lambda entry: (not entry.id.isdigit(), int(entry.id) if entry.id.isdigit() else 0))


FIGURES: dict[str, FigureEntry] = {entry.id: entry for entry in _entries()}


def draw(ids: Iterable[str], results: str | Path | xr.Dataset, out: str | Path) -> list[Path]:
    """Draw figures by id as PNG and PDF.

    Args:
        ids: keys of `FIGURES`, or ``["all"]``.
        results: a study folder, its store, or an open data set.
        out: folder for the files.

    Returns:
        The files written.

    Raises:
        InputError: for an unknown id, or a figure whose runs are not finished; before anything is drawn.
    """
    ids = list(ids)
    ids = list(FIGURES) if ids == ["all"] else ids
    for id in ids:
        if id not in FIGURES:
            raise InputError("figure", id, f"one of {', '.join(FIGURES)}, or all")
    data = results if isinstance(results, xr.Dataset) else open_results(results)
    data = data.load()
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
    paths = []
    for id in ids:
        with FIGURES[id].draw(data) as drawn:
            paths += style.save(drawn, out, FIGURES[id].name)
    return paths
