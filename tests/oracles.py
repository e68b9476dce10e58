"""Independent answers to one controller step, written straight from the equations (thesis 5.1-5.2, 6.1-6.5).

Nothing here is shared with the library: a case is read as the plain content of its JSON file, predictions
are superposed sample by sample, and the optimisation problem is the *full* form (5.6) with every sample's
move, MV and CV as a variable. `objective` and `violation` judge a given plan; `solve_qp`, `solve_scip` and
`brute_force` find plans with other people's solvers. What they are good for stands beside the functions.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from types import SimpleNamespace

import numpy as np
import scipy.sparse as sp

STEP_ROUNDING = 1e-6  # [steps]: a limit so close to a whole number of steps counts as that number


def read(case: dict) -> SimpleNamespace:
    """The numbers of a case file: arrays instead of lists, infinities instead of None, S continued to Hp."""
    model, structure, tuning = case["model"], case["structure"], case["tuning"]
    n = SimpleNamespace(cvs=len(model["cv"]), mvs=len(model["mv"]))
    n.hp, n.hu, n.hw = (
        structure[key] for key in ("prediction_horizon", "control_horizon", "first_penalised")
    )
    n.blocks = list(structure.get("blocks") or [1] * n.hu)
    n.starts = [0, *itertools.accumulate(n.blocks)][:-1]
    n.blocking = structure["blocking"]
    n.step = [structure.get("integer_step", {}).get(name) for name in model["mv"]]
    n.oscillation = [bool(tuning.get("oscillation_rows", {}).get(name)) for name in model["mv"]]
    n.S = np.zeros((n.cvs, n.mvs, n.hp))
    for c, m, j in np.ndindex(n.S.shape):
        response = model["coefficients"][c][m]
        n.S[c, m, j] = response[min(j, len(response) - 1)]
    n.Q, n.P, n.S2, n.S1, n.c, n.rho = (
        np.array(tuning[key], dtype=float)
        for key in (
            "cv_weight",
            "move_weight",
            "soft_quadratic",
            "soft_linear",
            "deadzone",
            "slack_weight",
        )
    )
    for name, key, missing in (
        ("ylo", "cv_low", -np.inf),
        ("yhi", "cv_high", np.inf),
        ("ulo", "mv_low", -np.inf),
        ("uhi", "mv_high", np.inf),
        ("dlo", "move_low", -np.inf),
        ("dhi", "move_high", np.inf),
    ):
        setattr(n, name, np.array([missing if v is None else v for v in tuning[key]], dtype=float))
    n.u0, n.last = np.array(case["mv_now"], dtype=float), np.array(case["last_move"], dtype=float)
    n.free, n.r = np.array(case["free_response"], dtype=float), np.array(case["setpoint"], dtype=float)
    return n


def sample_moves(case: dict, moves) -> np.ndarray:
    """The move of every sample, "sample mv", of a plan "block mv"."""
    n, moves = read(case), np.asarray(moves, dtype=float)
    du = np.zeros((n.hu, n.mvs))
    for b, (start, length) in enumerate(zip(n.starts, n.blocks, strict=True)):
        if n.blocking == "moves":
            du[start : start + length] = moves[b]
        else:
            du[start] = moves[b]
    return du


def predict(case: dict, moves) -> np.ndarray:
    """The CVs at j = 1..Hp, "horizon cv": the free response plus one step response per move, (2.30)."""
    n, du = read(case), sample_moves(case, moves)
    y = n.free.copy()
    for k in range(min(n.hu, n.hp)):
        y[k:] += np.einsum("cmj,m->jc", n.S[:, :, : n.hp - k], du[k])
    return y


def objective(case: dict, moves) -> float:
    """The cost (6.6) of a plan, constants included, with the slacks at their smallest values."""
    n, y = read(case), predict(case, moves)
    e = (y - n.r)[n.hw - 1 :]
    eta = np.maximum(0.0, np.abs(e) - n.c)
    above = np.maximum(0.0, (y - n.yhi)[n.hw - 1 :].max(axis=0))
    below = np.maximum(0.0, (n.ylo - y)[n.hw - 1 :].max(axis=0))
    du = sample_moves(case, moves)
    return float(
        (n.Q * e**2).sum()
        + (n.P * du**2).sum()
        + (n.S2 * eta**2 + n.S1 * eta).sum()
        + (n.rho * (above + below)).sum()
    )


def violation(case: dict, moves) -> float:
    """The largest violation of the hard constraints of a plan, 0 when there is none.

    Limits of moves and MVs count relative to max(1, |limit|), integrality and oscillation in steps. An MV
    that starts outside its limit by rounding widens the limit to where it is.
    """
    n, moves = read(case), np.asarray(moves, dtype=float)
    if not np.isfinite(moves).all():
        return math.inf
    du = sample_moves(case, moves)
    u = n.u0 + np.cumsum(du, axis=0)
    worst = 0.0
    for m in range(n.mvs):
        low, high = min(n.ulo[m], n.u0[m]), max(n.uhi[m], n.u0[m])
        for values, limit, sign in (
            (du[:, m], n.dhi[m], 1),
            (du[:, m], n.dlo[m], -1),
            (u[:, m], high, 1),
            (u[:, m], low, -1),
        ):
            if math.isfinite(limit):
                worst = max(worst, (sign * (values - limit)).max() / max(1.0, abs(limit)))
        if n.step[m]:
            d = du[:, m] / n.step[m]
            worst = max(worst, np.abs(d - np.round(d)).max())
            if n.oscillation[m]:  # (6.16), the past move rounded to whole steps
                past = round(n.last[m] / n.step[m])
                worst = max(worst, np.abs(np.diff(d, prepend=past)).max() - 1.0)
    return float(worst)


@dataclasses.dataclass
class Answer:
    """What an oracle found: `objective` is judged by `objective()`, `bound` is the solver's own."""

    status: str  # optimal, infeasible, limit, failed
    objective: float = math.inf
    bound: float = -math.inf
    moves: np.ndarray | None = None


