"""The cache: private to the user, and mended where it is damaged."""

import io
import os
import stat
import subprocess
import sys
import textwrap
import zipfile
from pathlib import Path

import pytest

from jaxmpc.programs import cache
from jaxmpc.programs.cache import cache_folder, read_sealed, sealed

POSIX = pytest.mark.skipif(os.name != "posix", reason="modes and owners are of POSIX")


@pytest.fixture
def home(tmp_path, monkeypatch):
    """An empty home and an empty folder for temporary files."""
    for name in ("home", "tmp"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("JAXMPC_CACHE", "")  # and it is what it was after the test
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    return tmp_path / "home"


def mode(path):
    return path.stat().st_mode & 0o777


@POSIX
def test_folders_of_the_cache_are_made_for_the_user_alone(home, capsys):
    before = os.umask(0)
    try:
        folder = cache_folder("fmu")
    finally:
        os.umask(before)
    assert folder == home / ".cache" / "jaxmpc" / "fmu"
    assert mode(folder) == mode(folder.parent) == 0o700
    assert cache_folder("fmu") == folder
    assert capsys.readouterr().err == ""


def test_the_environment_moves_the_cache(home, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXMPC_CACHE", str(tmp_path / "own"))
    assert cache_folder("jit") == tmp_path / "own" / "jit"


@POSIX
def test_a_folder_that_others_can_only_read_is_used(home, capsys):
    folder = home / ".cache" / "jaxmpc"
    folder.mkdir(parents=True)
    folder.chmod(0o755)
    assert cache_folder("fmu") == folder / "fmu"
    assert capsys.readouterr().err == ""


def not_private(root, monkeypatch):
    root.chmod(0o775)


def not_private_inside(root, monkeypatch):
    (root / "fmu").chmod(0o777)


def of_another_user(root, monkeypatch):
    monkeypatch.setattr(os, "getuid", lambda: root.stat().st_uid + 1)


@POSIX
@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (not_private, "can be written by others"),
        (not_private_inside, "can be written by others"),
        (of_another_user, "belongs to another user"),
    ],
)
def test_a_folder_that_others_can_fill_is_not_used(home, tmp_path, monkeypatch, capsys, spoil, reason):
    folder = cache_folder("fmu")
    (folder / "planted").touch()
    spoil(folder.parent, monkeypatch)
    real = os.getuid()
    if spoil is of_another_user:  # what is made from now on is of the other one
        monkeypatch.setattr(cache, "_temporary", lambda: own(tmp_path / "tmp" / "own", real, monkeypatch))
    instead = cache_folder("fmu")
    assert instead.is_relative_to(tmp_path / "tmp")
    assert mode(instead) == mode(instead.parent) == 0o700
    assert list(instead.iterdir()) == []
    said = capsys.readouterr().err
    assert said.startswith(f"jaxmpc: the cache is in {instead.parent}: ")
    assert reason in said
    assert said.count("\n") == 1
    assert cache_folder("fmu") == instead  # said once, also for processes that this one starts
    assert os.environ["JAXMPC_CACHE"] == str(instead.parent)
    assert capsys.readouterr().err == ""


def own(folder, user, monkeypatch):
    folder.mkdir(mode=0o700)
    monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid)
    return folder


@POSIX
def test_without_a_home_directory_a_private_folder_serves(home, tmp_path, monkeypatch, capsys):
    def none():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", none)
    folder = cache_folder("jit")
    assert folder.is_relative_to(tmp_path / "tmp")
    assert mode(folder) == 0o700
    assert "Could not determine home directory" in capsys.readouterr().err


