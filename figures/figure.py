"""What a figure is: its number, the study that it reads, the function that draws it, and what to say about it.

Drawing, caption and entry of a figure stand in one file of `figures.thesis` or `figures.comparison`; `figures.registry`
collects the entries.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping
from typing import Any

import xarray as xr
from matplotlib.figure import Figure

from figures import style


@dataclasses.dataclass(frozen=True)
class FigureEntry:
    """One figure.

    Attributes:
        id: ``10`` for thesis figure 10, or a name.
        title: what it shows.
        study: the kind of comparison whose results it reads, one of `studies.thesis.catalogue.STUDIES`, or ``comparison``
            for any; None if it reads none.
        function: makes it from the results and `arguments`; its docstring begins with what is drawn.
        caption: one to three sentences on what to see, or a function of the results and `arguments` that gives them.
        slug: what its files are called behind ``figure_10_``; those of a figure with a name have that name.
        needs: controllers whose runs must be finished.
        arguments: for `function` and `caption` beside the results.
    """

    id: str
    title: str
    study: str | None
    function: Callable[..., Figure]
    caption: str | Callable[..., str]
    slug: str = ""
    needs: tuple[str, ...] = ()
    arguments: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def name(self) -> str:
        """Of its files."""
        return f"figure_{self.id}_{self.slug}" if self.slug else self.id.replace("-", "_")

    @property
    def source(self) -> str:
        """The function that draws it, as ``module.function``."""
        return f"{self.function.__module__}.{self.function.__name__}"

    @style.house_style
    def draw(self, data: xr.Dataset | None) -> Figure:
        """The figure from the results of its study."""
        return self.function(data, **self.arguments)

    @property
    def alt(self) -> str:
        """What is drawn, for readers who do not see it."""
        return " ".join(str(inspect.getdoc(self.function)).partition("\n\n")[0].split())

    def text(self, data: xr.Dataset | None) -> str:
        """Its caption."""
        return style.minus(self.caption(data, **self.arguments) if callable(self.caption) else self.caption)
