"""Every statement of thesis chapters 6 to 8 as a measured row: runs the studies that the rows need, and writes the tables.

`jaxmpc study run claims` calls `run_claims`. All numbers come from stored results, but for times of controller steps on the
JAX well: its loops run compiled, so that a sample has no time of its own, and some loops are run again on the host for it.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np

from identify.plants import open_plant
from jaxmpc.files import write_atomically
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.process.host import HostPlant
from studies.definition.catalogue import Comparison
from studies.definition.comparison import ReferenceDefinition
from studies.run.comparison import is_current, run_controller
from studies.store.reading import open_results
from studies.store.writing import check_writable
from studies.thesis import catalogue
from studies.thesis.claims import ROWS, Claim, Evidence, judge, tables

FORMAT = "jaxmpc/claims/1"
NEEDED = tuple(dict.fromkeys(row.study for row in ROWS))  # keys of `studies.thesis.catalogue.STUDIES`
TIMED = 18_000.0  # s of a run that are run again for its times: three targets of the thesis reference
GALLERY = "../../figures-out/index.html"  # where `jaxmpc figures all` puts it


def run_claims(
    out: str | Path = "results",
    quick: bool = False,
    plant: str = catalogue.PLANTS[0],
    *,
    progress: bool = True,
    say: Callable[[str], None] = print,
    gallery: str = GALLERY,
) -> Path:
    """Measure every row on the studies of the catalogue; what of them is stored and current is not run again.

    Args:
        out, quick, plant, progress, say: as for `studies.thesis.catalogue.run_thesis`.
        gallery: page of the figures for the links of ``claims.html``, relative to it.

    Returns:
        The folder ``claims-PLANT`` or ``claims-quick-PLANT`` with ``claims.md``, ``claims.csv``, ``claims.json`` and
        ``claims.html``; errors as for `run_thesis`.
    """
    folder = check_writable(Path(out) / catalogue.study_name("claims", quick, plant))
    found: dict[str, Claim] = {}
    hashes: dict[str, str] = {}
    for study in NEEDED:
        comparison = catalogue.comparison_of(study, quick, plant)
        results = Path(out) / comparison.definition.name
        if is_current(comparison.definition, results):
            say(f"{results}: complete.")
        else:
            results = catalogue.run_thesis(study, out, quick, plant, progress=progress, say=say)
        data = open_results(results).load()
        hashes[study] = str(data.attrs["study_hash"])
        clock = _Clock(comparison, results, folder / "times.json", progress, say)
        evidence = Evidence.of(data, clock if plant == "jax" else None)
        found |= {row.id: judge(row, evidence) for row in ROWS if row.study == study}
    claims = [found[row.id] for row in ROWS]
    _write(claims, folder, quick, plant, hashes, gallery)
    say(f"{tables.tally(claims)}: {folder / 'claims.html'}")
    return folder


def _write(
    claims: list[Claim], folder: Path, quick: bool, plant: str, hashes: dict[str, str], gallery: str
) -> None:
    """Write the rows as ``claims.md``, ``claims.csv``, ``claims.json`` and ``claims.html``, each in one go."""
    title = "The statements of the thesis, measured"
    well = "an FMU of the well" if plant == "fmu" else "the JAX twin of the well"
    note = f"Measured on our own runs: {'shortened' if quick else 'full'} studies, {well}."
    body = {"format": FORMAT, "quick": quick, "plant": plant, "results": hashes}
    body["claims"] = [claim.written() for claim in claims]
    write_atomically(folder / "claims.md", tables.markdown(claims, title))
    write_atomically(folder / "claims.csv", tables.table_csv(claims))
    write_atomically(folder / "claims.json", json.dumps(body, indent=1, ensure_ascii=False))
    write_atomically(folder / "claims.html", tables.page(claims, title, note, gallery))


@dataclasses.dataclass
class _Clock:
    """Times of controller steps by the name of the run; measured once, then read from a file."""

    comparison: Comparison
    results: Path
    file: Path
    progress: bool
    say: Callable[[str], None]

    def __call__(self, name: str) -> np.ndarray:
        with open_results(self.results) as data:
            key = str(data.sel(controller=name).controller_hash.item())
        known = _read(self.file, self.say)
        if key not in known:
            self.say(f"{self.comparison.definition.name}, {name}: timed on the host.")
            model = StepResponseModel.load(self.results / "model.json")
            known[key] = step_times(self.comparison, name, model, self.progress).tolist()
            write_atomically(self.file, json.dumps(known))
        return np.array(known[key])


def _read(file: Path, say: Callable[[str], None]) -> dict[str, list[float]]:
    """Times that were measured before; none if the file is missing or damaged."""
    try:
        return msgspec.json.decode(file.read_bytes(), type=dict[str, list[float]])
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:
        say(f"{file} is damaged and is measured anew ({error}).")
        return {}


def step_times(
    comparison: Comparison, name: str, model: StepResponseModel, progress: bool = False
) -> np.ndarray:
    """Times of the controller steps of a run on the JAX well [s], ``"sample"``: its first `TIMED` seconds, on the host."""
    definition, process = comparison.definition, comparison.process
    whole = definition.reference
    duration = min(whole.duration, TIMED)
    count = sum(start < duration for start in whole.times)
    reference = ReferenceDefinition(whole.times[:count], whole.setpoints[:count], duration)
    part = msgspec.structs.replace(definition, reference=reference)
    controller = next(one for one in definition.controllers if one.name == name)
    well = lambda actual: HostPlant(open_plant(process, "jax", actual=actual))  # noqa: E731
    return np.asarray(run_controller(controller, part, process, model, well, progress).solve_time)
