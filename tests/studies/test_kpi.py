"""Key figures against trajectories that were worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from studies.kpi import loop as kpi
from studies.kpi import setpoint as kpi_setpoint


def test_travel_is_the_sum_of_absolute_moves_from_the_position_before_the_run():
    move = kpi.moves_of(np.array([52.0, 52.0, 48.0, 50.0]), 50.0)
    np.testing.assert_allclose(move, [2.0, 0.0, -4.0, 2.0])
    assert float(kpi.travel(move)) == 8.0
    assert int(kpi.move_count(move, 0.05)) == 3


def test_a_reversal_is_a_move_against_the_move_before_it_however_long_ago():
    move = np.array([2.0, 2.0, 0.0, 0.0, -2.0, 0.0, -2.0, 2.0, -2.0])
    events = np.asarray(kpi.reversal_events(move))
    assert np.flatnonzero(events).tolist() == [4, 7, 8]


def test_creeping_below_the_threshold_is_neither_a_move_nor_a_reversal():
    move = np.array([0.04, -0.04, 2.0, -0.04, 2.0, -0.06])
    assert int(kpi.move_count(move, 0.05)) == 3
    assert np.flatnonzero(kpi.reversal_events(move, 0.05)).tolist() == [5]


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
    assert int(kpi.rises_above_limit(move, 4, 1.2)) == 1
    assert int(kpi.rises_above_limit(move, 4, 1.5)) == 0


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
            kpi.rises_above_limit(move, 5, 0.5),
        )

    together = jax.vmap(figures)(jnp.asarray(moves))
    for i, move in enumerate(moves):
        for batch, one in zip(together, figures(move), strict=True):
            np.testing.assert_allclose(batch[i], one)


def test_the_largest_excess_ignores_what_the_violations_do_not_count():
    value = np.array([[-1.0, 9.0], [0.0, -9.0], [2.1, 1e9], [2.0, 0.0]])
    low, high = np.array([0.0, -np.inf]), np.array([2.0, np.inf])
    assert kpi.largest_excess(value, low, high).tolist() == [1.0, 0.0]
    assert kpi.largest_excess(value, low, high, np.array([1.0, 0.0])).tolist() == [0.0, 0.0]


def test_a_volume_is_a_rate_per_hour_times_the_seconds_that_it_holds():
    assert float(kpi.integral(np.array([3600.0, 0.0, 7200.0]), 10.0, 3600.0)) == pytest.approx(30.0)


def test_the_closed_loop_cost_adds_tracking_soft_and_move_cost_per_sample():
    setpoint = np.zeros((2, 2))
    cv, move = np.array([[3.0, 0.0], [-1.0, 2.0]]), np.array([[2.0], [0.0]])
    weights = dict(
        cv_weight=np.array([1.0, 10.0]),
        soft_quadratic=np.array([5.0, 0.0]),
        soft_linear=np.array([7.0, 1.0]),
        deadzone=np.array([1.0, 1.5]),
        move_weight=np.array([100.0]),
    )
    # sample 0: 9 + 5 * 2^2 + 7 * 2 + 100 * 2^2; sample 1: 1 + 10 * 2^2 + 1 * 0.5
    expected = (9 + 20 + 14 + 400 + 1 + 40 + 0.5) / 2
    assert float(kpi.closed_loop_cost(cv, setpoint, move, **weights)) == pytest.approx(expected)


@pytest.mark.parametrize("samples", [1, 2, 3, 150])
def test_solve_times_are_interpolated_like_percentiles(samples):
    times = np.random.default_rng(samples).exponential(size=samples)
    np.testing.assert_allclose(kpi.solve_time_statistics(times), np.percentile(times, [50, 99, 100]))


def test_a_missing_solve_time_leaves_no_statistics():
    assert np.isnan(kpi.solve_time_statistics(np.array([1.0, np.nan, 2.0]))).all()
    assert np.isnan(kpi.solve_time_statistics(np.array([1.0, -np.nan, 2.0]))).all()


# what follows a setpoint change


def settled(cv, setpoint, window, tolerance, dt=10.0):
    bounds = kpi_setpoint.window_bounds(window)
    change = kpi_setpoint.setpoint_change(cv, setpoint, tolerance, bounds[0])
    return kpi_setpoint.settling(cv, setpoint, change, tolerance, bounds, dt), change


def column(*values):
    return np.array(values, dtype=float)[:, None]


def test_window_bounds_are_the_first_and_last_sample_of_equal_labels():
    start, end = kpi_setpoint.window_bounds(np.array([3, 3, 5, 5, 5, 3]))
    assert start.tolist() == [0, 0, 2, 2, 2, 5]
    assert end.tolist() == [1, 1, 4, 4, 4, 5]


@pytest.mark.parametrize("lengths", [(4, 5), (1,), (1, 2, 3), (7, 1)])
def test_late_segments_are_the_second_halves(lengths):
    window = np.repeat(np.arange(len(lengths)), lengths)
    start, end = kpi_setpoint.window_bounds(window)
    late = np.asarray(kpi_setpoint.late_segment(start, end))
    expected = kpi.second_halves(window)
    assert (late >= 0).tolist() == (expected >= 0).tolist()
    assert late[late >= 0].tolist() == np.asarray(start)[expected >= 0].tolist()


def test_the_first_window_counts_as_a_change_only_from_beyond_the_tolerance():
    setpoint, window, tolerance = column(5, 5, 9, 9), np.array([0, 0, 1, 1]), np.array([2.0])
    far, near = column(2.0, 4.0, 9.0, 9.0), column(3.0, 4.0, 9.0, 9.0)
    assert settled(far, setpoint, window, tolerance)[1].ravel().tolist() == [3.0, 3.0, 4.0, 4.0]
    assert settled(near, setpoint, window, tolerance)[1].ravel().tolist() == [0.0, 0.0, 4.0, 4.0]
    assert settled(far, setpoint, window, tolerance)[0].changes.tolist() == [2]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_overshoot_is_beyond_the_new_setpoint_in_the_direction_of_the_change(sign):
    setpoint = sign * column(0, 0, 10, 10, 10, 8, 8, 8)
    window = np.array([0, 0, 1, 1, 1, 2, 2, 2])
    # up by 10: 1.5 beyond; then back by 2: the 3 above the setpoint do not count, the 0.5 below do
    cv = sign * column(0, 4, 4, 11.5, 10, 11, 7.5, 8)
    change = settled(cv, setpoint, window, np.array([1.0]))[1]
    assert float(kpi_setpoint.overshoot(cv, setpoint, change)[0]) == pytest.approx(1.5)
    assert float(kpi_setpoint.overshoot(cv[5:], setpoint[5:], change[5:])[0]) == pytest.approx(0.5)


def test_a_response_that_never_crosses_the_setpoint_has_no_overshoot():
    setpoint, cv = column(0, 10, 10, 10), column(0, 0, 5, 9.9)
    change = settled(cv, setpoint, np.array([0, 1, 1, 1]), np.array([1.0]))[1]
    assert kpi_setpoint.overshoot(cv, setpoint, change).tolist() == [0.0]


def test_settling_lasts_until_the_last_sample_outside():
    setpoint = column(0, 0, 10, 10, 10, 10, 10)
    window = np.array([0, 0, 1, 1, 1, 1, 1])
    cv = column(0, 3, 0, 10, 7, 9, 11)  # inside, outside again, then inside on the border
    found, _ = settled(cv, setpoint, window, np.array([1.0]))
    assert (found.changes.tolist(), found.unsettled.tolist()) == ([1], [0])
    assert (found.mean.tolist(), found.longest.tolist()) == ([30.0], [30.0])


def test_a_window_that_ends_outside_settles_in_its_length_and_is_counted():
    setpoint = column(0, 10, 10, 10, 20, 20)
    window = np.array([0, 1, 1, 1, 2, 2])
    cv = column(0, 10, 10, 7, 19.5, 20)  # unsettled after 30 s; then inside at once
    found, _ = settled(cv, setpoint, window, np.array([1.0]))
    assert (found.changes.tolist(), found.unsettled.tolist()) == ([2], [1])
    assert (found.mean.tolist(), found.longest.tolist()) == ([15.0], [30.0])


def test_a_missing_measurement_is_never_settled():
    setpoint = column(0, 10, 10, 10)
    found, _ = settled(column(0, 10, 10, np.nan), setpoint, np.array([0, 1, 1, 1]), np.array([1.0]))
    assert found.unsettled.tolist() == [1]
    assert found.longest.tolist() == [30.0]


def test_without_a_setpoint_change_there_is_nothing_to_settle_or_overshoot():
    cv = column(1, 0, 1, 5)
    found, change = settled(cv, np.zeros((4, 1)), np.array([0, 0, 1, 1]), np.array([1.0]))
    assert (found.changes.tolist(), found.unsettled.tolist()) == ([0], [0])
    assert np.isnan(
        [found.mean[0], found.longest[0], kpi_setpoint.overshoot(cv, np.zeros((4, 1)), change)[0]]
    ).all()
