"""``jaxmpc fmu build``, ``fmu info`` and ``identify``: the well as an FMU, what FMUs are, and a model from step tests."""

from __future__ import annotations

import sys
from pathlib import Path

from jaxmpc.cli.options import EXIT_OPTIMAL, EXITS, Options, choice, command, named_number, option
from jaxmpc.errors import InputError, near
from jaxmpc.files import check_target


@command(
    "fmu build",
    choice("--fmi", (2, 3), "major version of FMI"),
    option("--out", "FILE.fmu", "where to write (default: the cache of built FMUs)", Path),
)
def build(options: Options) -> int:
    """Build the shipped well as a co-simulation FMU; needs a C compiler."""
    from identify.well_fmu import build_fmu

    if options.out is not None:
        check_target("--out", options.out)
    print(build_fmu(fmi=options.fmi, out=options.out))
    return EXIT_OPTIMAL


@command("fmu info", option("fmu", "FMU", "an FMU of FMI 2.0 or 3.0", Path), epilog=EXITS)
def info(options: Options) -> int:
    """List the variables of an FMU, its default experiment and its machines, from its description; nothing of it runs."""
    from identify.fmu_process import FmuProcess

    try:
        with FmuProcess(options.fmu) as fmu:
            print(fmu.description.table())
    except InputError as error:
        raise InputError("FMU", error.value, error.expected, error.hint) from None
    return EXIT_OPTIMAL


@command(
    "identify",
    option(
        "process",
        "PROCESS",
        "process file or shipped process (default: the well of the thesis)",
        str,
        nargs="?",
    ),
    option("--plant", "NAME", "which plant of the process (default: the first)", ""),
    option(
        "--at",
        "MV=VALUE",
        "where an MV stands before the steps, if not as the process says",
        str,
        action="append",
    ),
    option("--step", "MV=SIZE", "step of an MV, if not as the process says", str, action="append"),
    option("--samples", "N", "coefficients [samples] (default: as the process says)", int),
    option("--out", "MODEL.json", "where to write", Path("model.json")),
)
def identify(options: Options) -> int:
    """Identify a step-response model: settle a plant and step each MV, and each measured disturbance, alone."""
    check_target("--out", options.out)
    from identify.plants import closing, identified, open_plant
    from identify.step_test import settling_notes
    from jaxmpc.process.file import DEFAULT_PROCESS, load_process

    process = load_process(options.process or DEFAULT_PROCESS)
    point, steps = (
        dict(named_number(name, text) for text in given or ())
        for name, given in (("--at", options.at), ("--step", options.step))
    )
    for name, given in (("--at", point), ("--step", steps)):
        for mv in given:
            if mv not in process.mv_names:
                raise InputError(
                    name, mv, f"an MV: {', '.join(process.mv_names)}", near(mv, process.mv_names)
                )
    with closing(open_plant(process, options.plant, actual=False)) as plant:
        model = identified(process, plant, point, steps, options.samples)
    for note in settling_notes(model):
        print(f"jaxmpc: {note}", file=sys.stderr)
    print(model.save(options.out))
    return EXIT_OPTIMAL
