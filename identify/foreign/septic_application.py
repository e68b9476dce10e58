"""An application of a SEPTIC configuration: its head, its variables, the system, and what else the file has."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from identify.foreign import cnfg
from identify.foreign.cnfg import Block
from identify.foreign.septic_meaning import APPLICATIONS, meanings_of, refuse_twice
from jaxmpc.check import among, require


@dataclasses.dataclass(frozen=True)
class Application:
    """An application with its variables.

    Attributes:
        blocks: all of the file.
        others: blocks of other applications, and variables that belong to none.
    """

    head: Block
    mvs: tuple[Block, ...]
    cvs: tuple[Block, ...]
    dvs: tuple[Block, ...]
    system: Block | None
    blocks: tuple[Block, ...]
    others: tuple[Block, ...]

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """Of CVs, MVs and DVs."""
        groups = {"cvs": self.cvs, "mvs": self.mvs, "dvs": self.dvs}
        return {key: tuple(block.name for block in own) for key, own in groups.items()}


def application_of(path: Path, name: str = "") -> Application:
    """The application of a configuration.

    Raises:
        InputError: for a file without one, several of them and no name, and blocks or attributes that stand twice.
    """
    blocks = cnfg.read_file(path)
    heads = [block for block in blocks if block.kind in APPLICATIONS]
    listed = [block.name for block in heads]
    require(heads, str(path), sorted({block.kind for block in blocks}), "an application: MPCAppl or SmpcAppl")
    if not name:
        hint = "The configuration has several"
        require(len(heads) == 1, "--application", None, f"one of {', '.join(listed)}", hint)
        name = listed[0]
    among("--application", name, listed)
    head = heads[listed.index(name)]
    begin = blocks.index(head)
    ends = [
        k for k, b in enumerate(blocks) if k > begin and (b.kind.endswith("Appl") or b.kind == "DisplayGroup")
    ]
    own = blocks[begin : min(ends, default=len(blocks))]
    groups = {kind: tuple(block for block in own if block.kind == kind) for kind in ("Mvr", "Cvr", "Dvr")}
    for kind in ("Mvr", "Cvr"):
        require(groups[kind], head.where, f"{head.kind}: {head.name}", f"a block {kind} or more after it")
    system = next((block for block in blocks if block.kind == "System"), None)
    mine = [*([system] if system else []), *own]
    refuse_twice(mine)
    known = {id(block) for block in mine}
    others = tuple(block for block in blocks if meanings_of(block) is not None and id(block) not in known)
    return Application(head, groups["Mvr"], groups["Cvr"], groups["Dvr"], system, tuple(blocks), others)
