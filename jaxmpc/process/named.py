"""Plants by name: ``module:name`` of a function without arguments, or a class, that makes the plant."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from jaxmpc.errors import InputError, near
from jaxmpc.process.plant import JaxPlant, StatefulPlant


def plant_named(name: str, folder: str | Path | None = None, path: str = "plant") -> JaxPlant | StatefulPlant:
    """Make the plant that a user's module has under this name.

    Args:
        name: ``module:name`` of a function that returns a plant, of a class of plants, or of a plant in JAX itself.
        folder: where the module may lie, beside what Python finds anyhow; the working directory if not given.
        path: of the field in errors.

    Raises:
        InputError: if there is no such module or name, or what it makes is no plant.
    """
    module, colon, attribute = str(name).partition(":")
    if not (module and colon and attribute):
        raise InputError(path, name, "module:name of a function or class that makes a plant")
    found = _imported(module, str(Path(folder or ".").resolve()), path, name)
    if not hasattr(found, attribute):
        raise InputError(path, name, f"a name in {found.__file__ or module}", near(attribute, vars(found)))
    made: Any = getattr(found, attribute)
    made = made() if callable(made) and not isinstance(made, JaxPlant) else made
    missing = [part for part in ("dt", "init", "step") if not hasattr(made, part)]
    if missing:
        raise InputError(
            path, name, f"a plant, with dt, init and step; {type(made).__name__} has no {missing[0]}"
        )
    return made


def _imported(module: str, folder: str, path: str, name: str) -> Any:
    """The module, also from a folder that is not on Python's path."""
    sys.path.insert(0, folder)
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(
            f"{error.name}."
        ):  # it imports something that is missing
            raise
        raise InputError(path, name, f"a module in {folder} or on Python's path") from None
    finally:
        sys.path.remove(folder)
