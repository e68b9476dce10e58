"""Other people's solvers behind one interface; the one door of the benchmark to each of them.

A peer gets a problem as a `forms.Form`, solves it, and says how long its own work took. Nothing is timed but the solver:
matrices are converted before the clock starts. A solver that can keep its factorisation pattern between samples with
equal matrices (PIQP, Clarabel, OSQP) is set up once per run of samples and updated; the others start anew each time.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import importlib.util
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp

from jaxmpc.integer.highs import solve_qp as highs_qp
from studies.bench import forms
from studies.bench.forms import Form, binaries_of, rows_of, same_matrices
from studies.bench.judge import taken

HUGE = 1e30  # what solvers without infinity call infinite


@dataclasses.dataclass
class PeerAnswer:
    """What a peer found."""

    status: str  # optimal, limit, infeasible or failed
    z: np.ndarray | None = None  # variables of the form, None without a point
    bound: float = -math.inf  # the solver's own lower bound of the cost without constants
    seconds: float = math.nan  # what its own work took [s]


Solve = Callable[[Form], PeerAnswer]


@dataclasses.dataclass(frozen=True)
class Peer:
    """A solver that the benchmark compares with."""

    name: str  # as printed
    package: str  # distribution on the package index that brings it, imported under the same name
    build: Callable[[dict], Form]  # the form it is fastest with
    begin: Callable[[float, float], Solve]  # with tolerance and seconds per solve; keeps what samples share
    timed: str  # what its time covers, for the table
    keeps: bool = False  # whether it is set up once for samples with equal matrices
    limit: int = 10_000  # samples it is asked at most, because it is slow
    hopeless: float = 10.0  # seconds after which one solve is cut off
    bounds: bool = False  # whether it says what no plan is below

    def missing(self) -> str | None:
        """Why it cannot be used, None if it can."""
        if importlib.util.find_spec(self.package.replace("-", "_")) is None:
            return f"{self.package} is not installed (pip install 'jaxmpc[bench]')"
        return None

    def version(self) -> str:
        """Of the installed package."""
        try:
            return importlib.metadata.version(self.package)
        except importlib.metadata.PackageNotFoundError:
            return "?"


def anew(solve: Callable[[Form, float, float], PeerAnswer]) -> Callable[[float, float], Solve]:
    """The `Peer.begin` of a solver that keeps nothing between samples."""
    return lambda tolerance, seconds: lambda form: solve(form, tolerance, seconds)


# ------------------------------------------------------------------------------------------------ relaxed QPs


@dataclasses.dataclass
class _Kept:
    """A solver that is set up once for samples with equal matrices, and only given their vectors from then on."""

    setup: Callable[..., Any]  # makes a solver of a form and its data
    update: Callable[..., object]  # gives the vectors of the data to one
    run: Callable[[Any], Any]  # solves; returns what it found
    form: Form | None = None
    solver: Any = None

    def __call__(self, form: Form, *data: Any) -> tuple[float, Any]:
        """Seconds of the solver's own work, and what it found."""
        keep = same_matrices(self.form, form)

        def work() -> Any:
            if keep:
                self.update(self.solver, form, *data)
            else:
                self.solver = self.setup(form, *data)
            return self.run(self.solver)

        found = taken(work)
        self.form = form
        return found


