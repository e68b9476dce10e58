"""Writing of files: what is replaced, what is followed, what is written to, and what is refused beforehand."""

import errno
import json
import math
import os
import socket
import stat
import threading
import tomllib
from pathlib import Path

import numpy as np
import pytest

from jaxmpc.errors import InputError
from jaxmpc.files import (
    check_folder,
    check_target,
    from_strict_json,
    strict_json,
    toml_text,
    write_atomically,
)

posix = pytest.mark.skipif(os.name != "posix", reason="modes, links and pipes of POSIX")
pytestmark = posix


def mode_of(path) -> int:
    return stat.S_IMODE(os.stat(path).st_mode)


@pytest.fixture
def umask():
    """The umask, to be set by a test and restored after it."""
    before = os.umask(0o022)
    yield os.umask
    os.umask(before)


@pytest.fixture
def character_device(tmp_path) -> Path:
    """A private null device."""
    path = tmp_path / "null"
    try:
        os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 3))
        with open(path, "wb") as file:
            file.write(b"nothing")
    except PermissionError:
        pytest.skip("device nodes are not permitted here")
    return path


def received(pipe: Path, write) -> bytes:
    """What arrives in a pipe while `write` runs."""
    got = []
    reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()), daemon=True)
    reader.start()
    write()
    reader.join(timeout=60)
    return got[0]


CONTENTS = {
    "text": ("naïve", "naïve".encode()),
    "bytes": (b"\x00\xff", b"\x00\xff"),
    "function": (lambda path: Path(path).write_text("made"), b"made"),
}
each_content = pytest.mark.parametrize(("content", "plain"), CONTENTS.values(), ids=list(CONTENTS))


# ---------------------------------------------------------------------------------------------- regular files


@each_content
def test_a_new_file_has_the_mode_of_the_umask_and_its_folders_are_made(tmp_path, umask, content, plain):
    umask(0o027)
    path = write_atomically(tmp_path / "a" / "b" / "new", content)
    assert path.read_bytes() == plain
    assert mode_of(path) == 0o640
    assert [entry.name for entry in path.parent.iterdir()] == ["new"]


@each_content
@pytest.mark.parametrize("mode", [0o600, 0o644, 0o664, 0o755])
def test_a_file_that_is_replaced_keeps_its_mode(tmp_path, content, plain, mode):
    path = tmp_path / "old"
    path.write_text("old")
    path.chmod(mode)
    write_atomically(path, content)
    assert path.read_bytes() == plain
    assert mode_of(path) == mode


@pytest.mark.skipif(
    not hasattr(os, "getuid") or os.getuid() != 0, reason="only the superuser gives files away"
)
def test_a_file_that_is_replaced_keeps_its_owner(tmp_path):
    path = tmp_path / "old"
    path.write_text("old")
    os.chown(path, 12345, 54321)
    write_atomically(path, "new")
    assert (path.stat().st_uid, path.stat().st_gid) == (12345, 54321)


def test_a_file_without_write_permission_is_not_replaced(tmp_path):
    path = tmp_path / "kept"
    path.write_text("kept")
    path.chmod(0o444)
    with pytest.raises(InputError, match="0444 does not let it be written") as caught:
        check_target("--out", path)
    assert caught.value.field == "--out"
    with pytest.raises(PermissionError, match="kept"):
        write_atomically(path, "new")
    assert (path.read_text(), mode_of(path)) == ("kept", 0o444)


