"""What a sweep store says about itself: the manifest of its fixed files, one commit record per finished chunk, and
which files are no longer what was written.

Both are JSON with their own checksum and list every file with its size and CRC-32. A chunk counts as stored only
if its record is whole, is of the wanted content, and every file of it is there in full size; ``deep`` also reads
the files. Nothing here writes but `write_checked`.
"""

from __future__ import annotations

import json
import os
import re
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxmpc.errors import InputError
from jaxmpc.files import write_atomically
from studies.store.layout import digest

FORMAT = "jaxmpc/sweep/1"
STORE = "study.zarr"  # in a folder that is not a store itself
COMMITS = "commits"
MANIFEST = f"{COMMITS}/store.json"

Mark = tuple[int, int]  # size, CRC-32


class DamagedError(Exception):
    """A file is there but is not what was written."""


def store_path(path: str | Path) -> Path:
    """The store that a user means: a path ending in ``.zarr`` is the store, any other is a folder that holds it."""
    path = Path(path)
    return path if path.suffix == ".zarr" else path / STORE


def mark(content: bytes) -> Mark:
    """Size and checksum of a file's content."""
    return len(content), zlib.crc32(content)


def record_file(chunk: int) -> str:
    """Path of a commit record inside the store."""
    return f"{COMMITS}/{chunk:06d}.json"


def chunk_file(variable: str, dims: int, chunk: int) -> str:
    """Path of a Zarr chunk inside the store, for a variable with `dims` axes after the slot."""
    return f"{variable}/c.{chunk}" + ".0" * dims


def write_checked(path: Path, body: dict[str, Any]) -> None:
    """Write a JSON body with its checksum in one rename, flushed to the disk."""
    plain = json.loads(json.dumps(body, default=lambda value: value.item()))  # numpy scalars become numbers
    write_atomically(path, json.dumps({"sha256": digest(plain), "body": plain}))


def read_checked(path: Path) -> dict[str, Any] | None:
    """Read what `write_checked` wrote; `None` if there is no such file.

    Raises:
        DamagedError: if the content does not match its checksum.
    """
    try:
        content = json.loads(path.read_bytes())
        if content["sha256"] == digest(content["body"]) and content["body"]["format"] == FORMAT:
            return content["body"]
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DamagedError("not readable") from error
    raise DamagedError("checksum or format differs")


def changed(store: Path, files: dict[str, Mark], deep: bool) -> dict[str, str]:
    """Files that are missing or not as recorded, with what is wrong.

    Args:
        store: the folder of the store.
        files: size and checksum by path inside the store.
        deep: read every file and compare checksums, not only sizes.
    """
    wrong = {}
    folder = os.fspath(store)
    for name, (size, checksum) in files.items():
        path = f"{folder}/{name}"
        try:
            found = os.stat(path).st_size
            if found != size:
                wrong[name] = f"{found} of {size} bytes"
            elif deep:
                with open(path, "rb") as file:
                    if zlib.crc32(file.read()) != checksum:
                        wrong[name] = "checksum differs"
        except FileNotFoundError:
            wrong[name] = "missing"
        except OSError as error:
            wrong[name] = error.strerror or str(error)
    return wrong


@dataclass
class Survey:
    """Which chunks of a store are there.

    Attributes:
        records: commit record of every stored chunk.
        damaged: file and reason for every committed chunk that is not usable.
    """

    records: dict[int, dict[str, Any]] = field(default_factory=dict)
    damaged: dict[int, dict[str, str]] = field(default_factory=dict)

    @property
    def damage(self) -> list[str]:
        """One line per damaged file."""
        return [f"{name} ({why})" for files in self.damaged.values() for name, why in files.items()]


def survey(store: Path, contents: list[str] | tuple[str, ...], deep: bool = False) -> Survey:
    """Look at every commit record and at the files it lists.

    Args:
        store: the folder of the store.
        contents: wanted content hash of each chunk.
        deep: read every file and compare checksums, not only sizes.
    """
    result = Survey()
    for chunk, content in enumerate(contents):
        try:
            record = read_checked(store / record_file(chunk))
        except DamagedError as error:
            result.damaged[chunk] = {record_file(chunk): str(error)}
            continue
        if record is None:
            continue
        if record["content"] != content:
            result.damaged[chunk] = {record_file(chunk): "of other scenarios or variables"}
        elif wrong := changed(store, record["files"], deep):
            result.damaged[chunk] = wrong
        else:
            result.records[chunk] = record
    return result


def all_records(store: Path) -> dict[int, dict[str, Any]]:
    """Every readable commit record of a store, whatever the manifest says."""
    found = {}
    for path in sorted((store / COMMITS).glob("*.json")):
        if re.fullmatch(r"\d+", path.stem):
            try:
                record = read_checked(path)
            except DamagedError:
                continue
            if record is not None and record["chunk"] == int(path.stem):
                found[record["chunk"]] = record
    return found


def open_manifest(path: str | Path) -> tuple[Path, dict[str, Any]]:
    """The store at a path and its manifest, with the fixed files checked.

    Raises:
        InputError: if there is no store, or if its fixed files are damaged.
    """
    store = store_path(path)
    again = "Give the command of the study again: it repairs what can be repaired and keeps the rest"
    try:
        manifest = read_checked(store / MANIFEST)
    except DamagedError as error:
        raise InputError("store", str(store), f"an undamaged store ({MANIFEST} is {error})", again) from None
    if manifest is None:
        if (store / COMMITS).is_dir():
            raise InputError("store", str(store), f"an undamaged store ({MANIFEST} is missing)", again)
        beside = ", ".join(sorted(other.name for other in store.parent.glob("*.zarr") if other != store))
        hint = f"This folder holds {beside}" if beside else "Run the study first: jaxmpc study run STUDY"
        raise InputError("store", str(store), "the store of a sweep study", hint)
    if wrong := changed(store, manifest["files"], deep=True):
        named = ", ".join(f"{name} ({why})" for name, why in wrong.items())
        raise InputError("store", str(store), f"an undamaged store (damaged: {named})", again)
    return store, manifest
