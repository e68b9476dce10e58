"""A tuned controller as a co-simulation FMU (FMI 2.0), for simulators in which it shall run against their own plants.

PythonFMU packs the controller's file and the program `identify.controller_slave`; the Python of the program that loads the
FMU runs it, and has to have jaxmpc.
"""

from __future__ import annotations

import contextlib
import json
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from jaxmpc.check import among, is_number
from jaxmpc.controller.checkpoint import save_controller
from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError, MissingToolError
from jaxmpc.files import check_target, write_atomically

PROGRAM = Path(__file__).with_name("controller_slave.py")


def build_controller_fmu(
    controller: Controller, path: str | Path, start: Mapping[str, float] | None = None
) -> Path:
    """Write a controller as an FMU.

    Its inputs are the CVs, their setpoints ``CV.setpoint``, the measured disturbances, and by MV the position of its
    actuator ``MV.position`` and whether somebody else moves it, ``MV.manual``; its outputs the demands of the MVs, and
    ``status``, ``status_text``, ``fallback``, ``objective`` and ``gap`` of the last step; its parameters ``MV.start``.

    Args:
        controller: as it steps; its options are part of the FMU.
        path: of the FMU; replaced in one go.
        start: default of the parameters by MV [MV unit], where not given 0 or the limit next to it; and of setpoints by CV
            [CV unit], where not given what is measured first.

    Returns:
        The path.

    Raises:
        InputError: for a controller of another kind, a path that is not that of an FMU, unknown names and starts that are
            not finite, and names that stand for two variables.
        MissingToolError: without PythonFMU.
    """
    if not isinstance(controller, Controller):
        raise InputError("controller", type(controller).__name__, "a Controller")
    path = check_fmu_target("path", path)
    starts = _checked_start(controller, dict(start or {}))
    try:
        from pythonfmu import FmuBuilder
    except ImportError:
        raise MissingToolError("The FMU of a controller needs PythonFMU: pip install 'jaxmpc[fmu]'") from None
    from identify.controller_slave import CONTROLLER, START

    with tempfile.TemporaryDirectory(prefix="jaxmpc-fmu-") as made, _as_it_was():
        folder = Path(made)
        files = save_controller(controller, folder / CONTROLLER), folder / START
        files[1].write_text(json.dumps(starts))
        built = FmuBuilder.build_FMU(PROGRAM, dest=folder / "controller.fmu", project_files=files)
        return write_atomically(path, Path(built).read_bytes())


def check_fmu_target(field: str, path: str | Path) -> Path:
    """The path of an FMU that can be written; errors of `check_target`."""
    if Path(path).suffix != ".fmu":
        raise InputError(field, str(path), "the path of a file that ends in .fmu")
    check_target(field, path)
    return Path(path)


def _checked_start(controller: Controller, given: dict[str, float]) -> dict[str, float]:
    """Start values of all MVs, and of the setpoints that have one."""
    structure, tuning = controller.structure, controller.tuning
    names = structure.cv_names + structure.mv_names
    for name, value in given.items():
        among("start", name, names)
        if not is_number(value):
            raise InputError(f"start.{name}", value, "a finite number [unit of the variable]")
    rest = np.clip(0.0, np.asarray(tuning.mv_low), np.asarray(tuning.mv_high)).tolist()
    return dict(zip(structure.mv_names, rest, strict=True)) | {k: float(v) for k, v in given.items()}


@contextlib.contextmanager
def _as_it_was() -> Iterator[None]:
    """PythonFMU imports the program under its bare name and leaves its folder among those that are searched."""
    searched = list(sys.path)
    try:
        yield
    finally:
        sys.path[:] = searched
        sys.modules.pop(PROGRAM.stem, None)
