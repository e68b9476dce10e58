"""FMUs of small plants for tests, compiled from a few lines of C, for co-simulation and for model exchange.

Their equations are snippets: `rates` sets the derivatives ``d[0..7]`` of the states ``x``, `outputs` sets ``y[0..7]`` from
``x``, the inputs ``u`` (reals), ``n`` (integers, enumerations), ``b`` (Booleans) and ``t``; `tick` runs at every step of 1 s
of co-simulation; `crossings` sets the event indicators ``z``, `update` runs in events and may set ``next``.
"""

import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import fmpy
import pytest

from tests.fmus import pack

SOURCE = """
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
typedef const unsigned *Refs;
static double u[8], x[8], y[8], z[8], now, next, past[4000], memory[8], d0[8];
static int n[4], b[4], ticks;
static unsigned long seed = 1;
static double noise(void)  /* of mean 0 and variance 1 */
{
    double s = -6;
    for (int i = 0; i < 12; i++) {
        seed = seed * 6364136223846793005UL + 1442695040888963407UL; s += (seed >> 11) / 9007199254740992.0;
    }
    return s;
}
static void rates(double t, const double *x, double *d) { memset(d, 0, 8 * sizeof *d); RATES; }
static void outputs(void) { double t = now; OUTPUTS; }
static void clear(void)
{
    memset(x, 0, sizeof x); memset(y, 0, sizeof y); memset(past, 0, sizeof past); memset(memory, 0, sizeof memory);
    ticks = 0; now = 0; next = 1e300; INITIAL;
}
#define WHOLE(T, values) \\
    int fmi2Set##T(void *c, Refs vr, size_t k, const int *v) \\
    { for (size_t i = 0; i < k; i++) { values[vr[i]] = v[i]; } return 0; } \\
    int fmi2Get##T(void *c, Refs vr, size_t k, int *v) \\
    { outputs(); for (size_t i = 0; i < k; i++) { v[i] = values[vr[i]]; } return 0; }
WHOLE(Integer, n) WHOLE(Boolean, b)
int fmi2SetReal(void *c, Refs vr, size_t k, const double *v)
{ for (size_t i = 0; i < k; i++) { if (vr[i] < 8) { u[vr[i]] = v[i]; } } return 0; }
int fmi2GetReal(void *c, Refs vr, size_t k, double *v)
{
    outputs(); rates(now, x, d0);
    for (size_t i = 0; i < k; i++) {
        unsigned r = vr[i]; v[i] = r < 8 ? u[r] : r < 20 ? y[r - 10] : r < 30 ? x[r - 20] : d0[r - 30];
    }
    return 0;
}
void *fmi2Instantiate(const char *name, int type, const char *guid) { clear(); return strcmp(guid, "{plant}") ? 0 : u; }
int fmi2Reset(void *c)
{ RESET; clear(); memset(u, 0, sizeof u); memset(n, 0, sizeof n); memset(b, 0, sizeof b); return 0; }
int fmi2SetupExperiment(void *c, int f, double a, double t, int known, double stop) { return 0; }
int fmi2ExitInitializationMode(void *c) { BEGIN; return 0; }
int fmi2DoStep(void *c, double t, double h)
{
    int count = (int)(h / 0.25 + 0.5); double e = h / count, k1[8], k2[8], k3[8], k4[8], w[8];
    for (int s = 0; s < count; s++) {  /* Runge-Kutta of fourth order */
        double a = t + s * e; int i;
        rates(a, x, k1); for (i = 0; i < 8; i++) { w[i] = x[i] + e / 2 * k1[i]; }
        rates(a + e / 2, w, k2); for (i = 0; i < 8; i++) { w[i] = x[i] + e / 2 * k2[i]; }
        rates(a + e / 2, w, k3); for (i = 0; i < 8; i++) { w[i] = x[i] + e * k3[i]; }
        rates(a + e, w, k4); for (i = 0; i < 8; i++) { x[i] += e / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]); }
    }
    now = t + h; ticks++; TICK; return 0;
}
int fmi2SetTime(void *c, double t) { now = t; return 0; }
int fmi2SetContinuousStates(void *c, const double *v, size_t k) { memcpy(x, v, k * sizeof *v); return 0; }
int fmi2GetContinuousStates(void *c, double *v, size_t k) { memcpy(v, x, k * sizeof *v); return 0; }
int fmi2GetNominalsOfContinuousStates(void *c, double *v, size_t k)
{ for (size_t i = 0; i < k; i++) { v[i] = 1; } return 0; }
int fmi2GetDerivatives(void *c, double *v, size_t k)
{ RATE_CALL; rates(now, x, d0); memcpy(v, d0, k * sizeof *v); return 0; }
int fmi2GetEventIndicators(void *c, double *v, size_t k)
{ double t = now; INDICATORS; memcpy(v, z, k * sizeof *v); return 0; }
typedef struct { int needed, ends, nominals, values, defined; double when; } Info;
int fmi2NewDiscreteStates(void *c, Info *info)
{
    double t = now; memset(info, 0, sizeof *info); UPDATE;
    info->defined = next < 1e299; info->when = next; return 0;
}
int fmi2CompletedIntegratorStep(void *c, int none, int *event, int *ends) { *event = *ends = 0; return 0; }
"""
SOURCE3 = """
#include <stdbool.h>
#define OF(T) \\
    int fmi3Set##T(void *c, Refs vr, size_t n, const double *v, size_t k) { return fmi2SetReal(c, vr, n, v); } \\
    int fmi3Get##T(void *c, Refs vr, size_t n, double *v, size_t k) { return fmi2GetReal(c, vr, n, v); }
OF(Float64)
void *fmi3InstantiateModelExchange(const char *name, const char *token) { return fmi2Instantiate(name, 0, token); }
void *fmi3InstantiateCoSimulation(const char *name, const char *token) { return fmi2Instantiate(name, 1, token); }
int fmi3Reset(void *c) { return fmi2Reset(c); }
int fmi3ExitInitializationMode(void *c) { return fmi2ExitInitializationMode(c); }
int fmi3SetTime(void *c, double t) { return fmi2SetTime(c, t); }
int fmi3SetContinuousStates(void *c, const double *v, size_t k) { return fmi2SetContinuousStates(c, v, k); }
int fmi3GetContinuousStates(void *c, double *v, size_t k) { return fmi2GetContinuousStates(c, v, k); }
int fmi3GetNominalsOfContinuousStates(void *c, double *v, size_t k) { return fmi2GetNominalsOfContinuousStates(c, v, k); }
int fmi3GetContinuousStateDerivatives(void *c, double *v, size_t k) { return fmi2GetDerivatives(c, v, k); }
int fmi3GetEventIndicators(void *c, double *v, size_t k) { return fmi2GetEventIndicators(c, v, k); }
int fmi3GetNumberOfContinuousStates(void *c, size_t *k) { *k = STATES; return 0; }
int fmi3GetNumberOfEventIndicators(void *c, size_t *k) { *k = CROSSED; return 0; }
int fmi3UpdateDiscreteStates(void *c, bool *again, bool *ends, bool *nominals, bool *values, bool *planned, double *when)
{
    Info info; fmi2NewDiscreteStates(c, &info);
    *again = *ends = *nominals = *values = false; *planned = info.defined; *when = info.when; return 0;
}
int fmi3CompletedIntegratorStep(void *c, bool none, bool *event, bool *ends) { *event = *ends = false; return 0; }
int fmi3DoStep(void *c, double t, double h, bool p, bool *event, bool *stop, bool *early, double *last)
{ *event = *stop = *early = false; *last = t + h; return fmi2DoStep(c, t, h); }
"""
PLACES = ("RATE_CALL", "RATES", "RESET", "OUTPUTS", "INITIAL", "BEGIN", "TICK", "INDICATORS", "UPDATE")


