"""Key figures against trajectories that were worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from studies import kpi


def test_travel_is_the_sum_of_absolute_moves_from_the_position_before_the_run():
    move = kpi.moves_of(np.array([52.0, 52.0, 48.0, 50.0]), 50.0)
    np.testing.assert_allclose(move, [2.0, 0.0, -4.0, 2.0])
    assert float(kpi.travel(move)) == 8.0
    assert int(kpi.move_count(move)) == 3


def test_a_reversal_is_a_move_against_the_move_before_it_however_long_ago():
    move = np.array([2.0, 2.0, 0.0, 0.0, -2.0, 0.0, -2.0, 2.0, -2.0])
    events = np.asarray(kpi.reversal_events(move))
    assert np.flatnonzero(events).tolist() == [4, 7, 8]


def test_creeping_below_the_threshold_is_neither_a_move_nor_a_reversal():
    move = np.array([0.04, -0.04, 2.0, -0.04, 2.0, -0.06])
    assert int(kpi.move_count(move)) == 3
    assert np.flatnonzero(kpi.reversal_events(move)).tolist() == [5]


def test_reversals_are_compared_within_a_segment_only():
    move = np.array([2.0, -2.0, 2.0, -2.0, 2.0, -2.0])
    segment = np.array([-1, -1, 0, 0, 1, 1])
    events = kpi.reversal_events(move, segment=segment)
    assert np.flatnonzero(events).tolist() == [3, 5]
    assert kpi.count_by_segment(events, segment, 3).tolist() == [1, 1, 0]


def test_second_halves_start_in_the_middle_of_each_window():
    window = np.array([0, 0, 0, 0, 1, 1, 1, 1, 1])
    assert kpi.second_halves(window).tolist() == [-1, -1, 0, 0, -1, -1, 1, 1, 1]


def test_dwell_is_the_time_between_successive_moves():
    move = np.array([0.0, 2.0, 0.0, 0.0, 2.0, -2.0, 0.0])
    mean, shortest = kpi.dwell(move, dt=10.0)
    assert float(mean) == pytest.approx(20.0)  # 30 s and 10 s
    assert float(shortest) == 10.0


@pytest.mark.parametrize("move", [np.zeros(5), np.array([0.0, 2.0, 0.0])])
def test_dwell_needs_two_moves(move):
    mean, shortest = kpi.dwell(move, dt=10.0)
    assert np.isnan(float(mean))
    assert np.isnan(float(shortest))


def test_deviations_and_time_outside_the_deadzone_are_per_cv():
    setpoint = np.array([[100.0, 5.0]] * 4)
    cv = setpoint + np.array([[1.0, 0.0], [-3.0, 0.5], [2.0, 0.0], [0.0, -0.5]])
    np.testing.assert_allclose(kpi.mean_absolute_deviation(cv, setpoint), [1.5, 0.25])
    np.testing.assert_allclose(kpi.integral_absolute_error(cv, setpoint, 10.0), [60.0, 10.0])
    # exactly on the border counts as inside
    np.testing.assert_allclose(
        kpi.time_outside_deadzone(cv, setpoint, np.array([2.0, 0.4]), 10.0), [10.0, 20.0]
    )


def test_limit_violations_count_samples_beyond_the_tolerance_and_infinite_limits_never_bind():
    value = np.array([[-1.0, 9.0], [0.0, -9.0], [2.1, 1e9], [2.0, 0.0]])
    low, high = np.array([0.0, -np.inf]), np.array([2.0, np.inf])
    np.testing.assert_allclose(kpi.limit_excess(value, low, high)[:, 0], [1.0, 0.0, 0.1, 0.0], atol=1e-12)
    assert kpi.limit_violations(value, low, high).tolist() == [2, 0]
    assert kpi.limit_violations(value, low, high, np.array([0.2, 0.0])).tolist() == [1, 0]


def test_windowed_mean_takes_the_moves_before_the_run_as_zero():
    np.testing.assert_allclose(
        kpi.windowed_mean(np.array([2.0, 2.0, 0.0, -2.0, 2.0]), 3), [2 / 3, 4 / 3, 4 / 3, 0.0, 0.0]
    )
    np.testing.assert_allclose(kpi.windowed_mean(np.array([2.0, 2.0]), 5), [0.4, 0.8])


def test_a_staircase_is_openings_that_go_on_after_a_pause_above_the_limit():
    # window of 4, limit 1.2: three openings of 2 reach a mean of 1.5, then a pause, then one more
    move = np.array([2.0, 2.0, 2.0, 0.0, 0.0, 2.0, 0.0, 0.0])
    assert int(kpi.mean_move_stops(move, 4, 1.2)) == 1
    assert int(kpi.mean_move_stops(move, 4, 2.0)) == 0  # the mean never got there
    closing_between = np.array([2.0, 2.0, 2.0, -2.0, 0.0, 2.0])
    assert int(kpi.mean_move_stops(closing_between, 4, 1.2)) == 0


def test_openings_above_the_limit_look_at_the_moves_before():
    move = np.array([2.0, 2.0, 2.0, 0.0, 2.0])
    # means before each sample, window of 4: 0, 0.5, 1.0, 1.5, 1.5
    assert int(kpi.opening_above_limit(move, 4, 1.2)) == 1
    assert int(kpi.opening_above_limit(move, 4, 1.5)) == 0


def test_solve_times_and_gap():
    np.testing.assert_allclose(kpi.solve_time_statistics(np.arange(101) / 1000), [0.05, 0.099, 0.1])
    assert float(kpi.largest_gap(np.array([0.0, 1e-7]))) == 1e-7
    assert np.isinf(float(kpi.largest_gap(np.array([0.0, np.nan]))))


def test_a_batch_gives_what_each_run_gives():
    rng = np.random.default_rng(0)
    moves = 2.0 * rng.integers(-1, 2, size=(7, 50))
    segment = np.repeat([0, -1, 1, -1, 2], 10)

    def figures(move):
        event = kpi.reversal_events(move, segment=segment)
        return (
            kpi.travel(move),
            kpi.count_by_segment(event, segment, 3),
            jnp.stack(kpi.dwell(move, 10.0)),
            kpi.mean_move_stops(move, 5, 0.5),
            kpi.opening_above_limit(move, 5, 0.5),
        )

    together = jax.vmap(figures)(jnp.asarray(moves))
    for i, move in enumerate(moves):
        for batch, one in zip(together, figures(move), strict=True):
            np.testing.assert_allclose(batch[i], one)
