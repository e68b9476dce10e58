"""The step responses of a process on one page, as `jaxmpc process check` draws them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from figures import style
from jaxmpc.process.process import Process


@style.house_style
def draw_responses(
    process: Process, responses: np.ndarray, measured: Sequence[tuple[str, str]], folder: str | Path
) -> list[Path]:
    """Draw what a unit step of every MV, and of every measured disturbance, does to every CV.

    Args:
        responses: ``"cv input n"``, step-response coefficients of the MVs, then of the disturbances.
        measured: names and units of the disturbances.
        folder: for the files ``NAME-responses``.

    Returns:
        The PNG and the PDF.
    """
    inputs = [*((mv.label, mv.unit) for mv in process.mvs), *measured]
    samples = responses.shape[2]
    drawn, axes = style.grid(
        len(process.cvs), len(inputs), 2.9 * len(inputs) + 0.6, 1.9 * len(process.cvs) + 0.5
    )
    long = samples * process.dt > 7200
    times = np.arange(samples + 1) * process.dt / (60 if long else 1)
    for i, cv in enumerate(process.cvs):
        for j, (label, unit) in enumerate(inputs):
            ax, response = axes[i][j], np.concatenate([[0.0], responses[i, j]])
            ax.plot(times, response, color=style.BLUE, drawstyle="steps-post")
            ax.axhline(0.0, color=style.GREY, linewidth=0.6)
            ax.set_title(f"{label} to {cv.label}", fontsize=9)
            ax.set_ylabel(f"[{style.unit(cv.unit)} per {style.unit(unit)}]", fontsize=8)
            if i == len(process.cvs) - 1:
                ax.set_xlabel(f"time after the step [{'min' if long else 's'}]")
    return style.save(drawn, folder, f"{process.name}-responses")
