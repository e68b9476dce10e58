"""The import rules of the packages, read from the source: who may use whom, one door per foreign library."""

import ast
import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("jaxmpc", "identify", "studies", "figures")
MAY_IMPORT = {
    "jaxmpc": {"jaxmpc"},
    "identify": {"identify", "jaxmpc"},
    "studies": {"studies", "identify", "jaxmpc"},
    "figures": {"figures", "studies", "jaxmpc"},
}
COMPOSITION_ROOT = "jaxmpc/cli/"
APPS = "studies/notebooks/"  # what a user opens and edits: puts studies and figures together
DOORS = {
    "highspy": ("jaxmpc/integer/highs.py",),
    "fmpy": ("identify/fmu.py", "identify/fmu_worker.py"),
    "matplotlib": ("figures/",),
    "dask": ("studies/",),
    "distributed": ("studies/",),
    "xarray": ("studies/", "figures/"),
    "zarr": ("studies/",),
    "optuna": ("studies/search/run.py",),
    "scipy": ("studies/bench/", "studies/definition/axes.py"),
    **dict.fromkeys(
        ("piqp", "clarabel", "osqp", "daqp", "qpax", "pyscipopt", "gurobipy"), ("studies/bench/peers.py",)
    ),
}
TEST_ONLY = {
    "hypothesis",
    "pytest",
    "tests",
}
SOLVES = {  # figures read results: nothing that predicts, solves or simulates
    "jaxmpc.model",
    "jaxmpc.problem.condense",
    "jaxmpc.relaxed",
    "jaxmpc.integer",
    "jaxmpc.controller.plan",
    "jaxmpc.controller.continuous",
    "jaxmpc.controller.mixed_integer",
    "jaxmpc.process.plant",
    "jaxmpc.loop.simulate",
    "jaxmpc.steady.optimise",
}


def sources() -> list[Path]:
    """Every Python file of the four packages."""
    return [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def imports(path: Path) -> list[tuple[str, bool]]:
    """Absolute dotted names that a file imports, and whether that happens on import of the file itself."""
    found = []

    def visit(node, top):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                found.extend((alias.name, top) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                package = ".".join(path.relative_to(ROOT).with_suffix("").parts[: -child.level or None])
                base = child.module or ""
                if child.level:
                    base = importlib.util.resolve_name("." * child.level + base, package + ".x")
                found.extend((f"{base}.{alias.name}", top) for alias in child.names)
            elif isinstance(child, ast.Call) and getattr(child.func, "attr", "") == "import_module":
                if child.args and isinstance(child.args[0], ast.Constant):
                    found.append((str(child.args[0].value), top))
                visit(child, top)
            else:
                inside = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
                visit(child, top and not inside)

    visit(ast.parse(path.read_text()), True)
    return found


def name_of(path: Path) -> str:
    """The path from the root with forward slashes."""
    return path.relative_to(ROOT).as_posix()


def test_the_reader_of_imports_sees_every_kind(tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    path = tmp_path / "jaxmpc" / "deep" / "module.py"
    path.parent.mkdir(parents=True)
    path.write_text(
        "import studies.store as s\nfrom identify import fmu\nfrom ..qp import solve\n"
        "class A:\n    import highspy\n"
        "def f():\n    import fmpy\n    import importlib\n    importlib.import_module('matplotlib.pyplot')\n"
    )
    assert imports(path) == [
        ("studies.store", True),
        ("identify.fmu", True),
        ("jaxmpc.qp.solve", True),
        ("highspy", True),
        ("fmpy", False),
        ("importlib", False),
        ("matplotlib.pyplot", False),
    ]


@pytest.mark.parametrize("path", sources(), ids=name_of)
def test_a_file_imports_only_what_its_package_may(path):
    package = path.relative_to(ROOT).parts[0]
    for name, on_import in imports(path):
        top = name.split(".")[0]
        if top not in PACKAGES or top in MAY_IMPORT[package] or name_of(path).startswith(APPS):
            continue
        assert name_of(path).startswith(COMPOSITION_ROOT), f"{name_of(path)} imports {name}"
        assert not on_import, f"{name_of(path)} imports {name} before a command asks for it"


@pytest.mark.parametrize("path", sources(), ids=name_of)
def test_a_foreign_library_has_one_door(path):
    for name, _ in imports(path):
        top = name.split(".")[0]
        assert top not in TEST_ONLY, f"{name_of(path)} imports {name}, which only tests have"
        if top in DOORS:
            assert name_of(path).startswith(DOORS[top]), f"{name_of(path)} imports {name}"


@pytest.mark.parametrize("path", [p for p in sources() if p.parts[len(ROOT.parts)] == "figures"], ids=name_of)
def test_figures_never_solve(path):
    for name, _ in imports(path):
        assert not any(name == solver or name.startswith(solver + ".") for solver in SOLVES), name


def test_the_command_line_imports_nothing_heavy_before_a_command_asks_for_it():
    light = {
        "__future__",
        "argparse",
        "collections",
        "contextlib",
        "io",
        "json",
        "os",
        "pathlib",
        "re",
        "shlex",
    }
    light |= {"sys", "typing"}
    light |= {"dataclasses"}
    own = ("jaxmpc.errors.", "jaxmpc.files.", "jaxmpc.programs.interrupts", "jaxmpc.cli.")
    for path in (ROOT / COMPOSITION_ROOT).glob("*.py"):
        for name, on_import in imports(path):
            assert not on_import or name.split(".")[0] in light or name.startswith(own), name


def test_no_two_files_of_a_package_import_each_other_in_a_circle():
    graph = {}
    modules = {name_of(path)[:-3].replace("/", "."): path for path in sources()}
    for module, path in modules.items():
        graph[module] = {
            target
            for name, on_import in imports(path)
            if on_import
            for target in (name, name.rpartition(".")[0])
            if target in modules and target != module
        }
    seen: dict[str, int] = {}

    def walk(module, trail):
        assert seen.get(module) != 1, " -> ".join([*trail, module])
        if module in seen:
            return
        seen[module] = 1
        for target in sorted(graph[module]):
            walk(target, [*trail, module])
        seen[module] = 2

    for module in sorted(graph):
        walk(module, [])
