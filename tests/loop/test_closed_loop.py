import os
import shutil
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from identify.step_test import identify_step_response
from jaxmpc import status
from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.measurement import MISSING, OUTSIDE, SensorFault, fault_errors
from jaxmpc.errors import InputError
from jaxmpc.loop.compiled import _Run
from jaxmpc.loop.noise import noise_samples
from jaxmpc.loop.simulate import simulate, simulate_batch, simulate_batches
from jaxmpc.process.host import HostPlant
from jaxmpc.process.reference import Reference
from jaxmpc.process.well.equations import WellParameters
from jaxmpc.process.well.plant import WellPlant
from jaxmpc.programs.lanes import per_lane
from studies.thesis.well import WELL

TO_30_PERCENT = Reference([0.0, 200.0], [[11013.0, 185.0], [12600.0, 175.0]], 1200.0)


@pytest.fixture(scope="module")
def model():
    return identify_step_response(WellPlant())


def controller_of(kind, model):
    structure = WELL.structure(integer=kind == "mixed-integer")
    return Controller(structure, WELL.tuning(structure), model)


@pytest.mark.skipif(
    shutil.which("gcc") is None and shutil.which("cc") is None, reason="the FMU needs a C compiler"
)
@pytest.mark.parametrize(
    ("kind", "actuator"),
    [
        pytest.param("continuous", "continuous", marks=pytest.mark.slow),
        ("continuous", "step"),
        ("mixed-integer", "step"),
    ],
)
def test_the_fmu_and_the_jax_well_close_the_same_loop(model, kind, actuator):
    from identify.well_fmu import WellFmuPlant

    controller = controller_of(kind, model)
    twin = simulate(controller, WellPlant(actuator=actuator), TO_30_PERCENT)
    with WellFmuPlant(actuator=actuator) as fmu:
        real = simulate(controller, fmu, TO_30_PERCENT)
    # the plants agree to 1e-9; a continuous solve repeats to about 1e-6 of a move limit
    np.testing.assert_allclose(real.mv, twin.mv, atol=1e-2 if actuator == "continuous" else 0.05)
    if actuator == "step":
        assert np.array_equal(real.mv[:, 0], twin.mv[:, 0])
    assert (real.status == status.OPTIMAL).all()
    assert (twin.status == status.OPTIMAL).all()
    assert not (real.fallback | twin.fallback).any()
    assert np.ptp(real.mv[:, 0]) > 0 or kind == "mixed-integer"
    assert (np.nan_to_num(real.gap, nan=1.0) <= 1e-6).all()


def test_a_loop_starts_in_steady_state_and_follows_the_setpoint(model):
    run = simulate(controller_of("continuous", model), WellPlant(), TO_30_PERCENT)
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
        controller_of("mixed-integer", model),
        WellPlant(actuator="step"),
        Reference([0.0], [[11013.0, 185.0]], 1200.0),
        disturbance=offset,
    )
    assert run.cv[-1, 1] < 184.0
    assert run.mv[-1, 1] > run.mv[0, 1] + 10.0
    assert np.abs(run.bias[-1, 1]) > 1.0


WEIGHTS = (60.0, 100.0, 250.0, 600.0, 1000.0)  # of choke moves [1/(%)^2], one per lane
LIMITS = dict(
    rtol=1e-6, atol=1e-6
)  # solves are as exact as their gap; their rounding depends on the batch size


@pytest.fixture(scope="module")
def singles(model):
    structure = WELL.structure()
    tunings = [
        WELL.tuning(structure, changes={"move_weight": {"choke": w, "gas_lift": 0.2}}) for w in WEIGHTS
    ]
    return [Controller(structure, tuning, model) for tuning in tunings]


@pytest.fixture(scope="module")
def lanes(model, singles):
    return Controllers(singles[0].structure, [one.tuning for one in singles], model)


def whole(batches):
    """All pieces of a sweep as one dictionary of arrays."""
    batches = list(batches)
    return {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0].fields}


