"""Step-response models (thesis 2.3.4, chapter 4): the model type, its file, and its prediction.

Identification writes these models, the controller predicts with them. A prediction is split, as in (2.30),
into the *free response* (what past moves will still do) and the forced response of future moves. The free
response is kept in a shift register of `prediction_horizon` future values, the way dynamic matrix control
does it, so that a sample costs O(N) and not O(N^2).
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxmpc import html
from jaxmpc.check import LARGEST, check_keys, is_number, sound
from jaxmpc.errors import InputError
from jaxmpc.files import read_json, write_atomically

FORMAT = "jaxmpc/step-response/1"
HALF_CHARACTER = re.compile("[\ud800-\udfff]")  # JSON can escape one, UTF-8 cannot encode it


class StepResponseModel(eqx.Module):
    """Unit-step responses of every CV to every MV and measured disturbance (DV), (4.2)-(4.3).

    Attributes:
        coefficients: ``"cv mv n"``, S(1)..S(N): CV change [CV unit per MV unit] at 1..N samples after a unit
            step. The last value holds for ever: S(N+1) = S(N).
        dt: sampling interval [s].
        cv_names, mv_names: names in the order of the arrays.
        cv_units, mv_units: engineering units in the same order.
        working_point: ``(("valve", 50.0), ...)``: MV values (and settled CV values) the steps started from.
        provenance: further facts, for example plant hash, dates, whether a response had settled.
        dv_coefficients: ``"cv dv n"``, as `coefficients`, of the DVs [CV unit per DV unit]; of none if not given.
        dv_names, dv_units: of the DVs.
    """

    coefficients: Float[Array, "cv mv n"]
    dt: float = eqx.field(static=True)
    cv_names: tuple[str, ...] = eqx.field(static=True)
    mv_names: tuple[str, ...] = eqx.field(static=True)
    cv_units: tuple[str, ...] = eqx.field(static=True, default=())
    mv_units: tuple[str, ...] = eqx.field(static=True, default=())
    working_point: tuple[tuple[str, float], ...] = eqx.field(static=True, default=())
    provenance: tuple[tuple[str, Any], ...] = eqx.field(static=True, default=())
    dv_coefficients: Float[Array, "cv dv n"] = None  # pyright: ignore[reportAssignmentType]
    dv_names: tuple[str, ...] = eqx.field(static=True, default=())
    dv_units: tuple[str, ...] = eqx.field(static=True, default=())

    def __post_init__(self):
        if self.dv_coefficients is None:
            cvs, _, samples = self.coefficients.shape
            self.dv_coefficients = np.zeros((cvs, 0, samples))  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def samples(self) -> int:
        """N, the number of step-response coefficients."""
        return self.coefficients.shape[-1]

    @property
    def responses(self) -> Float[np.ndarray, "cv input n"]:
        """Coefficients of the MVs, then of the DVs, on the host [CV unit per input unit]."""
        return np.concatenate([np.asarray(self.coefficients), np.asarray(self.dv_coefficients)], axis=1)

    @property
    def input_names(self) -> tuple[str, ...]:
        """Of the MVs, then of the DVs."""
        return (*self.mv_names, *self.dv_names)

    @property
    def units(self) -> dict[str, str]:
        """By the names of CVs, MVs and DVs; 1 where the model names none."""
        own = (self.cv_names, self.cv_units), (self.mv_names, self.mv_units), (self.dv_names, self.dv_units)
        return {
            name: unit
            for names, units in own
            for name, unit in zip(names, units or ("1",) * len(names), strict=True)
        }

    def extended(self, samples: int) -> Float[Array, "cv mv samples"]:
        """S(1)..S(samples), cut or continued with its last value (the process is stable, thesis 2.3.4)."""
        return _extended(self.coefficients, samples)

    def extended_dvs(self, samples: int) -> Float[Array, "cv dv samples"]:
        """As `extended`, of the DVs."""
        return _extended(self.dv_coefficients, samples)

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html.step_response(self)

    def save(self, path: str | Path) -> Path:
        """Write the model as JSON; the file is replaced in one go, so a crash leaves the old one."""
        return write_atomically(path, json.dumps(self.to_dict(), indent=1))

    def to_dict(self) -> dict[str, Any]:
        """The content of the file, which `from_dict` reads again."""
        dvs = {"dv": list(self.dv_names), "dv_units": list(self.dv_units)}
        dvs |= {"dv_coefficients": np.asarray(self.dv_coefficients).tolist()}
        return {
            "format": FORMAT,
            "dt": self.dt,
            "cv": list(self.cv_names),
            "mv": list(self.mv_names),
            "cv_units": list(self.cv_units),
            "mv_units": list(self.mv_units),
            "working_point": dict(self.working_point),
            "provenance": dict(self.provenance),
            "coefficients": np.asarray(self.coefficients).tolist(),
            **(dvs if self.dv_names else {}),
        }

    @classmethod
    def load(cls, path: str | Path) -> StepResponseModel:
        """Read a model written by `save`. Raises `InputError` naming the field that is wrong."""
        return cls.from_dict(read_json("model file", path))

    @classmethod
    def from_dict(cls, body: Any) -> StepResponseModel:
        """The model of a file's content. Raises `InputError` naming the field that is wrong."""
        if not isinstance(body, dict):
            raise InputError("model", type(body).__name__, "an object with dt, cv, mv and coefficients")
        check_keys("model", body, ("dt", "cv", "mv", "coefficients"))
        return make_model(
            body["coefficients"],
            body["dt"],
            body["cv"],
            body["mv"],
            cv_units=body.get("cv_units", ()),
            mv_units=body.get("mv_units", ()),
            working_point=body.get("working_point", {}),
            provenance=body.get("provenance", {}),
            dv_coefficients=body.get("dv_coefficients", ()),
            dv_names=body.get("dv", ()),
            dv_units=body.get("dv_units", ()),
        )