def real(name: str, reference: int, causality: str = "input", **more) -> str:
    """A real variable; inputs have the references 0 to 7, outputs 10 to 17."""
    return _variable("Real", name, reference, causality, "continuous", **more)


def whole(name: str, reference: int, causality: str = "input", kind: str = "Integer", **more) -> str:
    """An Integer, Boolean or Enumeration (of type ``Mode``) with a reference from 0 to 3."""
    return _variable(kind, name, reference, causality, "discrete", **more)


def _variable(kind, name, reference, causality, variability, **more):
    given = "".join(f' {key}="{value}"' for key, value in more.items() if value is not None)
    head = f'name="{name}" valueReference="{reference}" causality="{causality}" variability="{variability}"'
    return f"<ScalarVariable {head}><{kind}{given}/></ScalarVariable>"


def make_plant(
    folder: Path,
    variables: list[str],
    kind: str = "CoSimulation",
    states: int = 0,
    indicators: int = 0,
    step: float | None = 1.0,
    attributes: str = "",
    units: tuple[str, ...] = (),
    starts: float = 0.0,
    fmi: int = 2,
    **code: str,
) -> Path:
    """Compile the FMU, or skip the test where there is no compiler; `code` are the snippets, by their names.

    Of FMI 3.0 it has real variables only.
    """
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler")
    from fmpy.fmi2 import FMU2Model, FMU2Slave
    from fmpy.fmi3 import FMU3Model, FMU3Slave

    source = SOURCE
    for place in PLACES:
        source = source.replace(place, code.pop({"INDICATORS": "crossings"}.get(place, place.lower()), ""))
    assert not code, code
    made = (FMU2Slave, FMU2Model, FMU3Slave, FMU3Model)[2 * (fmi - 2) + (kind == "ModelExchange")]
    names = [name for name in dir(made) if name.startswith(f"fmi{fmi}")]
    if fmi == 3:
        source += SOURCE3.replace("STATES", str(states)).replace("CROSSED", str(indicators))
    stubs = [n for n in names if f"{n}(" not in source and n not in ("fmi2SetInteger", "fmi2GetInteger")]
    macros = ("fmi2SetBoolean", "fmi2GetBoolean", "fmi3SetFloat64", "fmi3GetFloat64")
    stubs = [n for n in stubs if n not in macros]
    source += "".join(f"int {name}(void) {{ return 0; }}\n" for name in stubs)
    library = folder / f"plant{fmpy.sharedLibraryExtension}"
    library.parent.mkdir(parents=True, exist_ok=True)
    command = [compiler, "-x", "c", "-O1", "-shared", "-fPIC", "-w", "-o", str(library), "-", "-lm"]
    subprocess.run(command, input=source, text=True, check=True)
    described = _description(variables, kind, states, indicators, step, attributes, units, starts)
    content = {
        "modelDescription.xml": described if fmi == 2 else _of_fmi3(described, kind, states),
        f"binaries/{fmpy.platform if fmi == 2 else fmpy.platform_tuple}/{library.name}": library.read_bytes(),
    }
    return pack(folder / "plant.fmu", content)


