"""A step-response model as its own plant: the process does what the controller predicts, as far as nobody says otherwise.

It makes loops of any process whose model is known, without equations: with actuators, load disturbances on every CV, and
gains, dead times and time scales that differ from those of the controller's model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxmpc.check import among, is_number
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import StepResponseModel, shift_free_response
from jaxmpc.process.actuator import Actuator, Actuators
from jaxmpc.process.plant import JaxPlant, Outputs, Parameter, Signals, checked_parameters
from jaxmpc.process.responses import LONGEST

NOTHING = 1e-9  # of the largest value of a response: what counts as no response yet
KNOBS = (
    Parameter("gain", "1", 1.0, "factor on the gain"),
    Parameter("dead_time", "s", 0.0, "added dead time"),
    Parameter("time_scale", "1", 1.0, "factor on the time of the response", positive=True),
)


class ModelState(NamedTuple):
    """State of the plant."""

    future: Float[Array, "cv n"]  # effect of past inputs on the CVs from the next sample on [CV unit]
    deviation: Float[Array, " cv"]  # effect now [CV unit]
    position: Float[Array, " mv"]  # where the actuators stand [MV unit]
    measured: Float[Array, " dv"]  # disturbances of the model during the last sample [DV unit]


class ModelPlant(JaxPlant):
    """A plant that answers as a step-response model does, sampled as the model is.

    Its disturbances are those of the model, then one load ``output.CV`` per CV that is added to it [CV unit]; all are 0 at
    the working point. Its parameters make it differ from the model: ``gain.CV.MV`` [1] multiplies a response,
    ``dead_time.CV.MV`` [s] is added to it (negative: taken away, as far as the response has some), ``time_scale.CV.MV``
    [1] stretches it; disturbances of the model count as MVs here. ``gain``, ``dead_time`` and ``time_scale`` do so for all
    pairs, on top of what holds for one.

    Args:
        model: of the process.
        actuators: one per MV; continuous ones without limits if not given.
        start: CVs and MVs by name at which it starts, where not at the working point of the model, or else 0.

    Raises:
        InputError: for other names, values that are not finite, or another number of actuators.
    """

    nominal: Float[np.ndarray, "cv input n"]  # responses of the model [CV unit per input unit]
    coefficients: Float[np.ndarray, "cv input register"]  # responses of the plant
    # gain, dead time [s] and time scale of all pairs, and of each
    common: Float[np.ndarray, "3"]
    pairs: Float[np.ndarray, "3 cv input"]
    start_cv: Float[np.ndarray, " cv"]
    start_mv: Float[np.ndarray, " mv"]
    dt: float = eqx.field(static=True)
    cv_names: tuple[str, ...] = eqx.field(static=True)
    mv_names: tuple[str, ...] = eqx.field(static=True)
    signals: Signals = eqx.field(static=True)
    dv_names: tuple[str, ...] = eqx.field(static=True)
    actuators: Actuators = eqx.field(static=True)

    def __init__(
        self,
        model: StepResponseModel,
        actuators: Sequence[Actuator] = (),
        start: Mapping[str, float] | None = None,
    ):
        self.dt, self.cv_names, self.mv_names = model.dt, model.cv_names, model.mv_names
        self.dv_names = model.dv_names
        tables = model.coefficients, model.dv_coefficients
        self.nominal = self.coefficients = np.concatenate([np.asarray(table) for table in tables], axis=1)
        loads = model.cv_units or ("",) * len(model.cv_names)
        units = (*(model.dv_units or ("",) * len(model.dv_names)), *loads)
        self.signals = Signals(model.cv_names, model.mv_names, model.cv_units, model.mv_units, units)
        self.common = np.array([knob.default for knob in KNOBS])
        self.pairs = np.tile(self.common[:, None, None], self.nominal.shape[:2])
        self.actuators = Actuators.of(actuators, len(self.mv_names))
        names = (*self.cv_names, *self.mv_names)
        for name, value in (start or {}).items():
            among(f"plant.start.{name}", name, names, "one of", value)
            if not is_number(value):
                unit = _units(model).get(name) or ("CV unit" if name in self.cv_names else "MV unit")
                raise InputError(f"plant.start.{name}", value, f"a finite number [{unit}]")
        there = dict(model.working_point) | dict(start or {})
        self.start_cv, self.start_mv = (
            np.array([float(there.get(name, 0.0)) for name in own]) for own in (self.cv_names, self.mv_names)
        )

    @property
    def disturbance_names(self) -> tuple[str, ...]:
        """Those of the model, then the loads of the CVs."""
        return (*self.dv_names, *(f"output.{name}" for name in self.cv_names))

    @property
    def parameter_table(self) -> tuple[Parameter, ...]:
        """Of all pairs, then of each."""
        return (*KNOBS, *(parameter for parameter, _ in self._own()))

    def _own(self) -> list[tuple[Parameter, tuple[int, int, int]]]:
        """Parameters of single pairs, and their places in `pairs`."""
        inputs = (*self.mv_names, *self.dv_names)
        return [
            (Parameter(f"{knob.name}.{cv}.{of}", *_common(knob, cv, of), positive=knob.positive), (k, i, j))
            for k, knob in enumerate(KNOBS)
            for i, cv in enumerate(self.cv_names)
            for j, of in enumerate(inputs)
        ]

    def replaced(self, values: Mapping[str, ArrayLike]) -> Self:
        """The plant with another mismatch; ``"lane"`` arrays give its coefficients a leading lane axis.

        Responses that become longer than the model has coefficients get more of them.

        Raises:
            InputError: as `JaxPlant.replaced`, and for a dead time that a response does not have.
        """
        found = checked_parameters(self.parameter_table, values)
        lanes = next((value.shape for value in found.values() if value.ndim), ())
        everywhere = {knob.name: k for k, knob in enumerate(KNOBS)}
        places = {parameter.name: place for parameter, place in self._own()}
        common = np.array(np.broadcast_to(self.common, (*lanes, 3) if lanes else self.common.shape))
        pairs = np.array(
            np.broadcast_to(self.pairs, (*lanes, *self.pairs.shape[-3:]) if lanes else self.pairs.shape)
        )
        for name, value in found.items():
            if name in everywhere:
                common[..., everywhere[name]] = value
            else:
                pairs[(..., *places[name])] = value
        of_all = np.moveaxis(common, -1, 0)[..., None, None]
        of_each = np.moveaxis(pairs, -3, 0)
        gain, scale = (of_all[k] * of_each[k] for k in (0, 2))
        dead = of_all[1] + of_each[1]
        self._check_dead_times(dead, scale)
        coefficients = warped(self.nominal, gain, dead / self.dt, scale)
        where = lambda p: (p.common, p.pairs, p.coefficients)  # noqa: E731
        return eqx.tree_at(where, self, (common, pairs, coefficients))

    def _check_dead_times(self, added: np.ndarray, scale: np.ndarray) -> None:
        """Refuse to take away more seconds ``"... cv input"`` than a stretched response has."""
        size = np.abs(self.nominal)
        silent = np.cumsum(size > NOTHING * size.max(axis=-1, keepdims=True), axis=-1) == 0
        least = -np.where(silent.all(axis=-1), np.inf, silent.sum(axis=-1) * self.dt) * scale
        wrong = np.argwhere(added < least - 1e-9 * self.dt)
        if len(wrong):
            *_, i, j = where = tuple(int(k) for k in wrong[0])
            name = f"plant.dead_time.{self.cv_names[i]}.{(*self.mv_names, *self.dv_names)[j]}"
            expected = f"{least[where] + 0.0:g} s or more, as the response has no more dead time"
            raise InputError(name, float(added[where]), expected)

    def init(self) -> ModelState:
        """At rest where it starts."""
        cvs, inputs, register = np.shape(self.coefficients)
        zeros = jnp.zeros((cvs, register))
        start = jnp.asarray(self.start_mv)
        return ModelState(zeros, jnp.zeros(cvs), start, jnp.zeros(inputs - len(self.mv_names)))

    def step(
        self, state: ModelState, mv: Float[Array, " mv"], disturbance: ArrayLike = 0.0
    ) -> tuple[ModelState, Outputs]:
        """One sample, see `JaxPlant.step`."""
        given = jnp.broadcast_to(jnp.asarray(disturbance, dtype=jnp.float64), (len(self.disturbance_names),))
        measured, load = given[: len(self.dv_names)], given[len(self.dv_names) :]
        position = self.actuators.move(state.position, jnp.asarray(mv, dtype=jnp.float64))
        change = jnp.concatenate([position - state.position, measured - state.measured])
        # (2.29) as one pass over the register: a matrix product would rearrange the coefficients at every sample
        after = state.future + (self.coefficients * change[:, None]).sum(axis=1)
        state = ModelState(shift_free_response(after), after[:, 0], position, measured)
        outputs = self.measure(state)
        return state, outputs._replace(cv=outputs.cv + load)

    def measure(self, state: ModelState) -> Outputs:
        """What it measures in `state`, without loads."""
        return Outputs(self.start_cv + state.deviation, state.position)


def warped(
    responses: Float[np.ndarray, "cv input n"],
    gain: Float[np.ndarray, "*lane cv input"],
    delay: Float[np.ndarray, "*lane cv input"],
    scale: Float[np.ndarray, "*lane cv input"],
) -> Float[np.ndarray, "*lane cv input register"]:
    """Responses with other gains, more delay [samples] and stretched time: gain S((k - delay) / scale) at k = 1, 2, ....

    Linear from sample to sample, with S = 0 up to the step; the last value is held. As many samples as it takes to reach
    that everywhere, in quarters of n, so that few lengths have to be compiled.
    """
    n = responses.shape[-1]
    quarter = -(-n // 4)
    needed = float(np.max(n * scale + delay))
    if needed > LONGEST:
        expected = f"responses of {LONGEST} samples at most"
        raise InputError("plant.time_scale", f"{needed:.0f} samples", expected)
    extra = max(int(np.ceil((needed - n) / quarter - 1e-9)), 0)
    at = (np.arange(1, n + extra * quarter + 1) - delay[..., None]) / scale[..., None]
    at = np.clip(at, 0.0, n)
    below = np.minimum(at.astype(int), n - 1)
    known = np.concatenate([np.zeros((*responses.shape[:-1], 1)), responses], axis=-1)
    known = np.broadcast_to(known, (*at.shape[:-1], n + 1))
    low, high = (np.take_along_axis(known, below + k, axis=-1) for k in (0, 1))
    share = at - below
    # exact at the samples, so that no mismatch is the model itself
    return gain[..., None] * ((1.0 - share) * low + share * high)


def _common(knob: Parameter, cv: str, of: str) -> tuple[str, float, str]:
    """Unit, default and label of a pair's parameter."""
    return knob.unit, knob.default, f"{knob.label} from {of} to {cv}"


def _units(model: StepResponseModel) -> dict[str, Any]:
    names, units = (*model.cv_names, *model.mv_names), (*model.cv_units, *model.mv_units)
    return dict(zip(names, units, strict=True)) if len(units) == len(names) else {}
