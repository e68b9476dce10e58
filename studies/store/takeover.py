"""Results of older stores, found by the content hash of the scenario: in whatever chunk, slot and chunk size they
lie, they are copied instead of computed if the same variables are stored of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from studies.store.files import all_records, changed, named
from studies.store.fingerprint import content_hash
from studies.store.layout import StoreLayout, Variable

_KEPT_CHUNKS = 512  # decoded chunks of one variable, for scenarios that moved between chunks


class OlderStores:
    """The scenarios of a layout that older stores hold."""

    def __init__(self, paths: Sequence[Path], beside: Path, layout: StoreLayout, say: Callable[[str], None]):
        """Look for them; files are read when a chunk is asked for."""
        self._beside, self._layout, self._say = beside, layout, say
        self._where: dict[str, tuple[Path, int, int]] = {}  # store, chunk, lane
        self._records: dict[tuple[Path, int], dict[str, Any]] = {}
        self._chunk_of = lru_cache(maxsize=_KEPT_CHUNKS)(self._read)
        self._usable = lru_cache(maxsize=None)(self._sound)
        wanted, schema = set(layout.scenario_hashes), layout.schema
        for path in paths:
            for chunk, record in all_records(path):
                hashes = record["scenario_hashes"]
                if record["schema"] == schema and record["content"] == content_hash(hashes, schema):
                    self._records[path, chunk] = record
                    for lane, value in enumerate(hashes):
                        if value in wanted:
                            self._where.setdefault(value, (path, chunk, lane))

    def chunk(self, chunk: int) -> tuple[dict[str, np.ndarray], list[str]] | None:
        """Values of every variable for a chunk of the layout, and the names of the stores they come from.

        Returns:
            `None` unless every scenario of the chunk is there and undamaged.
        """
        hashes = self._layout.hashes_of(chunk)
        places = [self._where[value] for value in hashes if value in self._where]
        if len(places) < len(hashes) or not all(self._usable(path, old) for path, old, _ in places):
            return None
        fields = {}
        for variable in self._layout.variables:
            try:
                rows = [self._chunk_of(path, old, variable)[lane] for path, old, lane in places]
                fields[variable.name] = np.stack(rows).astype(variable.dtype, casting="equiv")
            except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
                self._say(
                    f"{variable.name} of an older store cannot be read and is not taken over ({error})."
                )
                return None
        return fields, sorted({self._name(path) for path, *_ in places})

    def _name(self, path: Path) -> str:
        return path.name if path.parent == self._beside else f"{path.parent.name}/{path.name}"

    def _sound(self, path: Path, chunk: int) -> bool:
        """Whether the files of an older chunk are what was written."""
        wrong = changed(path, self._records[path, chunk]["files"], deep=True)
        if wrong:
            self._say(f"Damaged in {self._name(path)}: {named(wrong)}. It is not taken over.")
        return not wrong

    def _read(self, path: Path, chunk: int, variable: Variable) -> np.ndarray:
        size = self._records[path, chunk]["chunk_size"]
        array = zarr.open_array(str(path / variable.name), mode="r", zarr_format=3)
        values = np.asarray(array[chunk * size : (chunk + 1) * size])
        if not self._layout.lengths:
            return values
        fitted = np.full((size, *self._layout.shape(variable)), variable.empty, dtype=values.dtype)
        common = tuple(slice(min(pair)) for pair in zip(fitted.shape, values.shape, strict=True))
        fitted[common] = values[common]  # what is cut off is padding
        return fitted