def piqp(tolerance: float, seconds: float) -> Solve:
    """PIQP with sparse matrices: proximal interior point."""
    import piqp

    def setup(form: Form, A: Any, G: Any, vectors: dict[str, np.ndarray]) -> Any:
        solver = piqp.SparseSolver()
        chosen = solver.settings
        chosen.eps_abs = chosen.eps_rel = tolerance
        chosen.check_duality_gap = True
        chosen.eps_duality_gap_abs = chosen.eps_duality_gap_rel = tolerance
        chosen.max_iter = 500
        c, b, *limits = vectors.values()
        solver.setup(form.P, c, A, b, G, *limits)
        return solver

    kept = _Kept(
        setup,
        lambda solver, form, A, G, vectors: solver.update(**vectors),
        lambda solver: (solver.solve(), solver.result),
    )

    def solve(form: Form) -> PeerAnswer:
        A, b, G, low, high = rows_of(form)
        fixed = np.flatnonzero(form.low == form.high)  # an interior point needs an interior
        identity: Any = sp.identity(len(form.c), format="csr")
        A: Any = sp.vstack([A, identity[fixed]])
        b, box_low, box_high = np.r_[b, form.low[fixed]], form.low.copy(), form.high.copy()
        box_low[fixed], box_high[fixed] = -math.inf, math.inf
        vectors = {"c": form.c, "b": b, "h_l": low, "h_u": high, "x_l": box_low, "x_u": box_high}
        elapsed, (status, result) = kept(form, A.tocsc(), G.tocsc(), vectors)
        if status != piqp.PIQP_SOLVED:
            infeasible = status == piqp.PIQP_PRIMAL_INFEASIBLE
            return PeerAnswer("infeasible" if infeasible else "failed", seconds=elapsed)
        return PeerAnswer("optimal", np.array(result.x), result.info.dual_obj, elapsed)

    return solve


def clarabel(tolerance: float, seconds: float) -> Solve:
    """Clarabel: homogeneous interior point."""
    import clarabel

    library: Any = clarabel  # its compiled names are unknown to type checkers
    settings = library.DefaultSettings()
    settings.verbose, settings.max_iter, settings.time_limit = False, 200, seconds
    settings.presolve_enable = False  # so that vectors can be updated
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    kept = _Kept(
        lambda form, upper, M, right, cones: library.DefaultSolver(upper, form.c, M, right, cones, settings),
        lambda solver, form, upper, M, right, cones: solver.update(q=form.c, b=right),
        lambda solver: solver.solve(),
    )

    def solve(form: Form) -> PeerAnswer:
        M, right, equations = _standard(form)
        cones = [library.ZeroConeT(equations), library.NonnegativeConeT(len(right) - equations)]
        elapsed, found = kept(form, sp.triu(form.P, format="csc"), M, right, cones)
        status = str(found.status)
        if status in ("Solved", "AlmostSolved"):
            return PeerAnswer("optimal", np.array(found.x), found.obj_val_dual, elapsed)
        return PeerAnswer("infeasible" if "PrimalInfeasible" in status else "failed", seconds=elapsed)

    return solve


def osqp(tolerance: float, seconds: float) -> Solve:
    """OSQP: operator splitting; polished, and stopped at 1e-6 as it rarely gets further."""
    import osqp  # pyright: ignore[reportMissingImports]

    within = max(tolerance, 1e-6)
    options = {"eps_abs": within, "eps_rel": within, "time_limit": seconds, "max_iter": 20_000}

    def setup(form: Form, upper: Any, A: Any, low: np.ndarray, high: np.ndarray) -> Any:
        solver = osqp.OSQP()
        solver.setup(upper, form.c, A, low, high, verbose=False, polishing=True, **options)
        return solver

    def update(solver: Any, form: Form, upper: Any, A: Any, low: np.ndarray, high: np.ndarray) -> None:
        solver.warm_start(x=np.zeros(len(form.c)), y=np.zeros(len(low)))  # the samples are no neighbours
        solver.update(q=form.c, l=low, u=high)

    kept = _Kept(setup, update, lambda solver: solver.solve(raise_error=False))

    def solve(form: Form) -> PeerAnswer:
        A = sp.vstack([form.A, sp.identity(len(form.c))], format="csc")
        low = np.maximum(np.r_[form.row_low, form.low], -HUGE)
        high = np.minimum(np.r_[form.row_high, form.high], HUGE)
        elapsed, found = kept(form, sp.triu(form.P, format="csc"), A, low, high)
        if found.x is None or not np.isfinite(found.x).all():
            return PeerAnswer("failed", seconds=elapsed)
        good = found.info.status in ("solved", "solved inaccurate")
        return PeerAnswer("optimal" if good else "limit", np.array(found.x), seconds=elapsed)

    return solve


