"""Controllers and their states as files, so that a restarted controller goes on as if it had not been stopped.

A file is JSON that says its version and holds all numbers in full: after `load_controller` every further step is the one
that would have been made, to the last bit. Reading is as strict as the constructors: nothing that they refuse comes back.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.check import among, check_keys
from jaxmpc.controller.controller import Controller
from jaxmpc.controller.schedule import ModelSchedule, ScheduledController
from jaxmpc.controller.state import ControllerState
from jaxmpc.errors import InputError
from jaxmpc.files import from_strict_json, read_json, strict_json, write_atomically
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.structure import Structure
from jaxmpc.problem.tuning import Tuning, make_tuning

FORMAT = "jaxmpc/controller/2"


class _Parts(NamedTuple):
    """What a controller is made of."""

    kind: str
    structure: Structure
    tuning: Tuning
    model: StepResponseModel | ModelSchedule
    options: dict[str, Any]


def save_controller(controller: Controller, path: str | Path, state: ControllerState | None = None) -> Path:
    """Write a controller, and the state that it is in, as one file.

    Args:
        controller: a single one, of any kind.
        path: the file; replaced in one go.
        state: from `init` or the last `step`; None for the controller alone.
    """
    parts = _parts(controller)
    tuning = {
        field.name: strict_json(getattr(parts.tuning, field.name)) for field in dataclasses.fields(Tuning)
    }
    body = {
        "format": FORMAT,
        "kind": parts.kind,
        "structure": dataclasses.asdict(parts.structure),
        "tuning": tuning,
        "model": parts.model.to_dict(),
        "options": parts.options,
        "state": None if state is None else {name: strict_json(leaf) for name, leaf in _named(state).items()},
    }
    return write_atomically(path, json.dumps(body, allow_nan=False))


def load_controller(path: str | Path) -> tuple[Controller, ControllerState | None]:
    """Read what `save_controller` wrote.

    Returns:
        ``(controller, state)``; the state is None if none was saved.

    Raises:
        InputError: naming the field, for files that cannot be read or are of another version, and for everything that
            the constructors refuse.
    """
    body = read_json("controller file", path)
    if not isinstance(body, dict) or body.get("format") != FORMAT:
        found = body.get("format") if isinstance(body, dict) else type(body).__name__
        raise InputError("controller.format", found, f"{FORMAT!r}, as this version writes it")
    check_keys("controller", body, ("kind", "structure", "tuning", "model", "options", "state"))
    try:
        controller = _made(body)
        return controller, None if body["state"] is None else _restored(controller, body["state"])
    except InputError:
        raise
    except (TypeError, ValueError, AttributeError, KeyError) as error:
        raise InputError("controller file", str(path), f"what save_controller writes ({error})") from error


def _parts(controller: Controller) -> _Parts:
    options = {key: getattr(controller, key) for key in ("gap", "time_limit", "finish")}
    structure, tuning = controller.structure, controller.tuning
    if isinstance(controller, ScheduledController):
        table = {"spacing": controller.spacing, "kept": controller.kept}
        return _Parts("scheduled", structure, tuning, controller.schedule, options | table)
    return _Parts("controller", structure, tuning, controller.model, options)


KINDS = {"controller": Controller, "scheduled": ScheduledController}


def _made(body: dict[str, Any]) -> Controller:
    among("controller.kind", body["kind"], KINDS)
    tuples: dict[str, Any] = {
        key: tuple(v) if isinstance(v, list) else v for key, v in body["structure"].items()
    }
    structure = Structure(**tuples)
    fields = {key: _numbers(f"controller.tuning.{key}", values) for key, values in body["tuning"].items()}
    tuning = make_tuning(structure, path="controller.tuning", **{k: v.tolist() for k, v in fields.items()})
    scheduled = body["kind"] == "scheduled"
    model = (ModelSchedule if scheduled else StepResponseModel).from_dict(body["model"])
    return KINDS[body["kind"]](structure, tuning, model, **body["options"])  # pyright: ignore[reportArgumentType]


def _restored(controller: Controller, saved: Any) -> ControllerState:
    """The state with these numbers, in the form that the controller makes it."""
    if not isinstance(saved, dict):
        raise InputError("controller.state", type(saved).__name__, "an object with the fields of the state")
    check_keys("controller.state", saved, ("base", "mv"))
    base, mv = (_numbers(f"controller.state.{key}", saved[key]) for key in ("base", "mv"))
    fresh = controller.init(base[: controller.structure.cv_count], mv)
    wanted = _named(fresh)
    check_keys("controller.state", saved, wanted)
    for key in saved:
        among(f"controller.state.{key}", key, wanted, "one of", saved[key])
    leaves = []
    for key, leaf in wanted.items():
        value = _numbers(f"controller.state.{key}", saved[key])
        if not value.size and not np.size(leaf):
            value = value.reshape(np.shape(leaf))  # lists do not show all lengths of an empty array
        if value.shape != np.shape(leaf):
            shapes = f"shape {list(value.shape)}", f"shape {list(np.shape(leaf))}"
            raise InputError(f"controller.state.{key}", *shapes)
        value = value.astype(leaf.dtype)
        leaves.append(jnp.asarray(value) if isinstance(leaf, jax.Array) else value)
    return jax.tree.unflatten(jax.tree.structure(fresh), leaves)


def _named(state: ControllerState) -> dict[str, Any]:
    """The arrays of a state by their paths, such as ``warm.x``."""
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): v
        for path, v in jax.tree.leaves_with_path(state)
    }


def _numbers(path: str, given: Any) -> np.ndarray:
    """The array of nested lists."""

    def number(value: Any) -> Any:
        if isinstance(value, list):
            return [number(entry) for entry in value]
        if not isinstance(value, (bool, int, float)):
            raise InputError(path, given, "numbers in nested lists")
        return value

    try:
        return np.array(number(from_strict_json(given)))
    except ValueError:
        raise InputError(path, given, "lists of equal length") from None
