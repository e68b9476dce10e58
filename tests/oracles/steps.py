"""Independent answers to one controller step, written straight from the equations (thesis 5.1-5.2, 6.1-6.5).

Nothing here is shared with the solvers of the library: a case is read as the plain content of its JSON file,
predictions are superposed sample by sample, and the optimisation problem is the *full* form (5.6) with every
sample's move, MV and CV as a variable. `objective` and `violation` judge a given plan (the benchmark's judge, in
`studies.bench.problem`); `solve_qp`, `solve_scip` and `brute_force` find plans with other people's solvers.
What they are good for stands beside the functions.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import scipy.sparse as sp

from studies.bench import peers
from studies.bench.forms import Form, cv_units, move_units
from studies.bench.problem import objective, predict, read, sample_moves, step_limits, violation

__all__ = [
    "objective",
    "predict",
    "read",
    "sample_moves",
    "violation",
]  # the judge of the benchmark is ours, too

QP_SOLVERS = {"clarabel": peers.clarabel, "piqp": peers.piqp, "daqp": peers.daqp}


@dataclasses.dataclass
class Answer:
    """What an oracle found: `objective` is judged by `objective()`, `bound` is the solver's own."""

    status: str  # optimal, infeasible, limit, failed
    objective: float = math.inf
    bound: float = -math.inf
    moves: np.ndarray | None = None


# ------------------------------------------------------------------------------------ hard constraints alone


def integer_plans(
    case: dict, m: int, largest: float = math.inf, most: int = 200_000
) -> list[tuple[int, ...]]:
    """All plans of one integer MV, in steps per whole block, that meet its hard constraints at every sample.

    `largest` bounds the steps of one move where no limit does. Later moves are continuous: what they leave is reachable.
    """
    n = read(case)
    dlo, dhi, plo, phi = step_limits(n, m)
    blocks, later = n.lists[m][: n.whole[m]], n.lists[m][n.whole[m] :]
    plans: list[tuple[int, ...]] = []

    def extend(plan, position, previous):
        b = len(plan)
        if b == len(blocks):
            if not _reachable(n, m, later, n.u0[m] + position * n.step[m]):
                return
            plans.append(tuple(plan))
            if len(plans) > most:
                raise OverflowError(f"more than {most} integer plans")
            return
        length = blocks[b]
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
            for length in n.lists[m][: n.whole[m]]:
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
            later = n.lists[m][n.whole[m] :]
            if not any(_reachable(n, m, later, n.u0[m] + at * n.step[m]) for at, _ in states):
                return False
        elif not _reachable(n, m, n.lists[m], n.u0[m]):
            return False
    return True


def _reachable(n, m: int, blocks: list[int], start: float) -> bool:
    """Whether continuous moves of an MV over some blocks can keep its limits."""
    low, high = min(n.ulo[m], n.u0[m]), max(n.uhi[m], n.u0[m])
    near = far = start  # the interval of reachable positions
    for length in blocks:
        if n.blocking == "inputs" and length > 1 and not n.dlo[m] <= 0 <= n.dhi[m]:
            return False
        count = 1 if n.blocking == "inputs" else length
        near, far = max(low, near + count * n.dlo[m]), min(high, far + count * n.dhi[m])
        if near > far + 1e-9 * max(1.0, abs(far)):
            return False
    return True


@dataclasses.dataclass
class StepForm(Form):
    """A form in which some moves of an integer MV may be continuous; padding of the plan is a variable of its own."""

    whole: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 0), bool))  # "block mv"

    @property
    def integers(self) -> np.ndarray:
        """Positions of the integer variables."""
        return self.starts[self.whole & self.integer]


# --------------------------------------------------------------------------------------------- the full form


def full_form(case: dict) -> StepForm:
    """The problem (5.6) with Soft MPC (6.12), blocks (6.2), whole steps (6.1), oscillation rows (6.16)."""
    n = read(case)
    horizon = n.hp - n.hw + 1
    units = move_units(n)
    size = cv_units(n, units)

    count = itertools.count()

    def block(*shape):
        return np.array([next(count) for _ in range(math.prod(shape))], dtype=int).reshape(shape)

    du, u, e = block(n.hu, n.mvs), block(n.hu, n.mvs), block(horizon, n.cvs)
    away = block(horizon, n.mvs)
    eps_high, eps_low, eta = block(n.cvs), block(n.cvs), block(horizon, n.cvs)
    nothing = int(block(1)[0])  # the moves of a plan beyond the blocks of an MV
    total = next(count)
    q, c = np.zeros(total), np.zeros(total)
    low, high = np.full(total, -np.inf), np.full(total, np.inf)
    low[nothing] = high[nothing] = 0.0
    rows: list[dict[int, float]] = []
    row_low: list[float] = []
    row_high: list[float] = []

    def row(entries, lower, upper):
        if math.isfinite(lower) or math.isfinite(upper):
            rows.append({int(k): float(v) for k, v in entries})
            row_low.append(lower)
            row_high.append(upper)

    for m in range(n.mvs):
        for k in range(n.hu):
            if k < n.until[m]:
                dlo, dhi, plo, phi = step_limits(n, m)
            else:
                dlo, dhi = n.dlo[m] / units[m], n.dhi[m] / units[m]
                plo = min(0.0, (n.ulo[m] - n.u0[m]) / units[m])
                phi = max(0.0, (n.uhi[m] - n.u0[m]) / units[m])
            q[du[k, m]] = n.P[m] * units[m] ** 2
            low[du[k, m]], high[du[k, m]] = dlo, dhi  # (5.5a)
            low[u[k, m]], high[u[k, m]] = plo, phi
            before = [(u[k - 1, m], -1.0)] if k else []
            row([(u[k, m], 1.0), *before, (du[k, m], -1.0)], 0.0, 0.0)  # (5.4f)
            if n.oscillation[m] and k < n.until[m]:  # (6.16)
                if k:
                    row([(du[k, m], 1.0), (du[k - 1, m], -1.0)], -1.0, 1.0)
                else:
                    past = round(n.last[m] / n.step[m])
                    row([(du[0, m], 1.0)], past - 1.0, past + 1.0)
        for h in range(horizon):  # (6.20)
            q[away[h, m]] = n.W[m] * units[m] ** 2
            gap = (n.u0[m] - n.ideal[m]) / units[m]
            row([(away[h, m], 1.0), (u[min(n.hw + h, n.hu) - 1, m], -1.0)], gap, gap)
        for start, length in zip(n.begins[m], n.lists[m], strict=True):  # (6.3)
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
    starts = np.full((max(map(len, n.lists)), n.mvs), nothing)
    for m, begins in enumerate(n.begins):
        starts[: len(begins), m] = du[begins, m]
    return StepForm(
        P=sp.csc_matrix(sp.diags(2 * q)),
        c=c,
        A=sp.csr_matrix((v_, (r_, k_)), shape=(len(rows), total)),
        row_low=np.array(row_low),
        row_high=np.array(row_high),
        low=low,
        high=high,
        starts=starts,
        units=units,
        integer=np.array([s is not None for s in n.step]),
        whole=np.arange(len(starts))[:, None] < np.array(n.whole),
    )


