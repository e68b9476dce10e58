"""Figures on one HTML page: number, title, what to see, where it comes from, and how to draw it again.

The page is one file that needs nothing else: pictures are embedded, and there is no script and no address.
"""

from __future__ import annotations

import html
import string
from collections.abc import Callable, Sequence
from pathlib import Path

import xarray as xr

from figures import style
from figures.figure import FigureEntry
from jaxmpc.errors import InputError
from jaxmpc.files import write_atomically

PAGE = "index.html"
TEMPLATE = Path(__file__).with_name("page.html")
LARGEST = 10_000_000  # bytes; a page that opens at once and can be mailed


def write_page(
    shown: Sequence[tuple[FigureEntry, xr.Dataset | None]],
    folder: str | Path,
    title: str,
    about: str,
    command: Callable[[FigureEntry], str] = lambda entry: "",
) -> Path:
    """Write the page beside figures that are drawn already.

    Args:
        shown: figures, and the results from which they are drawn.
        folder: of the figures; the page goes there.
        title: of the page.
        about: a paragraph below it.
        command: that draws a figure again; empty for none.

    Returns:
        The page, ``index.html``.

    Raises:
        InputError: for a picture that is missing, or a page of more than 10 MB; before anything is written.
    """
    pictures = [Path(folder) / f"{entry.name}.png" for entry, _ in shown]
    for (entry, _), picture in zip(shown, pictures, strict=True):
        if not picture.is_file():
            expected = f"the picture of figure {entry.id}"
            raise InputError("out", str(picture), expected, "Draw the figures first")
    contents = [
        f'<li><a href="#figure-{html.escape(entry.id)}">{html.escape(heading(entry))}</a></li>'
        for entry, _ in shown
    ]
    sections = [
        _section(entry, picture.read_bytes(), data, command(entry))
        for (entry, data), picture in zip(shown, pictures, strict=True)
    ]
    blanks = {"contents": "\n".join(contents), "body": "\n".join(sections)}
    blanks |= {"title": html.escape(title), "about": html.escape(about)}
    page = string.Template(TEMPLATE.read_text(encoding="utf-8")).substitute(blanks)
    if len(page.encode()) > LARGEST:
        ids = [entry.id for entry, _ in shown]
        raise InputError("figure", ids, "figures of 10 MB together", "Ask for fewer of them")
    return write_atomically(Path(folder) / PAGE, page)


def heading(entry: FigureEntry) -> str:
    """``Figure 12: nominal and Soft mixed-integer MPC``."""
    return f"Figure {entry.id}: {entry.title}" if entry.id.isdigit() else entry.title.capitalize()


def _section(entry: FigureEntry, picture: bytes, data: xr.Dataset | None, command: str) -> str:
    study = "none: computed from the problem itself"
    if data is not None:
        study = f"{data.attrs.get('study', entry.study)} ({data.attrs.get('title', '')})"
    again = f"\n<dt>Again</dt><dd><code>{html.escape(command)}</code></dd>" if command else ""
    return f"""<section id="figure-{html.escape(entry.id)}">
<h2>{html.escape(heading(entry))}</h2>
<figure>
{style.image(picture, entry.alt)}
<figcaption>{html.escape(entry.text(data))}</figcaption>
</figure>
<dl>
<dt>Study</dt><dd>{html.escape(study)}</dd>
<dt>Drawn by</dt><dd><code>{html.escape(entry.source)}</code></dd>{again}
</dl>
<p class="up"><a href="#contents">Contents</a></p>
</section>"""
