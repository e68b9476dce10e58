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
from jaxmpc.problem.structure import LARGEST, Structure


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
        measurement_low, measurement_high: a measurement outside is left out, as one that is not a number is [CV unit].
        frozen_limit: samples in a row without any change after which a measurement is left out; infinite for never.
        bad_limit: measurements left out in a row after which the CV is switched off; infinite for never.
        bias_decay: time constant with which the bias of a CV fades while its measurements are left out [s]; infinite
            keeps it.
        demand_lead: how far a demand may be from where its actuator stands, where that is told [MV unit]; 0 starts every
            move from there, a step choke that is asked in small moves needs a step.
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
    measurement_low: Float[Array, " cv"]
    measurement_high: Float[Array, " cv"]
    frozen_limit: Float[Array, " cv"]
    bad_limit: Float[Array, " cv"]
    bias_decay: Float[Array, " cv"]
    demand_lead: Float[Array, " mv"]

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html.tuning(self, UNITS | {"bias_cutoff": "rad/s"}, DEFAULTS)


CV_FIELDS = (
    "cv_weight",
    "soft_quadratic",
    "soft_linear",
    "deadzone",
    "cv_low",
    "cv_high",
    "slack_weight",
    "measurement_low",
    "measurement_high",
    "frozen_limit",
    "bad_limit",
    "bias_decay",
)
MV_FIELDS = ("move_weight", "mv_low", "mv_high", "move_low", "move_high", "mean_move_limit", "demand_lead")
LIMIT_PAIRS = (
    ("cv_low", "cv_high"),
    ("mv_low", "mv_high"),
    ("move_low", "move_high"),
    ("measurement_low", "measurement_high"),
)
# the least value where a field that may be infinite has one
LEAST = {"mean_move_limit": 0.0, "demand_lead": 0.0, "frozen_limit": 1.0, "bad_limit": 1.0, "bias_decay": 0.0}
LIMITS = (*(field for pair in LIMIT_PAIRS for field in pair), *LEAST)
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
    "measurement_low": "CV unit",
    "measurement_high": "CV unit",
    "frozen_limit": "samples",
    "bad_limit": "samples",
    "bias_decay": "s",
    "demand_lead": "MV unit",
}
DEFAULTS = {
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
    "measurement_low": -np.inf,
    "measurement_high": np.inf,
    "frozen_limit": np.inf,
    "bad_limit": np.inf,
    "bias_decay": np.inf,
    "demand_lead": 0.0,
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
            given = fields.get(key, DEFAULTS.get(key))
            if given is None and key not in LIMITS:
                raise InputError(
                    f"{path}.{key}", None, f"{len(names)} numbers [{UNITS[key]}] for {', '.join(names)}"
                )
            values[key] = _vector(f"{path}.{key}", given, names, key)
    for low, high in LIMIT_PAIRS:
        names = structure.cv_names if low in CV_FIELDS else structure.mv_names
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
        if key in LEAST and value < LEAST[key]:
            raise InputError(f"{path}[{i}]", value, f"{LEAST[key]:g} or more [{UNITS[key]}] for {names[i]}")
        if LARGEST < abs(value) < np.inf:
            more = ", or none for no limit" if key in LIMITS else ""
            expected = f"a number of size {LARGEST:g} at most{more} [{UNITS[key]}] for {names[i]}"
            raise InputError(f"{path}[{i}]", value, expected)
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
