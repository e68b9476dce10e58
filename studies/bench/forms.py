"""The controller's problem as other people's solvers take it: matrices with slacks, built straight from the equations.

`lifted` keeps the block moves, the CV deviations, eps and eta as variables, which makes the Hessian diagonal and the rows
sparse; `dense` eliminates the deviations, for solvers that work on dense matrices. Both have the same optimum (6.6).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.sparse as sp

from jaxmpc.check import require
from studies.bench.problem import read, step_limits


@dataclasses.dataclass
class Form:
    """min z'Pz / 2 + c'z, row_low <= A z <= row_high, low <= z <= high, some z integer.

    Every variable is divided by a unit that keeps its size near one.
    """

    P: Any  # Hessian, sparse by columns "variable variable"
    c: np.ndarray  # linear cost
    A: Any  # rows, sparse by rows "row variable"
    row_low: np.ndarray  # their limits, equal for equations
    row_high: np.ndarray
    low: np.ndarray  # limits of the variables, infinite for none
    high: np.ndarray
    starts: np.ndarray  # "block mv", where the moves of a plan are
    units: np.ndarray  # of the moves, "mv" [MV unit]
    integer: np.ndarray  # "mv", whether the MV makes whole moves

    def scaled(self) -> Form:
        """The same problem with its cost divided by the largest entry of P, for solvers with absolute tolerances."""
        unit = np.abs(self.P.data).max() or 1.0
        return dataclasses.replace(self, P=self.P / unit, c=self.c / unit)

    @property
    def integers(self) -> np.ndarray:
        """Positions of the integer variables."""
        return self.starts[:, self.integer].ravel()

    def moves(self, z) -> np.ndarray:
        """The plan "block mv" in MV units."""
        return np.asarray(z)[self.starts] * self.units


def move_units(n: SimpleNamespace) -> np.ndarray:
    """A size for the moves of every MV: the step, the move limit, the range, or what reaches the setpoint."""
    units = np.ones(n.mvs)
    away = np.abs(n.free - n.r).max(axis=0) + n.c
    for m in range(n.mvs):
        limits = [abs(x) for x in (n.dlo[m], n.dhi[m], n.uhi[m] - n.ulo[m]) if math.isfinite(x) and x]
        gains = np.abs(n.S[:, m]).max(axis=1)
        reach = [d / g for d, g in zip(away, gains, strict=True) if d * g > 0]  # where nothing limits the MV
        units[m] = n.step[m] or (max(limits[:2]) if limits else min(reach, default=1.0))
    return units


def cv_units(n: SimpleNamespace, units: np.ndarray) -> np.ndarray:
    """A size for every CV: the largest response to a unit move."""
    size = np.einsum("cmj,m->cmj", np.abs(n.S), units).max(axis=(1, 2))
    size[size == 0] = 1.0
    return size


def _deviations(n: SimpleNamespace, units: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrix of the scaled deviations ``"deviation move"`` and the deviations without moves; CV-major, block-major."""
    spread = np.zeros((n.hu, len(n.blocks)))  # block moves to sample moves (6.3)
    for b, (start, length) in enumerate(zip(n.starts, n.blocks, strict=True)):
        spread[start : start + (1 if n.blocking == "inputs" else length), b] = 1.0
    lag = np.arange(n.hw, n.hp + 1)[:, None] - np.arange(n.hu)[None, :]  # S(j - k) of the move at k
    delayed = np.where(lag > 0, n.S[:, :, np.maximum(lag - 1, 0)], 0.0)
    theta = (delayed @ spread).transpose(0, 2, 3, 1) * units / size[:, None, None, None]
    gap = ((n.free - n.r)[n.hw - 1 :] / size).T.reshape(-1)
    return theta.reshape(len(gap), -1), gap


