"""What `jaxmpc update` writes beside a new model: a process with it, and the study that compares both models in closed loop.

The new model is the plant of the study, so that it answers what the present one costs if the new one is right.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from jaxmpc.files import toml_text, write_atomically
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.process import Process

PLANT = "updated"  # name of the plant that is the new model


def proposal_files(out: Path) -> dict[str, Path]:
    """What is written beside a model file: the page, the present model, the process and the study."""
    ends = {"page": ".html", "present": "-present.json", "process": "-process.toml", "study": "-study.toml"}
    return {name: out.with_name(out.stem + end) for name, end in ends.items()}


def write_proposal(
    process: Process, present: StepResponseModel, updated: StepResponseModel, out: Path
) -> list[Path]:
    """Write both models, the process with the new one, and the study; returns the files.

    Args:
        out: file of the new model; the others lie beside it, see `proposal_files`.
    """
    files = proposal_files(out)
    updated.save(out)
    present.save(files["present"])
    write_atomically(files["process"], toml_text(_process(process, out)))
    write_atomically(files["study"], _study(process, out, files))
    return [out, files["present"], files["process"], files["study"]]


def _process(process: Process, out: Path) -> dict[str, Any]:
    """The content of the process file with the new model, which is also its first plant."""
    body = {key: value for key, value in process.body.items() if key not in ("model", "plants")}
    near = lambda source: os.path.relpath(Path(process.folder) / source, out.parent)  # noqa: E731
    plants: dict[str, Any] = {PLANT: {"kind": "model", "source": out.name}}
    for name, plant in process.body.get("plants", {}).items():
        if plant["kind"] == "fmu" or (plant["kind"] == "model" and plant.get("source")):
            plants.setdefault(name, {**plant, "source": near(plant["source"])})
    return body | {"model": {"file": out.name}, "plants": plants}


def _study(process: Process, out: Path, files: dict[str, Path]) -> str:
    kind = "mixed-integer" if process.stepped else "continuous"
    controllers = [
        {"name": name, "label": f"{name} model", "kind": kind, "model": file.name}
        for name, file in (("present", files["present"]), (PLANT, out))
    ]
    body = {
        "name": f"{process.name}-{out.stem}",
        "title": f"{process.title}: the present model and the updated one, which is the plant",
        "process": files["process"].name,
        "plant": PLANT,
        "controllers": controllers,
        "quick": {"title": f"{process.title}: present and updated model, shortened"},
    }
    return toml_text(body)
