"""One controller step: from free response and setpoint to a plan with its certificate (thesis 5.3, 6.1).

`Planner` keeps what is constant between samples; the controllers and the `plan` command call it.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxmpc import html
from jaxmpc import status as codes
from jaxmpc.controller.sample import require_double_precision
from jaxmpc.errors import InputError
from jaxmpc.integer.constants import Constants
from jaxmpc.integer.host_search import SearchResult
from jaxmpc.integer.relaxer import Relaxations, Relaxer, relaxations
from jaxmpc.integer.solve import FINISHES, continuous_feasible
from jaxmpc.integer.step_solver import StepSolver
from jaxmpc.model.step_response import StepResponseModel, check_match
from jaxmpc.problem.blocking import first_position_rows, moves_per_block, sample_moves
from jaxmpc.problem.condense import DRIFT, QpInstance, dynamic_matrix, make_instance
from jaxmpc.problem.structure import LARGEST, Structure, check_vector, sound
from jaxmpc.problem.tuning import Tuning
from jaxmpc.programs.packing import Packing, flattened, rebuilt
from jaxmpc.relaxed.gap import check_gap, check_time_limit, closes, relative_gap
from jaxmpc.relaxed.newton import WarmStart
from jaxmpc.relaxed.solve import relax


@dataclasses.dataclass(frozen=True)
class Plan:
    """A solved controller step, in engineering units.

    Attributes:
        status: ``optimal``, ``limit`` (feasible, not proven within the gap), ``infeasible`` or ``failed``.
        objective: (6.6) with all constants; None without a plan.
        bound: proven lower bound of the objective.
        gap: relative gap between the two.
        moves: per-sample move of each block (`moves`) or the move at its first sample (`inputs`).
        mv: MVs of the Hu samples, row 0 after the move applied now.
        cv: predicted CVs at j = 1..Hp.
        eps_high, eps_low: largest violation of each CV limit over the penalised samples.
        nodes: relaxations solved in the search.
        solve_time_s: wall time of the solve without compilation [s].
        finished_by: which path closed the problem, None if none did.
        warm: prices of the root relaxation, a start for the next sample.
    """

    status: str
    objective: float | None
    bound: float | None
    gap: float | None
    moves: Float[np.ndarray, "block mv"] | None
    mv: Float[np.ndarray, "sample mv"] | None
    cv: Float[np.ndarray, "horizon cv"] | None
    eps_high: Float[np.ndarray, " cv"] | None
    eps_low: Float[np.ndarray, " cv"] | None
    nodes: int
    solve_time_s: float
    finished_by: str | None
    warm: WarmStart | None = None

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html.plan(self)


@functools.partial(jax.jit, static_argnames=("structure", "recover"))
def _make_instance(structure, tuning, qp, free_response, setpoint, mv_now, last_move, past_moves, recover):
    """The problem of one sample, with a scenario axis of one."""
    instance = make_instance(
        structure,
        tuning,
        qp,
        free_response=free_response,
        setpoint=setpoint,
        mv_now=mv_now,
        last_move=last_move,
        past_moves=past_moves,
        recover=recover,
    )
    return jax.tree.map(lambda leaf: leaf[None], instance)


@functools.partial(jax.jit, static_argnames=("structure", "recover", "form", "packings"))
def _relax_instance(structure, leaves, given, recover, form, packings):
    """`_make_instance` and its relaxation; goes in and comes out packed."""
    tuning, qp, rows, columns = rebuilt(form, leaves)
    *sample, start = jax.tree.map(lambda leaf: leaf[0], packings[0].unpack(given))
    instances = _make_instance(structure, tuning, qp, *sample, recover)
    own = jax.tree.map(lambda leaf: leaf[0], instances)
    root = relax(qp, rows, columns, own, own.lower, own.upper, start)
    return packings[1].pack((instances, jax.tree.map(lambda leaf: leaf[None], root)))


class Planner:
    """Solves the steps of one controller.

    Args:
        structure: static configuration.
        tuning: weights and limits.
        model: step-response model with the same names and sampling interval.
    """

    def __init__(self, structure: Structure, tuning: Tuning, model: StepResponseModel):
        check_match(structure, model)
        self.structure, self.tuning, self.model = structure, tuning, model
        self._numbers = jax.tree.map(np.asarray, tuning)
        self.solver = StepSolver(structure, [tuning], [model])  # refuses what is too large
        self.matrix = np.asarray(dynamic_matrix(structure, model.coefficients))
        self._packings: dict[tuple[bool, Packing], Packing] = {}
        self._started = False
        self._flat: Any = None

    def __getstate__(self) -> dict[str, Any]:
        """What a copy needs; forms of trees do not survive a copy."""
        return self.__dict__ | {"_packings": {}, "_flat": None}

    def solve(
        self,
        *,
        mv_now: Float[ArrayLike, " mv"],
        last_move: Float[ArrayLike, " mv"],
        free_response: Float[ArrayLike, "horizon cv"],
        setpoint: Float[ArrayLike, "horizon cv"],
        previous_moves: Float[ArrayLike, "block mv"] | None = None,
        past_moves: Float[ArrayLike, "window mv"] | None = None,
        recover: bool = False,
        warm: WarmStart | None = None,
        time_limit: float | None = None,
        gap: float = 1e-6,
        finish: str = "auto",
    ) -> Plan:
        """Solve one step; arguments as in `solve_plan`.

        Args:
            mv_now: MVs before the move.
            last_move: previous move.
            free_response: Lambda, ``"horizon cv"``.
            setpoint: r, ``"horizon cv"``.
            previous_moves: start, ``"block mv"``, or None.
            past_moves: moves of the mean-move window, ``"window mv"`` oldest first, or None.
            recover: let MVs outside their limits return the shortest way.
            warm: `Plan.warm` of a neighbouring step; ignored where its size does not fit.
            time_limit: seconds, None for none.
            gap: relative gap.
            finish: one of `integer.FINISHES`.
        """
        if finish not in FINISHES:
            raise InputError("finish", finish, f"one of {', '.join(FINISHES)}")
        require_double_precision()
        gap, time_limit = check_gap("gap", gap), check_time_limit("time_limit", time_limit)
        as_array = lambda v: np.asarray(v, dtype=np.float64)  # noqa: E731
        free_response, setpoint, mv_now = as_array(free_response), as_array(setpoint), as_array(mv_now)
        past = None if past_moves is None else as_array(past_moves)
        sample = free_response, setpoint, mv_now, as_array(last_move), past
        relaxer, root = self.solver.relaxer(1), None

        def instances_of(relaxer: Relaxer) -> QpInstance:
            if root is not None:
                return instances
            return _make_instance(self.structure, self.tuning, relaxer.scenario(0).qp, *sample, recover)

        start = None if warm is None else jax.tree.map(lambda leaf: np.asarray(leaf)[None], warm)
        if self.solver.narrow:
            begin, instances, root = self._posed(relaxer, sample, recover, relaxer.fitting(start, 1))
        else:
            if not self._started:  # compiles; the clock measures solves
                jax.block_until_ready(instances_of(relaxer))
                self._started = True
            begin = time.perf_counter() - self.solver.compiling
        if root is None or self.structure.integer_mvs:
            previous = None if previous_moves is None else as_array(previous_moves)[None]
            relaxer, instances, results, _ = self.solver.solve(
                instances_of,
                root=root,
                previous_moves=previous,
                warm=start,
                gap=gap,
                time_limit=time_limit,
                finish=finish,
            )
            result = results[0]
        else:
            result = self._solve_relaxed(relaxer, instances, root, gap)
        instance = jax.tree.map(lambda leaf: np.asarray(leaf)[0], instances)
        return self._plan(relaxer.scenario(0), instance, result, mv_now, free_response, setpoint, gap, begin)

    def _posed(
        self, relaxer: Relaxer, sample: tuple, recover: bool, start: WarmStart
    ) -> tuple[float, QpInstance, Relaxations]:
        """When the clock started, the problem for moves of one step, and its relaxation."""
        given = (*(None if v is None else v[None] for v in sample), start)
        of_given = Packing.of(given)
        qp = relaxer.scenario(0).qp
        if self._flat is None:
            self._flat = flattened((self.tuning, qp, relaxer.hard, relaxer.columns))
        leaves, form = self._flat
        fresh = (recover, of_given) not in self._packings
        if fresh:
            shapes = jax.eval_shape(lambda: _make_instance(self.structure, self.tuning, qp, *sample, recover))
            self._packings[recover, of_given] = Packing.of((shapes, relaxer.solved_shapes))
        packings = of_given, self._packings[recover, of_given]
        call = lambda: np.asarray(  # noqa: E731
            _relax_instance(self.structure, leaves, of_given.pack(given), recover, form, packings)
        )
        if fresh:
            call()  # compiles; the clock measures solves
        begin = time.perf_counter() - self.solver.compiling
        instances, root = packings[1].unpack(call())
        return begin, instances, relaxations(root, relaxer.predictions)

    def _solve_relaxed(
        self, relaxer: Relaxer, instances: QpInstance, root: Relaxations, gap: float
    ) -> SearchResult:
        """The problem without integers: one relaxation."""
        if not continuous_feasible(self.structure, jax.tree.map(lambda leaf: np.asarray(leaf)[0], instances)):
            return SearchResult(None, np.inf, np.inf, codes.INFEASIBLE, None, 0)
        if not np.isfinite(root.x[0]).all():
            return SearchResult(None, np.inf, -np.inf, codes.FAILED, None, 1)
        value = float(root.objective[0])
        bound = min(max(float(root.bound[0]), 0.0), value)
        closed = closes(value, bound, relaxer.scenario(0).scale, gap)
        status, by = (codes.OPTIMAL, "relaxation") if closed else (codes.LIMIT, None)
        return SearchResult(root.x[0], value, bound, status, by, 1, root.start(0))

    def _plan(
        self,
        constants: Constants,
        instance,
        result: SearchResult,
        mv_now,
        free_response,
        setpoint,
        gap,
        begin,
    ) -> Plan:
        elapsed = lambda: time.perf_counter() - begin - self.solver.compiling  # noqa: E731
        if result.x is None:
            name = codes.STATUS[result.status]
            return Plan(name, None, None, None, None, None, None, None, None, result.nodes, elapsed(), None)
        x = np.array(result.x)
        integer = constants.integer
        x[integer] = np.round(x[integer])
        x = _repair(self.structure, instance, x)
        moves = (x * np.asarray(constants.qp.scale)).reshape(self.structure.mv_count, -1).T
        objective, cv, eps = self.objective(moves, free_response, setpoint)
        bound = min(result.bound, objective)
        state = result.status
        if state == codes.OPTIMAL and not closes(objective, bound, constants.scale, gap):
            state = codes.LIMIT
        return Plan(
            status=codes.STATUS[state],
            objective=objective,
            bound=bound,
            gap=float(relative_gap(objective, bound, constants.scale)),
            moves=moves,
            mv=mv_now + np.cumsum(sample_moves(self.structure) @ moves, axis=0),
            cv=cv,
            eps_high=eps[0],
            eps_low=eps[1],
            nodes=result.nodes,
            solve_time_s=elapsed(),
            finished_by=result.finished_by if state == codes.OPTIMAL else None,
            warm=result.root,
        )

    def objective(
        self, moves, free_response, setpoint
    ) -> tuple[float, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """(6.6) of a plan in engineering units, with its predictions and limit violations.

        Args:
            moves: ``"block mv"`` [MV unit].
            free_response: Lambda, ``"horizon cv"``.
            setpoint: r, ``"horizon cv"``.

        Returns:
            ``(objective, cv, (eps_high, eps_low))``.
        """
        tuning = self._numbers
        cv = free_response + np.tensordot(self.matrix, moves, ((3, 2), (0, 1))).T
        first = self.structure.first_penalised - 1
        y, deviation = cv[first:], cv[first:] - setpoint[first:]
        beyond = np.maximum(np.abs(deviation) - tuning.deadzone, 0.0)
        eps_high = np.maximum((y - tuning.cv_high).max(axis=0), 0.0)
        eps_low = np.maximum((tuning.cv_low - y).max(axis=0), 0.0)
        counts = moves_per_block(self.structure)[:, None]
        value = (
            (tuning.cv_weight * deviation**2).sum()
            + (tuning.move_weight * counts * moves**2).sum()
            + (tuning.soft_quadratic * beyond**2 + tuning.soft_linear * beyond).sum()
            + (tuning.slack_weight * (eps_high + eps_low)).sum()
        )
        return float(value), cv, (eps_high, eps_low)


def _repair(structure: Structure, instance: QpInstance, x: np.ndarray) -> np.ndarray:
    """Take solver tolerance out of the continuous moves: clip moves, then positions, block after block."""
    x = x.copy()
    lower, upper = np.asarray(instance.lower), np.asarray(instance.upper)
    row_low, row_high = np.asarray(instance.row_low), np.asarray(instance.row_high)
    counts, blocks = moves_per_block(structure), structure.block_count
    for mv, row in enumerate(first_position_rows(structure)):
        columns = slice(mv * blocks, (mv + 1) * blocks)
        if mv not in structure.integer_mvs:
            position, own = 0.0, x[columns]
            for b in range(blocks):
                low = max(lower[columns][b], (row_low[row + b] - position) / counts[b])
                high = min(upper[columns][b], (row_high[row + b] - position) / counts[b])
                own[b] = min(max(own[b], low), high) if low <= high else own[b]
                position += counts[b] * own[b]
    return x


def solve_plan(
    model: StepResponseModel,
    structure: Structure,
    tuning: Tuning,
    *,
    mv_now: Float[ArrayLike, " mv"],
    last_move: Float[ArrayLike, " mv"],
    free_response: Float[ArrayLike, "horizon cv"],
    setpoint: Float[ArrayLike, "horizon cv"],
    previous_moves: Float[ArrayLike, "block mv"] | None = None,
    time_limit: float | None = None,
    gap: float = 1e-6,
    finish: str = "auto",
) -> Plan:
    """Solve one controller step.

    Args:
        model: step-response model.
        structure: static configuration.
        tuning: weights and limits.
        mv_now: MVs before the move, ``"mv"`` [MV unit], within their limits.
        last_move: previous move, ``"mv"`` [MV unit]; oscillation rows use it rounded to whole steps.
        free_response: Lambda at j = 1..Hp with bias, ``"horizon cv"`` [CV unit].
        setpoint: r at j = 1..Hp, ``"horizon cv"`` [CV unit].
        previous_moves: moves to start from, ``"block mv"``; may be infeasible, never changes the answer.
        time_limit: seconds after which the best plan so far is returned with its true gap; None for none.
        gap: relative gap at which the plan counts as optimal.
        finish: ``auto``, ``enumeration``, ``highs`` or ``branch-and-bound``.

    Returns:
        `Plan`.

    Raises:
        InputError: naming the field, for wrong shapes, NaN or an MV outside its limits.
    """
    now = check_vector("mv_now", mv_now, structure.mv_names, "MV unit")
    check_vector("last_move", last_move, structure.mv_names, "MV unit")
    for path, value in (("free_response", free_response), ("setpoint", setpoint)):
        array = np.asarray(value, dtype=np.float64)
        expected = (structure.prediction_horizon, structure.cv_count)
        if array.shape != expected or not sound(array).all():
            raise InputError(
                path,
                f"shape {list(array.shape)}",
                f"finite numbers of size {LARGEST:g} at most and of shape {list(expected)} [CV unit]",
            )
    low, high = np.asarray(tuning.mv_low), np.asarray(tuning.mv_high)
    for i, name in enumerate(structure.mv_names):
        drift = DRIFT * (structure.integer_step[i] or max(1.0, abs(now[i])))
        if not low[i] - drift <= now[i] <= high[i] + drift:
            raise InputError(f"mv_now[{i}]", now[i], f"between {low[i]} and {high[i]} [MV unit] for {name}")
    if previous_moves is not None and np.shape(previous_moves) != (structure.block_count, structure.mv_count):
        raise InputError(
            "previous_moves",
            f"shape {list(np.shape(previous_moves))}",
            f"shape {[structure.block_count, structure.mv_count]}, block by MV",
        )
    return Planner(structure, tuning, model).solve(
        mv_now=now,
        last_move=last_move,
        free_response=free_response,
        setpoint=setpoint,
        previous_moves=previous_moves,
        time_limit=time_limit,
        gap=gap,
        finish=finish,
    )
