"""One HTML page with every figure: number, title, what to see, where it comes from, and how to draw it again.

The page is one file that needs nothing else: pictures are embedded, and there is no script and no address.
"""

from __future__ import annotations

import html
import string
from collections.abc import Iterable
from pathlib import Path

import xarray as xr

from figures import style
from figures.figure import FigureEntry
from figures.produce import check_asked, study_folder
from figures.registry import FIGURES
from jaxmpc.errors import InputError
from jaxmpc.files import write_atomically
from studies.store.reading import open_results
from studies.thesis.catalogue import PLANTS

PAGE = "index.html"
TEMPLATE = Path(__file__).with_name("gallery.html")
LARGEST = 10_000_000  # bytes; a page that opens at once and can be mailed


def write_gallery(
    ids: Iterable[str] = ("all",),
    results: str | Path = "results",
    out: str | Path = "figures-out",
    quick: bool = False,
    plant: str = PLANTS[0],
) -> Path:
    """Write the page beside the figures that `figures.produce.produce` has drawn with the same arguments.

    Args:
        ids: keys of `figures.registry.FIGURES`, or ``["all"]``.
        results: folder of all results; the captions take their numbers from them.
        out: folder of the figures; the page goes there.
        quick: whether the shortened studies were drawn.
        plant: of the studies.

    Returns:
        The page, ``index.html``.

    Raises:
        InputError: for an unknown id, a figure or results that are missing, or a page of more than 10 MB; before
            anything is written.
    """
    ids = check_asked(ids, quick, plant)
    entries = [FIGURES[id] for id in ids]
    pictures = [Path(out) / f"{entry.name}.png" for entry in entries]
    for entry, picture in zip(entries, pictures, strict=True):
        if not picture.is_file():
            expected = f"the picture of figure {entry.id}"
            raise InputError("out", str(picture), expected, "Draw the figures first")
    read: dict[str | None, xr.Dataset | None] = {None: None}
    for entry in entries:
        if entry.study is not None and entry.study not in read:
            read[entry.study] = open_results(study_folder(entry.study, results, quick, plant)).load()
    options = (" --quick" if quick else "") + (f" --plant {plant}" if plant != PLANTS[0] else "")
    blanks = {
        "contents": "\n".join(
            f'<li><a href="#figure-{html.escape(entry.id)}">{html.escape(heading(entry))}</a></li>'
            for entry in entries
        ),
        "well": "an FMU of the well" if plant == "fmu" else "the JAX twin of the well",
        "length": "shortened studies" if quick else "full studies",
        "body": "\n".join(
            _section(entry, picture.read_bytes(), read[entry.study], options)
            for entry, picture in zip(entries, pictures, strict=True)
        ),
    }
    page = string.Template(TEMPLATE.read_text(encoding="utf-8")).substitute(blanks)
    if len(page.encode()) > LARGEST:
        raise InputError("figure", ids, "figures of 10 MB together", "Ask for fewer of them")
    return write_atomically(Path(out) / PAGE, page)


def heading(entry: FigureEntry) -> str:
    """``Figure 12: nominal and Soft mixed-integer MPC``."""
    return f"Figure {entry.id}: {entry.title}" if entry.id.isdigit() else entry.title.capitalize()


def _section(entry: FigureEntry, picture: bytes, data: xr.Dataset | None, options: str) -> str:
    command = f"jaxmpc figures {entry.id}{options if entry.study else ''}"
    study = "none: computed from the problem itself"
    if data is not None:
        study = f"{data.attrs.get('study', entry.study)} ({data.attrs.get('title', '')})"
    return f"""<section id="figure-{html.escape(entry.id)}">
<h2>{html.escape(heading(entry))}</h2>
<figure>
{style.image(picture, entry.alt)}
<figcaption>{html.escape(entry.text(data))}</figcaption>
</figure>
<dl>
<dt>Study</dt><dd>{html.escape(study)}</dd>
<dt>Drawn by</dt><dd><code>{html.escape(entry.source)}</code></dd>
<dt>Again</dt><dd><code>{html.escape(command)}</code></dd>
</dl>
<p class="up"><a href="#contents">Contents</a></p>
</section>"""
