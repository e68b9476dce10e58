"""Bad measurements are left out, and no controller stops for them."""

import dataclasses

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmpc.controller.batch import Controllers
from jaxmpc.controller.measurement import (
    FROZEN,
    GOOD,
    MISSING,
    OUTSIDE,
    SensorFault,
    Sensors,
    fault_errors,
    received,
)
from jaxmpc.errors import InputError
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import make_tuning
from tests.five_controllers import KINDS, SETPOINT, START, Process, closed, controller_of, stepped, tuned

CHOSEN = {"measurement_low": [0.0, 0.0], "measurement_high": [30000.0, 500.0]}


def column(infos, name):
    return np.array([np.asarray(getattr(info, name)) for info in infos])


@pytest.mark.parametrize("kind", KINDS)
def test_after_fifty_missing_samples_control_resumes_at_once(made, well_like_model, kind):
    missing = range(10, 60)
    process = Process(well_like_model)
    states, infos = closed(
        made(kind), process, 75, seen=lambda k, cv: np.full(2, np.nan) if k in missing else cv
    )
    quality = column(infos, "quality")[:, :2]
    assert (quality[10:60] == MISSING).all()
    assert (quality[:10] == GOOD).all()
    assert (quality[60:] == GOOD).all()
    assert not column(infos, "fallback").any()
    # without model error the prediction is right, so that what comes back finds no bias
    assert np.abs(column(states, "bias")[60:]).max() < 1e-6
    sound = Process(well_like_model)
    _, undisturbed = closed(made(kind), sound, 75)
    # the model is exact: leaving measurements out changes nothing but rounding and ties
    np.testing.assert_allclose(process.cv, sound.cv, atol=1e-3 * np.abs(SETPOINT - START[0]).max())
    assert len(undisturbed) == len(infos)


@pytest.mark.parametrize("kind", KINDS)
def test_a_spike_out_of_the_validation_limits_moves_nothing(made, well_like_model, kind):
    spikes = {5: 1e30, 9: -1e6, 12: 1e6, 15: np.inf, 20: -np.inf}
    with_spikes = Process(well_like_model)
    seen = lambda k, cv: np.array([spikes.get(k, cv[0]), cv[1]])  # noqa: E731
    _, infos = closed(made(kind, **CHOSEN), with_spikes, 30, seen=seen)
    quality = column(infos, "quality")
    assert [k for k in range(30) if quality[k, 0] != GOOD] == sorted(spikes)
    assert set(quality[[5, 15, 20], 0]) == {MISSING}  # no number that one can count with
    assert set(quality[[9, 12], 0]) == {OUTSIDE}
    assert (quality[:, 1] == GOOD).all()  # the other CV goes on
    sound = Process(well_like_model)
    closed(made(kind, **CHOSEN), sound, 30)
    np.testing.assert_allclose(with_spikes.mv, sound.mv, atol=1e-3)


def test_an_absurd_number_is_left_out_without_validation_limits_too(made, well_like_model):
    seen = lambda k, cv: np.array([1e30, cv[1]]) if k == 4 else cv  # noqa: E731
    _, infos = closed(made("mixed-integer"), Process(well_like_model), 8, seen=seen)
    assert column(infos, "quality")[:, 0].tolist() == [0, 0, 0, 0, MISSING, 0, 0, 0]
    assert not column(infos, "fallback").any()


@pytest.mark.slow
def test_a_spike_that_makes_the_moves_too_many_to_search_holds_the_mvs_for_as_long_as_it_lasts(
    well_like_model, small_structure, thesis_fields
):
    """Whole moves without any limit have a range that follows from the measurements."""
    unlimited = {f"{kind}_{end}": [None, None] for kind in ("mv", "move") for end in ("low", "high")}
    structure = dataclasses.replace(small_structure, integer_step=(0.02, None))
    controller = controller_of(
        "mixed-integer", well_like_model, structure, thesis_fields, **(unlimited | {"bias_cutoff": np.inf})
    )
    seen = lambda k, cv: np.array([cv[0], 9e11]) if k == 3 else cv  # noqa: E731
    _, infos = closed(controller, Process(well_like_model), 6, seen=seen)
    assert column(infos, "fallback").tolist() == [False, False, False, True, False, False]


def test_the_bias_of_a_cv_without_measurements_is_kept_or_fades_as_configured(made):
    for more, factor in (({}, 1.0), ({"bias_decay": [50.0, np.inf]}, np.exp(-10.0 / 50.0))):
        controller = made("continuous", **more)
        state = controller.init(*START)
        for _ in range(20):
            state, _ = stepped(controller, state, START[0] + [300.0, 4.0])
        before = np.asarray(state.bias)
        assert abs(before[0]) > 50.0
        state, _ = stepped(controller, state, np.array([np.nan, np.nan]))
        np.testing.assert_allclose(state.bias, before * [factor, 1.0], rtol=1e-12)


