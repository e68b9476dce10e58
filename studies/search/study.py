"""A sweep study that is searched: what may vary, how it is checked before the first run, and what its store looks like.

The points are not known before they are asked for, so a `SearchStudy` has no scenarios; `SearchStudy.batch` makes the
`Study` of one batch once its points are there. `studies.search.run` asks, runs and stores.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UnsetType

from jaxmpc.errors import InputError
from studies.definition.axes import check_count
from studies.definition.estimate import MODEL_SECONDS, Description, Work, chunk_seconds
from studies.definition.fields import Field
from studies.definition.scenarios import Study
from studies.definition.sections import Search
from studies.definition.sweep import StudyDefinition
from studies.kpi.objectives import Objective, objectives_of
from studies.run.chunk import study_layout
from studies.search.space import (
    Parameter,
    Point,
    check_one_group,
    extremes_of,
    listed,
    parameter_of,
)
from studies.store import fingerprint
from studies.store.layout import StoreLayout, Variable
from studies.store.reading import chunk_facts, open_study

SEEKING = ("search.run", "kpi.objectives")  # modules of `studies` that decide which points are asked for
LIBRARY = "optuna"
BATCH = 64  # scenarios, where the definition does not say


@dataclasses.dataclass(frozen=True, eq=False)
class EvaluatedStudy(Study):
    """The stored scenarios of a search as an ordinary study; the hashes are those of the search."""

    planned: tuple[str, ...] = ()

    def scenario_hash(self, k: int) -> str:
        """As `SearchStudy.scenario_hash`, which is what the store holds."""
        return self.planned[k]


@dataclasses.dataclass(frozen=True, eq=False)
class SearchStudy:
    """A search, checked when it exists; made by `studies.load`.

    Scenario k belongs to batch ``k // chunk_size``.
    """

    definition: StudyDefinition  # as written, quick cuts applied
    parameters: tuple[Parameter, ...]  # one per axis, in the order of the definition
    objectives: tuple[Objective, ...]  # what is weighed
    probe: Study  # study of extremes of the parameters, all of which can start

    @property
    def name(self) -> str:
        """Of the study; ends in ``-quick`` for the quick cut."""
        return self.definition.study.name

    @property
    def title(self) -> str:
        """For reports."""
        return self.probe.title

    @property
    def search(self) -> Search:
        """The table ``[search]``."""
        assert self.definition.search is not None
        return self.definition.search

    @property
    def batches(self) -> int:
        """How many are asked for; one is a chunk of the store."""
        return self.search.batches

    @property
    def chunk_size(self) -> int:
        """Scenarios of a batch."""
        return _batch_size(self.definition)

    @property
    def count(self) -> int:
        """Scenarios of all batches."""
        return self.batches * self.chunk_size

    def batch(self, points: Sequence[Point], index: int | None = None) -> Study:
        """An ordinary study of some points, in their order and in one group.

        Raises:
            InputError: naming the axes, for points that are refused or need more than one compiled program.
        """
        where = "" if index is None else f" (batch {index})"
        try:
            study = listed(self.definition, self.parameters, points)
        except InputError as error:
            raise InputError(f"{error.field}{where}", error.value, error.expected, error.hint) from None
        check_one_group(study, self.parameters, points)
        return study

    def scenario_hash(self, k: int) -> str:
        """Hash of what decides scenario k before it is known.

        A batch follows from the search (base settings and extremes as resolved numbers, axes, objectives, sampler with
        seed and version, batch size), from the code, and from the results of the batches before it, which follow from
        the same. So all of this with the number of the batch and the place in it stands for the numbers of the scenario.
        The number of batches is not part of it: a longer search goes on from a shorter one.
        """
        if not 0 <= k < self.count:
            raise InputError("scenario", k, f"a number from 0 to {self.count - 1}")
        return fingerprint.content_hash(self._content, *divmod(int(k), self.chunk_size))

    @functools.cached_property
    def hash(self) -> str:
        """Of everything that the stored results depend on."""
        store = self.definition.store
        return fingerprint.content_hash(self._content, self.batches, store.every, list(store.trajectories))

    @functools.cached_property
    def _content(self) -> str:
        search, probe = self.search, self.probe
        try:
            version = importlib.metadata.version(LIBRARY)
        except importlib.metadata.PackageNotFoundError:
            version = "not installed"
        return fingerprint.content_hash(
            [probe.scenario_hash(k) for k in range(probe.count)],
            [([f.key for f in p.fields], p.entries, p.low, p.high, p.log, p.whole) for p in self.parameters],
            [(o.name, o.direction) for o in self.objectives],
            [search.sampler, search.seed, self.chunk_size, version],
            [fingerprint.module_hash(f"studies.{name}") for name in SEEKING],
        )

    @property
    def work(self) -> Work:
        """The batches and what they are expected to cost."""
        group = self.probe.groups[0]
        seconds = chunk_seconds(group.kind, group.samples, self.chunk_size)
        return Work([0] * self.batches, [group.kind], [seconds])

    def describe(self) -> Description:
        """What a run would do, for a dry run; prints as a short table."""
        group, each = self.probe.groups[0], self.probe.describe()
        samples = self.count * group.samples
        return Description(
            name=self.name,
            scenarios=self.count,
            group_sizes=(self.count,),
            chunks=self.batches,
            compilations=1,
            models=each.models,
            samples=samples,
            stored_bytes=each.stored_bytes // each.scenarios * self.count,
            seconds=MODEL_SECONDS * each.models + self.work.rest({}),
            searched=True,
        )

    def layout(self, command: str | None = None) -> StoreLayout:
        """What the store has to know: every tuned value is a variable, as it is known only with the results."""
        base, tuned, size = study_layout(self.probe, command), {}, self.chunk_size
        variables = []
        labels = {column.key: column.label for column in self.probe.columns}
        for parameter in self.parameters:
            for i, field in enumerate(parameter.fields):
                texts = tuned[field.key] = parameter.texts(i)
                kind: Any = ("f8", np.nan) if texts is None else ("i2", -1)
                variables.append(Variable(field.key, labels[field.key], field.unit, (), *kind))
        return dataclasses.replace(
            base,
            name=self.name,
            title=self.title,
            study_hash=self.hash,
            chunk_size=size,
            chunk_scenarios=tuple(np.arange(b * size, (b + 1) * size) for b in range(self.batches)),
            scenario_hashes=tuple(self.scenario_hash(k) for k in range(self.count)),
            columns=(),
            variables=(*variables, *base.variables),
            provenance={
                **base.provenance,
                "work": dataclasses.asdict(self.work),
                "tuned": tuned,
                "objectives": {o.name: o.direction for o in self.objectives},
            },
        )

    def tuned_fields(self, batch: Study) -> dict[str, np.ndarray]:
        """The tuned values of a batch as variables of the store: numbers, or positions in the list of texts."""
        texts = {f.key: p.texts(i) for p in self.parameters for i, f in enumerate(p.fields)}
        out = {}
        for column in batch.columns:
            listed = texts[column.key]
            values = column.values if listed is None else [listed.index(text) for text in column.values]
            out[column.key] = np.asarray(values, dtype="f8" if listed is None else "i2")
        return out

    def evaluated(self, store: str | Path) -> Study:
        """The scenarios of a store up to its first missing batch, as an ordinary study with the same numbers.

        Raises:
            InputError: if there is no store, or its first batch is missing.
        """
        there = chunk_facts(store)
        done = next(b for b in itertools.count() if b not in there)
        if not done:
            raise InputError("store", str(store), "the store of a search with its first batch")
        rows = slice(0, done * self.chunk_size)
        with open_study(store) as data:
            columns = [[_plain(f, data[f.key].values[rows]) for f in p.fields] for p in self.parameters]
        points = list(zip(*(list(zip(*keys, strict=True)) for keys in columns), strict=True))
        study = self.batch(points)
        inherited = {f.name: getattr(study, f.name) for f in dataclasses.fields(study)}
        return EvaluatedStudy(**inherited, planned=tuple(self.scenario_hash(k) for k in range(rows.stop)))


def expand_search(definition: StudyDefinition, *, confirmed: bool = False) -> SearchStudy:
    """Check a definition with ``[search]``.

    Extremes of all axes are resolved and grouped like scenarios, each alone and (up to 1024 of them) in all combinations, so
    that a space with values that no controller could run, or that need another compiled program, is refused here.

    Raises:
        InputError: naming the path of the field.
    """
    search = definition.search
    assert search is not None
    objectives = objectives_of(search, definition.process)
    if not definition.axes:
        raise InputError("axes", "nothing", "one axis or more to search along, each headed [[axes]]")
    parameters = tuple(parameter_of(definition, i) for i in range(len(definition.axes)))
    check_count(definition, search.batches * _batch_size(definition), confirmed)
    points = extremes_of(parameters)
    probe = listed(definition, parameters, points)
    check_one_group(probe, parameters, points)
    return SearchStudy(definition, parameters, objectives, probe)


def _batch_size(definition: StudyDefinition) -> int:
    given = definition.study.chunk_size
    return BATCH if isinstance(given, UnsetType) else given


def _plain(field: Field, values: np.ndarray) -> list[Any]:
    """Stored values of a key in the types that a definition has."""
    if not field.numeric:
        return [field.parse(field.key, text) for text in values]
    return [field.check(field.key, value) for value in values.tolist()]
