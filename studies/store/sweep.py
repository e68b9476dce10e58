"""The store of a sweep study while it is being written: one Zarr v3 store, one process that writes, one chunk at a
time. `studies.store.reading` reads it.

A chunk's data land first, each file in one rename, and its commit record last, so a run that is killed leaves
nothing that looks finished. The store itself appears in one rename. A store of another study or cut is set aside
as ``<name>-<hash>.zarr`` beside it, never overwritten; chunks whose scenarios lie unchanged in a store beside it
(``<name>-*.zarr``) are copied instead of computed. What is damaged is named and computed again.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.errors import InputError
from jaxmpc.files import write_atomically
from studies.store import records
from studies.store.comparison import check_writable, locked
from studies.store.layout import StoreLayout
from studies.store.records import COMMITS, FORMAT, MANIFEST, DamagedError
from studies.store.takeover import OlderStores
from studies.store.template import ChunkEncoder, write_template

_LOCK_TRIES = 10  # 0.02 s apart: `held` takes the lock for an instant


class SweepStore:
    """One study's store while it is being written; a context manager that holds the lock until it is closed."""

    def __init__(self, path: Path, layout: StoreLayout, say: Callable[[str], None]):
        """Use `begin`."""
        self.path, self.layout = path, layout
        self._say, self._said = say, set[str]()
        self._open = contextlib.ExitStack()
        self._encoder = ChunkEncoder(layout)

    @classmethod
    def begin(
        cls,
        path: str | Path,
        layout: StoreLayout,
        say: Callable[[str], None] = print,
        verify: bool = True,
    ) -> SweepStore:
        """Open the store of a study, or make it, and take over what older stores beside it hold.

        Args:
            path: of the store, ending in ``.zarr``, or of a folder that is to hold it as ``study.zarr``.
            layout: of the study.
            say: receives a line for everything that is set aside, taken over, damaged or repaired.
            verify: read every stored file once; without it only sizes are compared.

        Returns:
            The store, locked until it is closed or the process ends.

        Raises:
            InputError: if the layout cannot be stored, the folder cannot be written, something else is at the
                path, another process writes the store, or the disk is full.
        """
        layout.check()
        path = records.store_path(path)
        check_writable(path.parent, "store")
        _refuse_foreign(path)
        store = cls(path, layout, say)
        try:
            with _disk(path):
                store._open.enter_context(_lock(path))
                store._prepare()
            if verify:
                store.verify()
            store._take_over()
        except BaseException:
            store.close()
            raise
        return store

    def close(self) -> None:
        """Release the lock."""
        self._open.close()

    def __enter__(self) -> SweepStore:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def commit(self, chunk_index: int, fields: Mapping[str, np.ndarray], facts: dict[str, Any]) -> None:
        """Store the results of a chunk: data first, its record last.

        Args:
            chunk_index: number of the chunk.
            fields: values of every variable, ``"lane ..."`` with the real lanes only.
            facts: JSON-like, for example ``wall_time`` [s], worker and device.

        Raises:
            InputError: if a variable is missing, unknown or of another shape (nothing is written), or if the disk
                does not take the data (the chunk counts as not stored, all others stay).
        """
        values = self._checked(chunk_index, fields)
        files = dict(self._encoder.encode(v, values[v.name], chunk_index) for v in self.layout.variables)
        body = {
            "format": FORMAT,
            "chunk": chunk_index,
            "chunk_size": self.layout.chunk_size,
            "content": self.layout.contents[chunk_index],
            "schema": self.layout.schema,
            "scenario_hashes": self.layout.hashes_of(chunk_index),
            "files": {name: records.mark(content) for name, content in files.items()},
            "committed": datetime.now(UTC).isoformat(timespec="seconds"),
            "facts": facts,
        }
        record = self.path / records.record_file(chunk_index)
        with _disk(self.path):
            record.unlink(missing_ok=True)  # an old record never stands beside new data
            for name, content in files.items():
                write_atomically(self.path / name, content)
            records.write_checked(record, body)

    def pending(self) -> list[int]:
        """Chunks without a valid commit, in order; damage that was not named yet is named."""
        found = records.survey(self.path, self.layout.contents)
        self._name_damage(found)
        return [i for i in range(len(self.layout.contents)) if i not in found.records]

    def verify(self) -> list[str]:
        """Read every stored file and compare checksums; damaged chunks become pending.

        Returns:
            The damaged files, as paths inside the store with what is wrong.
        """
        found = records.survey(self.path, self.layout.contents, deep=True)
        self._name_damage(found)
        with _disk(self.path):
            for chunk in found.damaged:
                (self.path / records.record_file(chunk)).unlink(missing_ok=True)
        return found.damage

    def _name_damage(self, found: records.Survey) -> None:
        for chunk, files in found.damaged.items():
            named = ", ".join(f"{name} ({why})" for name, why in files.items())
            line = f"Damaged in {self.path.name}: {named}. Chunk {chunk} is computed again."
            if line not in self._said:
                self._said.add(line)
                self._say(line)

    def _checked(self, chunk: int, fields: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        layout = self.layout
        if not 0 <= chunk < len(layout.contents):
            raise InputError("chunk_index", chunk, f"0 to {len(layout.contents) - 1}")
        names = {variable.name for variable in layout.variables}
        if names != set(fields):
            raise InputError(
                "fields", sorted(names ^ set(fields)), "every variable of the layout and no other"
            )
        values = {}
        for variable in layout.variables:
            wanted = (len(layout.chunk_scenarios[chunk]), *layout.shape(variable))
            value = np.asarray(fields[variable.name])
            if value.shape != wanted:
                raise InputError(f"fields.{variable.name}", value.shape, f"the shape {wanted}, lanes first")
            if not np.can_cast(value.dtype, variable.dtype, "same_kind") and value.dtype.kind != "b":
                raise InputError(
                    f"fields.{variable.name}", value.dtype.str, f"values of type {variable.dtype}"
                )
            values[variable.name] = value
        return values

    def _prepare(self) -> None:
        """Make, repair or set aside, so that the path holds the store of this layout."""
        for remains in self.path.parent.glob(
            f"{_unfinished(self.path)}*"
        ):  # of a run killed while it made them
            shutil.rmtree(remains, ignore_errors=True)
        if not self.path.exists() or not any(self.path.iterdir()):
            with self._new_template() as template:
                os.rename(template, self.path)
            return
        identity, wrong = _identity(self.path)
        if identity != self.layout.identity:
            kept = _set_aside(self.path)
            self._say(f"{self.path} holds another definition or code; it is kept as {kept.name}.")
            self._prepare()
            return
        if wrong:
            self._say(
                f"Damaged in {self.path.name}: {', '.join(wrong)}. It is written again from the definition."
            )
            self._repair()
        for folder in [COMMITS, *(variable.name for variable in self.layout.variables)]:
            for entry in list(os.scandir(self.path / folder)):  # temporary files of a run that was killed
                if entry.name.startswith("."):
                    os.unlink(entry)

    def _repair(self) -> None:
        """Write the fixed files again, each in one rename, the manifest last; chunks stay as they are."""
        with self._new_template() as template:
            names = [p.relative_to(template) for p in sorted(template.rglob("*")) if p.is_file()]
            for name in sorted(names, key=lambda name: name.as_posix() == MANIFEST):
                (self.path / name).parent.mkdir(parents=True, exist_ok=True)
                os.replace(template / name, self.path / name)

    @contextlib.contextmanager
    def _new_template(self) -> Iterator[Path]:
        temporary = Path(tempfile.mkdtemp(dir=self.path.parent, prefix=_unfinished(self.path)))
        try:
            write_template(temporary / self.path.name, self.layout)
            yield temporary / self.path.name
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    def _take_over(self) -> None:
        """Commit every pending chunk whose scenarios all lie in a store beside this one."""
        pending = self.pending()
        older = sorted(p for p in self.path.parent.glob(f"{self.path.stem}-*.zarr") if p.is_dir())
        if not pending or not older:
            return
        found = OlderStores(older, self.layout, self._say)
        scenarios, chunks, sources = 0, 0, set[str]()
        for chunk in pending:
            taken = found.chunk(chunk)
            if taken is not None:
                fields, names = taken
                self.commit(chunk, fields, {"taken_over_from": names})
                scenarios, chunks = scenarios + len(self.layout.chunk_scenarios[chunk]), chunks + 1
                sources.update(names)
        if chunks:
            self._say(
                f"{scenarios} scenarios ({chunks} chunks) are taken over from {', '.join(sorted(sources))}."
            )


def held(path: str | Path) -> bool:
    """Whether a run writes the store right now."""
    path = records.store_path(path)
    if not _lock_folder(path).is_dir():
        return False
    try:
        with locked(_lock_folder(path)):
            return False
    except InputError:
        return True
    except OSError:  # a medium that cannot be written holds no run
        return False


def _lock_folder(path: Path) -> Path:
    return path.with_name(f".{path.name}.lock")


def _unfinished(path: Path) -> str:
    return f".new-{path.name}-"


@contextlib.contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Hold a store for one run; the lock lies beside the store, which may be renamed meanwhile."""
    _lock_folder(path).mkdir(exist_ok=True)
    with contextlib.ExitStack() as stack:
        for attempt in range(_LOCK_TRIES):
            try:
                stack.enter_context(locked(_lock_folder(path)))
                break
            except InputError as error:
                if attempt == _LOCK_TRIES - 1:
                    hint = "Wait for that run, or choose another path"
                    raise InputError(
                        "store", str(path), "a store that no other run is writing", hint
                    ) from error
                time.sleep(0.02)
        yield


@contextlib.contextmanager
def _disk(path: Path) -> Iterator[None]:
    """Say what to do when the disk does not take the data."""
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        hint = f"Free space on the disk of {path.parent}" if full else f"Make {path.parent} writable"
        raise InputError(
            "store",
            str(path),
            f"a disk that takes the results ({error.strerror or error})",
            f"{hint}, then give the same command again: every chunk stored so far is kept",
        ) from error


def _refuse_foreign(path: Path) -> None:
    """Refuse a path that holds anything but a sweep store."""
    ours = not path.exists() or (
        path.is_dir()
        and ((path / COMMITS).is_dir() or not any(path.iterdir()) or _attribute(path, "format") == FORMAT)
    )
    if not ours:
        raise InputError("store", str(path), "a sweep store or a path that is free", "Choose another path")


def _attribute(path: Path, key: str) -> str | None:
    """A fact of the root group, without help of the manifest."""
    try:
        return str(json.loads((path / "zarr.json").read_bytes())["attributes"][key])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _identity(path: Path) -> tuple[str | None, list[str]]:
    """Identity of the store at a path and its damaged fixed files."""
    try:
        manifest = records.read_checked(path / MANIFEST)
        why = "missing"
    except DamagedError as error:
        manifest, why = None, str(error)
    if manifest is None:
        return _attribute(path, "identity"), [f"{MANIFEST} ({why})"]
    wrong = records.changed(path, manifest["files"], deep=True)
    return manifest["identity"], [f"{name} ({reason})" for name, reason in wrong.items()]


def _set_aside(path: Path) -> Path:
    """Rename a store so that it keeps its content under a name that says which study it is."""
    try:
        manifest = records.read_checked(path / MANIFEST)
    except DamagedError:
        manifest = None
    study_hash = manifest["study_hash"] if manifest else _attribute(path, "study_hash")
    stem = f"{path.stem}-{(study_hash or 'unreadable')[:10]}"
    target, count = path.with_name(f"{stem}.zarr"), 1
    while target.exists():
        count += 1
        target = path.with_name(f"{stem}-{count}.zarr")
    os.rename(path, target)
    return target
