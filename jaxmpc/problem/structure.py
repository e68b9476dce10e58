"""The structure of a controller: horizons, blocks, names and which MVs are integer (thesis 5.1, 6.1, 6.2).

Programs are compiled for its size only (`layout`), and see what follows from it as arrays; weights and limits are in
`tuning.Tuning`.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from typing import Any, Literal

from jaxmpc import html
from jaxmpc.check import LARGEST, is_count, is_number
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.declared import declare, declared
from jaxmpc.problem.values import checked_values, has_gaps, spacing

THESIS_BLOCKS = (1, 1, 1, 1, 2, 2, 4, 4, 8, 8, 8, 16, 16, 32, 32, 64)  # (6.3)


@dataclasses.dataclass(frozen=True)
class Structure:
    """Static configuration of a controller; checked on construction.

    With blocking ``moves`` the move is constant over a block (thesis figure 25), with ``inputs`` the MV is (thesis 6.2):
    it moves at block starts only. The mean-move limit is ``reactive`` (thesis: once the mean of the past moves exceeds
    the limit, no move in that direction) or ``predictive`` (rows on the windowed sum inside the control horizon).

    An integer MV moves in steps of one size, or among listed values; with ``moves`` and a block of several samples every
    value on its way must be in the list. Two of its moves are at least `dwell` samples apart; with ``moves`` the move of a
    block of several samples repeats in each of them, so that a dwell of 2 or more leaves such a block without one.
    Beyond the integer horizon, where moves are relaxed, neither holds.
    """

    cv_names: tuple[str, ...] = declare("", "names of the CVs", "in the order of every array")
    mv_names: tuple[str, ...] = declare("", "names of the MVs", "in the order of every array")
    dt: float = declare("s", "sampling interval", preset=10.0)
    prediction_horizon: int = declare(
        "samples",
        "prediction horizon",
        "j = 1..Hp, of which 1 is the next measurement",
        "H_p (5.1)",
        preset=250,
    )
    control_horizon: int = declare("samples", "control horizon", "", "H_u (5.1)", preset=200)
    first_penalised: int = declare(
        "samples", "first penalised sample", "the first j that costs anything", "H_w (5.1)", preset=1
    )
    blocks: tuple[int, ...] | tuple[tuple[int, ...], ...] = declare(
        "samples",
        "lengths of the blocks",
        "they sum to Hu; empty: no blocking; one list for all MVs, or one per MV",
        "(6.3)",
        preset=THESIS_BLOCKS,
    )
    blocking: Literal["moves", "inputs"] = declare(
        "", "blocking mode", "what a block holds constant", "6.2", preset="moves", choices=("moves", "inputs")
    )
    integer_step: tuple[float | None, ...] = declare(
        "MV unit", "step of {}", "None if continuous; empty if all are", "6.2", of="mv", preset=()
    )
    integer_values: tuple[tuple[float, ...] | None, ...] = declare(
        "MV unit",
        "allowed values of {}",
        "increasing, in place of a step; None without a list; empty if there is none",
        of="mv",
        preset=(),
    )
    dwell: tuple[int, ...] = declare(
        "samples",
        "minimum dwell of {}",
        "from one move of an integer MV to the next; 1 for none; empty if there is none",
        of="mv",
        preset=(),
    )
    integer_horizon: tuple[int | None, ...] = declare(
        "samples",
        "integer horizon of {}",
        "moves of blocks that begin after so many samples need not be whole; one number for all MVs, or one per MV; "
        "None or empty: the control horizon",
        of="mv",
        preset=(),
    )
    mean_move_window: int = declare("samples", "window of the mean move", "", "6.6", preset=25)
    mean_move_mode: Literal["reactive", "predictive"] = declare(
        "", "mode of the mean-move limit", "", "6.6", preset="reactive", choices=("reactive", "predictive")
    )
    cv_units: tuple[str, ...] = declare("", "units of the CVs", "for labels", preset=())
    mv_units: tuple[str, ...] = declare("", "units of the MVs", "for labels", preset=())

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html.fields("Structure", self, declared(Structure))

    def __post_init__(self):
        for key in ("prediction_horizon", "control_horizon", "first_penalised", "mean_move_window"):
            value = getattr(self, key)
            if not is_count(value):
                raise InputError(f"structure.{key}", value, "a whole number of samples, 1 or more")
            object.__setattr__(self, key, int(value))
        if self.first_penalised > self.prediction_horizon:
            raise InputError(
                "structure.first_penalised",
                self.first_penalised,
                f"at most prediction_horizon = {self.prediction_horizon} samples",
            )
        object.__setattr__(self, "blocks", self._checked_blocks())
        for key, field in declared(Structure).items():
            value, expected = getattr(self, key), " or ".join(map(repr, field.choices))
            if expected and value not in field.choices:
                raise InputError(f"structure.{key}", value, expected)
        if not is_number(self.dt) or self.dt <= 0:
            raise InputError("structure.dt", self.dt, "a positive sampling interval [s]")
        steps = tuple(self.integer_step) or (None,) * self.mv_count
        if len(steps) != self.mv_count:
            raise InputError("structure.integer_step", list(steps), f"{self.mv_count} entries, one per MV")
        for name, step in zip(self.mv_names, steps, strict=True):
            if step is not None and not (is_number(step) and 1 / LARGEST <= step <= LARGEST):
                raise InputError(
                    f"structure.integer_step.{name}",
                    step,
                    f"a positive step, {1 / LARGEST:g} to {LARGEST:g} [MV unit]",
                )
        object.__setattr__(
            self, "integer_step", tuple(None if step is None else float(step) for step in steps)
        )
        self._check_values()
        self._check_dwell()
        object.__setattr__(self, "integer_horizon", self._checked_horizon())

    def _check_values(self) -> None:
        lists = tuple(self.integer_values) or (None,) * self.mv_count
        if len(lists) != self.mv_count:
            raise InputError("structure.integer_values", list(lists), f"{self.mv_count} entries, one per MV")
        checked = []
        for name, step, values in zip(self.mv_names, self.integer_step, lists, strict=True):
            path = f"structure.integer_values.{name}"
            if values is not None and step is not None:
                raise InputError(path, list(values), f"no list for an MV with an integer_step ({step:g})")
            checked.append(None if values is None else checked_values(path, values))
        object.__setattr__(self, "integer_values", tuple(checked) if any(checked) else ())

    def _check_dwell(self) -> None:
        dwell = tuple(self.dwell) or (1,) * self.mv_count
        if len(dwell) != self.mv_count:
            raise InputError("structure.dwell", list(dwell), f"{self.mv_count} entries, one per MV")
        for mv, (name, samples) in enumerate(zip(self.mv_names, dwell, strict=True)):
            path = f"structure.dwell.{name}"
            if not is_count(samples):
                raise InputError(path, samples, "a whole number of samples, 1 or more")
            if samples > 1 and mv not in self.integer_mvs:
                expected = "1 for a continuous MV, which moves at every sample"
                raise InputError(path, samples, expected, "Give it an integer_step or integer_values")
            if samples > 1 and self.blocking == "moves" and min(self.blocks_of(mv)) > 1:
                raise InputError(
                    path,
                    samples,
                    "1 where a move repeats in every sample of a block (blocking moves) and no block has a single sample: "
                    "the MV could never move",
                    "Take blocking inputs, or begin with blocks of one sample",
                )
        dwell = tuple(map(int, dwell))
        object.__setattr__(self, "dwell", dwell if max(dwell, default=1) > 1 else ())

    def _checked_blocks(self) -> tuple[int, ...] | tuple[tuple[int, ...], ...]:
        """Lengths of the blocks, one list where those of all MVs are equal."""

        def lengths(path: str, given: Any) -> tuple[int, ...]:
            blocks = tuple(given) or (1,) * self.control_horizon
            if not all(map(is_count, blocks)):
                raise InputError(path, list(blocks), "block lengths in whole samples, 1 or more")
            if sum(blocks) != self.control_horizon:
                horizon = f"control_horizon = {self.control_horizon} samples"
                raise InputError(
                    path, list(blocks), f"lengths that sum to {horizon} (they sum to {sum(blocks)})"
                )
            return tuple(int(b) for b in blocks)

        given = tuple(self.blocks)
        if not any(isinstance(entry, (list, tuple)) for entry in given):
            return lengths("structure.blocks", given)
        lists: tuple[Any, ...] = given
        if len(lists) != self.mv_count or not all(isinstance(entry, (list, tuple)) for entry in lists):
            expected = f"one list of lengths for all MVs, or {self.mv_count} lists, one per MV"
            raise InputError("structure.blocks", list(lists), expected)
        named = zip(self.mv_names, lists, strict=True)
        own = tuple(lengths(f"structure.blocks.{name}", entry) for name, entry in named)
        return own[0] if len(set(own)) == 1 else own

    def _checked_horizon(self) -> tuple[int | None, ...]:
        """Integer horizons of the MVs, None for continuous ones and for the whole control horizon."""
        given: Any = self.integer_horizon
        if given is None or isinstance(given, bool) or is_number(given):
            given = (given,) * self.mv_count
        horizons = tuple(given) or (None,) * self.mv_count
        if len(horizons) != self.mv_count:
            expected = f"a number of samples for all MVs, or {self.mv_count} entries, one per MV"
            raise InputError("structure.integer_horizon", list(horizons), expected)
        for name, horizon in zip(self.mv_names, horizons, strict=True):
            if horizon is not None and not is_count(horizon):
                expected = "a whole number of samples, 1 or more"
                raise InputError(f"structure.integer_horizon.{name}", horizon, expected)
        integer = self.integer_mvs
        return tuple(None if h is None or mv not in integer else int(h) for mv, h in enumerate(horizons))

    @property
    def cv_count(self) -> int:
        """Number of CVs."""
        return len(self.cv_names)

    @property
    def mv_count(self) -> int:
        """Number of MVs."""
        return len(self.mv_names)

    @property
    def own_blocks(self) -> bool:
        """Whether the MVs have blocks of their own."""
        return isinstance(self.blocks[0], tuple)

    def blocks_of(self, mv: int) -> tuple[int, ...]:
        """Lengths of the blocks of one MV [samples]."""
        blocks: Any = self.blocks
        return blocks[mv] if self.own_blocks else blocks

    @property
    def block_count(self) -> int:
        """Number of blocks, the moves per MV that are decided; of the MV with the most."""
        return max(map(len, map(self.blocks_of, range(self.mv_count))))

    def whole_blocks(self, mv: int) -> int:
        """Number of blocks of one MV whose moves are whole: its first ones, none where it is continuous."""
        blocks, horizon = self.blocks_of(mv), self.integer_horizon[mv]
        if mv not in self.integer_mvs:
            return 0
        starts = itertools.accumulate(blocks[:-1], initial=0)
        return len(blocks) if horizon is None else sum(start < horizon for start in starts)

    @property
    def relaxed_moves(self) -> bool:
        """Whether an integer horizon leaves moves of an integer MV relaxed."""
        return any(self.whole_blocks(mv) < len(self.blocks_of(mv)) for mv in self.integer_mvs)

    @property
    def integer_until(self) -> tuple[int, ...]:
        """Samples of the control horizon, from the first on, whose moves are whole, per MV; 0 where it is continuous."""
        return tuple(sum(self.blocks_of(mv)[: self.whole_blocks(mv)]) for mv in range(self.mv_count))

    @property
    def horizon_count(self) -> int:
        """Penalised samples per CV, Hp - Hw + 1."""
        return self.prediction_horizon - self.first_penalised + 1

    @property
    def integer_mvs(self) -> tuple[int, ...]:
        """Positions of the integer MVs."""
        return tuple(i for i, step in enumerate(self.steps) if step is not None)

    @functools.cached_property
    def steps(self) -> tuple[float | None, ...]:
        """Steps of the integer MVs, of a list the greatest that its values have in common; None if continuous [MV unit]."""
        lists = self.integer_values or (None,) * self.mv_count
        pairs = zip(self.integer_step, lists, strict=True)
        return tuple(step if values is None else spacing(values) for step, values in pairs)

    @functools.cached_property
    def has_gaps_or_dwell(self) -> bool:
        """Whether limits and rows do not say all of what whole moves must keep: a list has gaps, or there is a dwell.

        The search on the host knows it; a compiled program leaves the whole moves of such a structure to it.
        """
        return bool(self.dwell) or any(
            values is not None and has_gaps(values) for values in self.integer_values
        )

    def relaxed(self) -> Structure:
        """The same structure with every MV continuous."""
        return dataclasses.replace(self, integer_step=(), integer_values=(), dwell=())


def check_match(structure: Structure, model: StepResponseModel, path: str = "model") -> None:
    """Refuse a model whose names or sampling interval differ from the structure's; errors begin with the path."""
    for key, ours, theirs in (
        ("cv", structure.cv_names, model.cv_names),
        ("mv", structure.mv_names, model.mv_names),
    ):
        if ours != theirs:
            raise InputError(
                f"{path}.{key}", list(theirs), f"the structure's names in its order, {list(ours)}"
            )
    if abs(structure.dt - model.dt) > 1e-9 * structure.dt:
        raise InputError(f"{path}.dt", model.dt, f"the structure's sampling interval {structure.dt} s")
