"""FMUs for tests, compiled from a few lines of C: ones that misbehave, and ones that are not what they should be."""

import re
import shutil
import subprocess
import zipfile
from pathlib import Path

import fmpy
import pytest
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

GUID = "{a-guid-of-the-tests}"

DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="sum" guid="{guid}">
  <{kind} modelIdentifier="sum"{attributes}/>{types}{experiment}
  <ModelVariables>
    <ScalarVariable name="u" valueReference="0" causality="input"><Real start="0" unit="m3/h"/></ScalarVariable>
    <ScalarVariable name="n" valueReference="0" causality="input" variability="discrete">
      <Integer start="0"/></ScalarVariable>
    <ScalarVariable name="b" valueReference="0" causality="input" variability="discrete">
      <Boolean start="false"/></ScalarVariable>
    <ScalarVariable name="sum" valueReference="1" causality="output"><Real/></ScalarVariable>
    <ScalarVariable name="time" valueReference="2" causality="output"><Real/></ScalarVariable>{more}
  </ModelVariables>
  <ModelStructure><Outputs><Unknown index="4"/><Unknown index="5"/></Outputs></ModelStructure>
</fmiModelDescription>
"""
UNITS = '\n  <UnitDefinitions><Unit name="m3/h"/></UnitDefinitions>'
TYPES = """
  <TypeDefinitions><SimpleType name="Mode"><Enumeration><Item name="off" value="0"/>
    <Item name="auto" value="2"/><Item name="manual" value="5"/></Enumeration></SimpleType></TypeDefinitions>"""
MORE = """
    <ScalarVariable name="gain" valueReference="3" causality="parameter" variability="fixed">
      <Real start="1" min="0" max="10"/></ScalarVariable>
    <ScalarVariable name="bias" valueReference="4" causality="parameter" variability="tunable"
      description="added to the sum"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="mode" valueReference="1" causality="input" variability="discrete">
      <Enumeration declaredType="Mode" start="0"/></ScalarVariable>
    <ScalarVariable name="level" valueReference="5" causality="local" initial="exact">
      <Real start="0"/></ScalarVariable>
    <ScalarVariable name="steps" valueReference="2" causality="local" variability="discrete">
      <Integer/></ScalarVariable>
    <ScalarVariable name="text" valueReference="0" causality="local" variability="discrete">
      <String/></ScalarVariable>"""

# What is defined here; every other function of the standard is a stub that returns fmi2OK.
SOURCE = """
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
static double r[6] = {0, 0, 0, 1, 0, 0}, end = END; static int n[3], b, ready;
ON_LOAD
static double sum(void) { return r[3] * (r[0] + n[0] + 100 * b + 1000 * n[1]) + r[4]; }
void *fmi2Instantiate(const char *name, int type, const char *guid) { INSTANTIATE; return strcmp(guid, GUID) ? 0 : r; }
int fmi2Reset(void *c) { memset(r, 0, sizeof r); memset(n, 0, sizeof n); r[3] = 1; b = ready = 0; return 0; }
int fmi2SetupExperiment(void *c, int f, double a, double t, int known, double stop)
{ end = known ? stop : END; return 0; }
int fmi2ExitInitializationMode(void *c) { ready = 1; return 0; }
int fmi2SetReal(void *c, const unsigned *vr, size_t count, const double *v)
{
    for (size_t i = 0; i < count; i++) { if (vr[i] == 3 && ready) { return 3; } r[vr[i]] = v[i]; }
    return 0;
}
int fmi2SetInteger(void *c, const unsigned *vr, size_t count, const int *v)
{
    for (size_t i = 0; i < count; i++) { n[vr[i]] = v[i]; }
    return 0;
}
int fmi2SetBoolean(void *c, const unsigned *vr, size_t count, const int *v) { b = v[0]; return 0; }
int fmi2GetReal(void *c, const unsigned *vr, size_t count, double *v)
{
    for (size_t i = 0; i < count; i++) { v[i] = vr[i] == 1 ? sum() : r[vr[i]]; }
    return 0;
}
int fmi2GetInteger(void *c, const unsigned *vr, size_t count, int *v)
{
    for (size_t i = 0; i < count; i++) { v[i] = n[vr[i]]; }
    return 0;
}
int fmi2GetBoolean(void *c, const unsigned *vr, size_t count, int *v) { v[0] = b; return 0; }
int fmi2DoStep(void *c, double t, double h)
{
    DO_STEP;
    if (t + h > end + 1e-9) { return 3; }
    r[2] = t + h; n[2]++; r[5] += h / 60 * (sum() - r[5]);
    return 0;
}
int fmi2Terminate(void *c) { TERMINATE; return 0; }
"""
PLACES = ("ON_LOAD", "INSTANTIATE", "DO_STEP", "TERMINATE")

DESCRIPTION3 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="sum" instantiationToken="{guid}">
  <CoSimulation modelIdentifier="sum" fixedInternalStepSize="0.5"/>
  <TypeDefinitions><EnumerationType name="Mode"><Item name="off" value="1"/><Item name="on" value="2"/>
  </EnumerationType></TypeDefinitions>
  <ModelVariables>
    <Float64 name="time" valueReference="0" causality="independent"/>
    <Float64 name="sum" valueReference="1" causality="output"/>{variables}
    <Float64 name="row" valueReference="30" causality="input" start="0 0"><Dimension start="2"/></Float64>
    <Float64 name="table" valueReference="32" causality="local" initial="exact" start="1 2 3 4 5 6">
      <Dimension start="2"/><Dimension start="3"/></Float64>
  </ModelVariables>
  <ModelStructure><Output valueReference="1"/></ModelStructure>
</fmiModelDescription>
"""
TYPES3 = (
    "Float64",
    "Float32",
    "Int8",
    "UInt8",
    "Int16",
    "UInt16",
    "Int32",
    "UInt32",
    "Int64",
    "UInt64",
    "Boolean",
)
SOURCE3 = """
#include <stdbool.h>
#include <stdint.h>
#include <string.h>
static double x[64];
static double sum(void) { double s = 0; for (int i = 2; i < 64; i++) { s += x[i]; } return s; }
#define TYPE(T, t) int fmi3Set##T(void *c, const unsigned *vr, size_t n, const t *v, size_t m) \\
    { for (size_t i = 0; i < m; i++) { x[n == m ? vr[i] : vr[0] + i] = v[i]; } return 0; } \\
    int fmi3Get##T(void *c, const unsigned *vr, size_t n, t *v, size_t m) \\
    { for (size_t i = 0; i < m; i++) { unsigned k = n == m ? vr[i] : vr[0] + i; v[i] = k == 1 ? sum() : x[k]; } return 0; }
TYPE(Float64, double) TYPE(Float32, float) TYPE(Boolean, bool)
TYPE(Int8, int8_t) TYPE(Int16, int16_t) TYPE(Int32, int32_t) TYPE(Int64, int64_t)
TYPE(UInt8, uint8_t) TYPE(UInt16, uint16_t) TYPE(UInt32, uint32_t) TYPE(UInt64, uint64_t)
void *fmi3InstantiateCoSimulation(const char *name, const char *guid) { return strcmp(guid, GUID) ? 0 : x; }
int fmi3Reset(void *c) { memset(x, 0, sizeof x); return 0; }
int fmi3DoStep(void *c, double t, double h, bool p, bool *event, bool *stop, bool *early, double *last)
{ *event = *early = false; DO_STEP; *stop = t + h > 50; *last = x[0] = t + h; return 0; }
"""


