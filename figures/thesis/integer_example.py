"""Thesis figures 3, 4 and 5: relaxed, rounded and integer optimum of (2.14), its convex hull, and a cut (thesis 2.2)."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures import style
from figures.figure import FigureEntry
from studies.thesis import integer_example as example
from studies.thesis.integer_example import EXAMPLE, Point, Row

VIEW = (-0.4, 5.6)  # both axes


def optima(_results=None) -> Figure:
    """A plane with integer points, the triangle that two inequalities leave of it, and three optima marked."""
    drawn, axes = _plane()
    return _finish(drawn, axes, ("relaxed", "rounded", "integer"))


def _optima_caption(_results=None) -> str:
    x, near, best = (find(EXAMPLE) for find in (example.relaxed_optimum, example.rounded, example.optimum))
    loss = 100 * (1 - EXAMPLE.value(near) / EXAMPLE.value(best))
    return (
        f"The relaxation of (2.14) has its optimum at {point_text(x)}. Rounded to the nearest feasible integers it is "
        f"{point_text(near)}, {float(loss):.1f} % worse than the integer optimum {point_text(best)} far away."
    )


def convex_hull(_results=None) -> Figure:
    """A plane with integer points; a grey polygon spans the feasible ones in the triangle of the relaxation."""
    drawn, axes = _plane()
    corners = np.array(example.hull(example.integer_points(EXAMPLE)), dtype=float)
    axes.fill(*corners.T, color="#C9C9C9", linewidth=0, label="convex hull of the integer points")
    axes.plot(*np.vstack([corners, corners[:1]]).T, color=style.GREY, linewidth=1.0)
    return _finish(drawn, axes)


def _hull_caption(_results=None) -> str:
    corners = example.hull(example.integer_points(EXAMPLE))
    points = len(example.integer_points(EXAMPLE))
    return (
        f"The {points} feasible integer points of (2.14) and their convex hull of {len(corners)} corners (grey): a linear "
        "program over the hull has the integer optimum as its solution."
    )


def valid_inequality(_results=None) -> Figure:
    """A plane with integer points; a line cuts a narrow strip, hatched, off the triangle of the relaxation."""
    row = example.best_cut(EXAMPLE).row
    drawn, axes = _plane()
    crossings = [point for known in EXAMPLE.rows if (point := example.crossing(row, known)) is not None]
    beyond = [p for p in (*example.corners(EXAMPLE), *crossings) if row.excess(p) >= 0 and EXAMPLE.holds(p)]
    look = {"facecolor": "none", "edgecolor": style.VERMILLION, "hatch": "////", "linewidth": 0}
    axes.fill(*np.array(example.hull(beyond), dtype=float).T, **look, label="cut off: no integer point")
    axes.plot(*_line(row), color=style.VERMILLION, linewidth=1.8, label=f"valid inequality {row_text(row)}")
    return _finish(drawn, axes)


def _cut_caption(_results=None) -> str:
    found = example.best_cut(EXAMPLE)
    u = " and ".join(str(value) for value in found.multipliers)
    right = sum((a * b.limit for a, b in zip(found.multipliers, found.rows, strict=True)), start=Fraction(0))
    return (
        f"A facet of the hull cuts off the relaxed optimum and no integer point. It is the sum of {u} times the two "
        f"rows, its right side {float(right):.2f} rounded down to {found.row.limit}; the relaxation with it has its "
        f"optimum at {point_text(found.optimum)}, which is the integer one."
    )


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


def _plane() -> tuple[Figure, Axes]:
    """The relaxed feasible set, the two rows that bound it, and the level of the objective through its optimum."""
    drawn, (axes,) = style.figure(1, width=6.2, row_height=6.2)
    corners = np.array(example.corners(EXAMPLE), dtype=float)
    axes.fill(*corners.T, color="#EEF3F8", linewidth=0, label="feasible set of the relaxation")
    for row, line in zip(EXAMPLE.rows[:2], ("-", "--"), strict=True):
        axes.plot(*_line(row), color=style.BLACK, linestyle=line, linewidth=1.0, label=row_text(row))
    level = Row(EXAMPLE.objective, EXAMPLE.value(example.relaxed_optimum(EXAMPLE)))
    look = {"linestyle": ":", "linewidth": 1.2, "label": "equal objective, relaxation"}
    axes.plot(*_line(level), color=style.BLUE, **look)
    return drawn, axes


def _finish(drawn: Figure, axes: Axes, optima: tuple[str, ...] = ("relaxed", "integer")) -> Figure:
    """Integer points, feasible ones filled, some of the optima, and the frame."""
    whole = range(int(np.ceil(VIEW[0])), int(VIEW[1]) + 1)
    feasible = set(example.integer_points(EXAMPLE))
    outside = [(i, j) for i in whole for j in whole if (i, j) not in feasible]
    axes.plot(*zip(*outside, strict=True), "o", color="white", markeredgecolor=style.GREY, markersize=3.5)
    inside = np.array(sorted(feasible), dtype=float)
    axes.plot(*inside.T, "o", color=style.BLACK, markersize=4.5, label="feasible integer points")
    for key in optima:
        name, find, marker, colour, offset = MARKS[key]
        point = find(EXAMPLE)
        place = float(point[0]), float(point[1])
        look = {"markersize": 15 if marker == "*" else 7, "markeredgecolor": "white", "markeredgewidth": 0.6}
        label = f"{name}, objective {float(EXAMPLE.value(point)):.3f}"
        axes.plot(*place, marker, color=colour, label=label, zorder=5, **look)
        note: dict[str, Any] = {"textcoords": "offset points", "color": colour, "weight": "bold"}
        axes.annotate(point_text(point), place, offset, **note)
    axes.set(xlim=VIEW, ylim=VIEW, aspect="equal", xlabel="x₁ [1]", ylabel="x₂ [1]")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2)
    return drawn


def _line(row: Row) -> np.ndarray:
    """Where a row's border is inside the view, ``"coordinate end"``."""
    (a, b), limit = map(float, row.normal), float(row.limit)
    t = np.array([VIEW[0] - 1.0, VIEW[1] + 1.0])
    return np.array([t, (limit - a * t) / b]) if b else np.array([[limit / a] * 2, t])


ENTRIES = (
    FigureEntry(
        "3",
        "optimum of a relaxation far from that of the integer program",
        None,
        optima,
        _optima_caption,
        "relaxation",
    ),
    FigureEntry("4", "convex hull of the integer points", None, convex_hull, _hull_caption, "convex_hull"),
    FigureEntry("5", "a valid inequality", None, valid_inequality, _cut_caption, "valid_inequality"),
)
