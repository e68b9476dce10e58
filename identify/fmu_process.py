"""An FMU in a process of its own: a crash, an `exit` or a call that never returns ends that process and no more.

`FmuProcess` starts `identify.fmu_worker` and talks to it, in one round trip per sample (about 0.1 ms);
`identify.fmu.FmuPlant` makes a plant of it.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from identify.fmu_description import FmuDescription, Value
from identify.fmu_worker import NOTE, NOTE_BYTES, UNPACKED
from jaxmpc.errors import InputError, PlantError
from jaxmpc.programs.interrupts import before_leaving

TIME_LIMIT = 300.0  # s for one call of an FMU
GOODBYE = 10.0  # s for an FMU to free itself
WORKER = Path(__file__).with_name("fmu_worker.py")


class FmuProcess:
    """An FMU of FMI 2.0 or 3.0 in its own process, which has read its description; `load` it to run it.

    Use it as a context manager, or `close` it; that frees the FMU, ends its process and removes the unpacked files.
    The process also ends when this one ends, however that happens.

    Args:
        path: of the FMU.
        time_limit: for one call of the FMU [s]; after that its process is ended.

    Attributes:
        path, time_limit: as given.
        folder: where the FMU is unpacked, removed by `close`.
        description: what the FMU says of itself.

    Raises:
        InputError: for a file that is not such an FMU, with the reason.
    """

    def __init__(self, path: str | Path, time_limit: float = TIME_LIMIT):
        if (
            isinstance(time_limit, bool)
            or not isinstance(time_limit, (int, float))
            or not 0 < time_limit <= 1e6
        ):
            raise InputError("plant.time_limit", time_limit, "a number of seconds above 0, at most 1e6")
        self.path, self.time_limit = Path(path), float(time_limit)
        if not self.path.is_file():
            raise InputError("plant.path", str(self.path), "an existing .fmu file")
        self._failure = ""
        self._asked, self._answered, self._received = 0, 0, b""
        self.folder = Path(tempfile.mkdtemp(prefix="jaxmpc-fmu-"))
        (self.folder / UNPACKED).mkdir()
        self._note = self.folder / NOTE
        self._note.write_bytes(f"{time.monotonic()} the start of its process".encode().ljust(NOTE_BYTES))
        self._channel, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                # -P: what lies in the folder of the command is no module of the worker
                [sys.executable, "-P", WORKER, str(theirs.fileno()), self.folder],
                stdin=subprocess.PIPE,
                pass_fds=[theirs.fileno()],
                process_group=0,  # Ctrl-C of a terminal goes to the group of the command
            )
        self._finalizer = weakref.finalize(self, _remove, self._process, self._channel, self.folder)
        before_leaving(self._finalizer)
        try:
            facts = self._ask(describe=str(self.path.absolute()))
            self.description = FmuDescription.of({k: v for k, v in facts.items() if k != "n"})
        except BaseException:
            self._finalizer()
            raise
        self._loaded = False

    def load(self) -> None:
        """Load the library of the FMU and instantiate it; twice is once.

        Raises:
            InputError: for an FMU of neither kind that can be run, not for this machine or not what it says it is.
            PlantError: if the FMU fails; so do all methods.
        """
        if not self._loaded:
            self._ask(load=True)
            self._loaded = True

    def start(
        self,
        values: Mapping[str, Value] | None = None,
        inputs: Mapping[str, Value] | None = None,
        stop: float | None = None,
    ) -> None:
        """Begin a new run at time zero, or where its default experiment begins, with start values by name.

        Args:
            values: set before the FMU initialises itself.
            inputs: set while it does, and held from then on.
            stop: after which time the FMU is told the run will end [s]; by default it is told none.
        """
        self.load()
        self._ask(start=[dict(values or {}), dict(inputs or {}), stop])

    def set(self, values: Mapping[str, Value]) -> None:
        """Set variables, by name."""
        self._ask(set=dict(values))

    def get(self, names: Sequence[str]) -> list[Any]:
        """Values of variables, in the order of the names."""
        return self._ask(get=list(names))["values"]

    def step(
        self,
        dt: float,
        inputs: Mapping[str, Value] | None = None,
        outputs: Sequence[str] = (),
        count: int = 1,
    ) -> list[Any]:
        """Set inputs by name, hold them over `count` steps of `dt` [s], and read outputs by name, in one round trip."""
        return self._ask(set=dict(inputs or {}), step=[dt, count], get=list(outputs))["values"]

    def hold(
        self, dt: float, inputs: Mapping[str, Value], outputs: Sequence[str], count: int, samples: int
    ) -> list[list[Any]]:
        """As `step`, for many samples of `count` steps with the same inputs; outputs by sample, in one round trip."""
        return self._ask(set=dict(inputs), hold=[dt, count, samples], get=list(outputs))["rows"]

    def _ask(self, **request: Any) -> dict[str, Any]:
        """The answer of the process."""
        if self._failure:
            raise PlantError(self._failure)
        if not self._finalizer.alive:
            raise InputError("plant", "closed", "an FMU that has not been closed")
        self._asked += 1
        try:
            self._channel.settimeout(self.time_limit)
            line = json.dumps({"n": self._asked, **request}, default=lambda value: value.item())  # of NumPy
            self._channel.sendall(line.encode() + b"\n")
            reply = self._reply()
        except TimeoutError:
            raise self._failed(
                f"did not come back from {self._call()[1]} within {self.time_limit:g} s; its process was ended"
            ) from None
        except ConnectionError:
            raise self._failed(self._last_words()) from None
        if "refused" in reply:
            raise InputError("plant.path", str(self.path), *reply["refused"])
        if "failed" in reply:
            raise PlantError(f"{self.path}: the FMU failed during {self._call()[1]}: {reply['failed']}")
        return reply

    def _reply(self) -> dict[str, Any]:
        """The reply to the last request; replies to requests that were interrupted are passed over."""
        while True:
            while b"\n" not in self._received:
                try:
                    received = self._channel.recv(65536)
                except TimeoutError:
                    # One request may be many calls, and each of them has the whole time.
                    left = self._call()[0] + self.time_limit - time.monotonic()
                    if left <= 0:
                        raise
                    self._channel.settimeout(left)
                    continue
                if not received:
                    raise ConnectionResetError
                self._received += received
            line, _, self._received = self._received.partition(b"\n")
            reply = json.loads(line)
            self._answered = reply["n"]
            if self._answered == self._asked:
                return reply

    def _call(self) -> tuple[float, str]:
        """When the last call into the FMU began, and which it was."""
        began, _, call = self._note.read_text().partition(" ")
        return float(began), call.strip()

    def _last_words(self) -> str:
        """How the process ended."""
        try:
            status = self._process.wait(GOODBYE)
        except subprocess.TimeoutExpired:
            return f"closed its connection during {self._call()[1]}; its process was ended"
        how = f"exit status {status}" if status >= 0 else f"signal {_signal_name(-status)}"
        return f"ended its process with {how} during {self._call()[1]}"

    def _failed(self, what: str) -> PlantError:
        """The error for an FMU that has lost its process; every later call raises it too."""
        self._failure = f"{self.path}: the FMU {what}"
        self._finalizer()
        return PlantError(self._failure)

    def close(self) -> None:
        """Free the FMU, end its process and remove the unpacked files; twice is once."""
        if not self._finalizer.alive:
            return
        if self._answered == self._asked:  # else it is in the middle of a call, which nobody waits for
            self.time_limit = min(self.time_limit, GOODBYE)
            with contextlib.suppress(PlantError):  # the run is over
                self._ask(end=True)
                self._process.wait(GOODBYE)
        self._finalizer()

    def __enter__(self) -> FmuProcess:
        return self

    def __exit__(self, *_) -> None:
        self.close()


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return str(number)


def _remove(process: subprocess.Popen, channel: socket.socket, folder: Path) -> None:
    process.kill()  # does nothing to one that has ended
    channel.close()
    if process.stdin is not None:
        process.stdin.close()
    process.wait()
    shutil.rmtree(folder, ignore_errors=True)
