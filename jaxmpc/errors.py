"""Errors that say what to do: one type for bad input, one for a missing tool, one for a plant that fails."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Bad input, refused before anything is computed or overwritten.

    Args:
        field: path of the offending field, for example ``tuning.cv_weight[1]``.
        value: the value that was given.
        expected: what was expected, with the unit.
        hint: what to do about it (optional).
    """

    def __init__(self, field: str, value: object, expected: str, hint: str = ""):
        self.field, self.value, self.expected, self.hint = field, value, expected, hint
        shown = repr(value)
        if len(shown) > 120:
            shown = shown[:117] + "..."
        super().__init__(f"{field}: got {shown}, expected {expected}" + (f". {hint}" if hint else ""))

    def __reduce__(self):
        return type(self), (self.field, self.value, self.expected, self.hint)


class MissingToolError(RuntimeError):
    """A program outside Python (a compiler, cmake) is missing; the message says what to install."""


class PlantError(RuntimeError):
    """A plant has failed while it ran, for example an FMU that crashed; the message says which one, how and when."""


def near(given: object, known: Iterable[str]) -> str:
    """``Did you mean ...?`` for the closest known names; empty where none is close."""
    found = difflib.get_close_matches(str(given), list(known), n=3, cutoff=0.6)
    return f"Did you mean {' or '.join(found)}?" if found else ""
