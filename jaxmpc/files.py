"""Files that are written, the one place where that happens: a regular file is replaced in one go or not at all, a link
is followed, a pipe or a character device is written to. `check_target` refuses beforehand what could not be written.
`strict_json` is how numbers that JSON has no word for stand in them, `toml_text` how a table becomes a TOML file.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import secrets
import stat
import tempfile
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.errors import InputError, near

Content = str | bytes | Callable[[str], object]
NOT_FINITE = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}  # numbers that JSON has no word for


def strict_json(value: Any) -> Any:
    """JSON-like values and arrays in what every JSON reader takes: numbers that are not finite become the texts of
    `NOT_FINITE`, arrays nested lists. A text that is one of these words itself gets an apostrophe before it.
    """
    if isinstance(value, Mapping):
        return {str(key): strict_json(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [strict_json(entry) for entry in value]
    if isinstance(value, str):
        return f"'{value}" if value.lstrip("'") in NOT_FINITE else value
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    return value if value is None or isinstance(value, int) else strict_json(np.asarray(value).tolist())


def from_strict_json(value: Any) -> Any:
    """What `strict_json` was given, with arrays as lists."""
    if isinstance(value, dict):
        return {key: from_strict_json(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [from_strict_json(entry) for entry in value]
    if isinstance(value, str) and value.lstrip("'") in NOT_FINITE:
        return NOT_FINITE.get(value, value[1:])
    return value


def json_by_field(body: dict[str, Any], **options: Any) -> str:
    """The text of a JSON object with a line per field; options of `json.dumps`."""
    fields = (f" {json.dumps(key)}: {json.dumps(value, **options)}" for key, value in body.items())
    return "{\n" + ",\n".join(fields) + "\n}\n"


def toml_text(body: Mapping[str, Any]) -> str:
    """The text of a TOML file: values first, then a header per table, list of tables and table of tables."""
    heads: list[str] = []
    values = {}
    for name, value in body.items():
        if isinstance(value, Mapping) and value and all(isinstance(one, Mapping) for one in value.values()):
            heads += [
                _headed(f"[{_toml_key(name)}.{_toml_key(inner)}]", table) for inner, table in value.items()
            ]
        elif isinstance(value, Mapping):
            heads += [_headed(f"[{_toml_key(name)}]", value)]
        elif isinstance(value, (list, tuple)) and value and all(isinstance(one, Mapping) for one in value):
            heads += [_headed(f"[[{_toml_key(name)}]]", table) for table in value]
        else:
            values[name] = value
    return "\n\n".join(["\n".join(toml_keys(values)), *heads]).strip() + "\n"


def _headed(head: str, table: Mapping[str, Any]) -> str:
    return "\n".join([head, *(f"{_toml_key(name)} = {toml_value(value)}" for name, value in table.items())])


def toml_keys(table: Mapping[str, Any], prefix: str = "") -> list[str]:
    """A table as lines of TOML with dotted keys; lists of tables are written within their line."""
    lines = []
    for name, value in table.items():
        key = prefix + _toml_key(name)
        lines += (
            toml_keys(value, f"{key}.") if isinstance(value, Mapping) else [f"{key} = {toml_value(value)}"]
        )
    return lines


def toml_value(value: Any) -> str:
    """A value within its line; numbers in as many digits as bring them back."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return "nan" if math.isnan(value) else repr(float(value))
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{_toml_key(k)} = {toml_value(v)}' for k, v in value.items())} }}"
    return (
        json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        if isinstance(value, str)
        else str(value)
    )


def _toml_key(name: str) -> str:
    bare = name.replace("_", "").replace("-", "").isalnum() and name.isascii()
    return name if bare else json.dumps(name, ensure_ascii=False)


def read_named_toml(
    field: str, name_or_path: str | Path, shipped: Mapping[str, Path], what: str, folder: str | Path = "."
) -> tuple[Path, dict[str, Any]]:
    """A TOML file that comes with the package by its name, or any by its path.

    Args:
        field: that names it, for errors.
        shipped: files by name.
        what: it is, for errors.
        folder: that a path is relative to.

    Returns:
        ``(path, content)``.

    Raises:
        InputError: for an unknown name, a file that cannot be read, and text that is not TOML.
    """
    path = shipped.get(str(name_or_path)) or Path(folder) / name_or_path
    try:
        return path, tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        expected = f"{what}, or one of {', '.join(shipped)} ({error.strerror or error})"
        raise InputError(field, str(name_or_path), expected, near(name_or_path, shipped)) from None
    except (ValueError, RecursionError) as error:
        raise InputError(field, str(path), f"a TOML file ({error})") from None


def read_json(field: str, path: str | Path) -> Any:
    """The content of a JSON file, or an `InputError` that names the path."""
    try:
        return json.loads(Path(path).read_text())
    except (OSError, ValueError, RecursionError) as error:  # no file, no text, no JSON
        raise InputError(field, str(path), f"a readable JSON file ({error})") from error


