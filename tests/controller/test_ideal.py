"""Ideal values of MVs (6.20)-(6.21): against brute force, other people's solvers, least squares and a CV in their place."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.case import case_to_dict, make_case
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.plan import Planner, solve_plan
from jaxmpc.errors import InputError
from jaxmpc.loop.events import Event
from jaxmpc.loop.simulate import simulate
from jaxmpc.problem.blocking import sample_moves
from jaxmpc.problem.tuning import make_tuning, stack_tunings
from jaxmpc.process.host import HostPlant
from jaxmpc.process.reference import Reference
from jaxmpc.process.well.plant import WellPlant
from tests import problems
from tests.oracles import steps as oracles

CV, MV = np.array([11000.0, 185.0]), np.array([50.0, 7500.0])
SETPOINT, IDEAL = CV + np.array([-600.0, -3.0]), np.array([46.0, 6900.0])
WEIGHT = np.array([40.0, 2e-4])
# fields of a CV that has the weight of an ideal value alone
MV_AS_CV = dict(cv_weight=0.01, cv_low=-np.inf, cv_high=np.inf, slack_weight=0.0) | dict.fromkeys(
    ("soft_quadratic", "soft_linear", "deadzone"), 0.0
)
STEERED = {"ideal": IDEAL, "ideal_weight": WEIGHT}


def price(structure, moves, mv_now, ideal=IDEAL, weight=WEIGHT):
    """J_u (6.20): every penalised sample pays for the input it was made with; held after the control horizon."""
    u = mv_now + np.cumsum(sample_moves(structure) @ moves, axis=0)
    held = np.minimum(np.arange(structure.prediction_horizon), structure.control_horizon - 1)
    return float((weight * (u[held][structure.first_penalised - 1 :] - ideal) ** 2).sum())


def step(controller, samples=1, **how):
    """Some samples against constant measurements; all infos."""
    state, infos = controller.init(CV, MV), []
    for _ in range(samples):
        state, info = controller.step(state, CV, SETPOINT, **how)
        infos.append(info)
    return infos


def solve(body):
    case = make_case(body)
    fields = ("mv_now", "last_move", "free_response", "setpoint")
    return solve_plan(case.model, case.structure, case.tuning, **{k: getattr(case, k) for k in fields})


def steered_case(seed, **shape):
    """A random case with ideal values; the first MV of some has none."""
    rng = np.random.default_rng(seed)
    body = problems.small_case(rng, **shape)
    problems.ideal_values(body, rng)
    if seed % 4 == 0:
        body["tuning"]["ideal_weight"][0] = 0.0
    return body


@pytest.mark.parametrize(
    "shape",
    [
        dict(blocks=[1, 1, 2, 2]),
        dict(blocks=[1, 2, 3], blocking="inputs", hw=3),
        dict(blocks=[1, 2, 3], integer={0: 2.0, 1: 0.5}),
        dict(blocks=[1, 1, 2, 2], integer={}, hw=2),
    ],
    ids=["moves", "inputs", "two-integer-mvs", "relaxed"],
)
def test_plans_are_the_best_of_all(shape):
    for seed in range(4):
        body = steered_case(seed, **shape)
        best = (oracles.brute_force if shape.get("integer", True) else oracles.best_qp)(body)
        assert oracles.complaints(body, solve(body), best) == []


def test_mvs_with_blocks_of_their_own_go_to_their_ideal_values_as_scip_has_it():
    body = steered_case(5, blocks=[1, 1, 2, 2], integer={0: 2.0, 1: 0.5})
    body["structure"]["blocks"] = {"u0": [1, 1, 2, 2], "u1": [2, 4]}
    assert oracles.complaints(body, solve(body), oracles.solve_scip(body, 20)) == []


def test_a_case_file_has_ideal_values_only_where_they_cost_something():
    body = steered_case(1, blocks=[1, 1, 2, 2])
    again = case_to_dict(make_case(body))
    assert again["tuning"]["ideal"] == body["tuning"]["ideal"]
    assert again["tuning"]["ideal_weight"] == body["tuning"]["ideal_weight"]
    plain = problems.small_case(np.random.default_rng(1), blocks=[1, 1, 2, 2])
    assert case_to_dict(make_case(plain))["tuning"].keys() == plain["tuning"].keys()


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
    (info,) = step(Controller(structure, make_tuning(structure, **thesis_fields, **STEERED), well_like_model))
    moves = np.asarray(info.moves)
    plain = Planner(structure, make_tuning(structure, **thesis_fields), well_like_model)
    rows = lambda cv: np.tile(cv, (structure.prediction_horizon, 1))  # noqa: E731
    without, _, _ = plain.objective(moves, np.tile(MV, (20, 1)), rows(CV), rows(SETPOINT))
    extra = price(structure, moves, MV)
    assert int(info.status) == status.OPTIMAL
    assert extra > 0.01 * without
    assert float(info.objective) == pytest.approx(without + extra, rel=1e-6)


def test_without_limits_the_moves_are_those_of_least_squares(well_like_model, small_structure):
    structure = small_structure.relaxed()
    tuning = make_tuning(structure, cv_weight=[1e-4, 0.1], move_weight=[250.0, 0.2], **STEERED)
    (info,) = step(Controller(structure, tuning, well_like_model))
    matrix = Planner(structure, tuning, well_like_model).matrix  # cv horizon mv block
    samples = sample_moves(structure)  # sample block
    position = np.cumsum(samples, axis=0)[np.minimum(np.arange(40), 19)]
    rows, right = [], []
    for cv, q in enumerate((1e-4, 0.1)):
        rows.append(np.sqrt(q) * matrix[cv].reshape(40, 12))
        right.append(np.sqrt(q) * np.full(40, (SETPOINT - CV)[cv]))
    for mv, (p, w) in enumerate(zip((250.0, 0.2), WEIGHT, strict=True)):
        only = np.eye(2)[mv]
        rows += [np.sqrt(p) * np.kron(only, samples), np.sqrt(w) * np.kron(only, position)]
        right += [np.zeros(20), np.full(40, np.sqrt(w) * (IDEAL - MV)[mv])]
    best = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
    assert np.asarray(info.moves).T.ravel() == pytest.approx(best, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("kind", ["continuous", "mixed-integer", "scheduled", "scheduled-mixed-integer"])
def test_a_cv_that_follows_the_mv_is_the_same_whatever_else_happens(
    made, well_like_model, small_structure, thesis_fields, kind
):
    """A CV with step response 1 from the next sample on, measured where the MV stands, its setpoint the ideal value."""
    from tests.five_controllers import controller_of

    lead = {"demand_lead": [2.0, 50.0]}
    own = {key: [*np.broadcast_to(thesis_fields[key], 2), value] for key, value in MV_AS_CV.items()}
    extra = np.zeros((1, 2, well_like_model.samples))
    extra[0, 1] = 1.0
    names = ("gas", "oil", "lift now")
    wide_model = dataclasses.replace(
        well_like_model,
        coefficients=jnp.concatenate([well_like_model.coefficients, extra]),
        dv_coefficients=np.zeros((3, 0, well_like_model.samples)),
        cv_names=names,
    )
    wide = controller_of(
        kind, wide_model, dataclasses.replace(small_structure, cv_names=names), thesis_fields | own | lead
    )
    one = made(kind, ideal=[0.0, 7000.0], ideal_weight=[0.0, 0.01], **lead)
    states = one.init(CV, MV), wide.init(np.append(CV, MV[1]), MV)
    # the actuators lag behind, one is in manual, a CV is switched off
    told = [{}, dict(mv=MV - 10.0), dict(mv=MV + 5.0, manual=np.array([True, False])), dict(cv_off=True)]
    for how in told:
        given, off = {k: v for k, v in how.items() if k != "cv_off"}, np.array([False, "cv_off" in how])
        stands = given.get("mv", np.asarray(states[0].position))[1]
        narrow, info = one.step(states[0], CV, SETPOINT, cv_off=off, **given)
        wider, same = wide.step(
            states[1],
            np.append(CV, stands),
            np.append(SETPOINT, 7000.0),
            cv_off=np.append(off, False),
            **given,
        )
        states = narrow, wider
        assert float(info.objective) == pytest.approx(float(same.objective), rel=2e-6)
        assert np.asarray(info.move) == pytest.approx(np.asarray(same.move), abs=0.02)
    assert np.asarray(narrow.mv)[1] < MV[1] - 20.0


def test_a_weight_of_zero_changes_nothing(well_like_model, small_structure, small_tuning):
    aimed = dataclasses.replace(small_tuning, ideal=jnp.array([46.0, 0.0]))
    controller = Controller(small_structure, small_tuning, well_like_model)
    same, plain = (step(c, 3) for c in (controller.with_tuning(aimed), controller))
    assert all(np.array_equal(one.moves, other.moves) for one, other in zip(same, plain, strict=True))
    assert controller.core.qp.ideal is None


def test_another_tuning_and_a_batch_may_bring_the_first_ideal_value(
    well_like_model, small_structure, small_tuning
):
    controller = Controller(small_structure, small_tuning, well_like_model)
    aimed = dataclasses.replace(small_tuning, ideal=jnp.asarray(IDEAL), ideal_weight=jnp.asarray(WEIGHT))
    state = controller.init(CV, MV)
    _, later = controller.with_tuning(aimed).step(state, CV, SETPOINT)
    alone = [step(Controller(small_structure, t, well_like_model))[0] for t in (small_tuning, aimed)]
    batch = Controllers(small_structure, [small_tuning, aimed], well_like_model)
    twice = lambda v: np.stack([v, v])  # noqa: E731
    _, both = batch.step(batch.init(twice(CV), twice(MV)), twice(CV), twice(SETPOINT))
    np.testing.assert_allclose(later.moves, alone[1].moves, atol=1e-4)
    for lane, one in enumerate(alone):
        np.testing.assert_allclose(both.moves[lane, :6], one.moves, atol=1e-4)
        assert float(both.objective[lane]) == pytest.approx(float(one.objective), rel=2e-6)
    assert np.abs(alone[0].moves - alone[1].moves).max() > 1.0


def test_continuous_steps_can_be_jitted_and_mapped_over_weights(
    well_like_model, small_structure, thesis_fields
):
    structure = small_structure.relaxed()
    tunings = [
        make_tuning(structure, **thesis_fields, ideal=IDEAL, ideal_weight=w * WEIGHT) for w in (0, 0.1, 10)
    ]
    one_by_one = np.stack([step(Controller(structure, t, well_like_model))[0].moves for t in tunings])

    def moves(tuning):
        controller = Controller(structure, tuning, well_like_model)
        return controller.step(controller.init(CV, MV), CV, SETPOINT)[1].moves

    together = jax.jit(jax.vmap(moves))(stack_tunings(tunings))
    assert np.asarray(together) == pytest.approx(one_by_one, rel=1e-4, abs=1e-3)
    assert np.abs(one_by_one[0] - one_by_one[2]).max() > 1.0


@pytest.mark.parametrize("integer", [pytest.param(False, marks=pytest.mark.slow), True])
def test_events_move_the_ideal_value_and_give_it_its_weight(
    well_like_model, small_structure, thesis_fields, integer
):
    structure = small_structure if integer else small_structure.relaxed()
    controller = Controller(structure, make_tuning(structure, **thesis_fields), well_like_model)
    plant = WellPlant(actuator="step" if integer else "continuous")
    events = [
        Event(100.0, {"ideal": {"lift": 7300.0}, "ideal_weight": {"lift": 0.05}}),
        Event(300.0, {"ideal": {"lift": 7000.0}}),
    ]
    how = dict(events=events, noise=[5.0, 0.05], seed=2, position_feedback=True)
    run, host = (
        simulate(controller, p, Reference([0.0], [CV], 600.0), **how) for p in (plant, HostPlant(plant))
    )
    assert not run.fallback.any()
    assert run.mv[9, 1] == pytest.approx(7500.0, abs=5.0)
    assert run.mv[29, 1] == pytest.approx(7300.0, abs=30.0)
    assert run.mv[-1, 1] == pytest.approx(7000.0, abs=30.0)
    np.testing.assert_allclose(host.mv, run.mv, atol=0.05)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            dict(ideal_weight={"gas": 1.0}),
            r"tuning.ideal_weight.gas: got 1.0, expected one of the names choke",
        ),
        (dict(ideal_weight=[0.0, -1.0]), r"tuning.ideal_weight\[1\].*0 or more \[1/MV unit\^2\] for lift"),
        (dict(ideal=[np.inf, 0.0]), r"tuning.ideal\[0\].*a finite number \[MV unit\] for choke"),
        (dict(ideal=[np.nan, 0.0]), r"tuning.ideal\[0\].*a number \[MV unit\] for choke"),
    ],
)
def test_bad_ideal_values_are_refused_by_name(small_structure, thesis_fields, fields, message):
    with pytest.raises(InputError, match=message):
        make_tuning(small_structure, **thesis_fields, **fields)


def test_ideal_values_may_be_negative(small_structure, thesis_fields):
    assert make_tuning(small_structure, **thesis_fields, ideal=-3.0).ideal.tolist() == [-3.0, -3.0]
