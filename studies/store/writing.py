"""The store of a study while it is being written, of a sweep or of a comparison: one Zarr v3 store, one process that
writes, one chunk at a time. `studies.store.reading` reads it.

A chunk's data land first, each file in one rename, and its commit record last, so a run that is killed leaves
nothing that looks finished. The store itself appears in one rename. A store of another study, cut or version is set
aside as ``<name>-<hash>.zarr`` beside it, never overwritten; chunks whose scenarios lie unchanged in a store beside it
(``<name>-*.zarr``), or in others that are named, are copied instead of computed. What is damaged is named and computed
again.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.errors import InputError
from jaxmpc.files import check_folder, write_atomically
from studies.store import files
from studies.store.files import COMMITS, FORMAT, MANIFEST, OLD_FORMATS, DamagedError, attribute
from studies.store.layout import StoreLayout
from studies.store.takeover import OlderStores
from studies.store.template import ChunkEncoder, write_template

_LOCK_TRIES = 10  # 0.02 s apart: `held` takes the lock for an instant


def check_writable(folder: str | Path, field: str = "out") -> Path:
    """Make a folder if it is missing and make sure that files can be written there.

    Raises:
        InputError: naming the folder and the reason.
    """
    check_folder(field, folder)
    Path(folder).mkdir(parents=True, exist_ok=True)
    return Path(folder)


class Store:
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
        others: Sequence[Path] = (),
        lock: bool = True,
    ) -> Store:
        """Open the store of a study, or make it, and take over what older stores beside it hold.

        Args:
            path: of the store, ending in ``.zarr``, or of a folder that is to hold it as ``study.zarr``.
            say: receives a line for everything that is set aside, taken over, damaged or repaired.
            verify: read every stored file once; without it only sizes are compared.
            others: stores of other studies, to take equal scenarios from.
            lock: hold the store against other runs; without it the caller does.

        Returns:
            The store, locked until it is closed or the process ends.

        Raises:
            InputError: if the layout cannot be stored, the folder cannot be written, something else is at the
                path, another process writes the store, or the disk is full.
        """
        layout.check()
        path = files.store_path(path)
        check_writable(path.parent, "store")
        _refuse_foreign(path)
        store = cls(path, layout, say)
        try:
            with _disk(path):
                if lock:
                    store._open.enter_context(locked(path))
                store._prepare()
            if verify:
                store.verify()
            store._take_over([other for other in others if other != path])
        except BaseException:
            store.close()
            raise
        return store

    def close(self) -> None:
        """Release the lock."""
        self._open.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def commit(self, chunk_index: int, fields: Mapping[str, np.ndarray], facts: dict[str, Any]) -> None:
        """Store the results of a chunk: data first, its record last.

        Args:
            fields: values of every variable, ``"lane ..."`` with the real lanes only.
            facts: JSON-like, for example ``wall_time`` [s], worker and device.

        Raises:
            InputError: if a variable is missing, unknown or of another shape (nothing is written), or if the disk
                does not take the data (the chunk counts as not stored, all others stay).
        """
        values = self._checked(chunk_index, fields)
        encoded = dict(self._encoder.encode(v, values[v.name], chunk_index) for v in self.layout.variables)
        body = {
            "chunk": chunk_index,
            "chunk_size": self.layout.chunk_size,
            "content": self.layout.contents[chunk_index],
            "schema": self.layout.schema,
            "scenario_hashes": self.layout.hashes_of(chunk_index),
            "files": {name: len(content) for name, content in encoded.items()},
            "committed": datetime.now(UTC).isoformat(timespec="seconds"),
            "facts": facts,
        }
        record = self.path / files.record_file(chunk_index)
        with _disk(self.path):
            record.unlink(missing_ok=True)  # an old record never stands beside new data
            for name, content in encoded.items():
                write_atomically(self.path / name, content)
            write_atomically(record, files.text_content(body))

    def pending(self) -> list[int]:
        """Chunks without a valid commit, in order; damage that was not named yet is named."""
        found = files.survey(self.path, self.layout.contents)
        self._name_damage(found)
        return [i for i in range(len(self.layout.contents)) if i not in found.records]

    def verify(self) -> list[str]:
        """Read every stored file and compare checksums; damaged chunks become pending."""
        found = files.survey(self.path, self.layout.contents, deep=True)
        self._name_damage(found)
        with _disk(self.path):
            for chunk in found.damaged:
                (self.path / files.record_file(chunk)).unlink(missing_ok=True)
        return found.damage

    def _name_damage(self, found: files.Survey) -> None:
        for chunk, wrong in found.damaged.items():
            line = (
                f"Damaged in {self.path.name}: {files.named(wrong)}. {self._chunk(chunk)} is computed again."
            )
            if line not in self._said:
                self._said.add(line)
                self._say(line)

    def _chunk(self, chunk: int) -> str:
        """What a chunk is called."""
        numbers, names = self.layout.chunk_scenarios[chunk], self.layout.names
        return ", ".join(names[k] for k in numbers) if names else f"Chunk {chunk}"

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
        known, wrong = _manifest(self.path)
        if known["identity"] != self.layout.identity:
            old = attribute(self.path, "format") in OLD_FORMATS
            kept = _set_aside(self.path, known["study_hash"])
            what = "is of an older version" if old else "holds another definition or code"
            self._say(f"{self.path} {what}; it is kept as {kept.name}.")
            self._prepare()
            return
        if wrong:
            self._say(
                f"Damaged in {self.path.name}: {files.named(wrong)}. It is written again from the definition."
            )
            self._repair()
        for folder in [COMMITS, "manifest", *(variable.name for variable in self.layout.variables)]:
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

    def _take_over(self, others: Sequence[Path]) -> None:
        """Commit every pending chunk whose scenarios all lie in a store beside this one, or in another."""
        pending = self.pending()
        older = [*sorted(self.path.parent.glob(f"{self.path.stem}-*.zarr")), *others]
        if not pending or not older:
            return
        found = OlderStores(older, self.path.parent, self.layout, self._say)
        scenarios, chunks, sources = 0, 0, set[str]()
        for chunk in pending:
            taken = found.chunk(chunk)
            if taken is not None:
                fields, names = taken
                self.commit(chunk, fields, {"taken_over_from": names})
                if self.layout.names:
                    self._say(f"{self._chunk(chunk)}: taken over from {', '.join(names)}.")
                scenarios, chunks = scenarios + len(self.layout.chunk_scenarios[chunk]), chunks + 1
                sources.update(names)
        if chunks and not self.layout.names:
            self._say(
                f"{scenarios} scenarios ({chunks} chunks) are taken over from {', '.join(sorted(sources))}."
            )


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a store for one run; the lock lies beside the store, which may be renamed meanwhile.

    Raises:
        InputError: if another process holds it.
    """
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        yield
        return
    _lock_folder(path).mkdir(exist_ok=True)
    with open(_lock_folder(path) / ".lock", "w") as file:
        for left in reversed(range(_LOCK_TRIES)):
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError:
                if not left:
                    expected = "a store that no other run is writing"
                    hint = "Wait for that run, or choose another path"
                    raise InputError("store", str(path), expected, hint) from None
                time.sleep(0.02)
        yield


