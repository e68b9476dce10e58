"""``jaxmpc fmu build``, ``fmu info`` and ``identify``: the well as an FMU, what FMUs are, and a model of anything."""

from __future__ import annotations

import sys
from pathlib import Path

from jaxmpc.cli.identify_data import DATA_OPTIONS, identify_data
from jaxmpc.cli.identify_fmu import FMU_OPTIONS, identify_fmu
from jaxmpc.cli.options import EXIT_OPTIMAL, EXITS, Options, choice, command, named_number, option
from jaxmpc.errors import InputError
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


PROCESS_OPTIONS = (
    option("--plant", "NAME", "process: which of its plants (default: the first)", str),
    option("--step", "MV=SIZE", "process: step of an MV, if not as it says", str, action="append"),
)
STEPPED_OPTIONS = (
    option(
        "--at",
        "MV=VALUE",
        "process: where an MV stands before the steps, if not as it says; "
        "FMU: MV=V1,V2,..., a gain schedule over one or two MVs",
        str,
        action="append",
    ),
)
FOREIGN_OPTIONS = (
    option(
        "--mv",
        "NAME",
        "FMU: NAME[=VALUE[:STEP]], where it stands and its step; data: a column",
        str,
        action="append",
    ),
    option("--cv", "NAME", "FMU: a variable; data: a column", str, action="append"),
    option("--dv", "NAME", "measured disturbance, as --mv", str, action="append"),
    option("--dt", "S", "FMU, data: sampling interval [s]", float),
)
KINDS = {  # of sources: what they are called, and their own options
    "process": ("a process", (*PROCESS_OPTIONS, *STEPPED_OPTIONS)),
    "fmu": ("an FMU", (*FOREIGN_OPTIONS, *STEPPED_OPTIONS, *FMU_OPTIONS)),
    "data": ("logged data", (*FOREIGN_OPTIONS, *DATA_OPTIONS)),
}


@command(
    "identify",
    option(
        "source",
        "SOURCE",
        "process file or shipped process (default: the well of the thesis), FILE.fmu, or logged data (.csv, .parquet)",
        str,
        nargs="?",
    ),
    *FOREIGN_OPTIONS,
    *STEPPED_OPTIONS,
    *PROCESS_OPTIONS,
    *FMU_OPTIONS,
    *DATA_OPTIONS,
    option("--samples", "N", "coefficients [samples] (default: as the process says; 250)", int),
    option(
        "--out",
        "MODEL.json",
        "where to write; the page of an FMU or of data goes beside it",
        Path("model.json"),
    ),
    epilog="Exit status: 0 model written, 2 bad input, 1 the plant failed or anything else, 130 stopped by Ctrl-C.",
)
def identify(options: Options) -> int:
    """Identify a step-response model: step a plant or an FMU, each input alone, or fit logged data."""
    suffix = Path(options.source or "").suffix.lower()
    kind = {".fmu": "fmu", ".csv": "data", ".parquet": "data"}.get(suffix, "process")
    called, own = KINDS[kind]
    for name in dict.fromkeys(name for _, listed in KINDS.values() for name, _ in listed):
        given = getattr(options, name.removeprefix("--").replace("-", "_"))
        if name not in dict(own) and given not in (None, False):
            raise InputError(name, given, f"none: it is not for {called}")
    return {"fmu": identify_fmu, "data": identify_data, "process": _identify_process}[kind](options)


def _identify_process(options: Options) -> int:
    """Settle a plant of a process and step each MV, and each measured disturbance, alone."""
    check_target("--out", options.out)
    from identify.plants import identified, open_plant
    from identify.step_test import settling_notes
    from jaxmpc.check import among
    from jaxmpc.process.file import DEFAULT_PROCESS, load_process
    from jaxmpc.process.plant import closing

    process = load_process(options.source or DEFAULT_PROCESS)
    point, steps = (
        dict(named_number(name, text) for text in given or ())
        for name, given in (("--at", options.at), ("--step", options.step))
    )
    for name, given in (("--at", point), ("--step", steps)):
        for mv in given:
            among(name, mv, process.mv_names, "an MV:")
    with closing(open_plant(process, options.plant or "", actual=False)) as plant:
        model = identified(process, plant, point, steps, options.samples)
    for note in settling_notes(model):
        print(f"jaxmpc: {note}", file=sys.stderr)
    print(model.save(options.out))
    return EXIT_OPTIMAL