@anew
def daqp(form: Form, tolerance: float, seconds: float) -> PeerAnswer:
    """DAQP: dual active set on dense matrices; integers become binaries that it branches on."""
    import daqp

    form, binary, back = binaries_of(form)
    A, b, G, low, high = rows_of(form)
    rows = np.ascontiguousarray(sp.vstack([A, G]).toarray())
    lower = np.clip(np.r_[form.low, b, low], -HUGE, None)
    upper = np.clip(np.r_[form.high, b, high], None, HUGE)
    sense = np.zeros(len(lower), dtype=np.int32)
    sense[lower == upper] = 5  # an equation, always active
    sense[binary] = 16
    hessian = np.ascontiguousarray(form.P.toarray())
    options = dict(primal_tol=max(tolerance, 1e-10), dual_tol=1e-11, eps_prox=1e-4, iter_limit=100_000)
    problem = hessian, form.c.copy(), rows, upper, lower, sense
    elapsed, (x, _, flag, _) = taken(lambda: daqp.solve(*problem, time_limit=seconds, **options))
    if flag not in (1, 2, 4):  # 4: solved, but its certificate is left open; the judge decides
        return PeerAnswer("infeasible" if flag == -1 else "limit", seconds=elapsed)
    return PeerAnswer("optimal", back(np.array(x)[: len(form.c)]), seconds=elapsed)


@anew
def highs(form: Form, tolerance: float, seconds: float) -> PeerAnswer:
    """The QP solver of HiGHS: primal active set."""
    data = form.P, form.c, form.A, form.row_low, form.row_high, form.low, form.high
    elapsed, (status, z) = taken(lambda: highs_qp(*data, seconds=seconds))
    return PeerAnswer(status, z, seconds=elapsed)


def qpax(tolerance: float, seconds: float) -> Solve:
    """qpax: dense interior point in JAX; compiled before the clock starts."""
    import jax
    import jax.numpy as jnp
    import qpax  # pyright: ignore[reportMissingImports]

    run = jax.jit(lambda *data: qpax.solve_qp(*data, solver_tol=max(tolerance, 1e-6)))
    ready: set[tuple[int, ...]] = set()

    def solve(form: Form) -> PeerAnswer:
        M, right, n = _standard(form)
        M = M.toarray()
        data = [jnp.asarray(v) for v in (form.P.toarray(), form.c, M[:n], right[:n], M[n:], right[n:])]
        if M.shape not in ready:
            jax.block_until_ready(run(*data))
            ready.add(M.shape)
        elapsed, found = taken(lambda: jax.block_until_ready(run(*data)))
        z, converged = np.asarray(found[0]), bool(found[4])
        return PeerAnswer("optimal" if converged else "limit", z, seconds=elapsed)

    return solve


def _standard(form: Form) -> tuple[Any, np.ndarray, int]:
    """All rows as M z = right for the first so many, M z <= right for the others."""
    A, b, G, low, high = rows_of(form, boxes=True)
    has_low, has_high = np.isfinite(low), np.isfinite(high)
    M = sp.vstack([A, G[has_high], -G[has_low]], format="csc")
    return M, np.r_[b, high[has_high], -low[has_low]], len(b)


# ---------------------------------------------------------------------------------------------- exact MIQPs


