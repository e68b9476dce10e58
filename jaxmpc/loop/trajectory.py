"""What a closed loop leaves behind: one `Trajectory` per run, plain arrays with the time axis first.

`jaxmpc.loop.simulate.simulate` makes it; stores, key figures and plots read it. `TrajectoryBatch` holds many runs of one
structure, with the lane axis before the time axis, and of each only what was asked for. Sample k is the interval from
`time[k]` to `time[k + 1]`: `cv[k]` is measured at its start, `mv_demand[k]` is decided from that measurement
and held until its end.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np

from jaxmpc import html
from jaxmpc.errors import InputError


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectory:
    """One closed-loop run.

    Attributes:
        time: ``"sample"``, start of each sample [s].
        setpoint: ``"sample cv"`` [CV unit].
        cv: ``"sample cv"``, measured at `time` by sensors without fault, noise included [CV unit].
        mv_demand: ``"sample mv"``, demand of the controller, held from `time` [MV unit].
        mv: ``"sample mv"``, what the actuators did with it, steps and limits included [MV unit].
        move: ``"sample mv"``, demand minus previous demand [MV unit].
        bias: ``"sample cv"``, filtered output bias v(k|k) (6.4) [CV unit].
        bias_raw: ``"sample cv"``, measured minus predicted output (2.31b) [CV unit].
        quality: ``"sample cv"``, codes of `measurement.QUALITY`: 0 good, all other measurements were left out.
        off: ``"sample cv"``, whether the CV was switched off after too many of them.
        status: ``"sample"``, codes of `jaxmpc.status`: 0 optimal, 1 limit, 2 infeasible, 3 failed.
        fallback: ``"sample"``, whether the MVs were held because the solve gave no plan.
        objective: ``"sample"``, objective (6.6) of the applied plan, constants included.
        bound: ``"sample"``, proven lower bound of the objective.
        gap: ``"sample"``, relative gap between the two.
        nodes: ``"sample"``, relaxations solved in a search.
        solve_time: ``"sample"`` [s].
        finished_by: ``"sample"``, codes of `jaxmpc.status.FINISHERS`.
        cv_names, mv_names, cv_units, mv_units: names and units in the order of the arrays.
        dt: sampling interval [s].
        plan: ``"sample block mv"``, block moves planned at each sample [MV unit], not a number where none was made; None
            if plans were not kept.
    """

    time: np.ndarray
    setpoint: np.ndarray
    cv: np.ndarray
    mv_demand: np.ndarray
    mv: np.ndarray
    move: np.ndarray
    bias: np.ndarray
    bias_raw: np.ndarray
    quality: np.ndarray
    off: np.ndarray
    status: np.ndarray
    fallback: np.ndarray
    objective: np.ndarray
    bound: np.ndarray
    gap: np.ndarray
    nodes: np.ndarray
    solve_time: np.ndarray
    finished_by: np.ndarray
    cv_names: tuple[str, ...]
    mv_names: tuple[str, ...]
    cv_units: tuple[str, ...]
    mv_units: tuple[str, ...]
    dt: float
    plan: np.ndarray | None = None

    def __post_init__(self):
        samples = np.shape(self.time)[0] if np.ndim(self.time) == 1 else -1
        for axis, keys in AXES.items():
            size = {"": (), "cv": (len(self.cv_names),), "mv": (len(self.mv_names),)}[axis]
            for key in keys:
                shape = np.shape(getattr(self, key))
                if shape != (samples, *size):
                    raise InputError(
                        f"trajectory.{key}", f"shape {list(shape)}", f"shape {[max(samples, 0), *size]}"
                    )
        shape = () if self.plan is None else np.shape(self.plan)
        if self.plan is not None and (len(shape) != 3 or shape[::2] != (samples, len(self.mv_names))):
            expected = f"shape [{max(samples, 0)}, blocks, {len(self.mv_names)}]"
            raise InputError("trajectory.plan", f"shape {list(shape)}", expected)

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.time)

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html.trajectory(self)


AXES = {
    "": (
        "time",
        "status",
        "fallback",
        "objective",
        "bound",
        "gap",
        "nodes",
        "solve_time",
        "finished_by",
    ),
    "cv": ("setpoint", "cv", "bias", "bias_raw", "quality", "off"),
    "mv": ("mv_demand", "mv", "move"),
}


RECORDABLE = tuple(key for keys in AXES.values() for key in keys if key not in ("time", "setpoint"))


@dataclasses.dataclass(frozen=True, eq=False)
class TrajectoryBatch:
    """Some closed-loop runs of one structure; `batch["cv"]` is an array ``"lane sample cv"``.

    Attributes:
        lanes: ``"lane"``, which lanes of the whole sweep these are.
        fields: the recorded fields of `Trajectory` by name, each with a lane axis first, which `setpoint` has, too.
    """

    lanes: np.ndarray
    time: np.ndarray
    setpoint: np.ndarray
    fields: Mapping[str, np.ndarray]
    cv_names: tuple[str, ...]
    mv_names: tuple[str, ...]
    cv_units: tuple[str, ...]
    mv_units: tuple[str, ...]
    dt: float

    def __len__(self) -> int:
        return len(self.lanes)

    def __getitem__(self, field: str) -> np.ndarray:
        if field not in self.fields:
            recorded = ", ".join(self.fields) or "nothing"
            raise InputError("record", field, f"a recorded field; recorded were: {recorded}")
        return self.fields[field]

    def trajectory(self, k: int) -> Trajectory:
        """The k-th of these runs; needs every field.

        Raises:
            InputError: naming a field that was not recorded.
        """
        return Trajectory(
            time=self.time,
            setpoint=self.setpoint[k],
            **{field: self[field][k] for field in RECORDABLE},
            cv_names=self.cv_names,
            mv_names=self.mv_names,
            cv_units=self.cv_units,
            mv_units=self.mv_units,
            dt=self.dt,
        )

    def trajectories(self) -> Iterator[Trajectory]:
        """All runs, one after the other."""
        return (self.trajectory(k) for k in range(len(self)))
