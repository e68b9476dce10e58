"""The thesis study end to end: plant, identification, three controllers, store, figures, verdicts."""

import numpy as np
import pytest

from figures.registry import FIGURES, draw_study
from studies.kpi import evaluate
from studies.store.reading import open_results
from studies.thesis import claims
from studies.thesis.catalogue import run_thesis


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """The shortened study on the JAX well."""
    lines = []
    folder = run_thesis(
        "thesis",
        tmp_path_factory.mktemp("results"),
        quick=True,
        plant="jax",
        progress=False,
        say=lines.append,
    )
    return folder, lines


@pytest.mark.slow
def test_the_quick_study_shows_what_the_thesis_shows(quick):
    data = open_results(quick[0]).load()
    assert data.complete.values.tolist() == [1, 1, 1]
    key = evaluate.key_figures(data)
    assert key.fallbacks.values.tolist() == [0, 0, 0]
    assert not key.cv_violations.any()
    assert not key.mv_violations.any()
    assert not key.move_violations.any()
    verdicts = {claim.statement: claim.verdict for claim in claims.claims(data, key)}
    for words in ("on the step choke oscillates", "mainly below", "Mixed-integer MPC does not", "staircase"):
        found = [verdict for statement, verdict in verdicts.items() if words in statement]
        assert found == ["holds"], words
    rounded, integer = key.sel(controller="step-choke"), key.sel(controller="mixed-integer")
    choke = {"mv": "choke"}
    assert rounded.travel.sel(choke) > integer.travel.sel(choke)
    oil = {"cv": "oil_rate"}
    assert rounded.mean_absolute_deviation.sel(oil) < integer.mean_absolute_deviation.sel(oil)
    steps = data.move.sel(controller="mixed-integer", mv="choke").values
    np.testing.assert_allclose(steps, 2 * np.round(steps / 2), atol=1e-9)


@pytest.mark.slow
def test_every_figure_is_drawn_and_a_rerun_computes_nothing(quick):
    folder, _ = quick
    paths = draw_study(folder, "thesis")
    own = [entry for entry in FIGURES.values() if entry.study == "thesis"]
    assert len(paths) == 2 * len(own) + 1  # PNG and PDF, and the page of all
    lines = []
    run_thesis("thesis", folder.parent, quick=True, plant="jax", progress=False, say=lines.append)
    assert sum("stored already" in line for line in lines) == 3


@pytest.mark.slow
def test_the_fmu_and_its_jax_twin_give_the_same_choke_sequence(quick, tmp_path):
    twin = open_results(quick[0]).load()
    fmu = open_results(
        run_thesis("thesis", tmp_path, quick=True, progress=False, say=lambda line: None)
    ).load()
    for name in ("step-choke", "mixed-integer"):
        np.testing.assert_allclose(
            fmu.position.sel(controller=name, mv="choke"),
            twin.position.sel(controller=name, mv="choke"),
            atol=1e-6,
        )
    np.testing.assert_allclose(fmu.sweep_coefficient, twin.sweep_coefficient, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(fmu.model_coefficient, twin.model_coefficient, rtol=1e-6, atol=1e-9)