def test_a_batch_of_loops_is_each_loop_alone(lanes, singles):
    offsets = np.linspace(-2.0, 2.0, 5)[:, None] * np.ones(25)
    references = [
        Reference([0.0, 30.0 * (k + 1)], [[11013.0, 185.0], [12600.0, 175.0]], 250.0) for k in range(5)
    ]
    together = simulate_batch(lanes, WellPlant(), references, disturbance=offsets)
    for k, lane in enumerate(together):
        alone = simulate(singles[k], WellPlant(), references[k], disturbance=offsets[k])
        np.testing.assert_allclose(lane.mv, alone.mv, atol=1e-2)  # [% and m3/h], as above
        np.testing.assert_array_equal(lane.setpoint, alone.setpoint)
        np.testing.assert_array_equal(lane.time, alone.time)
        assert (lane.solve_time > 0).all()
    assert not np.allclose(together[0].mv, together[2].mv, atol=0.1)


@pytest.mark.slow
def test_wells_may_have_lanes_and_controllers_none(singles):
    indices = jnp.asarray([0.95, 1.0, 1.05])
    wells = eqx.filter_vmap(
        lambda share: WellPlant(WellParameters(productivity=share * WellParameters().productivity))
    )(indices)
    together = simulate_batch(singles[2], per_lane(wells), TO_30_PERCENT, samples=5)
    assert len(together) == 3
    alone = simulate(singles[2], per_lane(wells).lane(0), TO_30_PERCENT, samples=5)
    np.testing.assert_allclose(together[0].cv, alone.cv, rtol=1e-6)
    assert together[0].cv[0, 1] < together[1].cv[0, 1] < together[2].cv[0, 1]


def test_neither_pieces_of_lanes_nor_of_samples_nor_padding_change_results(lanes, monkeypatch):
    run = lambda **how: list(  # noqa: E731
        simulate_batches(lanes, WellPlant(), TO_30_PERCENT, samples=25, noise=[40.0, 0.5], **how)
    )
    at_once = whole(run())
    assert at_once["cv"].shape == (5, 25, 2)
    pieces = run(lanes_at_once=2)
    assert [list(piece.lanes) for piece in pieces] == [[0, 1], [2, 3], [4]]
    in_pieces = whole(pieces)  # the third piece was half copies
    stride = _Run.stride
    # of the same program: a table of another length would be another one
    shorter = lambda self, packed, begin, most=9: stride(self, packed, begin, min(most, 9))  # noqa: E731
    monkeypatch.setattr(_Run, "stride", shorter)
    in_time = whole(run())
    for name in at_once:
        if name in ("nodes", "gap", "bound", "solve_time"):
            continue
        np.testing.assert_allclose(in_pieces[name], at_once[name], **LIMITS, err_msg=name)
        np.testing.assert_allclose(in_time[name], at_once[name], **LIMITS, err_msg=name)