# ------------------------------------------------------------------------------------ hard constraints alone


def step_limits(n: SimpleNamespace, m: int) -> tuple[float, float, float, float]:
    """Move and position limits of an integer MV in whole steps from where it is."""
    step, up, down = n.step[m], math.floor, math.ceil

    def whole(x, rounding, slack):
        return rounding(x + slack) if math.isfinite(x) else x

    return (
        whole(n.dlo[m] / step, down, -STEP_ROUNDING),
        whole(n.dhi[m] / step, up, STEP_ROUNDING),
        min(0, whole((n.ulo[m] - n.u0[m]) / step, down, -STEP_ROUNDING)),
        max(0, whole((n.uhi[m] - n.u0[m]) / step, up, STEP_ROUNDING)),
    )


def integer_plans(
    case: dict, m: int, largest: float = math.inf, most: int = 200_000
) -> list[tuple[int, ...]]:
    """All plans of one integer MV, in steps per block, that meet its hard constraints at every sample.

    `largest` bounds the steps of one move where no limit does.
    """
    n = read(case)
    dlo, dhi, plo, phi = step_limits(n, m)
    plans: list[tuple[int, ...]] = []

    def extend(plan, position, previous):
        b = len(plan)
        if b == len(n.blocks):
            plans.append(tuple(plan))
            if len(plans) > most:
                raise OverflowError(f"more than {most} integer plans")
            return
        length = n.blocks[b]
        low, high = max(dlo, plo - position, -largest), min(dhi, phi - position, largest)
        if not (math.isfinite(low) and math.isfinite(high)):
            raise ValueError("an integer MV without any limit needs `largest`")
        for d in range(int(low), int(high) + 1):
            inside = [d] * length if n.blocking == "moves" else [d] + [0] * (length - 1)
            where, past, fine = position, previous, True
            for move in inside:
                where += move
                fine &= dlo <= move <= dhi and plo <= where <= phi
                fine &= not n.oscillation[m] or abs(move - past) <= 1
                past = move
            if fine:
                extend([*plan, d], where, past)

    extend([], 0, round(n.last[m] / n.step[m]))
    return plans


