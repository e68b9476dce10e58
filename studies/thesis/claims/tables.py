"""The measured statements as Markdown, CSV and one HTML page that needs nothing but itself."""

from __future__ import annotations

import html
import string
from collections.abc import Sequence
from pathlib import Path

from studies.tables import csv_text, markdown_table
from studies.thesis.claims.record import VERDICTS, Claim

HEAD = ("id", "section", "the thesis says", "measured", "holds if", "value", "verdict", "figures", "study")


def markdown(claims: Sequence[Claim], title: str) -> str:
    """One table: what the thesis says, how it is measured, what came out, and the verdict."""
    rows = []
    for claim in claims:
        said = claim.verdict + (f": {claim.reason}" if claim.reason else "")
        words = claim.section, claim.statement, claim.definition, claim.rule, claim.value, said
        rows.append((f"`{claim.id}`", *words, ", ".join(claim.figures) or "–", claim.study))
    return "\n".join([f"# {title}", "", f"{tally(claims)}.", "", *markdown_table(HEAD, rows), ""])


def table_csv(claims: Sequence[Claim]) -> str:
    """One row per statement, the fields of `Claim` as columns; figures are separated by blanks."""
    rows = [claim.written() | {"figures": " ".join(claim.figures)} for claim in claims]
    return csv_text(list(rows[0]), [list(row.values()) for row in rows])


def tally(claims: Sequence[Claim]) -> str:
    """``48 statements: 30 hold, 12 hold in part, 5 do not hold, 1 is not tested``."""
    counts = [sum(claim.verdict == said for claim in claims) for said in VERDICTS]
    words = ("hold", "hold in part", "do not hold", "not tested")
    parts = [f"{count} {word}" for count, word in zip(counts, words, strict=True) if count]
    return f"{len(claims)} statements: {', '.join(parts)}"


def page(claims: Sequence[Claim], title: str, note: str, gallery: str) -> str:
    """The table as one HTML page.

    Args:
        claims, title: what it shows.
        note: one sentence on the results that they are measured on.
        gallery: page of the figures, relative to this one; figure 12 is its ``#figure-12``.
    """
    template = string.Template(Path(__file__).with_name("page.html").read_text("utf-8"))
    words = {"title": title, "tally": tally(claims), "note": note}
    rows = "\n".join(_row(claim, gallery) for claim in claims)
    return template.substitute({name: html.escape(text) for name, text in words.items()}, rows=rows)


def _row(claim: Claim, gallery: str) -> str:
    text = {name: html.escape(str(value)) for name, value in claim.written().items()}
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
