"""What the app shows beside what `figures` draws, of marimo's elements: progress, sliders, runs, what leaves the app."""

from __future__ import annotations

import contextlib
import queue
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import marimo as mo

from figures import choose, closed_loop
from figures import explore as draw
from jaxmpc import html
from jaxmpc.programs.clock import Clock
from jaxmpc.programs.compilation import told
from studies.notebooks import export
from studies.notebooks.controls import Slider
from studies.notebooks.loop import ExploreRun

SLIDER: dict[str, Any] = {"show_value": True, "debounce": True, "full_width": True}
ROW = '<div style="display:flex;gap:0.5rem;align-items:center;white-space:nowrap">{}</div>'


@contextlib.contextmanager
def compilation_shown(said=()):
    """Shows in its cell that something is compiled meanwhile; no threads but marimo's own reach the page."""
    lines = queue.SimpleQueue()
    for line in said:
        lines.put(line)

    def show():
        for line in iter(lines.get, None):
            mo.output.append(mo.md(line))

    thread = mo.Thread(target=show)
    thread.start()
    try:
        with told(lines.put):
            yield
    finally:
        lines.put(None)
        thread.join()
        mo.output.clear()


@contextlib.contextmanager
def progress_shown():
    """Gives what takes done and total samples; a bar is there as soon as a run takes longer than a second."""
    clock, bars, past = Clock(), contextlib.ExitStack(), [0.0]

    def report(done, total):
        part = done / total
        if not past[0] and (clock.seconds < 1 or part == 1):
            return
        if not past[0]:
            bar = mo.status.progress_bar(total=1, title="running", show_eta=True, remove_on_exit=True)
            report.bar = bars.enter_context(bar)
            report.bar.start_time = time.time() - clock.seconds
        report.bar.update(increment=part - past[0])
        past[0] = part

    with bars:
        yield report


def vega(spec) -> mo.ui.altair_chart:
    """A chart on the page, whose selections can be read."""
    return mo.ui.altair_chart(draw.altair_of(spec), chart_selection=False, legend_selection=False)


def sliders(given: Mapping[str, Slider]) -> mo.ui.dictionary:
    """A slider for each."""
    return mo.ui.dictionary(
        {
            key: mo.ui.slider(steps=one.steps, value=one.value, label=one.label, **SLIDER)
            for key, one in given.items()
        }
    )


def table(rows: list[dict[str, Any]], label: str, **look: Any) -> mo.ui.table:
    """Rows of which some can be ticked."""
    plain = {"show_column_summaries": False, "show_data_types": False}
    return mo.ui.table(rows, selection="multi", page_size=8, label=label, **plain, **look)


def chosen_of(title: str, choices: mo.ui.dictionary, *below: mo.Html) -> mo.Html:
    """What is chosen from a few, in two columns below a title."""
    rows = "".join(f"<span>{name}</span>{element}" for name, element in choices.elements.items())
    look = "display:grid;grid-template-columns:auto 1fr;gap:0 1rem;align-items:center;font-size:0.9rem"
    parts = mo.Html(f"<b>{html.escape(title)}</b>"), mo.Html(f'<div style="{look}">{rows}</div>')
    return mo.vstack([*parts, *below], gap=0.4)


def of_run(
    chart, runs: Mapping[str, ExploreRun], colours: Sequence[str], pinning: Sequence[mo.Html], seconds: float
):
    """The chart of a run and of those that are pinned, beside their key figures."""
    side = [
        mo.Html(
            '<div id="key-figures" style="font-size:12px;line-height:1.3;white-space:nowrap">'
            f"{export.figures_table(runs, colours)}</div>"
        ),
        *pinning,
        mo.md(f"<small>run and key figures: {seconds:.2f} s</small>"),
    ]
    drawn = mo.vstack([chart, mo.md(f"<small>{draw.CAPTION}</small>")], gap=0.1)
    if len(runs) > 2:  # a wide table
        return mo.vstack([drawn, *side], gap=0.3)
    return mo.hstack([drawn, mo.vstack(side, gap=0.3)], widths=[2.15, 1], align="start", gap=0.75)


def of_exports(run: ExploreRun, runs: Mapping[str, ExploreRun], colours: Sequence[str]) -> mo.Html:
    """A run as files to take along."""
    toml, python = export.as_toml(run), export.as_python(run)
    downloads = [
        mo.download(toml.encode(), "explored.toml", "application/toml", label="TOML"),
        mo.download(python.encode(), "tuning.py", "text/x-python", label="Python"),
        mo.download(
            lambda: export.as_page(runs, colours).encode(),
            "runs.html",
            "text/html",
            label="Page of these runs",
            disabled=not draw.can_be_sent(),
        ),
    ]
    shown = mo.accordion(
        {"As a study file": mo.md(f"```toml\n{toml}```"), "As Python": mo.md(f"```python\n{python}```")}
    )
    return mo.vstack([mo.hstack(downloads, justify="start"), shown], gap=0.3)


def of_picked(store: str, picked: Sequence[int], runs: choose.Runs, again: mo.ui.run_button) -> mo.Html:
    """Runs of a study that were picked; where `again` is pressed, the first of them is closed once more in full.

    Raises:
        InputError: for a store that cannot be read, or a run that cannot be made again.
    """
    shown = picked[: len(draw.COLOURS)]
    if again.value:
        from studies.rerun import rerun

        with compilation_shown(), mo.status.spinner("running"):
            found = rerun(Path(store), picked[0])
        data = [
            closed_loop.of_trajectory(
                found.trajectory, found.deadzone, found.kind, found.actuator, found.process
            )
        ]
    else:
        data = [choose.stored(store, number) for number in shown]
    names = runs.table.set_index("number")["run"]
    lines = [
        draw.Shown(str(number), colour, one)
        for number, colour, one in zip(shown, draw.COLOURS, data, strict=False)
    ]
    heads = [
        f'<b style="color:{line.colour}">{line.name}</b> {html.escape(names[number])}'
        for number, line in zip(shown, lines, strict=False)
    ]
    title = mo.hstack([mo.Html("<br>".join(heads)), again], widths=[5, 1])
    return mo.vstack([title, vega(draw.tracking(lines, width=800))], gap=0.3)
