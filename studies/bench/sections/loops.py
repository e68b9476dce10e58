"""Closed loops: the thesis run of one controller, and many variants advanced together."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaxmpc.controller.batch import Controllers
from jaxmpc.loop.simulate import simulate_batch
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning
from jaxmpc.process.well.plant import WellPlant
from studies.bench.context import Context
from studies.bench.instances import Kind, Mode, Recording, make_controller
from studies.bench.judge import taken
from studies.bench.rows import Goal, Row, timed, whole
from studies.thesis.well import WELL

RUN_SECONDS, RUN_AIM, RUN_SAMPLES = 20.0, 6.0, 7800  # floor and aim of the thesis run


def loops(context: Context) -> Iterator[Row]:
    """Rows of the thesis run, with the series of thesis figure 39, and of variants together."""
    runs: list[tuple[Kind, Mode]] = [("mixed-integer", mode) for mode in context.size.modes]
    for kind, mode in [*runs, ("continuous", context.size.modes[0])]:
        run = context.recordings.compiled(kind, mode)
        row = _run_row("one variant", run, context, kind, mode)
        if kind == "mixed-integer":
            share = len(run.cv) / RUN_SAMPLES
            row.goals = (Goal("seconds", RUN_SECONDS * share, RUN_AIM * share),)
        yield row
        run = context.recordings.live(kind, mode)
        context.series[f"run {kind} {mode}"] = {"solve_ms": (run.solve_time * 1e3).tolist()}
        row = _run_row("stepped from the host", run, context, kind, mode)
        row.note += "; as with a plant that is no JAX program, such as an FMU"
        yield row
    yield variants(context, integer=True)
    yield variants(context, integer=False)


def _run_row(how: str, run: Recording, context: Context, kind: Kind, mode: Mode) -> Row:
    wrong = np.where(run.fallback, np.nan, np.maximum(run.gap, broken_limits(run, kind, mode, context)))
    row = timed(f"{kind} run, {mode}, {how}", run.solve_time, wrong)
    row.counts = row.counts and not run.fallback.any()
    row.rate, row.seconds = len(run.cv) / run.wall_time, run.wall_time
    row.note = (
        f"{len(run.cv)} samples after a warm-up, plant included; median and p99 of the solves; the error is the "
        "proven gap, or a limit that was broken"
    )
    return row


def broken_limits(run: Recording, kind: Kind, mode: Mode, context: Context) -> np.ndarray:
    """Largest violation per sample of MV limits, move limits [relative] and whole steps [steps] by what was applied."""
    controller = make_controller(kind, mode, context.model)
    tuning, worst = controller.tuning, np.zeros(len(run.cv))
    for values, low, high in (
        (run.mv_demand, tuning.mv_low, tuning.mv_high),
        (run.move, tuning.move_low, tuning.move_high),
    ):
        for limit, sign in ((np.asarray(high), 1), (np.asarray(low), -1)):
            over = sign * (values - limit) / np.maximum(1.0, np.abs(limit))
            worst = np.maximum(worst, over.max(axis=1))
    for mv in controller.structure.integer_mvs:
        steps = run.move[:, mv] / controller.structure.steps[mv]
        worst = np.maximum(worst, np.abs(steps - np.round(steps)))
    return np.where(worst > 1e-9, worst, 0.0)  # sums of thousands of moves round


def variants(context: Context, integer: bool) -> Row:
    """Variants advanced together: the weights of their first moves differ."""
    size, mode = context.size, context.size.modes[0]
    structure = WELL.structure(mode, integer=integer)
    if integer:
        kind, count, samples, goal = "mixed-integer", size.together, size.together_samples, (800.0, 5000.0)
    else:
        kind, count, samples, goal = "continuous", size.variants, size.variant_samples, (4000.0, 20000.0)
    reference = WELL.reference(size.together_reference if integer else "quick")
    controllers = Controllers(structure, _tunings(structure, count), context.model)
    context.say(f"{count} {kind} variants, {samples} samples")
    run = lambda: simulate_batch(controllers, WellPlant(actuator="step"), reference, samples=samples)  # noqa: E731
    run()  # compiles, what searches on the host need as well
    elapsed, runs = taken(run)
    return whole(
        f"{kind} variants together, {mode}: {count}",
        elapsed,
        np.concatenate([np.where(run.fallback, np.inf, run.gap) for run in runs]),
        rate=count * samples / elapsed,
        goals=(Goal("rate", *goal),),
        note=f"variant-samples per second over {samples} samples, plant included, compiled before; the error is the gap",
    )


def _tunings(structure: Structure, count: int) -> list[Tuning]:
    weights = np.geomspace(60.0, 2000.0, count).tolist()  # 1/(%)^2
    stepped, other = WELL.mv_names
    changes = ({"move_weight": {stepped: weight, other: 0.2}} for weight in weights)
    return [WELL.tuning(structure, changes=change) for change in changes]
