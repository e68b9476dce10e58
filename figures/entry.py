"""What a figure is: its number, the study that it reads, the function that draws it, and what to say about it."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import xarray as xr
from matplotlib.figure import Figure


@dataclasses.dataclass(frozen=True)
class FigureEntry:
    """One figure.

    Attributes:
        id: ``10`` for thesis figure 10, or a name.
        title: what it shows.
        study: name in `studies.thesis.catalogue.STUDIES` of the study whose results it reads; None if it reads none.
        name: of its files.
        function: makes it, as a context that closes the figure: called with the results and `arguments`.
        needs: controllers whose runs must be finished.
        arguments: for `function` beside the results, or a function of the results that gives them.
        select: the part of the results that is drawn; everything if None.
        caption: one to three sentences on what to see, or a function of the results that gives them.
        alt: what is drawn, for readers who do not see it.
    """

    id: str
    title: str
    study: str | None
    name: str
    function: Callable[..., contextlib.AbstractContextManager[Figure]]
    needs: tuple[str, ...] = ()
    arguments: Mapping[str, Any] | Callable[[xr.Dataset], Mapping[str, Any]] = dataclasses.field(
        default_factory=dict
    )
    select: Callable[[xr.Dataset], xr.Dataset] | None = None
    caption: str | Callable[[Any], str] = ""
    alt: str = ""

    @property
    def source(self) -> str:
        """The function that draws it, as ``module.function``."""
        return f"{self.function.__module__}.{self.function.__name__}"

    def draw(self, data: xr.Dataset | None) -> contextlib.AbstractContextManager[Figure]:
        """The figure from the results of its study, to be used in a `with` statement."""
        arguments = self.arguments(data) if callable(self.arguments) else self.arguments  # type: ignore[arg-type]
        if self.select is not None and data is not None:
            data = self.select(data)
        return self.function(data, **arguments)

    def text(self, data: xr.Dataset | None) -> str:
        """Its caption."""
        return self.caption(data) if callable(self.caption) else self.caption
