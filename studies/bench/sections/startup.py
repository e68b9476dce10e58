"""The first call of a fresh process, compilation included."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.controller.case import make_case
from studies.bench.context import Context
from studies.bench.folder import solve
from studies.bench.judge import Judge, taken
from studies.bench.rows import Goal, Row, whole

PATIENCE = 600.0  # s
CALLS = {"first": "nothing compiled before", "second": "compiled programs taken from disk"}


def startup(context: Context) -> Iterator[Row]:
    """Rows ``first call, MODE``: `jaxmpc plan` on a recorded sample with an empty compilation cache, and again."""
    for mode in context.size.startup_modes:
        instances = context.recordings.instances("mixed-integer", mode, 5)
        cases = list(instances.files().values())
        case = cases[len(cases) // 2]
        judge = Judge([case])
        judge.hear("in process", [solve(make_case(case), PATIENCE)[1].moves])
        with tempfile.TemporaryDirectory(prefix="jaxmpc-bench-") as folder:
            for call, words in CALLS.items():
                context.say(f"{call} call, {mode}")
                seconds, plan = _plan(case, Path(folder))
                judge.hear(call, [plan])
                yield whole(
                    f"{call} call, {mode}",
                    seconds,
                    judge.errors(call),
                    goals=(Goal("seconds", 30.0, 8.0),) if call == "first" else (),
                    note=f"`jaxmpc plan` in a process of its own, {words}",
                )


def _plan(case: dict, folder: Path) -> tuple[float, np.ndarray | None]:
    """Seconds of a process that plans one case, and its plan ``"block mv"`` [MV unit]."""
    given, out = folder / "case.json", folder / "plan.json"
    given.write_text(json.dumps(case))
    environment = {**os.environ, "JAXMPC_CACHE": str(folder / "cache")}
    for name in ("JAX_COMPILATION_CACHE_DIR", "JAXMPC_NO_JIT_CACHE"):
        environment.pop(name, None)
    command = [sys.executable, "-m", "jaxmpc.cli", "plan", str(given), "--out", str(out)]
    limits: dict[str, Any] = {"check": False, "timeout": PATIENCE, "capture_output": True}
    seconds, _ = taken(lambda: subprocess.run(command, env=environment, **limits))
    moves = json.loads(out.read_text())["moves"] if out.exists() else None
    out.unlink(missing_ok=True)
    return seconds, None if moves is None else np.array(moves)
