"""Made-up closed loops of the thesis's shape, to test stores, key figures and plots without solving."""

import tempfile
from pathlib import Path

import numpy as np
import xarray as xr

from jaxmpc.loop.trajectory import Trajectory
from jaxmpc.model.step_response import make_model
from studies.definition.comparison import ComparisonDefinition, ReferenceDefinition
from studies.run.comparison import comparison_layout
from studies.store.files import RESULTS
from studies.store.layout import StoreLayout
from studies.store.reading import open_results
from studies.store.trajectories import run_fields
from studies.store.writing import Store
from studies.thesis import catalogue
from studies.thesis.well import WELL

DT = 10.0
CONTROLLERS = catalogue.comparison_of("thesis", False, "jax").definition.controllers
REFERENCE = ReferenceDefinition((0.0, 2000.0), ((10_000.0, 150.0), (30_000.0, 300.0)), 4000.0)


def definition(**changes) -> ComparisonDefinition:
    """Two windows of 200 samples: one setpoint pair within reach of the map, one far outside."""
    fields = {
        "name": "made-up",
        "title": "Made-up comparison",
        "process": WELL.name,
        "plant": "jax",
        "controllers": CONTROLLERS,
        "reference": REFERENCE,
    }
    return ComparisonDefinition(**{**fields, **changes})


def model():
    """A ramp of four coefficients per response."""
    ramp = np.tile(np.arange(1.0, 5.0), (2, 2, 1))
    return make_model(
        ramp,
        DT,
        ("gas_rate", "oil_rate"),
        ("choke", "gas_lift"),
        cv_units=("m3/h",) * 2,
        mv_units=("%", "m3/h"),
    )


def extra() -> dict[str, xr.DataArray]:
    """A plant whose steady gas is 100 times and whose oil is 1.5 times the choke, whatever the lift."""
    choke, lift = np.linspace(0, 100, 11), np.array([0.0, 10_000.0])
    rate = np.stack([np.tile(100 * choke, (2, 1)), np.tile(1.5 * choke, (2, 1))])
    sweep = np.ones((2, 3, 5)) * np.arange(5.0, 0.0, -1.0)
    return {
        "map_rate": xr.DataArray(
            rate, dims=("cv", "map_lift", "map_choke"), coords={"map_lift": lift, "map_choke": choke}
        ),
        "sweep_coefficient": xr.DataArray(
            sweep,
            dims=("cv", "sweep_lift", "sweep_choke"),
            coords={"sweep_lift": [5000.0, 7500.0, 10_000.0], "sweep_choke": np.linspace(10, 90, 5)},
        ),
    }


def layout(
    study_hash="study", hashes=("a", "b", "c"), of: ComparisonDefinition | None = None, code=None
) -> StoreLayout:
    """The store of the comparison."""
    facts = {"kind": "jax"}, {"jaxmpc": "none"} if code is None else code
    return comparison_layout(of or definition(), WELL, model(), extra, list(hashes), study_hash, *facts)


def begin(folder, given: StoreLayout | None = None, say=lambda line: None) -> Store:
    """Its store, made if it is not there."""
    return Store.begin(folder / RESULTS, given or layout(), say, lock=False)


def write(store: Store, name: str, run: Trajectory, wall_time: float = 1.0) -> None:
    """Store the run of a controller."""
    given = store.layout
    store.commit(given.names.index(name), run_fields(run, wall_time, given.lengths["block"]), {})


def stored(folder) -> Path:
    """A store with all of `RUNS`."""
    store = begin(folder)
    for name, kind in RUNS.items():
        write(store, name, trajectory(kind))
    return folder


def empty(given: StoreLayout | None = None) -> xr.Dataset:
    """The results before any run."""
    with tempfile.TemporaryDirectory() as folder:
        begin(Path(folder), given)
        return open_results(folder).load()


def trajectory(kind: str, samples: int = 400) -> Trajectory:
    """A run in which the choke rises in a staircase to 40 %, then holds (`smooth`), swings by 2 % every ten
    samples (`hunting`), or creeps (`creeping`)."""
    k = np.arange(samples)
    reference = REFERENCE.build(WELL)
    setpoint = reference.sample(DT, samples)
    move = np.zeros(samples)
    move[:20:2] = 2.0  # 20 % in ten moves: the windowed mean passes 0.55 with the seventh
    position = 20 + np.cumsum(move)
    demand = position.copy()
    if kind == "hunting":
        position = position + 2.0 * ((k // 10) % 2) * (k >= 20)
        demand = demand + np.sin(k / 3) * (k >= 20)
    if kind == "creeping":
        demand = position = position + 0.001 * np.sin(k)
    lift = np.full(samples, 7500.0)
    mv_demand = np.stack([demand, lift], axis=1)
    cv = setpoint + np.stack([10 * np.cos(k / 5), np.cos(k / 5)], axis=1)
    cv[setpoint[:, 0] > 20_000] = (15_000.0, 250.0)
    return Trajectory(
        time=DT * k,
        setpoint=setpoint,
        cv=cv,
        mv_demand=mv_demand,
        mv=np.stack([position, lift], axis=1),
        move=np.diff(mv_demand, axis=0, prepend=[[20.0, 7500.0]]),
        bias=cv / 10,
        bias_raw=cv / 9,
        quality=np.zeros(cv.shape, dtype=int),
        off=np.zeros(cv.shape, dtype=bool),
        status=np.zeros(samples, dtype=int),
        fallback=np.zeros(samples, dtype=bool),
        objective=np.ones(samples),
        bound=np.ones(samples),
        gap=np.zeros(samples),
        nodes=np.ones(samples, dtype=int),
        solve_time=np.linspace(1e-3, 2e-3, samples),
        finished_by=np.ones(samples, dtype=int),
        cv_names=("gas_rate", "oil_rate"),
        mv_names=("choke", "gas_lift"),
        cv_units=("m3/h", "m3/h"),
        mv_units=("%", "m3/h"),
        dt=DT,
    )


RUNS = {"continuous-choke": "creeping", "step-choke": "hunting", "mixed-integer": "smooth"}
