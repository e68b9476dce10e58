"""``jaxmpc fmu controller``: a controller of a process as an FMU, for other simulators."""

from __future__ import annotations

import sys
from pathlib import Path

from jaxmpc.cli.options import EXIT_OPTIMAL, EXITS, Options, choice, command, option
from jaxmpc.errors import InputError


@command(
    "fmu controller",
    option("process", "PROCESS", "process file or shipped process", str),
    choice("--controller", ("mixed-integer", "continuous"), "whether stepped MVs move in whole steps"),
    option("--preset", "NAME", "tuning of the process (default: its first)", str),
    option("--out", "FILE.fmu", "where to write", Path("controller.fmu")),
    epilog=EXITS,
)
def controller(options: Options) -> int:
    """Write a tuned controller as a co-simulation FMU, which needs a Python with jaxmpc where it runs."""
    from identify.controller_fmu import build_controller_fmu, check_fmu_target

    check_fmu_target("--out", options.out)
    from identify.plants import model_of
    from identify.step_test import settling_notes
    from jaxmpc.check import located
    from jaxmpc.controller.controller import Controller
    from jaxmpc.process.file import load_process

    process = load_process(options.process)
    integer = options.controller == "mixed-integer"
    if integer and not process.stepped:
        expected = f"continuous: every MV of {process.name} takes all values"
        raise InputError("--controller", options.controller, expected)
    structure = process.structure(integer=integer)
    with located(lambda _: "--preset"):
        tuning = process.tuning(structure, options.preset)
    model = model_of(process)
    for note in settling_notes(model):
        print(f"jaxmpc: {note}", file=sys.stderr)
    start = dict(process.model.working_point)
    for name, actuator in zip(process.mv_names, process.actuators(), strict=True):
        if name in start:  # a step test may begin where the actuator cannot stand
            start[name] = float(actuator.move(float("inf"), start[name]))
    print(build_controller_fmu(Controller(structure, tuning, model), options.out, start))
    return EXIT_OPTIMAL
