"""``jaxmpc fmu build``, ``fmu info`` and ``identify``: the well as an FMU, what FMUs are, and a model from step tests."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

from jaxmpc.cli.options import EXIT_OPTIMAL, EXITS, PLANTS, Options, choice, command, option
from jaxmpc.errors import InputError
from jaxmpc.files import check_target


@command(
    "fmu build",
    choice("--fmi", (2, 3), "major version of FMI"),
    option("--out", "FILE.fmu", "where to write (default: the cache of built FMUs)", Path),
)
def build(options: Options) -> int:
    """Build the gas-lifted well as a co-simulation FMU; needs a C compiler."""
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
    choice("--plant", PLANTS, "the FMU or the JAX well"),
    option("--choke", "PERCENT", "choke to start from [%%]", 50.0),
    option("--lift", "RATE", "lift to start from [m3/h]", 7500.0),
    option("--steps", ("CHOKE", "LIFT"), "steps of choke [%%] and lift [m3/h]", (2.0, 100.0), nargs=2),
    option("--samples", "N", "coefficients N [samples of 10 s]", 250),
    option("--out", "MODEL.json", "where to write", Path("model.json")),
)
def identify(options: Options) -> int:
    """Identify a step-response model: settle the plant and step each MV alone."""
    check_target("--out", options.out)
    from identify.step_test import identify_step_response, settling_notes

    with contextlib.ExitStack() as stack:
        plant = None  # the JAX well
        if options.plant == "fmu":
            from identify.well_fmu import WellFmuPlant

            plant = stack.enter_context(WellFmuPlant())
        start = options.choke, options.lift
        model = identify_step_response(plant, *start, tuple(options.steps), options.samples)
    for note in settling_notes(model):
        print(f"jaxmpc: {note}", file=sys.stderr)
    print(model.save(options.out))
    return EXIT_OPTIMAL
