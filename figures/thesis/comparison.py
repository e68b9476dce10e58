"""All figures of a comparison, beside its results; `jaxmpc study run` of a comparison calls it."""

from __future__ import annotations

from pathlib import Path

from figures.registry import FIGURES, draw


def draw_all(folder: str | Path, study: str) -> list[Path]:
    """Draw every figure of a study into its ``figures`` folder.

    Args:
        folder: of the study.
        study: a key of `studies.thesis.catalogue.STUDIES`.

    Returns:
        The files written.
    """
    ids = [id for id, entry in FIGURES.items() if entry.study == study]
    return draw(ids, folder, Path(folder) / "figures")
