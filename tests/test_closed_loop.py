import shutil

import equinox as eqx
import numpy as np
import pytest

from identify.step_test import identify_step_response
from jaxmpc import status
from jaxmpc.closed_loop import simulate, simulate_batch
from jaxmpc.controller import ContinuousController, MixedIntegerController
from jaxmpc.errors import InputError
from jaxmpc.plant import WellPlant
from jaxmpc.reference import Reference
from jaxmpc.tuning import stack_tunings
from studies import presets

TO_30_PERCENT = Reference([0.0, 200.0], [[11013.0, 185.0], [12600.0, 175.0]], 1200.0)


@pytest.fixture(scope="module")
def model():
    return identify_step_response(WellPlant())


def controller_of(kind, model):
    structure = presets.structure(integer=kind is MixedIntegerController)
    return kind(structure, presets.tuning(structure), model)


@pytest.mark.skipif(
    shutil.which("gcc") is None and shutil.which("cc") is None, reason="the FMU needs a C compiler"
)
@pytest.mark.parametrize(
    ("kind", "actuator"),
    [(ContinuousController, "continuous"), (ContinuousController, "step"), (MixedIntegerController, "step")],
)
def test_the_fmu_and_the_jax_well_close_the_same_loop(model, kind, actuator):
    from identify.fmu import FmuPlant

    controller = controller_of(kind, model)
    twin = simulate(controller, WellPlant(actuator=actuator), TO_30_PERCENT)
    with FmuPlant(actuator=actuator) as fmu:
        real = simulate(controller, fmu, TO_30_PERCENT)
    # the plants agree to 1e-9; a continuous solve repeats to about 1e-6 of a move limit
    np.testing.assert_allclose(real.mv, twin.mv, atol=1e-2 if actuator == "continuous" else 0.05)
    if actuator == "step":
        assert np.array_equal(real.mv[:, 0], twin.mv[:, 0])
    assert (real.status == status.OPTIMAL).all()
    assert (twin.status == status.OPTIMAL).all()
    assert not (real.fallback | twin.fallback).any()
    assert np.ptp(real.mv[:, 0]) > 0 or kind is MixedIntegerController
    assert (np.nan_to_num(real.gap, nan=1.0) <= 1e-6).all()


def test_a_loop_starts_in_steady_state_and_follows_the_setpoint(model):
    run = simulate(controller_of(ContinuousController, model), WellPlant(), TO_30_PERCENT)
    # before the change at 200 s there is only the rounding of the setpoints to make up for, 0.2 m3/h of gas
    assert np.abs(run.move[:20]).max() < 0.02
    before = np.abs(run.cv[20] - run.setpoint[20])
    after = np.abs(run.cv[-1] - run.setpoint[-1])
    assert after[0] < 0.8 * before[0]  # gas; oil first moves away, because lift acts before the choke
    np.testing.assert_allclose(
        np.cumsum(run.move, axis=0) + np.array([50.0, 7500.0]), run.mv_demand, atol=1e-9
    )


def test_a_pressure_drop_reaches_the_well_and_lift_answers(model):
    offset = np.where(np.arange(120) >= 30, -3.0, 0.0)
    run = simulate(
        controller_of(MixedIntegerController, model),
        WellPlant(actuator="step"),
        Reference([0.0], [[11013.0, 185.0]], 1200.0),
        disturbance=offset,
    )
    assert run.cv[-1, 1] < 184.0
    assert run.mv[-1, 1] > run.mv[0, 1] + 10.0
    assert np.abs(run.bias[-1, 1]) > 1.0


def test_a_batch_of_loops_is_each_loop_alone(model):
    structure = presets.structure()
    weights = (60.0, 250.0, 1000.0)
    tunings = [
        presets.tuning(structure, changes={"move_weight": {"choke": w, "gas_lift": 0.2}}) for w in weights
    ]
    batch = eqx.filter_vmap(lambda t: ContinuousController(structure, t, model))(stack_tunings(tunings))
    together = simulate_batch(batch, WellPlant(), TO_30_PERCENT, samples=60)
    for tuning, lane in zip(tunings, together, strict=True):
        alone = simulate(
            ContinuousController(structure, tuning, model), WellPlant(), TO_30_PERCENT, samples=60
        )
        np.testing.assert_allclose(lane.mv, alone.mv, atol=1e-2)  # [% and m3/h], as above
    assert not np.allclose(together[0].mv, together[2].mv, atol=0.1)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"samples": 121}, "reference.duration"),
        ({"disturbance": np.zeros(3)}, "disturbance"),
        ({"disturbance": np.full(120, np.nan)}, "disturbance"),
        ({"plant": WellPlant(dt=5.0)}, "plant.dt"),
        ({"reference": Reference([0.0], [[1.0]], 100.0)}, "reference.setpoints"),
    ],
)
def test_a_run_that_does_not_fit_is_refused_before_it_starts(model, change, field):
    arguments = {"plant": WellPlant(), "reference": TO_30_PERCENT} | change
    with pytest.raises(InputError) as error:
        simulate(
            controller_of(ContinuousController, model),
            arguments.pop("plant"),
            arguments.pop("reference"),
            **arguments,
        )
    assert error.value.field == field
