"""One closed loop on the JAX well from a handful of settings, with key figures and every plan: what the app computes.

Only numbers change from one run to the next as long as controller, blocking and length stay the same, so that nothing
is compiled again. `main` prints the key figures of a run.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import xarray as xr

from figures.closed_loop import RUN, of_trajectory
from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError
from jaxmpc.loop.simulate import simulate
from jaxmpc.loop.trajectory import RECORDABLE, Trajectory, TrajectoryBatch
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from jaxmpc.process.reference import Reference
from jaxmpc.process.well.plant import WellPlant
from studies.definition import presets, references
from studies.definition.models import identify_models
from studies.kpi.sweep import KPIS, RECORD, batch_kpis
from studies.thesis.well import CHOKE, GAS, OIL

Progress = Callable[[int, int], None]

CONTROLLERS = {  # kind of the controller and of the choke
    "continuous": ("continuous", "continuous"),
    "rounded": ("continuous", "step"),
    "mixed-integer": ("mixed-integer", "step"),
}
BLOCKING = ("moves", "inputs", "none")
CHOICES = {"controller": tuple(CONTROLLERS), "preset": tuple(presets.TUNINGS), "blocking": BLOCKING}
START = references.THESIS_WINDOWS[0][1:]  # gas and oil setpoint at the working point [m3/h]
STEP_TIME = 300.0  # s, when the setpoints of a short run change
SHORT = 1800.0  # s, length of a short run

# The key figures that are shown, with the words for them; the part behind the dot is a CV.
SHOWN = {
    "choke_travel": "choke travel",
    "choke_moves": "choke moves",
    "choke_reversals": "choke reversals",
    "lift_travel": "lift travel",
    f"mean_absolute_deviation.{OIL}": "mean deviation, oil",
    f"mean_absolute_deviation.{GAS}": "mean deviation, gas",
    f"time_outside_deadzone.{OIL}": "outside deadzone, oil",
    f"time_outside_deadzone.{GAS}": "outside deadzone, gas",
    "oil_produced": "oil produced",
    "closed_loop_cost": "cost per sample",
    "solve_time_median": "solve time, median",
    "solve_time_max": "solve time, longest",
    "largest_gap": "largest gap",
    "not_optimal": "not optimal",
}


def _in(unit: str, default: float | None) -> Any:
    """A number of `Settings` with its unit."""
    return dataclasses.field(default=default, metadata={"unit": unit})


@dataclasses.dataclass(frozen=True)
class Settings:
    """What a run is made of; None takes the value of the preset."""

    controller: str = "mixed-integer"  # a key of `CONTROLLERS`; "rounded" is continuous MPC on the step choke
    preset: str = "thesis"  # a key of `studies.definition.presets.TUNINGS`
    soft: bool = True  # False turns Soft MPC off: the weight of the deviation becomes Q + S, as in a sweep
    blocking: str = "moves"  # one of `BLOCKING`
    choke_weight: float | None = _in("1/%^2", None)  # of its moves
    gas_weight: float | None = _in("1/(m3/h)^2", None)  # of the deviation
    oil_weight: float | None = _in("1/(m3/h)^2", None)
    gas_deadzone: float | None = _in("m3/h", None)  # half width
    oil_deadzone: float | None = _in("m3/h", None)
    model_choke: float = _in("%", 50.0)  # working point of the model
    model_lift: float = _in("m3/h", 7500.0)
    gas_setpoint: float = _in("m3/h", 9640.0)  # of a short run, from `STEP_TIME` on
    oil_setpoint: float = _in("m3/h", 152.0)
    pressure: float = _in("bar", 0.0)  # change of the reservoir pressure, the disturbance
    pressure_time: float = _in("s", 900.0)  # from when on
    whole: bool = False  # the whole reference of the thesis (22 h) instead of a short run

    def __post_init__(self):
        for field, known in CHOICES.items():
            if getattr(self, field) not in known:
                raise InputError(field, getattr(self, field), f"one of {', '.join(known)}")
        if self.blocking == "none" and self.controller == "mixed-integer":
            hint = "Without blocks a step with whole moves takes seconds; choose moves or inputs, or another controller"
            raise InputError("blocking", "none", "blocks for whole moves", hint)
        for field, unit in (("pressure", "bar"), ("pressure_time", "s")):
            if not np.isfinite(getattr(self, field)):
                raise InputError(field, getattr(self, field), f"a number [{unit}]")

    @property
    def structure(self) -> Structure:
        """The checked structure."""
        return presets.structure(self.blocking, integer=self.controller == "mixed-integer")  # type: ignore[arg-type]

    @property
    def tuning(self) -> Tuning:
        """The checked tuning."""
        fields = presets.tuning_fields(self.preset)
        given = {
            "cv_weight": {GAS: self.gas_weight, OIL: self.oil_weight},
            "deadzone": {GAS: self.gas_deadzone, OIL: self.oil_deadzone},
            "move_weight": {CHOKE: self.choke_weight},
        }
        for key, values in given.items():
            fields[key] |= {name: value for name, value in values.items() if value is not None}
        if not self.soft:
            both = {name: fields["cv_weight"][name] + fields["soft_quadratic"][name] for name in (GAS, OIL)}
            off = {GAS: 0.0, OIL: 0.0}
            fields |= {"cv_weight": both, "soft_quadratic": off, "soft_linear": off}
        return presets.tuning(self.structure, self.preset, fields)

    @property
    def reference(self) -> Reference:
        """The thesis run, or a short run that changes the setpoints once."""
        if self.whole:
            return references.thesis()
        return Reference([0.0, STEP_TIME], [START, (self.gas_setpoint, self.oil_setpoint)], SHORT)

    @property
    def offsets(self) -> np.ndarray:
        """Change of the reservoir pressure, ``"sample"`` [bar]."""
        dt = presets.SAMPLING_INTERVAL
        times = np.arange(self.reference.samples(dt)) * dt
        return np.where(times >= self.pressure_time - 1e-9 * dt, self.pressure, 0.0)


@dataclasses.dataclass(frozen=True, eq=False)
class ExploreRun:
    """A finished run."""

    settings: Settings
    trajectory: Trajectory  # every sample, with its plans
    kpis: dict[
        str, float
    ]  # every key figure of `studies.kpi.sweep`; ``name.channel`` where it is one per CV or MV
    model: StepResponseModel
    tuning: Tuning
    structure: Structure
    seconds: float  # that it took, key figures included

    @functools.cached_property
    def data(self) -> xr.Dataset:
        """The run as `studies.store.reading.open_results` would give it, with one controller `RUN`."""
        t, structure, settings = self.trajectory, self.structure, self.settings
        kind, actuator = CONTROLLERS[settings.controller]
        known: dict[str, Any] = {
            "plan": (("controller", "time", "block", "mv"), np.asarray(t.plan)[None]),
            "window": ("time", settings.reference.window(t.dt, t.samples)),
            "disturbance": ("time", settings.offsets[: t.samples]),
            "model_coefficient": (("cv", "mv", "lag"), np.asarray(self.model.coefficients)),
            "block_length": (("controller", "block"), np.array([structure.blocks])),
            "prediction_horizon": ("controller", [structure.prediction_horizon]),
            "complete": ("controller", [1]),
            "blocking": ("controller", [structure.blocking]),
        }
        for name in ("deadzone", "soft_quadratic", "soft_linear"):
            known[f"tuning_{name}"] = (("controller", "cv"), np.asarray(getattr(self.tuning, name))[None])
        definition = {"controllers": [{"name": RUN, "kind": kind, "actuator": actuator, "schedule": False}]}
        run = of_trajectory(t, self.tuning.deadzone, kind, actuator)
        return run.assign(known).assign_attrs(definition=json.dumps(definition))


@functools.lru_cache(maxsize=64)
def model_at(choke: float, lift: float) -> StepResponseModel:
    """The model identified at a working point, choke [%] and gas lift [m3/h]; kept for the next run."""
    (model,) = identify_models([(choke, lift)]).values()
    return model


def run(settings: Settings, progress: Progress | None = None) -> ExploreRun:
    """Close the loop; `progress` is called with ``(done, total)`` samples.

    Raises:
        InputError: naming the field, for settings that no controller or well can have; before anything runs.
    """
    begin = time.perf_counter()
    structure, tuning, reference = settings.structure, settings.tuning, settings.reference
    model = model_at(float(settings.model_choke), float(settings.model_lift))
    _, actuator = CONTROLLERS[settings.controller]
    trajectory = simulate(
        Controller(structure, tuning, model),
        WellPlant(actuator=actuator),  # type: ignore[arg-type]
        reference,
        disturbance=settings.offsets,
        keep_plans=True,
        progress=progress,
    )
    figures = key_figures(trajectory, tuning, reference.window(trajectory.dt, trajectory.samples))
    seconds = time.perf_counter() - begin
    return ExploreRun(settings, trajectory, figures, model, tuning, structure, seconds)


def key_figures(trajectory: Trajectory, tuning: Tuning, window: np.ndarray) -> dict[str, float]:
    """Every key figure of a run by name, ``name.channel`` where it is one per CV or MV; window labels ``"sample"``."""
    t = trajectory
    recorded = {name: np.asarray(getattr(t, name))[None] for name in RECORDABLE if name in RECORD}
    same = {name: getattr(t, name) for name in ("time", "cv_names", "mv_names", "cv_units", "mv_units", "dt")}
    batch = TrajectoryBatch(np.zeros(1, dtype=int), setpoint=t.setpoint[None], fields=recorded, **same)
    values = batch_kpis(batch, tuning, window)
    out: dict[str, float] = {}
    for item in KPIS:
        names = {(): ("",), ("cv",): t.cv_names, ("mv",): t.mv_names}[item.dims]
        for name, value in zip(names, np.atleast_1d(values[item.name][0]), strict=True):
            out[f"{item.name}.{name}" if name else item.name] = float(value)
    return out


def shown_figures(run: ExploreRun) -> list[tuple[str, str, float]]:
    """The key figures of `SHOWN`: words, unit, value."""
    by_name = {item.name: item for item in KPIS}
    return [
        (words, by_name[key.partition(".")[0]].unit_of("m3/h"), run.kpis[key]) for key, words in SHOWN.items()
    ]


def written(value: float, unit: str) -> tuple[str, str]:
    """A key figure and its unit as they are printed: times below a second in ms, others as they are."""
    if unit == "s" and abs(value) < 1:
        value, unit = 1e3 * value, "ms"
    number = f"{value:,.4g}" if abs(value) < 1e4 else f"{value:,.0f}"
    return number, "" if unit == "1" else unit.replace("m3", "m³")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run once and print the key figures; every field of `Settings` is an option."""
    parser = argparse.ArgumentParser(
        prog="explore",
        description="Close one loop and print its key figures.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        allow_abbrev=False,
    )
    for field in dataclasses.fields(Settings):
        option = f"--{field.name.replace('_', '-')}"
        if isinstance(field.default, bool):
            action = argparse.BooleanOptionalAction
            parser.add_argument(option, action=action, default=field.default, help="-")
        elif field.name in CHOICES:
            parser.add_argument(option, choices=CHOICES[field.name], default=field.default, help="-")
        else:
            unit = field.metadata["unit"].replace("%", "%%")
            given = "" if field.default is not None else ", the preset's if not given"
            parser.add_argument(option, type=float, default=field.default, help=f"[{unit}]{given}")
    options = vars(parser.parse_args(arguments))
    try:
        done = run(Settings(**options))
    except InputError as error:
        parser.error(str(error))
    for words, unit, value in shown_figures(done):
        number, shown = written(value, unit)
        print(f"{words:28} {number:>12} {shown}")
    print(f"{'this run, compilation included':28} {done.seconds:>10.3g} s")
