"""HiGHS, the one importer of `highspy`: the reduced mixed-integer linear programme over the moves left free.

The problem over whole moves is V(d) = sum_i own_i(d_i) + R(d) with R convex. One binary per admissible value of a free
move makes any separable term exactly linear (for -1/0/1 these are the usual p and q with move = p - q), and cuts
of R from solved problems bound the rest from below (outer approximation, Duran and Grossmann 1986). Positions of a list
with gaps have one binary per allowed value, and of the moves within a dwell one at most is none of the binaries of zero.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import os
import threading

import highspy
import numpy as np

from jaxmpc.integer.chain import Chain
from jaxmpc.programs.compilation import say

ROUNDING = 1e-6  # by which answers of HiGHS may be off

_FIRST = threading.Lock()


def _silent_highs() -> highspy.Highs:
    """A solver that prints nothing."""
    with _FIRST:
        _swallow_greeting()
    highs = highspy.Highs()
    highs.setOptionValue("output_flag", False)
    return highs


@functools.cache
def _swallow_greeting() -> None:
    """The first solver of a process writes its version to standard output, past any option."""
    with contextlib.ExitStack() as stack, contextlib.suppress(OSError):  # standard output may be closed
        kept = os.dup(1)
        stack.callback(os.close, kept)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        stack.callback(os.close, nowhere)
        os.dup2(nowhere, 1)
        stack.callback(os.dup2, kept, 1)
        highspy.Highs()


def contradiction(claim: float, known: float, what: str) -> str:
    """Say on standard error that HiGHS claims what a known plan disproves; returns the line.

    Args:
        claim: bound that HiGHS calls proven, infinite where it finds nothing feasible.
        known: objective that disproves it.
        what: whose objective that is, such as ``a known plan``.
    """
    version = importlib.metadata.version("highspy")
    found = f"a bound of {claim:.12g}" if np.isfinite(claim) else "that nothing is feasible"
    line = f"HiGHS (highspy {version}) claims {found}, but {what} has {known:.12g}: its answer is dropped"
    say(line)
    return line


class ReducedMilp:
    """min sum own_i(d_i) + theta over the whole moves that are still free; theta is bounded below by cuts.

    Args:
        chains: hard rows.
        lower, upper: integer limits of all moves; equal limits fix a move.
        own: ``"integer value"`` separable cost, column v for the move `lower + v`.
        unit: objective values are divided by this before HiGHS sees them.
    """

    def __init__(
        self, chains: list[Chain], lower: np.ndarray, upper: np.ndarray, own: np.ndarray, unit: float
    ):
        self.lower, self.upper, self.unit = lower, upper, unit
        self.free = np.flatnonzero(upper > lower)
        self.base = float(sum(own[i, 0] for i in range(len(lower)))) / unit
        self.first_column = {}
        self.forbidden: set[bytes] = set()
        self.out_of_time = False  # whether its time limit has ended the last solve
        highs = self.highs = _silent_highs()
        for option, value in (
            ("threads", 1),
            ("mip_rel_gap", 1e-9),
            ("mip_abs_gap", 1e-10),
            ("mip_feasibility_tolerance", 1e-9),
            ("primal_feasibility_tolerance", 1e-9),
            ("dual_feasibility_tolerance", 1e-9),
        ):
            highs.setOptionValue(option, value)
        highs.addVar(-1e6, 1e9)  # theta
        highs.changeColCost(0, 1.0)
        column = 1
        for i in self.free:
            self.first_column[i] = column
            width = int(upper[i] - lower[i])
            for v in range(1, width + 1):
                highs.addVar(0.0, 1.0)
                highs.changeColIntegrality(column, highspy.HighsVarType.kInteger)
                highs.changeColCost(column, float(own[i, v] - own[i, 0]) / unit)
                column += 1
            if width > 1:
                self._row(-np.inf, 1.0, np.arange(column - width, column), np.ones(width))
        self._hard_rows(chains)
        for chain in chains:
            if chain.allowed is not None:
                self._allowed_rows(chain)
            if chain.apart is not None:
                self._dwell_rows(chain)
        self.cutoff_row = highs.getNumRow()
        costs = np.asarray(highs.getLp().col_cost_)
        index = np.flatnonzero(costs)
        self._row(-np.inf, np.inf, index, costs[index])

    def _row(self, low: float, high: float, index: np.ndarray, value: np.ndarray) -> None:
        self.highs.addRow(
            low, high, len(index), np.asarray(index, dtype=np.int32), np.asarray(value, dtype=float)
        )

    def _in_binaries(self, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Columns, values and constant of a linear form in the moves."""
        index, value = [], []
        for i in self.free:
            if coefficients[i] != 0.0:
                width = int(self.upper[i] - self.lower[i])
                index.append(self.first_column[i] + np.arange(width))
                value.append(coefficients[i] * np.arange(1, width + 1))
        constant = float(coefficients @ self.lower)
        if not index:
            return np.zeros(0, dtype=int), np.zeros(0), constant
        return np.concatenate(index), np.concatenate(value), constant

    def _hard_rows(self, chains: list[Chain]) -> None:
        for chain in chains:
            blocks = len(chain.columns)
            forms = []
            for b in range(blocks):
                form = np.zeros(blocks)
                form[: b + 1] = chain.counts[: b + 1]
                forms.append((form, chain.low[b], chain.high[b]))
                if chain.coupled[b]:
                    form = np.zeros(blocks)
                    form[b - 1], form[b] = -1.0, 1.0
                    forms.append((form, -1.0, 1.0))
            forms += list(zip(chain.windows, chain.window_low, chain.window_high, strict=True))
            for form, low, high in forms:
                wide = np.zeros(len(self.lower))
                wide[chain.columns] = form
                index, value, constant = self._in_binaries(wide)
                most = constant + np.maximum(wide * (self.upper - self.lower), 0.0).sum()
                least = constant + np.minimum(wide * (self.upper - self.lower), 0.0).sum()
                if len(index) and (most > high + 1e-9 or least < low - 1e-9):
                    self._row(low - constant, high - constant, index, value)

    def _allowed_rows(self, chain: Chain) -> None:
        """Every sample's position is one of the allowed ones."""
        assert chain.allowed is not None
        for b, count in enumerate(chain.counts):
            for sample in range(1, int(count) + 1):
                wide = np.zeros(len(self.lower))
                wide[chain.columns[:b]], wide[chain.columns[b]] = chain.counts[:b], sample
                index, value, constant = self._in_binaries(wide)
                reach = wide * (self.upper - self.lower)
                least, most = constant + np.minimum(reach, 0.0).sum(), constant + np.maximum(reach, 0.0).sum()
                among = chain.allowed[(chain.allowed >= least) & (chain.allowed <= most)].astype(float)
                if len(among) == most - least + 1:
                    continue  # nothing is left out
                first = self.highs.getNumCol()
                for _ in among:
                    self.highs.addVar(0.0, 1.0)
                    self.highs.changeColIntegrality(self.highs.getNumCol() - 1, highspy.HighsVarType.kInteger)
                place = first + np.arange(len(among))
                self._row(1.0, 1.0, place, np.ones(len(among)))
                self._row(
                    -constant, -constant, np.concatenate([index, place]), np.concatenate([value, -among])
                )

    def _dwell_rows(self, chain: Chain) -> None:
        """Of blocks within the dwell one at most moves."""
        assert chain.apart is not None
        blocks = len(chain.columns)
        moving = [self._moving(int(column)) for column in chain.columns]
        for b in range(blocks):
            near = [b, *(b + 1 + np.flatnonzero(chain.apart[b, b + 1 :]))]
            index = np.concatenate([moving[c][0] for c in near])
            value = np.concatenate([moving[c][1] for c in near])
            self._row(-np.inf, 1.0 - sum(moving[c][2] for c in near), index, value)

    def _moving(self, i: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Whether a move is none of zero, as columns, values and constant of a linear form."""
        if i not in self.first_column:
            return np.zeros(0, dtype=int), np.zeros(0), float(self.lower[i] != 0)
        columns = self.first_column[i] + np.arange(int(self.upper[i] - self.lower[i]))
        if self.lower[i] == 0:
            return columns, np.ones(len(columns)), 0.0
        if self.lower[i] < 0 <= self.upper[i]:
            return columns[-self.lower[i] - 1 : -self.lower[i]], -np.ones(1), 1.0
        return columns[:0], np.zeros(0), 1.0

    def add_cut(self, value: float, at: np.ndarray, gradient: np.ndarray) -> None:
        """Theta >= value + gradient'(d - at)."""
        index, slope, constant = self._in_binaries(gradient / self.unit)
        right = value / self.unit - gradient @ at / self.unit + constant
        self._row(float(right), np.inf, np.concatenate([[0], index]), np.concatenate([[1.0], -slope]))

    def set_cutoff(self, value: float) -> None:
        """Only moves whose own cost and theta stay below `value` are of interest from now on (infinite for all)."""
        high = value / self.unit - self.base if np.isfinite(value) else np.inf
        self.highs.changeRowBounds(self.cutoff_row, -np.inf, high)

    def forbid(self, point: np.ndarray) -> None:
        """No-good cut: at least one free move differs from `point`."""
        self.forbidden.add(point.tobytes())
        index, value, right = [], [], 1.0
        for i in self.free:
            width = int(self.upper[i] - self.lower[i])
            columns = self.first_column[i] + np.arange(width)
            chosen = int(point[i] - self.lower[i])
            if chosen == 0:  # differs when any binary is one
                index.append(columns)
                value.append(np.ones(width))
            else:
                index.append(columns[chosen - 1 : chosen])
                value.append(-np.ones(1))
                right -= 1.0
        if index:
            self._row(right, np.inf, np.concatenate(index), np.concatenate(value))
        else:
            self._row(1.0, np.inf, np.zeros(0, dtype=int), np.zeros(0))

    def solve(self, seconds: float | None) -> tuple[float, np.ndarray | None, bool]:
        """Solve the present master.

        Args:
            seconds: time limit, None for none.

        Returns:
            ``(bound, point, finished)``: a lower bound of everything not forbidden, the best whole moves (None
            if there are none below the cutoff), and whether HiGHS finished.
        """
        self.highs.setOptionValue(
            "time_limit", 1e30 if seconds is None else float(self.highs.getRunTime() + max(seconds, 1e-3))
        )
        self.highs.run()
        status, info = self.highs.getModelStatus(), self.highs.getInfo()
        self.out_of_time = status == highspy.HighsModelStatus.kTimeLimit
        if status == highspy.HighsModelStatus.kInfeasible:
            return np.inf, None, True
        finished = status == highspy.HighsModelStatus.kOptimal
        bound = info.mip_dual_bound if len(self.free) else info.objective_function_value
        if not np.isfinite(bound) or abs(bound) > 1e15:
            bound = -1e6
        # HiGHS is right to its tolerances: hand on a bound that is a little lower
        value = (self.base + bound - 1e-8 * (1.0 + abs(bound))) * self.unit
        solution = self.highs.getSolution().col_value
        point = None
        if len(solution) and info.primal_solution_status == 2:
            point = self.lower.copy()
            for i in self.free:
                width = int(self.upper[i] - self.lower[i])
                columns = np.asarray(solution[self.first_column[i] : self.first_column[i] + width])
                point[i] = self.lower[i] + int(np.round(columns @ np.arange(1, width + 1)))
        return value, point, finished


def solve_qp(
    P, c, A, row_low, row_high, low, high, *, seconds: float | None = None
) -> tuple[str, np.ndarray | None]:
    """Min x'Px/2 + c'x subject to row_low <= A x <= row_high, low <= x <= high, by the QP solver of HiGHS.

    The controllers do not use it: it fails on most of their problems. The benchmark compares with it.

    Args:
        P: Hessian, a SciPy CSC matrix ``"n n"``.
        c: linear cost.
        A: rows, a SciPy sparse matrix ``"row n"``.
        row_low, row_high, low, high: limits, infinite for none.
        seconds: time limit, None for none.

    Returns:
        ``(status, x)``: ``optimal``, ``limit``, ``infeasible`` or ``failed``, and the point where it is optimal.
    """
    highs = _silent_highs()
    if seconds is not None:
        highs.setOptionValue("time_limit", float(seconds))
    columns = A.tocsc()
    lp = highspy.HighsLp()
    lp.num_col_, lp.num_row_ = len(c), A.shape[0]
    lp.col_cost_, lp.col_lower_, lp.col_upper_ = c, low, high
    lp.row_lower_, lp.row_upper_ = row_low, row_high
    lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    lp.a_matrix_.start_, lp.a_matrix_.index_, lp.a_matrix_.value_ = (
        columns.indptr,
        columns.indices,
        columns.data,
    )
    highs.passModel(lp)
    lower = P.copy()  # HiGHS wants the lower triangle, by columns
    rows, place = P.indices, np.repeat(np.arange(len(c)), np.diff(P.indptr))
    lower.data = np.where(rows >= place, P.data, 0.0)
    lower.eliminate_zeros()
    hessian = highspy.HighsHessian()
    hessian.dim_, hessian.format_ = len(c), highspy.HessianFormat.kTriangular
    hessian.start_, hessian.index_, hessian.value_ = lower.indptr, lower.indices, lower.data
    highs.passHessian(hessian)
    highs.run()
    status = highs.getModelStatus()
    if status == highspy.HighsModelStatus.kOptimal:
        return "optimal", np.array(highs.getSolution().col_value)
    if status == highspy.HighsModelStatus.kInfeasible:
        return "infeasible", None
    return ("limit" if status == highspy.HighsModelStatus.kTimeLimit else "failed"), None


def solve_milp(
    cost: np.ndarray,
    entries: tuple[np.ndarray, np.ndarray, np.ndarray],
    row_low: np.ndarray,
    row_high: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    integer: np.ndarray,
    *,
    gap: float = 1e-9,
    seconds: float | None = None,
    known: np.ndarray | None = None,
) -> tuple[str, np.ndarray | None, float]:
    """Min cost'x subject to row_low <= A x <= row_high, low <= x <= high, x_i whole where `integer`.

    Args:
        cost: ``"n"``.
        entries: rows, columns and values of the entries of A; no place twice.
        row_low, row_high, low, high: limits, infinite for none.
        integer: ``"n"``, true for whole variables.
        gap: relative gap at which the search stops.
        seconds: time limit, None for none.
        known: a feasible point, None for none; what it disproves is not believed.

    Returns:
        ``(status, x, bound)``: ``optimal``, ``limit``, ``infeasible`` or ``failed``, which includes answers that contradict
        themselves or what is known; the best point, None without one; the proven lower bound of the cost.
    """
    highs = _silent_highs()
    for option, value in (
        ("threads", 1),
        ("mip_rel_gap", gap),
        ("mip_abs_gap", 1e-10),
        ("mip_feasibility_tolerance", 1e-9),
        ("primal_feasibility_tolerance", 1e-9),
        ("dual_feasibility_tolerance", 1e-9),
    ):
        highs.setOptionValue(option, value)
    if seconds is not None:
        highs.setOptionValue("time_limit", float(seconds))
    row, column, value = (np.asarray(part) for part in entries)
    order = np.lexsort((row, column))
    lp = highspy.HighsLp()
    lp.num_col_, lp.num_row_ = len(cost), len(row_low)
    lp.col_cost_, lp.col_lower_, lp.col_upper_ = cost, low, high
    lp.row_lower_, lp.row_upper_ = row_low, row_high
    lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    lp.a_matrix_.start_ = np.searchsorted(column[order], np.arange(len(cost) + 1)).astype(np.int32)
    lp.a_matrix_.index_, lp.a_matrix_.value_ = row[order].astype(np.int32), value[order].astype(float)
    kinds = highspy.HighsVarType
    lp.integrality_ = [kinds.kInteger if whole else kinds.kContinuous for whole in integer]
    highs.passModel(lp)
    highs.run()
    state, info = highs.getModelStatus(), highs.getInfo()
    worth = -np.inf if known is None else float(cost @ known)
    if state in (highspy.HighsModelStatus.kInfeasible, highspy.HighsModelStatus.kUnboundedOrInfeasible):
        if known is not None:
            contradiction(np.inf, worth, "a known point")
            return "failed", None, -np.inf
        return "infeasible", None, np.inf
    found = np.array(highs.getSolution().col_value) if info.primal_solution_status == 2 else None
    bound = info.mip_dual_bound if np.any(integer) else info.objective_function_value
    if found is not None:
        reached = np.bincount(row, value * found[column], minlength=len(row_low))
        slack = ROUNDING * (1.0 + np.bincount(row, np.abs(value * found[column]), minlength=len(row_low)))
        broken = (reached < row_low - slack) | (reached > row_high + slack)
        outside = (found < low - ROUNDING * (1.0 + np.abs(found))) | (
            found > high + ROUNDING * (1.0 + np.abs(found))
        )
        between = integer & (np.abs(found - np.round(found)) > ROUNDING)
        if broken.any() or outside.any() or between.any():
            contradiction(float(bound), float(cost @ found), "its own point, which breaks rows or limits,")
            return "failed", None, -np.inf
        worth, whose = (
            (worth, "a known point") if known is not None else (float(cost @ found), "its own point")
        )
        if bound > worth + ROUNDING * (1.0 + abs(worth)):
            contradiction(float(bound), worth, whose)
            return "failed", None, -np.inf
    if state == highspy.HighsModelStatus.kOptimal:
        return "optimal", found, float(bound)
    limits = (highspy.HighsModelStatus.kTimeLimit, highspy.HighsModelStatus.kIterationLimit)
    return ("limit" if state in limits else "failed"), found, float(bound)
