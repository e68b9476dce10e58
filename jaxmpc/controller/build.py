"""Problems of controllers from structures, tunings and models: one, or many as lanes that share what they have in common."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Bool

from jaxmpc.controller.core import Core, may_switch, without
from jaxmpc.errors import InputError
from jaxmpc.integer.tables import INTEGERS, Constants, Tables
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.condense import CondensedQp, Matrices, condense, matrices_of
from jaxmpc.problem.ideal import has_ideal
from jaxmpc.problem.layout import Layout, Size, layout_of, rung
from jaxmpc.problem.memory import check_size
from jaxmpc.problem.structure import Structure, check_match
from jaxmpc.problem.tuning import Tuning, within_values
from jaxmpc.programs.lanes import Lanes, lanes_of

AT_ONCE = 64  # lanes that are condensed together

_matrices = jax.jit(matrices_of, static_argnames=("size", "summed"))
_condense = jax.jit(condense, static_argnames=("size", "envelope", "has_limits", "has_ideal"))


@functools.partial(jax.jit, static_argnames=("size", "form"))
def _condense_some(layouts: Lanes[Layout], size, tunings, matrices: Lanes[Matrices], form):
    """Problems of `AT_ONCE` lanes, without their responses."""

    def lane(layout, tuning, own):
        given = eqx.combine(own, matrices.shared)
        return _bare(condense(layout, size, tuning, given, **dict(form)))

    return layouts.vmap(lane, tunings, matrices.each)


def _bare(qp: CondensedQp) -> CondensedQp:
    return eqx.tree_at(lambda q: (q.response, q.summed), qp, (None, None), is_leaf=lambda v: v is None)


class _Own(NamedTuple):
    """What was given per scenario."""

    structure: bool
    tuning: bool
    model: bool


@dataclasses.dataclass(frozen=True, eq=False)
class Scenarios:
    """What controllers are made of, checked, one entry per scenario, and what their programs are compiled for."""

    structures: list[Structure]  # with CVs and MVs of the same names
    tunings: list[Tuning]  # weights and limits
    models: list[StepResponseModel]  # step-response models
    # what has lanes; it follows from what was given, not from its values: programs of the same form are the same
    own: _Own
    size: Size  # that holds all structures
    integers: int  # whole moves that the tables of the search have room for
    has_limits: bool  # whether any CV limit costs anything
    has_ideal: bool  # whether any MV has an ideal value
    switching: bool  # whether any CV may be switched off

    @classmethod
    def checked(
        cls,
        structures: Sequence[Structure],
        tunings: Sequence[Tuning],
        models: Sequence[StepResponseModel],
        count: int | None = None,
    ) -> Scenarios:
        """Of structures, tunings and models, each one for all or one per scenario.

        Raises:
            InputError: naming what does not fit.
        """
        given = {"structure": len(structures), "tunings": len(tunings), "models": len(models)}
        for name, number in given.items():
            if not number:
                raise InputError(name, "nothing", "one or more, one for all or one per scenario")
        counts = {*given.values(), count or 1} - {1}
        if len(counts) > 1:
            raise InputError("tunings", given, "one for all or one per scenario")
        first = structures[0]
        for k, structure in enumerate(structures):
            names = lambda s: f"{s.mv_names} -> {s.cv_names}, dt = {s.dt} s"  # noqa: E731
            if names(structure) != names(first):
                raise InputError(f"structure[{k}]", names(structure), f"{names(first)} as the first")
            check_size(structure)
        for k, model in enumerate(models):
            path = f"model[{k}]" if len(models) > 1 else "model"
            check_match(first, model, path)
            if model.dv_names != models[0].dv_names:
                raise InputError(
                    f"{path}.dv", list(model.dv_names), f"{list(models[0].dv_names)} as the first"
                )
        number = counts.pop() if counts else 1
        if len({structure.integer_values for structure in structures}) > 1 and len(tunings) == 1:
            tunings = list(tunings) * number
        own = len(structures) > 1 and len(tunings) > 1
        tunings = [within_values(structures[k if own else 0], t) for k, t in enumerate(tunings)]
        one_each = lambda values: list(values) * number if len(values) == 1 else list(values)  # noqa: E731
        pairs = {(s, m.samples) for s in set(structures) for m in models}
        most = max(sum(map(s.whole_blocks, s.integer_mvs)) for s in structures)
        return cls(
            *map(one_each, (structures, tunings, models)),
            own=_Own(*(len(values) > 1 for values in (structures, tunings, models))),
            size=functools.reduce(lambda a, b: a | b, (Size.of(*p, len(models[0].dv_names)) for p in pairs)),
            integers=min(rung(most, INTEGERS), INTEGERS[-1]) if most else 0,
            has_limits=any(map(_limited, tunings)),
            has_ideal=any(map(has_ideal, tunings)),
            switching=any(may_switch(tuning) for tuning in tunings),
        )

    @property
    def count(self) -> int:
        """Number of scenarios."""
        return len(self.structures)

    @property
    def structure(self) -> Structure:
        """The first, which names and sampling intervals are taken from."""
        return self.structures[0]

    @property
    def lanes(self) -> bool:
        """Whether anything was given per scenario."""
        return any(self.own)

    def _coefficients(self) -> list[Any]:
        """Of the models, as long as the shift register."""
        made = {id(model): model.extended(self.size.future) for model in self.models}
        return [made[id(model)] for model in self.models]

    def _dv_coefficients(self) -> list[Any]:
        """As `_coefficients`, of the measured disturbances; None where there are none."""
        made = {id(m): m.extended_dvs(self.size.future) if self.size.dvs else None for m in self.models}
        return [made[id(model)] for model in self.models]

    def problems(self, envelope: int) -> Lanes[CondensedQp]:
        """Constant parts of the problems, for integer moves of so many steps."""
        size = self.size
        form: dict[str, Any] = dict(
            envelope=envelope if self.integers else 0,
            has_limits=self.has_limits,
            has_ideal=self.has_ideal,
        )
        made: dict[tuple[Structure, int], Matrices] = {}
        own = self.own.structure or self.own.model
        each = []
        for structure, coefficients in zip(self.structures, self._coefficients(), strict=True):
            key = structure, id(coefficients)
            if key not in made:
                # running sums take memory: every lane with its own response goes without
                made[key] = _matrices(layout_of(structure, size), size, coefficients, summed=not own)
            each.append(made[key])
        if not self.lanes:
            qp = _condense(layout_of(self.structure, size), size, self.tunings[0], each[0], **form)
            return lanes_of([qp])
        matrices = lanes_of(each, shared=not own)
        # on the host, where another number of them needs no program of its own
        layouts, tunings = self.layouts(), jax.tree.map(lambda *v: np.stack(v), *self.tunings)
        found = []
        for begin in range(0, self.count, AT_ONCE):
            index = np.minimum(begin + np.arange(AT_ONCE), self.count - 1)
            some = jax.tree.map(lambda v, i=index: np.asarray(v)[i], (layouts.each, tunings, matrices.each))
            some_layouts, some_matrices = Lanes(some[0], layouts.shared), Lanes(some[2], matrices.shared)
            qps = _condense_some(some_layouts, size, some[1], some_matrices, tuple(form.items()))
            used = min(AT_ONCE, self.count - begin)
            found.append(jax.tree.map(lambda v, u=used: np.asarray(v)[:u], qps))
        joined = jax.tree.map(lambda *v: np.concatenate(v), *found)
        responses = lambda q: (q.response, q.summed)  # noqa: E731
        put = lambda qp, m: eqx.tree_at(responses, qp, (m.response, m.summed), is_leaf=lambda v: v is None)  # noqa: E731
        nothing = jax.tree.map(lambda _: None, joined)
        return Lanes(put(joined, matrices.each), put(nothing, matrices.shared))

    def layouts(self) -> Lanes[Layout]:
        """Structures as arrays."""
        layouts = [layout_of(s, self.size) for s in self.structures]
        return lanes_of(layouts, shared=not self.own.structure)

    def constants(self, qps: Lanes[CondensedQp]) -> list[Constants]:
        """What searches need of the problems, one per scenario or a single one where all share it."""
        if not self.lanes:
            return [Constants(self.structure, self.size, jax.tree.map(np.asarray, qps.shared))]
        local = Lanes(*(jax.tree.map(np.asarray, part) for part in (qps.each, qps.shared)))
        return [Constants(s, self.size, local.lane(k)) for k, s in enumerate(self.structures)]

    def core(self, qps: Lanes[CondensedQp], constants: Sequence[Constants]) -> Lanes[Core]:
        """Everything that compiled programs know, shared where it is given once."""
        restricted = any(s.has_gaps_or_dwell for s in self.structures)
        made = [c.tables(self.integers, restricted) for c in constants]
        tables = lanes_of(made, shared=not self.lanes) if self.integers else _no_tables(qps)
        parts = [
            self.layouts(),
            lanes_of(self.tunings, shared=not self.own.tuning),
            lanes_of(self._coefficients(), shared=not self.own.model),
            lanes_of(self._dv_coefficients(), shared=not self.own.model),
            qps,
            tables,
        ]
        of = lambda key: [getattr(part, key) for part in parts]  # noqa: E731
        statics = dict(size=self.size, switching=self.switching)
        return Lanes(Core(*of("each"), **statics), Core(*of("shared"), **statics))

    def part(self, index: np.ndarray) -> Scenarios:
        """Some of the scenarios, in arrays of the same size."""
        some = {key: [getattr(self, key)[i] for i in index] for key in ("structures", "tunings", "models")}
        return dataclasses.replace(self, **some)

    def ready_for(self, tunings: Sequence[Tuning], *, own: bool = False) -> Scenarios:
        """The same scenarios for programs of a form that holds these tunings, too; `own`: with one per scenario."""
        return dataclasses.replace(
            self,
            own=self.own._replace(tuning=self.own.tuning or own),
            has_limits=self.has_limits or any(map(_limited, tunings)),
            has_ideal=self.has_ideal or any(map(has_ideal, tunings)),
            switching=self.switching or any(map(may_switch, tunings)),
        )

    def with_tunings(self, tunings: Sequence[Tuning]) -> Scenarios:
        """The same scenarios with other tunings, one each, for programs of the same form if that holds them."""
        pairs = [(s, id(t)) for s, t in zip(self.structures, tunings, strict=True)]
        made = {key: within_values(key[0], t) for key, t in zip(pairs, tunings, strict=True)}
        ready = self.ready_for(list(made.values()), own=len({id(t) for t in tunings}) > 1)
        return dataclasses.replace(ready, tunings=[made[key] for key in pairs])

    def without(self, off: Bool[np.ndarray, "scenario cv"]) -> Scenarios:
        """The same scenarios without the CVs that are switched off."""
        pairs = [(id(t), own.tobytes()) for t, own in zip(self.tunings, off, strict=True)]
        made = {key: without(t, own) for key, t, own in zip(pairs, self.tunings, off, strict=True)}
        return self.with_tunings([made[key] for key in pairs])


def _no_tables(qps: Lanes[CondensedQp]) -> Lanes[Tables]:
    """For problems without integer moves; traced where these are."""
    shared = qps.each.curvature is None
    scale = qps.value.unit
    one, square, levels = np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0))
    whole, flag = one.astype(int), one.astype(bool)
    zero, yes = np.asarray(0), np.asarray(True)
    rest = whole, whole, whole, flag, square, square, one, square, square, levels, one
    fields: list[Any] = [zero, yes, *rest, scale]
    none = Tables(*fields)
    nothing = jax.tree.map(lambda _: None, none)
    put = lambda tables: eqx.tree_at(lambda t: t.scale, tables, scale, is_leaf=lambda v: v is None)  # noqa: E731
    if shared:
        return Lanes(nothing, none)
    return Lanes(put(nothing), eqx.tree_at(lambda t: t.scale, none, None))


def _limited(tuning: Tuning) -> bool:
    """Whether any CV limit costs anything; true where that is not known yet."""
    low, high, price = tuning.cv_low, tuning.cv_high, tuning.slack_weight
    if any(isinstance(v, Tracer) for v in (low, high, price)):
        return True
    return bool(((np.isfinite(low) | np.isfinite(high)) & (np.asarray(price) > 0)).any())
