"""From a definition to the study that it describes: all scenarios of a sweep, or the space of a search."""

from __future__ import annotations

from pathlib import Path

from studies.definition.scenarios import Study, expand_sweep
from studies.definition.sweep import StudyDefinition, load_definition
from studies.search.study import SearchStudy, expand_search


def expand(
    definition: StudyDefinition, *, quick: bool = False, confirmed: bool = False
) -> Study | SearchStudy:
    """All scenarios of a definition, or its search where it has ``[search]``, checked; nothing is simulated.

    Args:
        definition: from `load_definition` or `StudyDefinition.from_dict`.
        quick: the quick version.
        confirmed: accept more scenarios than ``study.confirmation_limit``.

    Raises:
        InputError: naming the path of the field.
    """
    made = expand_sweep if definition.search is None else expand_search
    return made(definition.cut() if quick else definition, confirmed=confirmed)


def load_study(
    name_or_path: str | Path,
    *,
    quick: bool = False,
    confirmed: bool = False,
    process: str | Path | None = None,
) -> Study | SearchStudy:
    """Read a definition (`load_definition`) and expand it; arguments and errors as for `expand`.

    Args:
        name_or_path: a shipped study or a file.
        quick: the quick version.
        confirmed: accept more scenarios than ``study.confirmation_limit``.
        process: in place of that of the definition.
    """
    return expand(load_definition(name_or_path, process), quick=quick, confirmed=confirmed)
