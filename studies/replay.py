"""What a replay says of a log: predictions one sample ahead, and how the advice compares with what was done.

Missing measurements are left out. An advice begins where the MVs stand and is given again as long as nobody follows it, so
that its travel counts every repetition.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float

from jaxmpc import status as codes
from jaxmpc.files import write_atomically
from jaxmpc.process.process import Process
from studies.plans import begins
from studies.store.process import process_in
from studies.store.reading import open_results
from studies.tables import csv_text, markdown_table


def predicted(data: xr.Dataset) -> Float[np.ndarray, "sample cv"]:
    """Each CV as it was foreseen one sample before, bias included; not a number where nothing was measured [CV unit].

    Args:
        data: of one run.
    """
    before = np.concatenate([np.zeros((1, data.sizes["cv"])), data.bias.values[:-1]])
    before[begins(data)] = 0.0
    return data.measurement.values - data.bias_raw.values + before


def summary(data: xr.Dataset) -> list[tuple[str, str]]:
    """Key figures of a replay: what it is with its unit, and its value.

    Args:
        data: of its run.
    """
    process, stretches = process_in(data), int(begins(data).sum())
    count = data.sizes["time"]
    rows = [("samples", f"{count} in {stretches} stretch{'es' * (stretches > 1)} of the log")]
    rows += [row for i in range(len(process.mvs)) for row in _of_mv(process, i, data)]
    rows += [row for i in range(len(process.cvs)) for row in _of_cv(process, i, data)]
    solved, held = data.status.values == codes.OPTIMAL, data.fallback.values > 0
    by = {name: int((data.finished_by.values[solved] == code).sum()) for code, name in _finishers()}
    found = ", ".join(f"{name} {times}" for name, times in by.items() if times)
    times = 1e3 * data.solve_time.values
    gap = data.gap.values[np.isfinite(data.gap.values)]
    return [
        *rows,
        ("decisions proven optimal [%]", f"{100 * solved.mean():.4g}" + (f" (by {found})" if found else "")),
        ("largest gap", f"{gap.max():.2g}" if gap.size else "none proven"),
        ("samples without a plan", f"{held.sum()}"),
        ("solve time, mean / longest [ms]", f"{times.mean():.3g} / {times.max():.3g}"),
    ]


def _finishers() -> list[tuple[int, str]]:
    return [(code, name) for code, name in enumerate(codes.FINISHERS) if name]


def _of_mv(process: Process, i: int, data: xr.Dataset) -> list[tuple[str, str]]:
    mv, step = process.mvs[i], process.mvs[i].smallest_move
    position, advice = data.position.values[:, i], data.demand.values[:, i]
    moves = position - (advice - data.move.values[:, i]), data.move.values[:, i]
    off = np.abs(advice - position)
    travel = " / ".join(f"{np.abs(own).sum():.4g}" for own in moves)
    number = " / ".join(f"{(np.abs(own) > step * (1 + 1e-9)).sum()}" for own in moves)
    named = mv.label if mv.unit == "1" else f"{mv.label} [{mv.unit}]"
    return [
        (f"travel of {named}, done / advised", travel),
        (f"moves of {mv.label}, done / advised", number),
        (f"mean distance of advice and action, {named}", f"{off.mean():.3g}"),
        (f"advice and action of {mv.label} agree [% of samples]", f"{100 * (off <= step).mean():.4g}"),
    ]


def _of_cv(process: Process, i: int, data: xr.Dataset) -> list[tuple[str, str]]:
    cv, measured = process.cvs[i], data.measurement.values[:, i]
    known = np.isfinite(measured)
    named = cv.label if cv.unit == "1" else f"{cv.label} [{cv.unit}]"
    mean = lambda values: f"{values.mean():.3g}" if values.size else "nothing measured"  # noqa: E731
    error = (measured - predicted(data)[:, i])[known] ** 2
    changed = np.where(begins(data), np.nan, np.diff(measured, prepend=np.nan)) ** 2
    changed = changed[np.isfinite(changed)]
    root = lambda squares: f"{np.sqrt(squares.mean()):.3g}" if squares.size else "-"  # noqa: E731
    return [
        (f"measured samples of {cv.label} [%]", f"{100 * known.mean():.4g}"),
        (
            f"mean deviation of {named} from its setpoint",
            mean(np.abs(measured - data.setpoint[:, i].values)[known]),
        ),
        (
            f"{named} one sample ahead, error of the prediction / of no change, rms",
            f"{root(error)} / {root(changed)}",
        ),
    ]


def write_summary(folder: str | Path) -> Sequence[tuple[str, str]]:
    """Write the key figures of a replay as ``summary.md`` and ``summary.csv`` beside its results; returns them."""
    folder = Path(folder)
    data = open_results(folder).isel(controller=0).load()
    rows = summary(data)
    title = [f"# {data.attrs['title']}", ""]
    table = markdown_table(["", str(data.label.item())], rows)
    write_atomically(folder / "summary.md", "\n".join([*title, *table, ""]))
    write_atomically(folder / "summary.csv", csv_text(["key_figure", "value"], rows))
    return rows
