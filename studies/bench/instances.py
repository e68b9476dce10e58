"""Problems of single samples, recorded in closed loops on the well (thesis chapter 7), for both blocking modes.

A recording is the trajectory of a run. The problems come from replaying it through the controller's own memory, so that a
sample has exactly the free response, history and limits it had in the loop, without solving anything. Recordings are
kept in the cache under a hash of everything that decides them but the solver: the same problems every time.
"""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.controller.case import Case, case_to_dict
from jaxmpc.controller.controller import Controller
from jaxmpc.files import write_atomically
from jaxmpc.loop.simulate import simulate
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from jaxmpc.process.host import HostPlant
from jaxmpc.process.reference import Reference
from jaxmpc.process.well.equations import well_hash
from jaxmpc.process.well.plant import WellPlant
from jaxmpc.programs.cache import cache_folder, read_sealed, sealed
from studies.bench.judge import taken
from studies.store.fingerprint import content_hash
from studies.thesis.well import WELL

Kind = Literal["continuous", "mixed-integer"]
Mode = Literal["moves", "inputs"]
MODES: tuple[Mode, ...] = ("moves", "inputs")
RECORDING_FORMAT = 2
WARM_UP = 20  # samples before the clock of a run starts


class Recording(NamedTuple):
    """What a closed-loop run leaves for the benchmark, time first."""

    setpoint: np.ndarray  # "sample cv" [CV unit]
    cv: np.ndarray  # "sample cv" [CV unit]
    move: np.ndarray  # "sample mv" [MV unit]
    mv_demand: np.ndarray  # "sample mv" [MV unit]
    gap: np.ndarray  # "sample", relative gap of the plan
    fallback: np.ndarray  # "sample", whether there was no plan
    solve_time: np.ndarray  # "sample" [s]
    wall_time: float  # of the run, plant included, first compilation not [s]


class Problems(NamedTuple):
    """Problems of single samples, ``"problem"`` first; values as `jaxmpc.problem.instance.make_instance` takes them."""

    free_response: np.ndarray
    setpoint: np.ndarray
    mv_now: np.ndarray
    last_move: np.ndarray
    past_moves: np.ndarray

    def take(self, index: int | np.ndarray) -> Problems:
        """Some of the problems."""
        return Problems(*(values[index] for values in self))

    def at(self, i: int) -> dict[str, Any]:
        """One problem by the names of `Planner.solve`."""
        return self.take(i)._asdict()


@dataclasses.dataclass(frozen=True)
class Instances:
    """Recorded problems with those of the sample before, which a warm start comes from."""

    structure: Structure
    tuning: Tuning
    model: StepResponseModel
    sample: np.ndarray  # "problem", where in the run they are
    now: Problems
    before: Problems  # those one sample earlier

    def __len__(self) -> int:
        return len(self.sample)

    def cases(self) -> list[dict[str, Any]]:
        """The contents of case files, with the limits of the first move that the mean-move limit (6.6) sets."""
        return [self._case(i) for i in range(len(self))]

    def files(self) -> dict[str, dict[str, Any]]:
        """The contents of case files by name, where the first move alone has no limit: there is no field for one."""
        first, named = ("first_move_high", "first_move_low"), zip(self.sample, self.cases(), strict=True)
        free = (
            (sample, case) for sample, case in named if not any(np.isfinite(case[key]).any() for key in first)
        )
        return {
            f"well_{self.structure.blocking}_{sample}": {key: case[key] for key in case if key not in first}
            for sample, case in free
        }

    def _case(self, i: int) -> dict[str, Any]:
        problem = self.now.at(i)
        past = problem.pop("past_moves")
        body = case_to_dict(Case(self.model, self.structure, self.tuning, **problem))
        mean, limit = past.mean(axis=0), np.asarray(self.tuning.mean_move_limit) * (1.0 + 1e-9)
        body["first_move_high"] = np.where(mean > limit, 0.0, np.inf).tolist()
        body["first_move_low"] = np.where(mean < -limit, 0.0, -np.inf).tolist()
        return body


def make_controller(kind: Kind, mode: Mode, model: StepResponseModel) -> Controller:
    """The controller of the thesis preset."""
    structure = WELL.structure(mode, integer=kind == "mixed-integer")
    return Controller(structure, WELL.tuning(structure), model)


