"""Gain scheduling (thesis chapter 8): step-response models over a grid of working points, and controllers that use them.

A valve does several times more near closed than at half open. A schedule interpolates between models that were identified at
several values of one or two MVs; every sample, the controllers here predict their future moves with the model of the present
MVs.

A change of model is bumpless. What past moves will still do stays in the shift register as it was
predicted when they were made; only the response of moves from now on changes. What the prediction then misses is
output bias, as ever (2.31).

Moves are planned with the model of the present MVs, but a move that is made enters the register with the model half-way
along it. A step up and the step back then cancel; with the models of their two starting points they do not, and near
closed what is left feeds a limit cycle between two positions.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmpc.check import LARGEST, check_keys, is_count, is_number
from jaxmpc.controller.batch import Batch
from jaxmpc.controller.build import Scenarios
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.core import Core, Moment
from jaxmpc.controller.sample import Sample
from jaxmpc.controller.state import ControllerState, StepInfo
from jaxmpc.errors import InputError
from jaxmpc.files import read_json, write_atomically
from jaxmpc.model.step_response import StepResponseModel, advance_free_response, make_model
from jaxmpc.problem.condense import matrices_of
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from jaxmpc.programs.clock import Clock
from jaxmpc.programs.lanes import Lanes

FORMAT = "jaxmpc/gain-schedule/1"
FINER = 10  # times finer than the grid of a schedule is the table of mixed-integer controllers
KEPT = 32  # mixed-integer controllers kept, 2.5 MB each at thesis size


class ModelSchedule(eqx.Module):
    """Step-response models over a grid of one or two MVs.

    Attributes:
        grid: ``"value"`` per scheduling MV, increasing [MV unit].
        coefficients: ``"cv mv n"`` after one axis per scheduling MV, S(1)..S(N) at each of them [CV unit per MV unit].
        reference: a model with the names, units and dt of all; its coefficients are those of the middle of the grid.
        scheduled: names of the scheduling MVs.
    """

    grid: tuple[Float[Array, " value"], ...]
    coefficients: Float[Array, "*value cv mv n"]
    reference: StepResponseModel
    scheduled: tuple[str, ...] = eqx.field(static=True)

    @property
    def places(self) -> list[int]:
        """Which of the MVs of the models the scheduling ones are."""
        return [self.reference.mv_names.index(name) for name in self.scheduled]

    def coefficients_at(self, mv: Float[Array, " mv"]) -> Float[Array, "cv mv n"]:
        """S(1)..S(N) at the MVs [MV unit], linear in each; beyond the grid those of its border. Pure: jit it, vmap it."""
        cells = [_cell(values, mv[k]) for values, k in zip(self.grid, self.places, strict=True)]

        def between(*points):
            if len(points) == len(cells):
                return self.coefficients[points]
            i, next_i, along = cells[len(points)]
            low = between(*points, i)
            return low + along * (between(*points, next_i) - low)  # equal models give exactly that model

        return between()

    def model_at(self, mv) -> StepResponseModel:
        """The model at the MVs [MV unit], as `coefficients_at`."""
        return eqx.tree_at(
            lambda m: m.coefficients, self.reference, _coefficients_at(self, np.asarray(mv, dtype=np.float64))
        )

    def save(self, path: str | Path) -> Path:
        """Write the schedule as JSON; the file is replaced in one go, so a crash leaves the old one."""
        return write_atomically(path, json.dumps(self.to_dict()))

    def to_dict(self) -> dict[str, Any]:
        """The content of the file, which `from_dict` reads again."""
        model = self.reference
        return {
            "format": FORMAT,
            "dt": model.dt,
            "cv": list(model.cv_names),
            "mv": list(model.mv_names),
            "cv_units": list(model.cv_units),
            "mv_units": list(model.mv_units),
            "provenance": dict(model.provenance),
            "grid": {
                name: np.asarray(values).tolist()
                for name, values in zip(self.scheduled, self.grid, strict=True)
            },
            "coefficients": np.asarray(self.coefficients).tolist(),
        }

    @classmethod
    def load(cls, path: str | Path) -> ModelSchedule:
        """Read a schedule written by `save`. Raises `InputError` naming the field that is wrong."""
        return cls.from_dict(read_json("schedule file", path))

    @classmethod
    def from_dict(cls, body: Any) -> ModelSchedule:
        """The schedule of a file's content. Raises `InputError` naming the field that is wrong."""
        if not isinstance(body, dict):
            expected = "an object with dt, cv, mv, grid and coefficients"
            raise InputError("schedule", type(body).__name__, expected)
        check_keys("schedule", body, ("dt", "cv", "mv", "grid", "coefficients"))
        grid, path = body["grid"], "schedule.coefficients"
        scheduled = [name for name in body["mv"] if isinstance(grid, dict) and name in grid]
        if not scheduled or len(scheduled) != len(grid):
            raise InputError(
                "schedule.grid", grid, f"a list of values for each of one or two of {body['mv']}"
            )
        places: list[tuple[str, Any]] = [("", body["coefficients"])]
        for name in scheduled:
            for where, some in places:
                if not isinstance(some, list) or len(some) != len(grid[name]):
                    given = f"{len(some)} entries" if isinstance(some, list) else some
                    raise InputError(
                        path + where, given, f"{len(grid[name])} entries, one per value of {name}"
                    )
            places = [(f"{where}[{i}]", one) for where, some in places for i, one in enumerate(some)]
        points = itertools.product(*(grid[name] for name in scheduled))
        return make_schedule(
            [
                make_model(
                    coefficients,
                    body["dt"],
                    body["cv"],
                    body["mv"],
                    cv_units=body.get("cv_units", ()),
                    mv_units=body.get("mv_units", ()),
                    working_point=dict(zip(scheduled, point, strict=True)),
                    provenance=body.get("provenance", {}),
                    path=path + where,
                )
                for (where, coefficients), point in zip(places, points, strict=True)
            ],
            scheduled,
        )


