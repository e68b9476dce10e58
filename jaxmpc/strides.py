"""A mixed-integer controller on the JAX well, from one sample that has to be searched to the next in one compiled call.

In most samples the relaxed moves are whole already, or rounding them costs less than the gap: the relaxation closes them.
Nothing then needs the host: decision, plant and next sample stay on the device, with the very functions that
`mixed_integer` calls, until a sample needs a search. One call carries out what the search decided and goes on.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmpc import status as codes
from jaxmpc.condense import QpInstance
from jaxmpc.controller import ControllerState
from jaxmpc.mixed_integer import MixedIntegerControllers, observed, relative_gap, remembered
from jaxmpc.packing import Packing
from jaxmpc.plant import WellPlant, WellState
from jaxmpc.relaxer import Solved, relaxations

LONGEST = 32  # samples of one call


class Sample(NamedTuple):
    """A sample whose measurement is known; all arrays with a scenario axis of one.

    Attributes:
        state: of the controller, after the measurement.
        plant: state of the well.
        cv: measured.
        instance, root: its problem and the relaxation of that.
        x: the plan, scaled.
        good: whether there is one.
        decided: whether `x` and `good` are known.
    """

    state: ControllerState
    plant: WellState
    cv: Float[Array, "1 cv"]
    instance: QpInstance
    root: Solved
    x: Float[Array, "1 n"]
    good: Bool[Array, "1"]
    decided: Bool[Array, "1"]


class Seen(NamedTuple):
    """What the record keeps of a measured sample."""

    cv: Array
    bias: Array
    bias_raw: Array
    objective: Array
    bound: Array


class Done(NamedTuple):
    """What the record keeps of a sample that was carried out."""

    mv_demand: Array
    mv: Array
    move: Array
    plan: Array


def able(controllers: MixedIntegerControllers) -> bool:
    """Whether samples can be closed by the relaxation alone: one model, moves of one step, no way to finish prescribed."""
    plain = type(controllers) is MixedIntegerControllers and controllers.count == 1
    return plain and controllers.solver.narrow and controllers.finish == "auto"


def simulate_in_strides(
    controllers: MixedIntegerControllers,
    plant: WellPlant,
    inputs: tuple[np.ndarray, np.ndarray, np.ndarray],
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, np.ndarray]:
    """A closed loop of one controller; the fields of `Trajectory` that are recorded, ``"sample ..."``.

    The samples of a call share its time; what a search takes is charged to its sample.

    Args:
        controllers: one, see `able`.
        plant: the well.
        inputs: setpoints ``"sample cv"``, pressure offsets ``"sample"`` [bar] and measurement errors ``"sample cv"``.
        progress: called with ``(done, total)`` samples.
    """
    run = _Run(controllers, plant, inputs)
    fields: dict[str, np.ndarray] = {}
    total, done, sample = len(inputs[0]), 0, run.start()
    while done < total:
        begin = time.perf_counter()
        acted = bool(sample.decided[0])  # only the first call has nothing to carry out
        sample, seen, doings, steps = run.stride(sample, done)
        # the first row of what was seen is the sample after the one that was carried out first
        first, count = done + acted, steps
        taken = (time.perf_counter() - begin) / max(steps, 1)
        carried = steps - 1 + acted
        for name, values in doings._asdict().items():
            _put(fields, total, name, done, values[:carried])
        done += carried
        for name, values in seen._asdict().items():
            _put(fields, total, name, first, values[:count])
        closed = {
            "status": codes.OPTIMAL,
            "fallback": False,
            "nodes": 1,
            "finished_by": codes.finisher_code("relaxation"),
        }
        for name, value in closed.items():
            _put(fields, total, name, first, np.full(count, value))
        _put(fields, total, "solve_time", first, np.full(count, taken))
        if done < total and not sample.decided[0]:
            sample, found = run.search(sample)
            for name, value in found.items():
                _put(fields, total, name, done, np.asarray([value]))
            fields["solve_time"][done] += run.seconds
        if progress is not None:
            progress(min(done, total), total)
    scale = controllers.solver.relaxer(1).scenario(0).scale
    fields["gap"] = relative_gap(fields["objective"], fields["bound"], scale)
    return fields


def _put(fields: dict[str, np.ndarray], total: int, name: str, begin: int, values: np.ndarray) -> None:
    """Write rows of a field, made when first needed; what is beyond the run is dropped."""
    if name not in fields:
        fields[name] = np.empty((total, *values.shape[1:]), dtype=values.dtype)
    fields[name][begin : begin + len(values)] = values[: max(total - begin, 0)]


class _Run:
    """A loop under way.

    Args:
        controllers: one.
        plant: the well.
        inputs: as in `simulate_in_strides`.
    """

    def __init__(self, controllers: MixedIntegerControllers, plant: WellPlant, inputs):
        self.controllers, self.plant = controllers, plant
        self.inputs = [np.concatenate([v, np.repeat(v[-1:], LONGEST + 1, axis=0)]) for v in inputs]
        self.narrow = controllers.solver.relaxer(1)
        well = jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64)[None], plant)
        self.of_well = Packing.of(well)
        self.constants = (
            controllers.memory,
            *controllers.constants,
            controllers.scales_of(self.narrow)[0],
            jax.device_put(self.of_well.pack(well)),
        )
        self.seconds = 0.0  # of the last search

    def start(self) -> Sample:
        """Before the first sample, everything compiled."""
        c, setpoints = self.controllers, self.inputs[0]
        steady = self.plant.init()
        plant_state = jax.tree.map(lambda leaf: np.asarray(leaf)[None], steady)
        outputs = self.plant.measure(steady)
        state = c.init(np.asarray(outputs.cv)[None], np.asarray(outputs.mv)[None])
        cv: Any = np.asarray(outputs.cv)[None] + self.inputs[2][:1]
        memory, qps, rows, columns, *_ = self.constants
        shapes = jax.eval_shape(observed, memory, qps, rows, columns, state, cv, setpoints[:1])
        _, _, instance, root = jax.tree.map(lambda v: np.zeros(v.shape, v.dtype), shapes)
        no: Any = np.zeros(1, dtype=bool)
        sample = Sample(state, plant_state, cv, instance, root, np.zeros_like(root.warm.x), no, no)
        self.of_sample = Packing.of(sample)
        later, *_ = self.stride(sample, 0)
        self.narrow.compile(later.instance, later.state.warm)
        return sample

    def stride(self, sample: Sample, begin: int) -> tuple[Sample, Seen, Done, int]:
        """Carry out sample `begin` if it is decided, and go on up to one that is not.

        Returns:
            ``(sample, seen, done, count)``: the sample measured last, what was measured since, what was carried out, and how
            many samples were measured.
        """
        setpoints, offsets, errors = (v[begin : begin + LONGEST + 1] for v in self.inputs)
        gap = np.array([max(self.controllers.gap, 1e-9), self.narrow.scenario(0).scale])
        packed, seen, done, count = _stride(
            *self.constants,
            self.of_sample.pack(sample),
            (setpoints, offsets, errors, gap),
            packings=(self.of_well, self.of_sample),
        )
        rows = lambda tree: jax.tree.map(np.asarray, tree)  # noqa: E731
        return self.of_sample.unpack(np.asarray(packed)), rows(seen), rows(done), int(count)

    def search(self, sample: Sample) -> tuple[Sample, dict[str, Any]]:
        """Decide a sample on the host: the sample, and what the record keeps of the decision."""
        c = self.controllers
        _, _, (result,), _ = c.solver.solve(
            lambda _: sample.instance,
            root=relaxations(sample.root, self.narrow.predictions),
            previous_moves=np.asarray(sample.state.plan),
            warm=sample.state.warm,
            gap=c.gap,
            time_limit=c.time_limit,
            finish=c.finish,
        )
        self.seconds = result.seconds
        known = bool(np.isfinite(sample.cv).all())
        good = known and result.x is not None
        found = {
            "status": result.status if known else codes.FAILED,
            "fallback": not good,
            "nodes": result.nodes,
            "finished_by": codes.finisher_code(result.finished_by) if good else 0,
            "objective": result.value if good else np.nan,
            "bound": result.bound if good else np.nan,
        }
        x = sample.x if result.x is None else result.x[None]
        flags: Any = {"good": np.array([good]), "decided": np.array([True])}
        return sample._replace(x=x, **flags), found


@functools.partial(jax.jit, static_argnames="packings")
def _stride(memory, qps, rows, columns, scales, well, sample, inputs, packings):
    """See `_Run.stride`; the sample comes and goes packed."""
    setpoints, offsets, errors, (gap, scale) = inputs
    one = lambda tree: jax.tree.map(lambda leaf: leaf[0], tree)  # noqa: E731
    lane = lambda tree: jax.tree.map(lambda leaf: leaf[None], tree)  # noqa: E731
    plant: WellPlant = one(packings[0].unpack(well))
    sample = packings[1].unpack(sample)
    late = sample.decided[0].astype(int)  # measured is sample `late`, then late + 1, ...

    def carry_out(sample: Sample) -> tuple[Sample, Done]:
        state, moves, _ = remembered(
            memory, scales, sample.instance, sample.state, sample.x, sample.good, sample.root.warm
        )
        return sample._replace(state=state), Done(state.mv[0], state.mv[0], moves[0, 0], moves[0])

    def forward(carry):
        sample, seen, done, count = carry
        at = late + count - 1  # sample to carry out; -1 for none

        def advance(sample: Sample):
            sample, did = carry_out(sample)
            plant_state, outputs = plant.step(one(sample.plant), did.mv_demand, offsets[at])
            cv = outputs.cv + errors[at + 1]
            return sample._replace(plant=lane(plant_state), cv=cv[None]), did._replace(mv=outputs.mv)

        def nothing(sample: Sample):
            return sample, jax.tree.map(lambda v: jnp.zeros(v.shape[1:], v.dtype), done)

        sample, did = jax.lax.cond(at >= 0, advance, nothing, sample)
        row = jnp.where(at >= 0, at, LONGEST + 1)  # out of range: not written
        done = jax.tree.map(lambda rows, new: rows.at[row].set(new, mode="drop"), done, did)
        state, _, instance, root = observed(
            memory, qps, rows, columns, sample.state, sample.cv, setpoints[at + 1][None]
        )
        assert root is not None
        bound = jnp.maximum(root.bound, 0.0)
        size = jnp.maximum(jnp.abs(root.snapped), 1e-6 * scale)
        closed = jnp.isfinite(root.snapped) & (root.snapped - bound <= gap * size)
        closed &= jnp.isfinite(sample.cv).all(axis=1)
        x = root.warm.x
        x = x.at[:, columns].set(jnp.round(x[:, columns]))
        now = Seen(sample.cv, state.bias, state.bias_raw, root.snapped, jnp.minimum(bound, root.snapped))
        seen = jax.tree.map(lambda rows, new: rows.at[count].set(new[0]), seen, now)
        sample = sample._replace(state=state, instance=instance, root=root, x=x, good=closed, decided=closed)
        return sample, seen, done, count + 1

    def onward(carry):
        sample, *_, count = carry
        return (count == 0) | (sample.decided[0] & (count < LONGEST))

    cvs, mvs = setpoints.shape[1], sample.state.mv.shape[1]
    table = lambda *shape: jnp.zeros((LONGEST + 1, *shape))  # noqa: E731
    seen = Seen(table(cvs), table(cvs), table(cvs), table(), table())
    done = Done(table(mvs), table(mvs), table(mvs), table(*sample.state.plan.shape[1:]))
    sample, seen, done, count = jax.lax.while_loop(onward, forward, (sample, seen, done, 0))
    return packings[1].pack(sample), seen, done, count