def _fixed(form: StepForm, steps=None) -> StepForm:
    """The form without integers: relaxed, or with the integer moves fixed."""
    low, high = form.low.copy(), form.high.copy()
    if steps is not None:
        low[form.integers] = high[form.integers] = np.asarray(steps, dtype=float).ravel()
    return dataclasses.replace(form, low=low, high=high, integer=np.zeros_like(form.integer))


def solve_qp(case: dict, solver: str = "clarabel", fixed=None, form: StepForm | None = None) -> Answer:
    """The relaxed problem, or the one with the integer moves fixed, by somebody else's QP solver.

    The solvers run to 1e-10 in scaled units and `objective()` judges the plan. Over 3,000 random cases all that
    answered agreed to 1e-7 relative; PIQP gave up on four.

    Args:
        case: the content of a case file.
        solver: ``clarabel`` or ``piqp`` (interior point), ``daqp`` (active set, dense: small cases only).
        fixed: the whole moves in steps, block by block, the MVs of a block one after the other.
        form: the full form of the case, if it is at hand.
    """
    form = form or full_form(case)
    answer = QP_SOLVERS[solver](1e-10, 60.0)(_fixed(form, fixed))
    if answer.status != "optimal" or answer.z is None:
        return Answer(answer.status)
    moves = form.moves(answer.z)
    if fixed is not None:
        whole = form.whole & form.integer
        moves[whole] = np.asarray(fixed, dtype=float).ravel()
        moves *= np.where(whole, form.units, 1.0)
    return Answer("optimal", objective(case, moves), answer.bound, moves)


# ------------------------------------------------------------------------------------------ integer oracles


def integer_range(case: dict, ceiling: float) -> float:
    """Steps that no optimal move exceeds, from P d^2 <= `ceiling`, the cost of some feasible plan."""
    n = read(case)
    weights = [n.P[m] * n.step[m] ** 2 for m in range(n.mvs) if n.step[m]]
    return math.floor(math.sqrt(ceiling / min(weights))) + 1 if weights and min(weights) > 0 else math.inf


def brute_force(case: dict, solver: str = "piqp", most: int = 20_000, keep=lambda m, plan: True) -> Answer:
    """Every integer plan within the hard constraints, each with a QP for the continuous moves.

    `keep` tells of the plan of one MV whether it is one of them; a plan without moves must be.

    Raises:
        OverflowError: for more than `most` integer plans.
    """
    n = read(case)
    integer = [m for m in range(n.mvs) if n.step[m]]
    if not hard_feasible(case):
        return Answer("infeasible")
    none = np.zeros((max(map(len, n.lists)), n.mvs))
    ceiling = objective(case, none)
    largest = math.inf if violation(case, none) > 0 else integer_range(case, ceiling)
    per_mv = [[p for p in integer_plans(case, m, largest, 20 * most) if keep(m, p)] for m in integer]
    if math.prod(len(plans) for plans in per_mv) > most:
        raise OverflowError(f"more than {most} integer plans")
    form = full_form(case)
    best = Answer("infeasible")
    for chosen in itertools.product(*per_mv):
        steps = np.zeros(none.shape)
        for m, plan in zip(integer, chosen, strict=True):
            steps[: len(plan), m] = plan
        if n.whole == list(map(len, n.lists)):
            moves = steps * form.units
            found = Answer("optimal", objective(case, moves), -math.inf, moves)
        else:
            fixed = steps[form.whole & form.integer]
            found = solve_qp(case, solver, fixed, form)
            if found.status != "optimal":
                found = solve_qp(case, "clarabel", fixed, form)
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
    form = full_form(case)
    answer = peers.scip(gap, time_s)(form)
    if answer.z is None:
        return Answer("infeasible" if answer.status == "infeasible" else "failed", bound=answer.bound)
    polished = solve_qp(case, "clarabel", np.round(answer.z[form.integers]), form)
    return Answer(answer.status, polished.objective, answer.bound, polished.moves)


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
    solvers = ("clarabel", "piqp", "daqp") if len(form.c) < 300 else ("clarabel", "piqp")
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
    if moves.shape != (max(map(len, n.lists)), n.mvs) or not np.isfinite(moves).all():
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
