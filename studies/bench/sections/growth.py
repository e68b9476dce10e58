"""Time per relaxed QP as the problem grows: horizon, blocks, CVs, MVs of random stable models, in batches."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxmpc.model.step_response import make_model
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import make_tuning
from studies.bench.beside import ask
from studies.bench.context import Context
from studies.bench.instances import Instances, Problems
from studies.bench.judge import Judge
from studies.bench.lanes import Lanes
from studies.bench.rows import Row, whole
from studies.bench.sections.relaxed import TOLERANCE, batch_times

LANES = 32
WEIGHTS: dict[str, Any] = dict(
    cv_weight=1.0, soft_quadratic=1.0, soft_linear=0.5, deadzone=0.5, slack_weight=100.0, move_weight=20.0
)
LIMITS: dict[str, Any] = dict(
    cv_low=-6.0, cv_high=6.0, mv_low=-10.0, mv_high=10.0, move_low=-1.0, move_high=1.0
)
THESIS_LIKE = {"horizon": 250, "blocks": 16, "CVs": 2, "MVs": 2}  # horizon [samples]


def growth(context: Context) -> Iterator[Row]:
    """Rows ``growth, HORIZON x BLOCKS x CVS x MVS``: one dimension varied, the others as in the thesis."""
    peer = context.qp_peers[0]
    others = ", ".join(f"{name} {value}" for name, value in THESIS_LIKE.items())
    note = f"random stable models, batch of {LANES}, cold; time per QP; other sizes {others}"
    for axis, sizes in context.size.growth:
        for size in sizes:
            context.say(f"growth, {size} {axis}")
            instances = random_instances(np.random.default_rng(size), {**THESIS_LIKE, axis: size}, LANES)
            judge, lanes = Judge(instances.cases()), Lanes(instances)
            times, _ = batch_times(lanes, judge, "jaxmpc", "cold", LANES, 3)
            seconds, ratio = min(times), None
            if peer.missing() is None:
                theirs, _, plans = ask(peer, context, judge.cases, TOLERANCE)
                judge.hear(peer.name, plans)
                ratio = float(theirs.sum()) / seconds
            name, errors, to = f"growth, {axis} {size}", judge.errors("jaxmpc"), f"{peer.name} (one core)"
            yield whole(name, seconds, errors, LANES, ratio=ratio, ratio_to=to, note=note)


def random_instances(rng: np.random.Generator, shape: dict[str, int], lanes: int) -> Instances:
    """Problems of a random stable model of first-order responses, away from their setpoints by several deadzones."""
    horizon, blocks, cvs, mvs = (shape[key] for key in THESIS_LIKE)
    control = int(0.8 * horizon)
    structure = Structure(
        cv_names=tuple(f"y{i}" for i in range(cvs)),
        mv_names=tuple(f"u{i}" for i in range(mvs)),
        prediction_horizon=horizon,
        control_horizon=control,
        blocks=growing_blocks(control, blocks),
    )
    tuning = make_tuning(structure, **WEIGHTS, **LIMITS)
    t = np.arange(1, horizon + 1)
    gain = rng.choice([-1.0, 1.0], (cvs, mvs)) * rng.uniform(0.3, 1.5, (cvs, mvs))
    slow = rng.uniform(0.03, 0.2, (cvs, mvs)) * horizon  # samples
    response = gain[..., None] * (1.0 - np.exp(-t / slow[..., None]))
    model = make_model(response, structure.dt, structure.cv_names, structure.mv_names)
    start = rng.normal(0.0, 2.0, (lanes, 1, cvs))
    drift = rng.normal(0.0, 1.0, (lanes, 1, cvs)) * (1.0 - np.exp(-t / (0.1 * horizon)))[None, :, None]
    problems = Problems(
        free_response=start + drift,
        setpoint=np.broadcast_to(rng.normal(0.0, 2.0, (lanes, 1, cvs)), (lanes, horizon, cvs)),
        mv_now=rng.uniform(-5.0, 5.0, (lanes, mvs)),
        last_move=np.zeros((lanes, mvs)),
        past_moves=np.zeros((lanes, structure.mean_move_window, mvs)),
    )
    return Instances(structure, tuning, model, np.arange(lanes), problems, problems)


def growing_blocks(samples: int, count: int) -> tuple[int, ...]:
    """So many blocks that sum to `samples`, each at least as long as the one before."""
    edges = np.geomspace(1.0, samples + 1.0, count + 1) - 1.0
    lengths = np.maximum(np.diff(np.round(edges)).astype(int), 1)
    lengths[-1] += samples - lengths.sum()
    return tuple(sorted(int(length) for length in lengths))
