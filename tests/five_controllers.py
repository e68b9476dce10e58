"""The five kinds of controllers on one small process, and the process itself, for what all of them must do alike."""

import dataclasses

import numpy as np

from jaxmpc.controller.controller import Controller
from jaxmpc.controller.schedule import ScheduledController, make_schedule
from jaxmpc.problem.tuning import make_tuning

START = np.array([11000.0, 185.0]), np.array([50.0, 7500.0])
SETPOINT = np.array([12500.0, 205.0])
KINDS = ("continuous", "mixed-integer", "scheduled", "scheduled-mixed-integer", "ideal")


class Process:
    """The model itself, by superposition of the moves of its actuators; they follow the demand unless they are stuck."""

    def __init__(self, model):
        self.coefficients, self.cv, self.mv = np.asarray(model.coefficients), START[0].copy(), START[1].copy()
        self.moves, self.stuck = [], None

    def step(self, demand):
        position = np.asarray(demand, dtype=float).copy()
        if self.stuck is not None:
            position[self.stuck] = self.mv[self.stuck]
        self.moves.append(position - self.mv)
        self.mv, n, now = position, self.coefficients.shape[-1], len(self.moves)
        steps = [self.coefficients[..., min(now - i, n) - 1] @ move for i, move in enumerate(self.moves)]
        self.cv = START[0] + sum(steps)


def tuned(structure, fields, **more):
    """A tuning for whole choke moves or for none."""
    rows = {"oscillation_rows": {"choke": True}} if structure.integer_mvs else {}
    return make_tuning(structure, **(fields | more), **rows)


def controller_of(kind, model, structure, fields, **more):
    """A controller of a kind; the structure is for whole moves."""
    structure = structure if "integer" in kind else structure.relaxed()
    if kind == "ideal":
        more = {"ideal": [55.0, 0.0], "ideal_weight": [1.0, 0.0]} | more
    tuning = tuned(structure, fields, **more)
    if kind.startswith("scheduled"):
        corners = [(choke, lift) for choke in (0.0, 100.0) for lift in (0.0, 10000.0)]
        named = [dict(zip(model.mv_names, corner, strict=True)) for corner in corners]
        models = [dataclasses.replace(model, working_point=tuple(point.items())) for point in named]
        return ScheduledController(structure, tuning, make_schedule(models))
    return Controller(structure, tuning, model)


def stepped(controller, state, cv, setpoint=SETPOINT, mv=None, manual=None):
    """One step of any kind of controller."""
    return controller.step(state, cv, setpoint, mv=mv, manual=manual)


def closed(controller, process, samples, *, seen=lambda k, cv: cv, told=False, **options):
    """States and infos of a closed loop; `seen` turns what is measured into what arrives."""
    state, states, infos = controller.init(*START), [], []
    for k in range(samples):
        arrived = seen(k, process.cv.copy())
        state, info = stepped(controller, state, arrived, mv=process.mv if told else None, **options)
        process.step(state.mv)
        states.append(state)
        infos.append(info)
    return states, infos
