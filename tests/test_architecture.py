"""The import rules of the packages, read from the source: who may use whom, one door per foreign library.

An import counts wherever it stands in its file. What breaks a rule today is in `EXCEPTIONS`, which must not hold more.
"""

import ast
import importlib.util
import re
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
    "fmpy": tuple(f"identify/{name}.py" for name in ("fmu", "fmu_file", "fmu_worker", "fmu_exchange")),
    "pythonfmu": ("identify/controller_fmu.py", "identify/controller_slave.py"),
    "matplotlib": ("figures/",),
    "dask": ("studies/",),
    "distributed": ("studies/",),
    "xarray": ("studies/", "figures/"),
    "zarr": ("studies/",),
    "google_crc32c": ("studies/store/",),
    "optuna": ("studies/search/run.py",),
    "scipy": (
        "jaxmpc/integer/tighten.py",
        "identify/judge.py",
        "identify/logged/",
        "studies/bench/",
        "studies/definition/axes.py",
    ),
    "clarabel": ("jaxmpc/integer/tighten.py", "studies/bench/peers.py"),
    "sippy_unipi": ("studies/bench/sections/identification.py",),
    **dict.fromkeys(("piqp", "osqp", "daqp", "qpax", "pyscipopt", "gurobipy"), ("studies/bench/peers.py",)),
}
COLUMN = (
    "model",
    "problem",
    "relaxed",
    "integer",
    "controller",
    "loop",
)  # folders of jaxmpc; each uses those before
GROUND = (
    "check",
    "errors",
    "decoding",
    "files",
    "status",
    "html",
    "programs",
)  # used by all of them, and using nothing else
BESIDE = {
    "process": {"model", "problem"},
    "steady": {"model", "problem", "relaxed", "integer"},  # `integer.highs` is the door of both
}
MAY_USE = {
    **{folder: set(GROUND) for folder in GROUND},
    **{folder: {*GROUND, folder, *COLUMN[:k]} for k, folder in enumerate(COLUMN)},
    **{folder: {*GROUND, folder, *others} for folder, others in BESIDE.items()},
    "__init__": {"programs"},
}
MAY_USE["loop"] |= {"process"}
EXCEPTIONS = {  # file: what it imports against the rules
}
TEST_ONLY = {
    "hypothesis",
    "pytest",
    "tests",
}
SOLVES = {  # figures read results: nothing that predicts, solves or simulates
    "jaxmpc.model.step_response",
    "jaxmpc.model.transfer_function",
    "jaxmpc.problem.condense",
    "jaxmpc.relaxed",
    "jaxmpc.integer",
    "jaxmpc.controller.plan",
    "jaxmpc.controller.batch",
    "jaxmpc.controller.controller",
    "jaxmpc.controller.core",
    "jaxmpc.process.well.plant",
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
        "gc",
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


def module_of(path: Path) -> str:
    """Dotted name under which a file is imported."""
    return name_of(path)[:-3].replace("/", ".").removesuffix(".__init__")


def uses() -> dict[str, set[str]]:
    """By module, the modules of the four packages that it imports anywhere."""
    modules = {module_of(path): path for path in sources()}
    found = {}
    for module, path in modules.items():
        names = (name if name in modules else name.rpartition(".")[0] for name, _ in imports(path))
        found[module] = {name for name in names if name in modules and name != module}
    return found


def pairs(graph: dict[str, set[str]]) -> set[tuple[str, str]]:
    """Its edges."""
    return {(module, target) for module, targets in graph.items() for target in targets}


def against_the_order(graph: dict[str, set[str]]) -> set[tuple[str, str]]:
    """Imports of a folder of `jaxmpc` that it may not use; the command line may use all."""
    folder = lambda module: (*module.split(".")[1:], "__init__")[0]  # noqa: E731
    inside = {pair for pair in pairs(graph) if all(module.split(".")[0] == "jaxmpc" for module in pair)}
    return {(a, b) for a, b in inside if folder(a) != "cli" and folder(b) not in MAY_USE[folder(a)]}


def in_circles(graph: dict[str, set[str]]) -> set[tuple[str, str]]:
    """Imports that are part of a circle."""
    reached = {}
    for module in graph:
        known, waiting = set(), [module]
        while waiting:
            new = graph[waiting.pop()] - known
            known |= new
            waiting.extend(new)
        reached[module] = known
    return {(a, b) for a, b in pairs(graph) if a in reached[b]}


def test_circles_and_wrong_floors_are_found():
    graph = {"jaxmpc.model.a": {"jaxmpc.loop.b"}, "jaxmpc.loop.b": {"jaxmpc.model.a", "jaxmpc.errors"}}
    graph |= {"jaxmpc.errors": set(), "jaxmpc": {"jaxmpc.errors"}, "jaxmpc.cli.main": {"jaxmpc", "studies.c"}}
    graph |= {"studies.c": {"jaxmpc.loop.b"}}
    assert in_circles(graph) == {
        ("jaxmpc.model.a", "jaxmpc.loop.b"),
        ("jaxmpc.loop.b", "jaxmpc.model.a"),
    }
    assert against_the_order(graph) == {("jaxmpc.model.a", "jaxmpc.loop.b"), ("jaxmpc", "jaxmpc.errors")}


def test_the_folders_of_the_core_use_only_those_below_them():
    folders = {path.stem if path.is_file() else path.name for path in (ROOT / "jaxmpc").iterdir()}
    assert folders - {"cli", "py", "__pycache__"} == set(MAY_USE)
    assert against_the_order(uses()) <= pairs(EXCEPTIONS)


def test_no_two_files_import_each_other_in_a_circle():
    graph = uses()
    allowed = {module: targets - EXCEPTIONS.get(module, set()) for module, targets in graph.items()}
    assert in_circles(allowed) == set()


def test_an_exception_that_is_not_needed_any_more_is_not_kept():
    graph = uses()
    needed = (in_circles(graph) | against_the_order(graph)) & pairs(EXCEPTIONS)
    assert needed == pairs(EXCEPTIONS)
    for module, targets in EXCEPTIONS.items():  # nor is one of a circle that others open already
        for target in targets - {b for a, b in against_the_order(graph) if a == module}:
            others = {name: used - EXCEPTIONS.get(name, set()) for name, used in graph.items()}
            others[module] |= {target}
            assert in_circles(others), (module, target)


# what may speak of the well: its own code, its files, the thesis's studies and their figures, and the library
OF_THE_WELL = (
    "jaxmpc/process/well/",
    "jaxmpc/process/library/",
    "identify/well",
    "studies/thesis/",
    "figures/thesis/",
)
WORDS = re.compile(r"(?<![a-z])(chokes?|oil|gas|lift)(?![a-z])")


@pytest.mark.parametrize(
    "path", [p for p in sources() if not name_of(p).startswith(OF_THE_WELL)], ids=name_of
)
def test_general_code_names_nothing_of_the_well(path):
    text = path.read_text().lower()
    for process in ("gas-lifted-well", "step-choke-well"):  # names of shipped processes
        text = text.replace(process, "")
    found = [f"{i}: {line.strip()}" for i, line in enumerate(text.splitlines(), 1) if WORDS.search(line)]
    assert not found, f"{name_of(path)}:{found[0]}"
