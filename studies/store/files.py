"""What lies in a store and whether it is what was written: the manifest of its fixed files, one commit record per
finished chunk, and the checksums of both.

The checksum is Zarr's own: every file of an array ends in the CRC-32C of what stands before it, so that any Zarr reader
notices a flipped bit, and the manifest and the records are arrays of text like any other. What Zarr does not notice is
a file that is gone, which reads as empty: so a record lists the files of its chunk with their sizes. A chunk counts as
stored only if its record is whole, is of the wanted content, and every file of it is there in full size; ``deep`` also
reads the files. The manifest lists the fixed files and holds the CRC-32C of the metadata, which end in none. Nothing
here writes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import google_crc32c

from jaxmpc.errors import InputError

FORMAT = "jaxmpc/store/1"
OLD_FORMATS = ("jaxmpc/results/1", "jaxmpc/sweep/1")
STORE = "study.zarr"  # of a sweep, in a folder that is not a store itself
RESULTS = "results.zarr"  # of a comparison
COMMITS = "commits"
MANIFEST = "manifest/c"
_HEADER = 8  # bytes before an array's only text: how many texts, and how long it is
_CHECKSUM = 4  # bytes


class DamagedError(Exception):
    """A file is there but is not what was written."""


def store_path(path: str | Path) -> Path:
    """The store that a user means: a path ending in ``.zarr`` is the store, any other is a folder that holds it."""
    path = Path(path)
    if path.suffix == ".zarr":
        return path
    return path / (RESULTS if (path / RESULTS).exists() else STORE)


def record_file(chunk: int) -> str:
    """Path of a commit record inside the store."""
    return f"{COMMITS}/c.{chunk}"


def chunk_file(variable: str, dims: int, chunk: int) -> str:
    """Path of a Zarr chunk inside the store, for a variable with `dims` axes after the slot."""
    return f"{variable}/c.{chunk}" + ".0" * dims


def text_content(body: dict[str, Any]) -> bytes:
    """The file that Zarr writes for an array of one text, here a JSON object."""
    text = json.dumps(body, default=lambda value: value.item()).encode()  # numpy scalars become numbers
    content = (1).to_bytes(4, "little") + len(text).to_bytes(4, "little") + text
    return content + google_crc32c.value(content).to_bytes(_CHECKSUM, "little")


def checked(content: bytes) -> bytes:
    """The content of a file of an array without its checksum.

    Raises:
        DamagedError: if it is not what was written.
    """
    body, checksum = content[:-_CHECKSUM], content[-_CHECKSUM:]
    if google_crc32c.value(body).to_bytes(_CHECKSUM, "little") != checksum:
        raise DamagedError("checksum differs")
    return body


def read_text(path: Path) -> dict[str, Any] | None:
    """Read what `text_content` gave; `None` if there is no such file.

    Raises:
        DamagedError: if it is not what was written.
    """
    try:
        return json.loads(checked(path.read_bytes())[_HEADER:])
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise DamagedError("not readable") from error


def changed(
    store: Path, files: Mapping[str, int], deep: bool, checksums: Mapping[str, int] | None = None
) -> dict[str, str]:
    """Files that are missing or not as written, with what is wrong.

    Args:
        files: size by path inside the store.
        deep: read every file and compare checksums, not only sizes.
        checksums: CRC-32C of the files that do not end in it.
    """
    wrong, folder, own = {}, os.fspath(store), checksums or {}
    for name, size in files.items():
        path = f"{folder}/{name}"
        try:
            found = os.stat(path).st_size
            if found != size:
                wrong[name] = f"{found} of {size} bytes"
            elif deep:
                with open(path, "rb") as file:
                    content = file.read()
                if name not in own:
                    checked(content)
                elif google_crc32c.value(content) != own[name]:
                    raise DamagedError("checksum differs")
        except FileNotFoundError:
            wrong[name] = "missing"
        except OSError as error:
            wrong[name] = error.strerror or str(error)
        except DamagedError as error:
            wrong[name] = str(error)
    return wrong


def changed_fixed(store: Path, manifest: dict[str, Any]) -> dict[str, str]:
    """Fixed files that are missing or not as written, with what is wrong."""
    return changed(store, manifest["files"], deep=True, checksums=manifest["checksums"])


def named(wrong: Mapping[str, str]) -> str:
    """Damaged files and what is wrong with them, in one line."""
    return ", ".join(f"{name} ({why})" for name, why in wrong.items())


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


def survey(store: Path, contents: Sequence[str], deep: bool = False) -> Survey:
    """Look at every commit record and at the files it lists."""
    result = Survey()
    for chunk, content in enumerate(contents):
        try:
            record = read_text(store / record_file(chunk))
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


def all_records(store: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Every readable commit record of a store, whatever the manifest says."""
    for path in sorted((store / COMMITS).glob("c.*")):
        try:
            record = read_text(path)
        except DamagedError:
            continue
        if record is not None and path.name == f"c.{record['chunk']}":
            yield record["chunk"], record


def attribute(store: Path, key: str) -> str | None:
    """A fact of the root group, without help of the manifest."""
    try:
        return str(json.loads((store / "zarr.json").read_bytes())["attributes"][key])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def open_manifest(path: str | Path) -> tuple[Path, dict[str, Any]]:
    """The store at a path and its manifest, with the fixed files checked.

    Raises:
        InputError: if there is no store, it is of an older version, or its fixed files are damaged.
    """
    store = store_path(path)
    again = "Give the command of the study again: it repairs what can be repaired and keeps the rest"
    try:
        manifest = read_text(store / MANIFEST)
    except DamagedError as error:
        raise InputError("store", str(store), f"an undamaged store ({MANIFEST} is {error})", again) from None
    if manifest is None:
        if attribute(store, "format") in OLD_FORMATS:
            hint = "Give the command of the study again: it keeps these results beside the new ones"
            raise InputError("store", str(store), "a store of this version, not of an older one", hint)
        if (store / COMMITS).is_dir():
            raise InputError("store", str(store), f"an undamaged store ({MANIFEST} is missing)", again)
        beside = ", ".join(sorted(other.name for other in store.parent.glob("*.zarr") if other != store))
        hint = f"This folder holds {beside}" if beside else "Run the study first: jaxmpc study run STUDY"
        raise InputError("store", str(store), "a readable store of a study", hint)
    if wrong := changed_fixed(store, manifest):
        raise InputError("store", str(store), f"an undamaged store (damaged: {named(wrong)})", again)
    return store, manifest