def _moves(n: SimpleNamespace, units: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, ...]:
    """Limits of the scaled moves ``"block mv"``, low and high, and rows over them ``"row move"`` with theirs."""
    blocks = len(n.blocks)
    low, high = np.zeros((blocks, n.mvs)), np.zeros((blocks, n.mvs))
    held = [n.blocking == "inputs" and length > 1 for length in n.blocks]  # zero moves follow in the block
    rows, row_low, row_high = [], [], []

    def row(m: int, form: np.ndarray, lower: float, upper: float) -> None:
        rows.append(np.outer(form, np.arange(n.mvs) == m).ravel())
        row_low.append(lower)
        row_high.append(upper)

    def within(b: int, m: int, lower: float, upper: float) -> None:
        low[b, m], high[b, m] = max(low[b, m], lower), min(high[b, m], upper)

    for m in range(n.mvs):
        if n.step[m]:
            dlo, dhi, plo, phi = step_limits(n, m)
        else:
            dlo, dhi = n.dlo[m] / units[m], n.dhi[m] / units[m]
            plo, phi = (min(0.0, (n.ulo[m] - n.u0[m]) / units[m]), max(0.0, (n.uhi[m] - n.u0[m]) / units[m]))
        low[:, m], high[:, m] = dlo, dhi  # (5.5a)
        within(0, m, n.first_low[m] / units[m], n.first_high[m] / units[m])
        for b in range(blocks):  # the ends of a block bound what lies between them
            row(m, np.where(np.arange(blocks) <= b, counts, 0.0), plo, phi)
        if not n.oscillation[m]:
            continue
        past = round(n.last[m] / n.step[m])  # (6.16)
        within(0, m, past - 1.0, past + 1.0)
        for b in range(blocks):
            if held[b] or (b and held[b - 1]):  # a zero move lies between
                within(b, m, -1.0, 1.0)
            if b and not held[b - 1]:
                row(m, np.eye(blocks)[b] - np.eye(blocks)[b - 1], -1.0, 1.0)
    return low, high, np.array(rows), np.array(row_low), np.array(row_high)


def lifted(case: dict) -> Form:
    """Variables: block moves, deviations e = y - r, eps high, eps low, eta; diagonal Hessian."""
    n = read(case)
    whole = zip(n.lists, n.step, n.whole, strict=True)
    plain = all(own == n.lists[0] and (not step or count == len(own)) for own, step, count in whole)
    require(
        plain, "structure", case["structure"], "one list of blocks and no integer_horizon for other solvers"
    )
    for key in ("integer_values", "dwell"):
        given = case["structure"].get(key)
        require(
            not given, f"structure.{key}", given, "none for other solvers, whose forms have no rows for it"
        )
    require(
        not n.W.any(),
        "tuning.ideal_weight",
        n.W.tolist(),
        "none for other solvers, whose forms have no cost for it",
    )
    units = move_units(n)
    size = cv_units(n, units)
    counts = np.ones(len(n.blocks)) if n.blocking == "inputs" else np.array(n.blocks, dtype=float)
    theta, gap = _deviations(n, units, size)
    move_low, move_high, move_rows, position_low, position_high = _moves(n, units, counts)
    (d, k), horizon = theta.shape, n.hp - n.hw + 1

    def each(values: np.ndarray) -> np.ndarray:
        """One value per penalised prediction."""
        return np.repeat(values.astype(float), horizon)

    priced, setpoint = n.rho > 0, n.r[n.hw - 1 :]  # a slack without price is as good as no limit
    limit_high = np.where(priced, (n.yhi - setpoint) / size, np.inf).T.ravel()
    limit_low = np.where(priced, (n.ylo - setpoint) / size, -np.inf).T.ravel()
    member = np.repeat(np.eye(n.cvs), horizon, axis=0)
    one, soft, never = sp.identity(d), each((n.S2 + n.S1) > 0) > 0, np.full(d, np.inf)
    edge = np.where(soft, each(n.c / size), np.inf)
    A: Any = sp.bmat(
        [
            [-theta, one, None, None, None],  # (5.4c)
            [None, one, -member, None, None],  # (5.5b)
            [None, one, None, member, None],
            [None, one, None, None, -one],  # (6.12a)
            [None, one, None, None, one],  # (6.12b)
            [move_rows, None, None, None, None],
        ],
        format="csr",
    )
    row_low = np.concatenate([gap, -never, limit_low, -never, -edge, position_low])
    row_high = np.concatenate([gap, limit_high, never, edge, never, position_high])
    keep = np.isfinite(row_low) | np.isfinite(row_high)
    weights = (
        (counts[:, None] * n.P * units**2).ravel(),
        each(n.Q * size**2),
        np.zeros(2 * n.cvs),
        each(n.S2 * size**2),
    )
    price, none = n.rho * size, np.zeros(n.cvs)
    upper = [np.where(np.isfinite(limit) & priced, np.inf, 0.0) for limit in (n.yhi, n.ylo)]
    return Form(
        P=sp.csc_matrix(sp.diags(2.0 * np.concatenate(weights))),
        c=np.concatenate([np.zeros(k + d), price, price, each(n.S1 * size)]),
        A=A[keep],
        row_low=row_low[keep],
        row_high=row_high[keep],
        low=np.concatenate([move_low.ravel(), -never, none, none, np.zeros(d)]),
        high=np.concatenate([move_high.ravel(), never, *upper, np.where(soft, np.inf, 0.0)]),
        starts=np.arange(k).reshape(len(n.blocks), n.mvs),
        units=units,
        integer=np.array([step is not None for step in n.step]),
    )


