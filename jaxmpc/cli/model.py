"""``jaxmpc model import`` and ``export``: step-response models from files of other tools, and for them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jaxmpc.cli.options import EXIT_OPTIMAL, EXITS, Options, command, option
from jaxmpc.files import check_target

FIRST_ENTRY = option(
    "--first-entry",
    "0|1",
    "sample that first values stand at (default: by the format, and said)",
    int,
    choices=(0, 1),
)
WHICH = option("--which", "A|B", "response of SEPTIC model files (default: A)", str, choices=("A", "B"))
TIME_UNIT = option(
    "--time-unit",
    "s|min|h",
    "of dead times and time constants in the files (default: s)",
    str,
    choices=("s", "min", "h"),
)


def asked_in(options: Options) -> Any:
    """What the options say of files that leave it open: an `identify.foreign.common.Asked`."""
    from identify.foreign.common import Asked

    given = {
        key: getattr(options, key, None) for key in ("dt", "samples", "first_entry", "which", "time_unit")
    }
    names = {f"{kind}s": tuple(getattr(options, kind, None) or ()) for kind in ("cv", "mv", "dv")}
    return Asked(**names, **{key: value for key, value in given.items() if value is not None})


@command(
    "model import",
    option(
        "files", "FILE", "file of another tool; a folder, or several files, of SEPTIC models", Path, nargs="+"
    ),
    option(
        "--from",
        "FORMAT",
        "septic, lightweight, neqsim, numpy or transfer-functions (default: recognised)",
        str,
    ),
    option("--out", "MODEL.json", "where to write", Path("model.json")),
    *(
        option(
            f"--{kind}",
            "NAME",
            f"a {kind.upper()} as the file names it, where it does not say",
            str,
            action="append",
        )
        for kind in ("cv", "mv", "dv")
    ),
    option("--dt", "S", "sampling interval of the model [s] (default: that of the file)", float),
    option("--samples", "N", "coefficients (default: as many as there are)", int),
    FIRST_ENTRY,
    WHICH,
    TIME_UNIT,
    epilog=f"What was assumed, changed or left out is printed and kept in the model. {EXITS}",
)
def import_(options: Options) -> int:
    """Make a step-response model from files of another tool, and say what was assumed."""
    check_target("--out", options.out, options.files)
    from identify.foreign.formats import import_model

    form, (model, notes) = import_model(options.files, getattr(options, "from") or "", asked_in(options))
    model.save(options.out)
    counts = f"{len(model.cv_names)} CVs, {len(model.mv_names)} MVs, {len(model.dv_names)} DVs"
    print(options.out)
    print(f"{form}: {counts}, {model.samples} coefficients every {model.dt:g} s", *notes, sep="\n  ")
    print(f"Next: jaxmpc process new --model {options.out}")
    return EXIT_OPTIMAL


@command(
    "model export",
    option("model", "MODEL.json", "step-response model", Path),
    option(
        "--to",
        "FORMAT",
        "septic (a folder), lightweight, neqsim (.json or .csv) or numpy",
        str,
        required=True,
    ),
    option("--out", "PATH", "file or folder to write", Path, required=True),
    FIRST_ENTRY,
    epilog=f"What the format cannot say is printed. {EXITS}",
)
def export(options: Options) -> int:
    """Write a step-response model for another tool, and say what is lost."""
    from identify.foreign.formats import export_model
    from jaxmpc.model.step_response import StepResponseModel

    model = StepResponseModel.load(options.model)
    files, notes = export_model(model, options.to, options.out, asked_in(options))
    print(*files, *(f"  {note}" for note in notes), sep="\n")
    return EXIT_OPTIMAL
