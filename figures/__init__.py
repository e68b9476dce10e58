"""Figures from stored results; nothing here solves anything. `plot` and `pareto` are loaded when first used."""

from importlib import import_module as _import_module
from typing import Any as _Any

_QUICK = {"pareto": "figures.sweep.wear", "plot": "figures.show"}


def __getattr__(name: str) -> _Any:
    """The quick looks, so that importing the package stays light."""
    if name not in _QUICK:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(_import_module(_QUICK[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_QUICK})
