"""What `jaxmpc process check` says of limits over setpoints and of ideal values, and what the controller then does."""

import numpy as np
import pytest

from identify.judge import judge, limit_prices
from identify.plants import model_of
from jaxmpc.controller.plan import solve_plan
from jaxmpc.process.file import process_of

SPAN, LIMIT = 4.0, 1.0  # of the CV with a setpoint; high limit of the other one


def process(**preset):
    """One MV that moves two CVs at once; of the second only a limit counts."""
    responses = [{"cv": cv, "mv": "valve", "gain": gain} for cv, gain in (("flow", 2.0), ("level", 0.5))]
    return process_of(
        {
            "name": "two",
            "dt": 10.0,
            "cv": [{"name": "flow", "span": SPAN}, {"name": "level", "span": 1.0, "high": LIMIT}],
            "mv": [{"name": "valve", "span": 5.0, "low": 0.0, "high": 10.0}],
            "model": {"transfer_functions": responses, "samples": 5},
            "structure": {"prediction_horizon": 20, "control_horizon": 1, "blocks": [1]},
            "presets": {"default": dict(cv_weight={"flow": 0.3, "level": 0.0}, move_weight=1e-6, **preset)},
            "references": {"quick": {"windows": [[0, 0, 0]], "duration": 100.0}},
        }
    )


def finding(subject, **preset):
    given = process(**preset)
    (found,) = [f for f in judge(given, model_of(given)) if f.subject == subject]
    return found


@pytest.mark.parametrize("soft", [{}, dict(soft_linear={"flow": 0.7}, soft_quadratic={"flow": 0.2})])
def test_a_limit_is_kept_from_the_price_on_that_is_said(soft):
    given = process(**soft)
    structure, model = given.structure(), model_of(given)
    gains = np.asarray(model.coefficients)[:, :, -1]
    fixed, by_span = limit_prices(
        structure, given.tuning(structure), gains, np.array([SPAN, 1.0]), np.array([5.0])
    )
    assert np.isfinite(fixed + by_span).all()
    # at the limit the valve is at 2 and the flow at 4, one span below its setpoint
    setpoint = np.tile([2.0 * LIMIT / 0.5 + SPAN, 0.0], (20, 1))
    over = []
    for share in (0.9, 1.1):
        tuning = given.tuning(structure, changes={"slack_weight": share * float(fixed[1] + by_span[1])})
        plan = solve_plan(
            model,
            structure,
            tuning,
            mv_now=[0.0],
            last_move=[0.0],
            free_response=np.zeros((20, 2)),
            setpoint=setpoint,
        )
        over.append(plan.eps_high[1])
    assert over[0] > 0.05 * LIMIT
    assert over[1] == pytest.approx(0.0, abs=1e-6)


def test_a_price_that_is_too_low_is_found_with_the_one_that_is_not():
    """20 samples, twice 0.3 times a span, and four flow units per unit of the level: 192."""
    assert finding("limits of level", slack_weight=150.0).level == "fine"
    found = finding("limits of level", slack_weight=48.0)
    assert found.level == "look"
    assert "192 keeps them" in found.says
    assert "up to 0.25 of them" in found.says


@pytest.mark.parametrize(("ideal", "level"), [(4.0, "fine"), (12.0, "look")])
def test_an_ideal_value_beyond_the_limits_of_its_mv_is_found(ideal, level):
    found = finding("presets.default.ideal.valve", ideal={"valve": ideal}, ideal_weight={"valve": 0.1})
    assert found.level == level
    assert "limits 0 to 10" in found.says
