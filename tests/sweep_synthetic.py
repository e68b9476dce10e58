"""Made-up stores of sweep studies: columns as a definition would give them, key figures and trajectories without solving."""

import numpy as np

from studies.store.fingerprint import content_hash
from studies.store.layout import Column, StoreLayout, Variable
from studies.store.writing import Store

DEADZONE = ("tuning.deadzone.gas_rate", "deadzone of the gas rate", "m3/h")
OIL_DEADZONE = ("tuning.deadzone.oil_rate", "deadzone of the oil rate", "m3/h")
WEIGHT = ("tuning.move_weight.choke", "move weight of the choke", "1/%^2")
CONTROLLER, REFERENCE = ("controller", "controller", ""), ("reference", "operating region", "")
ACTUATOR = ("actuator", "choke actuator", "")
CHOKE, LIFT = ("model.choke", "choke of the model", "%"), ("model.gas_lift", "gas lift of the model", "m3/h")
MODE, BLOCKS = ("blocking", "blocking mode", ""), ("blocks", "lengths of the blocks", "")
HORIZON, SEED = ("prediction_horizon", "prediction horizon", "samples"), ("seed", "seed of the noise", "1")
PRESSURE = ("plant_scale.reservoir_pressure", "reservoir pressure of the well, relative", "1")
LIMIT = ("tuning.mean_move_limit.choke", "limit of the mean move of the choke", "% per sample")
THESIS_BLOCKS = "1 1 1 1 2 2 4 4 8 8 8 16 16 32 32 64"

KEY_FIGURES = (
    Variable("travel", "sum of absolute moves, actual position", "mv_unit", ("mv",)),
    Variable("reversals", "moves against the move before", "1", ("mv",)),
    Variable("mean_absolute_deviation", "mean absolute deviation from the setpoint", "cv_unit", ("cv",)),
    Variable("closed_loop_cost", "tracking and move cost of the realised run", "1"),
    Variable("solve_time_median", "median time of one controller step", "s"),
    Variable("solve_time_p99", "99th percentile of the time of one controller step", "s"),
    Variable("complete", "1 if the run is complete", "1", (), "i1", 0),
)
TRAJECTORIES = (
    Variable("measurement", "measured CV", "cv_unit", ("time", "cv")),
    Variable("position", "MV after the actuator", "mv_unit", ("time", "mv")),
    Variable("setpoint", "setpoint", "cv_unit", ("time", "cv")),
)


def grid(*axes):
    """Every combination of lists of entries, the last axis fastest; an entry is one value, or one per key."""
    places = np.indices([len(axis) for axis in axes]).reshape(len(axes), -1).T
    rows = []
    for place in places:
        entries = [axis[i] for axis, i in zip(axes, place, strict=True)]
        rows.append([value for e in entries for value in (e if isinstance(e, tuple) else (e,))])
    return [list(column) for column in zip(*rows, strict=True)]


def numbers(count, seed=0, cvs=2):
    """Made-up key figures."""
    rng = np.random.default_rng(seed)
    return {
        "travel": np.stack([rng.uniform(100, 800, count), np.full(count, 5000.0)], axis=1),
        "reversals": np.stack([rng.integers(0, 90, count).astype(float), np.full(count, 7.0)], axis=1),
        "mean_absolute_deviation": rng.uniform(0.5, 2, (count, cvs)) * (1000.0, 5.0),
        "closed_loop_cost": rng.uniform(90, 110, count),
        "solve_time_median": rng.uniform(1e-3, 5e-3, count),
        "solve_time_p99": rng.uniform(5e-3, 2e-2, count),
        "complete": np.ones(count, dtype="i1"),
    }


def write(
    path, keys, values, figures, trajectories=None, definition=None, skip=(), chunk_size=8, provenance=None
):
    """A store with these columns and key figures; the chunks in `skip` are not computed."""
    count = len(values[0])
    columns = []
    for (key, label, unit), column in zip(keys, values, strict=True):
        columns.append(Column(key, label, unit, np.array(column, dtype=float if unit else object)))
    points = len(next(iter(trajectories.values()))[0]) if trajectories else 3
    layout = StoreLayout(
        name="made-up",
        title="Made-up study",
        study_hash="made-up",
        chunk_size=chunk_size,
        chunk_scenarios=tuple(np.arange(i, min(i + chunk_size, count)) for i in range(0, count, chunk_size)),
        scenario_hashes=tuple(content_hash(k) for k in range(count)),
        columns=tuple(columns),
        variables=KEY_FIGURES + (TRAJECTORIES if trajectories else ()),
        coords={
            "time": (100.0 * np.arange(points), "s", "time"),
            "cv": (["gas_rate", "oil_rate"], "", "controlled variable"),
            "cv_unit": (["m3/h", "m3/h"], "", "unit of the CV"),
            "mv": (["choke", "gas_lift"], "", "manipulated variable"),
            "mv_unit": (["%", "m3/h"], "", "unit of the MV"),
        },
        provenance={**(provenance or {}), **({"definition": definition} if definition is not None else {})},
    )
    fields = {**figures, **(trajectories or {})}
    with Store.begin(path, layout, lambda line: None) as store:
        for i, rows in enumerate(layout.chunk_scenarios):
            if i not in skip:
                store.commit(i, {name: v[rows] for name, v in fields.items()}, {"wall_time": 1.0})
    return path


def runs(count, points=60, seed=0):
    """Made-up trajectories around two setpoints."""
    rng = np.random.default_rng(seed)
    setpoint = np.where(np.arange(points)[:, None] < points // 2, (9640.0, 152.0), (5870.0, 100.6))
    spread = rng.normal(size=(count, 1, 2)) * (300.0, 3.0)
    lag = np.stack([np.convolve(np.pad(s, (8, 0), "edge"), np.ones(9) / 9, "valid") for s in setpoint.T], 1)
    measured = lag + spread + rng.normal(size=(count, points, 2)) * (60.0, 0.6)
    choke = np.round(20 + rng.normal(size=(count, 1)) * 3 + np.where(np.arange(points) < points // 2, 2, -9))
    position = np.stack([choke, np.full((count, points), 7500.0)], axis=2)
    return {
        "measurement": measured,
        "position": position,
        "setpoint": np.broadcast_to(setpoint, (count, points, 2)).copy(),
    }
