"""Searching for tunings: a sampler asks for a batch of points, they run as one chunk, and all results are told together.

The sampler of every batch is new, with a seed of its own, and knows only the results before it. A search that is killed
therefore goes on as if nothing had happened: stored batches are asked for again and told what is stored, and only the
rest is computed.
This is the only file that uses optuna.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxmpc.errors import InputError, MissingToolError
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.programs.interrupts import last_words
from studies.definition.models import Point as WorkingPoint
from studies.definition.models import identify_models
from studies.definition.scenarios import Study
from studies.kpi.objectives import costs, front, unbeaten, values_of
from studies.run.chunk import run_scenarios
from studies.run.progress import Progress, progress_bar
from studies.run.runner import Say
from studies.search.space import Parameter, Point
from studies.search.study import SearchStudy
from studies.store.layout import FLAG
from studies.store.reading import chunk_facts, open_study
from studies.store.writing import Store

__all__ = ["SearchStudy", "front", "run_search"]

PLANT = ("plant.", "plant_scale.")
MODEL = "model."


def run_search(
    study: SearchStudy,
    store: str | Path,
    *,
    workers: int = 1,
    dask: str | None = None,
    progress: bool = True,
    say: Say = print,
    command: str | None = None,
) -> Path:
    """Ask, run and store every batch of a search that is missing; `objectives.front` gives what it found.

    A scenario that does not run to its end, or with an objective that is not a finite number, is told as failed: it has no
    influence on what is asked next and is never on the front.

    Args:
        store: path that ends in ``.zarr``, or a folder that is to hold ``study.zarr``.
        command: words after ``jaxmpc study run`` that give this study, for `status`.

    Raises:
        InputError: for bad arguments, a store that another run holds, or a full disk; what is stored stays.
        MissingToolError: if optuna is not installed; nothing is written.
        KeyboardInterrupt: after Ctrl-C; says how many batches are stored.
    """
    hint = "Every batch waits for the one before it; a larger study.chunk_size uses more cores"
    if isinstance(workers, bool) or workers != 1:
        raise InputError("workers", workers, "1 process for a search", hint)
    if dask is not None:
        raise InputError("dask", dask, "nothing: a search runs in this process", hint)
    sampler = _Sampler(study)
    with Store.begin(store, study.layout(command), say) as writer:
        missing = set(writer.pending())
        done = study.batches - len(missing)
        if done:
            say(_stored_batches(study, writer))
        facts, work = chunk_facts(writer.path), study.work
        with (
            last_words(lambda: f"{_stored_batches(study, writer)} Give the same command again to go on."),
            progress_bar(study.name, study.count, done * study.chunk_size, work, facts, progress) as bar,
        ):
            _search(study, sampler, writer, missing, bar, say)
        say(f"{study.count} scenarios, {len(front(writer.path))} on the front: {writer.path}")
        return writer.path


def _stored_batches(study: SearchStudy, writer: Store) -> str:
    return f"{study.batches - len(writer.pending())} of {study.batches} batches are stored."


def _search(
    study: SearchStudy, sampler: _Sampler, writer: Store, missing: set[int], bar: Progress, say: Say
) -> None:
    stored = _Stored(study, writer.path) if len(missing) < study.batches else None
    runner, told = _Runner(study), []
    for index in range(study.batches):
        batch = study.batch(sampler.ask(index), index)
        fields, facts = None, None
        if stored is not None and index not in missing:
            fields = stored.results(batch, index)
            if fields is None:
                say(f"Batch {index} is stored for other points and is computed again.")
        if fields is None:
            results, facts = runner.run(batch)
            writer.commit(index, {**results, **study.tuned_fields(batch)}, facts)
            fields = results
        values = values_of(study.objectives, fields)
        sampler.tell(values)
        told.append(costs(study.objectives, values))
        if facts is not None:
            best = int(unbeaten(np.concatenate(told)).sum())
            bar.add(index, facts, batch.count if index in missing else 0, f"{best} on the front")


class _Runner:
    """Runs batches in one compiled program; models are identified when a batch first needs them."""

    def __init__(self, study: SearchStudy):
        self.study = study
        self.models: dict[WorkingPoint, StepResponseModel] = {}
        keys = [field.key for parameter in study.parameters for field in parameter.fields]
        self.plant = tuple(
            dict.fromkeys(key.partition(".")[2] for key in keys if key.startswith(PLANT))
        )  # whether or not they differ within a batch, so that all batches share a program
        self.shared_model = not any(key.startswith(MODEL) for key in keys)

    def run(self, batch: Study) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """As `chunk.run_scenarios`."""
        wanted = batch.model_points if self.models else (*self.study.probe.model_points, *batch.model_points)
        new = identify_models(batch.process, (point for point in wanted if point not in self.models))
        self.models |= {point: jax.tree.map(np.asarray, model) for point, model in new.items()}
        scenarios = [batch.scenario(k) for k in range(batch.count)]
        options: Any = {"shared_model": self.shared_model, "varying": self.plant}
        return run_scenarios(batch, scenarios, self.models, lanes=batch.count, **options)


class _Stored:
    """Points and objectives of the batches that a store holds."""

    def __init__(self, study: SearchStudy, path: Path):
        needed = {FLAG, *(objective.figure for objective in study.objectives)}
        with open_study(path) as data:
            self.fields = {name: data[name].values for name in needed}
            keys = [field.key for parameter in study.parameters for field in parameter.fields]
            self.points = {key: data[key].values for key in keys}

    def results(self, batch: Study, index: int) -> dict[str, np.ndarray] | None:
        """What the objectives are made of, if it is stored for the points of this batch."""
        rows = slice(index * batch.count, (index + 1) * batch.count)
        if any(not np.array_equal(self.points[c.key][rows], c.values) for c in batch.columns):
            return None
        return {name: values[rows] for name, values in self.fields.items()}


# --------------------------------------------------------------------------------------------------------- optuna


def _optuna() -> Any:
    try:
        import optuna
    except ImportError as error:
        raise MissingToolError(
            "A search needs optuna, which is not installed. Install it with: pip install 'jaxmpc[search]'"
        ) from error
    return optuna


class _Sampler:
    """Asks for whole batches and is told their results; what it asks follows from the seed and from what it was told."""

    def __init__(self, study: SearchStudy):
        self.study, self.optuna = study, _optuna()
        self.distributions = {p.name: self._distribution(p) for p in study.parameters}
        self.finished = study.chunk_size  # scenarios of the last batch that did not fail
        self.trials: list[Any] = []
        with self._quiet():
            self.record = self.optuna.create_study(directions=[o.direction for o in study.objectives])

    def ask(self, index: int) -> list[Point]:
        """The points of a batch."""
        with self._quiet():
            self.record.sampler = self._sampler(index)
            self.trials = [self.record.ask(self.distributions) for _ in range(self.study.chunk_size)]
        return [tuple(_row(p, trial.params[p.name]) for p in self.study.parameters) for trial in self.trials]

    def tell(self, values: np.ndarray) -> None:
        """The objectives ``"scenario objective"`` of the batch asked for last; rows that are not finite failed."""
        finite = [bool(np.isfinite(row).all()) for row in values]
        with self._quiet():
            for trial, row, good in zip(self.trials, values.tolist(), finite, strict=True):
                if good:
                    self.record.tell(trial, row)
                else:
                    self.record.tell(trial, state=self.optuna.trial.TrialState.FAIL)
        self.finished = sum(finite)

    def _sampler(self, index: int) -> Any:
        samplers, search = self.optuna.samplers, self.study.search
        seed = int(np.random.SeedSequence([search.seed, index]).generate_state(1)[0])
        if search.sampler == "tpe":
            return samplers.TPESampler(
                seed=seed, n_startup_trials=self.study.chunk_size, multivariate=True, constant_liar=True
            )
        # a batch is a generation, also where some of it failed
        return samplers.NSGAIISampler(seed=seed, population_size=max(self.finished, 2))

    def _distribution(self, parameter: Parameter) -> Any:
        kinds = self.optuna.distributions
        if parameter.entries:
            return kinds.CategoricalDistribution(range(len(parameter.entries)))
        kind = kinds.IntDistribution if parameter.whole else kinds.FloatDistribution
        return kind(parameter.low, parameter.high, log=parameter.log)

    @contextlib.contextmanager
    def _quiet(self) -> Iterator[None]:
        """Its log lines and its warnings about experimental parts are of no use to whoever waits for results."""
        logging = self.optuna.logging
        before = logging.get_verbosity()
        logging.set_verbosity(logging.ERROR)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", self.optuna.exceptions.ExperimentalWarning)
                yield
        finally:
            logging.set_verbosity(before)


def _row(parameter: Parameter, asked: Any) -> tuple[Any, ...]:
    """One value per key for what was asked: a position among entries, or a number."""
    return parameter.entries[asked] if parameter.entries else (asked,)
