"""Whole moves for one step of one or many controllers of a structure: envelope, finite limits, search.

Between `integer`, which knows scaled problems only, and its callers `plan` and `mixed_integer`, which know
engineering units.
"""

from __future__ import annotations

import contextlib
import copy
import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxmpc.errors import InputError
from jaxmpc.integer.constants import Constants
from jaxmpc.integer.feasible import UndecidedError, chains_of, nearest, whole
from jaxmpc.integer.host_search import SearchResult
from jaxmpc.integer.relaxer import Relaxations, Relaxer
from jaxmpc.integer.solve import solve_integers
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.condense import DRIFT, CondensedQp, QpInstance, condensed, integer_columns
from jaxmpc.problem.memory import check_ranges, check_size
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from jaxmpc.relaxed.newton import WarmStart

WIDEST_ENVELOPE = 4  # steps up to which the envelope of the squared integer move is built

InstancesOf = Callable[[Relaxer], QpInstance]


class StepSolver:
    """Solves the steps of controllers that share a structure.

    Args:
        structure: static configuration.
        tunings: one per scenario, or a single one for all.
        models: one per scenario, or a single one for all.
    """

    def __init__(self, structure: Structure, tunings: Sequence[Tuning], models: Sequence[StepResponseModel]):
        check_size(structure)
        self.structure = structure
        count = max(len(tunings), len(models))
        one_each = lambda given: list(given) * count if len(given) == 1 else list(given)  # noqa: E731
        self.tunings, self.models = one_each(tunings), one_each(models)
        self._relaxers: dict[int, Relaxer] = {}
        limits = np.concatenate([np.asarray(v) for t in tunings for v in (t.cv_low, t.cv_high)])
        self.has_limits = bool(
            np.isfinite(limits).any() and any((np.asarray(t.slack_weight) > 0).any() for t in tunings)
        )

    def relaxer(self, envelope: int) -> Relaxer:
        """Compiled relaxations for integer ranges of so many steps, made when first needed."""
        if envelope not in self._relaxers:
            made: dict[tuple[int, int], Constants] = {}
            for tuning, model in zip(self.tunings, self.models, strict=True):
                if (id(tuning), id(model)) not in made:
                    made[id(tuning), id(model)] = Constants(self.structure, self._qp(tuning, model, envelope))
            each = [made[id(t), id(m)] for t, m in zip(self.tunings, self.models, strict=True)]
            self._relaxers[envelope] = Relaxer(each[:1] if len(made) == 1 else each)
        return self._relaxers[envelope]

    def __getstate__(self) -> dict[str, Any]:
        """What a copy needs; compiled relaxations are made again."""
        return self.__dict__ | {"_relaxers": {}}

    def part(self, index: np.ndarray) -> StepSolver:
        """The solver of some scenarios."""
        some = copy.copy(self)
        some._relaxers = {envelope: relaxer.part(index) for envelope, relaxer in self._relaxers.items()}
        if len(self.tunings) > 1:
            some.tunings, some.models = [self.tunings[i] for i in index], [self.models[i] for i in index]
        return some

    def _qp(self, tuning: Tuning, model: StepResponseModel, envelope: int) -> CondensedQp:
        return condensed(
            self.structure, tuning, model.coefficients, envelope=envelope, has_limits=self.has_limits
        )

    @property
    def compiling(self) -> float:
        """Seconds spent on first calls so far."""
        return sum(relaxer.compiling for relaxer in self._relaxers.values())

    @functools.cached_property
    def narrow(self) -> bool:
        """Whether no integer MV ever moves more than one step: `relaxer(1)` has all constants that are needed."""
        limits = np.array([[np.asarray(t.move_low), np.asarray(t.move_high)] for t in self.tunings])
        steps = [(mv, step) for mv, step in enumerate(self.structure.integer_step) if step is not None]
        return all((np.abs(limits[..., mv]) / step < 2.0 - DRIFT).all() for mv, step in steps)

    def solve(
        self,
        instances_of: InstancesOf,
        *,
        root: Relaxations | None = None,
        previous_moves: Float[np.ndarray, "scenario block mv"] | None = None,
        warm: WarmStart | None = None,
        gap: float = 1e-6,
        time_limit: float | None = None,
        finish: str = "auto",
    ) -> tuple[Relaxer, QpInstance, list[SearchResult], Relaxations]:
        """Solve one step of every scenario.

        Args:
            instances_of: makes the problems, with a scenario axis, for given constants.
            root: the relaxations of `relaxer(1)` if they are known already; only where `narrow`.
            previous_moves: start, in engineering units, or None.
            warm: prices of neighbouring steps with a scenario axis; ignored where their size does not fit.
            gap: relative gap.
            time_limit: seconds of work per scenario, None for none.
            finish: one of `integer.FINISHES`.

        Returns:
            ``(relaxer, problems, results, roots)``: what was solved, how it ended per scenario, and all root relaxations.
        """
        relaxer = self.relaxer(1)
        instances = instances_of(relaxer)
        if root is None:
            relaxer, instances = self._reaching(relaxer, instances, instances_of)
        count = len(instances.lower)
        starts: list[list[np.ndarray]] = [[] for _ in range(count)]
        if previous_moves is not None:
            starts = self.starts(relaxer, previous_moves)
        results, root = solve_integers(
            relaxer,
            instances,
            starts=starts,
            warm=warm,
            root=root,
            gap=gap,
            time_limit=time_limit,
            finish=finish,
        )
        return relaxer, instances, results, root

    def starts(self, relaxer: Relaxer, previous_moves: np.ndarray) -> list[list[np.ndarray]]:
        """The integer moves of plans ``"scenario block mv"`` [MV unit], to be tried as incumbents."""
        integer, starts = relaxer.integer, []
        for i, moves in enumerate(previous_moves):
            wanted = moves.T.reshape(-1)[integer] / relaxer.scenario(i).scales[integer]
            starts.append([np.clip(np.nan_to_num(wanted), -1e6, 1e6)])
        return starts

    def _reaching(self, relaxer: Relaxer, instances: QpInstance, instances_of: InstancesOf):
        """Constants with an envelope as wide as the integer ranges, and the problems for them, their limits finite."""
        integer = relaxer.integer
        lower, upper = self._bounded(instances)
        check_ranges(self.structure, lower[:, integer], upper[:, integer])
        envelope = int(max(np.abs(lower[:, integer]).max(), np.abs(upper[:, integer]).max()))
        if envelope > 1:
            relaxer = self.relaxer(envelope if envelope <= WIDEST_ENVELOPE else 0)
            instances = instances_of(relaxer)
        return relaxer, eqx.tree_at(lambda i: (i.lower, i.upper), instances, (lower, upper))

    def _bounded(self, instances: QpInstance) -> tuple[np.ndarray, np.ndarray]:
        """Limits ``"scenario n"``, finite for integer moves that have none: the level set of a rounded plan."""
        lower, upper = np.array(instances.lower), np.array(instances.upper)
        integer = integer_columns(self.structure)
        if np.isfinite(lower[:, integer]).all() and np.isfinite(upper[:, integer]).all():
            return lower, upper
        relaxer = self.relaxer(0)
        padded, start = _padded(instances, relaxer), relaxer.fitting(None, len(lower))
        root = relaxer.solve_roots(padded, start)
        center = root.x[:, integer]
        fixed_low, fixed_high = lower.copy(), upper.copy()
        for i in range(len(lower)):
            wanted = np.clip(center[i], lower[i, integer], upper[i, integer])
            near = _whole_near(self.structure, instances, i, wanted)
            fixed_low[i, integer] = fixed_high[i, integer] = near
        fixed = eqx.tree_at(lambda i: (i.lower, i.upper), padded, (fixed_low, fixed_high))
        value = relaxer.solve_roots(fixed, start).snapped
        radius = np.stack([relaxer.scenario(i).radius for i in range(len(lower))])
        reach = np.sqrt(2.0 * np.maximum(value - root.bound, 0.0)[:, None] * radius) + 1.0
        if not np.isfinite(reach).all():
            raise InputError(
                "tuning.move_low",
                "infinite",
                "finite move or MV limits for an integer MV that has neither weight nor effect, or that no whole moves"
                " near the relaxed ones satisfy",
            )
        lower[:, integer] = np.maximum(lower[:, integer], np.ceil(center - reach))
        upper[:, integer] = np.minimum(upper[:, integer], np.floor(center + reach))
        return lower, upper


def _whole_near(structure: Structure, instances: QpInstance, i: int, wanted: np.ndarray) -> np.ndarray:
    """Whole moves near `wanted` that satisfy the hard rows; the rounded ones where there are none within reach."""
    row_low, row_high = np.asarray(instances.row_low)[i], np.asarray(instances.row_high)[i]
    chains = chains_of(structure, row_low, row_high)
    for reach in (0, 3, 30):
        low, high = whole(np.floor(wanted + 0.5)) - reach, whole(np.floor(wanted + 0.5)) + reach
        with contextlib.suppress(UndecidedError):
            found = nearest(chains, wanted, low, high)
            if found is not None:
                return found
    return np.round(wanted)


def _padded(instances: QpInstance, relaxer: Relaxer) -> QpInstance:
    """The problems with as many envelope rows as the relaxer's constants have."""
    rows, predictions = relaxer.scenario(0).qp.theta.shape[0], instances.limit_high.shape[-1]
    offset = np.asarray(instances.offset)[:, :predictions]
    offset = np.concatenate([offset, np.zeros((len(offset), rows - predictions))], axis=1)
    return eqx.tree_at(lambda i: i.offset, instances, offset)