def _extended(coefficients: Any, samples: int) -> Any:
    """Step responses cut or continued with their last value."""
    index = np.minimum(np.arange(samples), coefficients.shape[-1] - 1)
    if isinstance(coefficients, Tracer):
        return coefficients[..., index]
    # on the host, where a model of another length needs no program of its own
    return jnp.asarray(np.asarray(coefficients)[..., index])


def make_model(
    coefficients,
    dt: float,
    cv_names,
    mv_names,
    *,
    cv_units=(),
    mv_units=(),
    working_point=(),
    provenance=(),
    dv_coefficients=(),
    dv_names=(),
    dv_units=(),
    path: str = "model",
) -> StepResponseModel:
    """Checked constructor of a `StepResponseModel` from nested lists or arrays.

    Args:
        coefficients: ``"cv mv n"`` [CV unit per MV unit], finite.
        dt: sampling interval [s], positive.
        cv_names: names of the CVs, distinct.
        mv_names: names of the MVs, distinct.
        cv_units: units of the CVs, or empty.
        mv_units: units of the MVs, or empty.
        working_point: mapping or pairs of name and value.
        provenance: mapping or pairs of name and JSON value.
        dv_coefficients: ``"cv dv n"`` [CV unit per DV unit], as many samples as `coefficients`; empty without DVs.
        dv_names: names of the DVs, distinct, none that of an MV.
        dv_units: units of the DVs, or empty.
        path: prefix of the field names in errors.

    Raises:
        InputError: naming the field, for wrong shapes, non-finite values or repeated names.
    """
    cv_names, mv_names, dv_names = tuple(cv_names), tuple(mv_names), tuple(dv_names)
    for key, names, least in (("cv", cv_names, 1), ("mv", mv_names, 1), ("dv", dv_names, 0)):
        distinct = len(set(names)) == len(names) and all(isinstance(n, str) and n for n in names)
        if len(names) < least or not distinct:
            expected = "one or more distinct, non-empty names" if least else "distinct, non-empty names"
            raise InputError(f"{path}.{key}", list(names), expected)
        if any(HALF_CHARACTER.search(name) for name in names):
            raise InputError(f"{path}.{key}", list(names), "names of whole characters, which a file can hold")
    both = sorted(set(mv_names) & set(dv_names))
    if both:
        raise InputError(f"{path}.dv", both[0], "a name that no MV has")
    if not is_number(dt) or dt <= 0:
        raise InputError(f"{path}.dt", dt, "a positive sampling interval [s]")
    array = _checked_responses(f"{path}.coefficients", coefficients, len(cv_names), len(mv_names), "mv")
    given = (
        dv_coefficients
        if dv_names or np.size(dv_coefficients)
        else np.zeros((len(cv_names), 0, array.shape[2]))
    )
    of_dvs = _checked_responses(
        f"{path}.dv_coefficients", given, len(cv_names), len(dv_names), "dv", array.shape[2]
    )
    for key, units, names in (
        ("cv_units", cv_units, cv_names),
        ("mv_units", mv_units, mv_names),
        ("dv_units", dv_units, dv_names),
    ):
        if units and len(units) != len(names):
            raise InputError(f"{path}.{key}", list(units), f"{len(names)} units, one per name")
    pairs = lambda x: tuple(x.items() if isinstance(x, dict) else x)  # noqa: E731
    return StepResponseModel(
        coefficients=jnp.asarray(array),
        dt=float(dt),
        cv_names=cv_names,
        mv_names=mv_names,
        cv_units=tuple(cv_units),
        mv_units=tuple(mv_units),
        working_point=tuple((str(k), float(v)) for k, v in pairs(working_point)),
        provenance=tuple((str(k), _frozen(v)) for k, v in pairs(provenance)),
        dv_coefficients=jnp.asarray(of_dvs) if dv_names else None,  # pyright: ignore[reportArgumentType]
        dv_names=dv_names,
        dv_units=tuple(dv_units),
    )