def make_schedule(models: Sequence[StepResponseModel], scheduled: Sequence[str] = ()) -> ModelSchedule:
    """Checked constructor from models whose working points form a grid.

    Args:
        models: one per working point, in any order; of the same names, dt and number of coefficients.
        scheduled: names of the one or two MVs that are the axes of the grid; by default all MVs of the models.

    Raises:
        InputError: naming the model that does not fit, or the working point that is missing or there twice.
    """
    if not models:
        raise InputError("models", "nothing", "one or more, one per working point")
    first = models[0]
    names = tuple(scheduled) or first.mv_names
    if len(set(names)) not in (1, 2) or len(set(names)) < len(names) or not {*names} <= {*first.mv_names}:
        expected = f"one or two of {', '.join(first.mv_names)}, the axes of the grid"
        raise InputError("scheduled", list(names), expected)
    points: dict[tuple[float, ...], StepResponseModel] = {}
    for k, model in enumerate(models):
        for key in ("cv_names", "mv_names", "cv_units", "mv_units", "dt", "samples"):
            if getattr(model, key) != getattr(first, key):
                raise InputError(
                    f"models[{k}].{key}", getattr(model, key), f"{getattr(first, key)} as models[0]"
                )
        if model.dv_names:
            raise InputError(
                f"models[{k}].dv", list(model.dv_names), "none: a schedule has no measured disturbances"
            )
        where = dict(model.working_point)
        for name in names:
            if not np.isfinite(where.get(name, np.nan)):
                raise InputError(
                    f"models[{k}].working_point.{name}", where.get(name), "a finite value [MV unit]"
                )
        point = tuple(where[name] for name in names)
        if point in points:
            raise InputError(f"models[{k}].working_point", point, "a working point that no other model has")
        points[point] = model
    grid = [sorted(set(values)) for values in zip(*points, strict=True)]
    for point in itertools.product(*grid):
        if point not in points:
            raise InputError("models", f"none at {point}", "a model at every point of the grid")
    middle = points[tuple(values[len(values) // 2] for values in grid)]
    coefficients = jnp.stack([points[point].coefficients for point in itertools.product(*grid)])
    return ModelSchedule(
        grid=tuple(jnp.asarray(values) for values in grid),
        coefficients=coefficients.reshape(*map(len, grid), *coefficients.shape[1:]),
        reference=middle,
        scheduled=names,
    )


def _cell(grid: Float[Array, " point"], value):
    """The grid points around a value and how far it is from the first to the second, 0..1."""
    last = grid.shape[0] - 1
    if last == 0:
        return 0, 0, 0.0
    i = jnp.clip(jnp.searchsorted(grid, value, side="right") - 1, 0, last - 1)
    return i, i + 1, jnp.clip((value - grid[i]) / (grid[i + 1] - grid[i]), 0.0, 1.0)


def _apart(asked: float | None, values: Float[Array, " value"]) -> float:
    """Distance of the table's controllers along an MV of a schedule [MV unit]."""
    if len(values) == 1:  # the same model everywhere
        return LARGEST
    return asked or float(np.diff(np.asarray(values)).min()) / FINER


def _register(schedule: ModelSchedule, mv, samples: int) -> Float[Array, "cv mv future"]:
    """Coefficients at the MVs, as long as a shift register."""
    model = eqx.tree_at(lambda m: m.coefficients, schedule.reference, schedule.coefficients_at(mv))
    return model.extended(samples)


def _half_way(schedule: ModelSchedule, used: Float[Array, "cv mv future"], future, before, move):
    """The shift register with the effect of a move by the model half-way along it, not by the one that planned it."""
    there = _register(schedule, before + 0.5 * move, used.shape[-1])
    return advance_free_response(future, there - used, move)


_corrected = jax.jit(_half_way)
_coefficients_at: Any = jax.jit(ModelSchedule.coefficients_at)


class ScheduledCore(Core):
    """A core whose problems are built from the interpolated coefficients inside the step."""

    schedule: ModelSchedule

    def consider(self, state: ControllerState, sample: Sample, gap, search=True, most=np.inf) -> Moment:
        """Observe, pose and decide a sample with the model of the present MVs."""
        standing = self.locate(state, sample.mv, sample.manual).mv
        coefficients = _register(self.schedule, standing, self.size.future)
        matrices = matrices_of(self.layout, self.size, coefficients, summed=False)
        qp = self.condensed(self.tuning, matrices)
        tables = eqx.tree_at(lambda t: t.scale, self.tables, qp.unit)
        known: dict[str, Any] = {field.name: getattr(self, field.name) for field in dataclasses.fields(Core)}
        known |= dict(coefficients=coefficients, qp=qp, tables=tables)
        now = Core(**known)
        return now.consider(state, sample, gap, search, most)

    def moving(self, before: Float[Array, " mv"], move: Float[Array, " mv"]) -> Float[Array, "cv mv future"]:
        """Coefficients half-way along a move."""
        return _register(self.schedule, before + 0.5 * move, self.size.future)


class _Table:
    """Controllers with whole moves over the present MVs, made when first needed; steps like `Controllers` of one lane.

    Args:
        spacing: of the table in continuous scheduling MVs [MV unit]; integer MVs have one row per step.
        kept: controllers kept; the one used least recently goes first.
    """

    def __init__(self, controllers: Batch, schedule: ModelSchedule, spacing: float | None, kept: int):
        if spacing is not None and not (is_number(spacing) and spacing > 0):
            raise InputError("spacing", spacing, "a positive distance of models in the table [MV unit]")
        if not is_count(kept):
            raise InputError("kept", kept, "a whole number of controllers, 1 or more")
        self.reference, self.schedule, self.spacing, self.kept = controllers, schedule, spacing, kept
        self.size, self.init, self.structure = controllers.size, controllers.init, controllers.structure
        self.scenarios, self.dv_names, self.count = controllers.scenarios, controllers.dv_names, 1
        steps = (self.structure.steps[k] for k in schedule.places)
        apart = [_apart(step or spacing, v) for step, v in zip(steps, schedule.grid, strict=True)]
        self.places, self.grid = schedule.places, np.array(apart)
        self.built = 0  # controllers made so far
        self._table: collections.OrderedDict[tuple[float, ...], Batch] = collections.OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        """All but the table, which is made again when needed."""
        return self.__dict__ | {"_table": collections.OrderedDict()}

    def of(self, scenarios: Scenarios) -> _Table:
        """As `Batch.of`, with nothing in it yet."""
        return _Table(self.reference.of(scenarios), self.schedule, self.spacing, self.kept)

    def at(self, mv) -> Batch:
        """The controller for the MVs [MV unit], rounded to the table."""
        rounded = np.array(mv, dtype=np.float64)
        rounded[self.places] = np.round(rounded[self.places] / self.grid) * self.grid
        point = tuple(rounded[self.places].tolist())
        if point not in self._table:
            there = dataclasses.replace(self.scenarios, models=[self.schedule.model_at(rounded)])
            self._table[point] = self.reference.of(there)
            self.built += 1
            if len(self._table) > self.kept:
                self._table.popitem(last=False)
        self._table.move_to_end(point)
        return self._table[point]

    def decide(
        self, state: ControllerState, sample: Sample, off: Bool[np.ndarray, "scenario cv"] | None = None
    ) -> tuple[ControllerState, StepInfo]:
        """One sample. Its time includes the making of a controller."""
        clock = Clock()
        before = np.where(np.isfinite(sample.mv[0]), sample.mv[0], np.asarray(state.mv)[0])
        controllers = self.at(before)
        made = clock.seconds
        state, info = controllers.decide(state, sample, off)
        clock = Clock()
        # moves of the others are too small to matter
        if np.any(info.move[0, list(self.structure.integer_mvs)]):
            used = controllers.cores.shared.coefficients
            future = _corrected(self.schedule, used, state.future[0], before, info.move[0])
            state = eqx.tree_at(lambda s: s.future, state, np.asarray(future)[None])
        return state, eqx.tree_at(lambda i: i.solve_time, info, info.solve_time + made + clock.seconds)


class ScheduledController(Controller):
    """MPC with the model of the present MVs.

    Without integer MVs the problem is built from the interpolated coefficients inside the step, which is pure; with them, a
    table of controllers over the present MVs is kept.

    Args:
        spacing: of the table in continuous scheduling MVs [MV unit]; a tenth of the schedule's own by default.
        kept: controllers kept in the table.
        **options: ``gap``, ``time_limit`` and ``finish`` of `Controller`.
    """

    def __init__(
        self,
        structure: Structure,
        tuning: Tuning,
        schedule: ModelSchedule,
        *,
        spacing: float | None = None,
        kept: int = KEPT,
        **options: Any,
    ):
        super().__init__(structure, tuning, schedule.reference, **options)
        self.schedule, self.spacing, self.kept = schedule, spacing, kept
        if structure.integer_mvs:
            self.lanes: Any = _Table(self.lanes, schedule, spacing, kept)
            return
        core = self.lanes.cores.shared
        known: dict[str, Any] = {field.name: getattr(core, field.name) for field in dataclasses.fields(core)}
        scheduled = ScheduledCore(**known, schedule=schedule)
        self.lanes.cores = Lanes(jax.tree.map(lambda _: None, scheduled), scheduled)

    @property
    def compiled(self) -> bool:
        """Whether its steps may be part of a compiled loop."""
        return not self.structure.integer_mvs

    @property
    def core(self) -> Core:
        """What compiled programs know of the controller; of the reference model where there is a table."""
        lanes = self.lanes.reference if self.structure.integer_mvs else self.lanes
        return lanes.cores.shared
