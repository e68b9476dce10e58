"""The process in which one FMU runs, started by `identify.fmu_process`: unpacks it, loads it, and does what it is told.

It is run as a script and needs only FMPy, so that it starts in a fraction of a second. Requests and replies are lines of
JSON over a socket. Before every call into the FMU it notes in a shared file when the call began and which it is: that is
what the parent tells when the process has died or the call takes too long.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import re
import shutil
import signal
import socket
import stat
import sys
import threading
import time
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

# What an archive may hold; far more than FMUs have, far less than fills a disk.
MAX_FILES = 10_000
MAX_BYTES = 2 * 2**30
MAX_RATIO = 200  # unpacked to packed size: XML packs 20 : 1, a bomb 1000 : 1
MAX_DESCRIPTION_BYTES = 256 * 2**20

NOTE, NOTE_BYTES = "note", 128
UNPACKED = "fmu"
DESCRIPTION = "modelDescription.xml"


class RefusedError(Exception):
    """The file is not an FMU that can be used: what was expected, and a hint."""

    def __init__(self, expected: str, hint: str = ""):
        super().__init__(expected)
        self.expected, self.hint = expected, hint


def check_archive(path: Path, free: int) -> None:
    """Refuse an archive that would leave its folder or fill the `free` bytes of the disk, from its table of contents.

    Unpacking stops at the sizes in the table, so that a table that lies does no harm.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile) as error:
        raise RefusedError(f"a readable FMU, which is a zip archive ({error})") from None
    if len(entries) > MAX_FILES:
        raise RefusedError(f"an archive of at most {MAX_FILES} files (it has {len(entries)})")
    for entry in entries:
        parts = entry.filename.split("/")
        if ".." in parts or not parts[0] or re.search(r"[\\:\0]", entry.filename):
            raise RefusedError(f"an archive whose files stay in its folder ({entry.filename!r} does not)")
        if stat.S_ISLNK(entry.external_attr >> 16):
            raise RefusedError(f"an archive without symbolic links ({entry.filename!r} is one)")
    size = sum(entry.file_size for entry in entries)
    if size > MAX_BYTES:
        raise RefusedError(f"an archive of at most {MAX_BYTES} bytes unpacked (it has {size})")
    if size > MAX_RATIO * path.stat().st_size:
        raise RefusedError(f"an archive that grows at most {MAX_RATIO} times when it is unpacked")
    if size > free:
        raise RefusedError(f"an archive that fits on the disk ({size} bytes unpacked, {free} bytes free)")
    sizes = {entry.filename: entry.file_size for entry in entries}
    if DESCRIPTION not in sizes:
        raise RefusedError(f"an FMU, with a {DESCRIPTION}")
    if sizes[DESCRIPTION] > MAX_DESCRIPTION_BYTES:
        raise RefusedError(f"a {DESCRIPTION} of at most {MAX_DESCRIPTION_BYTES} bytes")


def unpack(path: Path, folder: Path) -> None:
    """Unpack a checked archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder)
    except Exception as error:  # a damaged archive: whatever zipfile and zlib raise
        raise RefusedError(f"an undamaged FMU ({type(error).__name__}: {error})") from None


def read_description(folder: Path) -> Any:
    """FMPy's reading of the model description of a co-simulation FMU of FMI 2.0 or 3.0; refuses other kinds."""
    from fmpy import read_model_description

    try:
        root = ElementTree.parse(folder / DESCRIPTION).getroot()
    except ElementTree.ParseError as error:
        raise RefusedError(f"a {DESCRIPTION} that is XML ({error})") from None
    version = root.get("fmiVersion", "none")
    if not re.match(r"2\.0|3\.", version):
        raise RefusedError(f"an FMU of FMI 2.0 or 3.0 (its version is {version})")
    if root.find("CoSimulation") is None:
        kinds = [kind for kind in ("ModelExchange", "ScheduledExecution") if root.find(kind) is not None]
        expected = f"a co-simulation FMU (it has only: {', '.join(kinds) or 'nothing'})"
        raise RefusedError(expected, "Export it once more for co-simulation")
    try:
        return read_model_description(folder)
    except Exception as error:  # FMPy has no type of its own for most of what it finds
        reason = " ".join(str(error).split())
        raise RefusedError(f"a {DESCRIPTION} that follows the standard ({reason})") from None


def library_of(folder: Path, description: Any) -> Path:
    """The library for this machine; refuses an FMU without."""
    from fmpy import platform, platform_tuple, sharedLibraryExtension

    name = description.coSimulation.modelIdentifier
    here = platform_tuple if description.fmiVersion.startswith("3") else platform
    library = folder / "binaries" / here / f"{name}{sharedLibraryExtension}"
    if library.is_file():
        return library
    others = sorted(other.parent.name for other in folder.glob("binaries/*/*") if other.is_file())
    has, hint = "none", ""
    if others:
        has = f"one for {', '.join(dict.fromkeys(others))}"
    elif any(folder.glob("sources/*")):
        has, hint = "only sources", "Compile it: fmpy compile FILE.fmu"
    raise RefusedError(f"an FMU with a library for {here} (it has {has})", hint)


