"""Figures on one HTML page: number, title, what to see, where it comes from, and how to draw it again.

The page is one file that needs nothing else: pictures are embedded, and there is no script and no address.
"""

from __future__ import annotations

import string
from collections.abc import Callable, Sequence
from pathlib import Path

import xarray as xr

from figures import style
from figures.figure import FigureEntry
from jaxmpc.errors import InputError
from jaxmpc.files import write_atomically
from jaxmpc.html import escape

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
    sections = [
        (f"figure-{entry.id}", heading(entry), _body(entry, picture.read_bytes(), data, command(entry)))
        for (entry, data), picture in zip(shown, pictures, strict=True)
    ]
    ids = [entry.id for entry, _ in shown]
    refused = InputError("figure", ids, "figures of 10 MB together", "Ask for fewer of them")
    return write_sections(Path(folder) / PAGE, title, about, sections, refused)


def write_sections(
    path: str | Path, title: str, about: str, sections: Sequence[tuple[str, str, str]], too_large: InputError
) -> Path:
    """Write a page of sections, each of an id, a heading and what stands below it as HTML, behind a list of them.

    Raises:
        InputError: `too_large`, before anything is written.
    """
    found = [(escape(id), escape(words), body) for id, words, body in sections]
    blanks = {
        "title": escape(title),
        "about": escape(about),
        "contents": "\n".join(f'<li><a href="#{id}">{words}</a></li>' for id, words, _ in found),
        "body": "\n".join(
            f'<section id="{id}">\n<h2>{words}</h2>\n{body}\n</section>' for id, words, body in found
        ),
    }
    page = string.Template(TEMPLATE.read_text(encoding="utf-8")).substitute(blanks)
    if len(page.encode()) > LARGEST:
        raise too_large
    return write_atomically(path, page)


def heading(entry: FigureEntry) -> str:
    """``Figure 12: nominal and Soft mixed-integer MPC``."""
    return f"Figure {entry.id}: {entry.title}" if entry.id.isdigit() else entry.title.capitalize()


def _body(entry: FigureEntry, picture: bytes, data: xr.Dataset | None, command: str) -> str:
    study = "none: computed from the problem itself"
    if data is not None:
        study = f"{data.attrs.get('study', entry.study)} ({data.attrs.get('title', '')})"
    again = f"\n<dt>Again</dt><dd><code>{escape(command)}</code></dd>" if command else ""
    return f"""<figure>
{style.image(picture, entry.alt)}
<figcaption>{escape(entry.text(data))}</figcaption>
</figure>
<dl>
<dt>Study</dt><dd>{escape(study)}</dd>
<dt>Drawn by</dt><dd><code>{escape(entry.source)}</code></dd>{again}
</dl>
<p class="up"><a href="#contents">Contents</a></p>"""
