"""Everything a sweep varies without recompiling: weights, deadzones, limits (thesis table 1, chapters 5 and 6)."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmpc import html
from jaxmpc.errors import InputError
from jaxmpc.structure import Structure


class Tuning(eqx.Module):
    """Arrays only, in engineering units, so that any field can be batched with `jax.vmap`. Limits may be infinite.

    Attributes:
        cv_weight: Q [1/CV unit^2], weight of the squared deviation at every penalised sample.
        move_weight: P [1/MV unit^2], weight of the squared move, paid at every sample.
        soft_quadratic: S [1/CV unit^2], weight of the squared deviation beyond the deadzone (Soft MPC).
        soft_linear: s [1/CV unit], weight of the deviation beyond the deadzone.
        deadzone: c [CV unit], half width of the deadzone around the setpoint.
        cv_low, cv_high: soft CV limits [CV unit].
        slack_weight: rho [1/CV unit], price of the largest violation of a CV limit, one per CV for both sides.
        mv_low, mv_high: hard MV limits [MV unit].
        move_low, move_high: hard limits of the move per sample [MV unit].
        oscillation_rows: whether an integer MV may not reverse from one sample to the next (6.16).
        bias_cutoff: cut-off of the bias filter (6.4) [rad/s]; infinite means an unfiltered bias.
        mean_move_limit: largest mean move per sample over the window of the structure [MV unit], both directions.
    """

    cv_weight: Float[Array, " cv"]
    move_weight: Float[Array, " mv"]
    soft_quadratic: Float[Array, " cv"]
    soft_linear: Float[Array, " cv"]
    deadzone: Float[Array, " cv"]
    cv_low: Float[Array, " cv"]
    cv_high: Float[Array, " cv"]
    slack_weight: Float[Array, " cv"]
    mv_low: Float[Array, " mv"]
    mv_high: Float[Array, " mv"]
    move_low: Float[Array, " mv"]
    move_high: Float[Array, " mv"]
    oscillation_rows: Bool[Array, " mv"]
    bias_cutoff: Float[Array, ""]
    mean_move_limit: Float[Array, " mv"]

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html.tuning(self, UNITS | {"bias_cutoff": "rad/s"}, _DEFAULTS)


CV_FIELDS = (
    "cv_weight",
    "soft_quadratic",
    "soft_linear",
    "deadzone",
    "cv_low",
    "cv_high",
    "slack_weight",
)
MV_FIELDS = ("move_weight", "mv_low", "mv_high", "move_low", "move_high", "mean_move_limit")
LIMITS = ("cv_low", "cv_high", "mv_low", "mv_high", "move_low", "move_high", "mean_move_limit")
UNITS = {
    "cv_weight": "1/CV unit^2",
    "move_weight": "1/MV unit^2",
    "soft_quadratic": "1/CV unit^2",
    "soft_linear": "1/CV unit",
    "slack_weight": "1/CV unit",
    "deadzone": "CV unit",
    "cv_low": "CV unit",
    "cv_high": "CV unit",
    "mv_low": "MV unit",
    "mv_high": "MV unit",
    "move_low": "MV unit per sample",
    "move_high": "MV unit per sample",
    "mean_move_limit": "MV unit per sample",
}
_DEFAULTS = {
    "soft_quadratic": 0.0,
    "soft_linear": 0.0,
    "deadzone": 0.0,
    "cv_low": -np.inf,
    "cv_high": np.inf,
    "slack_weight": 1000.0,
    "mv_low": -np.inf,
    "mv_high": np.inf,
    "move_low": -np.inf,
    "move_high": np.inf,
    "mean_move_limit": np.inf,
    "oscillation_rows": False,
    "bias_cutoff": np.inf,
}


def make_tuning(structure: Structure, *, path: str = "tuning", **fields) -> Tuning:
    """Checked constructor of a `Tuning`.

    Args:
        structure: gives the names and sizes.
        path: prefix of the field names in errors.
        **fields: fields of `Tuning`; vectors in CV or MV order, a mapping from name to value, or one number for all.
            Limits take ``None`` for infinite. `cv_weight` and `move_weight` have no default;
            the others default to "off" (no deadzone, no limits; `slack_weight` 1000).

    Raises:
        InputError: naming the field, for unknown names, wrong lengths, NaN, negative weights, crossed limits or
            oscillation rows on a continuous MV.
    """
    known = {field.name for field in dataclasses.fields(Tuning)}
    for key in fields:
        if key not in known:
            raise InputError(f"{path}.{key}", fields[key], f"one of the fields {sorted(known)}")
    values = {}
    for keys, names in ((CV_FIELDS, structure.cv_names), (MV_FIELDS, structure.mv_names)):
        for key in keys:
            given = fields.get(key, _DEFAULTS.get(key))
            if given is None and key not in LIMITS:
                raise InputError(
                    f"{path}.{key}", None, f"{len(names)} numbers [{UNITS[key]}] for {', '.join(names)}"
                )
            values[key] = _vector(f"{path}.{key}", given, names, key)
    for low, high in (("cv_low", "cv_high"), ("mv_low", "mv_high"), ("move_low", "move_high")):
        names = structure.cv_names if low == "cv_low" else structure.mv_names
        for i, name in enumerate(names):
            if values[low][i] > values[high][i]:
                raise InputError(
                    f"{path}.{low}[{i}]",
                    values[low][i],
                    f"at most {high}[{i}] = {values[high][i]} for {name} [{UNITS[low]}]",
                )
            if np.isposinf(values[low][i]) or np.isneginf(values[high][i]):
                raise InputError(
                    f"{path}.{low}[{i}]",
                    values[low][i],
                    f"a limit below +inf (and {high}[{i}] above -inf) for {name}",
                )
    values["oscillation_rows"] = _flags(f"{path}.oscillation_rows", fields.get("oscillation_rows"), structure)
    cutoff = fields.get("bias_cutoff", np.inf)
    if isinstance(cutoff, bool) or not isinstance(cutoff, (int, float)) or np.isnan(cutoff) or cutoff <= 0:
        raise InputError(f"{path}.bias_cutoff", cutoff, "a positive cut-off [rad/s], infinite for no filter")
    values["bias_cutoff"] = np.float64(cutoff)
    return Tuning(**{key: jnp.asarray(value) for key, value in values.items()})


def _vector(path: str, given, names: tuple[str, ...], key: str) -> np.ndarray:
    """One finite or limit vector of the right length, or an InputError."""
    infinite = -np.inf if key.endswith("_low") else np.inf
    expected = f"{len(names)} numbers [{UNITS[key]}] for {', '.join(names)}"
    if isinstance(given, dict):
        for name in given:
            if name not in names:
                raise InputError(f"{path}.{name}", given[name], f"one of the names {', '.join(names)}")
        missing = [name for name in names if name not in given]
        if missing:
            raise InputError(f"{path}.{missing[0]}", None, expected)
        given = [given[name] for name in names]
    if given is None or isinstance(given, (int, float)):
        given = [given] * len(names)
    given = list(given) if isinstance(given, (list, tuple)) else list(np.asarray(given).tolist())
    if len(given) != len(names):
        raise InputError(path, given, expected)
    out = np.empty(len(names))
    for i, value in enumerate(given):
        if value is None and key in LIMITS:
            value = infinite
        if isinstance(value, bool) or not isinstance(value, (int, float)) or np.isnan(value):
            raise InputError(f"{path}[{i}]", value, f"a number [{UNITS[key]}] for {names[i]}")
        if key not in LIMITS and (value < 0 or np.isinf(value)):
            raise InputError(
                f"{path}[{i}]", value, f"a finite number, 0 or more [{UNITS[key]}] for {names[i]}"
            )
        if key == "mean_move_limit" and value < 0:
            raise InputError(f"{path}[{i}]", value, f"0 or more [{UNITS[key]}] for {names[i]}")
        out[i] = value
    return out


def _flags(path: str, given, structure: Structure) -> np.ndarray:
    """Oscillation rows per MV; only integer MVs can have them, their width is the step."""
    names = structure.mv_names
    if given is None:
        given = {}
    if not isinstance(given, dict):
        listed = list(given) if isinstance(given, (list, tuple)) else list(np.asarray(given).tolist())
        if len(listed) != len(names):
            raise InputError(path, given, f"a mapping from MV name to true or false ({', '.join(names)})")
        given = dict(zip(names, listed, strict=True))
    out = np.zeros(len(names), dtype=bool)
    for name, flag in given.items():
        if name not in names:
            raise InputError(f"{path}.{name}", flag, f"one of the MV names {', '.join(names)}")
        if not isinstance(flag, (bool, np.bool_)):
            raise InputError(f"{path}.{name}", flag, "true or false")
        i = names.index(name)
        if flag and structure.integer_step[i] is None:
            raise InputError(
                f"{path}.{name}",
                flag,
                "false for a continuous MV (the width of the rows is the integer step)",
            )
        out[i] = flag
    return out


def stack_tunings(tunings) -> Tuning:
    """Batch tunings along a new first axis, for `jax.vmap`."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *tunings)
