"""Lanes of different structures: each does what its controller does alone, and no structure costs a compilation."""

import contextlib
import dataclasses

import jax
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.controller import Controller
from jaxmpc.errors import InputError
from jaxmpc.loop.simulate import simulate, simulate_batches
from jaxmpc.process.reference import Reference
from jaxmpc.process.well.plant import WellPlant
from tests.five_controllers import START, tuned

SETPOINTS = START[0] + np.array(
    [[2500.0, 40.0], [900.0, 6.0], [1500.0, 20.0], [-1500.0, -20.0], [-1700.0, -30.0]]
)
CHOKE_WEIGHTS = (250.0, 1.0, 60.0, 250.0, 1.0)  # light ones leave something to search for
PLANT = WellPlant(actuator="step")
REFERENCE = Reference([0.0, 40.0], START[0] + np.array([[0.0, 0.0], [900.0, 6.0]]), 250.0)


@pytest.fixture(scope="module")
def structures(small_structure):
    """Horizons, blocks, both meanings of a block, whole moves and continuous ones; not all of one size."""
    change = dataclasses.replace
    relaxed = small_structure.relaxed()
    return [
        small_structure,
        change(small_structure, blocking="inputs", blocks=(1, 2, 2, 3, 4, 4, 4)),
        relaxed,
        change(relaxed, blocking="inputs", prediction_horizon=55, control_horizon=11, blocks=(1, 1, 2, 3, 4)),
        change(
            small_structure, prediction_horizon=30, first_penalised=3, control_horizon=7, blocks=(1, 2, 4)
        ),
    ]


@pytest.fixture(scope="module")
def tunings(structures, thesis_fields):
    return [
        tuned(structure, thesis_fields, move_weight=[weight, 0.2])
        for structure, weight in zip(structures, CHOKE_WEIGHTS, strict=True)
    ]


@pytest.fixture(scope="module")
def models(well_like_model):
    """One ends earlier than the others."""
    short = dataclasses.replace(well_like_model, coefficients=well_like_model.coefficients[..., :45])
    return [well_like_model, well_like_model, short, well_like_model, well_like_model]


@pytest.fixture(scope="module")
def together(structures, tunings, models):
    return Controllers(structures, tunings, models)


@pytest.fixture(scope="module")
def singles(structures, tunings, models):
    return [Controller(*given) for given in zip(structures, tunings, models, strict=True)]


@contextlib.contextmanager
def compilations():
    """The events of compilation within."""
    seen = []
    listen = lambda event, _, **__: seen.append(event) if "backend_compile" in event else None  # noqa: E731
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield seen
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def measured(k):
    """Measurements that do not depend on the moves."""
    return START[0] + np.array([150.0, -2.0]) * np.sin(0.5 * k)


def assert_same_step(info, lane, own, structure):
    blocks = structure.block_count
    assert info.status[lane] == own.status == status.OPTIMAL
    # each is solved to a relative gap of 1e-6, and programs of other sizes differ in rounding
    assert info.objective[lane] == pytest.approx(own.objective, rel=3e-6)
    assert info.mv[lane] == pytest.approx(own.mv, abs=1e-2)
    if structure.integer_mvs:
        assert info.mv[lane, 0] == pytest.approx(own.mv[0], abs=1e-9)
    assert own.moves.shape == (blocks, 2)
    assert not info.moves[lane, blocks:].any()  # padding


def test_a_step_of_lanes_of_different_structures_is_the_step_of_each(together, singles, structures):
    count = len(structures)
    state = together.init(np.tile(START[0], (count, 1)), np.tile(START[1], (count, 1)))
    alone = [single.init(*START) for single in singles]
    choke, broken = np.zeros(count), np.zeros(count)
    for k in range(6):
        state, info = together.step(state, np.tile(measured(k), (count, 1)), SETPOINTS)
        for lane, single in enumerate(singles):
            alone[lane], own = single.step(alone[lane], measured(k), SETPOINTS[lane])
            assert_same_step(info, lane, own, structures[lane])
        choke += np.abs(info.move[:, 0])
        steps = info.moves[:, :, 0] / 2.0
        broken = np.maximum(broken, np.abs(steps - np.round(steps)).max(axis=1))
    assert (choke > 1.0).all()
    whole = np.array([bool(structure.integer_mvs) for structure in structures])
    assert (broken < 1e-9).tolist() == whole.tolist()


