"""Closed loops on plants in JAX, many samples in one compiled call: one lane, or many on several cores or devices.

Decision, plant and next sample stay on the device until a sample is met whose whole moves have to be decided on the host.
One call carries out what was decided there and goes on. A call ends before the sample of an event, and the next one has the
changed controllers. `loop.simulate` is the only caller.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmpc.controller.batch import Batch, considered
from jaxmpc.controller.core import Moment
from jaxmpc.controller.measurement import received
from jaxmpc.controller.sample import Sample
from jaxmpc.loop.events import Course, Stage
from jaxmpc.programs.clock import Clock
from jaxmpc.programs.compilation import compiling_for
from jaxmpc.programs.lanes import Lanes
from jaxmpc.programs.pace import CALL
from jaxmpc.programs.packing import Packing, flattened, rebuilt
from jaxmpc.programs.threads import parts_of, side_by_side

LONGEST = 64  # samples of one call
TOGETHER = 16  # scenarios of one call, on a CPU


class Now(NamedTuple):
    """A sample whose measurement is known; all arrays with a scenario axis."""

    moment: Moment  # of the controllers, after the measurement
    plant: Any  # state of the plant
    cv: Float[Array, "scenario cv"]  # measured by sensors without fault
    mv: Float[Array, "scenario mv"]  # where the actuators stand
    x: Float[Array, "scenario n"]  # the plan, scaled
    good: Bool[Array, " scenario"]  # whether there is one
    decided: Bool[Array, " scenario"]  # whether `x` and `good` are known


class Inputs(NamedTuple):
    """What comes from outside, of all scenarios."""

    setpoints: np.ndarray  # ``"scenario sample cv"`` [CV unit]
    disturbance: np.ndarray  # ``"scenario sample disturbance"``
    errors: np.ndarray  # noise of the sensors, ``"scenario sample cv"`` [CV unit]
    faults: np.ndarray  # of the sensors, as of `measurement.fault_errors`
    told: np.ndarray  # ``"scenario"``, whether the controller is told where the actuators stand
    dv: np.ndarray  # ``"scenario sample dv"``, what it is told of the disturbances [DV unit]
    preview: bool  # whether it is told the setpoints and disturbances of the whole horizon

    def part(self, index: np.ndarray) -> Inputs:
        """Of some scenarios."""
        return self._replace(
            **{name: getattr(self, name)[index] for name in self._fields if name != "preview"}
        )


def simulate_compiled(
    controllers: Batch,
    plants: Lanes,
    inputs: Inputs,
    record: Collection[str],
    *,
    stages: Sequence[Sequence[Stage]] = (),
    real: int | None = None,
    devices: Sequence[Any] = (),
    progress: Callable[[int], None] | None = None,
) -> dict[str, np.ndarray]:
    """Closed loops of controllers that advance together; recorded fields of `Trajectory`, ``"scenario sample ..."``.

    The samples of a call share its time by the steps of their solves; what the host does is charged to its sample.

    Args:
        stages: of every scenario, where there are events; the controllers are in the first.
        real: number of scenarios that count, the others are copies; all if not given.
        devices: to spread the scenarios over; the default one if not given.
        progress: told how many samples of all scenarios were done, first when everything is compiled; by one thread at a
            time.
    """
    lock, count = threading.Lock(), controllers.count
    real = count if real is None else real
    most = TOGETHER if len(devices) < 2 else -(-count // len(devices))
    parts = parts_of(count, most, cut=len(devices) > 1)
    places = [devices[k % len(devices)] if len(devices) > 1 else None for k in range(len(parts))]
    held = any(stage.manual.any() for each in stages for stage in each)
    runs = [
        _Run(
            controllers.part(part),
            plants.take(part),
            inputs.part(part),
            record,
            place,
            [stages[k] for k in part] if stages else [],
            held,
        )
        for part, place in zip(parts, places, strict=True)
    ]
    with compiling_for(f"loops of {controllers.size}"):
        starts = [run.start() for run in runs]
        runs[0].stride(starts[0], 0, most=0)
    own = [min(max(real - int(part[0]), 0), len(part)) for part in parts]

    def tick(samples: int) -> None:
        if progress is not None:
            with lock:
                progress(samples)

    def advance(k: int, stopped: Callable[[], bool]) -> dict[str, np.ndarray]:
        fields = runs[k].advanced(starts[k], lambda samples: tick(own[k] * samples), stopped)
        return {name: values[: own[k]] for name, values in fields.items()}

    tick(0)
    fields = side_by_side(advance, range(len(parts)))
    if len(fields) == 1:
        return fields[0]
    return {name: np.concatenate([f.pop(name) for f in fields]) for name in list(fields[0])}


class _Run:
    """Loops under way, of scenarios that share every call; arguments as in `simulate_compiled`."""

    def __init__(
        self,
        controllers: Batch,
        plants: Lanes,
        inputs: Inputs,
        record: Collection[str],
        place: Any,
        stages: Sequence[Sequence[Stage]],
        held: bool,
    ):
        self.course, self.held = Course(controllers, stages), held  # `held`: whether an MV is in any run
        self.plants, self.record, self.place = plants, record, place
        self.count, self.samples = controllers.count, inputs.setpoints.shape[1]
        outside = [inputs.setpoints, inputs.errors, inputs.faults, inputs.dv, inputs.disturbance]
        together = np.concatenate(outside, axis=2)
        self.window = (
            LONGEST + 1 + (controllers.size.future if inputs.preview else 0)
        )  # samples that a call is told
        # beyond the end the last sample is repeated
        self.inputs = np.concatenate([together, np.repeat(together[:, -1:], self.window, axis=1)], axis=1)
        self.told = inputs.told.astype(float)[:, None]
        self._take()

    def _take(self) -> None:
        """Go on with the controllers of the course."""
        self.controllers = self.course.controllers
        leaves, self.form = flattened((self.controllers.cores, self.plants))
        self.leaves = leaves if self.place is None else jax.device_put(leaves, self.place)

    def start(self) -> Any:
        """The packed `Now` before the first sample."""
        c = self.controllers
        plant_state, outputs = self._steady()
        state, mv = c.init(outputs.cv, outputs.mv), outputs.mv
        cvs = outputs.cv.shape[1]
        cv = outputs.cv + self.inputs[:, 0, cvs : 2 * cvs]
        rows = np.zeros((self.count, c.size.future, cvs))
        told = c.size.future if self.window > LONGEST + 1 else 1
        dv = np.zeros((self.count, told, c.size.dvs)) if c.size.dvs else None
        sample = Sample(cv, rows, mv, np.zeros(mv.shape, dtype=bool), dv)
        shapes = jax.eval_shape(considered, c.cores, state, sample, c.settings)
        moment = jax.tree.map(lambda v: np.zeros(v.shape, v.dtype), shapes)._replace(state=state)
        no: Any = np.zeros(self.count, dtype=bool)
        now = Now(moment, plant_state, cv, mv, np.zeros_like(moment.decision.x), no, no)
        self.of_now = Packing.of(now)
        return self.of_now.pack(now)

    def _steady(self) -> tuple[Any, Any]:
        """Steady states of the plants, and what they measure there."""
        if self.plants.count is not None:
            return jax.tree.map(np.asarray, _steady(self.plants))
        plant = self.plants.shared  # outside a program its steady state may be known
        state = plant.init()
        lanes = lambda v: np.broadcast_to(v, (self.count, *np.shape(v)))  # noqa: E731
        return jax.tree.map(lanes, (state, plant.measure(state)))

    def stride(self, packed: Any, begin: int, most: int = LONGEST) -> tuple[Any, dict, dict, int, bool]:
        """Carry out sample `begin` if it is decided, and go on up to one that is not.

        Args:
            most: samples to measure.

        Returns:
            ``(packed, seen, done, count, decided)``: the sample measured last, fields of what was measured since and of what
            was carried out, how many samples were measured, and whether all scenarios of the last one are decided.
        """
        # without an MV that is held in any run, programs know of none
        manual = self.course.manual if self.held else np.zeros((self.count, 0))
        settings = np.concatenate([self.controllers.settings, self.told, manual], axis=1)
        given = (packed, self.inputs[:, begin : begin + self.window], settings)
        given = given if self.place is None else jax.device_put(given, self.place)
        packed, rows, (count, decided) = _stride(self.leaves, *given, most, self.form, self.of_now)
        seen, done = jax.tree.map(np.asarray, rows)
        return packed, seen, done, int(count), bool(decided)

    def advanced(
        self, packed: Any, tick: Callable[[int], None], stopped: Callable[[], bool]
    ) -> dict[str, np.ndarray]:
        """The whole run."""
        fields: dict[str, np.ndarray] = {}
        done = acted = 0  # only the first call has nothing to carry out
        while done < self.samples and not stopped():
            if self.course.enter(done + acted):
                self._take()
            clock = Clock()
            # the sample after the last is measured, too: nothing else is carried out at the end
            most = int(min(self.course.next, self.samples + 1)) - done - acted
            packed, seen, doings, count, decided = self.stride(packed, done, min(most, LONGEST))
            seconds = clock.seconds
            # the first row of what was seen is the sample after the one that was carried out first
            first, carried, acted = done + acted, count - 1 + acted, 1
            for name, values in doings.items():
                self._put(fields, name, done, values[:, :carried])
            work = seen["steps"][:, :count] + CALL
            seen["solve_time"] = seconds * work / work.sum()
            if count:
                self.controllers.pace.took(seconds, int(seen["steps"][:, :count].sum()), self.count * count)
            for name, values in seen.items():
                self._put(fields, name, first, values[:, :count])
            before, done = done, done + carried
            if done < self.samples and not decided:
                packed = self._decide(packed, fields, done, seen["solve_time"][:, -1])
            if carried:
                tick(min(done, self.samples) - before)
        return fields

    def _put(self, fields: dict[str, np.ndarray], name: str, begin: int, values: np.ndarray) -> None:
        """Write samples of a field that is kept, made when first needed; what is beyond the run is dropped."""
        if name not in self.record:
            return
        if name not in fields:
            fields[name] = np.empty((len(values), self.samples, *values.shape[2:]), dtype=values.dtype)
        fields[name][:, begin : begin + values.shape[1]] = values[:, : max(self.samples - begin, 0)]

    def _decide(self, packed: Any, fields: dict[str, np.ndarray], at: int, spent: np.ndarray) -> Any:
        """Decide sample `at` outside the stride, where it took so many seconds, and record how."""
        now: Now = self.of_now.unpack(np.array(packed))
        which = np.flatnonzero(~now.decided)
        x, good, said = self.controllers.finish_open(now.moment, which, spent[which])
        for name in said.keys() & fields.keys():
            fields[name][which, at] = said[name]
        decided: Any = np.ones(self.count, dtype=bool)
        return self.of_now.pack(now._replace(x=x, good=good, decided=decided))


@eqx.filter_jit
def _steady(plants: Lanes):
    def lane(plant):
        state = plant.init()
        return state, plant.measure(state)

    return plants.vmap(lane)


@functools.partial(jax.jit, static_argnames=("form", "of_now"))
def _stride(leaves, packed, inputs, settings, most, form, of_now: Packing):
    """See `_Run.stride`."""
    cores, plants = rebuilt(form, leaves)
    now: Now = of_now.unpack(packed)
    cvs, future, dvs = now.cv.shape[1], now.moment.free_response.shape[1], cores.value.size.dvs
    setpoints, errors, faults = (inputs[..., k * cvs : (k + 1) * cvs] for k in range(3))
    known, disturbance = inputs[..., 3 * cvs : 3 * cvs + dvs], inputs[..., 3 * cvs + dvs :]
    told, preview = settings[:, 3:4] > 0, inputs.shape[1] > LONGEST + 1
    none_held = settings.shape[1] == 4
    late = now.decided[0].astype(int)  # measured is sample `late`, then late + 1, ...

    def carry_out(now: Now, at) -> tuple[Now, dict[str, Array]]:
        state, moves = cores.vmap(lambda core, *plan: core.carry_out(*plan), now.moment, now.x, now.good)
        advance = lambda plant, *given: plant.step(*given)  # noqa: E731
        plant_state, outputs = plants.vmap(advance, now.plant, state.mv, disturbance[:, at])
        now = now._replace(
            moment=now.moment._replace(state=state),
            plant=plant_state,
            cv=outputs.cv + errors[:, at + 1],
            mv=outputs.mv,
        )
        return now, dict(mv_demand=state.mv, mv=outputs.mv, move=moves[:, 0], plan=moves)

    def ahead(values, begin, rows):
        """What is told of so many samples; of the first one only without a preview."""
        if preview:
            return jax.lax.dynamic_slice_in_dim(values, begin, rows, axis=1)
        return values[:, begin, None]

    def measure(now: Now, at) -> tuple[Now, dict[str, Array]]:
        before = now.moment.state
        sample = Sample(
            cv=received(now.cv, faults[:, at], before.sensors.value),
            setpoint=jnp.broadcast_to(
                ahead(setpoints, at + 1 if preview else at, future), (now.cv.shape[0], future, cvs)
            ),
            mv=jnp.where(told, now.mv, jnp.nan),
            manual=jnp.zeros(now.mv.shape, dtype=bool) if none_held else settings[:, 4:] > 0,
            dv=ahead(known, at, future) if dvs else None,
        )
        moment = considered(cores, before, sample, settings[:, :3])
        found, state, whole = moment.decision, moment.state, cores.value.tables.count > 0
        own = dict(cv=now.cv, bias=state.bias, bias_raw=state.bias_raw, steps=found.steps)
        now = now._replace(moment=moment, x=found.x, good=moment.good, decided=moment.good | ~whole)
        return now, own | moment.said(whole)

    def forward(carry):
        now, seen, done, count = carry
        at = late + count - 1  # sample to carry out; -1 for none
        now, did = jax.lax.cond(
            at >= 0, lambda: carry_out(now, at), lambda: (now, jax.tree.map(jnp.zeros_like, nothing))
        )
        row = jnp.where(at >= 0, at, LONGEST + 1)  # out of range: not written
        done = jax.tree.map(lambda rows, new: rows.at[:, row].set(new, mode="drop"), done, did)
        now, kept = measure(now, at + 1)
        seen = jax.tree.map(lambda rows, new: rows.at[:, count].set(new), seen, kept)
        return now, seen, done, count + 1

    def onward(carry):
        now, *_, count = carry
        return (count < most) & ((count == 0) | now.decided.all())

    table = lambda v: jnp.zeros((v.shape[0], LONGEST + 1, *v.shape[1:]), v.dtype)  # noqa: E731
    nothing = dict(mv_demand=now.mv, mv=now.mv, move=now.mv, plan=now.moment.state.plan)
    seen, done = jax.tree.map(table, (jax.eval_shape(measure, now, 0)[1], nothing))
    now, seen, done, count = jax.lax.while_loop(onward, forward, (now, seen, done, 0))
    return of_now.pack(now), (seen, done), (count, now.decided.all())
