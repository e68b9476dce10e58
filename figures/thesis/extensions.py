"""Figures of the studies beyond the thesis: gain scheduling, the mean-move limit ahead of time, limited solve times."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures import panels, style
from figures.entry import FigureEntry
from jaxmpc.status import LIMIT
from studies.definition.presets import CHOKE, GAS, OIL
from studies.kpi import loop as kpi
from studies.kpi.evaluate import key_figures

NEAR_CLOSED = 6500.0  # m3/h, gas setpoints below it need a choke of less than about 12 %
SOFT_PAIR, HARD_PAIR = ("single", "scheduled"), ("single-no-soft", "scheduled-no-soft")
ROUNDED_PAIR = ("rounded", "rounded-scheduled")
COLOURS = {
    "single": style.GREEN,
    "scheduled": style.BLUE,
    "single-no-soft": style.PURPLE,
    "scheduled-no-soft": style.ORANGE,
    "rounded": style.VERMILLION,
    "rounded-scheduled": style.SKY,
}
MODE_COLOURS = {"reactive": style.VERMILLION, "predictive": style.BLUE}
RATE_SHOWN, CHOKE_SHOWN = (55.0, 135.0), (0.0, 20.0)  # m3/h of oil, %
OPENING = 2400.0  # s to show of the window in which the choke opens
MILLISECONDS = 1e3  # of a second


def near_closed(data: xr.Dataset) -> xr.Dataset:
    """The stretch from the first to the last window with a target that needs a nearly closed choke."""
    low = np.flatnonzero(data.setpoint.sel(cv=GAS).values < NEAR_CLOSED)
    return data.isel(time=slice(low[0], low[-1] + 1))


@contextlib.contextmanager
def scheduling(data: xr.Dataset) -> Iterator[Figure]:
    """Oil rate and choke near closed with one model and with a schedule; below, reversals in every window of the run.

    Args:
        data: results of the study ``gain-scheduling``.
    """
    zoom = near_closed(data)
    with style.grid(3, 2, row_height=2.2, sharex=False) as (drawn, axes):
        for column, (pair, title) in enumerate(
            ((SOFT_PAIR, "with Soft MPC"), (HARD_PAIR, "without Soft MPC"))
        ):
            rate, choke = axes[0, column], axes[1, column]
            rate.sharex(choke)
            rate.tick_params(labelbottom=False)
            seconds = panels.time_axis(choke, *panels.span(zoom), bins=6)
            for name in pair:
                label = "one model" if name.startswith("single") else "scheduled"
                panels.measured(rate, zoom, name, OIL, seconds, label, COLOURS[name])
                panels.manipulated(
                    choke, zoom, name, CHOKE, seconds, legend=False, label=label, colour=COLOURS[name]
                )
            panels.deadzone_lines(rate, zoom, pair[0], OIL, seconds)
            panels.setpoint(rate, zoom, OIL, seconds)
            rate.set_title(title)
            rate.legend(loc="upper right", ncols=2)
        for row in (0, 1):
            axes[row, 1].sharey(axes[row, 0])
            axes[row, 1].set_ylabel("")
            axes[row, 0].set_ylim(*(RATE_SHOWN, CHOKE_SHOWN)[row])
        whole = axes[2, 0].get_gridspec()[2, :]
        for unused in axes[2]:
            unused.remove()
        _reversal_bars(drawn.add_subplot(whole), data)
        yield drawn


def _reversal_bars(axes: Axes, data: xr.Dataset) -> None:
    """Choke reversals in the second half of every window, one bar per controller."""
    figures = key_figures(data)
    names = [name for pair in (SOFT_PAIR, HARD_PAIR, ROUNDED_PAIR) for name in pair]
    names = [name for name in names if name in figures.controller.values]
    windows = figures.sizes["window"]
    width = 0.85 / len(names)
    for i, name in enumerate(names):
        run = figures.sel(controller=name)
        at = np.arange(windows) + (i - 0.5 * (len(names) - 1)) * width
        label = str(run.label.item()).replace("mixed-integer MPC", "MIMPC").replace("continuous MPC", "MPC")
        axes.bar(at, run.late_reversals.values, width, color=COLOURS[name], label=label)
    first = [int(np.flatnonzero(data.window.values == w)[0]) for w in range(windows)]
    oil = data.setpoint.sel(cv=OIL).values[first]
    axes.set_xticks(np.arange(windows), [f"{value:g}" for value in oil])
    axes.set_xlabel("window, by its oil setpoint [m³/h]")
    axes.set_ylabel("late reversals [1]")
    axes.grid(axis="x", visible=False)
    axes.legend(ncols=2, fontsize=7.5, loc="upper left")
    axes.set_ylim(top=1.5 * max(1.0, axes.get_ylim()[1]))


def _means(data: xr.Dataset, name: str) -> np.ndarray:
    """Windowed mean of the choke moves of a run, ``"time"`` [%/sample]."""
    run = data.sel(controller=name)
    return np.asarray(kpi.windowed_mean(run.move.sel(mv=CHOKE).values, int(run.mean_move_window.item())))


def opening(data: xr.Dataset) -> xr.Dataset:
    """The first minutes of the setpoint window in which the choke of every controller opens fast."""
    length = int(OPENING / float(data.attrs["dt"]))
    starts = np.flatnonzero(np.diff(data.window.values, prepend=-1))
    means = np.stack([_means(data, str(name)) for name in data.controller.values])
    start = int(max(starts, key=lambda k: means[:, k : k + length].max(axis=1).min()))
    return data.isel(time=slice(start, start + length))


@contextlib.contextmanager
def mean_move(data: xr.Dataset) -> Iterator[Figure]:
    """Choke and windowed mean of its moves while it opens, limit reactive and predictive; one column per controller.

    Args:
        data: results of the study ``mean-move``.
    """
    zoom = opening(data)
    kinds = ("continuous", "mixed-integer")
    with style.grid(2, 2, row_height=2.3) as (drawn, axes):
        for column, kind in enumerate(kinds):
            choke, mean = axes[:, column]
            seconds = panels.time_axis(mean, *panels.span(zoom), bins=6)
            for mode, colour in MODE_COLOURS.items():
                name = f"{kind}-{mode}"
                panels.manipulated(choke, zoom, name, CHOKE, seconds, legend=False, label=mode, colour=colour)
                whole = _means(data, name)
                at = np.flatnonzero(np.isin(data.time.values, zoom.time.values))
                mean.step(zoom.time.values / seconds, whole[at], where="post", color=colour, label=mode)
            limit = float(data.tuning_mean_move_limit.sel(mv=CHOKE).values[0])
            mean.axhline(limit, color=style.BLACK, linestyle="--", linewidth=1.0, label=f"limit {limit:g} %")
            mean.set_ylabel("mean of 25 moves [%/sample]" if column == 0 else "")
            choke.set_title(f"{kind} MPC")
            choke.ticklabel_format(useOffset=False)
            choke.legend(loc="best")
            panels.legend_above(mean)
            if column:
                choke.set_ylabel("")
        yield drawn


@contextlib.contextmanager
def time_limit(data: xr.Dataset) -> Iterator[Figure]:
    """What limited solve times cost: gaps of the steps that ended at the limit, then travel and deviation, per limit.

    Args:
        data: results of the study ``time-limit``.
    """
    figures = key_figures(data)
    names = [str(name) for name in figures.controller.values]
    limited = sorted((n for n in names if n != "exact"), key=_milliseconds)
    order = [*limited, *(n for n in names if n == "exact")]
    labels = [f"{_milliseconds(n):g} ms" for n in limited] + ["none"] * ("exact" in names)
    with style.grid(1, 3, width=9.6, row_height=2.9, sharex=False) as (drawn, axes):
        gaps, wear, away = axes[0]
        _gap_strips(gaps, data, limited)
        place = np.arange(len(order))
        travel = [float(figures.choke_travel.sel(controller=n)) for n in order]
        wear.bar(place, travel, 0.6, color=style.GREEN)
        _numbers(wear, place, travel, "{:.0f}")
        wear.set_ylabel("choke travel [%]")
        deviation = [float(figures.mean_absolute_deviation.sel(controller=n, cv=OIL)) for n in order]
        away.bar(place, deviation, 0.6, color=style.BLUE)
        _numbers(away, place, deviation, "{:.2f}")
        away.set_ylabel("mean absolute deviation, oil [m³/h]")
        for ax in (wear, away):
            ax.set_xticks(place, labels)
            ax.set_xlabel("time limit of a step")
            ax.grid(axis="x", visible=False)
        yield drawn


def _milliseconds(name: str) -> float:
    """The limit in the name of a controller."""
    return float(name.removeprefix("limit-").removesuffix("-ms"))


def _gap_strips(axes: Axes, data: xr.Dataset, names: Sequence[str]) -> None:
    """Certified gaps of the steps that ended at the limit as dots, their median as a bar, their share in words."""
    scatter = np.random.default_rng(0)
    words = []
    for i, name in enumerate(names):
        run = data.sel(controller=name)
        stopped = run.status.values == LIMIT
        gap = 100.0 * run.gap.values[stopped]
        words.append(f"{_milliseconds(name):g} ms\n({100.0 * stopped.mean():.1f} %)")
        if len(gap):
            axes.scatter(i + scatter.uniform(-0.25, 0.25, len(gap)), gap, s=7, color=style.GREY, alpha=0.6)
            axes.hlines(np.median(gap), i - 0.35, i + 0.35, color=style.BLACK, linewidth=2.0)
    axes.set_yscale("log")
    axes.set_xticks(np.arange(len(names)), words)
    axes.set_xlim(-0.5, len(names) - 0.5)  # the last limits may stop no step
    axes.set_ylabel("proven gap of limited steps [%]")
    axes.set_xlabel("time limit of a step (share that reaches it)")
    axes.grid(axis="x", visible=False)


def _numbers(axes: Axes, place, values: Sequence[float], form: str) -> None:
    for x, value in zip(place, values, strict=True):
        axes.text(x, value, form.format(value), ha="center", va="bottom", fontsize=8)


def _scheduling_caption(data: xr.Dataset) -> str:
    late = key_figures(data).late_reversals.sum("window")
    pairs = (("with Soft MPC", SOFT_PAIR), ("without", HARD_PAIR), ("rounded", ROUNDED_PAIR))
    counts = "; ".join(
        f"{words} {int(late.sel(controller=one))} and {int(late.sel(controller=two))}"
        for words, (one, two) in pairs
    )
    return (
        "One model from half open underestimates what the choke does near closed several times over. Reversals in the "
        f"second halves of the windows with one model and with a schedule: {counts}. Rounding hunts for another reason."
    )


def _mean_move_caption(data: xr.Dataset) -> str:
    largest = key_figures(data).largest_mean_opening
    kinds = "; ".join(
        f"{kind} MPC {float(largest.sel(controller=f'{kind}-reactive')):.3f} and "
        f"{float(largest.sel(controller=f'{kind}-predictive')):.3f}"
        for kind in ("continuous", "mixed-integer")
    )
    return (
        "The reactive limit stops the choke once the mean of its moves is above the limit; the predictive limit plans with "
        f"the windows. Largest mean of the run, reactive and predictive: {kinds} %/sample."
    )


ENTRIES = (
    FigureEntry(
        "gain-scheduling",
        "one model against a gain schedule, near closed",
        "gain-scheduling",
        "gain_scheduling",
        scheduling,
        (*SOFT_PAIR, *HARD_PAIR, *ROUNDED_PAIR),
        caption=_scheduling_caption,
        alt="Oil rate and choke over time in two columns, with and without Soft MPC; below, bars of reversals per window.",
    ),
    FigureEntry(
        "mean-move",
        "the mean-move limit: reactive against predictive",
        "mean-move",
        "mean_move",
        mean_move,
        (
            "continuous-reactive",
            "continuous-predictive",
            "mixed-integer-reactive",
            "mixed-integer-predictive",
        ),
        caption=_mean_move_caption,
        alt="Two columns, continuous and mixed-integer MPC: choke position above the windowed mean of its moves.",
    ),
    FigureEntry(
        "time-limit",
        "what limited solve times cost",
        "time-limit",
        "time_limit",
        time_limit,
        ("exact",),
        caption=(
            "A step that ends at its limit applies the best plan found so far. The gaps are what the search could prove by "
            "then, not what the plan lost."
        ),
        alt="Three plots over the time limit: proven gaps of limited steps, choke travel, mean deviation of the oil rate.",
    ),
)