@anew
def scip(form: Form, tolerance: float, seconds: float) -> PeerAnswer:
    """SCIP: branch and cut; one epigraph variable per square, the tightest outer approximation. Needs a diagonal P."""
    import pyscipopt

    model = pyscipopt.Model()
    model.hideOutput()
    exact = min(1e-8, tolerance / 10.0)
    limits = {"limits/time": seconds, "limits/gap": tolerance, "numerics/feastol": exact}
    for name, value in limits.items():
        model.setParam(name, value)
    kinds = np.full(len(form.c), "C")
    kinds[form.integers] = "I"
    finite = lambda limits: [limit if math.isfinite(limit) else None for limit in limits.tolist()]  # noqa: E731
    ranges = zip(kinds.tolist(), finite(form.low), finite(form.high), strict=True)
    z = [model.addVar(vtype=kind, lb=low, ub=high) for kind, low, high in ranges]
    for row, low, high in zip(form.A, form.row_low, form.row_high, strict=True):
        entries = zip(row.indices, row.data, strict=True)
        terms = pyscipopt.quicksum(float(value) * z[k] for k, value in entries)
        if low == high:
            model.addCons(terms == low)
            continue
        if math.isfinite(low):
            model.addCons(terms >= low)
        if math.isfinite(high):
            model.addCons(terms <= high)
    total = pyscipopt.quicksum(float(form.c[i]) * z[i] for i in np.flatnonzero(form.c))
    squares = form.P.diagonal() / 2
    for i in np.flatnonzero(squares):
        t = model.addVar(lb=0.0)
        model.addCons(z[i] * z[i] <= t)
        total += float(squares[i]) * t
    model.setObjective(total, "minimize")
    elapsed, _ = taken(model.optimize)
    status, bound = model.getStatus(), model.getDualbound()
    if status == "infeasible":
        return PeerAnswer("infeasible", seconds=elapsed)
    if model.getNSols() == 0:
        return PeerAnswer("limit" if status == "timelimit" else "failed", bound=bound, seconds=elapsed)
    point = np.array([model.getVal(variable) for variable in z])
    done = status in ("optimal", "gaplimit")
    return PeerAnswer("optimal" if done else "limit", point, bound, elapsed)


def gurobi(tolerance: float, seconds: float) -> Solve:
    """Gurobi. The licence in its package ends at 200 variables where terms are quadratic: too few for the thesis size."""
    import gurobipy  # pyright: ignore[reportMissingImports]

    environment = gurobipy.Env(params={"OutputFlag": 0})

    def solve(form: Form) -> PeerAnswer:
        with gurobipy.Model(env=environment) as started:
            model: Any = started
            kinds = np.full(len(form.c), "C")
            kinds[form.integers] = "I"
            z = model.addMVar(len(form.c), lb=form.low, ub=form.high, vtype=kinds)
            A, b, G, low, high = rows_of(form)
            model.addConstr(A @ z == b)
            up, down = np.isfinite(high), np.isfinite(low)
            model.addConstr(G[up] @ z <= high[up])
            model.addConstr(G[down] @ z >= low[down])
            model.setObjective(0.5 * (z @ form.P @ z) + form.c @ z)
            model.Params.TimeLimit, model.Params.MIPGap = seconds, tolerance
            model.Params.FeasibilityTol = model.Params.IntFeasTol = 1e-9
            elapsed, _ = taken(model.optimize)
            if model.Status == gurobipy.GRB.INFEASIBLE:
                return PeerAnswer("infeasible", seconds=elapsed)
            if not model.SolCount:
                return PeerAnswer("limit", seconds=elapsed)
            done = model.Status == gurobipy.GRB.OPTIMAL
            return PeerAnswer("optimal" if done else "limit", np.array(z.X), model.ObjBound, elapsed)

    return solve


_UPDATED = "update of the vectors and solve; set up once per run"
_ANEW = "setup and solve"
QP_PEERS = (
    Peer("PIQP sparse", "piqp", forms.lifted, piqp, _UPDATED, True),
    Peer("Clarabel", "clarabel", forms.lifted, clarabel, _UPDATED, True, limit=60),
    Peer("OSQP 1e-6", "osqp", lambda case: forms.dense(case).scaled(), osqp, _UPDATED, True, limit=20),
    Peer("DAQP", "daqp", forms.dense, daqp, _ANEW, limit=12),
    Peer("HiGHS QP", "highspy", forms.lifted, highs, _ANEW, limit=8, hopeless=2.0),
    Peer("qpax", "qpax", forms.dense, qpax, "solve, compiled before", limit=2),
)
MIQP_PEERS = (
    Peer("SCIP", "pyscipopt", forms.lifted, scip, "solve", limit=5, hopeless=15.0, bounds=True),
    Peer("Gurobi", "gurobipy", forms.lifted, gurobi, "solve", limit=20, hopeless=20.0, bounds=True),
    Peer("DAQP", "daqp", forms.dense, daqp, _ANEW, limit=5, hopeless=10.0),
)
