"""Everything a sweep varies without recompiling: weights, deadzones, limits (thesis table 1, chapters 5 and 6).

A field is declared once, in `Tuning`; see `jaxmpc.problem.declared` for what follows from that.
"""

from __future__ import annotations

from functools import partial
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmpc import html
from jaxmpc.check import LARGEST
from jaxmpc.errors import InputError
from jaxmpc.problem.declared import declare, declared
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.values import has_gaps

_cv, _mv = partial(declare, of="cv"), partial(declare, of="mv")
_cv_limit, _mv_limit = (partial(one, infinite=True, least=-np.inf) for one in (_cv, _mv))
# what a controller uses or remembers between steps
_cv_kept, _mv_kept = (partial(one, infinite=True, in_step=False) for one in (_cv, _mv))


class Tuning(eqx.Module):
    """Arrays only, in engineering units, so that any field can be batched with `jax.vmap`; `make_tuning` checks them."""

    cv_weight: Float[Array, " cv"] = _cv(
        "1/CV unit^2", "weight of the deviation of {}", "squared, at every penalised sample", "Q (6.6)"
    )
    move_weight: Float[Array, " mv"] = _mv(
        "1/MV unit^2", "move weight of {}", "of the squared move, paid at every sample", "P (6.6)"
    )
    soft_quadratic: Float[Array, " cv"] = _cv(
        "1/CV unit^2", "quadratic weight beyond the deadzone of {}", "Soft MPC", "S_η (6.6)", default=0.0
    )
    soft_linear: Float[Array, " cv"] = _cv(
        "1/CV unit", "linear weight beyond the deadzone of {}", "Soft MPC", "s_η (6.6)", default=0.0
    )
    deadzone: Float[Array, " cv"] = _cv(
        "CV unit", "deadzone of {}", "half its width, around the setpoint", "c (6.5)", default=0.0
    )
    cv_low: Float[Array, " cv"] = _cv_limit("CV unit", "low limit of {}", "soft", "(5.1)", high="cv_high")
    cv_high: Float[Array, " cv"] = _cv_limit("CV unit", "high limit of {}", "soft", "(5.1)")
    slack_weight: Float[Array, " cv"] = _cv(
        "1/CV unit",
        "price of limit violation of {}",
        "of the largest in the horizon, one price for both sides",
        "ρ (5.1)",
        default=1000.0,
    )
    mv_low: Float[Array, " mv"] = _mv_limit("MV unit", "low limit of {}", "hard", "(5.1e)", high="mv_high")
    mv_high: Float[Array, " mv"] = _mv_limit("MV unit", "high limit of {}", "hard", "(5.1e)")
    move_low: Float[Array, " mv"] = _mv_limit(
        "MV unit per sample", "largest move down of {}", "negative; hard", "(5.1d)", high="move_high"
    )
    move_high: Float[Array, " mv"] = _mv_limit(
        "MV unit per sample", "largest move up of {}", "hard", "(5.1d)"
    )
    ideal: Float[Array, " mv"] = _mv(
        "MV unit",
        "ideal value of {}",
        "where it rests as far as the CVs leave it free; without meaning while its weight is 0",
        "u_RTO (6.20)",
        default=0.0,
        least=-np.inf,
        optional=True,
    )
    ideal_weight: Float[Array, " mv"] = _mv(
        "1/MV unit^2",
        "weight of the distance of {} from its ideal value",
        "squared, at every penalised sample",
        "(6.20)",
        default=0.0,
        optional=True,
    )
    oscillation_rows: Bool[Array, " mv"] = _mv(
        "", "no reversal from one sample to the next", "of integer MVs", "(6.16)", default=False, flag=True
    )
    bias_cutoff: Float[Array, ""] = declare(
        "rad/s",
        "cut-off of the bias filter",
        "infinite for an unfiltered bias",
        "w_c (6.4)",
        infinite=True,
        least=1 / LARGEST,
        in_step=False,
    )
    mean_move_limit: Float[Array, " mv"] = _mv_kept(
        "MV unit per sample",
        "limit of the mean move of {}",
        "both ways, over the window of the structure",
        "6.6",
    )
    measurement_low: Float[Array, " cv"] = _cv_limit(
        "CV unit",
        "least measurement that counts of {}",
        "one below is left out, as one that is not a number is",
        high="measurement_high",
        in_step=False,
    )
    measurement_high: Float[Array, " cv"] = _cv_limit(
        "CV unit", "largest measurement that counts of {}", "one above is left out", in_step=False
    )
    frozen_limit: Float[Array, " cv"] = _cv_kept(
        "samples", "equal measurements in a row that are too many of {}", "more are left out", least=1.0
    )
    bad_limit: Float[Array, " cv"] = _cv_kept(
        "samples", "bad measurements in a row that switch off {}", "counting those left out", least=1.0
    )
    bias_decay: Float[Array, " cv"] = _cv_kept(
        "s", "time constant of the fading bias of {}", "while measurements are left out; infinite keeps it"
    )
    demand_lead: Float[Array, " mv"] = _mv_kept(
        "MV unit",
        "how far the demand may lead the position of {}",
        "where that is told; 0 starts every move from there, a stepped actuator that is asked in small moves needs a step",
        default=0.0,
    )

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html.fields("Tuning", self, FIELDS)


