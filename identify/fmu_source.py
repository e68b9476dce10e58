"""C sources and model description of the well's FMU, generated from the one model function (thesis 3.2.1).

`jaxmpc.process.well.equations.model` is traced with SymPy, common subexpressions are taken out, and the result becomes
``model.h``. The C files in ``fmu_sources`` add the integration and the FMI 2.0 and 3.0 co-simulation
interfaces. Nothing here runs a compiler or imports FMPy: see `identify.fmu`.
"""

from __future__ import annotations

import hashlib
from dataclasses import fields
from importlib.resources import files
from types import SimpleNamespace
from xml.sax.saxutils import quoteattr

import sympy
from sympy.printing.c import C99CodePrinter

from jaxmpc.process.well.equations import (
    DEFAULT_CHOKE,
    DEFAULT_LIFT,
    INPUTS,
    OUTPUTS,
    SHIPPED_STEADY_STATE,
    STATES,
    WellParameters,
    model,
    parameters_to_dict,
)

MODEL_IDENTIFIER = "gas_lifted_well"
SUBSTEP = 1.0  # s, as in the JAX plant
# What drives the well while SepticControl is false: start [s], choke [%], lift [m3/h].
INPUT_SEQUENCE = (
    (0.0, 50.0, 7500.0),
    (600.0, 52.0, 7500.0),
    (4200.0, 50.0, 7500.0),
    (7800.0, 50.0, 7600.0),
    (11400.0, 50.0, 7500.0),
    (15000.0, 30.0, 10000.0),
    (22200.0, 70.0, 5000.0),
    (29400.0, 50.0, 7500.0),
)
# Value references; fmu_sources/well.h has the same numbers.
VR_TIME, VR_INPUT, VR_SEPTIC_CONTROL, VR_OUTPUT, VR_STATE = 0, 1, 10, 20, 40
UNITS = {
    "1": "",
    "%": 'factor="0.01"',
    "m3/h": f'm="3" s="-1" factor="{1 / 3600!r}"',
    "bar": 'kg="1" m="-1" s="-2" factor="100000"',
    "Pa": 'kg="1" m="-1" s="-2"',
    "kg": 'kg="1"',
    "s": 's="1"',
}


class _Positive(sympy.Function):
    """max(x, 0), kept as one function so that SymPy does not split the model into cases."""


class _Root(sympy.Function):
    """Square root, kept as one function so that SymPy does not turn products of roots into pow()."""


class _SymbolicOps:
    sqrt = _Root
    positive = _Positive


class _Printer(C99CodePrinter):
    def _print_Pow(self, expr):
        # Products, not pow(): the JAX plant multiplies, and both should round alike.
        if expr.exp.is_Integer and abs(expr.exp) >= 2:
            product = f"power({self._print(expr.base)}, {abs(int(expr.exp))})"
            return product if expr.exp > 0 else f"(1.0/{product})"
        return super()._print_Pow(expr)

    def _print__Positive(self, expr):
        return f"positive({self._print(expr.args[0])})"

    def _print__Root(self, expr):
        return f"sqrt({self._print(expr.args[0])})"


HELPERS = """static double positive(double a) { return a > 0.0 ? a : 0.0; }
static double power(double a, int n)
{
    double product = a;
    while (--n > 0) product *= a;
    return product;
}
"""


def _function(name: str, result: str, expressions: list) -> str:
    """A C function that computes the expressions, with common subexpressions computed once."""
    printer = _Printer()
    shared, reduced = sympy.cse(expressions, sympy.numbered_symbols("t"), order="none")
    lines = [f"    const double {symbol} = {printer.doprint(value)};" for symbol, value in shared]
    lines += [f"    {result}[{i}] = {printer.doprint(value)};" for i, value in enumerate(reduced)]
    body = "\n".join(lines)
    return f"static void {name}(const double x[8], const double u[3], double {result}[8])\n{{\n{body}\n}}\n"


