"""The integer program of two variables (2.14): relaxation, rounding, optimum, convex hull and a cut, exactly.

Everything is computed from the rows of the problem with fractions, by looking at all corners and all integer
points, so that figures 3, 4 and 5 show derived numbers. Thesis 2.2.2 and 2.2.7; `figures.thesis.integer_example` draws it.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from fractions import Fraction

from jaxmpc.check import require
from jaxmpc.errors import InputError

Point = tuple[Fraction, Fraction]


@dataclasses.dataclass(frozen=True)
class Row:
    """The half plane ``normal . x <= limit``."""

    normal: Point
    limit: Fraction

    @classmethod
    def of(cls, first, second, limit) -> Row:
        """A row from integers, fractions or decimal texts."""
        return cls((Fraction(first), Fraction(second)), Fraction(limit))

    def excess(self, point: Point) -> Fraction:
        """``normal . x - limit``: positive where the row is violated."""
        return dot(self.normal, point) - self.limit


@dataclasses.dataclass(frozen=True)
class IntegerProgram:
    """Maximise ``objective . x`` over the integer points that satisfy every row."""

    objective: Point  # coefficients of the two variables
    rows: tuple[Row, ...]  # they must enclose a bounded set, the signs of the variables included

    def value(self, point: Point) -> Fraction:
        """Objective at a point."""
        return dot(self.objective, point)

    def holds(self, point: Point) -> bool:
        """Whether a point satisfies every row."""
        return all(row.excess(point) <= 0 for row in self.rows)


@dataclasses.dataclass(frozen=True)
class Cut:
    """A valid inequality and why it is one."""

    row: Row  # the inequality, with coprime integer coefficients
    optimum: Point  # optimum of the relaxation once the row is added
    rows: tuple[Row, ...]  # the rows of the problem that it is combined from
    # of these rows: the combination has the cut's left side, and its right side rounded down is the cut's
    # limit (a Chvatal-Gomory cut)
    multipliers: tuple[Fraction, ...]


# (2.14), the sign of both variables included
EXAMPLE = IntegerProgram(
    (Fraction("1.00"), Fraction("0.64")),
    (Row.of(50, 31, 250), Row.of(-3, 2, 4), Row.of(-1, 0, 0), Row.of(0, -1, 0)),
)


def dot(left: Point, right: Point) -> Fraction:
    """Inner product."""
    return left[0] * right[0] + left[1] * right[1]


def solved(one: Point, other: Point, right: Point) -> Point | None:
    """X with ``one . x = right[0]`` and ``other . x = right[1]``, by Cramer's rule; None for parallel ones."""
    (a, b), (c, d), (p, q) = one, other, right
    determinant = a * d - b * c
    return None if determinant == 0 else ((p * d - b * q) / determinant, (a * q - p * c) / determinant)


def crossing(one: Row, other: Row) -> Point | None:
    """Where the borders of two rows cross; None for parallel ones."""
    return solved(one.normal, other.normal, (one.limit, other.limit))


def corners(program: IntegerProgram) -> list[Point]:
    """Corners of the relaxed feasible set, counterclockwise.

    Raises:
        InputError: if there is none.
    """
    found = {crossing(*pair) for pair in itertools.combinations(program.rows, 2)}
    inside = [point for point in found if point is not None and program.holds(point)]
    require(inside, "program.rows", len(program.rows), "rows that some point satisfies")
    return hull(inside)


def relaxed_optimum(program: IntegerProgram) -> Point:
    """Best corner of the relaxed feasible set."""
    return max(corners(program), key=program.value)


def integer_points(program: IntegerProgram) -> list[Point]:
    """Every feasible integer point.

    Raises:
        InputError: if there is none.
    """
    spread = (range(math.ceil(min(x)), math.floor(max(x)) + 1) for x in zip(*corners(program), strict=True))
    points = [(Fraction(i), Fraction(j)) for i, j in itertools.product(*spread)]
    found = [point for point in points if program.holds(point)]
    require(found, "program.rows", len(program.rows), "rows that some integer point satisfies")
    return found


def rounded(program: IntegerProgram) -> Point:
    """The feasible integer point next to the relaxed optimum.

    Plain rounding of (2.14) gives (2, 5), which violates its first row; the thesis's (2, 4) is the nearest point
    that is feasible.
    """
    x = relaxed_optimum(program)
    return min(integer_points(program), key=lambda point: (point[0] - x[0]) ** 2 + (point[1] - x[1]) ** 2)


def optimum(program: IntegerProgram) -> Point:
    """Best feasible integer point, by looking at all of them."""
    return max(integer_points(program), key=program.value)


def hull(points: list[Point]) -> list[Point]:
    """Corners of the convex hull, counterclockwise from the lowest first coordinate; points on an edge left out."""

    def half(ordered: list[Point]) -> list[Point]:
        kept: list[Point] = []
        for point in ordered:
            while len(kept) > 1 and _turn(kept[-2], kept[-1], point) <= 0:
                kept.pop()
            kept.append(point)
        return kept[:-1]

    ordered = sorted(set(points))
    return half(ordered) + half(ordered[::-1]) if len(ordered) > 2 else ordered


def _turn(a: Point, b: Point, c: Point) -> Fraction:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def facets(polygon: list[Point]) -> list[Row]:
    """The edges of a counterclockwise polygon as rows with coprime integer coefficients."""
    rows = []
    for (x1, y1), (x2, y2) in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        normal = (y2 - y1, x1 - x2)
        whole = math.lcm(*(value.denominator for value in normal))
        scale = Fraction(whole, math.gcd(*(int(value * whole) for value in normal)))
        normal = (normal[0] * scale, normal[1] * scale)
        rows.append(Row(normal, dot(normal, (x1, y1))))
    return rows


def best_cut(program: IntegerProgram) -> Cut:
    """The facet of the integer hull that cuts off the relaxed optimum and lowers the relaxed objective most.

    Raises:
        InputError: if the relaxed optimum is in the hull, or if one rounding of two rows does not give the facet.
    """
    x = relaxed_optimum(program)
    cutting = [row for row in facets(hull(integer_points(program))) if row.excess(x) > 0]
    expected = "a relaxed optimum outside the integer hull"
    require(cutting, "program", "an integer relaxed optimum", expected)

    def after(row: Row) -> Point:
        return relaxed_optimum(dataclasses.replace(program, rows=(*program.rows, row)))

    row = min(cutting, key=lambda one: program.value(after(one)))
    active = tuple(known for known in program.rows if known.excess(x) == 0)
    for pair in itertools.combinations(active, 2):
        # multipliers u with u . normals = the cut's normal
        first, second = zip(*(known.normal for known in pair), strict=True)
        u = solved(first, second, row.normal)
        right = None if u is None else dot(u, (pair[0].limit, pair[1].limit))
        if u is not None and right is not None and min(u) >= 0 and math.floor(right) == row.limit:
            return Cut(row, after(row), pair, u)
    raise InputError("program", str(row), "a facet that follows from the active rows by one rounding")
