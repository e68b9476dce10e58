"""The tables of a process file that are typed objects as they stand: CVs, MVs, disturbances, plants, model, key figures.

`jaxmpc.process.file` reads them and a `Process` holds them; what can be wrong in one alone is refused here.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from jaxmpc.check import is_number, require
from jaxmpc.process.actuator import Actuator
from jaxmpc.process.responses import LONGEST, TransferFunctionSection

Positive = Annotated[float, msgspec.Meta(gt=0)]
Numbers = dict[str, float]


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table of the file."""


class Named(Section, frozen=True):
    """What has a name, and a label in words without the unit: the name itself, if not given."""

    name: str
    label: str = ""

    def __post_init__(self):
        msgspec.structs.force_setattr(self, "label", self.label or self.name.replace("_", " "))


class Variable(Named, frozen=True):
    """A CV, an MV or a disturbance (``[[disturbance]]``)."""

    unit: str = "1"
    span: Positive = 1.0  # how far it typically moves, in its unit
    tag: str = ""  # what logs of the plant call it; its name, if not given

    @property
    def column(self) -> str:
        """Of a log."""
        return self.tag or self.name


class Limited(Variable, frozen=True):
    """A variable with limits, for presets that do not give their own."""

    low: float = -np.inf
    high: float = np.inf

    def __post_init__(self):
        super().__post_init__()
        for name in ("low", "high"):
            value = getattr(self, name)
            require(not np.isnan(value), name, value, f"a number [{self.unit}]")
        require(self.low < self.high, "low", self.low, f"less than high = {self.high:g} [{self.unit}]")


class Cv(Limited, frozen=True):
    """A controlled variable (``[[cv]]``); its limits are soft."""

    # half width around the setpoint in which it counts as settled; a fiftieth of the span, if not given [CV unit]
    settled: float = None  # pyright: ignore[reportAssignmentType]
    setpoint_tag: str = ""  # what logs call its setpoint, if they have it

    def __post_init__(self):
        super().__post_init__()
        settled = self.span / 50 if self.settled is None else self.settled
        expected = f"a half width above 0 [{self.unit}]"
        require(settled > 0 and is_number(settled), "settled", settled, expected)
        msgspec.structs.force_setattr(self, "settled", settled)


class ActuatorSection(Section, frozen=True):
    """``actuator = {...}`` of an MV, which has the limits; see `jaxmpc.process.actuator.Actuator`."""

    kind: Literal["continuous", "stepped", "values", "on-off"]
    step: Positive | None = None
    threshold: Positive | None = None
    origin: float = 0.0
    values: tuple[float, ...] = ()


class Mv(Limited, frozen=True):
    """A manipulated variable (``[[mv]]``)."""

    move: Positive = np.inf  # largest move per sample, for presets that do not give their own [MV unit]
    # what counts as a move in key figures is larger; a thousandth of the span, if not given [MV unit]
    smallest_move: float = None  # pyright: ignore[reportAssignmentType]
    moved_by: ActuatorSection = msgspec.field(name="actuator", default=ActuatorSection("continuous"))

    def __post_init__(self):
        super().__post_init__()
        smallest = self.span / 1000 if self.smallest_move is None else self.smallest_move
        expected = f"0 or more [{self.unit}]"
        require(is_number(smallest) and smallest >= 0, "smallest_move", smallest, expected)
        msgspec.structs.force_setattr(self, "smallest_move", smallest)
        _ = self.actuator  # what it refuses is refused here

    @property
    def actuator(self) -> Actuator:
        """What it does with a demand."""
        own = self.moved_by
        given = {"step": own.step, "threshold": own.threshold, "values": own.values}
        given = {name: value for name, value in given.items() if value not in (None, ())}
        return Actuator(own.kind, low=self.low, high=self.high, origin=own.origin, **given)


class PlantSource(Section, frozen=True):
    """Where a plant comes from (``[plants.NAME]``).

    Attributes:
        kind: ``model`` (a step-response model as its own plant), ``jax``, ``fmu`` or ``python``.
        source: a file, or ``module:name`` of a function that gets ``actuators`` and gives the plant.
        options: further arguments of the plant.
    """

    kind: Literal["model", "jax", "fmu", "python"]
    source: str = ""
    options: dict[str, Any] = {}


class ModelSource(Section, frozen=True):
    """Where the step-response model comes from (``[model]``): a file, transfer functions, or a step test on the plant."""

    file: str = ""
    # pairs that are not listed do not respond
    responses: tuple[TransferFunctionSection, ...] = msgspec.field(name="transfer_functions", default=())
    # of the step test, by MV [MV unit]; of transfer functions, what CVs and MVs deviate from, 0 where not given
    working_point: Numbers = {}
    steps: Numbers = {}  # sizes of its steps, by MV [MV unit]
    disturbance_steps: Numbers = {}  # of measured disturbances, by name
    # positions of one or two MVs at which the models of a gain schedule are identified [MV unit]
    schedule: dict[str, tuple[float, ...]] = {}
    samples: Annotated[int, msgspec.Meta(ge=1, le=LONGEST)] = 250  # coefficients

    @property
    def given(self) -> bool:
        """Whether it needs no step test."""
        return bool(self.file or self.responses)


class KeyFigure(Named, frozen=True, kw_only=True):
    """An integral over a run that belongs to this process, such as a volume produced (``[[key_figure]]``)."""

    integral_of: str  # CV or MV, which is held from sample to sample
    unit: str
    per: Positive = 1.0  # seconds of the time unit in the unit of the rate
