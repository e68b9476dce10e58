"""Why a deviation stays: what the controller's own weights and model say of it, from stored variables alone."""

from __future__ import annotations

import numpy as np

from studies.kpi.loop import closed_loop_cost
from studies.thesis.claims.record import Run, index
from studies.thesis.well import CHOKE, GAS, LIFT, OIL


def slope(run: Run, deviation: np.ndarray) -> np.ndarray:
    """Derivative of what one sample costs in (6.6) by the CV, ``"cv"``: 2 Q d + sign(d) (2 S eta + s [eta > 0]).

    Here `deviation` is d = y - r, ``"cv"`` [CV unit], eta = max(|d| - c, 0), and the tuning that of the run.
    """
    weight, quadratic, linear, half = (
        run[f"tuning_{name}"].values for name in ("cv_weight", "soft_quadratic", "soft_linear", "deadzone")
    )
    beyond = np.maximum(np.abs(deviation) - half, 0.0)
    return 2 * weight * deviation + np.sign(deviation) * (2 * quadratic * beyond + linear * (beyond > 0))


def pulls(run: Run, deviation: np.ndarray) -> np.ndarray:
    """What another unit of each MV would change of the cost of one settled sample, ``"cv mv"``.

    That is `slope` times the steady gains of the prediction model; where the columns add up to about zero, the MV stands
    at a compromise.
    """
    return slope(run, deviation)[:, None] * run.model_coefficient.values[:, :, -1]


def compromise(run: Run, deviation: np.ndarray) -> str:
    """How oil and gas pull at the lift at some deviation, in words with numbers."""
    pull = pulls(run, deviation)[:, index(run, LIFT)]
    oil, gas = pull[index(run, OIL)], pull[index(run, GAS)]
    balanced = oil * gas < 0 and abs(oil + gas) <= 0.25 * max(abs(oil), abs(gas))
    words = "balance: no lift is better" if balanced else "do not balance"
    return f"the pulls of oil ({oil:+.2g}) and gas ({gas:+.2g}) on the lift, per m3/h of lift and sample, {words}"


def exchange(run: Run) -> str:
    """How little the larger weight of oil is worth, in words with numbers."""
    oil, gas, lift = (index(run, name) for name in (OIL, GAS, LIFT))
    gain, weight = run.model_coefficient.values[:, lift, -1], run.tuning_cv_weight.values
    if not weight[gas] * gain[gas] * gain[oil]:
        return "the lift moves one of the rates only, or only one of them has a weight"
    worth = weight[oil] * gain[oil] / (weight[gas] * gain[gas])
    return (  # where Q_oil d_oil g_oil = Q_gas d_gas g_gas, inside the deadzones
        f"oil weighs {weight[oil] / weight[gas]:.0f} times as much per (m3/h)^2, but by the model the lift moves gas "
        f"{gain[gas] / gain[oil]:.0f} times as far: 1 m3/h of oil off is in balance with "
        f"{worth:.1f} m3/h of gas off"
    )


def price_of_a_step(run: Run, deviation: np.ndarray) -> tuple[float, float]:
    """What one whole step of the choke, made now from rest, would save over the horizon by the model, and what it costs.

    Args:
        run: one controller of the results.
        deviation: y - r of a settled well, ``"cv"`` [CV unit].

    Returns:
        The larger saving of a step up and one down, the lift at rest; negative if neither saves anything. And the move
        weight of the step, in the unit of the objective.
    """
    at = index(run, CHOKE)
    size = float(run.tuning_move_high.values[at])
    lag = np.minimum(np.arange(int(run.prediction_horizon)), run.sizes["lag"] - 1)  # S(N+1) = S(N)
    effect = run.model_coefficient.values[:, at, lag].T
    low, stands, high = (v[at] for v in (run.tuning_mv_low, run.position[-1], run.tuning_mv_high))
    rooms = {size: high - stands, -size: stands - low}
    after = [horizon_cost(run, deviation + step * effect) for step, room in rooms.items() if room >= size]
    saved = horizon_cost(run, deviation + 0.0 * effect) - min(after, default=np.inf)
    return saved, float(run.tuning_move_weight.values[at]) * size**2


def horizon_cost(run: Run, deviation: np.ndarray) -> float:
    """What the deviations of a horizon, ``"horizon cv"`` [CV unit], cost in (6.6), moves and limits left out."""
    names = ("cv_weight", "soft_quadratic", "soft_linear", "deadzone", "move_weight")
    weights = {name: run[f"tuning_{name}"].values for name in names}
    none = np.zeros_like(deviation)
    rest = np.zeros((len(deviation), run.sizes["mv"]))
    return len(deviation) * float(closed_loop_cost(deviation, none, rest, **weights))