FIELDS = MappingProxyType(declared(Tuning))
LIMIT_PAIRS = tuple((key, field.high) for key, field in FIELDS.items() if field.high)


def make_tuning(structure: Structure, *, path: str = "tuning", **fields) -> Tuning:
    """Checked constructor of a `Tuning`.

    Args:
        **fields: fields of `Tuning`; vectors in CV or MV order, a mapping from name to value, or one number for all.
            Limits take ``None`` for infinite. `cv_weight` and `move_weight` have no default;
            the others default to "off" (no deadzone, no limits; `slack_weight` 1000).

    Raises:
        InputError: naming the field, for unknown names, wrong lengths, NaN, negative weights, crossed limits or
            oscillation rows on a continuous MV.
    """
    for key in fields:
        if key not in FIELDS:
            raise InputError(f"{path}.{key}", fields[key], f"one of the fields {sorted(FIELDS)}")
    names = {"cv": structure.cv_names, "mv": structure.mv_names, "": ()}
    values = {
        key: field.array(f"{path}.{key}", fields.get(key, field.default), names[field.of])
        for key, field in FIELDS.items()
    }
    for low, high in LIMIT_PAIRS:
        for i, name in enumerate(names[FIELDS[low].of]):
            least, largest, expected = values[low][i], values[high][i], ""
            if least > largest:
                expected = f"at most {high}[{i}] = {largest} for {name} [{FIELDS[low].unit}]"
            elif np.isposinf(least) or np.isneginf(largest):
                expected = f"a limit below +inf (and {high}[{i}] above -inf) for {name}"
            if expected:
                raise InputError(f"{path}.{low}[{i}]", least, expected)
    for mv, (name, watched) in enumerate(zip(structure.mv_names, values["oscillation_rows"], strict=True)):
        listed, expected = structure.integer_values[mv] if structure.integer_values else None, ""
        if watched and structure.steps[mv] is None:
            expected = "false for a continuous MV (the width of the rows is the integer step)"
        if watched and listed is not None and has_gaps(listed):
            expected = "false for an MV with an uneven list of values (the width of the rows is one step)"
        if expected:
            raise InputError(f"{path}.oscillation_rows.{name}", True, expected)
    return Tuning(**{key: jnp.asarray(value) for key, value in values.items()})


def within_values(structure: Structure, tuning: Tuning) -> Tuning:
    """The tuning with MV limits no wider than the lists of allowed values."""
    if not structure.integer_values:
        return tuning
    ends = [(v[0], v[-1]) if v else (-np.inf, np.inf) for v in structure.integer_values]
    low, high = np.array(ends).T
    limits = jnp.maximum(tuning.mv_low, low), jnp.minimum(tuning.mv_high, high)
    return eqx.tree_at(lambda t: (t.mv_low, t.mv_high), tuning, limits)


def by_name(structure: Structure, tuning: Tuning) -> dict[str, Any]:
    """The fields of a tuning as `make_tuning` takes them, mappings by name where there is one value per CV or MV."""
    names, found = {"cv": structure.cv_names, "mv": structure.mv_names}, {}
    for key, field in FIELDS.items():
        values = np.asarray(getattr(tuning, key)).tolist()
        found[key] = dict(zip(names[field.of], values, strict=True)) if field.of else values
    return found


def stack_tunings(tunings) -> Tuning:
    """Batch tunings along a new first axis, for `jax.vmap`."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *tunings)