@each_content
def test_a_write_that_fails_leaves_the_old_content_and_nothing_else(tmp_path, content, plain, monkeypatch):
    path = tmp_path / "old"
    path.write_text("old")

    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left on device") as caught:
        write_atomically(path, content)
    assert caught.value.filename == str(path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["old"]
    assert path.read_text() == "old"


def test_a_name_as_long_as_names_can_be_is_written(tmp_path):
    path = tmp_path / ("n" * os.pathconf(tmp_path, "PC_NAME_MAX"))
    check_target("--out", path)
    assert write_atomically(path, "x").read_text() == "x"


# ------------------------------------------------------------------------------------------------------ links


def test_a_link_stays_and_the_file_it_names_is_replaced_in_one_go_with_its_mode(tmp_path):
    (tmp_path / "folder").mkdir()
    target, link, outer = tmp_path / "folder" / "target", tmp_path / "link", tmp_path / "outer"
    target.write_text("old")
    target.chmod(0o600)
    link.symlink_to(Path("folder", "target"))
    outer.symlink_to(link)
    before = target.stat().st_ino
    write_atomically(outer, "new")
    assert outer.is_symlink()
    assert link.is_symlink()
    assert not target.is_symlink()
    assert target.read_text() == "new"
    assert target.stat().st_ino != before
    assert mode_of(target) == 0o600


def test_a_link_to_nothing_stays_and_what_it_names_is_made(tmp_path):
    link = tmp_path / "link"
    link.symlink_to("made")
    check_target("--out", link)
    write_atomically(link, "new")
    assert link.is_symlink()
    assert (tmp_path / "made").read_text() == "new"


def test_links_in_a_circle_are_refused(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(InputError, match="--out"):
        check_target("--out", tmp_path / "a")
    with pytest.raises(OSError, match="symbolic links"):
        write_atomically(tmp_path / "a", "x")


# -------------------------------------------------------------------------------------------- pipes and devices


@each_content
@pytest.mark.parametrize("linked", [False, True], ids=["pipe", "link to a pipe"])
def test_a_pipe_receives_the_content_and_stays(tmp_path, content, plain, linked):
    pipe = path = tmp_path / "pipe"
    os.mkfifo(pipe)
    if linked:
        path = tmp_path / "link"
        path.symlink_to(pipe)
    check_target("--out", path)
    assert received(pipe, lambda: write_atomically(path, content)) == plain
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert path.is_symlink() == linked


@each_content
def test_a_character_device_receives_the_content_and_stays(tmp_path, character_device, content, plain):
    link = tmp_path / "link"
    link.symlink_to(character_device)
    for path in (character_device, link):
        check_target("--out", path)
        write_atomically(path, content)
    assert stat.S_ISCHR(character_device.stat().st_mode)
    assert link.is_symlink()
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["link", "null"]


def test_a_pipe_whose_reader_leaves_is_named(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: os.close(os.open(pipe, os.O_RDONLY)), daemon=True)
    reader.start()
    with pytest.raises(BrokenPipeError) as caught:
        write_atomically(pipe, b"x" * 10_000_000)
    reader.join()
    assert caught.value.filename == str(pipe)


def test_a_folder_and_a_socket_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("socket")
        for path, reason in ((tmp_path, "folder"), (tmp_path / "socket", "neither a file, a pipe nor")):
            with pytest.raises(InputError, match=reason):
                check_target("--out", path)
            with pytest.raises(OSError, match=reason):
                write_atomically(path, "x")
    assert stat.S_ISSOCK((tmp_path / "socket").stat().st_mode)


# --------------------------------------------------------------------------------------------- refused beforehand


def test_the_input_is_refused_by_every_name_it_has(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = tmp_path / "case.json"
    given.write_text("{}")
    (tmp_path / "link").symlink_to(given)
    os.link(given, tmp_path / "hard")
    for name in (given, Path("case.json"), tmp_path / "link", tmp_path / "hard"):
        with pytest.raises(InputError, match="it is the input"):
            check_target("--out", name, [given])
    check_target("--out", tmp_path / "other.json", [given, tmp_path / "missing"])


def test_a_target_inside_a_folder_that_is_read_is_refused(tmp_path):
    store = tmp_path / "a.zarr"
    store.mkdir()
    (tmp_path / "b.zarr").symlink_to(store)
    for path in (store / "zarr.json", tmp_path / "b.zarr" / "deep" / "x"):
        with pytest.raises(InputError, match="inside the input"):
            check_target("FILE", path, [store])
    check_target("FILE", tmp_path / "a.zarr.csv", [store])


@pytest.mark.parametrize(
    "name",
    ["n" * 300, f"new/{'n' * 300}", f"{'n' * 300}/x", "file/x", "file/deep/x", "null\0character"],
    ids=["long", "long in a new folder", "long folder", "below a file", "far below a file", "null character"],
)
def test_a_name_that_no_file_can_have_is_refused_and_no_folder_is_made(tmp_path, name):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="a file that can be written"):
        check_target("--out", tmp_path / name)
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("name", ["file", "file/x", "n" * 300, f"new/{'n' * 300}", "null\0character", "loop"])
def test_a_folder_that_cannot_be_written_is_refused_and_none_is_made(tmp_path, name):
    (tmp_path / "file").write_text("")
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(InputError, match="a folder that can be written"):
        check_folder("--out", tmp_path / name)
    for good in (tmp_path, tmp_path / "new" / "folder"):
        check_folder("--out", good)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "loop"]


def test_what_is_checked_stays_as_it_is(tmp_path):
    path = tmp_path / "old"
    path.write_text("old")
    before = path.stat()
    check_target("--out", path)
    check_target("--out", tmp_path / "new" / "folder" / "x")
    assert path.stat() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["old"]


@pytest.mark.parametrize(
    "value",
    [{"a": [1, 2.5, math.inf, -math.inf]}, ["inf", "'inf", "''nan", "info", "'"], None, True, {"": {}}],
)
def test_numbers_and_texts_survive_strict_json(value):
    written = json.dumps(strict_json(value), allow_nan=False)
    assert from_strict_json(json.loads(written)) == value


def test_an_array_becomes_lists_that_are_read_back_to_the_last_bit():
    array = np.array([[0.1, np.nan], [np.inf, 1 / 3]])
    again = from_strict_json(json.loads(json.dumps(strict_json(array), allow_nan=False)))
    np.testing.assert_array_equal(np.array(again), array)


def test_a_table_that_is_written_as_toml_reads_back_the_same():
    body = {
        "name": 'a "quoted" \\ name\n\x7f\x01é',
        "numbers": [1, 2.5, 1e-300, -math.inf, 0.1 + 0.2, 1e22],
        "flags": [True, False],
        "empty": {},
        "none": [],
        "model": {"point": {"a.b": 1.0, "ü": {"deep": [[1, 2], [3]]}}, "list": [{"x": 1}, {"y": {"z": "t"}}]},
        "presets": {"first": {"weight": {"a": 1.0}}, "odd name": {}},
        "cv": [{"name": "a", "span": 2.0, "actuator": {"kind": "stepped", "step": 0.5}}, {"name": "b"}],
    }
    assert tomllib.loads(toml_text(body)) == body