def model_header(parameters: WellParameters) -> str:
    """The generated ``model.h``: parameters, start values, input sequence, derivatives and measurements."""
    x = [sympy.Symbol(f"x[{i}]", real=True) for i in range(len(STATES))]
    u = [sympy.Symbol(f"u[{i}]", real=True) for i in range(len(INPUTS))]
    # Parameters stay symbols: SymPy would otherwise fold them in its own precision.
    symbols = {f.name: sympy.Symbol(f"p_{f.name}", real=True) for f in fields(WellParameters)}
    dx, y = model(_SymbolicOps, x, u, SimpleNamespace(**symbols))
    constants = [f"static const double p_{k} = {v!r};" for k, v in parameters_to_dict(parameters).items()]
    start = ", ".join(repr(v) for v in start_state(parameters))
    rows = ",\n".join("    {" + ", ".join(repr(v) for v in row) + "}" for row in INPUT_SEQUENCE)
    return "\n".join(
        [
            "/* Generated from the well's model function; do not edit. */",
            "#include <math.h>",
            f"#define SUBSTEP {SUBSTEP!r}",
            f"#define SEQUENCE_ROWS {len(INPUT_SEQUENCE)}",
            f"static const double SEQUENCE[SEQUENCE_ROWS][3] = {{\n{rows}\n}};",
            f"static const double START_STATE[8] = {{{start}}};",
            f"static const double START_INPUT[3] = {{{DEFAULT_CHOKE!r}, {DEFAULT_LIFT!r}, 0.0}};",
            *constants,
            HELPERS,
            _function("rates", "dx", dx),
            _function("outputs", "y", y),
        ]
    )


def start_state(parameters: WellParameters) -> tuple[float, ...]:
    """Steady state at 50 % and 7500 m3/h: the shipped one, or that of other parameters."""
    if parameters_to_dict(parameters) == parameters_to_dict(WellParameters()):
        return SHIPPED_STEADY_STATE
    from jaxmpc.process.plant import WellPlant

    return tuple(float(v) for v in WellPlant(parameters).init().x)


def _variables(parameters: WellParameters) -> list[dict]:
    """Every variable of the FMU, in the order of the model description."""
    start = start_state(parameters)
    inputs = (DEFAULT_CHOKE, DEFAULT_LIFT, 0.0)
    rows = [
        {
            "name": name,
            "vr": VR_INPUT + i,
            "unit": unit,
            "text": text,
            "causality": "input",
            "start": inputs[i],
        }
        for i, (name, unit, text) in enumerate(INPUTS)
    ]
    rows.append(
        {
            "name": "SepticControl",
            "vr": VR_SEPTIC_CONTROL,
            "text": "false: the built-in input sequence drives the well; true: the inputs do",
            "causality": "input",
        }
    )
    rows += [
        {"name": name, "vr": VR_OUTPUT + i, "unit": unit, "text": text, "causality": "output"}
        for i, (name, unit, text) in enumerate(OUTPUTS)
    ]
    rows += [
        {
            "name": f"state.{name}",
            "vr": VR_STATE + i,
            "unit": unit,
            "text": text,
            "causality": "local",
            "start": start[i],
        }
        for i, (name, unit, text) in enumerate(STATES)
    ]
    return rows


def _variable_xml(row: dict, fmi: int) -> str:
    kind = {"input": "", "output": ' initial="calculated"', "local": ' initial="exact"'}[row["causality"]]
    common = (
        f'name={quoteattr(row["name"])} valueReference="{row["vr"]}" description={quoteattr(row["text"])}'
        f' causality="{row["causality"]}"'
    )
    boolean = "unit" not in row
    variability = ' variability="discrete"' if boolean else ' variability="continuous"'
    value = ' start="false"' if boolean else f' unit="{row["unit"]}"'
    value += f' start="{row["start"]!r}"' if "start" in row else ""
    if fmi == 3:
        return f"    <{'Boolean' if boolean else 'Float64'} {common}{variability}{kind}{value}/>"
    element = "Boolean" if boolean else "Real"
    return f"    <ScalarVariable {common}{variability}{kind}><{element}{value}/></ScalarVariable>"


