"""A plan that is carried out to its end without a look at the process (thesis 7.2.3), and times inside a run.

`loop.simulate` is the only caller.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxmpc.check import is_number
from jaxmpc.errors import InputError
from jaxmpc.problem.blocking import moves_of_samples
from jaxmpc.problem.structure import Structure


def checked_sample(field: str, time: Any, structure: Structure, samples: int) -> int:
    """The first sample at or after a time [s] inside the run, or an `InputError` that names the field."""
    sample = int(np.ceil(time / structure.dt - 1e-9)) if is_number(time) else -1
    if not 0 <= sample < samples:
        last = (samples - 1) * structure.dt
        raise InputError(field, time, f"a time from 0 to {last:g} s, the last sample of the run")
    return sample


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
