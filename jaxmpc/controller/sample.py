"""What a controller is told at a sample, checked once for all controllers: measurements, setpoints, positions, manual MVs.

A measurement, of a CV or a disturbance, may be bad, that is judged later (`measurement`, `core`); everything else must make
sense. Traced values (inside `jax.jit`, `jax.vmap`, `jax.lax.scan`) are checked for their shapes only.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import ArrayLike

from jaxmpc.errors import InputError
from jaxmpc.problem.structure import Structure


class Sample(NamedTuple):
    """What is known at a sample, the lane axis first where there are lanes."""

    cv: Any  # ``"cv"``, measured; not a number where nothing arrived [CV unit]
    setpoint: Any  # ``"horizon cv"`` over the horizon, or ``"cv"`` held over it [CV unit]
    mv: Any  # ``"mv"``, where the actuators stand; not a number where that is not known [MV unit]
    manual: Any  # ``"mv"``, MVs that somebody else moves
    # ``"row dv"``, measured disturbances now and in the samples to come; not a number where unchanged; None without any
    dv: Any = None  # [DV unit]


def checked(
    structure: Structure,
    cv: ArrayLike,
    setpoint: ArrayLike,
    mv: ArrayLike | None = None,
    manual: ArrayLike | None = None,
    dv: ArrayLike | None = None,
    *,
    dv_names: tuple[str, ...] = (),
    lanes: int | None = None,
) -> Sample:
    """A sample of one controller, or of `lanes` of them with a lane axis first.

    Args:
        dv_names: of the model's measured disturbances.

    Raises:
        InputError: naming the argument, for other shapes, texts, setpoints that are not finite, and where JAX's double
            precision was switched off.
    """
    require_double_precision()
    lead = () if lanes is None else (lanes,)
    cvs, mvs, horizon = (structure.cv_count,), (structure.mv_count,), (structure.prediction_horizon,)
    cv = _array("cv", cv, structure.cv_names, "CV unit", lead + cvs)
    setpoint = _array("setpoint", setpoint, structure.cv_names, "CV unit", lead + cvs, lead + horizon + cvs)
    if not isinstance(setpoint, Tracer) and not np.isfinite(setpoint).all():
        raise InputError(
            "setpoint", _shown(setpoint), f"finite numbers [CV unit] for {_names(structure.cv_names)}"
        )
    mv = (
        np.full(lead + mvs, np.nan)
        if mv is None
        else _array("mv", mv, structure.mv_names, "MV unit", lead + mvs)
    )
    manual = _flags("manual", manual, structure.mv_names, lead)
    return Sample(cv, setpoint, mv, manual, _disturbances(dv, dv_names, lead, horizon))


def _disturbances(given: Any, names: tuple[str, ...], lead: tuple, horizon: tuple) -> Any:
    """Rows of the measured disturbances, one where nothing is told of those to come; None without any."""
    if not names:
        if given is not None and np.size(given):
            raise InputError("dv", _shown(given), "nothing: the model has no measured disturbances")
        return None
    now = (len(names),)
    dv = np.full(lead + now, np.nan) if given is None else given
    dv = _array("dv", dv, names, "DV unit", lead + now, lead + horizon + now)
    return dv[..., None, :] if dv.ndim == len(lead) + 1 else dv


def checked_off(structure: Structure, given: ArrayLike | None, *, lanes: int | None = None) -> np.ndarray:
    """CVs that are switched off, ``"cv"`` or ``"lane cv"``.

    Raises:
        InputError: naming the argument, for another shape, what is not true or false, and traced values: what a program is
            made of is known before it runs.
    """
    off = _flags("cv_off", given, structure.cv_names, () if lanes is None else (lanes,))
    if isinstance(off, Tracer):
        raise InputError(
            "cv_off", "a traced value", f"true or false for each of {_names(structure.cv_names)}"
        )
    return np.asarray(off)


def _flags(path: str, given: Any, names: tuple[str, ...], lead: tuple[int, ...]) -> Any:
    """True or false for each of some names; false if not given."""
    if given is None:
        given = np.zeros((*lead, len(names)), dtype=bool)
    elif not isinstance(given, jax.Array):
        given = np.asarray(given)
    if given.shape != (*lead, len(names)) or given.dtype != np.bool_:
        raise InputError(path, _shown(given), f"true or false for each of {_names(names)}")
    return given


def checked_start(
    structure: Structure,
    cv: ArrayLike,
    mv: ArrayLike,
    dv: ArrayLike | None = None,
    *,
    dv_names: tuple[str, ...] = (),
    lanes: int | None = None,
) -> tuple[Any, Any, Any]:
    """Measured CVs, present MVs and measured disturbances that a controller starts from; all must be known.

    Args:
        dv: zeros if not given; None comes back without any.

    Raises:
        InputError: naming the argument, for other shapes and values that are not finite.
    """
    require_double_precision()
    out, lead = [], () if lanes is None else (lanes,)
    dv = np.zeros((*lead, len(dv_names))) if dv is None else dv
    for path, value, names, unit in (
        ("cv", cv, structure.cv_names, "CV unit"),
        ("mv", mv, structure.mv_names, "MV unit"),
        ("dv", dv, dv_names, "DV unit"),
    ):
        array = _array(path, value, names, unit, (*lead, len(names)))
        if not isinstance(array, Tracer) and not np.isfinite(array).all():
            raise InputError(path, _shown(array), f"{len(names)} finite numbers [{unit}] for {_names(names)}")
        out.append(array)
    return out[0], out[1], out[2] if dv_names else None


def require_double_precision() -> None:
    """Refuse to work where JAX's double precision was switched off after `jaxmpc` was imported: no bound would be right."""
    if jax.dtypes.canonicalize_dtype(np.float64) != np.float64:
        raise InputError(
            "jax_enable_x64",
            False,
            "True, as importing jaxmpc sets it: certificates need double precision",
            "Call jax.config.update('jax_enable_x64', True)",
        )


def _array(path: str, given: Any, names: tuple[str, ...], unit: str, *shapes: tuple[int, ...]) -> Any:
    """An array of floats of one of the shapes; JAX arrays and traced values stay what they are."""
    expected = f"shape {' or '.join(str(list(s)) for s in shapes)}, numbers [{unit}] for {_names(names)}"
    try:
        value = given if isinstance(given, jax.Array) else np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(path, _shown(given), expected) from None
    if value.shape not in shapes:
        raise InputError(path, f"shape {list(value.shape)}", expected)
    return value


def _names(names: tuple[str, ...]) -> str:
    return ", ".join(names)


def _shown(value: Any) -> Any:
    """A value as an error shows it: its shape where it is long."""
    return f"shape {list(np.shape(value))}" if np.size(value) > 8 else np.asarray(value).tolist()
