"""The controller's problem as other people's solvers take it: matrices with slacks, built straight from the equations.

`lifted` keeps the block moves, the CV deviations, eps and eta as variables, which makes the Hessian diagonal and the rows
sparse; `dense` eliminates the deviations, for solvers that work on dense matrices. Both have the same optimum (6.6).
"""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.sparse as sp

from studies.bench.problem import read, step_limits


@dataclasses.dataclass
class Form:
    """min z'Pz / 2 + c'z, row_low <= A z <= row_high, low <= z <= high, some z integer.

    Every variable is divided by a unit that keeps its size near one.

    Attributes:
        P: Hessian, sparse by columns ``"variable variable"``.
        c: linear cost.
        A: rows, sparse by rows ``"row variable"``.
        row_low, row_high: their limits, equal for equations.
        low, high: limits of the variables, infinite for none.
        starts: ``"block mv"``, where the moves of a plan are.
        units: of the moves, ``"mv"`` [MV unit].
        integer: ``"mv"``, whether the MV makes whole moves.
    """

    P: Any
    c: np.ndarray
    A: Any
    row_low: np.ndarray
    row_high: np.ndarray
    low: np.ndarray
    high: np.ndarray
    starts: np.ndarray
    units: np.ndarray
    integer: np.ndarray

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


@dataclasses.dataclass
class _Parts:
    """What the forms share: numbers, units, matrix of the scaled deviations, rows and limits of the moves."""

    n: SimpleNamespace
    units: np.ndarray
    size: np.ndarray
    theta: np.ndarray  # "deviation move", CV-major; moves are block-major: block 0 of every MV first
    gap: np.ndarray  # deviation without moves
    rows: Any
    row_low: np.ndarray
    row_high: np.ndarray
    low: np.ndarray
    high: np.ndarray
    weight: np.ndarray  # P per sample and block

    def per_cv(self, values) -> np.ndarray:
        """One value per penalised prediction."""
        return np.repeat(np.asarray(values, dtype=float), self.n.hp - self.n.hw + 1)


def _parts(case: dict) -> _Parts:
    n = read(case)
    units = move_units(n)
    size = cv_units(n, units)
    blocks, single = len(n.blocks), n.blocking == "inputs"
    counts = np.ones(blocks) if single else np.array(n.blocks, dtype=float)
    spread = np.zeros((n.hu, blocks))  # block moves to sample moves (6.3)
    for b, (start, length) in enumerate(zip(n.starts, n.blocks, strict=True)):
        spread[start : start + (1 if single else length), b] = 1.0
    lag = np.arange(n.hw, n.hp + 1)[:, None] - np.arange(n.hu)[None, :]  # S(j - k) of the move at k
    theta = np.zeros((n.cvs, len(lag), blocks, n.mvs))
    for c, m in np.ndindex(n.cvs, n.mvs):
        delayed = np.where(lag > 0, n.S[c, m][np.maximum(lag - 1, 0)], 0.0)
        theta[c, :, :, m] = delayed @ spread * units[m] / size[c]
    gap = ((n.free - n.r)[n.hw - 1 :] / size).T.reshape(-1)

    low, high = np.zeros((blocks, n.mvs)), np.zeros((blocks, n.mvs))
    rows, row_low, row_high = [], [], []

    def row(m, form, lower, upper):
        if math.isfinite(lower) or math.isfinite(upper):
            wide = np.zeros((blocks, n.mvs))
            wide[:, m] = form
            rows.append(wide.ravel())
            row_low.append(lower)
            row_high.append(upper)

    for m in range(n.mvs):
        if n.step[m]:
            dlo, dhi, plo, phi = step_limits(n, m)
        else:
            dlo, dhi = n.dlo[m] / units[m], n.dhi[m] / units[m]
            plo, phi = (min(0.0, (n.ulo[m] - n.u0[m]) / units[m]), max(0.0, (n.uhi[m] - n.u0[m]) / units[m]))
        low[:, m], high[:, m] = dlo, dhi  # (5.5a)
        low[0, m] = max(low[0, m], n.first_low[m] / units[m])
        high[0, m] = min(high[0, m], n.first_high[m] / units[m])
        for b in range(blocks):  # the ends of a block bound what lies between them
            row(m, np.where(np.arange(blocks) <= b, counts, 0.0), plo, phi)
        if n.oscillation[m]:  # (6.16)
            past = round(n.last[m] / n.step[m])
            low[0, m], high[0, m] = max(low[0, m], past - 1.0), min(high[0, m], past + 1.0)
            for b in range(1, blocks):
                if single and n.blocks[b - 1] > 1:  # a zero move lies between
                    low[b - 1, m], high[b - 1, m] = max(low[b - 1, m], -1.0), min(high[b - 1, m], 1.0)
                    low[b, m], high[b, m] = max(low[b, m], -1.0), min(high[b, m], 1.0)
                else:
                    row(m, np.eye(blocks)[b] - np.eye(blocks)[b - 1], -1.0, 1.0)
            if single and n.blocks[-1] > 1:
                low[-1, m], high[-1, m] = max(low[-1, m], -1.0), min(high[-1, m], 1.0)
    return _Parts(
        n,
        units,
        size,
        theta.reshape(-1, blocks * n.mvs),
        gap,
        sp.csr_matrix(np.array(rows).reshape(-1, blocks * n.mvs)),
        np.array(row_low),
        np.array(row_high),
        low.ravel(),
        high.ravel(),
        (counts[:, None] * n.P * units**2).ravel(),
    )