def hard_feasible(case: dict) -> bool:
    """Whether any plan meets the hard constraints; they never couple two MVs, so each is asked alone."""
    n = read(case)
    for m in range(n.mvs):
        if n.step[m]:
            # Reachable (position, last move) pairs; moves beyond `cap` lead nowhere that smaller ones do not.
            dlo, dhi, plo, phi = step_limits(n, m)
            past = round(n.last[m] / n.step[m])
            cap = max([abs(x) for x in (dlo, dhi) if math.isfinite(x)] + [abs(past)]) + 2
            states = {(0, past)}
            for length in n.blocks:
                reached = set()
                for position, previous in states:
                    for d in range(int(max(dlo, -cap)), int(min(dhi, cap)) + 1):
                        if n.oscillation[m] and abs(d - previous) > 1:
                            continue
                        held = length > 1 and n.blocking == "inputs"
                        if held and (not dlo <= 0 <= dhi or (n.oscillation[m] and abs(d) > 1)):
                            continue
                        end = position + (d if n.blocking == "inputs" else d * length)
                        if plo <= end <= phi:
                            reached.add((end, 0 if held else d))
                states = reached
            if not states:
                return False
        else:
            low, high = min(n.ulo[m], n.u0[m]), max(n.uhi[m], n.u0[m])
            near, far = n.u0[m], n.u0[m]  # the interval of reachable positions
            for length in n.blocks:
                if n.blocking == "inputs" and length > 1 and not n.dlo[m] <= 0 <= n.dhi[m]:
                    return False
                count = 1 if n.blocking == "inputs" else length
                near, far = max(low, near + count * n.dlo[m]), min(high, far + count * n.dhi[m])
                if near > far + 1e-9 * max(1.0, abs(far)):
                    return False
    return True


# --------------------------------------------------------------------------------------------- the full form


@dataclasses.dataclass
class FullForm:
    """min z'diag(q)z + c'z, row_low <= A z <= row_high, low <= z <= high, some z integer.

    Variables: moves, MV changes since now, CV deviations from the setpoint, eps, eta; each divided by a unit
    that keeps its size near one. Deviations instead of values keep the cost free of cancellation.
    """

    q: np.ndarray
    c: np.ndarray
    A: sp.csr_matrix
    row_low: np.ndarray
    row_high: np.ndarray
    low: np.ndarray
    high: np.ndarray
    starts: np.ndarray  # "block mv", where the moves of a plan are
    units: np.ndarray  # of the moves, "mv"
    integer: np.ndarray  # "mv"

    @property
    def integers(self) -> np.ndarray:
        """Positions of the integer variables."""
        return self.starts[:, self.integer].ravel()

    def moves(self, z) -> np.ndarray:
        """The plan "block mv" in MV units."""
        return np.asarray(z)[self.starts] * self.units


