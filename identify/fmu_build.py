"""Compiling an FMU from its sources and its model description, for this machine."""

from __future__ import annotations

import functools
import importlib.util
import io
import os
import shutil
import sys
import tempfile
import zipfile
from pathlib import Path

from jaxmpc.errors import MissingToolError
from jaxmpc.programs.interrupts import in_the_end, run_program

# No fused multiply-adds: an FMU and a plant in JAX then round alike.
COMPILER_FLAGS = "-O2 -ffp-contract=off -fno-math-errno"


def _compiler() -> str | None:
    """Path of a C compiler, the one of ``$CC`` first."""
    names = (os.environ.get("CC", ""), "cc", "gcc", "clang", "cl")
    return next((found for name in names if name and (found := shutil.which(name.split()[0]))), None)


def _cmake_options() -> dict[str, str]:
    options = {
        "CMAKE_C_FLAGS:STRING": COMPILER_FLAGS,
        "CMAKE_C_STANDARD_LIBRARIES:STRING": "-lm",
        # FMPy's project asks for a C++ compiler too and never uses it: any path that needs no check will do.
        "CMAKE_CXX_COMPILER:FILEPATH": _compiler() or "",
        "CMAKE_CXX_COMPILER_WORKS:BOOL": "TRUE",
        "CMAKE_CXX_COMPILER_FORCED:BOOL": "TRUE",
    }
    return options if os.name == "posix" else {}


def _tools() -> dict[str, str]:
    """Environment in which cmake and a C compiler are found; cmake's PyPI package serves if PATH has none."""
    environment = dict(os.environ)
    missing = []
    if not shutil.which("cmake"):
        package = importlib.util.find_spec("cmake")
        if package and package.origin:
            folder = str(Path(package.origin).parent / "data" / "bin")
            environment["PATH"] = folder + os.pathsep + environment.get("PATH", "")
        if not shutil.which("cmake", path=environment.get("PATH")):
            missing.append("cmake")
    if not _compiler():
        missing.append("a C compiler")
    if not missing and not shutil.which("make") and not shutil.which("ninja") and os.name == "posix":
        missing.append("make")
    if missing:
        raise MissingToolError(
            f"Cannot build the FMU: {' and '.join(missing)} not found. On Debian or Ubuntu: "
            "apt install gcc libc6-dev make (and cmake, or: pip install cmake); on macOS: "
            "xcode-select --install. The JAX well needs none of this: --plant jax."
        )
    return environment


def compiled(contents: dict[str, str]) -> bytes:
    """Compile the sources in a temporary folder and return the zipped FMU."""
    environment = _tools()
    folder = tempfile.mkdtemp(prefix="jaxmpc-fmu-")
    with in_the_end(functools.partial(shutil.rmtree, folder, ignore_errors=True)):
        tree, build = Path(folder, "fmu").resolve(), Path(folder, "build").resolve()
        build.mkdir()
        for name, content in contents.items():
            path = tree / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content)
        # A process of its own keeps cmake's output and the changed PATH out of this one.
        code = (
            "from fmpy.build import build_platform_binary as build; "
            f"build({str(tree)!r}, {str(build)!r}, cmake_options={_cmake_options()!r})"
        )
        command = [sys.executable, "-P", "-c", code]
        status, said = run_program(command, {**environment, "TMPDIR": str(build)})
        if status != 0:
            raise MissingToolError(
                "Building the FMU failed. A C compiler with its headers is needed (Debian or Ubuntu: "
                f"apt install gcc libc6-dev make). Its last words:\n{said[-3000:]}"
            )
        archive = io.BytesIO()
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as zipped:
            for path in sorted(p for p in tree.rglob("*") if p.is_file()):
                # A fixed date keeps equal FMUs equal.
                zipped.writestr(zipfile.ZipInfo(path.relative_to(tree).as_posix()), path.read_bytes())
        return archive.getvalue()
