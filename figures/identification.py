"""What an identification has found, on one self-contained HTML page: responses, verdicts, evidence, what to do next.

``jaxmpc identify`` writes it beside the model, for FMUs and for logged data alike (`jaxmpc.model.identification`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from figures import style
from figures.page import write_sections
from jaxmpc import html
from jaxmpc.errors import InputError
from jaxmpc.html import Markup, escape
from jaxmpc.model.identification import Identification, Record

COLOURS = {"good": style.GREEN, "look": style.ORANGE, "bad": style.VERMILLION, "none": style.GREY}
WORDS = {
    "good": "use it",
    "look": "look at it before you use it",
    "bad": "not to be used as it is",
    "none": "no response",
}
OTHERS = (style.ORANGE, style.SKY, style.PURPLE, style.GREEN, style.VERMILLION, style.BLACK)
MOST_RECORDS, MOST_PANELS = 24, 120  # drawn; a page is to be read
POINTS = 4000  # of a curve


def write_page(found: Identification, path: str | Path) -> Path:
    """Write the page.

    Args:
        found: model, verdicts, bands, alternatives and records.
        path: of the HTML file.

    Returns:
        The path.

    Raises:
        InputError: for a page of more than 10 MB, before anything is written.
    """
    model = found.model
    inputs = ", ".join(model.input_names)
    sections = [
        ("verdicts", "Verdicts", _verdicts(found)),
        ("next", "What to do next", _listed(found.advice)),
    ]
    sections += [("responses", "Responses to a step of one unit", _responses(found))]
    shown = found.records[: max(min(MOST_RECORDS, MOST_PANELS // (len(model.cv_names) + 1)), 1)]
    if shown:
        parts = [_record(found, record, number) for number, record in enumerate(shown, 1)]
        left = len(found.records) - len(shown)
        parts += [f"<p>{left} more are not shown.</p>"] if left else []
        sections.append(("records", "What was measured, and what the model makes of it", "".join(parts)))
    sections += [("notes", "Notes", _listed(found.notes)), ("origin", "Where it comes from", _origin(found))]
    about = Markup(
        f"Responses to {escape(inputs)}: {model.samples} samples of {model.dt:g} s. Worst verdict: "
        f"<strong>{found.worst}</strong>."
    )
    refused = InputError("page", str(path), "a page of 10 MB at most", "Identify fewer pairs at once")
    sections = [one for one in sections if one[2]]
    return write_sections(path, f"Model of {', '.join(model.cv_names)}", about, sections, refused)


def _listed(lines: tuple[str, ...]) -> str:
    """Sentences as a list."""
    items = "".join(f"<li>{escape(style.printed(line))}</li>" for line in lines)
    return f"<ul>{items}</ul>" if items else ""


def _verdicts(found: Identification) -> str:
    rows = [
        [
            Markup(
                f'<span style="background:{COLOURS[row.verdict]};color:#fff;padding:1px 8px;border-radius:4px">'
                f"{row.verdict}</span>"
            ),
            row.input,
            row.cv,
            style.printed(row.says),
        ]
        for row in found.verdicts
    ]
    known = ", ".join(f"{word}: {says}" for word, says in WORDS.items())
    return f"{html.table(['verdict', 'input', 'CV', 'why'], rows)}<p>{known}.</p>"


def _axis(times: np.ndarray) -> tuple[np.ndarray, str]:
    """Times [s] as they are drawn, with their unit."""
    return (times / 60, "min") if times[-1] - times[0] > 7200 else (times, "s")


def _channels(found: Identification) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Names and units of the inputs, and of the CVs."""
    model = found.model
    inputs, cvs = ([(name, model.units[name]) for name in own] for own in (model.input_names, model.cv_names))
    return inputs, cvs


