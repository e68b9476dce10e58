"""The cache of built FMUs, compiled programs and recordings: private to the user, and mended when a file in it is damaged.

What lies in it is run as code, so a folder that others can write to, or that is another's, is not used. Archives carry the
digest of their own content; a compiled program that JAX cannot load is removed, for JAX itself never writes over one.
"""

from __future__ import annotations

import contextlib
import functools
import os
from pathlib import Path

from jaxmpc.programs.compilation import say

SEAL = 64  # hexadecimal digits of a SHA-256
LEAST = 0.02  # s that a program takes to compile from which it is kept: reading one takes some milliseconds
EMITTERS = ((0, 7), (0, 10))  # first and last version of jaxlib in which XLA lets choose its CPU emitters


def cache_folder(kind: str) -> Path:
    """The folder for ``fmu``, ``jit`` or ``bench``, made if missing: in ``$JAXMPC_CACHE``, or in ``~/.cache/jaxmpc``.

    If that cannot be used, standard error says why, and a private folder among the temporary files serves this process
    and those that it starts.

    Raises:
        OSError: if no folder can be made anywhere.
    """
    try:
        given = os.environ.get("JAXMPC_CACHE")
        root = Path(given).absolute() if given else Path.home() / ".cache" / "jaxmpc"
        return _private(_private(root) / kind)
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home directory
        root = _temporary()
        say(f"the cache is in {root}: {str(error).rstrip('.')}; JAXMPC_CACHE moves it")
        os.environ["JAXMPC_CACHE"] = str(root)
        return _private(root / kind)


def _private(folder: Path) -> Path:
    """The folder, made if missing, for this user alone.

    Raises:
        OSError: if it cannot be made or written, if others can write to it, or if it is another user's.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    if os.name == "posix":
        known = folder.stat()
        if known.st_uid != os.getuid():
            raise PermissionError(f"{folder} belongs to another user, and what is in a cache is run as code")
        if known.st_mode & 0o022:
            raise PermissionError(
                f"{folder} can be written by others, and what is in a cache is run as code "
                "(remove it, or make it private with chmod 700 if you trust what is in it)"
            )
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(f"{folder} cannot be written")
    return folder


def _temporary() -> Path:
    """A private folder for temporary files, the same for every process of the user if that is possible."""
    import tempfile

    folder = Path(tempfile.gettempdir()) / f"jaxmpc-cache-{os.getuid() if os.name == 'posix' else 'user'}"
    with contextlib.suppress(OSError):
        if not folder.is_symlink():
            return _private(folder)
    return Path(tempfile.mkdtemp(prefix="jaxmpc-cache-"))


def sealed(archive: bytes) -> bytes:
    """A zip archive that ends, as its comment, in the SHA-256 of everything before.

    Args:
        archive: without a comment.
    """
    import hashlib

    body = archive[:-2] + SEAL.to_bytes(
        2, "little"
    )  # the length of the comment is the last field of an archive
    return body + hashlib.sha256(body).hexdigest().encode()


def read_sealed(path: Path) -> bytes | None:
    """Content of a sealed archive in the cache; `None` if there is none.

    One that is damaged counts as none, and is removed; standard error says so.
    """
    import hashlib

    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        content, reason = b"", f" ({error.strerror})"
    else:
        reason = ""
    if hashlib.sha256(content[:-SEAL]).hexdigest().encode() == content[-SEAL:]:
        return content
    say(f"{path} is damaged{reason}; it is made anew")
    with contextlib.suppress(OSError):
        path.unlink()
    return None


def compile_quickly() -> None:
    """Let XLA compile for a CPU without its newer emitters, which take twice as long for code that is no faster.

    Only for versions that are known to have the choice: an unknown one ends the process. Too late once XLA is in use.
    """
    import jaxlib.version

    flags, choice = os.environ.get("XLA_FLAGS", ""), "--xla_cpu_use_fusion_emitters"
    if choice not in flags and EMITTERS[0] <= jaxlib.version.__version_info__[:2] <= EMITTERS[1]:
        os.environ["XLA_FLAGS"] = f"{flags} {choice}=false".strip()


def keep_programs() -> None:
    """Let JAX keep compiled programs, in the folder of ``$JAX_COMPILATION_CACHE_DIR`` or in the cache.

    JAX only warns of a kept program that it cannot load, compiles it, and leaves the file as it is, so that every start
    compiles it again. Here such a file is removed before JAX compiles, and so JAX writes it anew.
    """
    import jax

    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        try:
            jax.config.update("jax_compilation_cache_dir", str(cache_folder("jit")))
        except OSError as error:
            say(f"compiled programs are not kept: {error}")
            return
        jax.config.update("jax_persistent_cache_min_compile_time_secs", LEAST)
    # JAX has no public hook; without this function only the mending is missing.
    with contextlib.suppress(ImportError, AttributeError):
        from jax._src import compilation_cache

        compilation_cache.get_executable_and_time = _mending(compilation_cache.get_executable_and_time)


def _mending(load):
    """A loader of kept programs that removes one that does not load and reports it as missing."""

    @functools.wraps(load)
    def mended(key, *arguments, **options):
        try:
            return load(key, *arguments, **options)
        except Exception as error:
            import jax

            folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
            kept = Path(folder or "") / f"{key}-cache"
            if not kept.is_file():
                raise
            kept.unlink()
            say(f"{kept} is damaged ({type(error).__name__}); it is compiled anew")
            return None, None

    return mended
