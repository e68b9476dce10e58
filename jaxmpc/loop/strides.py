"""Mixed-integer controllers on the JAX well, many samples in one compiled call.

Nearly every sample is closed by its relaxation or by `compiled_search`. Decision, plant and next sample then stay on the
device, with the very functions that `mixed_integer` calls, until a sample has to be searched on the host. One call carries
out what was decided there and goes on.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmpc import status as codes
from jaxmpc.controller.batch import Lanes
from jaxmpc.controller.continuous import ControllerState
from jaxmpc.controller.measurement import received
from jaxmpc.controller.mixed_integer import MixedIntegerControllers, observed, remembered
from jaxmpc.controller.sample import Sample, checked
from jaxmpc.integer.relaxer import relaxations
from jaxmpc.integer.search import decide
from jaxmpc.integer.solve import compiles, solve_integers
from jaxmpc.problem.condense import QpInstance, integer_columns
from jaxmpc.problem.structure import Structure
from jaxmpc.process.plant import WellPlant, WellState
from jaxmpc.programs.packing import Packing, flattened, rebuilt
from jaxmpc.programs.threads import compile_together, parts_of, side_by_side
from jaxmpc.relaxed.gap import FINEST, closes, relative_gap
from jaxmpc.relaxed.solve import Solved

LONGEST = 32  # samples of one call
TOGETHER = 16  # scenarios of one call
APART = 5  # Newton steps that take as long as the rest of a sample
RELAXATION = codes.finisher_code("relaxation")


class Moment(NamedTuple):
    """A sample whose measurement is known; all arrays with a scenario axis.

    Attributes:
        state: of the controller, after the measurement.
        plant: state of the well.
        cv: measured by sensors without fault.
        mv: where the actuators stand.
        instance, root: its problem and the relaxation of that.
        x: the plan, scaled.
        good: whether there is one.
        decided: whether `x` and `good` are known.
    """

    state: ControllerState
    plant: WellState
    cv: Float[Array, "scenario cv"]
    mv: Float[Array, "scenario mv"]
    instance: QpInstance
    root: Solved
    x: Float[Array, "scenario n"]
    good: Bool[Array, " scenario"]
    decided: Bool[Array, " scenario"]


class Seen(NamedTuple):
    """What is kept of a measured sample: fields of `Trajectory`, and the steps that its solves took."""

    cv: Array
    bias: Array
    bias_raw: Array
    quality: Array
    off: Array
    objective: Array
    bound: Array
    nodes: Array
    finished_by: Array
    steps: Array


class Done(NamedTuple):
    """What is kept of a sample that was carried out."""

    mv_demand: Array
    mv: Array
    move: Array
    plan: Array


class Loop(NamedTuple):
    """Everything that stays the same from sample to sample."""

    memory: Lanes
    qps: Lanes
    tables: Lanes
    rows: Any
    scales: Lanes
    plants: Lanes[WellPlant]


def able(controllers: MixedIntegerControllers) -> bool:
    """Whether samples can be closed on the device: moves of one step, no CV that may be switched off, no way to finish
    prescribed, no short time limit.
    """
    c = controllers
    plain = type(c) is MixedIntegerControllers and c.solver.narrow and not c.switching
    return plain and compiles(c.solver.relaxer(1), c.finish, c.time_limit)


def simulate_in_strides(
    controllers: MixedIntegerControllers,
    plants: Lanes[WellPlant],
    inputs: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    told: np.ndarray,
    progress: Callable[[int], None] | None = None,
) -> dict[str, np.ndarray]:
    """Closed loops of controllers that advance together; the fields of `Trajectory`, ``"scenario sample ..."``.

    A single controller is searched in a call of its own, whose time is charged to the sample. Otherwise the samples of a
    call share its time by the steps of their solves, and what the host does is charged to its sample.

    Args:
        controllers: see `able`.
        plants: one well for all, or one per scenario.
        inputs: setpoints ``"scenario sample cv"``, pressure offsets ``"scenario sample"`` [bar], and noise and faults of the
            sensors ``"scenario sample cv"`` [CV unit].
        told: ``"scenario"``, whether the controller is told where the actuators stand.
        progress: told how many samples of all scenarios were done, first when everything is compiled; by one thread at a
            time.
    """
    lock, count = threading.Lock(), controllers.count
    parts = parts_of(count, TOGETHER)
    runs = [
        _Run(controllers.part(part), plants.take(part), [v[part] for v in inputs], told[part])
        for part in parts
    ]
    stages = [run.start() for run in runs]  # the first compiles
    real = [min(len(part), count - int(part[0])) for part in parts]

    def tick(samples: int) -> None:
        if progress is not None:
            with lock:
                progress(samples)

    def advance(k: int, stopped: Callable[[], bool]) -> dict[str, np.ndarray]:
        fields = _advanced(runs[k], stages[k], lambda samples: tick(real[k] * samples), stopped)
        return {name: values[: real[k]] for name, values in fields.items()}

    tick(0)
    fields = side_by_side(advance, range(len(parts)))
    return {name: np.concatenate([f[name] for f in fields]) for name in fields[0]}


def _advanced(run: _Run, stage: _Stage, tick: Callable[[int], None], stopped: Callable[[], bool]) -> dict:
    """The whole run of some controllers."""
    fields: dict[str, np.ndarray] = {}
    total, done = run.samples, 0
    while done < total and not stopped():
        begin = time.perf_counter()
        acted = int(stage.decided)  # only the first call has nothing to carry out
        stage, seen, doings, count = run.stride(stage, done)
        seconds = time.perf_counter() - begin
        # the first row of what was seen is the sample after the one that was carried out first
        first, carried = done + acted, count - 1 + acted
        for name, values in doings._asdict().items():
            _put(fields, total, name, done, values[:, :carried])
        work = seen.steps[:, :count] + APART
        shares = {"solve_time": seconds * work / work.sum()}
        for name, values in (seen._asdict() | shares).items():
            if name != "steps":
                _put(fields, total, name, first, np.asarray(values[:, :count]))
        _put(fields, total, "status", first, np.full((run.count, count), codes.OPTIMAL))
        _put(fields, total, "fallback", first, np.full((run.count, count), False))
        before, done = done, done + carried
        if done < total and not stage.decided:
            stage = run.decide(stage, fields, done)
        if carried:
            tick(min(done, total) - before)
    scale = run.controllers.scales_of(run.narrow)[1]
    fields["gap"] = relative_gap(fields["objective"], fields["bound"], scale[:, None])
    return fields


def _put(fields: dict[str, np.ndarray], total: int, name: str, begin: int, values: np.ndarray) -> None:
    """Write samples of a field, made when first needed; what is beyond the run is dropped."""
    if name not in fields:
        fields[name] = np.empty((len(values), total, *values.shape[2:]), dtype=values.dtype)
    fields[name][:, begin : begin + values.shape[1]] = values[:, : max(total - begin, 0)]


class _Stage(NamedTuple):
    """A packed sample, on the device or the host, and whether all of it is decided."""

    packed: Any
    decided: bool


class _Run:
    """Loops under way.

    Args:
        controllers, plants, inputs, told: as in `simulate_in_strides`, of scenarios that share every call.
    """

    def __init__(
        self, controllers: MixedIntegerControllers, plants: Lanes[WellPlant], inputs, told: np.ndarray
    ):
        self.controllers, self.plants, self.count = controllers, plants, controllers.count
        self.samples = inputs[0].shape[1]
        setpoints, offsets, errors, faults = inputs
        self.inputs = np.concatenate([setpoints, errors, faults, offsets[..., None]], axis=2)
        # beyond the end the last sample is repeated
        self.inputs = np.concatenate(
            [self.inputs, np.repeat(self.inputs[:, -1:], LONGEST + 1, axis=1)], axis=1
        )
        self.narrow = controllers.solver.relaxer(1)
        assert self.narrow.tables is not None
        memory, (qps, rows, _) = controllers.memory, controllers.constants
        self.leaves, self.form = flattened(
            Loop(memory, qps, self.narrow.tables, rows, controllers.scales_of(self.narrow)[0], plants)
        )
        scale = controllers.scales_of(self.narrow)[1]
        gap = np.full(self.count, max(controllers.gap, FINEST))
        self.settings = np.stack([gap, scale, told.astype(float)], axis=1)

    def start(self) -> _Stage:
        """Before the first sample, everything compiled."""
        c, steady = self.controllers, _steady(self.plants, self.count)
        plant_state, outputs = jax.tree.map(np.asarray, steady)
        state, mv = c.init(outputs.cv, outputs.mv), outputs.mv
        cvs = outputs.cv.shape[1]
        cv: Any = outputs.cv + self.inputs[:, 0, cvs : 2 * cvs]
        memory, (qps, rows, columns) = c.memory, c.constants
        sample = checked(c.structure, cv, outputs.cv, mv, lanes=self.count)
        shapes = jax.eval_shape(observed, memory, qps, rows, columns, state, sample)
        _, _, instance, root = jax.tree.map(lambda v: np.zeros(v.shape, v.dtype), shapes)
        no: Any = np.zeros(self.count, dtype=bool)
        moment = Moment(state, plant_state, cv, mv, instance, root, np.zeros_like(root.warm.x), no, no)
        self.of_sample = Packing.of(moment)
        statics = _Statics(c.structure, self.form, self.of_sample, self.count > 1)
        self.program = _program(statics)
        stage = _Stage(self.of_sample.pack(moment), False)
        search = lambda: self.narrow.compile(instance, state.warm)  # noqa: E731
        compile_together(lambda: self.stride(stage, 0), *([search] if self.count == 1 else []))
        return stage

    def stride(self, stage: _Stage, begin: int) -> tuple[_Stage, Seen, Done, int]:
        """Carry out sample `begin` if it is decided, and go on up to one that is not.

        Returns:
            ``(stage, seen, done, count)``: the sample measured last, what was measured since, what was carried out, and how
            many samples were measured.
        """
        now = self.inputs[:, begin : begin + LONGEST + 1]
        packed, (seen, done), (count, decided) = self.program(self.leaves, stage.packed, now, self.settings)
        rows = lambda tree: jax.tree.map(np.asarray, tree)  # noqa: E731
        return _Stage(packed, bool(decided)), rows(seen), rows(done), int(count)

    def decide(self, stage: _Stage, fields: dict[str, np.ndarray], at: int) -> _Stage:
        """Decide sample `at` outside the stride, and record how."""
        begin = time.perf_counter()
        sample: Moment = self.of_sample.unpack(np.array(stage.packed))
        c = self.controllers
        which = np.flatnonzero(~sample.decided)
        starts = c.solver.starts(self.narrow, np.asarray(sample.state.plan))
        seconds = (time.perf_counter() - begin) / len(which)
        results, _ = solve_integers(
            self.narrow,
            sample.instance,
            starts=starts,
            root=relaxations(sample.root, self.narrow.predictions),
            gap=c.gap,
            time_limit=c.time_limit,
            which=which,
            searched=self.count > 1,
        )
        x, good = sample.x.copy(), sample.good.copy()
        for i, result in zip(which, results, strict=True):
            good[i] = result.x is not None
            found = {
                "status": result.status,
                "fallback": not good[i],
                "nodes": result.nodes,
                "finished_by": codes.finisher_code(result.finished_by) if good[i] else 0,
                "objective": result.value if good[i] else np.nan,
                "bound": result.bound if good[i] else np.nan,
            }
            for name, value in found.items():
                fields[name][i, at] = value
            fields["solve_time"][i, at] += result.seconds + seconds
            if result.x is not None:
                x[i] = result.x
        decided: Any = np.ones(self.count, dtype=bool)
        return _Stage(self.of_sample.pack(sample._replace(x=x, good=good, decided=decided)), True)


def _steady(plants: Lanes[WellPlant], count: int):
    def lane(own, _):
        plant: WellPlant = eqx.combine(own, plants.shared)
        state = plant.init()
        return state, plant.measure(state)

    return jax.vmap(lane)(plants.each, np.zeros(count))


class _Statics(NamedTuple):
    """What programs are compiled for; `inside` says whether strides search."""

    structure: Structure
    form: Any
    of_sample: Packing
    inside: bool


@functools.lru_cache(maxsize=64)
def _program(statics: _Statics):
    """The compiled stride of loops of one form."""
    return jax.jit(functools.partial(_stride, statics))


def _decided(structure: Structure, loop: Loop, instance, root: Solved, gap):
    """The compiled search of all scenarios whose root has a bound."""

    def lane(own, instance, root, gap):
        qp, tables = eqx.combine(own, (loop.qps.shared, loop.tables.shared))
        return decide(structure, qp, tables, loop.rows, instance, root, gap)

    return jax.vmap(lane)((loop.qps.each, loop.tables.each), instance, root, gap)


def _stride(statics: _Statics, leaves, packed, inputs, settings):
    """See `_Run.stride`."""
    loop: Loop = rebuilt(statics.form, leaves)
    sample: Moment = statics.of_sample.unpack(packed)
    columns = np.asarray(integer_columns(statics.structure))
    cvs, mvs = sample.cv.shape[1], sample.state.mv.shape[1]
    setpoints, errors, faults = (inputs[..., k * cvs : (k + 1) * cvs] for k in range(3))
    offsets = inputs[..., -1]
    gap, scale, told = settings[:, 0], settings[:, 1], settings[:, 2:] > 0
    late = sample.decided[0].astype(int)  # measured is sample `late`, then late + 1, ...

    def carry_out(sample: Moment, at) -> tuple[Moment, Done]:
        state, moves, _ = remembered(
            loop.memory, loop.scales, sample.instance, sample.state, sample.x, sample.good, sample.root.warm
        )

        def advance(own, plant_state, mv, offset):
            return eqx.combine(own, loop.plants.shared).step(plant_state, mv, offset)

        plant_state, outputs = jax.vmap(advance)(loop.plants.each, sample.plant, state.mv, offsets[:, at])
        cv = outputs.cv + errors[:, at + 1]
        sample = sample._replace(state=state, plant=plant_state, cv=cv, mv=outputs.mv)
        return sample, Done(state.mv, outputs.mv, moves[:, 0], moves)

    def forward(carry):
        sample, seen, done, count = carry
        at = late + count - 1  # sample to carry out; -1 for none

        def nothing(sample: Moment, _):
            return sample, jax.tree.map(lambda v: jnp.zeros((v.shape[0], *v.shape[2:]), v.dtype), done)

        sample, did = jax.lax.cond(at >= 0, carry_out, nothing, sample, at)
        row = jnp.where(at >= 0, at, LONGEST + 1)  # out of range: not written
        done = jax.tree.map(lambda rows, new: rows.at[:, row].set(new, mode="drop"), done, did)
        given = Sample(
            cv=received(sample.cv, faults[:, at + 1], sample.state.sensors.value),
            setpoint=setpoints[:, at + 1],
            mv=jnp.where(told, sample.mv, jnp.nan),
            manual=jnp.zeros(sample.mv.shape, dtype=bool),
        )
        state, _, instance, root = observed(loop.memory, loop.qps, loop.rows, columns, sample.state, given)
        assert root is not None
        x = root.warm.x
        x = x.at[:, columns].set(jnp.round(x[:, columns]))
        value, steps = root.snapped, root.steps.astype(int)
        bound = jnp.minimum(jnp.maximum(root.bound, 0.0), value)
        closed = closes(value, bound, scale, gap)
        nodes, finished_by = jnp.ones_like(steps), jnp.full_like(steps, RELAXATION)
        if statics.inside:
            open_root = root._replace(bound=jnp.where(closed, jnp.nan, root.bound))
            found = _decided(statics.structure, loop, instance, open_root, gap)
            pick = lambda new, old: jnp.where(found.closed.reshape(-1, *[1] * (old.ndim - 1)), new, old)  # noqa: E731
            x, value, bound = pick(found.x, x), pick(found.value, value), pick(found.bound, bound)
            nodes, finished_by = pick(found.nodes, nodes), pick(found.finished_by, finished_by)
            steps, closed = steps + found.steps, closed | found.closed
        sensors = state.sensors
        kept = sample.cv, state.bias, state.bias_raw, sensors.quality, sensors.off
        now = Seen(*kept, value, bound, nodes, finished_by, steps)
        seen = jax.tree.map(lambda rows, new: rows.at[:, count].set(new), seen, now)
        sample = sample._replace(state=state, instance=instance, root=root, x=x, good=closed, decided=closed)
        return sample, seen, done, count + 1

    def onward(carry):
        sample, *_, count = carry
        return (count == 0) | (sample.decided.all() & (count < LONGEST))

    def table(*shape, dtype=float):
        return jnp.zeros((sample.cv.shape[0], LONGEST + 1, *shape), dtype=dtype)

    whole = lambda: table(dtype=int)  # noqa: E731
    flags = table(cvs, dtype=int), table(cvs, dtype=bool)
    seen = Seen(table(cvs), table(cvs), table(cvs), *flags, table(), table(), whole(), whole(), whole())
    done = Done(table(mvs), table(mvs), table(mvs), table(*sample.state.plan.shape[1:]))
    sample, seen, done, count = jax.lax.while_loop(onward, forward, (sample, seen, done, 0))
    return statics.of_sample.pack(sample), (seen, done), (count, sample.decided.all())