@style.house_style
def _responses(found: Identification) -> str:
    """A panel per pair: the model with its band, and the alternatives."""
    model, responses = found.model, found.responses
    inputs, cvs = _channels(found)
    verdicts = {(row.cv, row.input): row.verdict for row in found.verdicts}
    times, unit = _axis(np.arange(model.samples + 1) * model.dt)
    pictures = []
    looks = [(colour, line) for line in ("--", ":", "-.") for colour in OTHERS]
    width = max(3.0 * len(inputs), 5.0) + 0.6  # inch
    for i, (cv, cv_unit) in enumerate(cvs):
        drawn, axes = style.grid(1, len(inputs), width, 2.9)
        for j, (name, input_unit) in enumerate(inputs):
            ax, verdict = axes[0][j], verdicts.get((cv, name), "none")
            start = np.zeros(1)
            for (words, other), (colour, line) in zip(found.alternatives.items(), looks, strict=False):
                if np.isfinite(other[i, j]).all():
                    curve = np.concatenate([start, other[i, j]])
                    ax.plot(times, curve, color=colour, linewidth=1.0, linestyle=line, label=words)
            s = np.concatenate([start, responses[i, j]])
            if found.bands is not None:
                half = np.concatenate([start, found.bands[i, j]])
                ax.fill_between(
                    times, s - half, s + half, color=style.BLUE, alpha=0.2, linewidth=0, label="95 % band"
                )
            ax.plot(times, s, color=style.BLUE, label="model")
            ax.axhline(0.0, color=style.GREY, linewidth=0.6)
            ax.set_title(f"{name}: {verdict}", fontsize=9, color=COLOURS[verdict])
            ax.set_xlabel(f"time after the step [{unit}]")
            ax.set_ylabel(f"[{style.unit(cv_unit)} per {style.unit(input_unit)}]", fontsize=8)
        handles = {
            text: line for ax in axes[0] for line, text in zip(*ax.get_legend_handles_labels(), strict=True)
        }
        columns = max(int(width / 1.5), 2)
        drawn.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns)
        picture = style.image(style.png(drawn, dpi=110), f"Responses of {cv}")
        pictures.append(f"<h3>{escape(cv)}</h3><figure>{picture}</figure>")
    return "".join(pictures)


@style.house_style
def _record(found: Identification, record: Record, number: int) -> str:
    """Measured and predicted CVs above the inputs that move; what the model has not seen is shaded."""
    inputs, cvs = _channels(found)
    moving = np.ptp(record.inputs, axis=0) > 0
    shown = np.flatnonzero(moving if moving.any() else ~moving)
    every = -(-len(record.times) // POINTS)
    times, unit = _axis(record.times[::every])
    drawn, axes = style.figure(len(cvs) + len(shown), row_height=1.3)
    unseen = ~record.used[::every]
    for i, (cv, cv_unit) in enumerate(cvs):
        ax = axes[i]
        ax.plot(times, record.measured[::every, i], color=style.BLACK, label="measured")
        ax.plot(times, record.predicted[::every, i], color=style.ORANGE, linestyle="--", label="model alone")
        ax.set_ylabel(style.label(style.name_of(cv), cv_unit), fontsize=8)
    for ax, j in zip(axes[len(cvs) :], shown, strict=True):
        ax.plot(times, record.inputs[::every, j], color=style.BLUE, drawstyle="steps-post")
        ax.set_ylabel(style.label(style.name_of(inputs[j][0]), inputs[j][1]), fontsize=8)
    axes[-1].set_xlabel(f"time [{unit}]")
    axes[0].legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    for ax in axes:
        for begin, end in _stretches(unseen):
            ax.axvspan(times[begin], times[end], color=style.BAND, zorder=0)
    left = " Shaded: left out of the model, to judge it." if unseen.any() else ""
    picture = style.image(style.png(drawn, dpi=90), f"{record.title}: measured and predicted")
    return f"<figure>{picture}<figcaption>{number}. {escape(style.minus(record.title))}.{left}</figcaption></figure>"


def _stretches(flags: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of every stretch of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _origin(found: Identification) -> str:
    model = found.model
    units = model.units
    rows = [
        [f"{name} at the working point", f"{html.number(value)} {units.get(name, '')}".removesuffix(" 1")]
        for name, value in model.working_point
    ]
    rows += [[key, str(value)] for key, value in model.provenance if isinstance(value, str | int | float)]
    return html.table(["", ""], rows)
