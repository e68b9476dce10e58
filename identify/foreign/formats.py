"""The formats of foreign model files: how each is recognised, read and written. Adding one is one file and one entry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from identify.foreign import arrays, lightweight, mdf, neqsim, septic, tables
from identify.foreign.common import Asked, Imported, read_text
from jaxmpc.check import among, require
from jaxmpc.errors import InputError
from jaxmpc.files import check_folder, check_target, read_json
from jaxmpc.model.step_response import StepResponseModel


class Format(NamedTuple):
    """A format.

    Attributes:
        suffixes: of its files; a file that is written has one of `targets`, or they stand in a folder.
    """

    title: str
    read: Callable[[Sequence[Path], Asked], Imported]
    write: Callable[[StepResponseModel, Path, Asked], tuple[list[Path], list[str]]] | None
    suffixes: tuple[str, ...]
    targets: tuple[str, ...] = ()

    @property
    def folder(self) -> bool:
        """Whether it is a folder of files."""
        return not self.targets and self.write is not None


FORMATS = {
    "septic": Format("SEPTIC model files", septic.read_models, mdf.write, (*mdf.SUFFIXES, ".cnfg")),
    "lightweight": Format("Light-weight-MPC", lightweight.read, lightweight.write, (".json",), (".json",)),
    "neqsim": Format("NeqSim", neqsim.read, neqsim.write, (".json", ".csv"), (".json", ".csv")),
    "numpy": Format("NumPy", arrays.read, arrays.write, (".npz", ".npy"), (".npz",)),
    "transfer-functions": Format("transfer functions", tables.read, None, (".csv", ".toml")),
}
WRITTEN = tuple(name for name, form in FORMATS.items() if form.write)


def import_model(given: Sequence[Path], form: str = "", asked: Asked | None = None) -> tuple[str, Imported]:
    """A model from files of another tool.

    Args:
        given: one file, or the files and folders of SEPTIC models.
        form: format; recognised by name and content if not given.

    Returns:
        The format, and the model with what was assumed.

    Raises:
        InputError: for files that are none of a known format, and what is wrong in them.
    """
    asked = asked or Asked()
    asked.check()
    require(given, "FILE", [], "a file or a folder")
    for path in given:
        require(path.exists(), "FILE", str(path), "a file or a folder that is there")
    form = form or recognised(given)
    among("--from", form, FORMATS)
    single = not FORMATS[form].folder
    if single and (len(given) != 1 or given[0].is_dir()):
        raise InputError("FILE", [str(path) for path in given], f"one file of the format {form}")
    return form, FORMATS[form].read(given, asked)


def recognised(given: Sequence[Path]) -> str:
    """The format of files, by their names and content."""
    path = given[0]
    suffix = path.suffix.lower()
    if path.is_dir() or suffix in FORMATS["septic"].suffixes:
        return "septic"
    if suffix in FORMATS["numpy"].suffixes:
        return "numpy"
    if suffix == ".toml":
        return "transfer-functions"
    if suffix == ".json":
        body = read_json("file", path)
        found = [
            name for name, own in (("lightweight", lightweight), ("neqsim", neqsim)) if own.recognises(body)
        ]
        hint = (
            "A model file of jaxmpc needs no import"
            if isinstance(body, dict) and "coefficients" in body
            else ""
        )
        require(
            found, "FILE", str(path), "a system of Light-weight-MPC or an export of NeqSim with a model", hint
        )
        return found[0]
    if suffix in (".csv", ".txt", ".tsv"):
        text = read_text(path)
        if neqsim.recognises_table(text):
            return "neqsim"
        good = tables.recognises(text)
        require(
            good,
            f"{path}:1",
            text.lstrip().split("\n", 1)[0].strip(),
            "columns cv, mv, gain, ...; or Time and CV/MV",
        )
        return "transfer-functions"
    raise InputError("FILE", str(path), f"a file of a known format: {', '.join(FORMATS)}", "Give --from")


def export_model(
    model: StepResponseModel, form: str, out: Path, asked: Asked | None = None
) -> tuple[list[Path], list[str]]:
    """Write a model in a format of another tool; returns the files, and what they cannot say.

    Raises:
        InputError: for a format that is not written, and a target that cannot be.
    """
    among("--to", form, WRITTEN)
    known = FORMATS[form]
    assert known.write is not None  # of what `WRITTEN` names
    if known.folder:
        require(not out.is_file(), "--out", str(out), "a folder")
        check_folder("--out", out)
    else:
        require(
            out.suffix.lower() in known.targets,
            "--out",
            str(out),
            f"a name that ends in {' or '.join(known.targets)}",
        )
        check_target("--out", out)
    return known.write(model, out, asked or Asked())