def _limit_rows(parts: _Parts) -> tuple[np.ndarray, np.ndarray, sp.csr_matrix]:
    """Scaled CV limits (high, low) as deviations, and which eps each prediction belongs to."""
    n, horizon = parts.n, parts.n.hp - parts.n.hw + 1
    priced = n.rho > 0  # a slack without price is as good as no limit
    r = n.r[n.hw - 1 :]
    high = np.where(priced, (n.yhi - r) / parts.size, np.inf).T.reshape(-1)
    low = np.where(priced, (n.ylo - r) / parts.size, -np.inf).T.reshape(-1)
    member = sp.csr_matrix(sp.kron(sp.identity(n.cvs), np.ones((horizon, 1))))
    return high, low, member


def _zeros(rows: int, columns: int) -> sp.csr_matrix:
    return sp.csr_matrix((rows, columns))


def lifted(case: dict) -> Form:
    """Variables: block moves, deviations e = y - r, eps high, eps low, eta; diagonal Hessian."""
    p = _parts(case)
    n, k, d, cvs = p.n, p.theta.shape[1], len(p.gap), p.n.cvs
    limit_high, limit_low, member = _limit_rows(p)
    one, soft = sp.identity(d), p.per_cv((n.S2 + n.S1) > 0) > 0
    none = _zeros(d, cvs)
    never = np.full(d, np.inf)
    edge = np.where(soft, p.per_cv(n.c / p.size), np.inf)
    rows = [
        ([-sp.csr_matrix(p.theta), one, none, none, _zeros(d, d)], p.gap, p.gap),  # (5.4c)
        ([_zeros(d, k), one, -member, none, _zeros(d, d)], -never, limit_high),  # (5.5b)
        ([_zeros(d, k), one, none, member, _zeros(d, d)], limit_low, never),
        ([_zeros(d, k), one, none, none, -one], -never, edge),  # (6.12a)
        ([_zeros(d, k), one, none, none, one], -edge, never),  # (6.12b)
        (
            [p.rows, _zeros(p.rows.shape[0], 2 * (d + cvs))],
            p.row_low,
            p.row_high,
        ),
    ]
    size2 = p.size**2
    diagonal = 2.0 * np.concatenate(
        [p.weight, p.per_cv(n.Q * size2), np.zeros(2 * cvs), p.per_cv(n.S2 * size2)]
    )
    price = n.rho * p.size
    linear = np.concatenate([np.zeros(k + d), price, price, p.per_cv(n.S1 * p.size)])
    eps_high = np.where(np.isfinite(n.yhi) & (n.rho > 0), np.inf, 0.0)
    eps_low = np.where(np.isfinite(n.ylo) & (n.rho > 0), np.inf, 0.0)
    low = np.concatenate([p.low, np.full(d, -np.inf), np.zeros(2 * cvs + d)])
    high = np.concatenate([p.high, np.full(d, np.inf), eps_high, eps_low, np.where(soft, np.inf, 0.0)])
    A: Any = sp.csr_matrix(sp.vstack([sp.hstack(blocks) for blocks, _, _ in rows]))
    row_low, row_high = (np.concatenate([entry[i] for entry in rows]) for i in (1, 2))
    keep = np.isfinite(row_low) | np.isfinite(row_high)
    return Form(
        P=sp.csc_matrix(sp.diags(diagonal)),
        c=linear,
        A=sp.csr_matrix(A[keep]),
        row_low=row_low[keep],
        row_high=row_high[keep],
        low=low,
        high=high,
        starts=np.arange(k).reshape(len(n.blocks), n.mvs),
        units=p.units,
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
    hessian = form.P[keep][:, keep].tolil()
    hessian[:k, :k] += (theta.T @ sp.diags(weight) @ theta).toarray()
    linear = form.c[keep].copy()
    linear[:k] += theta.T @ (weight * gap)
    A = sp.csr_matrix(rest[:, keep] + sp.hstack([deviation @ theta, _zeros(rest.shape[0], len(keep) - k)]))
    moved = deviation @ gap
    return Form(
        sp.csc_matrix(hessian),
        linear,
        A,
        form.row_low[d:] - moved,
        form.row_high[d:] - moved,
        form.low[keep],
        form.high[keep],
        form.starts,
        form.units,
        form.integer,
    )


def rows_of(form: Form, boxes: bool = False):
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
    if one is None or one.A.shape != other.A.shape or one.P.nnz != other.P.nnz:
        return False
    kinds = [
        np.r_[
            f.low == f.high, f.row_low == f.row_high, np.isfinite([*f.low, *f.high, *f.row_low, *f.row_high])
        ]
        for f in (one, other)
    ]
    return (
        np.array_equal(*kinds)
        and np.array_equal(one.A.indices, other.A.indices)
        and np.array_equal(one.A.data, other.A.data)
        and np.array_equal(one.P.data, other.P.data)
    )


@dataclasses.dataclass
class Binaries:
    """Integers written as their lower limit plus binaries: z = back @ x + base."""

    back: sp.csr_matrix
    base: np.ndarray
    binary: np.ndarray


def binaries_of(form: Form) -> tuple[Form, Binaries | None]:
    """The form with every integer as a sum of binaries; untouched where there are none."""
    if not len(form.integers):
        return form, None
    count = len(form.c)
    owner: list[int] = []
    base = np.zeros(count)
    for i in form.integers:
        base[i] = form.low[i]
        owner += [int(i)] * int(form.high[i] - form.low[i])
    kept = np.setdiff1d(np.arange(count), form.integers)
    back = sp.csr_matrix(
        (
            np.ones(len(kept) + len(owner)),
            (np.r_[kept, np.array(owner, dtype=int)], np.arange(len(kept) + len(owner))),
        ),
        shape=(count, len(kept) + len(owner)),
    )
    moved = form.A @ base
    return dataclasses.replace(
        form,
        P=sp.csc_matrix(back.T @ form.P @ back),
        c=back.T @ (form.c + form.P @ base),
        A=sp.csr_matrix(form.A @ back),
        row_low=form.row_low - moved,
        row_high=form.row_high - moved,
        low=np.r_[form.low[kept], np.zeros(len(owner))],
        high=np.r_[form.high[kept], np.ones(len(owner))],
    ), Binaries(back, base, len(kept) + np.arange(len(owner)))