@POSIX
def test_a_home_that_is_no_folder_is_no_obstacle(home, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    assert cache_folder("jit").is_relative_to(tmp_path / "tmp")
    assert str(tmp_path / "file") in capsys.readouterr().err


@POSIX
def test_a_planted_folder_for_temporary_files_is_not_used(home, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", "/dev/null")
    planted = tmp_path / "tmp" / f"jaxmpc-cache-{os.getuid()}"
    planted.mkdir()
    planted.chmod(0o777)
    first = cache_folder("jit")
    assert not first.is_relative_to(planted)
    monkeypatch.setenv("JAXMPC_CACHE", "")
    planted.rmdir()
    planted.symlink_to(tmp_path / "home")
    assert not cache_folder("jit").resolve().is_relative_to(tmp_path / "home")


def test_a_sealed_archive_is_an_archive_and_any_change_is_seen(tmp_path, capsys):
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as zipped:
        zipped.writestr("content", "text")
    content = sealed(archive.getvalue())
    path = tmp_path / "file.zip"
    path.write_bytes(content)
    assert zipfile.ZipFile(path).read("content") == b"text"
    assert read_sealed(path) == content
    for i in range(len(content)):
        path.write_bytes(content[:i] + bytes([content[i] ^ 255]) + content[i + 1 :])
        assert read_sealed(path) is None
        assert not path.exists()
        path.write_bytes(content[:i])
        assert read_sealed(path) is None
    assert capsys.readouterr().err.count("is damaged; it is made anew\n") == 2 * len(content)
    assert read_sealed(tmp_path / "none.zip") is None
    assert capsys.readouterr().err == ""


COMPILES = """
    import logging, sys
    from pathlib import Path
    import jaxmpc
    import jax, jax.numpy as jnp

    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    folder = Path(jax.config.jax_compilation_cache_dir)
    hits = []
    jax.monitoring.register_event_listener(lambda event, **_: hits.append(event) if "cache_hits" in event else None)

    def kept():
        jax.clear_caches()
        hits.clear()
        assert jax.jit(lambda x: jnp.sin(x) @ x)(jnp.arange(3.0)) > 0
        return len(hits), {p.name: p.stat().st_size for p in folder.glob("*-cache")}

    count, sound = kept()
    assert count == 0 and sound, (count, sound)
    count, again = kept()
    assert count == len(sound) and again == sound, (count, again)
    for damage in (lambda content: content[: len(content) // 2], lambda content: b"garbage", lambda content: b""):
        for name in sound:
            path = folder / name
            path.write_bytes(damage(path.read_bytes()))
        print("damaged", file=sys.stderr)
        count, mended = kept()
        assert count == 0 and mended.keys() == sound.keys(), (count, mended)
        count, again = kept()
        assert count == len(sound) and again == mended, (count, again)
"""


def test_a_damaged_compiled_program_is_compiled_once_and_kept_anew(tmp_path):
    environment = {**os.environ, "JAXMPC_CACHE": str(tmp_path)}
    for name in ("JAX_COMPILATION_CACHE_DIR", "JAXMPC_NO_JIT_CACHE"):
        environment.pop(name, None)
    command = [sys.executable, "-W", "error", "-c", textwrap.dedent(COMPILES)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stderr.splitlines() if line != "damaged"]
    count = len(list((tmp_path / "jit").glob("*-cache")))
    assert len(lines) == 3 * count
    assert all(line.startswith(f"jaxmpc: {tmp_path / 'jit'}") for line in lines)
    assert all(line.endswith("; it is compiled anew") for line in lines)


def in_a_new_process(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python code as a user without a home directory."""
    without = {k: v for k, v in os.environ.items() if k not in ("HOME", "JAXMPC_CACHE")}
    nobody = "import os, pwd\ndef none(*_): raise KeyError('no entry')\npwd.getpwuid = none\n"
    return subprocess.run(
        [sys.executable, "-c", nobody + code],
        env=without | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_without_a_home_directory_the_cache_is_a_private_folder_and_one_line_says_so(tmp_path):
    code = "import jaxmpc, jax\nfrom jaxmpc.programs.cache import cache_folder\n"
    code += "print(jax.config.jax_compilation_cache_dir, cache_folder('fmu'))"
    run = in_a_new_process(code, TMPDIR=str(tmp_path))
    assert run.returncode == 0
    jit, fmu = map(Path, run.stdout.split())
    assert jit.parent == fmu.parent
    assert jit.parent.parent == tmp_path
    assert stat.S_IMODE(jit.parent.stat().st_mode) == 0o700
    assert run.stderr.count("\n") == 1
    assert str(jit.parent) in run.stderr
    assert "JAXMPC_CACHE" in run.stderr


@pytest.mark.parametrize(
    ("version", "given", "flags"),
    [
        ((0, 7, 0), "", "--xla_cpu_use_fusion_emitters=false"),
        ((0, 10, 9), "--xla_dump_to=d", "--xla_dump_to=d --xla_cpu_use_fusion_emitters=false"),
        ((0, 10, 0), "--xla_cpu_use_fusion_emitters=true", "--xla_cpu_use_fusion_emitters=true"),
        ((0, 11, 0), "", ""),  # it may not know the choice, and would end the process
        ((1, 0, 0), "", ""),
    ],
)
def test_quick_emitters_are_chosen_where_xla_has_them_and_nobody_else_chose(
    version, given, flags, monkeypatch
):
    monkeypatch.setattr("jaxlib.version.__version_info__", version)
    monkeypatch.setenv("XLA_FLAGS", given)
    cache.compile_quickly()
    assert os.environ["XLA_FLAGS"] == flags


def test_a_process_that_imports_the_package_compiles_with_the_quick_emitters():
    script = "import os, jaxmpc, jax.numpy as jnp; print(os.environ['XLA_FLAGS'], float(jnp.ones(3).sum()))"
    env = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=env, check=True)
    assert run.stdout.split() == ["--xla_cpu_use_fusion_emitters=false", "3.0"]
