"""Input targets (6.20)-(6.21): against brute force, least squares and the controller without them."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.measurement import SensorFault, fault_errors
from jaxmpc.controller.plan import Planner, solve_plan
from jaxmpc.controller.targets import TargetController, augment
from jaxmpc.errors import InputError
from jaxmpc.loop.targets import simulate_with_targets
from jaxmpc.model.step_response import make_model
from jaxmpc.problem.blocking import sample_moves
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import make_tuning, stack_tunings
from jaxmpc.process.reference import Reference
from jaxmpc.process.well.plant import WellPlant

CV, MV = np.array([11000.0, 185.0]), np.array([50.0, 7500.0])
SETPOINT, TARGET = CV + np.array([-600.0, -3.0]), np.array([46.0, 6900.0])
WEIGHT = {"choke": 40.0, "lift": 2e-4}


def price(structure, moves, mv_now, target, weight):
    """J_u (6.20): every penalised sample pays for the input it was made with; held after the control horizon."""
    u = mv_now + np.cumsum(sample_moves(structure) @ moves, axis=0)
    held = np.minimum(np.arange(structure.prediction_horizon), structure.control_horizon - 1)
    return float((weight * (u[held][structure.first_penalised - 1 :] - target) ** 2).sum())


def step_from_steady(controller, *, target=TARGET, setpoint=SETPOINT, samples=1):
    """Some samples against constant measurements; the last state and all infos."""
    state, infos = controller.init(CV, MV), []
    inputs = (CV, setpoint, target) if isinstance(controller, TargetController) else (CV, setpoint)
    for _ in range(samples):
        state, info = controller.step(state, *inputs)
        infos.append(info)
    return state, infos


@pytest.mark.parametrize(
    ("integer", "blocking", "first_penalised"),
    [
        (True, "moves", 4),
        pytest.param(True, "inputs", 1, marks=pytest.mark.slow),
        (False, "moves", 1),
    ],
)
def test_the_objective_is_that_of_the_problem_plus_the_price_of_the_inputs(
    well_like_model, small_structure, thesis_fields, integer, blocking, first_penalised
):
    structure = dataclasses.replace(
        small_structure if integer else small_structure.relaxed(),
        blocking=blocking,
        first_penalised=first_penalised,
    )
    tuning = make_tuning(structure, **thesis_fields)
    controller = TargetController(structure, tuning, well_like_model, WEIGHT)
    _, (info,) = step_from_steady(controller)
    moves = np.asarray(info.moves)
    free = np.tile(CV, (structure.prediction_horizon, 1))
    setpoints = np.tile(SETPOINT, (structure.prediction_horizon, 1))
    plain, _, _ = Planner(structure, tuning, well_like_model).objective(moves, free, setpoints)
    extra = price(structure, moves, MV, TARGET, np.array(list(WEIGHT.values())))
    assert int(info.status) == status.OPTIMAL
    assert extra > 0.01 * plain
    assert float(info.objective) == pytest.approx(plain + extra, rel=1e-6)


def test_whole_moves_are_the_best_of_all(thesis_fields):
    structure = Structure(("gas", "oil"), ("choke", "valve"), 10.0, 12, 6, 1, (1, 2, 3), "moves", (2.0, 1.0))
    rng = np.random.default_rng(1)
    shape = 1 - np.exp(-np.arange(1, 13) / 4.0)
    for case in range(4):
        model = make_model(rng.normal(0, 1, (2, 2, 1)) * shape, 10.0, structure.cv_names, structure.mv_names)
        tuning = make_tuning(
            structure,
            cv_weight=rng.uniform(0.1, 1, 2),
            move_weight=rng.uniform(0, 0.5, 2),
            soft_quadratic=0.3,
            soft_linear=0.2,
            deadzone=1.0,
            move_low=[-2.0, -1.0],
            move_high=[2.0, 1.0],
            mv_low=-4.0,
            mv_high=[100.0, 3.0],
        )
        mv_now, target = np.array([0.0, 1.0]), rng.uniform(-4, 4, 2)
        weight = np.array([rng.uniform(0.1, 1), 0.0 if case == 0 else rng.uniform(0.1, 1)])
        free, setpoints = rng.normal(0, 2, (12, 2)), np.tile(rng.normal(0, 4, 2), (12, 1))
        wide = augment(structure, tuning, model, dict(choke=weight[0], valve=weight[1]))
        plan = solve_plan(
            wide[2],
            wide[0],
            wide[1],
            mv_now=mv_now,
            last_move=np.zeros(2),
            free_response=np.hstack([free, np.tile(mv_now, (12, 1))]),
            setpoint=np.hstack([setpoints, np.tile(target, (12, 1))]),
        )
        planner, best = Planner(structure, tuning, model), np.inf
        for steps in itertools.product((-1, 0, 1), repeat=6):
            moves = np.array(steps).reshape(3, 2) * [2.0, 1.0]
            u = mv_now + np.cumsum(sample_moves(structure) @ moves, axis=0)
            if (u >= -4.0).all() and (u <= [100.0, 3.0]).all():
                value = planner.objective(moves, free, setpoints)[0]
                best = min(best, value + price(structure, moves, mv_now, target, weight))
        assert plan.status == "optimal"
        assert plan.objective == pytest.approx(best, rel=1e-6)


def test_without_limits_the_moves_are_those_of_least_squares(well_like_model, small_structure):
    structure = small_structure.relaxed()
    tuning = make_tuning(structure, cv_weight=[1e-4, 0.1], move_weight=[250.0, 0.2])
    _, (info,) = step_from_steady(TargetController(structure, tuning, well_like_model, WEIGHT))
    matrix = Planner(structure, tuning, well_like_model).matrix  # cv horizon mv block
    samples = sample_moves(structure)  # sample block
    held = np.minimum(np.arange(40), 19)
    position = np.cumsum(samples, axis=0)[held]
    rows, right = [], []
    for cv, q in enumerate((1e-4, 0.1)):
        rows.append(np.sqrt(q) * matrix[cv].reshape(40, 12))
        right.append(np.sqrt(q) * np.full(40, (SETPOINT - CV)[cv]))
    for mv, (p, w) in enumerate(zip((250.0, 0.2), WEIGHT.values(), strict=True)):
        only = np.eye(2)[mv]
        rows += [np.sqrt(p) * np.kron(only, samples), np.sqrt(w) * np.kron(only, position)]
        right += [np.zeros(20), np.full(40, np.sqrt(w) * (TARGET - MV)[mv])]
    best = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
    assert np.asarray(info.moves).T.ravel() == pytest.approx(best, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("integer", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_weight_of_zero_gives_the_moves_of_the_controller_without_targets(
    well_like_model, small_structure, thesis_fields, integer
):
    structure = small_structure if integer else small_structure.relaxed()
    tuning = make_tuning(structure, **thesis_fields)
    _, plain = step_from_steady(Controller(structure, tuning, well_like_model), samples=6)
    zero = TargetController(structure, tuning, well_like_model, {"choke": 0.0, "lift": 0.0})
    _, same = step_from_steady(zero, samples=6)
    assert np.abs([np.asarray(info.move) for info in plain]).max() > 1.0
    for one, other in zip(plain, same, strict=True):
        assert np.asarray(other.move) == pytest.approx(np.asarray(one.move), abs=1e-4)
        assert float(other.objective) == pytest.approx(float(one.objective), rel=2e-6)


def test_no_targets_leave_the_problem_as_it_is(well_like_model, small_structure, small_tuning):
    given = small_structure, small_tuning, well_like_model
    assert all(a is b for a, b in zip(augment(*given, {}), given, strict=True))
    controller = TargetController(*given, {})
    assert controller.controller.structure is small_structure
    _, (info,) = step_from_steady(controller)
    _, (plain,) = step_from_steady(Controller(*given))
    assert np.array_equal(info.move, plain.move)


@pytest.mark.slow
def test_a_target_for_one_mv_alone_adds_one_cv(well_like_model, small_structure, small_tuning):
    structure, tuning, model = augment(small_structure, small_tuning, well_like_model, {"lift": 0.5})
    assert structure.cv_names == model.cv_names == ("gas", "oil", "lift.target")
    assert np.asarray(tuning.cv_weight).tolist() == [1e-4, 0.1, 0.5]
    assert np.asarray(tuning.cv_high)[2] == np.inf
    assert (np.asarray(model.coefficients)[2] == [[0.0], [1.0]]).all()
    controller = TargetController(small_structure, small_tuning, well_like_model, {"lift": 0.5})
    calm = dict(target=np.array([np.nan, 7000.0]), setpoint=CV)
    _, infos = step_from_steady(controller, samples=3, **calm)
    assert float(infos[-1].mv[1]) < 7300.0


def test_demands_are_measured_without_bias(well_like_model, small_structure, small_tuning):
    controller = TargetController(small_structure, small_tuning, well_like_model, WEIGHT)
    state, infos = step_from_steady(controller, samples=8)
    assert np.abs(np.asarray(state.bias)[2:]).max() < 1e-9
    assert np.abs(np.asarray(state.mv) - MV).max() > 5.0
    assert not any(bool(info.fallback) for info in infos)


def test_continuous_steps_can_be_jitted_and_mapped_over_weights(
    well_like_model, small_structure, thesis_fields
):
    structure = small_structure.relaxed()
    tuning = make_tuning(structure, **thesis_fields)
    weights = [{"choke": w, "lift": 1e-4 * w} for w in (0.0, 3.0, 300.0)]
    alone = [TargetController(structure, tuning, well_like_model, weight) for weight in weights]
    one_by_one = np.stack([step_from_steady(c)[1][0].moves for c in alone])
    wide = [augment(structure, tuning, well_like_model, weight) for weight in weights]

    def moves(tuning):
        controller = Controller(wide[0][0], tuning, wide[0][2])
        state = controller.init(np.append(CV, MV), MV)
        return controller.step(state, np.append(CV, MV), np.append(SETPOINT, TARGET))[1].moves

    together = jax.jit(jax.vmap(moves))(stack_tunings([tuning for _, tuning, _ in wide]))
    assert np.asarray(together) == pytest.approx(one_by_one, rel=1e-4, abs=1e-3)
    assert np.abs(one_by_one[0] - one_by_one[2]).max() > 1.0


@pytest.mark.parametrize("integer", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_loop_with_targets_has_the_cvs_of_the_plant_and_pulls_the_inputs(
    well_like_model, small_structure, thesis_fields, integer
):
    structure = small_structure if integer else small_structure.relaxed()
    tuning = make_tuning(structure, **thesis_fields)
    reference = Reference([0.0], [CV], 600.0)
    targets = Reference([0.0, 200.0], [[50.0, 7500.0], [0.0, 7000.0]], 600.0)
    plant = WellPlant(actuator="step" if integer else "continuous")
    pulled = TargetController(structure, tuning, well_like_model, {"lift": 0.05})
    faults = fault_errors(structure, 60, [SensorFault("gas", "missing", 100.0, 50.0)])
    broken = dict(faults=faults, position_feedback=True)
    run = simulate_with_targets(pulled, plant, reference, targets, noise=[5.0, 0.05], seed=2, **broken)
    assert run.quality.shape == (60, 2)
    assert run.quality[:, 0].nonzero()[0].tolist() == [10, 11, 12, 13, 14]
    assert run.cv_names == ("gas", "oil")
    assert run.cv.shape == run.setpoint.shape == run.bias.shape == (60, 2)
    assert not run.fallback.any()
    assert run.mv[-1, 1] == pytest.approx(7000.0, abs=30.0)


@pytest.mark.parametrize(
    ("weight", "message"),
    [
        ({"gas": 1.0}, r"target_weight.gas: got 1.0, expected one of the MV names choke, lift"),
        ({"lift": -1.0}, r"target_weight.lift.*1/MV unit\^2"),
        ({"lift": np.inf}, r"target_weight.lift.*finite"),
        ({"lift": "much"}, r"target_weight.lift"),
        (1.0, r"target_weight.*mapping"),
    ],
)
def test_bad_weights_are_refused_by_name(well_like_model, small_structure, small_tuning, weight, message):
    with pytest.raises(InputError, match=message):
        augment(small_structure, small_tuning, well_like_model, weight)


def test_targets_and_noise_of_the_wrong_size_are_refused(well_like_model, small_structure, small_tuning):
    controller = TargetController(small_structure, small_tuning, well_like_model, WEIGHT)
    reference = Reference([0.0], [CV], 100.0)
    with pytest.raises(InputError, match="mv_target: got '1 columns', expected 2 columns"):
        simulate_with_targets(controller, WellPlant(), reference, Reference([0.0], [[1.0]], 100.0))
    with pytest.raises(InputError, match="noise"):
        simulate_with_targets(controller, WellPlant(), reference, Reference([0.0], [MV], 100.0), noise=[1.0])
