"""Which columns of a log belong to the variables of a process."""

from __future__ import annotations

from typing import NamedTuple

from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.process import Process


class Tags(NamedTuple):
    """Columns of the CVs, the MVs and the measured disturbances of a model, in its order."""

    cv: list[str]
    mv: list[str]
    dv: list[str]

    @property
    def inputs(self) -> list[str]:
        """Of MVs, then of measured disturbances."""
        return [*self.mv, *self.dv]


def tags_of(process: Process, model: StepResponseModel) -> Tags:
    """The columns of a process, whose model says which disturbances are measured."""
    known = {variable.name: variable.column for variable in process.disturbances}
    cv, mv = ([variable.column for variable in own] for own in (process.cvs, process.mvs))
    return Tags(cv, mv, [known.get(name, name) for name in model.dv_names])
