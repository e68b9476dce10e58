"""Figures from stored results; nothing here solves anything. `plot` and `pareto` are loaded when first used.

``figures.pareto`` is a module and can be called: ``figures.pareto(study)`` draws the front of a study.
"""

import sys as _sys
from importlib import import_module as _import_module
from types import ModuleType as _ModuleType
from typing import Any as _Any


class _Front(_ModuleType):
    """The module `figures.pareto`, which can be called."""

    def __call__(self, study: _Any, *arguments: _Any, **options: _Any) -> _Any:
        """See `figures.show.pareto`."""
        from figures import show

        return show.pareto(study, *arguments, **options)


class _Figures(_ModuleType):
    """This package; it learns of a module of its own when that is imported, whoever imports it."""

    def __setattr__(self, name: str, value: _Any) -> None:
        if name == "pareto":
            value.__class__ = _Front
        super().__setattr__(name, value)


def __getattr__(name: str) -> _Any:
    """The quick looks of `figures.show`, so that importing the package stays light."""
    if name == "plot":
        from figures import show

        return show.plot
    if name == "pareto":
        return _import_module("figures.pareto")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), "plot", "pareto"})


_sys.modules[__name__].__class__ = _Figures