def compile_library(target: Path, without: str = "", fmi: int = 2, ends: str = "1e300", **code: str) -> Path:
    """Compile the library, or skip the test where there is no compiler.

    Args:
        target: of the library.
        without: a function that is left out.
        fmi: version of FMI.
        ends: when the FMU refuses to go on [s], if it has not been told an end.
        code: C statements for the places ``ON_LOAD``, ``INSTANTIATE``, ``DO_STEP`` and ``TERMINATE``.
    """
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler")
    source, slave = (SOURCE, FMU2Slave) if fmi == 2 else (SOURCE3, FMU3Slave)
    source = source.replace("GUID", f'"{GUID}"').replace("END", ends)
    for place in PLACES:
        source = source.replace(place, code.get(place.lower(), ""))
    names = [name for name in dir(slave) if name.startswith(f"fmi{fmi}")]
    typed = f"fmi3(Get|Set)({'|'.join(TYPES3)})"  # made by a macro
    own = {name for name in names if f"{name}(" in source or re.fullmatch(typed, name)}
    stubs = [name for name in names if name not in own and name != without]
    source += "".join(f"int {name}(void) {{ return 0; }}\n" for name in stubs)
    target.parent.mkdir(parents=True, exist_ok=True)
    command = [compiler, "-x", "c", "-shared", "-fPIC", "-w", "-o", str(target), "-"]
    subprocess.run(command, input=source, text=True, check=True)
    return target


def make_fmu(folder: Path, description: str | None = None, **code: str) -> Path:
    """An FMI 2.0 FMU: inputs ``u``, ``n``, ``b``, ``mode``, parameters ``gain``, ``bias`` and what they make.

    ``sum`` is gain (u + n + 100 b + 1000 mode) + bias, ``level`` follows it with a lag of 60 s by one Euler step a step,
    ``time`` and ``steps`` count.

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


def make_fmu3(folder: Path, **code: str) -> Path:
    """An FMI 3.0 FMU with an input of every type, named after it, and ``mode``; ``sum`` of them all, and an array ``row``.

    It asks for the end after 50 s. `code` as of `compile_library`.
    """
    library = compile_library(folder / f"sum{fmpy.sharedLibraryExtension}", fmi=3, **code)
    inputs = [
        f'\n    <{kind} name="{kind}" valueReference="{k}" causality="input" start="{"false" if kind == "Boolean" else 0}"/>'
        for k, kind in enumerate(TYPES3, 2)
    ]
    inputs.append(
        '\n    <Enumeration name="mode" valueReference="20" declaredType="Mode" causality="input" start="1"/>'
    )
    content = {
        "modelDescription.xml": DESCRIPTION3.format(guid=GUID, variables="".join(inputs)),
        f"binaries/{fmpy.platform_tuple}/{library.name}": library.read_bytes(),
    }
    return pack(folder / "test3.fmu", content)


def describe(kind: str = "CoSimulation", guid: str = GUID, attributes: str = "", experiment: str = "") -> str:
    """The model description.

    Args:
        kind: of FMU.
        guid: of it.
        attributes: of the kind.
        experiment: attributes of the default experiment.
    """
    return DESCRIPTION.format(
        kind=kind,
        guid=guid,
        attributes=f" {attributes}" if attributes else "",
        types=UNITS + TYPES,
        experiment=f"\n  <DefaultExperiment {experiment}/>" if experiment else "",
        more=MORE,
    )


def pack(path: Path, content: dict[str, str | bytes]) -> Path:
    """A zip archive."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return path
