"""Logs of every kind on a regular grid: what is read, what is refused by column and row, and what is said of it."""

import datetime

import numpy as np
import pytest

from identify.logged import read_log
from jaxmpc.errors import InputError

COUNT = 40


def written(tmp_path, lines, name="log.csv", **kind):
    path = tmp_path / name
    path.write_text("\n".join(lines) + "\n", **kind)
    return path


def rows(times, u=None, y=None, separator=","):
    """Lines ``time, u, y``; u is 0, 1, 2, ... and y twice that where not given."""
    u = range(len(times)) if u is None else u
    y = [2 * k for k in range(len(times))] if y is None else y
    return [
        "t,u,y".replace(",", separator),
        *(separator.join(map(str, row)) for row in zip(times, u, y, strict=True)),
    ]


def test_rows_at_equal_intervals_are_kept_as_they_are(tmp_path):
    log = read_log(written(tmp_path, rows([10 * k for k in range(COUNT)])), ["u", "y"], held=["u"])
    assert (log.dt, log.starts, log.quality) == (10.0, (0,), {"u": 1.0, "y": 1.0})
    np.testing.assert_array_equal(log.times, 10.0 * np.arange(COUNT))
    np.testing.assert_array_equal(log.values["y"], 2.0 * np.arange(COUNT))


START = datetime.datetime(2024, 2, 28, 23, 59, 0)
MOMENTS = [START + datetime.timedelta(seconds=10 * k) for k in range(COUNT)]


@pytest.mark.parametrize(
    "times",
    [
        [m.isoformat() for m in MOMENTS],
        [m.isoformat(sep=" ") + "+02:00" for m in MOMENTS],
        [m.strftime("%d.%m.%Y %H:%M:%S") for m in MOMENTS],
        [m.strftime("%m/%d/%Y %I:%M:%S %p") for m in MOMENTS],
        [m.strftime("%d-%b-%y %H:%M:%S") for m in MOMENTS],
        [m.timestamp() for m in MOMENTS],
        [int(m.timestamp() * 1000) for m in MOMENTS],
        [m.strftime("%H:%M:%S") for m in MOMENTS],
        [m.strftime("%I:%M:%S.00 %p") for m in MOMENTS],
        [f"{45350 + k * 10 / 86400:.8f}" for k in range(COUNT)],
    ],
    ids=[
        *("ISO", "offset", "day first", "month first", "month by name", "epoch", "milliseconds"),
        *("time of day", "time of day in halves", "days of a spreadsheet"),
    ],
)
def test_times_are_read_in_the_usual_forms(tmp_path, times):
    log = read_log(written(tmp_path, rows(times)), ["u", "y"], held=["u"])
    assert log.dt == 10.0
    np.testing.assert_allclose(log.times, 10.0 * np.arange(COUNT), atol=1e-6)
    assert log.begin == str(times[0])


def test_a_date_and_a_time_of_day_in_two_columns_are_one_time(tmp_path):
    lines = ["date,time,u,y", *(f"{m:%d.%m.%Y},{m:%H:%M:%S},{k},{2 * k}" for k, m in enumerate(MOMENTS))]
    log = read_log(written(tmp_path, lines), ["u", "y"], held=["u"])
    np.testing.assert_array_equal(log.times, 10.0 * np.arange(COUNT))
    assert any("date and time together" in note for note in log.notes)


@pytest.mark.parametrize(("end", "mark"), [("\r", ","), ("\r\n", "\t"), ("\n", "|")])
def test_every_end_of_line_and_separator_is_read(tmp_path, end, mark):
    path = tmp_path / "log.csv"
    path.write_bytes(("\ufeff" + end.join(rows([10 * k for k in range(COUNT)], separator=mark))).encode())
    log = read_log(path, ["u", "y"], held=["u"])
    np.testing.assert_array_equal(log.values["y"], 2.0 * np.arange(COUNT))


