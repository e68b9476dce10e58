"""Models from logged data: exact without noise, bands that hold what they promise, and a no where the data cannot tell."""

import dataclasses

import numpy as np
import pytest

from figures.identification import write_page
from identify.logged import fit as fit_module
from identify.logged import identify_log
from identify.logged.fit import bands, chosen, fitted, make_data, search, simulated
from identify.logged.kernel import Posterior, estimate, factors
from identify.logged.low_order import low_order
from identify.logged.noise import WALK, Noise, likeliest, whitened
from identify.logged.regression import Segment, sums
from jaxmpc.cli import main as cli
from jaxmpc.errors import InputError
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.model.transfer_function import TransferFunction

COUNT, LENGTH = 900, 60  # samples; N: all fits of this file are of the sizes of two or three programs
FIRST = TransferFunction(2.0, (5.0, 3.0), 4.0)
SECOND = TransferFunction(-1.0, (6.0,), 0.0)
INVERSE = TransferFunction(1.5, (3.0, 3.0), 2.0, lead=-3.0)
NOTHING = TransferFunction(0.0, (1.0,))
INTEGRATING = TransferFunction(0.05, (np.inf, 4.0), 3.0)


def coefficients(function, count=LENGTH):
    return function.step_response(np.arange(1.0, count + 1))


def response(function, u):
    """What an input does to a CV from rest, the plain sum over all its moves."""
    impulse = np.diff(coefficients(function, len(u)), prepend=0.0)
    return np.convolve(np.append(0.0, u - u[0]), impulse)[: len(u)]