def dense(case: dict) -> Form:
    """Variables: block moves, eps high, eps low, eta; the tracking cost is a dense block over the moves."""
    form = lifted(case)
    k = form.starts.size
    d = int((form.row_low == form.row_high).sum())  # the deviations come first among the rows
    theta, gap = -form.A[:d, :k], form.row_low[:d]
    keep = np.r_[np.arange(k), np.arange(k + d, len(form.c))]
    rest, deviation = form.A[d:], form.A[d:, k : k + d]
    weight = form.P.diagonal()[k : k + d]
    hessian, linear, rows = form.P[keep][:, keep].tolil(), form.c[keep], rest[:, keep].tolil()
    hessian[:k, :k] += (theta.T @ sp.diags(weight) @ theta).toarray()
    linear[:k] += theta.T @ (weight * gap)
    rows[:, :k] += (deviation @ theta).toarray()
    moved = deviation @ gap
    return dataclasses.replace(
        form,
        P=sp.csc_matrix(hessian),
        c=linear,
        A=sp.csr_matrix(rows),
        row_low=form.row_low[d:] - moved,
        row_high=form.row_high[d:] - moved,
        low=form.low[keep],
        high=form.high[keep],
    )


def rows_of(form: Form, boxes: bool = False) -> tuple[Any, np.ndarray, Any, np.ndarray, np.ndarray]:
    """Equations (A, b) and inequalities (G, l, u); with `boxes` the limits of the variables are among them."""
    A, low, high = form.A, form.row_low, form.row_high
    if boxes:
        A: Any = sp.vstack([A, sp.identity(len(form.c), format="csr")], format="csr")
        low, high = np.r_[low, form.low], np.r_[high, form.high]
    same = low == high
    free = ~same & (np.isfinite(low) | np.isfinite(high))
    return A[same], low[same], A[free], low[free], high[free]


def same_matrices(one: Form | None, other: Form) -> bool:
    """Whether only vectors differ, so that a solver may keep what it made of the matrices."""

    def matrices(form: Form) -> list[np.ndarray]:
        limits = np.r_[form.low, form.high, form.row_low, form.row_high]
        fixed = form.low == form.high, form.row_low == form.row_high
        return [form.A.indices, form.A.data, form.P.data, *fixed, np.isfinite(limits)]

    if one is None or one.A.shape != other.A.shape:
        return False
    return all(np.array_equal(a, b) for a, b in zip(matrices(one), matrices(other), strict=True))


def binaries_of(form: Form) -> tuple[Form, np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """The form with every integer as its lower limit plus binaries, their positions, and the way back to its variables."""
    base = np.zeros(len(form.c))
    base[form.integers] = form.low[form.integers]
    ranges = (form.high - form.low)[form.integers].astype(int)
    kept = np.setdiff1d(np.arange(len(form.c)), form.integers)
    owner = np.r_[kept, np.repeat(form.integers, ranges)]  # of every new variable
    back = sp.csr_matrix((np.ones(len(owner)), (owner, np.arange(len(owner)))), (len(form.c), len(owner)))
    binary, moved = np.arange(len(kept), len(owner)), form.A @ base
    changed = dataclasses.replace(
        form,
        P=sp.csc_matrix(back.T @ form.P @ back),
        c=back.T @ (form.c + form.P @ base),
        A=sp.csr_matrix(form.A @ back),
        row_low=form.row_low - moved,
        row_high=form.row_high - moved,
        low=np.r_[form.low[kept], np.zeros(len(binary))],
        high=np.r_[form.high[kept], np.ones(len(binary))],
    )
    return changed, binary, lambda z: back @ z + base