def full_form(case: dict) -> FullForm:
    """The problem (5.6) with Soft MPC (6.12), blocks (6.2), whole steps (6.1), oscillation rows (6.16)."""
    n = read(case)
    horizon = n.hp - n.hw + 1
    units = np.ones(n.mvs)
    away = np.abs(n.free - n.r).max(axis=0) + n.c
    for m in range(n.mvs):
        limits = [abs(x) for x in (n.dlo[m], n.dhi[m], n.uhi[m] - n.ulo[m]) if math.isfinite(x) and x]
        gains = np.abs(n.S[:, m]).max(axis=1)
        reach = [d / g for d, g in zip(away, gains, strict=True) if d * g > 0]  # where nothing limits the MV
        units[m] = n.step[m] or (max(limits[:2]) if limits else min(reach, default=1.0))
    size = np.einsum("cmj,m->cmj", np.abs(n.S), units).max(axis=(1, 2))
    size[size == 0] = 1.0

    count = itertools.count()

    def block(*shape):
        return np.array([next(count) for _ in range(math.prod(shape))], dtype=int).reshape(shape)

    du, u, e = block(n.hu, n.mvs), block(n.hu, n.mvs), block(horizon, n.cvs)
    eps_high, eps_low, eta = block(n.cvs), block(n.cvs), block(horizon, n.cvs)
    total = next(count)
    q, c = np.zeros(total), np.zeros(total)
    low, high = np.full(total, -np.inf), np.full(total, np.inf)
    rows: list[dict[int, float]] = []
    row_low: list[float] = []
    row_high: list[float] = []

    def row(entries, lower, upper):
        if math.isfinite(lower) or math.isfinite(upper):
            rows.append({int(k): float(v) for k, v in entries})
            row_low.append(lower)
            row_high.append(upper)

    for m in range(n.mvs):
        if n.step[m]:
            dlo, dhi, plo, phi = step_limits(n, m)
        else:
            dlo, dhi = n.dlo[m] / units[m], n.dhi[m] / units[m]
            plo = min(0.0, (n.ulo[m] - n.u0[m]) / units[m])
            phi = max(0.0, (n.uhi[m] - n.u0[m]) / units[m])
        for k in range(n.hu):
            q[du[k, m]] = n.P[m] * units[m] ** 2
            low[du[k, m]], high[du[k, m]] = dlo, dhi  # (5.5a)
            low[u[k, m]], high[u[k, m]] = plo, phi
            before = [(u[k - 1, m], -1.0)] if k else []
            row([(u[k, m], 1.0), *before, (du[k, m], -1.0)], 0.0, 0.0)  # (5.4f)
            if n.oscillation[m]:  # (6.16)
                if k:
                    row([(du[k, m], 1.0), (du[k - 1, m], -1.0)], -1.0, 1.0)
                else:
                    past = round(n.last[m] / n.step[m])
                    row([(du[0, m], 1.0)], past - 1.0, past + 1.0)
        for start, length in zip(n.starts, n.blocks, strict=True):  # (6.3)
            for k in range(start + 1, start + length):
                same = [(du[start, m], -1.0)] if n.blocking == "moves" else []
                row([(du[k, m], 1.0), *same], 0.0, 0.0)
    for i in range(n.cvs):
        w = size[i]
        low[eps_high[i]] = low[eps_low[i]] = 0.0
        c[eps_high[i]] = c[eps_low[i]] = n.rho[i] * w
        for h in range(horizon):
            j = n.hw + h  # the sample that this row predicts
            q[e[h, i]] = n.Q[i] * w**2
            q[eta[h, i]], c[eta[h, i]], low[eta[h, i]] = n.S2[i] * w**2, n.S1[i] * w, 0.0
            forced = [
                (du[k, m], -n.S[i, m, j - 1 - k] * units[m] / w)
                for m in range(n.mvs)
                for k in range(min(j, n.hu))
            ]
            gap = (n.free[j - 1, i] - n.r[j - 1, i]) / w
            row([(e[h, i], 1.0), *forced], gap, gap)  # (5.4c)
            if n.rho[i]:  # a slack without price is as good as no limit
                row(
                    [(e[h, i], 1.0), (eps_high[i], -1.0)],
                    -math.inf,
                    (n.yhi[i] - n.r[j - 1, i]) / w,
                )  # (5.5b)
                row([(e[h, i], 1.0), (eps_low[i], 1.0)], (n.ylo[i] - n.r[j - 1, i]) / w, math.inf)
            if n.S2[i] or n.S1[i]:
                row([(e[h, i], 1.0), (eta[h, i], -1.0)], -math.inf, n.c[i] / w)  # (6.12a)
                row([(e[h, i], 1.0), (eta[h, i], 1.0)], -n.c[i] / w, math.inf)  # (6.12b)
            else:
                high[eta[h, i]] = 0.0
        for slack, limit in ((eps_high[i], n.yhi[i]), (eps_low[i], n.ylo[i])):
            if not math.isfinite(limit) or not n.rho[i]:
                high[slack] = 0.0
    place = [(r, k, v) for r, entries in enumerate(rows) for k, v in entries.items()]
    r_, k_, v_ = zip(*place, strict=True)
    return FullForm(
        q=q,
        c=c,
        A=sp.csr_matrix((v_, (r_, k_)), shape=(len(rows), total)),
        row_low=np.array(row_low),
        row_high=np.array(row_high),
        low=low,
        high=high,
        starts=du[n.starts],
        units=units,
        integer=np.array([s is not None for s in n.step]),
    )


