"""What may happen to a controller during a run: others take over from it (thesis 7.2.4), or its plan is carried out to
its end without a look at the well (thesis 7.2.3). `loop.simulate` is the only caller.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxmpc.check import is_number
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.core import ControllerState
from jaxmpc.errors import InputError
from jaxmpc.problem.blocking import moves_of_samples
from jaxmpc.problem.structure import Structure


def checked_changes(
    controller: Controller, changes: Sequence[tuple[float, Controller]], samples: int
) -> dict[int, Controller]:
    """Controllers that take over by the first sample they decide.

    Raises:
        InputError: naming the entry, for times that do not increase or are outside the run, and for controllers whose
            structure or length of the model differs.
    """
    structure, before, out = controller.structure, 0, {}
    for i, (time, other) in enumerate(changes):
        sample = checked_sample(f"changes[{i}].time", time, structure, samples)
        if sample <= before:
            earlier = f"after {before * structure.dt:g} s, the start or the change before"
            raise InputError(f"changes[{i}].time", time, f"a time at least one sample {earlier}")
        if not isinstance(other, Controller) or other.structure != structure:
            raise InputError(
                f"changes[{i}].controller",
                type(other).__name__,
                "a controller of the structure it takes over",
            )
        lengths = [c.lanes.size.future for c in (controller, other)]
        if lengths[0] != lengths[1]:
            raise InputError(
                f"changes[{i}].controller",
                f"a shift register of {lengths[1]} samples",
                f"a model whose register has {lengths[0]}, as before",
            )
        out[sample] = other
        before = sample
    return out


def checked_sample(field: str, time: Any, structure: Structure, samples: int) -> int:
    """The first sample at or after a time [s] inside the run, or an `InputError` that names the field."""
    sample = int(np.ceil(time / structure.dt - 1e-9)) if is_number(time) else -1
    if not 0 <= sample < samples:
        last = (samples - 1) * structure.dt
        raise InputError(field, time, f"a time from 0 to {last:g} s, the last sample of the run")
    return sample


def handed_over(state: ControllerState, fresh: ControllerState) -> ControllerState:
    """The state for a controller that takes over: all of it, but for a start of its solver that does not fit."""
    shapes = [[np.shape(leaf) for leaf in jax.tree.leaves(s.warm)] for s in (state, fresh)]
    return state if shapes[0] == shapes[1] else eqx.tree_at(lambda s: s.warm, state, fresh.warm)


class CarriedOut:
    """A plan that is carried out to its end and then held, whatever the well does."""

    def __init__(self, structure: Structure, made: dict[str, np.ndarray]):
        """Args: the structure, and what the sample that made the plan left behind."""
        self.made = made
        self.moves = moves_of_samples(structure, made["plan"])
        self.moves[0] = made["move"]  # the plan itself may be off by the tolerance of its solver
        self.positions = made["mv_demand"] + np.cumsum(self.moves, axis=0) - self.moves[0]

    def record(self, later: int, cv: np.ndarray) -> dict[str, np.ndarray]:
        """What the sample so many samples later leaves behind: status and bias are those of the plan."""
        last = len(self.moves) - 1
        move = self.moves[later] if later <= last else np.zeros_like(self.moves[0])
        nothing = {name: np.zeros_like(self.made[name]) for name in ("nodes", "solve_time")}
        none = {"plan": np.full_like(self.made["plan"], np.nan)}
        position = self.positions[min(later, last)]
        return self.made | nothing | none | {"cv": cv, "move": move, "mv_demand": position}