class Runner:
    """The FMU of this process, its files in a folder; the note receives which call is being made."""

    def __init__(self, folder: Path, note: mmap.mmap):
        self.folder, self._note = folder, note
        self._time, self._used = 0.0, False

    def _begin(self, call: str) -> None:
        text = f"{time.monotonic():.3f} {call}".encode()[:NOTE_BYTES]
        self._note[:] = text.ljust(NOTE_BYTES)

    def load(self, path: str) -> dict[str, Any]:
        """Unpack an FMU, load its library and instantiate it; returns what it says of itself."""
        self._begin("the unpacking")
        check_archive(Path(path), shutil.disk_usage(self.folder).free)
        unpack(Path(path), self.folder)
        self._begin("the reading of its model description")
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        described = read_description(self.folder)
        self.fmi = 3 if described.fmiVersion.startswith("3") else 2
        self._references = {v.name: (v.type, v.valueReference) for v in described.modelVariables}
        library = library_of(self.folder, described)
        self._begin("the loading of its library")
        try:
            self._fmu: Any = (FMU3Slave if self.fmi == 3 else FMU2Slave)(
                guid=described.guid,
                unzipDirectory=str(self.folder),
                modelIdentifier=described.coSimulation.modelIdentifier,
                instanceName="fmu",
            )
        except AttributeError as error:  # how ctypes says that a library has no such function
            missing = f"{str(error).rpartition(' ')[2]} is missing"
            raise RefusedError(
                f"an FMU whose library has every function of FMI {self.fmi} ({missing})"
            ) from None
        except Exception as error:
            reason = str(error).replace(str(library), library.name).replace(str(self.folder) + os.sep, "")
            raise RefusedError(f"an FMU whose library can be loaded ({reason})") from None
        self._begin("its instantiation")
        try:
            self._fmu.instantiate()
        except Exception:
            token = "instantiationToken" if self.fmi == 3 else "GUID"
            foreign = described.guid.encode() not in library.read_bytes()
            reason = (
                f"the {token} {described.guid} of its description is not in its library"
                if foreign
                else "it declined"
            )
            raise RefusedError(f"an FMU whose library lets itself be instantiated ({reason})") from None
        variables = {v.name: (v.type, v.causality) for v in described.modelVariables}
        return {"fmi": self.fmi, "token": described.guid, "variables": variables}

    def start(self, values: dict[str, Any]) -> None:
        """Begin a new run at time zero with start values."""
        if self._used:
            self._begin("reset")
            self._fmu.reset()
        self._time, self._used = 0.0, True
        self.set(values)
        self._begin("its initialisation")
        if self.fmi == 3:
            self._fmu.enterInitializationMode(startTime=0.0)
        else:
            self._fmu.setupExperiment(startTime=0.0)
            self._fmu.enterInitializationMode()
        self._fmu.exitInitializationMode()

    def set(self, values: dict[str, Any]) -> None:
        """Set variables."""
        for kind, names in self._by_type(values).items():
            self._begin(f"set{kind} at t = {self._time:.10g} s")
            references = [self._references[name][1] for name in names]
            getattr(self._fmu, f"set{kind}")(references, [values[name] for name in names])

    def get(self, names: list[str]) -> list[Any]:
        """Values of variables, in the order of the names."""
        found = {}
        for kind, some in self._by_type(names).items():
            self._begin(f"get{kind} at t = {self._time:.10g} s")
            references = [self._references[name][1] for name in some]
            found.update(zip(some, getattr(self._fmu, f"get{kind}")(references), strict=True))
        return [found[name] for name in names]

    def step(self, dt: float, count: int) -> None:
        """Step `count` times by `dt` [s]."""
        for _ in range(count):
            self._begin(f"doStep at t = {self._time:.10g} s")
            self._fmu.doStep(self._time, dt)
            self._time += dt

    def end(self) -> None:
        """Free the FMU."""
        self._begin("terminate")
        self._fmu.terminate()
        self._begin("freeInstance")
        self._fmu.freeInstance()

    def _by_type(self, names: Iterable[str]) -> dict[str, list[str]]:
        """Names by the type in the names of FMPy's methods."""
        groups: dict[str, list[str]] = {}
        for name in names:
            if name not in self._references:
                raise RefusedError(f"an FMU with a variable {name}")
            kind = self._references[name][0]
            if kind == "Enumeration":
                kind = "Int64" if self.fmi == 3 else "Integer"
            groups.setdefault(kind, []).append(name)
        return groups

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Do what is asked, in the order start, set, step, get."""
        try:
            if "load" in request:
                return self.load(request["load"])
            if "end" in request:
                self.end()
            if "start" in request:
                self.start(request["start"])
            if "set" in request:
                self.set(request["set"])
            if "step" in request:
                self.step(*request["step"])
            return {"values": self.get(request["get"])} if "get" in request else {}
        except RefusedError as error:
            return {"refused": [error.expected, error.hint]}
        except Exception as error:  # a status of the FMU, or a value that its type cannot hold
            return {"failed": f"{error}"}


def _end_with_the_parent(folder: Path) -> None:
    """The parent holds the other end of standard input: it ends, also by a kill, and so does this process at once."""
    while os.read(0, 1):
        pass
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)


def _leave_no_core() -> None:
    """A crash leaves no image of the process on the disk."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main() -> None:
    """Serve requests until the parent closes the socket. Arguments: number of the socket, and a folder for everything."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    _leave_no_core()
    channel = socket.socket(fileno=int(sys.argv[1]))
    channel.set_inheritable(False)  # a program that an FMU starts does not keep it open
    os.dup2(2, 1)  # what an FMU prints is no result of the command that uses it
    folder = Path(sys.argv[2])
    threading.Thread(target=_end_with_the_parent, args=[folder], daemon=True).start()
    with open(folder / NOTE, "r+b") as file:
        runner = Runner(folder / UNPACKED, mmap.mmap(file.fileno(), NOTE_BYTES))
    for line in channel.makefile("rb"):
        request = json.loads(line)
        reply = {"n": request["n"], **runner.answer(request)}
        channel.sendall(json.dumps(reply).encode() + b"\n")
        if "end" in request:
            return


if __name__ == "__main__":
    main()
