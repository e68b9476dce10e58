"""A sweep study of a few seconds, and the same with a chunk that goes wrong where it is computed, in whatever process.

``python -c "from tests.sweep_hazards import main; main()" HAZARD CHUNK FOLDER study run ...`` is the command line with
a hazard.
"""

import dataclasses
import multiprocessing
import os
import signal
import sys
import time
import tomllib
from pathlib import Path

TEXT = """
[study]
name = "tiny"
chunk_size = 3
confirmation_limit = 8

[base]
controller = "continuous"
actuator = "step"
duration = 300
prediction_horizon = 30
blocks = [1, 2, 4]

[base.noise]
oil_rate = 0.5

[[base.disturbance]]
time = 100
offset = -1.5

[[base.sensor_fault]]
cv = "oil_rate"
kind = "missing"
time = 50
duration = 40

[[axes]]
key = "tuning.move_weight.choke"
values = [100, 200]

[[axes]]
keys = [
  "plant.reservoir_pressure", "model.choke", "seed", "reference", "noise.gas_rate", "disturbance.time",
  "disturbance.offset", "sensor_fault.time", "position_feedback",
]
values = [
  [77, 50, 0, "quick", 0, 100, -1.5, 50, false],
  [78, 40, 1, "mid-choke", 50, 150, -1.5, 80, true],
  [79, 50, 2, "quick", 50, 100, 0, 50, true],
  [78.5, 50, 3, "quick", 20, 100, 1, 120, false],
]

[store]
every = 4

[quick.axes]
"tuning.move_weight.choke" = { keep = [0] }
"""

BODY = {name: table for name, table in tomllib.loads(TEXT).items() if name != "quick"}


class Hazards(tuple):
    """Chunks of a study that do something when one of them is computed, and keep a list of those that were."""

    def __new__(cls, chunks, hazard, index, folder):
        self = super().__new__(cls, chunks)
        self.hazard, self.index, self.folder = hazard, index, Path(folder)
        return self

    def __getnewargs__(self):
        return tuple(self), self.hazard, self.index, self.folder

    def __getitem__(self, index):
        with open(self.folder / "computed", "a") as file:
            file.write(f"{index} {os.getpid()}\n")
        if index == self.index:
            HAZARDS[self.hazard](self.folder)
        return super().__getitem__(index)


def computed(folder) -> list[int]:
    """Numbers of the chunks that were begun, in this order."""
    return [int(line.split()[0]) for line in (Path(folder) / "computed").read_text().splitlines()]


def processes(folder) -> set[int]:
    """Processes that began a chunk."""
    return {int(line.split()[1]) for line in (Path(folder) / "computed").read_text().splitlines()}


def _first_time(folder: Path) -> bool:
    try:
        (folder / "happened").touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def _main_process() -> int:
    return os.getpid() if multiprocessing.parent_process() is None else os.getppid()


def _die(folder):
    os.kill(os.getpid(), signal.SIGKILL)


def _die_once(folder):
    if _first_time(folder):
        _die(folder)


def _fail(folder):
    raise RuntimeError("made to fail")


def _kill_main(folder):
    os.kill(_main_process(), signal.SIGKILL)
    _wait_for_the_end()


def _interrupt(folder):
    """What Ctrl-C in a terminal does: every process of the group gets it."""
    os.killpg(os.getpgid(0), signal.SIGINT)
    _wait_for_the_end()


def _wait_for_the_end():
    """Until a signal that was sent arrives and ends this process; the run must not be over before that."""
    while True:
        time.sleep(0.05)


def _kill_scheduler(folder):
    os.kill(int((folder / "scheduler.pid").read_text()), signal.SIGKILL)
    time.sleep(5)


HAZARDS = {
    "none": lambda folder: None,
    "die": _die,
    "die-once": _die_once,
    "fail": _fail,
    "kill-main": _kill_main,
    "interrupt": _interrupt,
    "kill-scheduler": _kill_scheduler,
}


def preparation(hazard: str, index: int, folder):
    """A `prepare_study` whose study has the hazard."""
    from studies.run.chunk import prepare_study

    def prepare(study):
        chunks = Hazards(study.chunks, hazard, index, folder)
        return dataclasses.replace(prepare_study(study), study=dataclasses.replace(study, chunks=chunks))

    return prepare


def main() -> None:
    """Run the command line with a hazard; figures are left out."""
    import figures.sweep.draw
    from jaxmpc.cli import main as cli
    from studies.run import runner

    program, hazard, index, folder, *arguments = sys.argv
    sys.argv = [program, *arguments]
    runner.prepare_study = preparation(hazard, int(index), folder)
    figures.sweep.draw.draw_sweep = lambda store, folder: []
    sys.exit(cli.main())
