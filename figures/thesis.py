"""All figures and the summary of the thesis study, beside its results; `jaxmpc study run thesis` calls it."""

from __future__ import annotations

from pathlib import Path

from figures.registry import FIGURES, draw
from jaxmpc.files import write_atomically
from studies import report
from studies.store import open_results


def draw_all(folder: str | Path) -> list[Path]:
    """Draw figures 10, 11, 14 to 24 and 39 and the summary page; write the summary as Markdown and CSV.

    Args:
        folder: of the study; figures go to its ``figures`` folder.

    Returns:
        The files written.
    """
    folder = Path(folder)
    data = open_results(folder).load()
    ids = [id for id, entry in FIGURES.items() if entry.study == "thesis"]
    paths = draw(ids, data, folder / "figures")
    paths.append(write_atomically(folder / "summary.md", report.markdown(data)))
    paths.append(write_atomically(folder / "summary.csv", report.table_csv(data)))
    return paths