def judged(cvs, **fields):
    """Codes of a sequence of measurements of one CV, and whether it was off; the first is that of `init`."""
    structure = Structure(("y",), ("u",), prediction_horizon=2, control_horizon=1, blocks=(1,))
    tuning = make_tuning(structure, cv_weight=1.0, move_weight=1.0, **fields)
    sensors, out = Sensors.fresh(np.array([cvs[0]])), []
    for cv in cvs[1:]:
        sensors = sensors.judged(tuning, np.array([cv]))
        out.append((int(sensors.quality[0]), bool(sensors.off[0])))
    return out


def test_a_sensor_counts_as_frozen_after_as_many_equal_values_in_a_row_as_allowed():
    codes = [code for code, _ in judged([5.0, 6.0, 6.0, 6.0, 6.0, 7.0, 7.0], frozen_limit=2)]
    assert codes == [GOOD, GOOD, FROZEN, FROZEN, GOOD, GOOD]
    assert {code for code, _ in judged([6.0] * 50)} == {GOOD}  # nobody asked


def test_limits_of_the_validation_are_themselves_allowed():
    codes = [c for c, _ in judged([1.0, 0.0, 2.0, -0.1, 2.1], measurement_low=0.0, measurement_high=2.0)]
    assert codes == [GOOD, GOOD, OUTSIDE, OUTSIDE]


def test_a_cv_is_off_after_as_many_bad_measurements_as_allowed_and_on_with_the_first_good_one():
    nan = np.nan
    off = [o for _, o in judged([1.0, nan, nan, 1.5, nan, nan, nan, nan, 1.5], bad_limit=3)]
    assert off == [False, False, False, False, False, True, True, False]


@pytest.mark.parametrize("kind", ["continuous", "mixed-integer"])
def test_a_cv_that_is_off_leaves_the_others_to_be_controlled_as_if_it_had_no_weight(
    made, well_like_model, kind
):
    seen = lambda k, cv: np.array([np.nan, cv[1]]) if k >= 3 else cv  # noqa: E731
    states, infos = closed(made(kind, bad_limit=[1, np.inf]), Process(well_like_model), 12, seen=seen)
    off = column(infos, "off")
    assert (off[:, 0] == (np.arange(12) >= 3)).all()
    assert not off[:, 1].any()
    assert not column(infos, "fallback").any()
    # the same state, decided by a controller for which this CV never had weights and limits
    unweighted = {key: [0.0, float(getattr(made(kind).tuning, key)[1])] for key in WEIGHTS}
    alone = made(kind, **unweighted, cv_low=[None, 0.0], cv_high=[None, 400.0])
    cv = np.array([np.nan, 190.0])
    _, expected = stepped(alone, states[-1], cv)
    _, info = stepped(made(kind, bad_limit=[1, np.inf]), states[-1], cv)
    np.testing.assert_allclose(info.move, expected.move, atol=1e-4)  # both to a gap of 1e-6
    np.testing.assert_allclose(info.objective, expected.objective, rtol=1e-5)


WEIGHTS = ("cv_weight", "soft_quadratic", "soft_linear", "slack_weight")


def test_with_all_cvs_off_nothing_moves_and_control_comes_back(made, well_like_model):
    for kind in ("continuous", "mixed-integer"):
        seen = lambda k, cv: np.full(2, np.nan) if 3 <= k < 8 else cv  # noqa: E731
        _, infos = closed(made(kind, bad_limit=[1, 1]), Process(well_like_model), 12, seen=seen)
        moves = column(infos, "move")
        assert not column(infos, "fallback").any()
        assert np.abs(moves[3:8]).max() < 1e-6
        assert np.abs(moves[8:]).max() > 1e-3


@pytest.mark.parametrize("kind", ["continuous", "mixed-integer"])
def test_switching_a_cv_off_compiles_nothing(made, kind):
    """A real process does not wait for it."""
    controller = made(kind, bad_limit=[1, 1])
    state, _ = stepped(controller, controller.init(*START), START[0])
    compiled = []
    listen = lambda name, seconds, **_: compiled.append(name) if "backend_compile" in name else None  # noqa: E731
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for missing in ([True, False], [False, False], [True, True]):
            state, info = stepped(controller, state, np.where(missing, np.nan, START[0]))
            assert np.asarray(info.off).tolist() == missing
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert not compiled


