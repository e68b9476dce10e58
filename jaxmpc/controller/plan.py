"""One controller step: from free response and setpoint to a plan with its certificate (thesis 5.3, 6.1).

`Planner` keeps what is constant between samples; the controllers and the `plan` command call it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from jaxmpc import html
from jaxmpc import status as codes
from jaxmpc.controller.batch import Controllers, check_finish, known_of, one_lane
from jaxmpc.controller.core import Core
from jaxmpc.controller.given import check_listed, check_position, checked_since, step_array
from jaxmpc.controller.sample import require_double_precision
from jaxmpc.integer.actuators import LONG_AGO, Actuator, actuators_of, samples_since
from jaxmpc.integer.finish import finish_steps
from jaxmpc.integer.host_search import SearchResult, no_whole_moves
from jaxmpc.integer.nearest import held_within
from jaxmpc.integer.relaxer import Relaxations
from jaxmpc.integer.search import Decision, Relaxed, decide
from jaxmpc.integer.solve import continuous_feasible
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.blocking import counts_by_mv, moves_of_samples
from jaxmpc.problem.condense import dynamic_matrix
from jaxmpc.problem.instance import QpInstance, make_instance
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from jaxmpc.programs.clock import Clock, in_time
from jaxmpc.programs.compilation import compiling_for
from jaxmpc.programs.lanes import Lanes
from jaxmpc.programs.packing import PackedCall
from jaxmpc.relaxed.gap import check_gap, check_time_limit, closes, relative_gap
from jaxmpc.relaxed.newton import MOST_STEPS, WarmStart

ROUNDED = "rounding leaves objective and bound farther apart than the gap that is asked for"


@dataclasses.dataclass(frozen=True)
class Plan:
    """A solved controller step, in engineering units.

    Attributes:
        status: ``optimal``, ``limit`` (the time limit came before the proof), ``unproven`` (something else did, as `reason`
            says), ``infeasible`` or ``failed``.
        objective: (6.6) with all constants; None without a plan.
        bound: proven lower bound of the objective.
        gap: relative gap between the two.
        moves: per-sample move of each block (`moves`) or the move at its first sample (`inputs`); zero beyond the last
            block of an MV with blocks of its own.
        mv: MVs of the Hu samples, row 0 after the move applied now.
        cv: predicted CVs at j = 1..Hp.
        eps_high, eps_low: largest violation of each CV limit over the penalised samples.
        nodes: relaxations solved in the search.
        solve_time_s: wall time of the solve without compilation [s].
        finished_by: which path closed the problem, None if none did.
        reason: a sentence that says why the plan is not optimal, None where it is.
        warm: prices of the root relaxation, a start for the next sample.
        integer_until: under an integer horizon, the samples from the first on in which the moves of each MV are whole (0 for
            a continuous one): later moves are relaxed, and so are objective and bound. None where no MV has relaxed ones.
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
    reason: str | None = None
    warm: WarmStart | None = None
    integer_until: Int[np.ndarray, " mv"] | None = None

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html.plan(self)


def _one_posed(
    core: Core, free_response, setpoint, mv_now, last_move, past_moves, start, settings
) -> tuple[QpInstance, Decision]:
    instance = make_instance(
        core.layout,
        core.size,
        core.tuning,
        core.qp,
        free_response=free_response,
        setpoint=setpoint,
        mv_now=mv_now,
        last_move=last_move,
        past_moves=past_moves,
        recover=settings[2] > 0,
    )
    tables = eqx.tree_at(lambda t: t.known, core.tables, core.tables.known & (settings[1] > 0))
    return instance, decide(core.qp, tables, instance, start, settings[0], settings[3])


@functools.partial(jax.jit, inline=True)  # its shapes and the program that calls it are one trace
def _posed(cores: Lanes[Core], *given) -> tuple[QpInstance, Decision]:
    """A step that is posed and decided as far as a compiled program decides it; all arrays with a lane axis."""
    return jax.vmap(functools.partial(_one_posed, cores.shared))(*given)


