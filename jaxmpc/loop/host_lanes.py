"""Many closed loops on plants that keep their own state, such as FMUs, each of which works in a process of its own.

The lanes of a part decide in one compiled call, and then their plants step one after the other; as many parts as there are
cores run side by side in threads. While one thread waits for its FMU, the other decides or waits for another one, so that
all cores have work, and only the FMUs of the parts under way have a process.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence

import numpy as np

from jaxmpc.controller.batch import Batch
from jaxmpc.errors import PlantError
from jaxmpc.loop.compiled import Inputs
from jaxmpc.loop.events import Stage
from jaxmpc.loop.host import HostLoops, undisturbed
from jaxmpc.process.plant import StatefulPlant, closing
from jaxmpc.programs.compilation import compiling_for
from jaxmpc.programs.threads import parts_of, side_by_side

TOGETHER = 8  # lanes of a part


def simulate_host_lanes(
    controllers: Batch,
    plants: Sequence[StatefulPlant],
    inputs: Inputs,
    progress: Callable[[int], None] | None = None,
    stages: Sequence[Sequence[Stage]] = (),
) -> tuple[dict[str, np.ndarray], dict[int, PlantError]]:
    """Closed loops of controllers and plants, one of each per lane; plants are closed when their loop is over.

    A plant that fails ends its own lane: what is measured from then on is not a number, nothing is decided, and the status
    is ``failed``. Results do not depend on the number of cores.

    Args:
        plants: whose processes start with `init`, so that no more of them run than are needed (`FmuPlant.replaced`).
        progress: told how many samples of all lanes were done, by one thread at a time.
        stages: as of `simulate_compiled`.

    Returns:
        ``(fields, failures)``: fields of `Trajectory`, ``"lane sample ..."``, and what ended a lane, by its number.
    """
    lock, count, failures = threading.Lock(), len(plants), {}
    parts = parts_of(count, TOGETHER, cut=True)
    runs = [
        HostLoops(controllers.part(part), inputs.part(part), [stages[k] for k in part] if stages else [])
        for part in parts
    ]
    with compiling_for(f"loops of {controllers.size}"):
        runs[0].compile()

    def advance(k: int, stopped: Callable[[], bool]) -> dict[str, np.ndarray]:
        run, first = runs[k], len(parts[0]) * k
        own = plants[first : first + len(parts[0])]

        def tick(_: int) -> None:
            if progress is not None:
                with lock:
                    progress(len(own))

        with contextlib.ExitStack() as stack:
            for plant in own:
                stack.enter_context(closing(plant))
            run.begin(own)
            fields = run.advanced(own, tick, stopped)
        failures.update({first + lane: error for lane, error in run.failed.items()})
        return {name: values[: len(own)] for name, values in fields.items()}

    with undisturbed():
        found = side_by_side(advance, range(len(parts)))
    fields = {name: np.concatenate([part.pop(name) for part in found]) for name in list(found[0])}
    return fields, dict(sorted(failures.items()))
