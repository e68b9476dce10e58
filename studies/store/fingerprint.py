"""Content hashes: what decides whether a stored result still answers the question that is asked.

A hash covers the resolved inputs of a run (numbers, not the names of presets) and the code that computes it.
Code is hashed by its syntax tree, so that comments and formatting do not throw results away, but any change
of a statement does.
"""

from __future__ import annotations

import ast
import datetime
import functools
import hashlib
import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
from pathlib import Path
from typing import Any

import numpy as np

# Modules of `jaxmpc` that no closed loop depends on.
EDGE_FOLDERS = ("cli", "steady")
EDGE_MODULES = ("html", "controller/case", "controller/given", "controller/plan")


def content_hash(*parts: Any) -> str:
    """SHA-256 (hex) of JSON-like values and arrays; mappings count independent of their order."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(json.dumps(part, sort_keys=True, default=_plain).encode())
        digest.update(b"\0")
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    array = np.asarray(value)
    if array.dtype == object:
        raise TypeError(f"cannot hash {type(value).__name__}")
    data = np.ascontiguousarray(array)
    return {
        "dtype": str(data.dtype),
        "shape": data.shape,
        "sha256": hashlib.sha256(data.tobytes()).hexdigest(),
    }


@functools.cache
def source_hash(package: str) -> str:
    """Hash of the statements of a package's modules, command line and other edges left out."""
    module = importlib.import_module(package)
    folder = Path(module.__file__ or "").parent
    trees = {}
    for path in sorted(folder.rglob("*.py")):
        name = path.relative_to(folder).with_suffix("").as_posix()
        if name not in EDGE_MODULES and name.split("/")[0] not in EDGE_FOLDERS:
            trees[name] = ast.dump(_without_docstrings(ast.parse(path.read_text())))
    return content_hash(trees)


def packages_hash() -> dict[str, str]:
    """`source_hash` of the packages that every closed loop depends on, by name."""
    return {package: source_hash(package) for package in ("jaxmpc", "identify")}


@functools.cache
def module_hash(name: str) -> str:
    """Hash of the statements of one module, found without importing it."""
    found = importlib.util.find_spec(name)
    if found is None or found.origin is None:
        raise ModuleNotFoundError(name)
    return content_hash(ast.dump(_without_docstrings(ast.parse(Path(found.origin).read_text()))))


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            first = node.body[0] if node.body else None
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                node.body = node.body[1:] or [ast.Pass()]
    return tree


def made_now() -> dict[str, Any]:
    """Versions and time, for the provenance of results."""
    return {
        "versions": versions(),
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def versions() -> dict[str, str]:
    """Versions of Python, of the libraries that numbers depend on, and of the machine, for provenance."""
    out = {"python": platform.python_version(), "machine": platform.machine(), "cpus": str(os.cpu_count())}
    for name in ("jaxmpc", "jax", "jaxlib", "numpy", "equinox", "highspy", "fmpy", "xarray", "zarr"):
        try:
            out[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            out[name] = "not installed"
    return out