def test_searches_on_the_host_know_which_structure_a_lane_has(structures, tunings, models, singles):
    searching = Controllers(structures, tunings, models, finish="branch-and-bound")
    count = len(structures)
    state = searching.init(np.tile(START[0], (count, 1)), np.tile(START[1], (count, 1)))
    _, info = searching.step(state, np.tile(START[0], (count, 1)), SETPOINTS)
    for lane, single in enumerate(singles):
        _, own = single.step(single.init(*START), START[0], SETPOINTS[lane])
        assert_same_step(info, lane, own, structures[lane])
    assert (info.finished_by == status.finisher_code("branch-and-bound")).any()


@pytest.mark.parametrize(
    "at_once", [256, pytest.param(2, marks=pytest.mark.slow)], ids=["one piece", "pieces"]
)
def test_loops_of_different_structures_are_those_of_each(together, singles, structures, at_once):
    noise = dict(noise=np.array([20.0, 0.2]), samples=20)
    batches = simulate_batches(together, PLANT, REFERENCE, seed=np.arange(5), lanes_at_once=at_once, **noise)
    runs = [run for batch in batches for run in batch.trajectories()]
    for lane, (run, single) in enumerate(zip(runs, singles, strict=True)):
        alone = simulate(single, PLANT, REFERENCE, seed=lane, **noise)
        assert (run.status == status.OPTIMAL).all()
        assert run.cv == pytest.approx(alone.cv, rel=1e-6)
        assert run.mv_demand == pytest.approx(alone.mv_demand, abs=1e-2)
        assert run.objective == pytest.approx(alone.objective, rel=1e-4)  # loops feed back what rounding does
        if structures[lane].integer_mvs:
            assert run.mv_demand[:, 0] == pytest.approx(alone.mv_demand[:, 0], abs=1e-9)
    assert len({run.mv_demand[-1].tobytes() for run in runs}) == len(runs)


@pytest.mark.parametrize("integer", [False, True], ids=["continuous", "mixed-integer"])
def test_a_controller_of_a_size_seen_before_compiles_nothing(
    singles, structures, thesis_fields, well_like_model, integer
):
    known = singles[0 if integer else 3]
    other = dataclasses.replace(
        known.structure,
        prediction_horizon=48,
        first_penalised=2,
        control_horizon=17,
        blocks=(2, 1, 3, 5, 6),
        blocking="inputs" if integer else "moves",
    )

    def used(controller):
        state, _ = controller.step(controller.init(*START), START[0], SETPOINTS[0])
        _, info = controller.step(state, START[0], SETPOINTS[0])
        return info, simulate(controller, PLANT, REFERENCE, samples=20)

    used(known)
    with compilations() as seen:
        info, run = used(Controller(other, tuned(other, thesis_fields), well_like_model))
    assert not seen
    assert info.status == status.OPTIMAL
    assert info.moves.shape == (5, 2)
    assert (run.status == status.OPTIMAL).all()


def test_lanes_of_a_size_seen_before_compile_nothing(together, structures, tunings, models):
    """Another order of the structures, with one that was not there before."""

    def used(controllers):
        count = controllers.count
        starts = [np.tile(value, (count, 1)) for value in (START[0], START[1])]
        controllers.step(controllers.init(*starts), starts[0], SETPOINTS)
        return list(simulate_batches(controllers, PLANT, REFERENCE, samples=20))

    used(together)
    changed = [dataclasses.replace(structures[3], prediction_horizon=50), *structures[1:3], *structures[:2]]
    order = [3, 1, 2, 0, 1]
    with compilations() as seen:
        used(Controllers(changed, [tunings[i] for i in order], [models[i] for i in order]))
    assert not seen


def test_structures_of_different_processes_are_refused(structures, tunings, well_like_model):
    for change in ({"cv_names": ("oil", "gas")}, {"dt": 5.0}):
        others = [structures[0], dataclasses.replace(structures[1], **change)]
        with pytest.raises(InputError, match=r"structure\[1\]"):
            Controllers(others, tunings[:2], well_like_model)
    with pytest.raises(InputError, match="tunings"):
        Controllers(structures, tunings[:2], well_like_model)