def _rows(form: FullForm, fixed=None):
    """Equalities (A, b) and inequalities (G, l, u), fixed variables among the equalities."""
    low, high = form.low.copy(), form.high.copy()
    if fixed is not None:
        low[form.integers] = high[form.integers] = np.asarray(fixed, dtype=float).ravel()
    identity = sp.identity(len(low), format="csr")
    A = sp.vstack([form.A, identity], format="csr")
    lower, upper = np.r_[form.row_low, low], np.r_[form.row_high, high]
    same = lower == upper
    free = ~same & (np.isfinite(lower) | np.isfinite(upper))
    return A[same], lower[same], A[free], lower[free], upper[free]


def solve_qp(case: dict, solver: str = "clarabel", fixed=None, form: FullForm | None = None) -> Answer:
    """The relaxed problem, or the one with the integer moves fixed, by somebody else's QP solver.

    The solvers run to 1e-10 in scaled units and `objective()` judges the plan. Over 3,000 random cases all that
    answered agreed to 1e-7 relative; PIQP gave up on four.

    Args:
        case: the content of a case file.
        solver: ``clarabel`` or ``piqp`` (interior point), ``daqp`` (active set, dense: small cases only).
        fixed: "block integer-mv" in steps.
        form: the full form of the case, if it is at hand.
    """
    form = form or full_form(case)
    A, b, G, lower, upper = _rows(form, fixed)
    if solver == "clarabel":
        status, z, bound = _clarabel(form, A, b, G, lower, upper)
    elif solver == "piqp":
        status, z, bound = _piqp(form, A, b, G, lower, upper)
    else:
        status, z, bound = _daqp(form, A, b, G, lower, upper)
    if status != "optimal":
        return Answer(status)
    moves = form.moves(z)
    if fixed is not None:
        moves[:, form.integer] = np.asarray(fixed, dtype=float).reshape(moves[:, form.integer].shape)
        moves[:, form.integer] *= form.units[form.integer]
    return Answer("optimal", objective(case, moves), bound, moves)


def _clarabel(form, A, b, G, lower, upper):
    import clarabel

    has_low, has_high = np.isfinite(lower), np.isfinite(upper)
    M = sp.vstack([A, G[has_high], -G[has_low]], format="csc")
    rhs = np.r_[b, upper[has_high], -lower[has_low]]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    settings.max_iter = 200
    cones = [clarabel.ZeroConeT(len(b)), clarabel.NonnegativeConeT(len(rhs) - len(b))]
    P = sp.diags(2 * form.q).tocsc()
    solution = clarabel.DefaultSolver(P, form.c, M, rhs, cones, settings).solve()
    status = str(solution.status)
    if status in ("Solved", "AlmostSolved"):
        return "optimal", np.array(solution.x), solution.obj_val_dual
    return ("infeasible" if "PrimalInfeasible" in status else "failed"), None, None


def _piqp(form, A, b, G, lower, upper):
    import piqp

    solver = piqp.SparseSolver()
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-10
    solver.settings.check_duality_gap = True
    solver.settings.eps_duality_gap_abs = solver.settings.eps_duality_gap_rel = 1e-10
    solver.settings.max_iter = 500
    P = sp.diags(2 * form.q).tocsc()
    solver.setup(P, form.c, A.tocsc(), b, G.tocsc(), lower, upper)
    status = solver.solve()
    if status == piqp.PIQP_SOLVED:
        bound = solver.result.info.dual_obj
        return "optimal", np.array(solver.result.x), bound
    return ("infeasible" if status == piqp.PIQP_PRIMAL_INFEASIBLE else "failed"), None, None


def _daqp(form, A, b, G, lower, upper):
    import daqp

    n = len(form.q)
    M = np.ascontiguousarray(sp.vstack([A, G]).toarray())
    low, high = np.r_[b, lower], np.r_[b, upper]
    sense = np.r_[np.full(len(b), 5), np.zeros(len(lower))].astype(np.int32)  # 5: equality, always active
    low, high = np.clip(low, -1e30, None), np.clip(high, None, 1e30)
    H = np.diag(2 * form.q)
    z, _, flag, _ = daqp.solve(
        H,
        form.c.copy(),
        M,
        high,
        low,
        sense,
        primal_tol=1e-10,
        dual_tol=1e-11,
        eps_prox=1e-4,
        iter_limit=100000,
    )
    if flag in (1, 2):
        return "optimal", np.array(z)[:n], -math.inf  # an active set has no separate bound
    return ("infeasible" if flag == -1 else "failed"), None, None


