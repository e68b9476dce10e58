"""SEPTIC model files, ``.mdf`` and ``.pdf``: one pair per file, named ``CV_MV`` or ``CV_DV``; read strictly and written.

Public is the form, from the reader in github.com/equinor/vscode-septic (MIT). Whether first values are S(0) or S(1), and
what tells response A from B, is not documented: both are answered in `Asked`, and what was assumed is said.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from identify.foreign.common import (
    Asked,
    Curve,
    Imported,
    Pairs,
    assemble,
    chosen,
    first_entry_of,
    number,
    read_text,
    shifted,
    single_words,
)
from jaxmpc.check import require
from jaxmpc.errors import InputError, near
from jaxmpc.files import write_atomically
from jaxmpc.model.step_response import StepResponseModel

SUFFIXES = (".mdf", ".pdf")
KEY = re.compile(r"\s*([A-Za-z]\w*)\s*=\s*(.*)")
TEXTS = ("Text1", "Text2", "Atext", "Btext")
PER_LINE = 5


@dataclasses.dataclass(frozen=True)
class ModelFile:
    """The content of a file: texts by key, sampling interval [s] (0 if not given), responses A and B."""

    path: Path
    texts: dict[str, str]
    nsecs: float
    responses: dict[str, Float[np.ndarray, " n"]]
    unknown: tuple[str, ...]


def read_file(path: Path) -> ModelFile:
    """A model file.

    Raises:
        InputError: with file and line, for what is no key, a count that is wrong, and what is no number.
    """
    texts: dict[str, str] = {}
    responses: dict[str, np.ndarray] = {}
    unknown: list[str] = []
    nsecs, seen, lines = 0.0, dict[str, int](), read_text(path).splitlines()
    at = 0
    while at < len(lines):
        line, where = _bare(lines[at]), f"{path}:{at + 1}"
        at += 1
        if not line.strip():
            continue
        match = KEY.fullmatch(line)
        if not match:
            raise InputError(
                where, line.strip(), "'Key= value', or the numbers that Amodl= or Bmodl= announced"
            )
        key, value = match[1], match[2].strip()
        if key in seen:
            raise InputError(where, key, f"each key once (it stands in line {seen[key]})")
        seen[key] = at
        if key in TEXTS:
            texts[key] = value.strip('"')
        elif key == "Nsecs":
            nsecs = number(value, where, "the sampling interval [s]")
            if nsecs <= 0:
                raise InputError(where, nsecs, "a positive sampling interval [s]")
        elif key in ("Amodl", "Bmodl"):
            responses[key[0]], at = _numbers(path, lines, at, key, value)
        else:
            unknown.append(f"{key}= {value} ({where})")
    if not responses:
        raise InputError(str(path), "neither Amodl= nor Bmodl=", "a SEPTIC model file")
    return ModelFile(path, texts, nsecs, responses, tuple(unknown))


def _bare(line: str) -> str:
    """A line without its comment."""
    outside = re.match(r'(?:[^"/]|"[^"]*"|"[^"]*$|/(?!/))*', line)
    return outside[0] if outside else line


def _numbers(path: Path, lines: list[str], at: int, key: str, told: str) -> tuple[np.ndarray, int]:
    """As many numbers as were announced, from the rest of a line and those after it; and the line that follows them."""
    where, first = f"{path}:{at}", told.split()
    if not first or not first[0].isdecimal():
        raise InputError(where, f"{key}= {told}", "how many numbers follow")
    count, found = int(first[0]), [number(text, where, f"a value of {key}") for text in first[1:]]
    while at < len(lines) and not KEY.fullmatch(_bare(lines[at])):
        found += [number(text, f"{path}:{at + 1}", f"a value of {key}") for text in _bare(lines[at]).split()]
        at += 1
    if len(found) != count:
        raise InputError(where, f"{key}= {count} and then {len(found)} numbers", f"{count} numbers")
    return np.array(found), at


def read_models(
    files: Sequence[Path], asked: Asked, cvs: Sequence[str] = (), inputs: Sequence[str] = ()
) -> Pairs:
    """The responses of model files.

    Args:
        cvs: names that are known, from a configuration; those that were asked for if not given.
        inputs: of MVs and DVs, likewise.

    Raises:
        InputError: for a file that is wrong, a name that cannot be taken apart, and a response that is not there.
    """
    told_cvs, told_inputs = tuple(cvs) or asked.cvs, tuple(inputs) or (*asked.mvs, *asked.dvs)
    given: dict[tuple[str, str], tuple[ModelFile, np.ndarray]] = {}
    notes: list[str] = []
    texts = {}
    for path in files:
        file = read_file(path)
        pair = pair_of(path, told_cvs, told_inputs)
        if pair in given:
            raise InputError(
                str(path), f"{pair[1]} on {pair[0]}", f"each pair once ({given[pair][0].path} has it)"
            )
        if asked.which not in file.responses or not len(file.responses[asked.which]):
            have = ", ".join(key for key, values in file.responses.items() if len(values)) or "none"
            raise InputError(str(path), f"no response {asked.which}", f"one of {have}", "Give --which")
        given[pair] = file, file.responses[asked.which]
        notes += [f"unknown: {entry}" for entry in file.unknown]
        texts |= {f"{pair[0]}_{pair[1]}": "; ".join(filter(None, file.texts.values()))}
    both = [str(f.path) for f, _ in given.values() if _differ(f.responses)]
    notes.append(
        f"response {asked.which} is taken" + ("; the other is the same, or none" if not both else "")
    )
    if both:
        other = "B" if asked.which == "A" else "A"
        notes.append(
            f"A and B differ in {', '.join(both)}; what tells them apart is not documented; --which {other}"
        )
    first, said = first_entry_of(asked, 0, {str(f.path): v for f, v in given.values()})
    pairs = Pairs(
        list(dict.fromkeys([*told_cvs, *(cv for cv, _ in given)])),
        [name for name in dict.fromkeys([*told_inputs, *(of for _, of in given)]) if name not in asked.dvs],
        list(asked.dvs),
        notes=[*notes, said],
        provenance={"texts": {key: text for key, text in texts.items() if text}},
    )
    for (cv, of), (file, values) in given.items():
        nsecs = file.nsecs or asked.dt
        if not nsecs:
            raise InputError(str(file.path), "no Nsecs=", "a sampling interval [s]", "Give --dt")
        kept, lost = shifted(values, first, str(file.path))
        pairs.notes += [lost] if lost else []
        pairs.add(str(file.path), cv, of, Curve(nsecs, kept))
    return pairs


def read(files: Sequence[Path], asked: Asked) -> Imported:
    """The model of model files alone, without a configuration."""
    pairs = read_models(files, asked)
    for option, names, known in (
        ("--cv", asked.cvs, {cv for cv, _ in pairs.curves}),
        ("--mv", asked.mvs, {of for _, of in pairs.curves}),
        ("--dv", asked.dvs, {of for _, of in pairs.curves}),
    ):
        chosen(option, names, known)
    return assemble(pairs, asked, "SEPTIC model files")


def _differ(responses: dict[str, np.ndarray]) -> bool:
    a, b = (responses.get(key, np.zeros(0)) for key in "AB")
    return bool(len(a) and len(b)) and not (len(a) == len(b) and (a == b).all())


def pair_of(path: Path, cvs: Sequence[str], inputs: Sequence[str]) -> tuple[str, str]:
    """CV and input that a file's name joins, by names that are known or by its only underscore."""
    fold = lambda names: {name.casefold(): name for name in names}  # noqa: E731
    known_cvs, known_inputs, stem = fold(cvs), fold(inputs), path.stem
    found = []
    for at in (k for k, c in enumerate(stem) if c == "_" and 0 < k < len(stem) - 1):
        cv, of = stem[:at], stem[at + 1 :]
        if (not cvs or cv.casefold() in known_cvs) and (not inputs or of.casefold() in known_inputs):
            found.append((known_cvs.get(cv.casefold(), cv), known_inputs.get(of.casefold(), of)))
    if len(found) == 1:
        return found[0]
    expected = "CV_MV or CV_DV" + (f" of the CVs {', '.join(cvs)}" if cvs else "")
    expected += f" and the inputs {', '.join(inputs)}" if inputs else ""
    close = near(stem, [f"{cv}_{of}" for cv in cvs for of in inputs])
    hint = close or ("Name every CV, MV and DV: --cv, --mv, --dv" if not (cvs and inputs) else "")
    raise InputError(str(path), stem, expected, hint)


