"""The folders of `studies` import one way, function-level imports included, and no two files import each other."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

STUDIES = Path(__file__).parents[2] / "studies"
ORDER = ("store", "definition", "kpi", "run", "search", "", "thesis")  # "" is the top folder itself
PLACES = {
    path.relative_to(STUDIES.parent).with_suffix("").as_posix().replace("/", "."): path
    for path in STUDIES.rglob("*.py")
}


def imported(path):
    """Files of `studies` that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        yield from (name for name in names if name in PLACES)


def test_the_files_of_studies_import_in_no_circle():
    graph = {name: set(imported(path)) - {name} for name, path in PLACES.items()}
    assert list(TopologicalSorter(graph).static_order())


def test_a_folder_imports_only_folders_below_it():
    folder = lambda name: name.split(".")[1] if name.count(".") > 1 else ""  # noqa: E731
    for name, path in PLACES.items():
        for other in imported(path) if folder(name) in ORDER else ():
            assert ORDER.index(folder(other)) <= ORDER.index(folder(name)), f"{name} imports {other}"
