"""What the thesis says in its chapters 6 to 8, measured on stored results.

`ROWS` are the statements with how each is measured and when it holds, in the order of the thesis; their words are in
``rows.toml``, their measures in the modules beside it, and `judge` turns one into a `Claim`. `claims_study` runs what they
need and writes the tables of `tables`; `claims` are the rows of the summary page.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import xarray as xr

from studies.thesis.claims import comparison, cost, events, limits, moves, predictions, settling, soft
from studies.thesis.claims.record import Claim as Claim
from studies.thesis.claims.record import Evidence as Evidence
from studies.thesis.claims.record import Finding, claim_of
from studies.thesis.claims.record import Row as Row

MEASURES: tuple[ModuleType, ...] = (comparison, cost, events, moves, predictions, settling, soft)
SUMMARY = (
    "smooth-quiet",
    "rounded-oscillates",
    "rounded-below-half",
    "integer-quiet",
    "rounded-deviates-less",
    "rounded-travels-more",
    "stationary-deviation",
    "staircase",
)


def _rows() -> tuple[Row, ...]:
    """The rows with the limits and phrases that their words name written out."""
    body = tomllib.loads(Path(__file__).with_name("rows.toml").read_text("utf-8"))
    known: dict[str, Any] = dict(vars(limits))
    known |= {name: words.format_map(known) for name, words in body["words"].items()}
    said = ("statement", "definition", "rule")
    written = ({**row, **{key: row[key].format_map(known) for key in said}} for row in body["row"])
    return tuple(msgspec.convert(row, Row) for row in written)


ROWS = _rows()


def judge(row: Row, evidence: Evidence | None) -> Claim:
    """Measure one row on the results of its study; without its runs it is not tested."""
    missing = [name for name in row.needs if evidence is None or name not in evidence.roles]
    if evidence is None or missing:
        nothing = Finding((), {}, instead=f"no finished run of {', '.join(missing) or row.study}")
        return claim_of(row, nothing)
    module, _, name = row.measure.partition(".")
    measures = next(known for known in MEASURES if known.__name__.endswith(f".{module}"))
    return claim_of(row, getattr(measures, name)(evidence, *map(evidence.run, row.needs)))


def claims(data: xr.Dataset, figures: xr.Dataset | None = None) -> list[Claim]:
    """The rows of the summary page: what the thesis says of the three controllers, measured on these results.

    Rows whose controllers have not run are left out.

    Args:
        data: results of the thesis study.
        figures: from `key_figures`, if already there.
    """
    evidence, known = Evidence.of(data, given=figures), {row.id: row for row in ROWS}
    rows = (known[name] for name in SUMMARY)
    return [judge(row, evidence) for row in rows if set(row.needs) <= set(evidence.roles)]