def models_in(folder: Path) -> list[Path]:
    """Model files of a folder; a document that is called ``.pdf`` is none."""
    found = (path for path in sorted(folder.glob("*")) if path.suffix.lower() in SUFFIXES and path.is_file())
    return [path for path in found if not path.read_bytes().startswith(b"%PDF-")]


def refuse_occupied(folder: Path) -> None:
    """Refuse a folder that has an application in it: its files may be the only ones of a plant."""
    there = [path.name for path in (*folder.glob("*.cnfg"), *models_in(folder))]
    require(
        not there,
        "--out",
        str(folder),
        f"a folder without files of an application; {there[:1]} is not overwritten",
    )


def write(model: StepResponseModel, folder: Path, asked: Asked) -> tuple[list[Path], list[str]]:
    """A file per pair that responds, response A.

    Args:
        asked: `first_entry` says what the first values are, S(0) = 0 if not given.

    Returns:
        The files and what was assumed or left out.
    """
    refuse_occupied(folder)
    names, units, responses = single_words(model), model.units, model.responses
    first = 0 if asked.first_entry is None else asked.first_entry
    out, silent = [], []
    for i, cv in enumerate(model.cv_names):
        for j, of in enumerate(model.input_names):
            values = responses[i, j]
            if not values.any():
                silent.append(f"{of} on {cv}")
                continue
            stem = f"{names[cv]}_{names[of]}"
            lines = [
                f"// File= {stem}.mdf",
                f'Text1= "{cv} [{units[cv]}] to {of} [{units[of]}]"',
                'Text2= ""',
            ]
            lines += ['Atext= "step response"', 'Btext= ""', f"Nsecs= {model.dt:g}"]
            listed = [repr(float(v)) for v in ([0.0, *values] if first == 0 else values)]
            lines += [f"Amodl= {len(listed)}"]
            lines += ["  ".join(listed[k : k + PER_LINE]) for k in range(0, len(listed), PER_LINE)]
            out.append(write_atomically(folder / f"{stem}.mdf", "\n".join([*lines, "Bmodl= 0", ""])))
    notes = [
        f"first values are S({first}); whether SEPTIC reads them so is not documented (--first-entry {1 - first})"
    ]
    notes.append("response A holds the model, B is empty; what tells them apart is not documented")
    if silent:
        notes.append(f"no file for pairs that do not respond: {', '.join(silent)}")
    return out, notes
