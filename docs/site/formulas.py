"""Formulas of the site: TeX becomes MathML while the pages are built, so that readers need no script and no network."""

import html
import re

from latex2mathml.converter import convert

# What the Markdown extension arithmatex marks as a formula: in a line, or on its own.
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
# Where the converter's MathML reads otherwise than TeX: Greek capitals are upright, bars without \left and \right keep
# their height and stand close, and so do the names of functions.
CORRECTIONS = (
    (re.compile(r"<mi>(&#x0039[1-9A-F];|&#x003A[0-9];)</mi>"), r'<mi mathvariant="normal">\1</mi>'),
    (re.compile(r"<mo>(&#x0007C;|&#x02016;)</mo>"), r'<mo stretchy="false" lspace="0" rspace="0">\1</mo>'),
    (re.compile(r"<mo>(&#x02223;)</mo>"), r'<mo stretchy="false">\1</mo>'),
    (re.compile(r"<mo>(max|min)</mo>"), r'<mo lspace="0.17em" rspace="0.1em">\1</mo>'),
)


def on_page_content(content: str, **_) -> str:
    """The page with its formulas as MathML; MkDocs calls this for every page.

    Raises:
        ValueError: for TeX that the converter does not know, which would be shown as it is typed.
    """
    return FORMULA.sub(_mathml, content)


def _mathml(found: re.Match) -> str:
    kind, tex = found[1], html.unescape(found[2]).strip()
    formula = convert(tex, display="block" if kind == "div" else "inline")
    unknown = re.findall(r"\\[a-zA-Z]+", formula)
    if unknown:
        raise ValueError(f"{', '.join(unknown)} in the formula {tex!r}: write it with other commands")
    for pattern, replacement in CORRECTIONS:
        formula = pattern.sub(replacement, formula)
    return f'<{kind} class="formula">{formula}</{kind}>'
