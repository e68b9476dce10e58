"""FMUs for tests, compiled from a few lines of C: ones that misbehave, and ones that are not what they should be."""

import shutil
import subprocess
import zipfile
from pathlib import Path

import fmpy
import pytest
from fmpy.fmi2 import FMU2Slave

GUID = "{a-guid-of-the-tests}"

DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="sum" guid="{guid}">
  <{kind} modelIdentifier="sum"/>
  <ModelVariables>
    <ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="n" valueReference="0" causality="input" variability="discrete">
      <Integer start="0"/></ScalarVariable>
    <ScalarVariable name="b" valueReference="0" causality="input" variability="discrete">
      <Boolean start="false"/></ScalarVariable>
    <ScalarVariable name="sum" valueReference="1" causality="output"><Real/></ScalarVariable>
    <ScalarVariable name="time" valueReference="2" causality="output"><Real/></ScalarVariable>
  </ModelVariables>
  <ModelStructure><Outputs><Unknown index="4"/><Unknown index="5"/></Outputs></ModelStructure>
</fmiModelDescription>
"""

# What is defined here; every other function of the standard is a stub that returns fmi2OK.
SOURCE = """
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
static double u, now; static int n, b;
ON_LOAD
void *fmi2Instantiate(const char *name, int type, const char *guid) { INSTANTIATE; return strcmp(guid, GUID) ? 0 : &u; }
int fmi2Reset(void *c) { u = now = 0; n = b = 0; return 0; }
int fmi2SetReal(void *c, const unsigned *vr, size_t count, const double *v) { u = v[0]; return 0; }
int fmi2SetInteger(void *c, const unsigned *vr, size_t count, const int *v) { n = v[0]; return 0; }
int fmi2SetBoolean(void *c, const unsigned *vr, size_t count, const int *v) { b = v[0]; return 0; }
int fmi2GetReal(void *c, const unsigned *vr, size_t count, double *v)
{
    for (size_t i = 0; i < count; i++) { v[i] = vr[i] == 0 ? u : vr[i] == 1 ? u + n + 100 * b : now; }
    return 0;
}
int fmi2DoStep(void *c, double t, double h) { DO_STEP; now = t + h; return 0; }
int fmi2Terminate(void *c) { TERMINATE; return 0; }
"""
OWN = ("Instantiate", "Reset", "SetReal", "SetInteger", "SetBoolean", "GetReal", "DoStep", "Terminate")


def compile_library(target: Path, without: str = "", **code: str) -> Path:
    """Compile the library, or skip the test where there is no compiler.

    Args:
        target: of the library.
        without: a function that is left out.
        code: C statements for the places ``ON_LOAD``, ``INSTANTIATE``, ``DO_STEP`` and ``TERMINATE``.
    """
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler")
    source = SOURCE.replace("GUID", f'"{GUID}"')
    for place in ("ON_LOAD", "INSTANTIATE", "DO_STEP", "TERMINATE"):
        source = source.replace(place, code.get(place.lower(), ""))
    names = [name for name in dir(FMU2Slave) if name.startswith("fmi2")]
    stubs = [name for name in names if name.removeprefix("fmi2") not in OWN and name != without]
    source += "".join(f"int {name}(void) {{ return 0; }}\n" for name in stubs)
    target.parent.mkdir(parents=True, exist_ok=True)
    command = [compiler, "-x", "c", "-shared", "-fPIC", "-w", "-o", str(target), "-"]
    subprocess.run(command, input=source, text=True, check=True)
    return target


def make_fmu(folder: Path, description: str | None = None, **code: str) -> Path:
    """An FMI 2.0 FMU with inputs ``u``, ``n`` and ``b`` and outputs ``sum`` (u + n + 100 b) and ``time``.

    Args:
        folder: for it.
        description: the model description; the one of the FMU by default.
        code: see `compile_library`.
    """
    library = compile_library(folder / f"sum{fmpy.sharedLibraryExtension}", **code)
    content = {
        "modelDescription.xml": description or describe(),
        f"binaries/{fmpy.platform}/{library.name}": library.read_bytes(),
    }
    return pack(folder / "test.fmu", content)


def describe(kind: str = "CoSimulation", guid: str = GUID) -> str:
    """The model description."""
    return DESCRIPTION.format(kind=kind, guid=guid)


def pack(path: Path, content: dict[str, str | bytes]) -> Path:
    """A zip archive."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return path
