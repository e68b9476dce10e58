"""Closed loops: the thesis run of one controller, and many variants advanced together."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from jaxmpc.controller.batch import controller_batch
from jaxmpc.controller.mixed_integer import MixedIntegerControllers
from jaxmpc.loop.reference import Reference
from jaxmpc.loop.simulate import simulate_batch
from jaxmpc.problem.tuning import Tuning
from jaxmpc.process.plant import WellPlant
from studies.bench.context import Context
from studies.bench.instances import Kind, Mode, Recording, make_controller
from studies.bench.rows import Goal, Row, timed
from studies.definition import presets, references

RUN_SECONDS, RUN_AIM, RUN_SAMPLES = 20.0, 6.0, 7800  # floor and aim of the thesis run


def loops(context: Context) -> Iterator[Row]:
    """Rows of the thesis run, with the series of thesis figure 39, and of variants together."""
    runs: list[tuple[Kind, Mode]] = [("mixed-integer", mode) for mode in context.size.modes]
    for kind, mode in [*runs, ("continuous", context.size.modes[0])]:
        run = context.recordings.compiled(kind, mode)
        row = _run_row(f"{kind} run, {mode}, one variant", run, context, mode)
        if kind == "mixed-integer":
            share = len(run.cv) / RUN_SAMPLES
            row.goals = (Goal("seconds", RUN_SECONDS * share, RUN_AIM * share),)
        yield row
        run = context.recordings.live(kind, mode)
        context.series[f"run {kind} {mode}"] = {"solve_ms": (run.solve_time * 1e3).tolist()}
        row = _run_row(f"{kind} run, {mode}, stepped from the host", run, context, mode)
        row.note += "; as with a plant that is no JAX program, such as an FMU"
        yield row
    yield mixed_integer_variants(context)
    yield continuous_variants(context)


def _run_row(name: str, run: Recording, context: Context, mode) -> Row:
    kind = "mixed-integer" if "integer" in name else "continuous"
    wrong = np.where(run.fallback, np.nan, np.maximum(run.gap, broken_limits(run, kind, mode, context)))
    row = timed(name, "loop", run.solve_time, wrong)
    row.counts = row.counts and not run.fallback.any()
    row.rate, row.seconds = len(run.cv) / run.wall_time, run.wall_time
    row.note = (
        f"{len(run.cv)} samples after a warm-up, plant included; median and p99 of the solves; the error is the "
        "proven gap, or a limit that was broken"
    )
    return row


def broken_limits(run: Recording, kind, mode, context: Context) -> np.ndarray:
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
        steps = run.move[:, mv] / controller.structure.integer_step[mv]
        worst = np.maximum(worst, np.abs(steps - np.round(steps)))
    return np.where(worst > 1e-9, worst, 0.0)  # sums of thousands of moves round


def mixed_integer_variants(context: Context) -> Row:
    """Mixed-integer variants advanced together: the move weights of their chokes differ."""
    count, samples, mode = context.size.together, context.size.together_samples, context.size.modes[0]
    context.say(f"{count} mixed-integer variants, {samples} samples")
    structure = presets.structure(mode, integer=True)
    controllers = MixedIntegerControllers(structure, _tunings(structure, count), [context.model])
    name, reference = f"mixed-integer variants together, {mode}: {count}", context.size.together_reference()
    row, elapsed = _advanced(name, controllers, samples, reference)
    row.rate = count * samples / (elapsed - controllers.solver.compiling)
    row.goals = (Goal("rate", 800.0, 5000.0),)
    row.note = (
        f"variant-samples per second over {samples} samples, plant included, compilation left out; "
        "the error is the gap"
    )
    return row


def continuous_variants(context: Context) -> Row:
    """Continuous variants advanced together: the move weights of their chokes differ."""
    count, samples, mode = context.size.variants, context.size.variant_samples, context.size.modes[0]
    context.say(f"{count} continuous variants, {samples} samples")
    structure = presets.structure(mode)
    controllers = controller_batch(structure, _tunings(structure, count), context.model)
    row, elapsed = _advanced(
        f"continuous variants together, {mode}: {count}", controllers, samples, references.quick()
    )
    row.rate = count * samples / elapsed
    row.goals = (Goal("rate", 4000.0, 20000.0),)
    row.note = f"variant-samples per second over {samples} samples, plant included, compiled before; the error is the gap"
    return row


def _tunings(structure, count: int) -> list[Tuning]:
    weights = np.geomspace(60.0, 2000.0, count)  # 1/(%)^2
    changes = [{"move_weight": {presets.CHOKE: float(w), presets.LIFT: 0.2}} for w in weights]
    return [presets.tuning(structure, changes=change) for change in changes]


def _advanced(name: str, controllers, samples: int, reference: Reference) -> tuple[Row, float]:
    """Closed loops of all controllers at once, and their seconds from the end of the first compilation on."""
    times: list[float] = []
    runs = simulate_batch(
        controllers,
        WellPlant(actuator="step"),
        reference,
        samples=samples,
        progress=lambda done, total: times.append(time.perf_counter()),
    )
    elapsed = times[-1] - times[0]
    gaps = np.concatenate([np.where(run.fallback, np.inf, run.gap) for run in runs])
    row = timed(name, "loop", np.full(1, elapsed), gaps)
    row.median_ms = row.p99_ms = None
    row.seconds = elapsed
    return row, elapsed