def held(rng, hold, count=COUNT):
    """A new random level every so many samples."""
    return np.repeat(rng.normal(size=count // hold + 1), hold)[:count]


@pytest.fixture
def moves():
    rng = np.random.default_rng(5)
    return np.stack([held(rng, hold) for hold in (12, 17)], axis=1)


def log_file(path, u, y, first=("a", "b"), then=("y",)):
    """A CSV file with one row per second."""
    names = ",".join(["t", *first[: u.shape[1]], *then])
    table = np.column_stack([np.arange(len(u)), u, y])
    np.savetxt(path, table, delimiter=",", header=names, comments="", fmt="%.17g")
    return path


def verdicts(found):
    return {(row.cv, row.input): row.verdict for row in found.verdicts}


def test_responses_are_exact_without_noise(tmp_path, moves):
    truth = [[FIRST, SECOND], [INVERSE, NOTHING]]
    y = np.stack([sum(response(f, u) for f, u in zip(row, moves.T, strict=True)) for row in truth], axis=1)
    path = log_file(tmp_path / "log.csv", moves + 50, y + np.array([80.0, 3.0]), then=("y", "z"))
    found = identify_log(path, ["a"], ["y", "z"], ["b"], samples=LENGTH)
    exact = np.array([[coefficients(f) for f in row] for row in truth])
    # 0.5 % of the largest coefficient; what the plant still does after N samples is 5e-5 of it
    limit = 0.005 * np.abs(exact).max(axis=2, keepdims=True) + 1e-3
    assert (np.abs(found.responses - exact) < limit).all()
    assert verdicts(found) == {("y", "a"): "good", ("y", "b"): "good", ("z", "a"): "good", ("z", "b"): "none"}
    assert (found.model.mv_names, found.model.dv_names, found.model.dt) == (("a",), ("b",), 1.0)
    assert [tuple(row) for row in dict(found.model.provenance)["verdicts"]] == [
        tuple(v) for v in found.verdicts
    ]
    assert not found.responses[1, 1].any()
    (record,) = found.records
    assert record.used.sum() == round(0.73 * COUNT)
    np.testing.assert_allclose(record.predicted, record.measured, atol=0.05)


def test_n_is_chosen_longer_than_the_slowest_response(tmp_path, moves):
    y = response(FIRST, moves[:, 0]) + response(SECOND, moves[:, 1])
    found = identify_log(log_file(tmp_path / "log.csv", moves, y), ["a", "b"], ["y"])
    assert 30 <= found.model.samples <= 80  # 99.5 % of the gains are there after 32 and 33 samples
    assert np.abs(found.responses[0, 0] - coefficients(FIRST, found.model.samples)).max() < 0.01
    assert any(note.startswith("N = ") for note in found.notes)


def test_the_posterior_is_that_of_conditioning_all_data_at_once():
    rng = np.random.default_rng(0)
    length = 12
    u = [held(rng, 3, count) for count in (40, 55)]
    y = [np.cumsum(part) * 0.2 + rng.normal(size=len(part)) for part in u]
    y[1][[7, 20, 21]] = np.nan
    parameters = np.array([[0.4, np.log(4.0), np.log(9.0)]])
    noise = Noise(0.9, 0.5)
    data = sums([Segment((a - a[0])[:, None], b) for a, b in zip(u, y, strict=True)], length, noise)
    found = estimate(data, parameters, 0)
    # dense: y = X g + offsets + v, covariances of all measurements written down
    lag = np.arange(1, length + 1)
    prior = np.exp(0.4 - (lag[:, None] + lag) / 8.0 - np.abs(lag[:, None] - lag) / 9.0)
    known = [np.isfinite(part) for part in y]
    x = np.concatenate(
        [
            np.array([[a[max(t - k, 0)] - a[0] for k in lag] for t in range(len(a))])[keep]
            for a, keep in zip(u, known, strict=True)
        ]
    )
    which = np.repeat([0, 1], [keep.sum() for keep in known])
    at = np.concatenate([np.flatnonzero(keep) for keep in known])
    same = which[:, None] == which
    drift = 0.5 / (1 - 0.81) * 0.9 ** np.abs(at[:, None] - at)
    cover = np.where(same, drift + 1e8, 0.0) + np.eye(len(at)) + x @ prior @ x.T
    gain = np.linalg.solve(cover, x @ prior).T
    measured = np.concatenate([part[keep] for part, keep in zip(y, known, strict=True)])
    # offsets have the prior variance 1e8, of which a solution of that condition keeps seven digits
    np.testing.assert_allclose(found.mean[0], gain @ measured, rtol=1e-4, atol=1e-6)
    posterior = prior - gain @ x @ prior
    np.testing.assert_allclose(
        found.root[0] @ found.root[0].T / found.variance, posterior, rtol=1e-3, atol=1e-6
    )
    sign, logdet = np.linalg.slogdet(cover)
    assert sign == 1
    square = measured @ np.linalg.solve(cover, measured)
    expected = logdet + len(at) * np.log(square / len(at))
    assert found.score == pytest.approx(expected, abs=1e-3)


def test_the_factor_of_a_kernel_is_that_of_its_covariance():
    low = np.asarray(factors(np.array([[0.5, np.log(3.0), np.log(7.0)]]), np.arange(9.0)))[0]
    lag = np.arange(1, 10)
    covariance = np.exp(0.5 - (lag[:, None] + lag) / 6.0 - np.abs(lag[:, None] - lag) / 7.0)
    np.testing.assert_allclose(low @ low.T, covariance, rtol=1e-12)


def test_whitened_noise_is_white_also_where_measurements_are_missing():
    rng = np.random.default_rng(2)
    noise = Noise(0.95, 0.3)
    x = np.zeros(20000)
    steps = np.sqrt(0.3) * rng.normal(size=len(x))
    for t in range(1, len(x)):
        x[t] = 0.95 * x[t - 1] + steps[t]
    v = x + rng.normal(size=len(x))
    known = rng.random(len(x)) > 0.2
    blocks = (v[k : k + 3000, None] for k in range(0, len(v), 3000))
    white = np.concatenate([rows for rows, _ in whitened(noise, blocks, known)])[:, 0]
    assert white.var() == pytest.approx(1.0, abs=0.05)  # three standard deviations of a variance of 16,000
    assert abs(np.mean(white[1:] * white[:-1])) < 0.03
    found = likeliest([np.where(known, v, np.nan)])
    assert found.phi in (0.9, 0.95, 0.98)
    assert found.drift == pytest.approx(0.3, rel=0.7)  # the next candidates are 3.2 times as far


@pytest.mark.parametrize("kind", ["white", "drift"])
def test_bands_hold_the_true_coefficients_as_often_as_they_promise(kind):
    inside = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        truth = [
            TransferFunction(
                rng.uniform(0.5, 2),
                tuple(rng.uniform(1, 5, 2)),
                float(rng.integers(0, 6)),
                rng.uniform(-3, 3),
            )
            for _ in range(2)
        ]
        u = np.stack([held(rng, hold) for hold in (12, 17)], axis=1)
        y = sum(response(f, signal) for f, signal in zip(truth, u.T, strict=True)) + 0.5 * rng.normal(
            size=COUNT
        )
        if kind == "drift":
            y = y + 0.1 * rng.normal(size=COUNT).cumsum()
        data = make_data(y, u, [slice(0, COUNT)])
        fit = search(data, LENGTH)
        exact = np.array([coefficients(f) for f in truth])
        inside.append((np.abs(fit.steps(data) - exact) <= bands(data, fit)).mean())
    # coefficients of a pair go together: 24 pairs are some 60 independent ones, of which 95 % have 3 % as their deviation
    assert 0.88 <= np.mean(inside) <= 1.0


def test_drift_does_not_bias_and_is_named(tmp_path, moves):
    rng = np.random.default_rng(7)
    y = response(FIRST, moves[:, 0]) + response(SECOND, moves[:, 1])
    y = y + 0.15 * rng.normal(size=COUNT).cumsum() + 0.05 * rng.normal(size=COUNT)
    found = identify_log(log_file(tmp_path / "log.csv", moves, y), ["a", "b"], ["y"], samples=LENGTH)
    exact = np.array([[coefficients(FIRST), coefficients(SECOND)]])
    assert (np.abs(found.responses - exact) < 2 * found.bands).all()
    assert any("random walk" in note or "drifting" in note for note in found.notes)


def test_segments_that_begin_in_motion_do_not_bias(moves):
    y = response(FIRST, moves[:, 0]) + response(SECOND, moves[:, 1])
    cut = [slice(0, 300), slice(300, 600)]  # the second begins in the middle of what the first did
    data = make_data(y[250:850], moves[250:850], cut)
    fit = search(data, LENGTH)
    assert fit.free is not None
    np.testing.assert_allclose(fit.steps(data), [coefficients(FIRST), coefficients(SECOND)], atol=0.02)
    np.testing.assert_allclose(simulated(data, fit, 600)[360:], data.output[360:], atol=0.1)


def test_a_cv_that_integrates_is_named_with_its_slope(tmp_path, moves):
    y = response(INTEGRATING, moves[:, 0]) + response(SECOND, moves[:, 1])
    found = identify_log(log_file(tmp_path / "log.csv", moves, y), ["a", "b"], ["y"], samples=LENGTH)
    assert verdicts(found) == {("y", "a"): "look", ("y", "b"): "good"}
    assert "integrates: still rises by 0.05" in found.verdicts[0].says
    exact = np.array([[coefficients(INTEGRATING), coefficients(SECOND)]])
    assert (np.abs(found.responses - exact) < 0.005 * np.abs(exact).max(axis=2, keepdims=True)).all()
    (low,) = found.alternatives.values()
    np.testing.assert_allclose(low[0, 0], exact[0, 0], atol=0.02)


def test_what_the_data_cannot_tell_is_not_said_to_be_nothing(tmp_path, moves):
    rng = np.random.default_rng(1)
    u = np.column_stack([moves, 50 + 0.01 * held(rng, 9), np.full(COUNT, 7.0)])
    y = response(FIRST, u[:, 0]) + response(SECOND, u[:, 2]) + 0.2 * rng.normal(size=COUNT)
    path = log_file(tmp_path / "log.csv", u, y, first=("a", "b", "small", "still"))
    found = identify_log(path, ["a", "b", "small", "still"], ["y"], samples=LENGTH)
    says = {row.input: (row.verdict, row.says) for row in found.verdicts}
    assert {name: verdict for name, (verdict, _) in says.items()} == {
        "a": "good",
        "b": "none",
        "small": "bad",
        "still": "bad",
    }
    assert "tells nothing of larger moves" in says["small"][1]
    assert "never moves" in says["still"][1]
    assert np.isnan(found.bands[0, 3]).all()
    assert found.advice[0].startswith("Step small, still")
    assert "never moves" in write_page(found, tmp_path / "page.html").read_text()


def test_inputs_that_move_together_are_refused(tmp_path, moves):
    u = np.column_stack([moves[:, 0], 3 * moves[:, 0] + 1])
    path = log_file(tmp_path / "log.csv", u, response(FIRST, u[:, 0]))
    with pytest.raises(InputError, match=r"a moves like b .* cannot tell which"):
        identify_log(path, ["a", "b"], ["y"], samples=LENGTH)


def test_a_response_that_noise_hides_is_refused(tmp_path, moves):
    y = response(FIRST, moves[:, 0]) + 300 * np.random.default_rng(4).normal(size=COUNT)
    path = log_file(tmp_path / "log.csv", moves[:, :1], y)
    with pytest.raises(InputError, match="cannot tell: "):
        identify_log(path, ["a"], ["y"], samples=LENGTH)


def test_a_loop_that_was_closed_is_recognised(tmp_path):
    rng = np.random.default_rng(6)
    impulse = np.diff(coefficients(FIRST, 200), prepend=0.0)
    drift, target = 0.15 * rng.normal(size=COUNT).cumsum(), 3 * held(rng, 90)
    u, y, total = np.zeros(COUNT), np.zeros(COUNT), 0.0
    for t in range(COUNT):
        past = min(t, 200)
        y[t] = drift[t] + (impulse[:past] @ u[t - past : t][::-1] if past else 0.0)
        total += 0.0075 * (target[t] - y[t])
        u[t] = 0.15 * (target[t] - y[t]) + total
    found = identify_log(log_file(tmp_path / "log.csv", u[:, None], y), ["a"], ["y"], samples=LENGTH)
    assert verdicts(found) == {("y", "a"): "look"}
    assert any("closed the loop" in note for note in found.notes)


def test_an_input_that_a_controller_moves_by_the_disturbance_alone_tells_nothing(tmp_path):
    rng = np.random.default_rng(2)
    drift, noise = 0.05 * rng.normal(size=COUNT).cumsum(), 0.05 * rng.normal(size=COUNT)
    u, y, x, total = np.zeros(COUNT), drift + noise, 0.0, 0.0
    for t in range(COUNT):
        y[t] += x
        total -= 0.02 * y[t]
        u[t] = total - 0.3 * y[t]
        x += (1.2 * u[t] - x) / 6
    with pytest.raises(InputError, match="feedback"):
        identify_log(log_file(tmp_path / "log.csv", u[:, None], y), ["a"], ["y"], samples=LENGTH)


def test_a_large_transient_does_not_make_a_response_of_nothing(tmp_path, moves):
    y = response(FIRST, moves[:, 0]) + response(SECOND, moves[:, 1])
    y[:20] += 5000
    with pytest.raises(InputError, match="cannot tell"):
        identify_log(log_file(tmp_path / "log.csv", moves, y), ["a", "b"], ["y"], samples=LENGTH)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mv": ()}, "--mv"),
        ({"samples": 0}, "--samples"),
        ({"samples": COUNT}, "--samples"),
        ({"dt": -1.0}, "--dt"),
        ({"cv": ["c"]}, "column y|column c|c"),
    ],
)
def test_bad_options_are_refused_by_name(tmp_path, moves, change, message):
    path = log_file(tmp_path / "log.csv", moves, moves[:, 0])
    given = {"mv": ["a", "b"], "cv": ["y"], **change}
    with pytest.raises(InputError, match=message):
        identify_log(path, **given)


