"""The documentation: its Python runs, its links and anchors resolve, it knows every figure and study, the site builds.

A block whose title begins with "Needs a C compiler" runs where there is one; any other block that needs something is not
run. The blocks of a page run in order, in one namespace, in a folder of their own. A block with the name of a file as its
title is written there; "FILE, changed" replaces tables of it that begin alike; commands run where the title is "Runs".
"""

import argparse
import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import unicodedata
from pathlib import Path
from typing import NamedTuple

import pytest

import jaxmpc
from figures.registry import FIGURES
from jaxmpc.cli import main as cli
from studies.definition.sweep import StudyDefinition, shipped_studies
from studies.load import expand
from studies.thesis import catalogue

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
NOTEBOOK = ROOT / "studies" / "notebooks" / "tour.ipynb"
FENCE = re.compile(r"^```(\w+)[ \t]*([^\n]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
FILE = re.compile(r"([\w.-]+\.(?:toml|json|py|csv|cnfg|mdf))(, changed)?")
QUICK = {
    "reading-a-plan.md",
    "mathematics.md",
    "processes.md",
    "other-tools.md",
}  # the other pages with Python take more than 20 s
COMPILER = "Needs a C compiler"


def name_of(path: Path) -> str:
    """The path below the docs with forward slashes."""
    return path.relative_to(DOCS).as_posix()


def title(options: str) -> str:
    """What a block says that it needs."""
    found = re.search(r'title="([^"]*)"', options)
    return found[1] if found else ""


class Block(NamedTuple):
    """A block of code."""

    language: str
    title: str
    code: str
    line: int

    @property
    def runs(self) -> bool:
        """Whether it does something in the order of its page."""
        if self.language == "python":
            return not self.title.startswith("Needs") or self.title == COMPILER
        return bool(FILE.fullmatch(self.title)) or self.title == "Runs" or self.title == f"Runs. {COMPILER}"

    @property
    def compiles(self) -> bool:
        """Whether that takes a C compiler."""
        return self.title.endswith(COMPILER)


def blocks_of(path: Path) -> list[Block]:
    """The blocks of a page."""
    text = path.read_text()
    return [
        Block(found[1], title(found[2]), found[3], text.count("\n", 0, found.start()) + 1)
        for found in FENCE.finditer(text)
    ]


def running() -> list:
    """Pages with Python or commands that run, the long ones marked."""
    marks = lambda path: [] if path.name in QUICK else [pytest.mark.slow]  # noqa: E731
    return [
        pytest.param(path, marks=marks(path), id=name_of(path))
        for path in PAGES
        if any(block.runs and block.language in ("python", "sh") for block in blocks_of(path))
    ]


def changed(text: str, changes: str) -> str:
    """A file in which tables, parted by empty lines, are replaced by those that begin alike."""
    parts = text.strip().split("\n\n")
    for new in changes.strip().split("\n\n"):
        head = re.match(r"\[\[\w+\]\]\nname = .*|\[.*?\]", new)
        assert head, new
        (at,) = (k for k, part in enumerate(parts) if part.startswith(head[0]))
        parts[at] = new
    return "\n\n".join([*parts, ""])


def run(block: Block, page: Path, namespace: dict) -> None:
    """Write the file, run the commands or run the Python of a block."""
    if file := FILE.fullmatch(block.title):
        here = Path(file[1])
        here.write_text(changed(here.read_text(), block.code) if file[2] else block.code)
    elif block.language == "python":
        exec(compile("\n" * block.line + block.code, str(page), "exec"), namespace)
    else:
        for line in block.code.splitlines():
            words = shlex.split(line, comments=True)
            assert words[0] == "jaxmpc"
            assert cli.main(words[1:]) == 0, f"{page.name}: {line}"


@pytest.mark.parametrize("page", running())
def test_the_python_and_the_commands_of_a_page_run_as_typed(page, tmp_path, monkeypatch):
    blocks = [block for block in blocks_of(page) if block.runs]
    if any(block.compiles for block in blocks) and not (
        shutil.which("make") and any(map(shutil.which, ("cc", "gcc", "clang")))
    ):
        pytest.skip("no C compiler")
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "__main__"}
    for block in blocks:
        run(block, page, namespace)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_python_that_does_not_run_says_what_it_needs_and_is_python(page):
    for block in blocks_of(page):
        if block.language == "python":
            said = not block.title or re.fullmatch(r"Needs [a-zA-Z].+", block.title)
            assert said or FILE.fullmatch(block.title), f"{page.name}:{block.line}"
            compile(block.code, f"{page.name}:{block.line}", "exec")


def command(words: list[str]) -> tuple[argparse.ArgumentParser, list[str]]:
    """The command that words begin with, and what follows; a KeyError if there is none."""
    parser = cli.parser(cli.COMMANDS)
    while groups := [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]:
        parser, words = groups[0].choices[words[0]], words[1:]
    return parser, words


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_of_a_page_exist_with_their_options(page):
    for words in re.findall(
        r"\bjaxmpc ((?:plan|fmu|identify|model|process|study|simulate|figures|explore|bench)\b[^`\n]*)",
        page.read_text(),
    ):
        words = re.split(r"\s+#|\s{2,}|[;|&]", words)[0].replace("'", "")
        parser, _ = command(words.split())
        given = {w for w in words.split() if re.fullmatch(r"--[a-z-]+", w)}
        assert given <= {n for action in parser._actions for n in action.option_strings}, (
            f"{page.name}: {words}"
        )


