"""Figures: drawn from stored results only, both formats, the same style for the same controller."""

import matplotlib
import numpy as np
import pytest

from figures import panels, registry, style
from figures.thesis import runs
from jaxmpc.errors import InputError
from studies.store.reading import open_results
from tests import studies_synthetic as made


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return made.stored(tmp_path_factory.mktemp("made-up"))


def test_every_thesis_figure_is_drawn_as_png_and_pdf(results):
    paths = registry.draw_study(results, "thesis")
    names = {path.name for path in paths}
    for number in [10, 11, *range(14, 25)]:
        for kind in ("png", "pdf"):
            assert any(n.startswith(f"figure_{number}_") and n.endswith(kind) for n in names), (number, kind)
    assert {"summary.png", "summary.pdf"} <= names
    assert all(path.stat().st_size > 1000 for path in paths)
    assert matplotlib.get_backend().lower() == "agg"


def test_drawing_again_gives_the_same_bytes(results, tmp_path):
    for folder in ("one", "two"):
        registry.draw(["15"], results, tmp_path / folder)
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


def test_an_unknown_figure_is_refused_before_anything_is_drawn(results, tmp_path):
    with pytest.raises(InputError, match="figure: got '99'"):
        registry.draw(["10", "99"], results, tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_figure_of_a_run_that_is_not_finished_is_refused(tmp_path):
    made.write(made.begin(tmp_path), "step-choke", made.trajectory("hunting"))
    with pytest.raises(InputError, match="mixed-integer"):
        registry.draw(["17", "22"], tmp_path, tmp_path / "figures")
    assert not (tmp_path / "figures").exists()
    assert len(registry.draw(["17"], tmp_path, tmp_path / "figures")) == 2


def test_a_controller_has_one_colour_and_the_setpoint_is_dashed(results):
    data = open_results(results)
    for panel in (runs.rates, runs.inputs, runs.bias):
        for name in made.RUNS:
            drawn = panel(data, name)
            for axes in drawn.axes:
                assert "[" in axes.get_ylabel()
                assert any(line.get_color() == panels.run_colour(data, name) for line in axes.lines)
            assert "[" in drawn.axes[-1].get_xlabel()
    drawn = runs.rates(data, "step-choke")
    setpoint = [line for line in drawn.axes[0].lines if line.get_label() == "setpoint"]
    assert [line.get_linestyle() for line in setpoint] == ["--"]
    assert drawn.axes[0].collections  # the deadzone
    assert len({panels.run_colour(data, name) for name in made.RUNS}) == 3


def test_there_is_no_band_without_soft_mpc(results):
    data = open_results(results).load()
    hard = data.assign(
        tuning_soft_quadratic=0 * data.tuning_soft_quadratic, tuning_soft_linear=0 * data.tuning_soft_linear
    )
    assert not runs.rates(hard, "step-choke").axes[0].collections


def test_the_close_up_is_the_window_with_most_reversals_below_half_open(results):
    data = open_results(results).load()
    start, end = runs.oscillating_stretch(data, "step-choke")
    assert (
        1000.0 <= start < end <= 2000.0
    )  # the second half of the first window hunts as much as the last: first wins
    late = data.assign(position=data.position.copy(deep=True))
    in_first = data.time.values < 2000
    late.position.loc[{"time": data.time[in_first], "mv": "choke"}] = 40.0
    start, end = runs.oscillating_stretch(late, "step-choke")
    assert 3000.0 <= start < end <= 4000.0


def test_a_close_up_of_a_quiet_run_is_refused(results):
    with pytest.raises(InputError, match="reverses below"):
        runs.oscillating_stretch(open_results(results), "mixed-integer")


def test_figures_need_not_be_closed():
    import matplotlib.pyplot as plt

    before = plt.get_fignums()
    _, axes = style.figure(2)
    assert len(axes) == 2
    assert plt.get_fignums() == before


def test_units_are_printed_as_readers_know_them():
    assert style.label("oil rate", "m3/h") == "oil rate [m³/h]"
    assert np.all([len(colour) == 7 for colour in style.CONTROLLER_COLOURS.values()])