def write_atomically(path: str | Path, content: Content) -> Path:
    """Write a file so that a crash or a full disk leaves the previous content.

    A regular file gets a new content by a rename: mode and, as far as permitted, owner stay, other hard links keep the
    old content. A new file has the mode of the umask. A link stays and what it names is written. A pipe or a
    character device stays and receives the content.

    Args:
        path: target; missing folders are made.
        content: text (UTF-8), bytes, or a function that writes the file whose path it is given.

    Returns:
        The path that was given.

    Raises:
        OSError: if the target cannot be written; one without any write permission (mode 0444) is not replaced.
    """
    path = Path(path)
    try:
        known = _status(path)
        if known is not None:
            _refuse_kind(path, known)
        if known is None or stat.S_ISREG(known.st_mode):
            _replace(Path(os.path.realpath(path)), content, known)
        else:
            _send(path, content)
    except OSError as error:  # names the file that was asked for, not its temporary neighbour
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    return path


def check_target(field: str, path: str | Path, inputs: Iterable[str | Path] = ()) -> None:
    """Refuse a file that could not be written later; nothing is left behind and nothing is opened.

    Args:
        field: name of the option, for the error.
        path: what is to be written.
        inputs: files that are read, or folders that are read from; the target may not be one of them or inside.

    Raises:
        InputError: naming the path and the reason.
    """
    path = Path(path)
    with _writable(field, path, "file"):
        known = _status(path)
        if known is not None:
            _refuse_kind(path, known)
        for given in inputs:
            _refuse_input(path, known, Path(given))
        if known is None or stat.S_ISREG(known.st_mode):
            _probe(Path(os.path.realpath(path)))


def check_folder(field: str, path: str | Path) -> None:
    """Refuse a folder in which no file could be written later; nothing is made; arguments and errors of `check_target`."""
    with _writable(field, path, "folder"):
        _probe(Path(os.path.realpath(path)) / "file")


@contextlib.contextmanager
def _writable(field: str, path: str | Path, what: str) -> Iterator[None]:
    """Make an `InputError` of what the system refuses."""
    try:
        yield
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(field, str(path), f"a {what} that can be written ({reason})") from None


def _status(path: Path) -> os.stat_result | None:
    """Of what the path names, links followed; None if there is nothing."""
    try:
        return os.stat(path)
    except FileNotFoundError:
        return None


def _refuse_kind(path: Path, known: os.stat_result) -> None:
    """Folders, disks and sockets, and files whose permissions say that they are not to be written."""
    mode = known.st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder", str(path))
    if not (stat.S_ISREG(mode) or stat.S_ISFIFO(mode) or stat.S_ISCHR(mode)):
        raise OSError(errno.EINVAL, "it is neither a file, a pipe nor a character device", str(path))
    if not mode & 0o222 or not os.access(path, os.W_OK):
        reason = f"its mode {stat.S_IMODE(mode):04o} does not let it be written"
        raise PermissionError(errno.EACCES, reason, str(path))


def _refuse_input(path: Path, known: os.stat_result | None, given: Path) -> None:
    """The file that is read, also by another name; a terminal may be both."""
    source = _status(given)
    if source is None:
        return
    if known is not None and os.path.samestat(known, source) and not stat.S_ISCHR(known.st_mode):
        raise OSError(errno.EINVAL, "it is the input", str(path))
    if stat.S_ISDIR(source.st_mode) and Path(os.path.realpath(path)).is_relative_to(os.path.realpath(given)):
        raise OSError(errno.EINVAL, f"it is inside the input {given}", str(path))


def _existing(folder: Path) -> Path:
    """The folder, or the nearest one above it that exists."""
    while not os.path.lexists(folder):
        folder = folder.parent
    return folder


def _probe(target: Path) -> None:
    """Raise what would prevent a new file with this name."""
    folder = _existing(target.parent)
    with tempfile.TemporaryFile(dir=folder):
        pass
    longest = os.pathconf(folder, "PC_NAME_MAX") if hasattr(os, "pathconf") else 255
    if any(len(os.fsencode(part)) > longest for part in target.relative_to(folder).parts):
        raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG), str(target))


def _replace(target: Path, content: Content, known: os.stat_result | None) -> None:
    """Write a temporary neighbour, flush it to the disk, and rename it over the target."""
    target.parent.mkdir(parents=True, exist_ok=True)
    # a short name of its own: the target's may be as long as a name can be
    temporary = target.with_name(f".{target.name[:32]}.{secrets.token_hex(6)}")
    mode = 0o666 if known is None else 0o600  # the system takes the umask off
    os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode))
    try:
        _fill(temporary, content)
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        if known is not None:
            _keep_owner_and_mode(temporary, known)
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _fill(path: Path, content: Content) -> None:
    if callable(content):
        content(str(path))
    else:
        path.write_bytes(content.encode() if isinstance(content, str) else content)


def _keep_owner_and_mode(path: Path, known: os.stat_result) -> None:
    if hasattr(os, "chown"):
        with contextlib.suppress(PermissionError):  # only the superuser may give files away
            os.chown(path, known.st_uid, known.st_gid)
    os.chmod(path, stat.S_IMODE(known.st_mode))


def _send(path: Path, content: Content) -> None:
    """Write to a pipe or a character device, which can be neither sought in nor renamed over."""
    if callable(content):
        with tempfile.TemporaryDirectory(prefix="jaxmpc-") as folder:
            whole = Path(folder, "content")
            content(str(whole))
            content = whole.read_bytes()
    _fill(path, content)
