"""The measured statements as Markdown, CSV, JSON and one HTML page that needs nothing but itself."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Sequence

import msgspec

from studies.thesis.claims.record import VERDICTS, Claim

COLUMNS = (
    "id",
    "section",
    "statement",
    "definition",
    "rule",
    "value",
    "verdict",
    "reason",
    "figures",
    "study",
)


def markdown(claims: Sequence[Claim], title: str) -> str:
    """One table: what the thesis says, how it is measured, what came out, and the verdict."""
    lines = [f"# {title}", "", f"{tally(claims)}.", "", *markdown_table(claims), ""]
    return "\n".join(lines)


def markdown_table(claims: Sequence[Claim]) -> list[str]:
    """The lines of that table."""
    lines = [
        "| id | section | the thesis says | measured | holds if | value | verdict | figures | study |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for claim in claims:
        said = claim.verdict + (f": {claim.reason}" if claim.reason else "")
        cells = (
            f"`{claim.id}`",
            claim.section,
            claim.statement,
            claim.definition,
            claim.rule,
            claim.value,
            said,
            ", ".join(claim.figures) or "–",
            claim.study,
        )
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return lines


def table_csv(claims: Sequence[Claim]) -> str:
    """One row per statement, `COLUMNS` as columns; figures are separated by blanks."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(COLUMNS)
    for claim in claims:
        row = msgspec.structs.asdict(claim) | {"figures": " ".join(claim.figures)}
        writer.writerow([row[name] for name in COLUMNS])
    return buffer.getvalue()


def tally(claims: Sequence[Claim]) -> str:
    """``48 statements: 30 hold, 12 hold in part, 5 do not hold, 1 is not tested``."""
    counts = [sum(claim.verdict == said for claim in claims) for said in VERDICTS]
    words = ("hold", "hold in part", "do not hold", "not tested")
    parts = [f"{count} {word}" for count, word in zip(counts, words, strict=True) if count]
    return f"{len(claims)} statements: {', '.join(parts)}"


def page(claims: Sequence[Claim], title: str, note: str, gallery: str) -> str:
    """The table as one HTML page.

    Args:
        claims: the measured statements.
        title: of the page.
        note: one sentence on the results that they are measured on.
        gallery: page of the figures, relative to this one; figure 12 is its ``#figure-12``.
    """
    rows = "\n".join(_row(claim, gallery) for claim in claims)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html.escape(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
<header>
<h1>{html.escape(title)}</h1>
<p>{html.escape(tally(claims))}. {html.escape(note)} A verdict follows from the numbers by the rule of its
row; rates are compared by the half width c of their deadzone, 1000 m3/h of gas and 5 m3/h of oil.</p>
</header>
<main>
<table>
<thead><tr><th scope="col">Section</th><th scope="col">The thesis says</th><th scope="col">We see</th>
<th scope="col">Verdict</th><th scope="col">Figures</th></tr></thead>
<tbody>
{rows}
</tbody>
</table>
</main>
</body>
</html>
"""


def _row(claim: Claim, gallery: str) -> str:
    text = {name: html.escape(str(value)) for name, value in msgspec.structs.asdict(claim).items()}
    links = ", ".join(
        f'<a href="{html.escape(gallery)}#figure-{html.escape(id)}">{html.escape(id)}</a>'
        for id in claim.figures
    )
    reason = f"<p><b>Why:</b> {text['reason']}.</p>" if claim.reason else ""
    kind = claim.verdict.replace(" ", "-")
    return f"""<tr id="{text["id"]}">
<td>{text["section"]}</td>
<td>{text["statement"]}<details><summary>how it is judged</summary><dl>
<dt>Measured</dt><dd>{text["definition"]}</dd>
<dt>Holds if</dt><dd>{text["rule"]}</dd>
<dt>Study</dt><dd><code>{text["study"]}</code>, row <code>{text["id"]}</code></dd></dl></details></td>
<td>{text["value"]}{reason}</td>
<td class="verdict {kind}">{text["verdict"]}</td>
<td>{links or "–"}</td>
</tr>"""


_STYLE = """
:root { color-scheme: light dark; --page: #ffffff; --text: #1d1d1f; --quiet: #55585e; --line: #d9dbe0; --link: #005a96;
  --yes: #00664d; --part: #8a5a00; --no: #a8330a; }
@media (prefers-color-scheme: dark) {
  :root { --page: #17181b; --text: #e8e8ea; --quiet: #a9adb5; --line: #3a3d44; --link: #7cc0f2; --yes: #5fd0ac;
    --part: #f0b95a; --no: #ff9b73; }
}
body { margin: 0 auto; padding: 1.5rem; max-width: 76rem; background: var(--page); color: var(--text);
  font: 0.95rem/1.45 system-ui, sans-serif; }
a { color: var(--link); }
table { border-collapse: collapse; width: 100%; }
th, td { border-bottom: 1px solid var(--line); padding: 0.5rem 0.7rem 0.5rem 0; text-align: left; vertical-align: top; }
th { color: var(--quiet); font-weight: 600; }
td:nth-child(2) { width: 30%; }
td:nth-child(3) { width: 42%; overflow-wrap: anywhere; }
td p { margin: 0.3rem 0 0; color: var(--quiet); }
details { color: var(--quiet); font-size: 0.88rem; }
summary { cursor: pointer; }
dl { margin: 0.2rem 0; }
dd { margin: 0 0 0.2rem 0.8rem; }
.verdict { font-weight: 600; white-space: nowrap; }
.holds { color: var(--yes); }
.holds-in-part { color: var(--part); }
.does-not-hold { color: var(--no); }
.not-tested { color: var(--quiet); }
"""