class Planner:
    """Solves the steps of one controller."""

    def __init__(self, structure: Structure, tuning: Tuning, model: StepResponseModel):
        self.structure, self.tuning, self.model = structure, tuning, model
        self.controllers = Controllers(structure, tuning, model)
        self._numbers = jax.tree.map(np.asarray, tuning)
        core, size = self.controllers.cores.shared, self.controllers.size
        whole = np.asarray(_matrix(core.layout, core.coefficients, np.arange(1, size.future + 1)))
        self.matrix = whole[:, : structure.prediction_horizon, :, : structure.block_count]
        zeros = lambda *shape: np.zeros((1, *shape))  # noqa: E731
        self._no_past = zeros(size.past, size.mvs)
        cold = jax.eval_shape(core.init, np.zeros(size.cvs), np.zeros(size.mvs)).warm
        self._cold = jax.tree.map(lambda v: np.zeros((1, *v.shape)), cold)
        self._pose = PackedCall(_posed)
        self._integer_until = np.array(structure.integer_until) if structure.relaxed_moves else None

    def solve(
        self,
        *,
        mv_now: Float[ArrayLike, " mv"],
        last_move: Float[ArrayLike, " mv"],
        free_response: Float[ArrayLike, "horizon cv"],
        setpoint: Float[ArrayLike, "horizon cv"],
        previous_moves: Float[ArrayLike, "block mv"] | None = None,
        past_moves: Float[ArrayLike, "window mv"] | None = None,
        samples_since_move: Sequence[int | None] | None = None,
        recover: bool = False,
        warm: WarmStart | None = None,
        time_limit: float | None = None,
        gap: float = 1e-6,
        finish: str = "auto",
    ) -> Plan:
        """Solve one step; arguments as in `solve_plan`.

        Args:
            past_moves: moves of the mean-move window, ``"window mv"`` oldest first, or None; the dwell sees them, too.
            recover: let MVs outside their limits return the shortest way.
            warm: `Plan.warm` of a neighbouring step; ignored where its size does not fit.
        """
        check_finish(finish)
        require_double_precision()
        gap, time_limit = check_gap("gap", gap), check_time_limit("time_limit", time_limit)
        as_array = lambda v: np.asarray(v, dtype=np.float64)  # noqa: E731
        free_response, setpoint, mv_now = as_array(free_response), as_array(setpoint), as_array(mv_now)
        check_listed(self.structure, mv_now)
        past: np.ndarray = self._no_past.copy()
        if past_moves is not None:
            moves = as_array(past_moves)[-past.shape[1] :]
            past[0, past.shape[1] - len(moves) :] = moves
        fits = lambda a, b: np.shape(a) == np.shape(b)[1:]  # noqa: E731
        start = self._cold
        if warm is not None and jax.tree.all(jax.tree.map(fits, warm, start)):
            start = jax.tree.map(lambda leaf: np.asarray(leaf)[None], warm)
        whole = self.controllers.over_horizon
        known = whole(free_response[None]), whole(setpoint[None]), mv_now[None], as_array(last_move)[None]
        clock, own = Clock(), self.controllers
        until = own.pace.before_tail(time_limit)
        left = lambda: None if until is None else until - clock.seconds  # noqa: E731
        with compiling_for(str(own.size)), in_time(time_limit):
            while True:
                most, one = own.pace.steps_within(left()), Clock()
                settings = np.array([[gap, float(finish == "auto"), float(recover), most]])
                instance, found = self._pose(own.cores, own.flat, *known, past, start, settings)
                steps, root = int(found.steps[0]), found.root
                own.pace.took(one.seconds, steps)
                if root.steps[0] < most or root.status[0] == codes.OPTIMAL or not own.pace.fits(left()):
                    break
                start = root.warm  # there was more time than it was given
            actuators = self._actuators(mv_now, past[0], known[3], samples_since_move)
            line = gap, until, finish, clock.seconds
            result = self._decided(instance, found, previous_moves, actuators, recover, *line)
            plan = self._plan(one_lane(instance), result, mv_now, free_response, setpoint, gap, clock)
        if time_limit is not None and result.status == codes.LIMIT:
            own.pace.ended(clock.seconds - time_limit)
        return plan

    def _actuators(self, mv_now, past, last_move, samples_since_move) -> list[list[Actuator]]:
        """What lists and a dwell leave the integer MVs, one lane; none where there are neither."""
        if not self.structure.has_gaps_or_dwell:
            return []
        moves = np.concatenate([past[:-1], np.where(last_move == 0.0, past[-1:], last_move)])
        told = _told(self.structure, samples_since_move)
        return [actuators_of(self.structure, mv_now, np.minimum(samples_since(self.structure, moves), told))]

    def _decided(
        self,
        instance: QpInstance,
        decision: Decision,
        previous_moves,
        actuators: list[list[Actuator]],
        recover: bool,
        gap,
        time_limit,
        finish: str,
        spent: float,
    ) -> SearchResult:
        """How the step ended, by the compiled program or on the host."""
        found = one_lane(decision)
        if not self.structure.integer_mvs:
            stopped = time_limit is not None and found.root.steps < MOST_STEPS
            return self._relaxed(one_lane(instance), found.root, gap, stopped)
        start = found.root.warm
        if found.closed and finish == "auto":
            by = codes.FINISHERS[int(found.finished_by)]
            x, value, bound = np.asarray(found.x), float(found.value), float(found.bound)
            return SearchResult(x, value, bound, codes.OPTIMAL, by, int(found.nodes), start, spent)
        previous = np.zeros((1, self.controllers.size.blocks, self.controllers.size.mvs))
        if previous_moves is not None:
            previous[0, : self.structure.block_count] = previous_moves
        (result,) = finish_steps(
            self.controllers.relaxers,
            instance,
            Relaxations.of(decision.root),
            previous_moves=previous,
            gap=gap,
            time_limit=time_limit,
            finish=finish,
            actuators=actuators,
            recover=recover,
            spent=spent,
            known=None if time_limit is None else known_of(decision),
        )
        return result

    def _relaxed(self, instance: QpInstance, root: Relaxed, gap: float, stopped: bool) -> SearchResult:
        """The problem without integers: one relaxation, which the time limit may have stopped."""
        if not continuous_feasible(self.structure, self.controllers.size, instance):
            return no_whole_moves()
        if not np.isfinite(root.warm.x).all():
            why = "the relaxation was not solved: its numbers are not finite"
            return SearchResult(None, np.inf, -np.inf, codes.FAILED, None, 1, reason=why)
        value = float(root.objective)
        bound = min(max(float(root.bound), 0.0), value)
        x = np.asarray(root.warm.x)
        if closes(value, bound, self._unit, gap):
            return SearchResult(x, value, bound, codes.OPTIMAL, "relaxation", 1, root.warm)
        if stopped:
            return SearchResult(x, value, bound, codes.LIMIT, None, 1, root.warm, reason=codes.OUT_OF_TIME)
        return SearchResult(x, value, bound, codes.UNPROVEN, None, 1, root.warm, reason=ROUNDED)

    @functools.cached_property
    def _unit(self) -> float:
        """Of the objective, see `gap.closes`."""
        return float(self.controllers.cores.shared.tables.scale)

    def _plan(
        self, instance: QpInstance, result: SearchResult, mv_now, free_response, setpoint, gap, clock: Clock
    ) -> Plan:
        if result.x is None:
            name, took = codes.STATUS[result.status], clock.seconds
            nothing: Any = (None,) * 8
            said: dict[str, Any] = dict(reason=result.reason, integer_until=self._integer_until)
            return Plan(name, *nothing, nodes=result.nodes, solve_time_s=took, finished_by=None, **said)
        core, size = self.controllers.cores.shared, self.controllers.size
        x = np.array(result.x)
        x = np.where(np.asarray(core.qp.whole), np.round(x), x)
        x = held_within(self.structure, size, instance, x)  # solver tolerance is taken out
        moves = (x * np.asarray(core.qp.scale)).reshape(size.mvs, -1).T[: self.structure.block_count]
        mv = mv_now + np.cumsum(moves_of_samples(self.structure, moves), axis=0)
        objective, cv, eps = self.objective(moves, mv, free_response, setpoint)
        bound = min(result.bound, objective)
        state, reason = result.status, result.reason
        if state == codes.OPTIMAL and not closes(objective, bound, self._unit, gap):
            state, reason = codes.UNPROVEN, ROUNDED
        return Plan(
            status=codes.STATUS[state],
            objective=objective,
            bound=bound,
            gap=float(relative_gap(objective, bound, self._unit)),
            moves=moves,
            mv=mv,
            cv=cv,
            eps_high=eps[0],
            eps_low=eps[1],
            nodes=result.nodes,
            solve_time_s=clock.seconds,
            finished_by=result.finished_by if state == codes.OPTIMAL else None,
            reason=reason,
            warm=result.root,
            integer_until=self._integer_until,
        )

    def objective(
        self, moves, mv, free_response, setpoint
    ) -> tuple[float, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """(6.6) and (6.20) of a plan in engineering units, with its predictions and limit violations.

        Args:
            moves: ``"block mv"``.
            mv: the MVs that follow, ``"sample mv"``.

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
        counts = counts_by_mv(self.structure)
        held = np.minimum(np.arange(first, len(cv)), len(mv) - 1)
        value = (
            (tuning.cv_weight * deviation**2).sum()
            + (tuning.move_weight * counts * moves**2).sum()
            + (tuning.soft_quadratic * beyond**2 + tuning.soft_linear * beyond).sum()
            + (tuning.slack_weight * (eps_high + eps_low)).sum()
            + (tuning.ideal_weight * (mv[held] - tuning.ideal) ** 2).sum()
        )
        return float(value), cv, (eps_high, eps_low)


def _told(structure: Structure, since: Sequence[int | None] | None) -> np.ndarray:
    """Samples since the last moves, `LONG_AGO` where nothing is told."""
    return np.array([LONG_AGO if n is None else n for n in since or (None,) * structure.mv_count])


_matrix = jax.jit(dynamic_matrix)


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
    samples_since_move: Sequence[int | None] | None = None,
    time_limit: float | None = None,
    gap: float = 1e-6,
    finish: str = "auto",
) -> Plan:
    """Solve one controller step.

    Args:
        mv_now: MVs before the move, ``"mv"`` [MV unit], within their limits and on a value of their lists.
        last_move: previous move, ``"mv"`` [MV unit]; oscillation rows use it rounded to whole steps.
        free_response: Lambda at j = 1..Hp with bias, ``"horizon cv"`` [CV unit].
        setpoint: r at j = 1..Hp, ``"horizon cv"`` [CV unit].
        previous_moves: moves to start from, ``"block mv"``; may be infeasible, never changes the answer.
        samples_since_move: samples since the last move of every MV, for the dwell; 1 for a move at the sample before, None
            for long ago, which a `last_move` of half a step or more contradicts: the MV has then just moved.
        time_limit: seconds after which the best plan so far is returned with its true gap; None for none.
        gap: relative gap at which the plan counts as optimal.
        finish: ``auto``, ``enumeration``, ``highs`` or ``branch-and-bound``.

    Raises:
        InputError: naming the field, for wrong shapes, NaN or an MV outside its limits.
    """
    given = dict(mv_now=mv_now, last_move=last_move, free_response=free_response, setpoint=setpoint)
    known: dict[str, Any] = {
        path: step_array(path, value, structure)
        for path, value in (given | {"previous_moves": previous_moves}).items()
    }
    check_position(structure, tuning, known["mv_now"])
    known["samples_since_move"] = checked_since(structure, samples_since_move)
    return Planner(structure, tuning, model).solve(**known, time_limit=time_limit, gap=gap, finish=finish)
