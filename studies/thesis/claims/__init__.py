"""What the thesis says in its chapters 6 to 8, measured on stored results.

`ROWS` are the statements with how each is measured and when it holds, in the order of the thesis; `record.judge` turns one
into a `Claim`. `claims_study` runs what they need and writes the tables of `tables`; `claims` are the rows of the
summary page.
"""

from studies.thesis.claims import comparison, cost, events, moves, predictions, settling, soft
from studies.thesis.claims.comparison import claims
from studies.thesis.claims.record import Claim, Evidence, Row, judge


def _place(row: Row) -> tuple[int, ...]:
    return tuple(int(part) for part in row.section.split(",")[0].split("."))


ROWS: tuple[Row, ...] = tuple(
    sorted(
        [
            *cost.ROWS,
            *soft.ROWS,
            *comparison.ROWS,
            *moves.ROWS,
            *settling.ROWS,
            *predictions.ROWS,
            *events.ROWS,
        ],
        key=_place,
    )
)

__all__ = ["ROWS", "Claim", "Evidence", "Row", "claims", "judge"]