def _frozen(value: Any) -> Any:
    """A JSON value that can be hashed, as the facts of a compiled program are: lists as tuples, objects as pairs."""
    if isinstance(value, dict):
        return tuple((key, _frozen(one)) for key, one in value.items())
    return tuple(map(_frozen, value)) if isinstance(value, list | tuple) else value


def _checked_responses(path: str, given: Any, cvs: int, inputs: int, kind: str, samples: int | None = None):
    """Step-response coefficients of some MVs or DVs as an array, of so many samples if that is known."""
    try:
        array = np.array(given, dtype=np.float64)
    except (ValueError, TypeError):
        array = np.array([])
    if samples is None:
        expected = f"[cv][{kind}][n] = [{cvs}][{inputs}][N >= 1] numbers of equal length N"
    else:
        expected = f"[cv][{kind}][n] = [{cvs}][{inputs}][{samples}] numbers, as many samples as the MVs have"
    long = array.ndim == 3 and (array.shape[2] >= 1 if samples is None else array.shape[2] == samples)
    if not long or array.shape[:2] != (cvs, inputs):
        raise InputError(path, f"shape {list(array.shape)}", expected)
    if not sound(array).all():
        where = tuple(int(i) for i in np.argwhere(~sound(array))[0])
        expected = f"a finite number of size {LARGEST:g} at most [CV unit per {kind.upper()} unit]"
        raise InputError(f"{path}{list(where)}", float(array[where]), expected)
    return array


def advance_free_response(
    free: Float[Array, "cv horizon"], coefficients: Float[Array, "cv mv horizon"], move: Float[Array, " mv"]
) -> Float[Array, "cv horizon"]:
    """Free response one sample later: add the effect of the applied move and shift.

    Args:
        free: deviation of the CVs at k+1..k+Hp caused by moves before k [CV unit].
        coefficients: S(1)..S(Hp) [CV unit per MV unit].
        move: the move applied at k [MV unit].

    Returns:
        ``(after)``: deviation at k+1..k+Hp caused by moves up to and including k. Its first column is the
        prediction of the next measurement; `shift_free_response` moves on to the next sample.
    """
    return free + jnp.einsum("cmn,m->cn", coefficients, move)


def shift_free_response(free: Float[Array, "cv horizon"]) -> Float[Array, "cv horizon"]:
    """The free response seen from the next sample; the last value is repeated, S(N+1) = S(N)."""
    return jnp.concatenate([free[:, 1:], free[:, -1:]], axis=1)


def future_response(
    coefficients: Float[Array, "cv dv horizon"], change: Float[Array, "horizon dv"]
) -> Float[Array, "cv horizon"]:
    """What changes that are still to come do to the CVs at k+1..k+Hp.

    Args:
        coefficients: S(1)..S(Hp) [CV unit per DV unit].
        change: at k, k+1, ... [DV unit]; one at k+j acts on the samples after it.
    """
    horizon = coefficients.shape[-1]
    age = np.arange(horizon)[:, None] - np.arange(horizon)  # of the change at k+j at sample k+i+1, less 1
    step = jnp.where(age >= 0, coefficients[..., np.maximum(age, 0)], 0.0)
    return jnp.einsum("cdij,jd->ci", step, change)