# ------------------------------------------------------------------------------------------ integer oracles


def integer_range(case: dict, ceiling: float) -> float:
    """Steps that no optimal move exceeds, from P d^2 <= `ceiling`, the cost of some feasible plan."""
    n = read(case)
    weights = [n.P[m] * n.step[m] ** 2 for m in range(n.mvs) if n.step[m]]
    return math.floor(math.sqrt(ceiling / min(weights))) + 1 if weights and min(weights) > 0 else math.inf


def brute_force(case: dict, solver: str = "piqp", most: int = 20_000) -> Answer:
    """Every integer plan within the hard constraints, each with a QP for the continuous moves.

    Raises:
        OverflowError: for more than `most` integer plans.
    """
    n = read(case)
    integer = [m for m in range(n.mvs) if n.step[m]]
    if not hard_feasible(case):
        return Answer("infeasible")
    ceiling = objective(case, np.zeros((len(n.blocks), n.mvs)))
    largest = (
        math.inf if violation(case, np.zeros((len(n.blocks), n.mvs))) > 0 else integer_range(case, ceiling)
    )
    per_mv = [integer_plans(case, m, largest, most) for m in integer]
    if math.prod(len(plans) for plans in per_mv) > most:
        raise OverflowError(f"more than {most} integer plans")
    form = full_form(case)
    best = Answer("infeasible")
    for chosen in itertools.product(*per_mv):
        steps = np.array(chosen, dtype=float).T.reshape(len(n.blocks), len(integer))
        if len(integer) == n.mvs:
            moves = steps * form.units
            found = Answer("optimal", objective(case, moves), -math.inf, moves)
        else:
            found = solve_qp(case, solver, steps, form)
            if found.status != "optimal":
                found = solve_qp(case, "clarabel", steps, form)
            if found.status != "optimal":
                raise ArithmeticError(f"no QP solver settles the integer plan {chosen}: {found.status}")
        if found.objective < best.objective:
            best = found
    best.bound = best.objective
    return best


def solve_scip(case: dict, time_s: float = 60.0, gap: float = 1e-7) -> Answer:
    """The mixed-integer problem by SCIP; its primal is polished by a QP and judged by `objective()`.

    SCIP holds rows to 1e-6 absolute in scaled units, so its dual bound is good for about 1e-6 relative.
    """
    import pyscipopt

    form = full_form(case)
    model = pyscipopt.Model()
    model.hideOutput()
    model.setParam("limits/time", time_s)
    model.setParam("limits/gap", gap)
    model.setParam("numerics/feastol", 1e-8)
    integer = set(form.integers.tolist())
    z = []
    for i, (low, high) in enumerate(zip(form.low, form.high, strict=True)):
        z.append(
            model.addVar(
                vtype="I" if i in integer else "C",
                lb=low if math.isfinite(low) else None,
                ub=high if math.isfinite(high) else None,
            )
        )
    for r in range(form.A.shape[0]):
        part = slice(form.A.indptr[r], form.A.indptr[r + 1])
        terms = pyscipopt.quicksum(
            float(v) * z[k] for k, v in zip(form.A.indices[part], form.A.data[part], strict=True)
        )
        low, high = form.row_low[r], form.row_high[r]
        if low == high:
            model.addCons(terms == low)
        else:
            if math.isfinite(low):
                model.addCons(terms >= low)
            if math.isfinite(high):
                model.addCons(terms <= high)
    total = pyscipopt.quicksum(float(form.c[i]) * z[i] for i in np.flatnonzero(form.c))
    for i in np.flatnonzero(form.q):  # one epigraph per square: the tightest outer approximation
        t = model.addVar(lb=0.0)
        model.addCons(z[i] * z[i] <= t)
        total += float(form.q[i]) * t
    model.setObjective(total, "minimize")
    model.optimize()
    status, bound = model.getStatus(), model.getDualbound()
    if status == "infeasible":
        return Answer("infeasible")
    if model.getNSols() == 0:
        return Answer("failed", bound=bound)
    values = [model.getVal(variable) for variable in z]
    polished = solve_qp(case, "clarabel", np.round(np.array(values)[form.integers]), form)
    done = status in ("optimal", "gaplimit")
    return Answer("optimal" if done else "limit", polished.objective, bound, polished.moves)