def test_a_first_order_with_dead_time_is_found_in_its_own_response():
    exact = TransferFunction(3.0, (7.0,), 5.5)
    found = low_order(coefficients(exact), np.zeros(LENGTH))
    assert (found.gain, found.lag, found.dead_time) == pytest.approx((3.0, 7.0, 5.5), rel=0.01)
    assert not found.integrating


def test_the_evidence_of_a_fit_does_not_depend_on_the_order_of_its_inputs(moves):
    y = response(FIRST, moves[:, 0]) + response(SECOND, moves[:, 1])
    y = y + 0.3 * np.random.default_rng(8).normal(size=COUNT)
    start = search(make_data(y, moves, [slice(0, COUNT)]), LENGTH)
    turned = Posterior(*(np.zeros(0),) * 2, 1.0, 0.0, start.posterior.parameters[::-1])
    swapped = dataclasses.replace(start, posterior=turned)
    other = fitted(make_data(y, moves[:, ::-1], [slice(0, COUNT)]), LENGTH, swapped, 0)
    assert other.posterior.score == pytest.approx(start.posterior.score, rel=1e-9)


def test_unseen_samples_overrule_a_likely_fit_that_foresees_them_far_worse(moves, monkeypatch):
    y = response(FIRST, moves[:, 0]) + 0.1 * np.random.default_rng(4).normal(size=COUNT)
    data, cut = make_data(y, moves[:, :1], [slice(0, COUNT)]), round(0.73 * COUNT)
    right, overruled = chosen(data, LENGTH, cut)
    assert not overruled
    posterior = dataclasses.replace(right.posterior, mean=-right.posterior.mean)
    wrong = dataclasses.replace(
        right, posterior=posterior, noise=WALK
    )  # as one sample ahead may make it look
    monkeypatch.setattr(fit_module, "search", lambda *_: wrong)
    found, overruled = chosen(data, LENGTH, cut)
    assert overruled
    np.testing.assert_allclose(found.steps(data)[0], coefficients(FIRST), atol=0.1)


