"""Thesis figures 3, 4 and 5: relaxed, rounded and integer optimum of (2.14), its convex hull, and a cut."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures import style
from studies.thesis import integer_example as example
from studies.thesis.integer_example import EXAMPLE, Point, Row

VIEW = (-0.4, 5.6)  # both axes


@contextlib.contextmanager
def optima(_results=None) -> Iterator[Figure]:
    """Figure 3: where the relaxation, its rounding and the integer program have their optima."""
    with _plane() as (drawn, axes):
        _relaxed(axes)
        _lattice(axes)
        _optima(axes)
        _finish(axes)
        yield drawn


@contextlib.contextmanager
def convex_hull(_results=None) -> Iterator[Figure]:
    """Figure 4: the convex hull of the feasible integer points inside the relaxed set."""
    with _plane() as (drawn, axes):
        _relaxed(axes)
        corners = np.array(example.hull(example.integer_points(EXAMPLE)), dtype=float)
        axes.fill(*corners.T, color="#C9C9C9", linewidth=0, label="convex hull of the integer points")
        axes.plot(*np.vstack([corners, corners[:1]]).T, color=style.GREY, linewidth=1.0)
        _lattice(axes)
        _optima(axes, ("relaxed", "integer"))
        _finish(axes)
        yield drawn


@contextlib.contextmanager
def valid_inequality(_results=None) -> Iterator[Figure]:
    """Figure 5: a valid inequality with what it cuts off hatched, and the optimum that is left."""
    cut = example.best_cut(EXAMPLE)
    with _plane() as (drawn, axes):
        _relaxed(axes)
        beyond = [
            point
            for point in [*example.corners(EXAMPLE), *_ends(cut.row)]
            if cut.row.excess(point) >= 0 and EXAMPLE.holds(point)
        ]
        axes.fill(
            *np.array(example.hull(beyond), dtype=float).T,
            facecolor="none",
            edgecolor=style.VERMILLION,
            hatch="////",
            linewidth=0,
            label="cut off: no integer point",
        )
        label = f"valid inequality {row_text(cut.row)}"
        axes.plot(*_line(cut.row), color=style.VERMILLION, linestyle="-", linewidth=1.8, label=label)
        _lattice(axes)
        _optima(axes, ("relaxed", "integer"))
        _finish(axes)
        yield drawn


def row_text(row: Row) -> str:
    """A row in words: ``3 x₁ + 2 x₂ ≤ 15``."""
    terms = []
    for value, name in zip(row.normal, ("x₁", "x₂"), strict=True):
        if value:
            size = "" if abs(value) == 1 else f"{abs(value)} "
            sign = ("−" if value < 0 else "") if not terms else (" − " if value < 0 else " + ")
            terms.append(f"{sign}{size}{name}")
    return "".join(terms) + f" ≤ {row.limit}".replace("-", "−")


def point_text(point: Point) -> str:
    """A point in exact numbers: ``(376/193, 950/193)``."""
    return f"({point[0]}, {point[1]})"


MARKS = {  # of an optimum: name, function, marker, colour, place of its label [points]
    "relaxed": ("optimum of the relaxation", example.relaxed_optimum, "s", style.BLUE, (18, 11)),
    "rounded": ("rounded to a feasible point", example.rounded, "D", style.ORANGE, (-12, -17)),
    "integer": ("integer optimum", example.optimum, "*", style.GREEN, (7, 8)),
}


def _optima(axes: Axes, which: tuple[str, ...] = ("relaxed", "rounded", "integer")) -> None:
    for key in which:
        name, find, marker, colour, offset = MARKS[key]
        point = find(EXAMPLE)
        label = f"{name}, objective {float(EXAMPLE.value(point)):.3f}"
        size = 15 if marker == "*" else 7
        axes.plot(
            *map(float, point),
            marker,
            color=colour,
            markersize=size,
            markeredgecolor="white",
            markeredgewidth=0.6,
            label=label,
            zorder=5,
        )
        axes.annotate(
            point_text(point),
            tuple(map(float, point)),
            offset,
            textcoords="offset points",
            color=colour,
            weight="bold",
        )


def _relaxed(axes: Axes) -> None:
    """The relaxed feasible set, the two rows that bound it, and the level of the objective through its optimum."""
    corners = np.array(example.corners(EXAMPLE), dtype=float)
    axes.fill(*corners.T, color="#EEF3F8", linewidth=0, label="feasible set of the relaxation")
    for row, line in zip(EXAMPLE.rows[:2], ("-", "--"), strict=True):
        axes.plot(*_line(row), color=style.BLACK, linestyle=line, linewidth=1.0, label=row_text(row))
    best = example.relaxed_optimum(EXAMPLE)
    level = Row(EXAMPLE.objective, EXAMPLE.value(best))
    axes.plot(
        *_line(level), color=style.BLUE, linestyle=":", linewidth=1.2, label="equal objective, relaxation"
    )


def _lattice(axes: Axes) -> None:
    """Integer points: feasible ones filled."""
    whole = range(int(np.ceil(VIEW[0])), int(VIEW[1]) + 1)
    feasible = set(example.integer_points(EXAMPLE))
    outside = [(i, j) for i in whole for j in whole if (i, j) not in feasible]
    axes.plot(*zip(*outside, strict=True), "o", color="white", markeredgecolor=style.GREY, markersize=3.5)
    inside = np.array(sorted(feasible), dtype=float)
    axes.plot(*inside.T, "o", color=style.BLACK, markersize=4.5, label="feasible integer points")


def _line(row: Row) -> np.ndarray:
    """Where a row's border is inside the view, ``"coordinate end"``."""
    (a, b), limit = map(float, row.normal), float(row.limit)
    t = np.array([VIEW[0] - 1.0, VIEW[1] + 1.0])
    return np.array([t, (limit - a * t) / b]) if b else np.array([[limit / a] * 2, t])


def _ends(row: Row) -> list[Point]:
    """Where the row's border crosses the borders of the problem."""
    found = [example.crossing(row, known) for known in EXAMPLE.rows]
    return [point for point in found if point is not None]


@contextlib.contextmanager
def _plane():
    with style.figure(1, width=6.2, row_height=6.2) as (drawn, (axes,)):
        yield drawn, axes


def _finish(axes: Axes) -> None:
    axes.set_xlim(*VIEW)
    axes.set_ylim(*VIEW)
    axes.set_aspect("equal")
    axes.set_xlabel("x₁ [1]")
    axes.set_ylabel("x₂ [1]")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2)