def test_studies_that_are_named_in_commands_are_shipped():
    named = set(re.findall(r"[a-z][a-z-]*", command(["study", "run"])[0].epilog or ""))
    assert {*catalogue.STUDIES, *shipped_studies()} <= named, "the help names every study"
    for page in [*PAGES, ROOT / "README.md"]:
        for name in re.findall(r"jaxmpc study run ([a-z][a-z-]*)(?![\w.-])", page.read_text()):
            assert name in named, f"{page.name}: {name}"


def test_study_files_of_the_pages_are_accepted():
    count = 0
    for block in (block for page in PAGES for block in blocks_of(page)):
        if block.language == "toml" and "[study]" in block.code and not block.runs:
            expand(StudyDefinition.from_dict(tomllib.loads(block.code)))
            count += 1
    assert count >= 3


# ----------------------------------------------------------------------------------------------------- links


def anchor(heading: str) -> str:
    """The anchor of a heading, as the site makes it."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "")
    text = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", text).strip().lower())


def outside_fences(path: Path) -> str:
    """A page without its code."""
    return re.sub(
        r"`[^`\n]*`", "", re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.DOTALL | re.MULTILINE)
    )


def anchors(path: Path) -> set[str]:
    """Anchors of the headings of a page."""
    bare = re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.DOTALL | re.MULTILINE)
    return {anchor(heading) for heading in re.findall(r"^#+ (.*)$", bare, re.MULTILINE)}


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda path: path.name)
def test_links_and_anchors_resolve(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", outside_fences(page)):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, fragment = target.partition("#")
        there = (page.parent / file).resolve() if file else page
        assert there.is_file(), f"{page.name}: {target}"
        assert there.is_relative_to(ROOT if page.parent == ROOT else DOCS), (
            f"{page.name}: {target} is outside"
        )
        assert not fragment or fragment in anchors(there), f"{page.name}: {target}"


def test_every_page_is_in_the_navigation():
    lines = (DOCS / "site" / "mkdocs.yml").read_text()
    listed = set(re.findall(r"[\w/-]+\.md", lines[lines.index("nav:") : lines.index("plugins:")]))
    assert listed == {name_of(page) for page in PAGES}


# ------------------------------------------------------------------------------------------------- completeness


def test_the_page_of_figures_has_every_figure_with_its_study():
    rows = re.findall(
        r"^\| ([\w, -]+) \| .* \| (?:`([\w-]+)`|none) \|$", (DOCS / "figures.md").read_text(), re.MULTILINE
    )
    told = {id.strip(): study or None for ids, study in rows for id in ids.split(",")}
    assert told == {id: entry.study for id, entry in FIGURES.items()}


def test_the_page_of_figures_has_every_comparison():
    text = (DOCS / "figures.md").read_text()
    section = text[text.index("## The studies behind them") :]
    told = set(re.findall(r"^\| `([\w-]+)` \|", section, re.MULTILINE))
    assert told == set(catalogue.STUDIES)


def test_the_reference_has_every_public_name_of_the_package():
    shown = set(re.findall(r"^::: ([\w.]+)$", "\n".join(p.read_text() for p in PAGES), re.MULTILINE))
    for name, module in jaxmpc._HOME_OF.items():
        assert f"jaxmpc.{module}" in shown, name
        assert f"`{name}`" in (DOCS / "api" / "index.md").read_text(), name


def test_the_site_builds_without_warnings(tmp_path):
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    pytest.importorskip("material")
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "-f",
        "docs/site/mkdocs.yml",
        "-d",
        str(tmp_path),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    warnings = [line for line in done.stderr.splitlines() if "WARNING" in line or "ERROR" in line]
    assert done.returncode == 0, warnings
    for page in tmp_path.glob("*.html"):
        assert "<p>```" not in page.read_text(), f"a block of {page.name} is not read as code"
    mathematics = (tmp_path / "mathematics.html").read_text()
    assert mathematics.count("<math") > 50
    assert "arithmatex" not in mathematics, "a formula is shown as it is typed"
    for page in tmp_path.rglob("*.html"):
        fetched = re.findall(
            r'<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)="((?:https?:)?//[^"]*)"', page.read_text()
        )
        assert fetched == [], f"{page.name} needs a network"


# ---------------------------------------------------------------------------------------------------- notebook


def test_the_notebook_is_stored_without_outputs():
    notebook = json.loads(NOTEBOOK.read_text())
    assert notebook["nbformat"] == 4
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert len(code) >= 6
    for cell in code:
        assert cell["outputs"] == []
        assert cell["execution_count"] is None


def test_the_notebook_runs_from_top_to_bottom(tmp_path):
    pytest.importorskip("nbmake")
    notebook = shutil.copy(NOTEBOOK, tmp_path)
    command = [sys.executable, "-m", "pytest", "--nbmake", "--nbmake-timeout=900", "--overwrite", notebook]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:]
    cells = json.loads(Path(notebook).read_text())["cells"]
    pictures = [o for c in cells for o in c.get("outputs", ()) if "image/png" in o.get("data", {})]
    assert len(pictures) == 4