def test_noise_is_named_by_its_seed(lanes, singles):
    run = lambda **how: whole(  # noqa: E731
        simulate_batches(lanes, WellPlant(), TO_30_PERCENT, samples=25, **how)
    )["cv"]
    quiet = run()
    one, again, other = (run(noise=[40.0, 0.5], seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    first = one[:, 0] - quiet[:, 0]  # before any move
    assert len(np.unique(first[:, 0])) == 5  # every lane has its own
    assert not np.isin(other[:, 0], one[:, 0]).any()
    paired = run(noise=[40.0, 0.5], seed=np.array([7, 7, 7, 8, 8]))
    np.testing.assert_array_equal(paired[0, 0], paired[1, 0])
    assert (paired[2, 0] != paired[3, 0]).all()
    alone = simulate(singles[3], WellPlant(), TO_30_PERCENT, samples=25, noise=[40.0, 0.5], seed=8)
    np.testing.assert_allclose(alone.cv, paired[3], **LIMITS)
    deviations = np.array([[40.0, 0.5]]) * np.array([[0.0], [1.0], [1.0], [1.0], [1.0]])
    np.testing.assert_array_equal(run(noise=deviations, seed=1)[0, 0], quiet[0, 0])


def test_noise_has_the_deviation_that_was_asked_for(lanes):
    noise = jax.jit(noise_samples)
    deviation = np.array([40.0, 0.5])
    several = [np.asarray(noise(deviation, 3, k, np.arange(4000))) for k in range(2)]
    np.testing.assert_allclose(np.std(several[0], axis=0), [40.0, 0.5], rtol=0.05)
    np.testing.assert_allclose(np.mean(several[0], axis=0), 0.0, atol=2.0)
    assert abs(np.corrcoef(several[0][:, 0], several[1][:, 0])[0, 1]) < 0.05
    later = noise(deviation, 3, 1, np.arange(10, 12))
    np.testing.assert_array_equal(later, several[1][10:12])


@pytest.mark.slow
def test_only_what_is_recorded_is_kept(lanes):
    (batch,) = simulate_batches(lanes, WellPlant(), TO_30_PERCENT, samples=5, record=("cv", "solve_time"))
    assert set(batch.fields) == {"cv", "solve_time"}
    with pytest.raises(InputError, match=r"record: got '.*', expected a recorded field"):
        batch.trajectory(0)
    with pytest.raises(InputError, match="record"):
        simulate_batches(lanes, WellPlant(), TO_30_PERCENT, record=("cvs",))


def test_a_second_sweep_of_the_same_shape_compiles_nothing(lanes):
    run = lambda: simulate_batch(lanes, WellPlant(), TO_30_PERCENT, samples=25, noise=[1.0, 0.1])  # noqa: E731
    run()
    compiled = []
    monitor = lambda event, _, **__: compiled.append(event) if "compile" in event else None  # noqa: E731
    jax.monitoring.register_event_duration_secs_listener(monitor)
    try:
        run()
    finally:
        jax.monitoring.unregister_event_duration_listener(monitor)
    assert not [event for event in compiled if "backend_compile" in event]


def test_progress_starts_after_compilation_and_counts_every_lane(lanes):
    seen = []
    simulate_batch(
        lanes,
        WellPlant(),
        TO_30_PERCENT,
        samples=25,
        lanes_at_once=2,
        progress=lambda *step: seen.append(step),
    )
    assert seen == [(0, 125), (50, 125), (100, 125), (125, 125)]


SPREAD = """
import sys
import jax
import numpy as np
from jaxmpc import Reference, StepResponseModel, WellPlant
from jaxmpc.controller.batch import Controllers
from jaxmpc.loop.simulate import simulate_batches
from studies.thesis.well import WELL
assert jax.device_count() == 2
structure = WELL.structure()
tunings = [WELL.tuning(structure, changes={"move_weight": {"choke": w, "gas_lift": 0.2}}) for w in WEIGHTS]
lanes = Controllers(structure, tunings, StepResponseModel.load(sys.argv[1]))
reference = Reference([0.0, 200.0], [[11013.0, 185.0], [12600.0, 175.0]], 1200.0)
(batch,) = simulate_batches(lanes, WellPlant(), reference, samples=25, noise=[40.0, 0.5])
np.savez(sys.argv[2], **batch.fields)
"""


def test_several_devices_give_the_results_of_one(lanes, model, tmp_path):
    script = SPREAD.replace("WEIGHTS", repr(WEIGHTS[:3]))  # two lanes, and one that is filled up
    command = [
        sys.executable,
        "-c",
        script,
        str(model.save(tmp_path / "model.json")),
        str(tmp_path / "two.npz"),
    ]
    flags = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    subprocess.run(command, env=flags, check=True, cwd=Path(__file__).parents[2])
    one = whole(simulate_batches(lanes, WellPlant(), TO_30_PERCENT, samples=25, noise=[40.0, 0.5]))
    two = np.load(tmp_path / "two.npz")
    for name in ("cv", "mv", "move", "bias", "objective", "status"):
        np.testing.assert_allclose(two[name], one[name][:3], **LIMITS, err_msg=name)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"controllers": "alone"}, "lanes"),
        ({"reference": []}, "lanes"),
        ({"reference": [TO_30_PERCENT] * 4}, "lanes"),
        ({"seed": np.arange(3)}, "lanes"),
        ({"seed": 0.5}, "seed"),
        ({"noise": [1.0]}, "noise"),
        ({"noise": [1.0, -1.0]}, "noise"),
        ({"disturbance": np.zeros((5, 3))}, "disturbance"),
        ({"disturbance": np.zeros((4, 120))}, "lanes"),
        ({"faults": np.zeros((4, 120, 2))}, "lanes"),
        ({"faults": np.zeros((5, 120))}, "faults"),
        ({"position_feedback": [True, False]}, "lanes"),
        ({"position_feedback": 1.0}, "position_feedback"),
        ({"samples": 121}, "reference.duration"),
        ({"plants": WellPlant(dt=5.0)}, "plant.dt"),
        ({"controllers": "what they know"}, "controllers"),
        ({"lanes_at_once": 0}, "lanes_at_once"),
    ],
)
def test_a_sweep_that_does_not_fit_is_refused_before_it_starts(lanes, singles, change, field):
    given = {"alone": singles[0], "what they know": lanes.cores}
    arguments = {"controllers": lanes, "plants": WellPlant(), "reference": TO_30_PERCENT} | change
    controllers = arguments.pop("controllers")
    with pytest.raises(InputError) as error:
        simulate_batches(
            given[controllers] if isinstance(controllers, str) else controllers,
            arguments.pop("plants"),
            arguments.pop("reference"),
            **arguments,
        )
    assert error.value.field == field