def held(path: str | Path) -> bool:
    """Whether a run writes the store right now."""
    path = files.store_path(path)
    if not _lock_folder(path).is_dir():
        return False
    try:
        with locked(path):
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
    """Refuse a path that holds anything but a store."""
    ours = not path.exists() or (
        path.is_dir()
        and (
            (path / COMMITS).is_dir()
            or not any(path.iterdir())
            or attribute(path, "format") in (FORMAT, *OLD_FORMATS)
        )
    )
    if not ours:
        raise InputError(
            "store", str(path), "the store of a study or a path that is free", "Choose another path"
        )


def _manifest(path: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """What the store at a path says that it is, as far as it does, and its damaged fixed files."""
    try:
        manifest, why = files.read_text(path / MANIFEST), "missing"
    except DamagedError as error:
        manifest, why = None, str(error)
    if manifest is None:
        return {key: attribute(path, key) for key in ("identity", "study_hash")}, {MANIFEST: why}
    return manifest, files.changed_fixed(path, manifest)


def _set_aside(path: Path, study_hash: str | None) -> Path:
    """Rename a store so that it keeps its content under a name that says which study it is."""
    stem = f"{path.stem}-{(study_hash or 'unreadable')[:10]}"
    target, count = path.with_name(f"{stem}.zarr"), 1
    while target.exists():
        count += 1
        target = path.with_name(f"{stem}-{count}.zarr")
    os.rename(path, target)
    return target