# ---------------------------------------------------------------------------------------------- the judgement

FEASIBLE = 1e-7  # of `violation`: sums of 200 moves lose 1e-13 in float64, solvers stop at 1e-9
EXACT = 1e-6  # relative: the gap at which a plan counts as optimal; oracles agree with each other to 1e-7
SAME = 1e-8  # relative: two float64 evaluations of one cost, that differ in the order of sums alone
FLOOR = 1e-3  # costs below it are compared absolutely: random cases have costs of order 1 to 1000


def best_qp(case: dict) -> Answer:
    """The relaxed problem by two interior-point solvers, and an active-set one where it is small: the best."""
    if not hard_feasible(case):
        return Answer("infeasible")
    form = full_form(case)
    solvers = ("clarabel", "piqp", "daqp") if len(form.q) < 300 else ("clarabel", "piqp")
    answers = [solve_qp(case, solver, form=form) for solver in solvers]
    return min(answers, key=lambda answer: answer.objective)


def complaints(case: dict, plan, reference: Answer) -> list[str]:
    """What is wrong with a plan of the library, in words; empty if nothing is.

    Args:
        case: the content of a case file.
        plan: with the fields of a plan file as attributes, arrays as arrays.
        reference: the answer of an oracle; its status is ``optimal``, ``infeasible`` or ``limit`` (its
            objective is only known to be reachable, and its bound to be a bound).
    """
    if "infeasible" in (plan.status, reference.status):
        if plan.status == reference.status:
            return []
        return [f"status {plan.status}, oracle {reference.status} {reference.objective}"]
    found = [] if plan.status == "optimal" else [f"status {plan.status}, oracle {reference.status}"]
    n, moves = read(case), np.asarray(plan.moves, dtype=float)
    if moves.shape != (len(n.blocks), n.mvs) or not np.isfinite(moves).all():
        return [*found, f"moves of shape {moves.shape}, or not finite"]
    if (worst := violation(case, moves)) > FEASIBLE:
        found.append(f"violates a hard constraint by {worst:.1e}")
    cost, given, bound = objective(case, moves), float(plan.objective), float(plan.bound)
    known = reference.objective if math.isfinite(reference.objective) else cost
    scale = max(abs(known), FLOOR)
    if not abs(cost - given) <= SAME * max(abs(cost), FLOOR):
        found.append(f"states the objective {given!r}, but the plan costs {cost!r}")
    if not cost <= reference.objective + EXACT * scale:
        found.append(
            f"costs {cost!r}, {(cost - reference.objective) / scale:.1e} more than {reference.objective!r}"
        )
    if reference.status == "optimal" and not cost >= reference.objective - EXACT * scale:
        found.append(f"costs {cost!r}, {(reference.objective - cost) / scale:.1e} less than the optimum")
    if not bound <= reference.objective + EXACT * scale:
        found.append(f"states the bound {bound!r}, above the reachable {reference.objective!r}")
    if not reference.bound <= cost + EXACT * scale:
        found.append(f"costs {cost!r}, less than the oracle's bound {reference.bound!r}")
    if not float(plan.gap) <= EXACT:
        found.append(f"states a gap of {float(plan.gap):.1e}")
    y = predict(case, moves)
    u = n.u0 + np.cumsum(sample_moves(case, moves), axis=0)
    above = np.maximum(0.0, (y - n.yhi)[n.hw - 1 :].max(axis=0))
    below = np.maximum(0.0, (n.ylo - y)[n.hw - 1 :].max(axis=0))
    size = np.abs(y).max(axis=0) + 1.0
    for name, got, wanted, unit in (
        ("cv", plan.cv, y, size),
        ("mv", plan.mv, u, np.abs(u).max(axis=0) + 1.0),
        ("eps_high", plan.eps_high, above, size),
        ("eps_low", plan.eps_low, below, size),
    ):
        got = np.asarray(got, dtype=float)
        if got.shape != wanted.shape or not (np.abs(got - wanted) <= SAME * unit).all():
            found.append(f"states another {name} than its moves lead to")
    return found