class OnTheHost:
    """The JAX well as a plant of one's own, so that the loop runs on the host."""

    def __init__(self, plant):
        self.well, self.dt = HostPlant(plant), plant.dt

    def init(self):
        return self.well.init()

    def step(self, mv, disturbance=0.0):
        return self.well.step(mv, disturbance)


def test_faults_of_sensors_and_told_positions_are_the_same_in_compiled_loops_and_on_the_host(model):
    structure = WELL.structure()
    changes = {
        "measurement_low": {"gas_rate": None, "oil_rate": 20.0},
        "bad_limit": {"gas_rate": 5, "oil_rate": None},
    }
    controller = Controller(structure, WELL.tuning(structure, changes=changes), model)
    faults = [
        SensorFault("gas_rate", "missing", 100.0, 100.0),
        SensorFault("oil_rate", "frozen", 300.0, 150.0),
        SensorFault("oil_rate", "spike", 600.0, size=-200.0),
    ]
    given = dict(faults=fault_errors(structure, 120, faults), position_feedback=True, noise=[20.0, 0.3])
    plant = WellPlant(actuator="step")
    compiled = simulate(controller, plant, TO_30_PERCENT, **given)
    stepped = simulate(controller, OnTheHost(plant), TO_30_PERCENT, **given)
    lanes = Controllers(structure, [controller.tuning] * 2, model)
    both = {
        key: np.stack([np.zeros_like(value), value]) if key == "faults" else value
        for key, value in given.items()
    }
    feedback = {"position_feedback": np.array([False, True]), "seed": np.array([0, 0])}
    sound, failing = simulate_batch(lanes, plant, TO_30_PERCENT, **(both | feedback))
    for run in (stepped, failing):
        np.testing.assert_array_equal(run.quality, compiled.quality)
        np.testing.assert_array_equal(run.off, compiled.off)
        np.testing.assert_allclose(run.mv_demand, compiled.mv_demand, **LIMITS)
    assert compiled.quality[:, 0].tolist() == [MISSING if 10 <= k < 20 else 0 for k in range(120)]
    assert compiled.quality[:, 1].tolist() == [OUTSIDE if k == 60 else 0 for k in range(120)]
    assert compiled.off[:, 0].tolist() == [14 <= k < 20 for k in range(120)]
    assert not sound.quality.any()
    # without a lead the demand never leaves a step choke by more than one move
    assert np.abs(compiled.mv_demand[1:, 0] - compiled.mv[:-1, 0]).max() <= 2.0 + 1e-6
    assert np.abs(sound.mv_demand - compiled.mv_demand).max() > 1.0


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"samples": 121}, "reference.duration"),
        ({"disturbance": np.zeros(3)}, "disturbance"),
        ({"faults": np.zeros((119, 2))}, "faults"),
        ({"disturbance": np.full(120, np.nan)}, "disturbance"),
        ({"plant": WellPlant(dt=5.0)}, "plant.dt"),
        ({"reference": Reference([0.0], [[1.0]], 100.0)}, "reference.setpoints"),
    ],
)
def test_a_run_that_does_not_fit_is_refused_before_it_starts(model, change, field):
    arguments = {"plant": WellPlant(), "reference": TO_30_PERCENT} | change
    with pytest.raises(InputError) as error:
        simulate(
            controller_of("continuous", model),
            arguments.pop("plant"),
            arguments.pop("reference"),
            **arguments,
        )
    assert error.value.field == field