def test_the_command_writes_a_model_and_a_page_and_refuses_what_is_for_fmus(tmp_path, moves, capsys):
    rng = np.random.default_rng(9)
    y = response(FIRST, moves[:, 0]) + response(SECOND, moves[:, 1]) + 0.1 * rng.normal(size=COUNT)
    path, out = log_file(tmp_path / "log.csv", moves, y), tmp_path / "made.json"
    words = ["identify", str(path), "--mv", "a", "--dv", "b", "--cv", "y", "--samples", str(LENGTH)]
    assert cli.main([*words, "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "good" in shown
    assert f"Next: jaxmpc process new --model {out}" in shown
    model = StepResponseModel.load(out)
    assert (model.mv_names, model.dv_names, model.samples) == (("a",), ("b",), LENGTH)
    assert hash(model.provenance)  # programs know it
    assert "<html" in out.with_suffix(".html").read_text()
    out.unlink()
    for wrong in (["--settle", "10"], ["--mv", "c=3"], ["--dt", "-1"]):
        assert cli.main([*words, *wrong, "--out", str(out)]) == 2
        assert wrong[0] in capsys.readouterr().err
    assert not out.exists()


PROCESS = """
name = "own"
dt = 1
cv = [{ name = "level", unit = "m", tag = "y" }]
mv = [{ name = "valve", unit = "%", tag = "a", low = 0, high = 100 }]
disturbance = [{ name = "feed", unit = "t/h", tag = "b" }]

[model]
samples = 20
working_point = { level = 2, valve = 50 }
transfer_functions = [{ cv = "level", mv = "valve", gain = 1, time_constants = [3] }]

[structure]
prediction_horizon = 16
control_horizon = 4
blocks = [1, 1, 2]

[presets.default]
cv_weight = { level = 1 }
move_weight = { valve = 0.001 }

[references.day]
duration = 1500
windows = [[0, 2]]
"""


def test_the_command_takes_names_and_tags_of_a_process(tmp_path, moves):
    y = response(FIRST, moves[:, 0]) + response(SECOND, moves[:, 1])
    y = y + 0.1 * np.random.default_rng(9).normal(size=COUNT)
    path, out = log_file(tmp_path / "log.csv", moves, y), tmp_path / "made.json"
    process = tmp_path / "own.toml"
    process.write_text(PROCESS)
    words = ["identify", str(path), "--process", str(process), "--dv", "b", "--samples", str(LENGTH)]
    assert cli.main([*words, "--out", str(out)]) == 0
    model = StepResponseModel.load(out)
    assert (model.cv_names, model.mv_names, model.dv_names) == (("level",), ("valve",), ("feed",))
    assert (model.cv_units, model.mv_units, model.dv_units) == (("m",), ("%",), ("t/h",))


def test_a_response_longer_than_can_be_fitted_is_sampled_more_coarsely(tmp_path):
    rng = np.random.default_rng(3)
    u = np.repeat(rng.normal(size=12), 500)
    y, x = np.zeros(len(u)), 0.0
    for k in range(len(u)):
        y[k] = x
        x += (2 * u[k] - x) / 200
    path = log_file(tmp_path / "log.csv", u[:, None], y + 0.02 * rng.normal(size=len(u)))
    found = identify_log(path, ["a"], ["y"])
    dt = found.model.dt
    exact = 2 * (1 - np.exp(-dt * np.arange(1, found.model.samples + 1) / 200))
    assert dt > 1
    assert found.verdicts[0].verdict == "good"
    assert np.abs(found.responses[0, 0] - exact).max() < found.bands[0, 0].max() < 0.15
    assert any("were made one" in note for note in found.notes)


def test_a_cv_with_hardly_any_value_is_refused(tmp_path, moves):
    y = np.where(np.arange(COUNT) % 100 == 0, moves[:, 0], np.nan)
    path = log_file(tmp_path / "log.csv", moves, y)
    with pytest.raises(InputError, match="column y: got '7 values'"):
        identify_log(path, ["a"], ["y"], samples=LENGTH)