@dataclasses.dataclass
class Recordings:
    """Recordings of one benchmark run: from this run, from the cache, or made now."""

    model: StepResponseModel  # of every controller
    reference: Reference  # setpoints of the runs
    samples: int | None = None  # length of the runs, None for the whole reference
    say: Callable[[str], None] = lambda line: None  # receives a line per recording
    _live: dict[tuple[Kind, Mode], Recording] = dataclasses.field(default_factory=dict)

    def live(self, kind: Kind, mode: Mode) -> Recording:
        """The run made now, once per benchmark: its times are of this machine and code."""
        if (kind, mode) not in self._live:
            self.say(f"{kind} run, {mode}, stepped from the host")
            made = self._run(kind, mode, HostPlant(WellPlant(actuator="step")))
            self._live[kind, mode] = made
            path = self.path(kind, mode)
            if _load(path) is None:
                buffer = io.BytesIO()
                np.savez_compressed(buffer, **made._asdict())
                write_atomically(path, sealed(buffer.getvalue()))
        return self._live[kind, mode]

    def compiled(self, kind: Kind, mode: Mode) -> Recording:
        """The same run as `jaxmpc.simulate` makes it on the JAX well: many samples in one compiled call."""
        self.say(f"{kind} run, {mode}")
        return self._run(kind, mode, WellPlant(actuator="step"))

    def _run(self, kind: Kind, mode: Mode, plant) -> Recording:
        """A run after one of a few samples, which compiles."""
        controller = make_controller(kind, mode, self.model)
        simulate(controller, plant, self.reference, samples=WARM_UP)
        seconds, run = taken(lambda: simulate(controller, plant, self.reference, samples=self.samples))
        return Recording(*(getattr(run, name) for name in Recording._fields[:-1]), wall_time=seconds)

    def path(self, kind: Kind, mode: Mode) -> Path:
        """File of a recording, named by its content key."""
        controller = make_controller(kind, mode, self.model)
        tuning = {field.name: getattr(controller.tuning, field.name) for field in dataclasses.fields(Tuning)}
        key = content_hash(
            RECORDING_FORMAT,
            kind,
            dataclasses.asdict(controller.structure),
            tuning,
            np.asarray(self.model.coefficients),
            well_hash(WellPlant().parameters),
            self.reference.sample(self.model.dt, self.samples),
        )
        return cache_folder("bench") / f"{kind}-{mode}-{key[:20]}.npz"

    def kept(self, kind: Kind, mode: Mode) -> Recording:
        """The recording in the cache, else the run made now; its problems stay the same from run to run."""
        stored = _load(self.path(kind, mode))
        return self.live(kind, mode) if stored is None else stored

    def instances(self, kind: Kind, mode: Mode, count: int) -> Instances:
        """At most `count` problems, spread evenly over a recorded run."""
        recording = self.kept(kind, mode)
        usable = np.arange(2, len(recording.cv))
        chosen = usable[np.unique(np.linspace(0, len(usable) - 1, count + 2).astype(int)[1:-1])]
        controller = make_controller(kind, mode, self.model)
        of, problems = (controller.structure, controller.tuning, self.model), replay(controller, recording)
        return Instances(*of, chosen, problems.take(chosen), problems.take(chosen - 1))


def replay(controller: Controller, recording: Recording) -> Problems:
    """The problem of every sample of a recording that the controller made, without solving any."""
    core, structure = controller.core, controller.structure
    start = controller.init(recording.cv[0], recording.mv_demand[0] - recording.move[0])
    nothing = jnp.zeros((core.size.blocks, core.size.mvs))

    @jax.jit
    def run(state, cvs, moves):
        def sample(state, inputs):
            cv, move = inputs
            state, free = core.observe(state, cv, jnp.nan, False)
            problem = free, state.mv, state.last_move, state.past_moves
            return core.remember(state, nothing.at[0].set(move), state.warm), problem

        return jax.lax.scan(sample, state, (cvs, moves))[1]

    free, now, last, past = jax.tree.map(np.asarray, run(start, recording.cv, recording.move))
    free, past = free[:, : structure.prediction_horizon], past[:, -structure.mean_move_window :]
    setpoint = np.broadcast_to(recording.setpoint[:, None, :], free.shape)
    return Problems(free, setpoint, now, last, past)


def _load(path: Path) -> Recording | None:
    """A stored recording; None if there is none or it is damaged."""
    content = read_sealed(path)
    if content is None:
        return None
    with np.load(io.BytesIO(content)) as stored:
        return Recording(*(stored[name][()] for name in Recording._fields))
