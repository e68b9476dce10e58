"""Times of controller steps: thesis figure 39 (chapter 8), and what a benchmark measured: the same, rates over batch sizes,
and performance profiles of solvers.

`draw_benchmark` reads the JSON file of `jaxmpc bench --json`, or the same content in memory; nothing is measured here.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from figures import style
from figures.figure import FigureEntry
from jaxmpc.errors import InputError
from studies.bench.judge import performance_profile

MILLISECONDS = 1e3  # of a second
TIMED = ("step-choke", "mixed-integer")
RUN_NAME, BATCH_NAME = "figure_39_time_per_sample", "bench_rate_over_batch"
PROFILE_NAME = "bench_performance_profile"
DT_HOURS = 10.0 / 3600.0  # sampling interval of the thesis preset [h]
MODES = ("moves", "inputs")


def draw(data: xr.Dataset, controllers: tuple[str, ...]) -> Figure:
    """Scatter plots over time on a logarithmic axis, one per controller: milliseconds of each step."""
    return time_per_sample(_timed(data, controllers))


def _timed(data: xr.Dataset, controllers: Iterable[str]) -> list[tuple[str, str, np.ndarray]]:
    """Kind, blocking mode and times ``"sample"`` [ms] of finished runs."""
    runs = [data.sel(controller=name) for name in controllers]
    return [(run.kind.item(), run.blocking.item(), MILLISECONDS * run.solve_time.values) for run in runs]


def _caption(data: xr.Dataset, controllers: tuple[str, ...]) -> str:
    parts = ", ".join(
        f"{kind} MPC {np.median(ms):.1f} / {ms.max():.0f} ms" for kind, _, ms in _timed(data, controllers)
    )
    return (
        f"Median and longest time of one step: {parts}; the sampling interval is "
        f"{float(data.attrs['dt']):.0f} s.{time_note(data, controllers)}"
    )


def time_note(data: xr.Dataset, controllers: Iterable[str]) -> str:
    """What to know of times per sample where compiled loops have none of their own; empty otherwise."""
    times = (data.solve_time.sel(controller=name).values for name in controllers)
    if any(len(np.unique(run)) < data.sizes["time"] / 10 for run in times):
        return " On the JAX well samples run compiled, many at once; each has their mean time."
    return ""


@style.house_style
def draw_benchmark(results: str | Path | dict[str, Any], out: str | Path) -> list[Path]:
    """Draw what the results have numbers for, as PNG and PDF.

    Args:
        results: JSON file of the benchmark, or its decoded content.
        out: folder for the files.

    Returns:
        The files written; none if no section with a figure was measured.

    Raises:
        InputError: for a file that cannot be read.
    """
    try:
        body: dict = results if isinstance(results, dict) else json.loads(Path(results).read_text())
    except (OSError, ValueError, RecursionError) as error:
        expected = f"a file of `jaxmpc bench --json` ({error})"
        raise InputError("benchmark results", str(results), expected) from None
    series = body.get("series", {})
    paths: list[Path] = []
    named = ((name.split(), found) for name, found in series.items())
    runs = [(*words[1:], np.array(found["solve_ms"])) for words, found in named if words[0] == "run"]
    if runs:
        paths += style.save(time_per_sample(runs), out, RUN_NAME)
    if any(name.startswith("batch ") for name in series):
        paths += style.save(rate_over_batch(series), out, BATCH_NAME)
    if "foreign" in series:
        paths += style.save(profiles(series["foreign"]), out, PROFILE_NAME)
    return paths


def time_per_sample(runs: list[tuple[str, str, np.ndarray]]) -> Figure:
    """One panel per run of `_timed`: solve time of every sample, its median, and the value that 99 % stay below."""
    drawn, axes = style.figure(len(runs), row_height=1.9, sharey=True)
    for ax, (kind, mode, milliseconds) in zip(axes, runs, strict=True):
        hours = np.arange(len(milliseconds)) * DT_HOURS
        look: dict[str, Any] = {"markersize": 1.6, "color": style.colour(kind, "step"), "rasterized": True}
        ax.plot(hours, milliseconds, ".", **look)
        for percent, line, word in ((50, "-", "median"), (99, "--", "99 %")):
            value = np.percentile(milliseconds, percent)
            label = style.printed(f"{word}: {two_digits(value)} ms")
            ax.axhline(value, color=style.BLACK, linewidth=0.9, linestyle=line, label=label)
        ax.set_yscale("log")
        ax.set_ylabel("time per sample [ms]")
        ax.set_title(f"{kind} MPC, {mode}", loc="left")
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.1)
    axes[-1].set_xlabel("time [h]")
    return drawn


def two_digits(value: float) -> str:
    """Two digits, and no power of ten for a hundred and more."""
    return f"{value:,.0f}" if value >= 99.5 else f"{value:.2g}"


def rate_over_batch(series: dict[str, Any]) -> Figure:
    """Relaxed QPs per second over batch size, with and without a start, and the rate of the peer beside it.

    Of the series, ``batch MODE`` has ``batch``, ``warm``, ``cold`` and perhaps a peer's rate.
    """
    modes = [mode for mode in MODES if f"batch {mode}" in series]
    drawn, axes = style.figure(len(modes), width=6.0, row_height=2.6, sharey=True)
    for ax, mode in zip(axes, modes, strict=True):
        rates = dict(series[f"batch {mode}"])
        sizes = rates.pop("batch")
        for name, rate in rates.items():
            peer = style.BLACK, "--", f"{name}, one core", ""
            colour, line, label, mark = _LINES.get(name, peer)
            ax.plot(sizes[: len(rate)], rate, line, marker=mark, markersize=4, color=colour, label=label)
        ax.set_xscale("log", base=2)
        ax.set_yscale("log")
        ax.set_xticks(sizes, [f"{count:g}" for count in sizes])
        ax.set_ylabel("rate [QP/s]")
        ax.set_title(f"relaxed QP, {mode}", loc="left")
    axes[0].legend(loc="best")
    axes[-1].set_xlabel("batch size [problems]")
    return drawn


def profiles(seconds: dict[str, Any]) -> Figure:
    """Share of instances that each solver solves within a factor of the fastest; times ``"instance"`` by solver [s]."""
    drawn, (ax,) = style.figure(1, width=6.0, row_height=3.2)
    looks = zip(
        (style.GREEN, style.BLUE, style.VERMILLION, *style.SPARE_COLOURS),
        ("-", "--", "-.", ":", "-"),
        strict=False,
    )
    curves = performance_profile(seconds)
    widest = 2.0 * max(float(factors.max(initial=1.0)) for factors, _ in curves.values())
    for (name, (factors, shares)), (colour, line) in zip(curves.items(), looks, strict=False):
        steps = np.r_[1.0, factors, widest], 100.0 * np.r_[0.0, shares, shares[-1:] if len(shares) else 0.0]
        ax.step(*steps, line, where="post", color=colour, label=name)
    ax.set_xscale("log")
    ax.set_xlim(1.0, widest)
    ax.set_ylim(0.0, 102.0)
    ax.set_xlabel("factor to the fastest solver of an instance")
    ax.set_ylabel("solved within the factor [% of instances]")
    ax.set_title(f"{len(next(iter(seconds.values())))} instances", loc="left")
    ax.legend(loc="best")
    return drawn


_LINES = {
    "warm": (style.BLUE, "-", "jaxmpc, started one sample earlier", "o"),
    "cold": (style.ORANGE, "-", "jaxmpc, no start", "o"),
}


ENTRIES = (
    FigureEntry(
        "39",
        "computation time of every sample: continuous and mixed-integer MPC",
        "thesis",
        draw,
        _caption,
        "solve_time",
        TIMED,
        {"controllers": TIMED},
    ),
)
