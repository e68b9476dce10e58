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
    """Unit-step responses of every CV to every MV, (4.2)-(4.3).

    Attributes:
        coefficients: ``"cv mv n"``, S(1)..S(N): CV change [CV unit per MV unit] at 1..N samples after a unit
            step. The last value holds for ever: S(N+1) = S(N).
        dt: sampling interval [s].
        cv_names, mv_names: names in the order of the arrays.
        cv_units, mv_units: engineering units in the same order.
        working_point: ``(("valve", 50.0), ...)``: MV values (and settled CV values) the steps started from.
        provenance: further facts, for example plant hash, dates, whether a response had settled.
    """

    coefficients: Float[Array, "cv mv n"]
    dt: float = eqx.field(static=True)
    cv_names: tuple[str, ...] = eqx.field(static=True)
    mv_names: tuple[str, ...] = eqx.field(static=True)
    cv_units: tuple[str, ...] = eqx.field(static=True, default=())
    mv_units: tuple[str, ...] = eqx.field(static=True, default=())
    working_point: tuple[tuple[str, float], ...] = eqx.field(static=True, default=())
    provenance: tuple[tuple[str, Any], ...] = eqx.field(static=True, default=())

    @property
    def samples(self) -> int:
        """N, the number of step-response coefficients."""
        return self.coefficients.shape[-1]

    def extended(self, samples: int) -> Float[Array, "cv mv samples"]:
        """S(1)..S(samples), cut or continued with its last value (the process is stable, thesis 2.3.4)."""
        index = np.minimum(np.arange(samples), self.samples - 1)
        if isinstance(self.coefficients, Tracer):
            return self.coefficients[..., index]
        # on the host, where a model of another length needs no program of its own
        return jnp.asarray(np.asarray(self.coefficients)[..., index])

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html.step_response(self)

    def save(self, path: str | Path) -> Path:
        """Write the model as JSON; the file is replaced in one go, so a crash leaves the old one."""
        return write_atomically(path, json.dumps(self.to_dict(), indent=1))

    def to_dict(self) -> dict[str, Any]:
        """The content of the file, which `from_dict` reads again."""
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
        )


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
        path: prefix of the field names in errors.

    Raises:
        InputError: naming the field, for wrong shapes, non-finite values or repeated names.
    """
    cv_names, mv_names = tuple(cv_names), tuple(mv_names)
    for key, names in (("cv", cv_names), ("mv", mv_names)):
        if not names or len(set(names)) != len(names) or not all(isinstance(n, str) and n for n in names):
            raise InputError(f"{path}.{key}", list(names), "one or more distinct, non-empty names")
        if any(HALF_CHARACTER.search(name) for name in names):
            raise InputError(f"{path}.{key}", list(names), "names of whole characters, which a file can hold")
    if not is_number(dt) or dt <= 0:
        raise InputError(f"{path}.dt", dt, "a positive sampling interval [s]")
    try:
        array = np.array(coefficients, dtype=np.float64)
    except (ValueError, TypeError):
        array = np.array([])
    expected = f"[cv][mv][n] = [{len(cv_names)}][{len(mv_names)}][N >= 1] numbers of equal length N"
    if array.ndim != 3 or array.shape[:2] != (len(cv_names), len(mv_names)) or array.shape[2] < 1:
        raise InputError(f"{path}.coefficients", f"shape {list(array.shape)}", expected)
    if not sound(array).all():
        where = tuple(int(i) for i in np.argwhere(~sound(array))[0])
        expected = f"a finite number of size {LARGEST:g} at most [CV unit per MV unit]"
        raise InputError(f"{path}.coefficients{list(where)}", float(array[where]), expected)
    for key, units, names in (("cv_units", cv_units, cv_names), ("mv_units", mv_units, mv_names)):
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
        provenance=tuple((str(k), v if not isinstance(v, list) else tuple(v)) for k, v in pairs(provenance)),
    )


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
