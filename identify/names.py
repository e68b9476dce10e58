"""Names that a process may have, for what FMUs and files of other tools call otherwise."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence

from jaxmpc.process.file import VARIABLE

LONGEST = 60  # characters, so that there is room for a number


def legal_names(names: Sequence[str]) -> dict[str, str]:
    """Names that a process may have, all distinct, by those that are given: ``tank[1].level`` as ``tank_1_level``.

    A name that is legal stays.
    """
    out: dict[str, str] = {}
    for name in names:
        plain = name if VARIABLE.fullmatch(name) else _plain(name)
        own, k = plain, 1
        while own in out.values() or (own != name and own in names):
            k += 1
            own = f"{plain}_{k}"
        out[name] = own
    return out


def _plain(name: str) -> str:
    text = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    text = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_") or "variable"
    return (text if text[0].isalpha() else f"v_{text}")[:LONGEST]
