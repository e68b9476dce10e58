"""The process in which one FMU runs, started by `identify.fmu_process`: unpacks it, loads it, and does what it is told.

It is run as a script and needs only FMPy, so that it starts in a fraction of a second. Requests and replies are lines of
JSON over a socket. Before every call into the FMU it notes in a shared file when the call began and which it is: that is
what the parent tells when the process has died or the call takes too long.
"""

from __future__ import annotations

import contextlib
import json
import math
import mmap
import os
import shutil
import signal
import socket
import sys
import threading
import time
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from identify.fmu_file import (
    RefusedError,
    check_archive,
    facts_of,
    kinds_of,
    library_of,
    number,
    read_description,
    unpack,
)

NOTE, NOTE_BYTES = "note", 128
UNPACKED = "fmu"


class Runner:
    """The FMU of this process, its files in a folder; the note receives which call is being made."""

    def __init__(self, folder: Path, note: mmap.mmap):
        self.folder, self._note = folder, note
        self._time, self._used = 0.0, False
        self._stop: float | None = None
        self._fmu: Any = None
        self._exchange: Any = None  # the run of an FMU for model exchange
        self._held: dict[str, Any] = {}

    def _begin(self, call: str) -> None:
        text = f"{time.monotonic():.3f} {call}".encode()[:NOTE_BYTES]
        self._note[:] = text.ljust(NOTE_BYTES)

    def describe(self, path: str) -> dict[str, Any]:
        """Read what an FMU says of itself."""
        self.path = Path(path)
        self._begin("the reading of its model description")
        check_archive(self.path, shutil.disk_usage(self.folder).free)
        self._described, flaws = read_description(self.path, self.folder)
        self.fmi = 3 if self._described.fmiVersion.startswith("3") else 2
        self._references = {v.name: (v.type, v.valueReference) for v in self._described.modelVariables}
        self._shapes = {v.name: v.shape for v in self._described.modelVariables if v.shape}
        with zipfile.ZipFile(self.path) as archive:
            return facts_of(self._described, flaws, archive.namelist())

    def load(self) -> None:
        """Unpack the FMU, load its library and instantiate it."""
        described = self._described
        if described.coSimulation is None and described.modelExchange is None:
            has = ", ".join(kinds_of(described)) or "nothing"
            expected = f"an FMU for co-simulation or model exchange (it has only: {has})"
            raise RefusedError(expected, "Export it once more for co-simulation")
        self._begin("the unpacking")
        unpack(self.path, self.folder)
        self._instantiate()

    def _instantiate(self) -> None:
        """Load the library and make an instance."""
        described = self._described
        kind = described.coSimulation or described.modelExchange
        from fmpy.fmi2 import FMU2Model, FMU2Slave
        from fmpy.fmi3 import FMU3Model, FMU3Slave

        made = (FMU2Slave, FMU3Slave) if described.coSimulation else (FMU2Model, FMU3Model)
        library = library_of(self.folder, described)
        self._begin("the loading of its library")
        try:
            self._fmu = made[self.fmi - 2](
                guid=described.guid,
                unzipDirectory=str(self.folder),
                modelIdentifier=kind.modelIdentifier,
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

    def start(self, values: dict[str, Any], inputs: dict[str, Any], stop: float | None) -> None:
        """Begin a new run where its default experiment begins, or at time zero; inputs hold from then on."""
        if self._used:
            self._begin("reset")
            try:
                self._fmu.reset()
            except Exception:  # many FMUs cannot: another instance begins anew, too
                self._fmu.freeInstance()
                self._instantiate()
        begin = number(getattr(self._described.defaultExperiment, "startTime", None)) or 0.0
        stop = None if stop is None else begin + stop
        self._time, self._used, self._stop = begin, True, stop
        self._exchange = None
        if self.fmi == 2:
            self._begin("setupExperiment")
            self._fmu.setupExperiment(startTime=begin, stopTime=stop)
        self.set(values)
        self._begin("its initialisation")
        self._fmu.enterInitializationMode(**({"startTime": begin, "stopTime": stop} if self.fmi == 3 else {}))
        self.set(inputs)
        self._begin("its initialisation")
        self._fmu.exitInitializationMode()
        if self._described.coSimulation is None:
            from identify.fmu_exchange import Exchange

            self._exchange, self._held = Exchange(self._fmu, self._described, begin), dict(inputs)

    def change(self, values: dict[str, Any]) -> None:
        """Set variables while it runs; for model exchange in an event, and only those that change."""
        if self._exchange is None:
            self.set(values)
            return
        new = {name: value for name, value in values.items() if self._held.get(name) != value}
        if new:
            self._begin(f"an event at t = {self._time:.10g} s")
            self._exchange.change(lambda: self.set(new))
            self._held |= new

    def set(self, values: dict[str, Any]) -> None:
        """Set variables and elements of arrays."""
        values, arrays = dict(values), {}
        for name in [name for name in values if name not in self._references]:
            array, k = self._element(name)
            arrays.setdefault(array, {})[k] = values.pop(name)
        for kind, names in self._by_type(values).items():
            self._begin(f"set{kind} at t = {self._time:.10g} s")
            references = [self._references[name][1] for name in names]
            getattr(self._fmu, f"set{kind}")(references, [values[name] for name in names])
        for array, elements in arrays.items():
            whole = self._array(array)
            for k, value in elements.items():
                whole[k] = value
            ((kind, _),) = self._by_type([array]).items()
            self._begin(f"set{kind} at t = {self._time:.10g} s")
            getattr(self._fmu, f"set{kind}")([self._references[array][1]], whole)

    def get(self, names: list[str]) -> list[Any]:
        """Values of variables and elements of arrays, in the order of the names."""
        found = {}
        for name in names:
            if name not in self._references:
                array, k = self._element(name)
                found[name] = self._array(array)[k]
        for kind, some in self._by_type(name for name in names if name not in found).items():
            self._begin(f"get{kind} at t = {self._time:.10g} s")
            references = [self._references[name][1] for name in some]
            found.update(zip(some, getattr(self._fmu, f"get{kind}")(references), strict=True))
        return [found[name] for name in names]

    def _array(self, name: str) -> list[Any]:
        """All elements of an array, the last index first."""
        ((kind, _),) = self._by_type([name]).items()
        self._begin(f"get{kind} at t = {self._time:.10g} s")
        return getattr(self._fmu, f"get{kind}")([self._references[name][1]], math.prod(self._shapes[name]))

    def _element(self, name: str) -> tuple[str, int]:
        """Array and place of an element such as ``x[2,1]``, counted from 1."""
        array, _, index = name.removesuffix("]").rpartition("[")
        if array not in self._shapes:
            raise RefusedError(f"an FMU with a variable {name}")
        place = 0
        for size, k in zip(self._shapes[array], index.split(","), strict=True):
            place = place * size + int(k) - 1
        return array, place

    def step(self, dt: float, count: int) -> None:
        """Step `count` times by `dt` [s]."""
        begin = self._time
        call = "doStep" if self._exchange is None else "the integration"
        for k in range(count):
            self._begin(f"{call} at t = {self._time:.10g} s")
            end = begin + (k + 1) * dt
            try:
                if self._exchange is not None:
                    self._exchange.step(end, dt)
                else:
                    self._do_step(self._time, end)
            except Exception as error:
                raise RuntimeError(f"{error}{self._beyond()}") from None
            self._time = end

    def _do_step(self, begin: float, end: float) -> None:
        """One communication step; one of FMI 3 that returns early is gone on with."""
        while True:
            said = self._fmu.doStep(begin, end - begin)
            if self.fmi == 2:
                return
            _, ends, early, reached = said
            if ends:
                raise RuntimeError("it asks for the end of the simulation")
            if not early or end - reached <= 1e-9 * (end - begin):
                return
            if reached <= begin:
                raise RuntimeError(f"it returns early at {reached:.10g} s, where it was")
            begin = reached

    def sample(self, dt: float, count: int, names: list[str]) -> list[Any]:
        """Step and read."""
        self.step(dt, count)
        return self.get(names)

    def _beyond(self) -> str:
        """What may be the reason for a failed step: some FMUs end where their default experiment does, if not told when."""
        end = number(getattr(self._described.defaultExperiment, "stopTime", None))
        late = self._stop is None and end is not None and self._time >= end * (1 - 1e-9)
        return f" (its default experiment ends at {end:g} s: give a later stop_time)" if late else ""

    def end(self) -> None:
        """Free the FMU."""
        if self._fmu is None:
            return
        self._begin("terminate")
        self._fmu.terminate()
        self._begin("freeInstance")
        self._fmu.freeInstance()

    def _by_type(self, names: Iterable[str]) -> dict[str, list[str]]:
        """Names by the type in the names of FMPy's methods."""
        groups: dict[str, list[str]] = {}
        for name in names:
            kind = self._references[name][0]
            if kind == "Enumeration":
                kind = "Int64" if self.fmi == 3 else "Integer"
            groups.setdefault(kind, []).append(name)
        return groups

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Do what is asked, in the order load, start, set, step or hold, get."""
        try:
            if "describe" in request:
                return self.describe(request["describe"])
            if "load" in request:
                self.load()
            if "end" in request:
                self.end()
            if "start" in request:
                self.start(*request["start"])
            if "set" in request:
                self.change(request["set"])
            if "hold" in request:
                dt, count, samples = request["hold"]
                return {"rows": [self.sample(dt, count, request["get"]) for _ in range(samples)]}
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
    watch = threading.Thread(target=_end_with_the_parent, args=[folder], daemon=True)
    watch.start()
    with open(folder / NOTE, "r+b") as file:
        runner = Runner(folder / UNPACKED, mmap.mmap(file.fileno(), NOTE_BYTES))
    for line in channel.makefile("rb"):
        request = json.loads(line)
        reply = {"n": request["n"], **runner.answer(request)}
        text = json.dumps(reply, default=bytes.decode)  # FMPy gives texts as the bytes that they are
        channel.sendall(text.encode() + b"\n")
        if "end" in request:
            return
    watch.join()  # the parent has gone: the files go, too


if __name__ == "__main__":
    main()
