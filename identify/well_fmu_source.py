"""C sources and model description of the well's FMU, generated from the one model function (thesis 3.2.1).

`jaxmpc.process.well.equations.model` is traced with SymPy, common subexpressions are taken out, and the result becomes
``model.h``. The C files in ``well_fmu_sources`` add the integration and the FMI 2.0 and 3.0 co-simulation
interfaces. Nothing here runs a compiler or imports FMPy: see `identify.well_fmu`.
"""

from __future__ import annotations

import hashlib
from dataclasses import fields
from importlib.resources import files
from string import Template
from types import SimpleNamespace
from typing import NamedTuple
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
# Value references; well_fmu_sources/well.h has the same numbers.
VR_TIME, VR_INPUT, VR_SEPTIC_CONTROL, VR_OUTPUT, VR_STATE = 0, 1, 10, 20, 40
UNITS = {
    "1": "",
    "%": ' factor="0.01"',
    "m3/h": f' m="3" s="-1" factor="{1 / 3600!r}"',
    "bar": ' kg="1" m="-1" s="-2" factor="100000"',
    "Pa": ' kg="1" m="-1" s="-2"',
    "kg": ' kg="1"',
    "s": ' s="1"',
}


class _SymbolicOps:
    # Each kept as one function: SymPy would turn products of roots into pow() and split the model into cases.
    sqrt = sympy.Function("sqrt")
    positive = sympy.Function("positive")


class _Printer(C99CodePrinter):
    def _print_Pow(self, expr):
        # Products, not pow(): the JAX plant multiplies, and both should round alike.
        if expr.exp.is_Integer and abs(expr.exp) >= 2:
            product = f"power({self._print(expr.base)}, {abs(int(expr.exp))})"
            return product if expr.exp > 0 else f"(1.0/{product})"
        return super()._print_Pow(expr)


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
    printer = _Printer({"user_functions": {"sqrt": "sqrt", "positive": "positive"}})
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
    start = ", ".join(map(repr, start_state(parameters)))
    rows = ",\n".join("    {" + ", ".join(map(repr, row)) + "}" for row in INPUT_SEQUENCE)
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
    from jaxmpc.process.well.plant import WellPlant

    return tuple(float(v) for v in WellPlant(parameters=parameters).init().x)


class Variable(NamedTuple):
    """A variable of the FMU; one without a unit is Boolean."""

    name: str
    reference: int
    unit: str | None
    text: str
    causality: str
    start: float | None = None


def _variables(parameters: WellParameters) -> list[Variable]:
    """Every variable of the FMU, in the order of the model description."""
    switch = "false: the built-in input sequence drives the well; true: the inputs do"
    inputs, nothing = (DEFAULT_CHOKE, DEFAULT_LIFT, 0.0), (None,) * len(OUTPUTS)

    def group(rows, prefix: str, first: int, causality: str, start) -> list[Variable]:
        return [
            Variable(f"{prefix}{name}", first + i, unit, text, causality, start[i])
            for i, (name, unit, text) in enumerate(rows)
        ]

    return [
        *group(INPUTS, "", VR_INPUT, "input", inputs),
        Variable("SepticControl", VR_SEPTIC_CONTROL, None, switch, "input"),
        *group(OUTPUTS, "", VR_OUTPUT, "output", nothing),
        *group(STATES, "state.", VR_STATE, "local", start_state(parameters)),
    ]


def _variable_xml(row: Variable, fmi: int) -> str:
    initial = {"input": "", "output": ' initial="calculated"', "local": ' initial="exact"'}[row.causality]
    variability = "discrete" if row.unit is None else "continuous"
    common = (
        f'name={quoteattr(row.name)} valueReference="{row.reference}" description={quoteattr(row.text)}'
        f' causality="{row.causality}" variability="{variability}"{initial}'
    )
    value = ' start="false"' if row.unit is None else f' unit="{row.unit}"'
    value += f' start="{row.start!r}"' if row.start is not None else ""
    kind = "Boolean" if row.unit is None else "Float64" if fmi == 3 else "Real"
    if fmi == 3:
        return f"    <{kind} {common}{value}/>"
    return f"    <ScalarVariable {common}><{kind}{value}/></ScalarVariable>"


def model_description(fmi: int, token: str, parameters: WellParameters) -> str:
    """``modelDescription.xml`` for FMI 2.0 or 3.0."""
    rows = _variables(parameters)
    outputs = [(i, row.reference) for i, row in enumerate(rows, 1) if row.causality == "output"]
    if fmi == 2:
        listed = "".join(f'<Unknown index="{i}"/>' for i, _ in outputs)
    else:
        kinds = ("Output", "InitialUnknown")
        listed = "".join(f'<{kind} valueReference="{at}"/>' for kind in kinds for _, at in outputs)
    units = (f'    <Unit name="{name}"><BaseUnit{base}/></Unit>' for name, base in UNITS.items())
    return _filled(
        f"modelDescription{fmi}.xml",
        token=token,
        identifier=MODEL_IDENTIFIER,
        sources="".join(f'<File name="{name}"/>' for name in (f"fmi{fmi}.c", "well.c")),
        units="\n".join(units),
        variables="\n".join(_variable_xml(row, fmi) for row in rows),
        listed=listed,
        time=VR_TIME,
    )


def _filled(name: str, **words: object) -> str:
    """A template of ``well_fmu_sources`` with its words filled in."""
    return Template((files("identify") / "well_fmu_sources" / name).read_text("utf-8")).substitute(words)


def fmu_files(fmi: int, parameters: WellParameters) -> tuple[dict[str, str], str]:
    """Everything in an FMU of FMI 2 or 3 but its binary.

    Returns:
        ``(files, token)``: contents by path inside the FMU, and the instantiation token, which is a digest of
        those contents.
    """
    folder = files("identify") / "well_fmu_sources"
    contents = {
        f"sources/{name}": (folder / name).read_text() for name in ("well.h", "well.c", f"fmi{fmi}.c")
    }
    contents["sources/model.h"] = model_header(parameters)
    if fmi == 3:
        sources = "".join(f'<SourceFile name="{name}"/>' for name in (f"fmi{fmi}.c", "well.c"))
        build = _filled("buildDescription.xml", identifier=MODEL_IDENTIFIER, sources=sources)
        contents["sources/buildDescription.xml"] = build
    body = repr(sorted(contents.items())) + model_description(fmi, "", parameters)
    digest = hashlib.sha256(body.encode()).hexdigest()
    token = "{" + "-".join((digest[:8], digest[8:12], digest[12:16], digest[16:20], digest[20:32])) + "}"
    contents["sources/token.h"] = f'#define TOKEN "{token}"\n'
    contents["modelDescription.xml"] = model_description(fmi, token, parameters)
    return contents, token