def test_lanes_are_judged_and_switched_each_by_itself(well_like_model, small_structure, thesis_fields):
    tuning = tuned(small_structure, thesis_fields, bad_limit=[2, 2])
    together = Controllers(small_structure, [tuning], [well_like_model], count=3)
    single = Controllers(small_structure, [tuning], [well_like_model])
    cvs = np.tile(START[0], (4, 3, 1))
    cvs[1:, 1, 0] = np.nan
    cvs[2:, 2, :] = np.nan
    state = together.init(cvs[0], np.tile(START[1], (3, 1)))
    alone = [single.init(START[0][None], START[1][None])] * 3
    for cv in cvs:
        state, info = together.step(state, cv, np.tile(SETPOINT, (3, 1)))
        for lane in range(3):
            alone[lane], own = single.step(alone[lane], cv[lane][None], SETPOINT[None])
            assert np.array_equal(info.off[lane], own.off[0])
            assert np.array_equal(info.quality[lane], own.quality[0])
            np.testing.assert_allclose(info.move[lane], own.move[0], atol=1e-3)  # programs of other shapes
    assert info.off.tolist() == [[False, False], [True, False], [True, True]]


anything = st.floats(allow_nan=True, allow_infinity=True) | st.sampled_from(
    [np.nan, np.inf, -np.inf, 1e308, -1e308, 1e12, 1e11, 5e-324, 0.0, 11000.0]
)


@pytest.mark.parametrize("kind", ["continuous", "mixed-integer"])
@settings(max_examples=25, deadline=None)
@given(cvs=st.lists(st.tuples(anything, anything), min_size=1, max_size=8))
def test_no_sequence_of_measurements_freezes_a_controller(made, kind, cvs):
    controller = made(kind, **CHOSEN)
    state = controller.init(*START)
    for cv in cvs:
        state, info = stepped(controller, state, np.array(cv))
        assert np.isfinite(np.asarray(info.mv)).all()
        assert not bool(info.fallback)
    state, info = stepped(controller, state, START[0])
    assert np.asarray(info.quality).tolist() == [GOOD, GOOD]
    assert not bool(info.fallback)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves((state.bias, state.future)))


@settings(max_examples=40, deadline=None)
@given(cvs=st.lists(anything, min_size=1, max_size=30), limit=st.integers(1, 5))
def test_counts_follow_from_the_codes_alone(cvs, limit):
    out = judged([1.0, *cvs], bad_limit=limit, frozen_limit=3)
    in_a_row = 0
    for code, off in out:
        in_a_row = 0 if code == GOOD else in_a_row + 1
        assert off == (in_a_row >= limit)


# ------------------------------------------------------------------------------------------------- faults of sensors


@pytest.fixture(scope="module")
def two_cvs():
    return Structure(("a", "b"), ("u",), prediction_horizon=2, control_horizon=1, blocks=(1,), dt=10.0)


def test_faults_begin_and_end_at_their_times(two_cvs):
    faults = [SensorFault("a", "missing", 20.0, 20.0), SensorFault("b", "spike", 0.0, size=7.0)]
    errors = fault_errors(two_cvs, 5, [*faults, SensorFault("b", "frozen", 31.0, 10.0)])
    assert np.isnan(errors[:, 0]).tolist() == [False, False, True, True, False]
    assert errors[:, 1].tolist() == [7.0, 0.0, 0.0, 0.0, np.inf]


def test_what_arrives_is_sound_or_off_or_nothing_or_what_was_there_before():
    sound, before = np.array([1.0, 2.0, 3.0, 4.0]), np.array([9.0, 9.0, 9.0, 9.0])
    got = received(sound, np.array([0.0, 5.0, np.nan, np.inf]), before)
    np.testing.assert_array_equal(got, [1.0, 7.0, np.nan, 9.0])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"cv": "c"}, r"faults\[0\]\.cv"),
        ({"kind": "lost"}, r"faults\[0\]\.kind"),
        ({"time": 50.0}, r"faults\[0\]\.time"),
        ({"time": -1.0}, r"faults\[0\]\.time"),
        ({"duration": 0.0}, r"faults\[0\]\.duration"),
        ({"size": np.nan}, r"faults\[0\]\.size"),
    ],
)
def test_faults_that_make_no_sense_are_refused(two_cvs, change, field):
    fault = dataclasses.replace(SensorFault("a", "missing", 0.0, 10.0), **change)
    with pytest.raises(InputError, match=field):
        fault_errors(two_cvs, 5, [fault])
