"""Results of older stores, found by the content hash of the scenario: in whatever chunk, slot and chunk size they
lie, they are copied instead of computed if the same variables are stored of them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import zarr

from studies.store.layout import StoreLayout, content_hash
from studies.store.records import all_records, changed

_KEPT_CHUNKS = 512  # decoded chunks of one variable, for scenarios that moved between chunks


class OlderStores:
    """The scenarios of a layout that older stores hold."""

    def __init__(self, paths: list[Path], layout: StoreLayout, say: Callable[[str], None]):
        """Look for them; files are read when a chunk is asked for.

        Args:
            paths: of the older stores.
            layout: of the study that wants them.
            say: receives a line for every file that is damaged.
        """
        self._layout, self._say = layout, say
        self._where: dict[str, tuple[Path, int, int]] = {}  # store, chunk, lane
        self._records = {}
        self._chunk_of = lru_cache(maxsize=_KEPT_CHUNKS)(self._read)
        wanted = set(layout.scenario_hashes)
        for path in paths:
            for chunk, record in all_records(path).items():
                hashes = record["scenario_hashes"]
                if record["schema"] != layout.schema or record["content"] != content_hash(
                    hashes, layout.schema
                ):
                    continue
                self._records[path, chunk] = record
                for lane, value in enumerate(hashes):
                    if value in wanted and value not in self._where:
                        self._where[value] = (path, chunk, lane)

    def chunk(self, chunk: int) -> tuple[dict[str, np.ndarray], list[str]] | None:
        """Values of every variable for a chunk of the layout, and the names of the stores they come from.

        Returns:
            `None` unless every scenario of the chunk is there and undamaged.
        """
        hashes = self._layout.hashes_of(chunk)
        sources = [self._where.get(value) for value in hashes]
        places = [source for source in sources if source is not None]
        if len(places) < len(hashes) or not all(self._usable(path, old) for path, old, _ in places):
            return None
        fields = {}
        for variable in self._layout.variables:
            try:
                rows = [self._chunk_of(path, old, variable.name)[lane] for path, old, lane in places]
                fields[variable.name] = np.stack(rows).astype(variable.dtype, casting="equiv")
            except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
                self._say(
                    f"{variable.name} of an older store cannot be read and is not taken over ({error})."
                )
                return None
        return fields, sorted({path.name for path, *_ in places})

    def _usable(self, path: Path, chunk: int) -> bool:
        """Whether the files of an older chunk are what was written; looked at once."""
        record = self._records.get((path, chunk))
        if record is None:
            return False
        if not record.get("checked"):
            if wrong := changed(path, record["files"], deep=True):
                named = ", ".join(f"{name} ({why})" for name, why in wrong.items())
                self._say(f"Damaged in {path.name}: {named}. It is not taken over.")
                del self._records[path, chunk]
                return False
            record["checked"] = True
        return True

    def _read(self, path: Path, chunk: int, name: str) -> np.ndarray:
        size = self._records[path, chunk]["chunk_size"]
        array = zarr.open_array(str(path / name), mode="r", zarr_format=3)
        return np.asarray(array[chunk * size : (chunk + 1) * size])
