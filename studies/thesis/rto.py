"""Real-time optimisation above the controller (thesis 6.7): low demands with and without it, from nothing to results.

Some demanded rates can only be met with a little lift, 0 to 2000 m3/h, where a well slugs. `run_rto` lets the same
mixed-integer controller follow the demands as they are, and follow what `steady.optimise` makes of them: rates within the
demands' deadzones that need no such lift, and the choke and lift that belong to them as ideal values (6.20).
`figures.thesis.rto` draws the results.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from identify.plants import model_of, open_plant, plant_facts
from identify.steady_map import steady_map
from jaxmpc.controller.controller import Controller
from jaxmpc.files import write_atomically
from jaxmpc.loop.events import Event
from jaxmpc.loop.simulate import simulate
from jaxmpc.loop.trajectory import Trajectory
from jaxmpc.model.step_response import StepResponseModel
from jaxmpc.problem.structure import Structure
from jaxmpc.process.plant import closing
from jaxmpc.process.reference import Reference
from jaxmpc.process.well.grids import LIFT_RANGES, STEADY_MAP
from jaxmpc.steady.map import SteadyMap
from jaxmpc.steady.optimise import Targets, optimise
from studies.run.comparison import labelled, progress_bar, results_layout, run_missing
from studies.store.files import RESULTS
from studies.store.fingerprint import content_hash, module_hash, packages_hash
from studies.store.layout import StoreLayout
from studies.store.reading import open_results
from studies.store.writing import check_writable, locked
from studies.tables import markdown_table
from studies.thesis.catalogue import study_name
from studies.thesis.steady import over_inputs
from studies.thesis.well import CHOKE, GAS, LIFT, OIL, WELL

WITHOUT, WITH = "without-rto", "with-rto"
LABELS = {WITHOUT: "mixed-integer MPC", WITH: "mixed-integer MPC below an RTO"}
# start [s], gas rate [m3/h], oil rate [m3/h]
WINDOWS = (
    (0, 11013, 185),  # the working point
    (3600, 2700, 81),  # met with about 1600 m3/h of lift
    (12000, 1750, 54),  # met with about 1050 m3/h
    (20400, 9640, 152),
)
DURATION, QUICK_DURATION = 28_800.0, 12_000.0  # s; the quick run ends before the third window
PRICES = {GAS: 0.1, OIL: 400.0, LIFT: 0.3}  # per m3
OPTIMISING = tuple(f"jaxmpc.steady.{name}" for name in ("optimise", "milp", "map"))  # set the targets
SETTLED = 300.0  # s at the end of a window that stand for where a run settles
IDEAL_WEIGHT = {CHOKE: 1.0, LIFT: 1e-3}  # 1/(%)^2, 1/(m3/h)^2


def demands(quick: bool = False) -> Reference:
    """Demanded gas and oil rate [m3/h] over time; the first two windows alone if `quick`."""
    duration = QUICK_DURATION if quick else DURATION
    rows = [row for row in WINDOWS if row[0] < duration]
    return Reference([row[0] for row in rows], [row[1:] for row in rows], duration)


def targets_of(steady: SteadyMap, demanded: Reference, deadzone: np.ndarray) -> list[Targets]:
    """What the real-time optimisation makes of each demand: the most profitable point within its deadzone [CV unit]."""
    return [
        optimise(
            steady,
            PRICES,
            rates - deadzone,
            rates + deadzone,
            mv_ranges={CHOKE: [(0.0, 100.0)], LIFT: LIFT_RANGES},
            mv_steps={CHOKE: WELL.mvs[0].actuator.step},
        )
        for rates in demanded.setpoints
    ]


def run_rto(
    out: str | Path = "results",
    quick: bool = False,
    plant: str = "jax",
    *,
    progress: bool = True,
    say: Callable[[str], None] = print,
) -> Path:
    """Compute and store both runs; what is stored already with equal inputs is kept.

    Args:
        quick: 1,200 instead of 2,880 samples.
        plant: ``jax``, or ``fmu``, whose steady map takes longer.
        out, progress, say: as for `studies.thesis.catalogue.run_thesis`.

    Returns:
        The folder of the study, with ``results.zarr`` (see `studies.store.reading.open_results`), ``model.json``,
        ``steady_map.json`` and ``summary.md``, where both runs settle; errors as for `run_thesis`.
    """
    folder = check_writable(Path(out) / study_name("rto", quick, plant))
    demanded = demands(quick)
    with locked(folder / RESULTS):
        with closing(open_plant(WELL, plant, actual=False)) as tested:
            model, steady = model_of(WELL, tested), steady_map(tested, STEADY_MAP)
            facts = plant_facts(WELL, tested)
        model.save(folder / "model.json")
        steady.save(folder / "steady_map.json")
        structure = WELL.structure(integer=True)
        tuning = WELL.tuning(structure)
        found = targets_of(steady, demanded, np.asarray(tuning.deadzone))
        for rates, each in zip(demanded.setpoints, found, strict=True):
            say(
                f"Demand {rates[0]:.0f} / {rates[1]:.0f} m3/h: gas {each.cv[0]:.0f}, oil {each.cv[1]:.0f} m3/h "
                f"with {each.mv[0]:.0f} % choke and {each.mv[1]:.0f} m3/h lift. {each.message}"
            )
        shared = _shared(demanded, found, np.asarray(tuning.deadzone), steady, structure.dt)
        layout = _layout(folder.name, demanded, found, facts, model, structure, shared)

        def run(i: int) -> Trajectory:
            name, label = list(LABELS.items())[i]
            with closing(open_plant(WELL, plant)) as well, progress_bar(label, progress) as report:
                if name == WITHOUT:
                    return simulate(Controller(structure, tuning, model), well, demanded, progress=report)
                setpoints = Reference(demanded.times, [each.cv for each in found], demanded.duration)
                controller = Controller(
                    structure, WELL.tuning(structure, changes={"ideal_weight": IDEAL_WEIGHT}), model
                )
                ideal = [
                    Event(float(time), {"ideal": each.mv})
                    for time, each in zip(demanded.times, found, strict=True)
                ]
                return simulate(controller, well, setpoints, events=ideal, progress=report)

        run_missing(folder, layout, run, say)
    write_atomically(folder / "summary.md", markdown(open_results(folder).load()))
    return folder


def _layout(
    name: str,
    demanded: Reference,
    found: list[Targets],
    facts: dict[str, Any],
    model: StepResponseModel,
    structure: Structure,
    shared: dict[str, xr.DataArray],
) -> StoreLayout:
    """The store of both runs, known by their inputs."""
    code = packages_hash() | {name: module_hash(name) for name in OPTIMISING}
    inputs = {
        "plant": facts,
        "model": np.asarray(model.coefficients),
        "map": shared["map_rate"].values,
        "demands": [demanded.times.tolist(), demanded.setpoints.tolist(), demanded.duration],
        "prices": PRICES,
        "tuning": WELL.tuning_fields(),
        "code": code,
    }
    hashes = [content_hash(inputs, WITHOUT), content_hash(inputs, WITH, IDEAL_WEIGHT)]
    provenance = {
        "study": name,
        "title": "Low demands: mixed-integer MPC with and without real-time optimisation",
        "plant": facts,
        "prices": PRICES,
        "ideal_weight": IDEAL_WEIGHT,
        "lift_ranges": [list(pair) for pair in LIFT_RANGES],
        "messages": [each.message for each in found],
        "code": code,
    }
    return results_layout(
        controllers=LABELS,
        hashes=hashes,
        structure=structure,
        times=structure.dt * np.arange(demanded.samples(structure.dt)),
        blocks=structure.block_count,
        shared=lambda: shared,
        provenance=provenance,
        study_hash=content_hash(name, hashes),
    )


def _shared(
    demanded: Reference, found: list[Targets], deadzone: np.ndarray, steady: SteadyMap, dt: float
) -> dict[str, xr.DataArray]:
    """Demands, setpoints, targets, tuning and the steady map, as variables of the results."""
    window, rates = demanded.window(dt), demanded.sample(dt)
    cv, mv = (np.array([getattr(each, key) for each in found])[window] for key in ("cv", "mv"))
    setpoint, target = np.stack([rates, cv]), np.stack([np.full_like(mv, np.nan), mv])
    profit = np.array([each.profit for each in found])
    lanes = ("controller", "time")
    half = np.tile(deadzone, (2, 1))
    texts = {
        name: xr.DataArray(np.array([value] * 2, dtype=np.dtypes.StringDType()), dims="controller")
        for name, value in {"kind": "mixed-integer", "actuator": "step"}.items()
    }
    return {
        "demanded": labelled(rates, ("time", "cv"), "demanded CV", "cv_unit"),
        "setpoint": labelled(setpoint, (*lanes, "cv"), "setpoint", "cv_unit"),
        "target": labelled(target, (*lanes, "mv"), "ideal value", "mv_unit"),
        "window": labelled(window.astype("i4"), ("time",), "index of the demand", "1"),
        "profit": labelled(profit, ("demand",), "steady profit of the target", "1/h"),
        "tuning_deadzone": labelled(half, ("controller", "cv"), "half width of the deadzone", "cv_unit"),
        **texts,
        "map_rate": over_inputs("map", steady.grid, steady.cv, "steady CV", "cv_unit"),
    }


def markdown(data: xr.Dataset) -> str:
    """Where both runs settle for each demand as a Markdown table: means over the last `SETTLED` seconds of its window."""
    rows = []
    window, half = data.window.values, data.tuning_deadzone.isel(controller=0)
    samples = round(SETTLED / float(data.attrs["dt"]))
    for w in range(int(window.max()) + 1):
        end = data.isel(time=np.flatnonzero(window == w)[-samples:])
        rates = end.demanded.isel(time=-1)
        for name in data.controller.values:
            run = end.sel(controller=name)
            off = (run.measurement - rates).mean("time")
            choke, lift = (float(run.position.sel(mv=mv).mean()) for mv in (CHOKE, LIFT))
            far = float((np.abs(off) / half).max())
            asked, away = ([float(v.sel(cv=cv)) for cv in (GAS, OIL)] for v in (rates, off))
            row = {
                "gas / oil demanded [m3/h]": f"{asked[0]:.0f} / {asked[1]:.0f}",
                "run": str(run.label.item()),
                "choke [%]": f"{choke:.1f}",
                "lift [m3/h]": f"{lift:.0f}",
                "gas / oil off the demand [m3/h]": f"{away[0]:+.0f} / {away[1]:+.1f}",
                "half widths off": f"{far:.2f}",
            }
            rows.append(row)
    table = markdown_table(list(rows[0]), [list(row.values()) for row in rows])
    return "\n".join([f"# {data.attrs['title']}", "", *table, ""])
