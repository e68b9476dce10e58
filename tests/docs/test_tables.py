"""Tables of the documentation that follow from declarations; ``python -m tests.docs.test_tables`` writes them anew."""

import dataclasses
import re
from pathlib import Path

import msgspec
import pytest

from identify.foreign.septic_meaning import MEANINGS
from jaxmpc.problem.declared import declared
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from jaxmpc.process import file, variables
from jaxmpc.process.responses import TransferFunctionSection
from studies.definition.fields import study_fields
from studies.thesis.well import WELL

DOCS = Path(__file__).resolve().parents[2] / "docs"
TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)


def shown(value) -> str:
    """A default as the pages write it."""
    if value is None:
        return "required"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple):
        return " ".join(map(str, value)) or "none"
    return f"`{value}`" if isinstance(value, str) else f"{value:g}"


def table(head, rows) -> str:
    """Markdown."""
    lines = [" | ".join(["", *row, ""]).strip() for row in [head, *rows]]
    lines.insert(1, "---".join("|" * (len(head) + 1)))
    return re.sub(r"\|  (?=\|)", "| ", "\n".join(lines)) + "\n"


def fields_of(kind) -> str:
    """Every field of a class."""
    head = ["field", "one per", "unit", "default", "meaning", "thesis"]
    rows = [
        [f"`{key}`", field.of.upper(), field.unit, shown(field.default), field.text, field.equation]
        for key, field in declared(kind).items()
    ]
    return table(head, rows)


def keys_of_studies() -> str:
    """Every key below ``[base.tuning]``, with the default of the thesis preset."""
    structure = WELL.structure(integer=True)
    tuning, rows = WELL.tuning(structure), []
    for key, field in study_fields(WELL, ()).items():
        _, name, *of = key.split(".") if key.startswith("tuning.") else ("", "")
        if name:
            names = structure.cv_names + structure.mv_names
            value = getattr(tuning, name)
            value = value[names.index(of[0]) % 2] if of else value
            default = field.default if field.kind == "flag" else float(value)
            rows.append([f"`{key}`", field.unit, shown(default), field.label])
    return table(["key", "unit", "default", "meaning"], rows)


def meanings(*kinds) -> str:
    """What becomes of the attributes of SEPTIC objects, those alike in one row."""
    rows: dict[tuple[str, ...], list[str]] = {}
    for kind in kinds:
        for name, meaning in MEANINGS[kind].items():
            level = {"none": "no equal"}.get(meaning.level, meaning.level)
            key = level, meaning.says, ", ".join(value or '""' for value in meaning.neutral if value != '""')
            rows.setdefault(key, []).append(f"`{name}`")
    head = ["attribute", "is", "here", "asks for nothing at"]
    return table(head, [[", ".join(dict.fromkeys(names)), *key] for key, names in rows.items()])


TABLES = {
    ("other-tools.md", "### System and application"): lambda: meanings("System", "Appl"),
    ("other-tools.md", "### Manipulated variables"): lambda: meanings("Mvr"),
    ("other-tools.md", "### Controlled variables"): lambda: meanings("Cvr"),
    ("other-tools.md", "### Measured disturbances"): lambda: meanings("Dvr"),
    ("api/models.md", "## Fields of a structure"): lambda: fields_of(Structure),
    ("api/models.md", "## Fields of a tuning"): lambda: fields_of(Tuning),
    ("studies.md", "### `[base.tuning]`: changes of the preset"): keys_of_studies,
}


SECTIONS = {  # tables of a process file by their headings in processes.md
    "### At the top": file.ProcessFile,
    "### `[[cv]]`: controlled variables": variables.Cv,
    "### `[[mv]]`: manipulated variables": variables.Mv,
    "### `actuator`: what becomes of a demand": variables.ActuatorSection,
    "### `[[disturbance]]`: what else moves the CVs": variables.Variable,
    "### `[model]`: what the controller predicts with": variables.ModelSource,
    "### `transfer_functions`: entries of the list": TransferFunctionSection,
    "### `[plants.NAME]`: what is controlled": variables.PlantSource,
    "### `[references.NAME]` and `[disturbances.NAME]`: over time": file.WindowsSection,
    "### `[[key_figure]]`: integrals of your own": variables.KeyFigure,
}


def parts(page: str, heading: str) -> tuple[str, str, str]:
    """A page before, in and after the first table below a heading."""
    text = (DOCS / page).read_text()
    start = text.index(f"\n{heading}\n") + len(heading) + 2
    found = TABLE.search(text, start)
    assert found, f"{page}: no table below {heading}"
    return text[: found.start()], found[0], text[found.end() :]


@pytest.mark.parametrize(("page", "heading"), TABLES)
def test_a_table_of_fields_says_what_their_declarations_say(page, heading):
    assert parts(page, heading)[1] == TABLES[page, heading]()


@pytest.mark.parametrize(("heading", "section"), SECTIONS.items())
def test_the_page_of_processes_has_every_key_with_its_default(heading, section):
    rows = [line.split("|")[1:5] for line in parts("processes.md", heading)[1].splitlines()[2:]]
    told = {key.strip(" `"): default.strip(" `") for key, _, default, _ in rows}
    fields = msgspec.structs.fields(section)
    assert set(told) == {field.encode_name for field in fields}
    for field in fields:
        assert (told[field.encode_name] == "required") == field.required, field.name
        if isinstance(field.default, (int, float)) and field.name != "settled":  # which 0 leaves to the span
            assert told[field.encode_name] == f"{field.default:g}"


@pytest.mark.parametrize("kind", [Structure, Tuning])
def test_every_field_is_declared_with_its_meaning_and_numbers_with_their_unit(kind):
    for field in dataclasses.fields(kind):
        known = declared(kind)[field.name]
        assert known.meaning
        assert known.unit or known.flag or known.choices or field.name.endswith(("names", "units"))


if __name__ == "__main__":
    for (page, heading), made in TABLES.items():
        before, _, after = parts(page, heading)
        (DOCS / page).write_text(before + made() + after)