def _of_fmi3(described: str, kind: str, states: int) -> str:
    """The same in the words of FMI 3.0."""
    root = ElementTree.fromstring(described)
    root.set("fmiVersion", "3.0")
    root.set("instantiationToken", root.attrib.pop("guid"))
    del root.attrib["numberOfEventIndicators"]
    for gone in [*root.findall("TypeDefinitions")]:
        root.remove(gone)
    variables, structure = root.find("ModelVariables"), root.find("ModelStructure")
    assert variables is not None
    assert structure is not None
    names = [v.get("name") for v in variables]
    structure.clear()
    for own in variables:
        (of_type,) = own
        own.tag = {"Real": "Float64"}[of_type.tag]
        derivative = of_type.attrib.pop("derivative", None)
        own.attrib |= of_type.attrib
        if derivative:
            own.set("derivative", str(variables[int(derivative) - 1].get("valueReference")))
        own.remove(of_type)
    time = '<Float64 name="time" valueReference="99" causality="independent" variability="continuous"/>'
    variables.append(ElementTree.fromstring(time))
    listed = [("Output", v) for v in variables if v.get("causality") == "output"]
    listed += [("ContinuousStateDerivative", variables[names.index(f"der(x{k})")]) for k in range(states)]
    for tag, v in listed:
        ElementTree.SubElement(structure, tag, valueReference=str(v.get("valueReference")))
    return ElementTree.tostring(root, encoding="unicode")


def _description(variables, kind, states, indicators, step, attributes, units, starts):
    lines, first = list(variables), len(variables)
    for k in range(states):
        lines.append(_variable("Real", f"x{k}", 20 + k, "local", "continuous"))
        lines.append(
            _variable("Real", f"der(x{k})", 30 + k, "local", "continuous", derivative=first + 2 * k + 1)
        )
    outputs = [i for i, line in enumerate(lines, 1) if 'causality="output"' in line]
    listed = "".join(f'<Unknown index="{i}"/>' for i in outputs)
    rates = "".join(f'<Unknown index="{first + 2 * k + 2}"/>' for k in range(states))
    rates = f"<Derivatives>{rates}</Derivatives>" if states else ""
    experiment = (
        f'<DefaultExperiment startTime="{starts}" stopTime="{starts + 100}" stepSize="{step}"/>'
        if step
        else ""
    )
    unit = (
        f"<UnitDefinitions>{''.join(f'<Unit name={u!r}/>' for u in units)}</UnitDefinitions>" if units else ""
    )
    items = "".join(f'<Item name="{n}" value="{v}"/>' for n, v in (("off", 0), ("slow", 1), ("fast", 4)))
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="plant" guid="{{plant}}" numberOfEventIndicators="{indicators}">
<{kind} modelIdentifier="plant" {attributes}/>{unit}
<TypeDefinitions><SimpleType name="Mode"><Enumeration>{items}</Enumeration></SimpleType></TypeDefinitions>{experiment}
<ModelVariables>{"".join(lines)}</ModelVariables>
<ModelStructure><Outputs>{listed}</Outputs>{rates}</ModelStructure>
</fmiModelDescription>"""
