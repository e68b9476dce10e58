"""One controller step: from free response and setpoint to a plan with its certificate (thesis 5.3, 6.1).

`Planner` keeps what is constant between samples; the controllers and the `plan` command call it.
"""

from __future__ import annotations

import dataclasses
import functools
import time

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxmpc import status as codes
from jaxmpc.blocking import first_position_rows, moves_per_block, sample_moves
from jaxmpc.condense import DRIFT, QpInstance, condense, dynamic_matrix, integer_columns, make_instance
from jaxmpc.errors import InputError
from jaxmpc.integer import FINISHES, continuous_feasible, solve_integers
from jaxmpc.newton import WarmStart
from jaxmpc.relaxer import Constants, Relaxer
from jaxmpc.search import SearchResult
from jaxmpc.step_response import StepResponseModel
from jaxmpc.structure import Structure
from jaxmpc.tuning import Tuning

WIDEST_ENVELOPE = 4  # steps up to which the envelope of the squared integer move is built


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


_condense = eqx.filter_jit(condense)


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
        self.matrix = np.asarray(dynamic_matrix(structure, model.coefficients))
        self._relaxers: dict[int, Relaxer] = {}
        self._started = False
        limits = np.concatenate([np.asarray(tuning.cv_low), np.asarray(tuning.cv_high)])
        self.has_limits = bool(np.isfinite(limits).any() and (np.asarray(tuning.slack_weight) > 0).any())

    def relaxer(self, envelope: int) -> Relaxer:
        """Compiled relaxations for integer ranges of so many steps, made when first needed."""
        if envelope not in self._relaxers:
            qp = _condense(
                self.structure,
                self.tuning,
                self.model.coefficients,
                envelope=envelope,
                has_limits=self.has_limits,
            )
            self._relaxers[envelope] = Relaxer([Constants(self.structure, qp)])
        return self._relaxers[envelope]

    def constants(self, envelope: int) -> Constants:
        """Constants for integer ranges of so many steps."""
        return self.relaxer(envelope).scenario(0)

    def solve(
        self,
        *,
        mv_now,
        last_move,
        free_response,
        setpoint,
        previous_moves=None,
        past_moves=None,
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
        as_array = lambda v: np.asarray(v, dtype=np.float64)  # noqa: E731
        free_response, setpoint, mv_now = as_array(free_response), as_array(setpoint), as_array(mv_now)
        past = None if past_moves is None else as_array(past_moves)

        def instance_of(constants: Constants) -> QpInstance:
            return _make_instance(
                self.structure,
                self.tuning,
                constants.qp,
                free_response,
                setpoint,
                mv_now,
                as_array(last_move),
                past,
                recover,
            )

        relaxer = self.relaxer(1)
        integer = relaxer.integer
        if not self._started:  # compiles; the clock measures solves
            jax.block_until_ready(instance_of(relaxer.scenario(0)))
            self._started = True
        begin = time.perf_counter() - self._compiling()
        instance = instance_of(relaxer.scenario(0))
        if len(integer):
            lower, upper = self._bounded(instance)
            envelope = int(max(np.abs(lower[:, integer]).max(), np.abs(upper[:, integer]).max()))
            if envelope > 1:
                relaxer = self.relaxer(envelope if envelope <= WIDEST_ENVELOPE else 0)
                instance = instance_of(relaxer.scenario(0))
            instance = eqx.tree_at(lambda i: (i.lower, i.upper), instance, (lower, upper))
        constants = relaxer.scenario(0)
        starts = []
        if previous_moves is not None and len(integer):
            scale = np.asarray(constants.qp.scale).reshape(self.structure.mv_count, -1).T
            wanted = (as_array(previous_moves) / scale).T.reshape(-1)[integer]
            starts.append(np.clip(np.nan_to_num(wanted), -1e6, 1e6))
        start = jax.tree.map(lambda leaf: np.asarray(leaf)[None], _fitting(warm, constants))
        result = (
            solve_integers(
                relaxer, instance, starts=[starts], warm=start, gap=gap, time_limit=time_limit, finish=finish
            )[0]
            if len(integer)
            else self._solve_relaxed(relaxer, instance, start, gap)
        )
        instance = jax.tree.map(lambda leaf: np.asarray(leaf)[0], instance)
        return self._plan(constants, instance, result, mv_now, free_response, setpoint, gap, begin)

    def _compiling(self) -> float:
        """Seconds of compilation so far."""
        return sum(relaxer.compiling for relaxer in self._relaxers.values())

    def _solve_relaxed(
        self, relaxer: Relaxer, instance: QpInstance, start: WarmStart, gap: float
    ) -> SearchResult:
        """The problem without integers: one relaxation."""
        if not continuous_feasible(self.structure, jax.tree.map(lambda leaf: np.asarray(leaf)[0], instance)):
            return SearchResult(None, np.inf, np.inf, codes.INFEASIBLE, None, 0)
        root = relaxer.solve_roots(instance, start)
        if not np.isfinite(root.x[0]).all():
            return SearchResult(None, np.inf, -np.inf, codes.FAILED, None, 1)
        value = float(root.objective[0])
        bound = min(max(float(root.bound[0]), 0.0), value)
        closed = value - bound <= max(gap, 1e-9) * max(abs(value), 1e-6 * relaxer.scenario(0).scale)
        status, by = (codes.OPTIMAL, "relaxation") if closed else (codes.LIMIT, None)
        return SearchResult(root.x[0], value, bound, status, by, 1, root.start(0))

    def _bounded(self, instance: QpInstance) -> tuple[np.ndarray, np.ndarray]:
        """Finite limits ``"1 n"`` for integer moves that have none: the level set of a rounded plan (see `levelset`)."""
        lower, upper = np.array(instance.lower), np.array(instance.upper)
        integer = integer_columns(self.structure)
        if np.isfinite(lower[:, integer]).all() and np.isfinite(upper[:, integer]).all():
            return lower, upper
        relaxer = self.relaxer(0)
        constants = relaxer.scenario(0)
        padded = _padded(instance, constants)
        start = jax.tree.map(lambda leaf: leaf[None], constants.cold)
        root = relaxer.solve_roots(padded, start)
        center = root.x[:, integer]
        whole_low = np.where(np.isfinite(lower[:, integer]), lower[:, integer], -1e6)
        whole_high = np.where(np.isfinite(upper[:, integer]), upper[:, integer], 1e6)
        fixed_low, fixed_high = lower.copy(), upper.copy()
        fixed_low[:, integer] = fixed_high[:, integer] = np.clip(np.round(center), whole_low, whole_high)
        fixed = eqx.tree_at(lambda i: (i.lower, i.upper), padded, (fixed_low, fixed_high))
        rounded = relaxer.solve_roots(fixed, start)
        reach = np.sqrt(2.0 * max(rounded.snapped[0] - root.bound[0], 0.0) * constants.radius) + 1.0
        if not np.isfinite(reach).all():
            raise InputError(
                "tuning.move_low",
                "infinite",
                "a finite move or MV limit for every integer MV that has neither weight nor effect",
            )
        lower[:, integer] = np.maximum(lower[:, integer], np.ceil(center - reach))
        upper[:, integer] = np.minimum(upper[:, integer], np.floor(center + reach))
        return lower, upper

    def _plan(
        self, constants, instance, result: SearchResult, mv_now, free_response, setpoint, gap, begin
    ) -> Plan:
        elapsed = lambda: time.perf_counter() - begin - self._compiling()  # noqa: E731
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
        reference = max(abs(objective), 1e-6 * constants.scale)
        relative = max(objective - bound, 0.0) / reference
        state = result.status
        if state == codes.OPTIMAL and relative > max(gap, 1e-9):
            state = codes.LIMIT
        return Plan(
            status=codes.STATUS[state],
            objective=objective,
            bound=bound,
            gap=relative,
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
        tuning = self.tuning
        cv = free_response + np.einsum("cjmb,bm->jc", self.matrix, moves)
        first = self.structure.first_penalised - 1
        y, deviation = cv[first:], cv[first:] - setpoint[first:]
        beyond = np.maximum(np.abs(deviation) - np.asarray(tuning.deadzone), 0.0)
        eps_high = np.maximum((y - np.asarray(tuning.cv_high)).max(axis=0), 0.0)
        eps_low = np.maximum((np.asarray(tuning.cv_low) - y).max(axis=0), 0.0)
        counts = moves_per_block(self.structure)[:, None]
        value = (
            (np.asarray(tuning.cv_weight) * deviation**2).sum()
            + (np.asarray(tuning.move_weight) * counts * moves**2).sum()
            + (np.asarray(tuning.soft_quadratic) * beyond**2 + np.asarray(tuning.soft_linear) * beyond).sum()
            + (np.asarray(tuning.slack_weight) * (eps_high + eps_low)).sum()
        )
        return float(value), cv, (eps_high, eps_low)


def _fitting(warm: WarmStart | None, constants: Constants) -> WarmStart:
    """The start if it has as many rows as the problem (wider integer ranges have more), else a cold one."""
    fits = warm is not None and len(warm.row_price) == constants.qp.theta.shape[0]
    return warm if warm is not None and fits else constants.cold


def _padded(instance: QpInstance, constants: Constants) -> QpInstance:
    """The instance with as many envelope rows as the constants have."""
    rows, predictions = constants.qp.theta.shape[0], instance.limit_high.shape[-1]
    offset = np.asarray(instance.offset)[:, :predictions]
    offset = np.concatenate([offset, np.zeros((1, rows - predictions))], axis=1)
    return eqx.tree_at(lambda i: i.offset, instance, offset)


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


def check_match(structure: Structure, model: StepResponseModel) -> None:
    """Refuse a model whose names or sampling interval differ from the structure's."""
    for key, ours, theirs in (
        ("cv", structure.cv_names, model.cv_names),
        ("mv", structure.mv_names, model.mv_names),
    ):
        if ours != theirs:
            raise InputError(
                f"model.{key}", list(theirs), f"the structure's names in its order, {list(ours)}"
            )
    if abs(structure.dt - model.dt) > 1e-9 * structure.dt:
        raise InputError("model.dt", model.dt, f"the structure's sampling interval {structure.dt} s")


def check_vector(path: str, value, names: tuple[str, ...], unit: str) -> np.ndarray:
    """A finite vector with one entry per name, or an `InputError`."""
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (len(names),) or not np.isfinite(array).all():
        raise InputError(
            path, np.asarray(value).tolist(), f"{len(names)} finite numbers [{unit}] for {', '.join(names)}"
        )
    return array


def solve_plan(
    model: StepResponseModel,
    structure: Structure,
    tuning: Tuning,
    *,
    mv_now,
    last_move,
    free_response,
    setpoint,
    previous_moves=None,
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
        if array.shape != expected or not np.isfinite(array).all():
            raise InputError(
                path, f"shape {list(array.shape)}", f"finite numbers of shape {list(expected)} [CV unit]"
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
