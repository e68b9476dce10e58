"""Steady-state step coefficients over the range of an MV: thesis 4.1.1, figures 10 and 11.

For each value of a second MV, the gain of a step of the first from each of its values to the next, computed from steady
states. A plant in JAX solves them in batches; any other settles one after the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from identify.working_point import Values, check_mv, point_of, signals_of, units_of
from jaxmpc.check import as_floats
from jaxmpc.errors import InputError
from jaxmpc.process.plant import JaxPlant, Signals
from jaxmpc.programs.lanes import in_pieces

POINTS = 50  # of one call, so that all grids are solved by one program


class SteadySweep(NamedTuple):
    """Steady states and step coefficients over two MVs, the first and the second of the grid.

    Attributes:
        grid: by the name of each MV, its values [MV unit].
        cv: ``"cv second first"``, steady CVs [CV unit].
        coefficient: ``"cv second first-1"``, change of the steady CV from each value of the first MV to the next
            [CV unit per MV unit]; entry i belongs to a step from its value i.
        converged: ``"second first"``, whether the steady state was found.
        signals: names and units of the plant.
    """

    grid: dict[str, Float[np.ndarray, " value"]]
    cv: Float[np.ndarray, "cv second first"]
    coefficient: Float[np.ndarray, "cv second step"]
    converged: Bool[np.ndarray, "second first"]
    signals: Signals


@jax.jit
def _some_steady(plant, mv):
    found = jax.vmap(plant.steady)(mv)
    return found.outputs.cv, found.converged


def steady_sweep(
    plant: Any,
    grid: Mapping[str, ArrayLike],
    *,
    working_point: Values | None = None,
    signals: Signals | None = None,
) -> SteadySweep:
    """Steady states over a grid of two MVs, and the step coefficients between neighbouring values of the first.

    Args:
        plant: one that finds its steady states: a `JaxPlant` or a stateful one with a method ``steady(mv)``.
        grid: by MV name the values of two MVs [MV unit]: those of the first increase, two or more.
        working_point: where the other MVs stand [MV unit]; as the plant has them by default.
        signals: names and units; the plant's own by default.

    Raises:
        InputError: for a plant without `steady`, an unknown MV, or values outside their range or that do not increase.
    """
    signals = signals_of(plant, signals)
    names = signals.mv_names
    if not hasattr(plant, "steady"):
        raise InputError(
            "plant", type(plant).__name__, "a plant that finds its steady states (a method `steady`)"
        )
    if not isinstance(grid, Mapping) or len(grid) != 2 or not {*grid} <= {*names}:
        raise InputError("grid", grid, f"the values of two of the MVs {', '.join(names)}")
    found = {n: np.atleast_1d(as_floats(f"grid.{n}", v, "numbers [MV unit]")) for n, v in grid.items()}
    first, second = found.values()
    point = point_of(plant, signals, working_point)
    check_mv(plant, [found.get(name, value) for name, value in zip(names, point, strict=True)])
    for (name, values), least in zip(found.items(), (2, 1), strict=True):
        expected = f"{'two or more increasing' if least == 2 else 'one or more finite'} values"
        wrong = values.ndim != 1 or len(values) < least or not np.isfinite(values).all()
        if wrong or (least == 2 and (np.diff(values) <= 0).any()):
            unit = units_of(signals)[names.index(name)]
            raise InputError(f"grid.{name}", values.tolist(), f"{expected} [{unit}]")
    mv = np.tile(point, (len(second), len(first), 1))
    along, across = (names.index(name) for name in found)
    mv[..., along], mv[..., across] = first, second[:, None]
    mv = mv.reshape(-1, len(names))
    if isinstance(plant, JaxPlant):
        cv, converged = in_pieces(lambda some: _some_steady(plant, some), POINTS, mv)
    else:
        settled = [plant.steady(one) for one in mv]
        cv, converged = (
            np.array(part) for part in zip(*((s.outputs.cv, s.converged) for s in settled), strict=True)
        )
    shape = len(second), len(first)
    cv = np.moveaxis(np.asarray(cv).reshape(*shape, -1), -1, 0)
    return SteadySweep(found, cv, np.diff(cv, axis=-1) / np.diff(first), converged.reshape(shape), signals)