def model_description(fmi: int, token: str, parameters: WellParameters) -> str:
    """``modelDescription.xml`` for FMI 2.0 or 3.0."""
    rows = _variables(parameters)
    variables = "\n".join(_variable_xml(row, fmi) for row in rows)
    units = "\n".join(
        f'    <Unit name="{name}"><BaseUnit {base}/></Unit>'.replace(" />", "/>")
        for name, base in UNITS.items()
    )
    text = "Gas-lifted oil well with two tubing sections, integrated with fixed steps of 1 s"
    experiment = '<DefaultExperiment startTime="0" stopTime="78000" stepSize="10"/>'
    sources = "".join(f'<File name="{name}"/>' for name in (f"fmi{fmi}.c", "well.c"))
    outputs = [(i, row) for i, row in enumerate(rows, 1) if row["causality"] == "output"]
    if fmi == 2:
        listed = "".join(f'<Unknown index="{i}"/>' for i, _ in outputs)
        return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="GasLiftedWell" guid="{token}"
  description="{text}" generationTool="jaxmpc" license="MIT" variableNamingConvention="structured">
  <CoSimulation modelIdentifier="{MODEL_IDENTIFIER}" canHandleVariableCommunicationStepSize="true"
    canGetAndSetFMUstate="true" canSerializeFMUstate="true">
    <SourceFiles>{sources}</SourceFiles>
  </CoSimulation>
  <UnitDefinitions>
{units}
  </UnitDefinitions>
  {experiment}
  <ModelVariables>
{variables}
  </ModelVariables>
  <ModelStructure>
    <Outputs>{listed}</Outputs>
    <InitialUnknowns>{listed}</InitialUnknowns>
  </ModelStructure>
</fmiModelDescription>
"""
    listed = "".join(f'<Output valueReference="{row["vr"]}"/>' for _, row in outputs)
    listed += "".join(f'<InitialUnknown valueReference="{row["vr"]}"/>' for _, row in outputs)
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="GasLiftedWell" instantiationToken="{token}"
  description="{text}" generationTool="jaxmpc" license="MIT" variableNamingConvention="structured">
  <CoSimulation modelIdentifier="{MODEL_IDENTIFIER}" canHandleVariableCommunicationStepSize="true"
    canGetAndSetFMUState="true" canSerializeFMUState="true"/>
  <UnitDefinitions>
{units}
  </UnitDefinitions>
  {experiment}
  <ModelVariables>
    <Float64 name="time" valueReference="{VR_TIME}" causality="independent" variability="continuous"
      unit="s"/>
{variables}
  </ModelVariables>
  <ModelStructure>{listed}</ModelStructure>
</fmiModelDescription>
"""


def _build_description(fmi: int) -> str:
    sources = "".join(f'<SourceFile name="{name}"/>' for name in (f"fmi{fmi}.c", "well.c"))
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiBuildDescription fmiVersion="3.0">
  <BuildConfiguration modelIdentifier="{MODEL_IDENTIFIER}">
    <SourceFileSet language="C99">{sources}</SourceFileSet>
  </BuildConfiguration>
</fmiBuildDescription>
"""


def fmu_files(fmi: int, parameters: WellParameters) -> tuple[dict[str, str], str]:
    """Everything in the FMU but its binary.

    Args:
        fmi: 2 or 3.
        parameters: of the well.

    Returns:
        ``(files, token)``: contents by path inside the FMU, and the instantiation token, which is a digest of
        those contents.
    """
    folder = files("identify") / "fmu_sources"
    contents = {
        f"sources/{name}": (folder / name).read_text() for name in ("well.h", "well.c", f"fmi{fmi}.c")
    }
    contents["sources/model.h"] = model_header(parameters)
    if fmi == 3:
        contents["sources/buildDescription.xml"] = _build_description(fmi)
    body = repr(sorted(contents.items())) + model_description(fmi, "", parameters)
    digest = hashlib.sha256(body.encode()).hexdigest()
    token = "{" + "-".join((digest[:8], digest[8:12], digest[12:16], digest[16:20], digest[20:32])) + "}"
    contents["sources/token.h"] = f'#define TOKEN "{token}"\n'
    contents["modelDescription.xml"] = model_description(fmi, token, parameters)
    return contents, token