@pytest.mark.parametrize("words", [("OFF", "ON"), ("false", "true"), ("Closed", "Open"), ("no", "YES")])
def test_a_column_of_two_words_is_zero_and_one(tmp_path, words):
    u = [words[k // 7 % 2] if k != 11 else "Bad" for k in range(COUNT)]
    log = read_log(written(tmp_path, rows([10 * k for k in range(COUNT)], u)), ["u", "y"], held=["u"])
    np.testing.assert_array_equal(log.values["u"], [k // 7 % 2 for k in range(COUNT)])
    assert any(f"u: {words[1].lower()} was taken for 1" in note for note in log.notes)
    mixed = written(tmp_path, rows([10 * k for k in range(COUNT)], [*range(COUNT - 1), words[0]]))
    with pytest.raises(InputError, match=f"column u, row {COUNT + 1}: got '{words[0]}'"):
        read_log(mixed, ["u", "y"])


def test_numbers_that_stand_for_no_value_are_missing(tmp_path):
    y = [-9999 if 10 < k < 15 else 2 + 0.1 * k for k in range(COUNT)]
    log = read_log(written(tmp_path, rows([10 * k for k in range(COUNT)], y=y)), ["u", "y"], held=["u"])
    assert np.flatnonzero(np.isnan(log.values["y"])).tolist() == [11, 12, 13, 14]
    near = [-9999 + 100 * k for k in range(COUNT)]
    assert (
        read_log(written(tmp_path, rows([10 * k for k in range(COUNT)], y=near)), ["u", "y"]).quality["y"]
        == 1
    )


def test_a_date_that_may_be_read_in_two_ways_is_refused(tmp_path):
    times = [f"01/02/2024 00:{k:02}:00" for k in range(COUNT)]
    with pytest.raises(InputError, match=r"column t, row 2: got '01/02/2024 00:00:00'.*Is the day"):
        read_log(written(tmp_path, rows(times)), ["u", "y"])


def test_semicolons_decimal_commas_units_and_a_foreign_encoding_are_read(tmp_path):
    lines = ["Zeit;Öffnung [%];y", "s;%;°C", *(f"{k};{k},5;1.0{k % 10:02},25" for k in range(COUNT))]
    path = written(tmp_path, lines, encoding="cp1252")
    log = read_log(path, ["Öffnung", "y"], held=["Öffnung"])
    np.testing.assert_array_equal(log.values["Öffnung"], np.arange(COUNT) + 0.5)
    assert log.values["y"][3] == 1003.25  # the dot parts thousands
    assert log.units == {"Öffnung": "%", "y": "°C"}


def test_words_for_no_value_are_missing_and_other_words_are_refused_by_column_and_row(tmp_path):
    y = [2.0 * k for k in range(COUNT)]
    y[5:9] = ["Bad", "", "NaN", "I/O Timeout"]
    log = read_log(written(tmp_path, rows(range(COUNT), y=y)), ["u", "y"], held=["u"])
    assert np.flatnonzero(np.isnan(log.values["y"])).tolist() == [5, 6, 7, 8]
    assert log.quality["y"] == 0.9
    y[6] = "12,5 approx"
    with pytest.raises(InputError, match=r"column y, row 8: got '12"):
        read_log(written(tmp_path, rows(range(COUNT), y=[str(v).replace(",", ".") for v in y])), ["u", "y"])


def test_a_missing_column_is_refused_with_the_nearest_name(tmp_path):
    with pytest.raises(InputError, match=r"column: got 'Y1'.*t, u, y"):
        read_log(written(tmp_path, rows(range(COUNT))), ["u", "Y1"])


def test_rows_out_of_order_and_twice_are_put_right_and_counted(tmp_path):
    times = list(range(COUNT))
    order = [0, 2, 1, *range(3, COUNT), COUNT - 1]
    y = [2 * k for k in order]
    y[-1] = 500
    log = read_log(written(tmp_path, rows([times[k] for k in order], u=order, y=y)), ["u", "y"], held=["u"])
    np.testing.assert_array_equal(log.values["u"], np.arange(COUNT))
    assert log.values["y"][-1] == 500  # the later row of the two
    assert any("go back 1 times" in note for note in log.notes)
    assert any("1 rows have a time that a later row has too" in note for note in log.notes)


def test_a_gap_parts_the_log_and_is_not_bridged(tmp_path):
    times = [*range(COUNT), *range(1000, 1000 + COUNT)]
    log = read_log(written(tmp_path, rows(times)), ["u", "y"], held=["u"])
    assert (log.starts, len(log.times)) == ((0, COUNT), 2 * COUNT)
    assert log.times[COUNT] == 1000
    assert any("1 gaps" in note for note in log.notes)


def test_an_input_is_held_for_three_samples_and_then_parts_the_log(tmp_path):
    u = [float(k) for k in range(2 * COUNT)]
    u[10], u[30:37] = "", ["Bad"] * 7
    log = read_log(written(tmp_path, rows(range(2 * COUNT), u=u)), ["u", "y"], held=["u"])
    assert log.values["u"][10] == 9
    assert np.isfinite(log.values["u"]).all()
    assert len(log.starts) == 2
    assert len(log.times) == 2 * COUNT - 4  # three of the seven are held


def test_coarser_sampling_takes_the_mean_of_cvs_and_the_last_value_of_inputs(tmp_path):
    log = read_log(written(tmp_path, rows(range(101))), ["u", "y"], 5.0, held=["u"])
    np.testing.assert_array_equal(log.values["u"], 5.0 * np.arange(21))
    np.testing.assert_allclose(log.values["y"][1:-1], 10.0 * np.arange(1, 20))  # centred, so not late
    assert any("resampled from 1 s to 5 s" in note for note in log.notes)


def test_a_cv_that_is_logged_rarely_is_missing_between_its_values(tmp_path):
    y = [2 * k if k % 5 == 0 else "" for k in range(101)]
    log = read_log(written(tmp_path, rows(range(101), y=y)), ["u", "y"], held=["u"])
    assert np.isfinite(log.values["y"]).sum() == 21


def test_spikes_and_frozen_pieces_are_taken_out_and_counted_but_steps_stay(tmp_path):
    rng = np.random.default_rng(3)
    y = np.where(np.arange(300) < 100, 0.0, 5.0) + 0.1 * rng.normal(size=300)
    y[50], y[200:240] = 99.0, y[200]
    log = read_log(written(tmp_path, rows(range(300), y=y)), ["u", "y"], held=["u"])
    gone = np.flatnonzero(np.isnan(log.values["y"]))
    assert gone.tolist() == [50, *range(200, 240)]
    assert any("1 outliers" in note for note in log.notes)
    assert any("40 frozen" in note for note in log.notes)


def test_a_piece_that_is_frozen_up_to_the_end_counts_as_missing_also_after_a_rest(tmp_path):
    y = np.random.default_rng(3).normal(size=300)
    y[:40], y[200:] = 7.0, y[200]
    log = read_log(written(tmp_path, rows(range(300), y=y)), ["u", "y"], held=["u"])
    assert np.flatnonzero(np.isnan(log.values["y"])).tolist() == list(range(200, 300))


def test_a_cv_that_is_held_between_its_values_counts_where_it_is_new(tmp_path):
    y = np.repeat(np.random.default_rng(3).normal(size=40), 10)[3:]
    log = read_log(written(tmp_path, rows(range(397), y=y)), ["u", "y"], held=["u"])
    assert np.flatnonzero(np.isfinite(log.values["y"])).tolist() == list(range(7, 397, 10))


def test_a_single_value_of_an_input_far_away_from_all_others_is_held_over(tmp_path):
    u = np.arange(300) // 20 % 3
    u[105] = 100_000
    log = read_log(written(tmp_path, rows(range(300), u=u)), ["u", "y"], held=["u"])
    assert log.values["u"].max() == 2
    assert any("u: 1 outliers" in note for note in log.notes)


@pytest.mark.parametrize("apart", [10, 7])
def test_an_hour_that_comes_twice_in_local_time_is_put_in_order(tmp_path, apart):
    moments = datetime.datetime(2024, 10, 27, 2) + datetime.timedelta(seconds=apart) * np.arange(900)
    moments[500:] -= datetime.timedelta(hours=1)
    log = read_log(written(tmp_path, rows(moments)), ["u", "y"], held=["u"])
    assert log.values["u"].tolist() == list(range(900))
    assert any("set back by an hour" in note for note in log.notes)


def test_an_hour_that_is_in_a_file_twice_is_taken_once(tmp_path):
    moments = datetime.datetime(2024, 10, 27, 2) + datetime.timedelta(seconds=10) * np.arange(900)
    own = [*range(500), *range(140, 900)]  # row 140 is an hour before 500
    log = read_log(written(tmp_path, rows(moments[own], own, own)), ["u", "y"], held=["u"])
    assert log.values["u"].tolist() == list(range(900))


def test_lines_above_the_names_are_passed_over_and_counted(tmp_path):
    lines = ["Export of the historian", "", *rows(range(COUNT))]
    log = read_log(written(tmp_path, lines), ["u", "y"], held=["u"])
    assert log.values["u"].tolist() == list(range(COUNT))
    lines[10] = "8,off,1"
    with pytest.raises(InputError, match="column u, row 11: got 'off'"):
        read_log(written(tmp_path, lines), ["u", "y"])


def test_times_that_stand_still_are_refused(tmp_path):
    with pytest.raises(InputError, match="date and time are two columns"):
        read_log(written(tmp_path, rows(["2024-03-01"] * COUNT)), ["u", "y"])


def test_a_file_without_times_needs_the_interval(tmp_path):
    lines = ["u,y", *(f"{k},{2 * k}" for k in range(COUNT))]
    path = written(tmp_path, lines)
    with pytest.raises(InputError, match="--dt"):
        read_log(path, ["u", "y"])
    assert read_log(path, ["u", "y"], 4.0).times[1] == 4.0


@pytest.mark.parametrize("zone", [None, "Europe/Oslo"])
def test_parquet_and_csv_are_read_alike(tmp_path, zone):
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    y = [None if k == 7 else 2.0 * k for k in range(COUNT)]
    when = pyarrow.array(MOMENTS, pyarrow.timestamp("us", zone))  # last, as pandas writes an index
    table = pyarrow.table({"u": list(range(COUNT)), "y": y, "__index_level_0__": when})
    parquet.write_table(table, tmp_path / "log.parquet")
    log = read_log(tmp_path / "log.parquet", ["u", "y"], held=["u"])
    assert log.dt == 10.0
    assert np.flatnonzero(np.isnan(log.values["y"])).tolist() == [7]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([""], "empty"),
        (["t,u,y"], "rows of values"),
        (rows(range(5)), "at least 20 samples"),
        (["t,u,y", "0,1"], "row 2"),
        (rows(range(COUNT), y=["Bad"] * COUNT), "no value in any row"),
        (rows(["noon"] * COUNT), "column t, row 2: got 'noon'"),
        (["t,u,y,y", *(["0,1,2,3"] * COUNT)], "a name that one column has"),
    ],
)
def test_what_is_no_log_is_refused_by_name(tmp_path, lines, message):
    with pytest.raises(InputError, match=message):
        read_log(written(tmp_path, lines), ["u", "y"])


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        read_log(tmp_path / "nowhere.csv", ["u"])
