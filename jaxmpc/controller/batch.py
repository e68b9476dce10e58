"""Controllers that advance together as lanes (thesis 5.3, 6), of any structures, tunings and models.

A step is one compiled call; whole moves that it leaves open are finished on the host, by `integer.finish`.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import ArrayLike, Bool, Float

from jaxmpc import status as codes
from jaxmpc.check import among
from jaxmpc.controller.build import Scenarios
from jaxmpc.controller.core import Core, Moment
from jaxmpc.controller.sample import Sample, checked, checked_off, checked_start
from jaxmpc.controller.state import ControllerState, StepInfo
from jaxmpc.errors import InputError
from jaxmpc.integer.actuators import Actuator, actuators_of, samples_since
from jaxmpc.integer.finish import finish_steps
from jaxmpc.integer.host_search import Known, SearchResult
from jaxmpc.integer.relaxer import Relaxations, Relaxer, pace_of
from jaxmpc.integer.search import Decision
from jaxmpc.integer.solve import FINISHES
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from jaxmpc.programs.clock import Clock, in_time
from jaxmpc.programs.compilation import compiling_for
from jaxmpc.programs.lanes import Lanes
from jaxmpc.programs.pace import Pace
from jaxmpc.programs.packing import PackedCall, flattened, rebuilt
from jaxmpc.relaxed.gap import FINEST, check_gap, check_time_limit, relative_gap

KEPT = 8  # combinations of CVs that are switched off, with what their searches need


class Relaxers:
    """Compiled relaxations of scenarios by the steps of their integer ranges, made when first needed."""

    def __init__(self, scenarios: Scenarios, made: dict[int, Relaxer]):
        self.scenarios, self.made = scenarios, made

    def __call__(self, envelope: int) -> Relaxer:
        """For integer ranges of so many steps."""
        if envelope not in self.made:
            qps = self.scenarios.problems(envelope)
            self.made[envelope] = Relaxer(qps, self.scenarios.constants(qps))
        return self.made[envelope]

    def part(self, index: np.ndarray) -> Relaxers:
        """Of some of the scenarios."""
        return Relaxers(
            self.scenarios.part(index), {key: made.part(index) for key, made in self.made.items()}
        )


@dataclasses.dataclass(eq=False)
class Batch:
    """Controllers that are built: the lanes of `Controllers`, or some of them."""

    scenarios: Scenarios  # what they are made of
    cores: Lanes[Core]  # what compiled programs know of them
    relaxers: Relaxers  # what searches on the host need
    gap: float
    time_limit: float | None
    finish: str
    pace: Pace  # of compiled steps as far as it is known
    decided: bool = False  # whether a step has been

    def __post_init__(self):
        self.count, self.size = self.scenarios.count, self.scenarios.size
        self.structure, self.dv_names = self.scenarios.structures[0], self.scenarios.models[0].dv_names
        self._step = PackedCall(_stepped)
        self._reduced: dict[bytes, Batch] = {}

    def of(self, scenarios: Scenarios) -> Batch:
        """The same controllers made of other scenarios; nothing is compiled where programs of the same form hold them."""
        cores, relaxers = _built(scenarios)
        cores = Lanes(*(old.of(new) for old, new in zip(_halves(self.cores), _halves(cores), strict=True)))
        return Batch(
            scenarios, cores, relaxers, self.gap, self.time_limit, self.finish, self.pace, self.decided
        )

    def without(self, off: Bool[np.ndarray, "scenario cv"]) -> Batch:
        """The same without the CVs that are switched off."""
        pattern = off.tobytes()
        if not off.any():
            return self
        if pattern not in self._reduced:
            self._reduced[pattern] = self.of(self.scenarios.without(off))
            while len(self._reduced) > KEPT:
                self._reduced.pop(next(iter(self._reduced)))
        return self._reduced[pattern]

    def part(self, index: np.ndarray) -> Batch:
        """The controllers of some scenarios, which share what is computed already."""
        if self.count == len(index) and (index == np.arange(self.count)).all():
            return self
        relaxers = self.relaxers.part(index)
        own = self.gap, self.time_limit, self.finish, self.pace, self.decided
        return Batch(relaxers.scenarios, self.cores.take(index), relaxers, *own)

    def repeated(self, count: int) -> Batch:
        """So many copies of a single controller, which share everything."""
        return self.part(np.zeros(count, dtype=int))

    @property
    def searching(self) -> bool:
        """Whether whole moves may be searched for in a compiled call."""
        return self.finish == "auto"

    @property
    def most(self) -> Float[np.ndarray, " scenario"]:
        """Newton steps of a compiled step that fit the time limit, infinite where there are no integer MVs or no limit."""
        return np.where(self.integer, self.pace.steps_within(self.pace.before_tail(self.time_limit)), np.inf)

    @property
    def settings(self) -> Float[np.ndarray, "scenario 3"]:
        """Of `considered`."""
        shared = np.tile([max(self.gap, FINEST), float(self.searching)], (self.count, 1))
        return np.concatenate([shared, self.most[:, None]], axis=1)

    def __getstate__(self) -> dict[str, Any]:
        """All but forms of trees, which are of no use outside this process."""
        return {key: value for key, value in self.__dict__.items() if key != "flat"}

    @functools.cached_property
    def flat(self) -> tuple[list[jax.Array], Any]:
        """All that compiled programs know, taken apart."""
        return flattened(self.cores)

    def init(
        self,
        cv: Float[ArrayLike, "scenario cv"],
        mv: Float[ArrayLike, "scenario mv"],
        dv: Float[ArrayLike, "scenario dv"] | None = None,
    ) -> ControllerState:
        """State at steady states; arguments and errors as in `Controller.init`, the scenario axis first."""
        start = checked_start(self.structure, cv, mv, dv, dv_names=self.dv_names, lanes=self.count)
        leaves, form = self.flat
        return jax.tree.map(np.asarray, _init(leaves, *start, form))

    def step(
        self,
        state: ControllerState,
        cv: Float[ArrayLike, "scenario cv"],
        setpoint: Float[ArrayLike, "scenario cv"] | Float[ArrayLike, "scenario horizon cv"],
        mv: Float[ArrayLike, "scenario mv"] | None = None,
        manual: Bool[ArrayLike, "scenario mv"] | None = None,
        dv: Float[ArrayLike, "scenario dv"] | Float[ArrayLike, "scenario horizon dv"] | None = None,
        cv_off: Bool[ArrayLike, "scenario cv"] | None = None,
    ) -> tuple[ControllerState, StepInfo]:
        """One sample of all scenarios; arguments as in `Controller.step`, the scenario axis first."""
        own: dict[str, Any] = dict(dv_names=self.dv_names, lanes=self.count)
        off = checked_off(self.structure, cv_off, lanes=self.count)
        return self.decide(state, checked(self.structure, cv, setpoint, mv, manual, dv, **own), off)

    def decide(
        self, state: ControllerState, sample: Sample, off: Bool[np.ndarray, "scenario cv"] | None = None
    ) -> tuple[ControllerState, StepInfo]:
        """`step` of a checked sample; `off`: CVs that somebody has switched off."""
        if off is not None and off.any():
            return self.without(off).decide(state, sample)
        clock = Clock()
        sample = self.over_register(sample)
        given = jax.tree.map(np.asarray, (state, sample, self.settings))
        with compiling_for(str(self.size)), in_time(self.time_limit):
            state, info, moment = self._step(self.cores, self.flat, *given)
        self.pace.took(clock.seconds, int(moment.decision.steps.sum()), self.count)
        seconds = np.full(self.count, clock.seconds / self.count)
        fields: dict[str, Any] = {"solve_time": seconds}
        left = np.flatnonzero(~moment.decision.closed & self.integer)
        if left.size:
            x, good, said = self.finish_open(moment, left, seconds[left])
            for name, values in said.items():
                fields[name] = seconds if name == "solve_time" else np.array(getattr(info, name))
                fields[name][left] = values
            leaves, form = self.flat
            state, moves = jax.tree.map(np.asarray, _carry_out(leaves, moment, x, good, form))
            fields |= dict(move=moves[:, 0], mv=state.mv, moves=moves)
            if self.time_limit is not None and self.count == 1 and fields["status"][0] == codes.LIMIT:
                self.pace.ended(clock.seconds - self.time_limit)
        self.decided = True
        return state, dataclasses.replace(info, **fields)

    @functools.cached_property
    def integer(self) -> Bool[np.ndarray, " scenario"]:
        """Which controllers have integer MVs."""
        return np.array([bool(s.integer_mvs) for s in self.scenarios.structures])

    def over_register(self, sample: Sample) -> Sample:
        """A sample with setpoints and measured disturbances over the shift register."""
        dv = None if sample.dv is None else self.over_horizon(sample.dv)
        return sample._replace(setpoint=self.over_horizon(sample.setpoint), dv=dv)

    def over_horizon(self, setpoint: Any) -> Any:
        """Setpoints over the shift register, the last one repeated: ``"scenario future cv"``; NumPy's unless traced."""
        xp: Any = jnp if traced(setpoint) else np
        rows = setpoint[:, None] if setpoint.ndim == 2 else setpoint
        more = max(self.size.future - rows.shape[1], 0)
        return xp.concatenate([rows, xp.repeat(rows[:, -1:], more, axis=1)], axis=1)[:, : self.size.future]

    def finish_open(
        self, moment: Moment, which: np.ndarray, spent: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Decide scenarios on the host that the compiled program left open.

        Args:
            moment: of all scenarios, with NumPy's arrays.
            spent: seconds that each of them has taken already.

        Returns:
            Plans of all scenarios, whether there is one, and what those that were decided here say of themselves, by the
            names of `StepInfo` and `Trajectory`.
        """
        x, good = np.array(moment.decision.x), np.array(moment.good)
        results: dict[int, SearchResult] = {}
        structures = [self.scenarios.structures[i] for i in which]
        for structure in dict.fromkeys(structures):
            own = np.array([its == structure for its in structures])
            results |= zip(which[own], self._finish_some(moment, which[own], spent[own]), strict=True)
        for i, result in results.items():
            good[i] = result.x is not None
            if result.x is not None:
                x[i] = result.x
        self.decided = True
        said = [_said(results[i], float(moment.unit[i])) for i in which]
        return x, good, {name: np.array([one[name] for one in said]) for name in said[0]}

    def _finish_some(self, moment: Moment, index: np.ndarray, spent: np.ndarray) -> list[SearchResult]:
        """Of scenarios of one structure."""
        own: Moment = jax.tree.map(lambda leaf: np.asarray(leaf)[index], moment)
        structure = self.scenarios.structures[index[0]]
        relaxers = self.without(np.asarray(moment.state.sensors.off)).relaxers
        try:
            with compiling_for(str(self.size)), in_time(self.time_limit):
                return finish_steps(
                    functools.cache(lambda envelope: relaxers(envelope).part(index)),
                    own.instance,
                    Relaxations.of(own.decision.root),
                    previous_moves=own.state.plan,  # pyright: ignore[reportArgumentType]
                    gap=self.gap,
                    time_limit=self.pace.before_tail(self.time_limit),
                    finish=self.finish,
                    actuators=_actuators(structure, own) if structure.has_gaps_or_dwell else (),
                    recover=True,
                    spent=spent,
                    known=None if self.time_limit is None else known_of(own.decision),
                )
        except InputError:  # moves without limits have ranges that follow from the measurements
            if not self.decided:
                raise
            return [
                SearchResult(None, np.inf, -np.inf, codes.FAILED, None, 0, seconds=float(s)) for s in spent
            ]


class Controllers(Batch):
    """Controllers that advance together, one per scenario.

    Args:
        structure: for all, or one per scenario; with CVs and MVs of the same names.
        tunings: one per scenario, or a single one for all.
        models: one per scenario, or a single one for all.
        count: number of scenarios where it does not follow.
        gap: relative gap of a solve with whole moves.
        time_limit: seconds of work per scenario and sample, None for none.
        finish: path that closes the integer problems, see `jaxmpc.integer.solve`.

    Raises:
        InputError: naming what does not fit.
    """

    def __init__(
        self,
        structure: Structure | Sequence[Structure],
        tunings: Tuning | Sequence[Tuning],
        models: StepResponseModel | Sequence[StepResponseModel],
        *,
        count: int | None = None,
        gap: float = 1e-6,
        time_limit: float | None = None,
        finish: str = "auto",
    ):
        options = check_gap("gap", gap), check_time_limit("time_limit", time_limit), check_finish(finish)
        some: Callable[[Any, type], Any] = lambda given, kind: [given] if isinstance(given, kind) else given  # noqa: E731
        given = some(structure, Structure), some(tunings, Tuning), some(models, StepResponseModel)
        scenarios = Scenarios.checked(*given, count)
        super().__init__(scenarios, *_built(scenarios), *options, pace_of(scenarios.size))


def _built(scenarios: Scenarios) -> tuple[Lanes[Core], Relaxers]:
    """What compiled programs know of controllers, and what searches on the host need."""
    with compiling_for(str(scenarios.size)):
        qps = scenarios.problems(1)
    constants = scenarios.constants(qps) if scenarios.integers else []
    relaxers = Relaxers(scenarios, {1: Relaxer(qps, constants)} if scenarios.integers else {})
    return scenarios.core(qps, constants), relaxers


def _halves(cores: Lanes[Core]) -> tuple[Core, Core]:
    return cores.each, cores.shared


def _actuators(structure: Structure, moment: Moment) -> list[list[Actuator]]:
    """What the integer MVs of every lane must keep besides limits and hard rows."""
    state, found = moment.state, []
    for k, past in enumerate(np.asarray(state.past_moves)):
        now, since = np.array(state.mv[k]), samples_since(structure, past)
        if moment.correction is not None:
            back = np.asarray(moment.correction[k])
            now += back
            since = np.where(samples_since(structure, back[None]) == 1, 0, since)  # it is a move, too
        found.append(actuators_of(structure, now, since, np.asarray(state.manual[k])))
    return found


def check_finish(finish: str) -> str:
    """A path that closes integer problems, or an `InputError`."""
    among("finish", finish, FINISHES)
    return finish


def known_of(decision: Decision) -> list[Known]:
    """What a compiled search has found for its scenarios, for moves of one step."""
    fields = decision.x, decision.value, np.maximum(decision.bound, 0.0)
    fields = (np.asarray(values) for values in fields)
    return [Known(x, float(value), float(bound)) for x, value, bound in zip(*fields, strict=True)]


def _said(result: SearchResult, unit: float) -> dict[str, Any]:
    """What a step that was decided on the host says of itself; see `Moment.said`."""
    found = result.x is not None
    value, bound = (result.value, result.bound) if found else (np.nan, np.nan)
    return {
        "status": result.status,
        "fallback": not found,
        "objective": value,
        "bound": bound,
        "gap": relative_gap(value, bound, unit),
        "nodes": result.nodes,
        "finished_by": codes.finisher_code(result.finished_by) if found else 0,
        "solve_time": result.seconds,
    }


@functools.partial(jax.jit, static_argnames="form")
def _init(leaves, cv, mv, dv, form) -> ControllerState:
    cores: Lanes[Core] = rebuilt(form, leaves)
    return cores.vmap(lambda core, *start: core.init(*start), cv, mv, dv)


@jax.jit
def considered(cores: Lanes[Core], state: ControllerState, sample: Sample, settings) -> Moment:
    """A sample of all scenarios, decided as far as a compiled program decides it.

    Args:
        settings: ``"scenario 3"``, relative gap, whether whole moves may be searched for (1 or 0), and Newton steps at most.
    """

    def one(core: Core, state, sample, settings):
        return core.consider(state, sample, settings[0], settings[1] > 0, settings[2])

    return cores.vmap(one, state, sample, settings)


def _stepped(cores: Lanes[Core], state, sample, settings) -> tuple:
    moments = considered(cores, state, sample, settings)
    return *cores.vmap(lambda core, moment: core.conclude(moment), moments), moments


@functools.partial(jax.jit, static_argnames="form")
def _carry_out(leaves, moment: Moment, x, good, form):
    cores: Lanes[Core] = rebuilt(form, leaves)
    return cores.vmap(lambda core, *plan: core.carry_out(*plan), moment, x, good)


def traced(*trees: Any) -> bool:
    """Whether anything in them is traced."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def one_lane(tree: Any) -> Any:
    """The only lane, on the host: indexing a JAX array is a dispatch."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[0], tree)
