"""What `jaxmpc update` writes beside a new model: the study that compares both models in closed loop, and its process.

The new model is the plant of the study, so that it answers what the present one costs if the new one is right.
"""

from __future__ import annotations

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
    write_atomically(files["process"], toml_text(_process(process, updated, out)))
    write_atomically(files["study"], _study(process, out, files))
    return [out, files["present"], files["process"], files["study"]]


def _process(process: Process, updated: StepResponseModel, out: Path) -> dict[str, Any]:
    """The content of the process file with the new model, which is also its plant, and disturbances that it has."""
    body = dict(process.body)
    for key in ("model", "plants", "disturbance", "disturbances"):
        body.pop(key, None)
    own = {*updated.dv_names, *(f"output.{name}" for name in process.cv_names)}
    given = process.body.get("disturbance", [])
    kept = [one for one in given if one["name"] in own]
    body |= {"disturbance": kept} if kept else {}
    if len(kept) == len(given) and "disturbances" in process.body:
        body["disturbances"] = process.body["disturbances"]
    plant = {"kind": "model", "source": out.name}
    return body | {"model": {"file": out.name}, "plants": {PLANT: plant}}


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
