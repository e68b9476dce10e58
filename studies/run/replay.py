"""A controller of a process on a log of its plant: reads the log, replays it, and stores the result as a comparison of one.

`jaxmpc replay` calls `run_replay`; what is decided is in `jaxmpc.loop.replay`.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import xarray as xr

from identify.logged.log import Log, read_log
from identify.logged.tags import Tags, tags_of
from identify.plants import model_of
from jaxmpc.check import located
from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError
from jaxmpc.files import strict_json
from jaxmpc.loop.replay import LEAST, Done, replay
from jaxmpc.loop.trajectory import Trajectory
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.file import process_digest
from jaxmpc.process.process import Process
from studies.definition.comparison import ControllerDefinition
from studies.run.comparison import labelled, progress_bar, results_layout, run_missing, shared_variables
from studies.store.files import RESULTS
from studies.store.fingerprint import content_hash, packages_hash
from studies.store.layout import StoreLayout
from studies.store.writing import check_writable, locked

ADVICE = "advice"  # name of the one controller in the results
WINDOWS = 100  # setpoint windows at most; a setpoint that moves all the time has none


def run_replay(
    process: Process,
    log: str | Path,
    out: str | Path = "results",
    *,
    kind: str = "",
    preset: str = "",
    reference: str = "",
    time: str | None = None,
    progress: bool = True,
    say: Callable[[str], None] = print,
) -> Path:
    """Replay a log and store it; a replay that is stored already with equal inputs is kept.

    Args:
        process: whose controller advises.
        log: CSV or Parquet file, see `identify.logged.log.read_log`; columns are the tags of the process.
        out: folder of all results.
        kind: ``mixed-integer`` or ``continuous``; the first if the process has stepped MVs and none is given.
        preset: tuning; the first one of the process if not given.
        reference: of the process, whose first setpoints hold where the log has none; the first one if not given.
        time: column of the times; found if not given.
        progress: whether to show a bar with rate and time left.
        say: receives one line per event.

    Returns:
        The folder, with ``results.zarr`` (`studies.store.reading.open_results`) and one controller `ADVICE`: its
        ``position`` is what was done, its ``demand`` what was advised.

    Raises:
        InputError: for another preset or reference, and a log that cannot be read; before anything is computed.
    """
    known = "mixed-integer" if process.stepped else "continuous"
    controller = ControllerDefinition(
        ADVICE,
        f"{kind or known} advice",
        kind=kind or known,  # pyright: ignore[reportArgumentType]
        actuator="step" if process.stepped else "continuous",
        blocking=process.structure().blocking,  # pyright: ignore[reportArgumentType]
        tuning=preset,
        changes={"demand_lead": 0.0},  # every advice begins where the MVs stand
        position_feedback=True,
    )
    with located(lambda field: "--preset" if field == "tuning" else field):
        controller.check(process, np.inf)
    name = f"{process.name}-{re.sub('[^A-Za-z0-9_.-]', '-', Path(log).stem)}-replay"
    folder = check_writable(Path(out) / name)
    model = model_of(process)
    tags = tags_of(process, model)
    read = _read(process, tags, log, time)
    for note in read.notes:
        say(f"Log: {note}.")
    done = _done(process, tags, read, process.reference(reference or None).setpoints[0], say)
    layout = _layout(process, model, controller, done, name, Path(log).name, read)
    controls = Controller(controller.structure(process), controller.build_tuning(process), model)

    def run(_: int) -> Trajectory:
        with progress_bar("replay", progress) as report:
            return replay(controls, done, progress=report)

    with locked(folder / RESULTS):
        return run_missing(folder, layout, run, say)


def _read(process: Process, tags: Tags, path: str | Path, time: str | None) -> Log:
    """The log at the sampling interval of the process; nothing that was measured is left out."""
    held = [*tags.inputs, *_setpoint_tags(process).values()]
    columns = list(dict.fromkeys([*tags.cv, *held]))
    return read_log(path, columns, process.dt, time, held=held, hold=np.inf, clean=False)


def _setpoint_tags(process: Process) -> dict[int, str]:
    """Columns of setpoints by the place of their CV."""
    return {i: cv.setpoint_tag for i, cv in enumerate(process.cvs) if cv.setpoint_tag}


def _done(process: Process, tags: Tags, log: Log, constant: np.ndarray, say: Callable[[str], None]) -> Done:
    """The log as a controller is told it.

    Args:
        constant: setpoints where the log has none, ``"cv"`` [CV unit].

    Raises:
        InputError: for a log without two rows in a row that have all CVs at the first.
    """
    count, given = len(log.times), _setpoint_tags(process)
    table = lambda names: np.stack([log.values[name] for name in names], axis=1)  # noqa: E731
    cv, setpoint = table(tags.cv), np.tile(np.asarray(constant, dtype=float), (count, 1))
    for i, name in given.items():
        setpoint[:, i] = log.values[name]
    stretches, begins = [], np.all(np.isfinite(cv), axis=1)
    for own in log.segments:
        rows = np.flatnonzero(begins[own])
        if rows.size and own.stop - own.start - rows[0] >= LEAST:
            stretches.append(slice(own.start + int(rows[0]), own.stop))
    if not stretches:
        raise InputError("log", f"{count} rows", "two rows in a row, the first with a value of every CV")
    fixed = ", ".join(
        f"{one.name} {constant[i]:g} {one.unit}".removesuffix(" 1")
        for i, one in enumerate(process.cvs)
        if i not in given
    )
    if fixed:
        say(f"Log: setpoints that it does not have are taken from the reference: {fixed}.")
    dv = table(tags.dv) if tags.dv else np.zeros((count, 0))
    return Done(log.times, cv, setpoint, table(tags.mv), dv, stretches)


def _layout(
    process: Process,
    model: StepResponseModel,
    controller: ControllerDefinition,
    done: Done,
    name: str,
    log: str,
    read: Log,
) -> StoreLayout:
    """The store of a replay: a comparison of one controller, its samples at the times of the log."""
    code = packages_hash()
    told = [np.asarray(getattr(done, key)) for key in ("time", "cv", "setpoint", "mv", "dv")]
    stretches = [[own.start, own.stop] for own in done.stretches]
    inputs: dict[str, Any] = {
        "log": told,
        "stretches": stretches,
        "process": process_digest(process),
        "code": code,
        "model": np.asarray(model.coefficients),
    }
    hashes = [content_hash(inputs, controller.resolved(process))]
    structure, rows = controller.structure(process), done.decided
    definition = {"name": name, "log": log, "controllers": [msgspec.to_builtins(controller)]}
    return results_layout(
        controllers={ADVICE: controller.label},
        hashes=hashes,
        structure=structure,
        times=done.time[rows],
        blocks=structure.block_count,
        shared=lambda: _shared(process, model, controller, done),
        provenance={
            "study": name,
            "title": f"{process.title}: {controller.label} on {log}",
            "definition": definition,
            "process": strict_json(process.body),
            "structures": [dataclasses.asdict(structure)],
            "plant": {"kind": "log", "file": log, "begin": read.begin, "notes": list(read.notes)},
            "model": {"working_point": dict(model.working_point), "provenance": dict(model.provenance)},
            "code": code,
        },
        study_hash=content_hash(definition, hashes),
    )


def _shared(
    process: Process, model: StepResponseModel, controller: ControllerDefinition, done: Done
) -> dict[str, xr.DataArray]:
    """What belongs to the log, and where the predictions of each sample began."""
    rows, begun = done.decided, done.begun
    setpoint = done.setpoint[rows]
    window = np.concatenate([[0], np.cumsum(np.any(np.diff(setpoint, axis=0) != 0, axis=1))])
    known = done.dv[rows] - done.dv[begun]
    course = np.zeros((len(rows), len(process.disturbances)))
    for j, name in enumerate(model.dv_names):
        if name in process.disturbance_names:
            course[:, process.disturbance_names.index(name)] = known[:, j]
    window = window if window[-1] < WINDOWS else 0 * window
    out = shared_variables(process, model, [controller], setpoint, window, course)
    out["base"] = labelled(done.cv[begun], ("time", "cv"), "CV where the stretch of the log began", "cv_unit")
    if model.dv_names:
        names = list(model.dv_names), "measured disturbance", ""
        words = "measured disturbance, from where the stretch of the log began"
        out["dv"] = labelled(known, ("time", "dv_name"), words, "dv_unit", dv_name=names)
        words, unit = "step-response coefficient", "cv_unit per dv_unit"
        axes = ("cv", "dv_name", "lag")
        out["dv_coefficient"] = labelled(np.asarray(model.dv_coefficients), axes, words, unit)
    return out
