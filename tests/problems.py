"""Controller steps to solve: random small ones, constructed ones with known optima, and thesis-size ones.

Every function returns the content of a case file (a dictionary) and draws from the generator it is given, so
a seed names a case. `TWISTS` are the awkward situations: each changes a case in place. The oracles in
`tests.oracles.steps` are the judges; nothing here calls the library.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.oracles import steps as oracles

PUBLISHED = Path(__file__).resolve().parents[2] / "shared" / "data" / "single_well_step_response.json"
THESIS_BLOCKS = [1, 1, 1, 1, 2, 2, 4, 4, 8, 8, 8, 16, 16, 32, 32, 64]
TRAP = -2.000000465  # thesis 6.5: a move that a MIP solver calls integer


def second_order(rng, samples: int, fast: float = 0.5, slow: float = 4.0) -> np.ndarray:
    """A unit-gain step response of second order with one zero, sometimes inverse, at 1..samples."""
    t = np.arange(1, samples + 1)
    one, two = rng.uniform(fast, slow, 2)
    two += 0.1 + (abs(one - two) < 0.1)
    zero = rng.uniform(-1.0, 2.0) * max(one, two) * rng.integers(0, 2)
    a, b = (one - zero) / (one - two), (two - zero) / (two - one)
    return 1 - a * np.exp(-t / one) - b * np.exp(-t / two)


def small_case(
    rng,
    *,
    cvs: int = 2,
    mvs: int = 2,
    hp: int = 8,
    hu: int = 6,
    hw: int = 1,
    blocks: list[int] | None = None,
    blocking: str = "moves",
    integer: dict[int, float] | None = None,
    samples: int | None = None,
) -> dict:
    """A random case with every term: both soft weights, deadzone, CV limits and slacks, MV and move limits.

    Args:
        rng: random generator.
        cvs, mvs: how many.
        hp, hu, hw: horizons.
        blocks: block lengths; none for one block per sample.
        blocking: ``moves`` or ``inputs``.
        integer: step size by position of the MV; a move is at most one step. Default: MV 0 in steps of 2.
        samples: N; the prediction horizon if not given.
    """
    integer = {0: 2.0} if integer is None else integer
    samples = samples or hp
    cv_size = 10 ** rng.uniform(-1, 3, cvs)
    unit = np.array([integer.get(m, 10 ** rng.uniform(-1, 2.5)) for m in range(mvs)])
    gain = rng.choice([-1, 1], (cvs, mvs)) * rng.uniform(0.2, 1.5, (cvs, mvs))
    S = [
        [(gain[c, m] * cv_size[c] / unit[m] * second_order(rng, samples)).tolist() for m in range(mvs)]
        for c in range(cvs)
    ]
    start = cv_size * rng.uniform(-3, 10, cvs)
    j = np.arange(1, hp + 1)[:, None]
    free = start + cv_size * rng.normal(0, 1.5, cvs) * (1 - np.exp(-j / rng.uniform(1, 5, cvs)))
    setpoint = np.repeat((free[-1] + cv_size * rng.normal(0, 2.5, cvs))[None], hp, axis=0)
    if hp > 3 and rng.random() < 0.3:  # a setpoint change inside the horizon
        setpoint[rng.integers(1, hp) :] += cv_size * rng.normal(0, 2, cvs)
    room = rng.integers(0, 5, (2, mvs))  # moves to each MV limit
    now = np.array([integer.get(m, unit[m]) * rng.integers(-3, 20) for m in range(mvs)], dtype=float)
    names = [f"u{m}" for m in range(mvs)]
    return {
        "model": {
            "dt": 10.0,
            "cv": [f"y{c}" for c in range(cvs)],
            "mv": names,
            "coefficients": S,
        },
        "structure": {
            "prediction_horizon": hp,
            "control_horizon": hu,
            "first_penalised": hw,
            "blocks": list(blocks or [1] * hu),
            "blocking": blocking,
            "integer_step": {names[m]: step for m, step in integer.items()},
        },
        "tuning": {
            "cv_weight": (10 ** rng.uniform(-1, 1, cvs) / cv_size**2).tolist(),
            "move_weight": (10 ** rng.uniform(-1.5, 1, mvs) / unit**2).tolist(),
            "soft_quadratic": (10 ** rng.uniform(-1, 1, cvs) / cv_size**2).tolist(),
            "soft_linear": (10 ** rng.uniform(-1, 1, cvs) / cv_size).tolist(),
            "deadzone": (rng.uniform(0.1, 1.5, cvs) * cv_size).tolist(),
            "cv_low": (start - cv_size * rng.uniform(2, 15, cvs)).tolist(),
            "cv_high": (start + cv_size * rng.uniform(2, 15, cvs)).tolist(),
            "slack_weight": (10 ** rng.uniform(0, 2, cvs) / cv_size).tolist(),
            "mv_low": (now - unit * room[0]).tolist(),
            "mv_high": (now + unit * (room[1] + 1)).tolist(),
            "move_low": (-unit).tolist(),
            "move_high": unit.tolist(),
            "oscillation_rows": {names[m]: bool(rng.random() < 0.6) for m in integer},
        },
        "mv_now": now.tolist(),
        "last_move": [float(unit[m] * rng.integers(-1, 2)) for m in range(mvs)],
        "free_response": free.tolist(),
        "setpoint": setpoint.tolist(),
    }


SHAPES: dict[str, dict] = {
    "two by two": dict(blocks=[1, 1, 2, 2]),
    "two by two, inputs": dict(blocks=[1, 1, 2, 2], blocking="inputs"),
    "no blocking": dict(hu=5),
    "no blocking, inputs": dict(hu=5, blocking="inputs"),
    "long first block": dict(blocks=[3, 1, 2]),
    "long first block, inputs": dict(blocks=[3, 1, 2], blocking="inputs"),
    "one block": dict(blocks=[6]),
    "siso": dict(cvs=1, mvs=1, hu=5),
    "siso, inputs": dict(cvs=1, mvs=1, blocks=[1, 2, 1, 2], blocking="inputs"),
    "siso, one sample": dict(cvs=1, mvs=1, hp=1, hu=1),
    "one sample": dict(hp=1, hu=1),
    "three by two": dict(cvs=3, mvs=2, blocks=[1, 1, 2, 2]),
    "two by three": dict(cvs=2, mvs=3, blocks=[1, 2, 3]),
    "two integers": dict(blocks=[1, 2, 3], integer={0: 2.0, 1: 0.5}),
    "two integers of three": dict(mvs=3, blocks=[1, 2, 3], blocking="inputs", integer={2: 2.0, 0: 0.5}),
    "second MV integer": dict(blocks=[1, 1, 2, 2], integer={1: 0.5}),
    "late first penalty": dict(hp=10, hw=4, blocks=[1, 1, 2, 2]),
    "control beyond prediction": dict(hp=4, hu=8, blocks=[1, 1, 2, 4]),
    "control beyond prediction, inputs": dict(hp=4, hu=8, blocks=[1, 1, 2, 4], blocking="inputs"),
    "short model": dict(samples=3, blocks=[1, 1, 2, 2]),
    "long model": dict(samples=14, blocks=[1, 1, 2, 2]),
    "relaxed": dict(hp=12, hu=9, blocks=[1, 1, 1, 2, 4], integer={}),
    "relaxed, inputs": dict(hp=12, hu=9, blocks=[1, 1, 1, 2, 4], integer={}, blocking="inputs"),
    "relaxed three by three": dict(cvs=3, mvs=3, hp=12, hu=8, integer={}),
    "relaxed siso": dict(cvs=1, mvs=1, hp=15, hu=10, integer={}),
}


# --------------------------------------------------------------------------------------------------- twists

TWISTS: dict[str, Callable] = {}


def twist(function):
    """Register a twist under its own name."""
    TWISTS[function.__name__] = function
    return function


def _unit(case: dict, m: int) -> float:
    """The size of a move of MV m."""
    step = case["structure"]["integer_step"].get(case["model"]["mv"][m])
    limits = [case["tuning"][key][m] for key in ("move_low", "move_high")]
    return step or max([abs(x) for x in limits if x] or [1.0])


def _integer(case: dict) -> list[int]:
    return [m for m, name in enumerate(case["model"]["mv"]) if name in case["structure"]["integer_step"]]


def ideal_values(case, rng):
    """Of every MV, with an influence like that of the CVs; no twist, because other people's forms have no cost for them."""
    unit = np.array([_unit(case, m) for m in range(len(case["mv_now"]))])
    case["tuning"]["ideal"] = (case["mv_now"] + unit * rng.uniform(-4, 4, len(unit))).tolist()
    case["tuning"]["ideal_weight"] = (10 ** rng.uniform(-1.5, 0.5, len(unit)) / unit**2).tolist()


@twist
def continuous_mvs_without_limits(case, rng):
    for m in range(len(case["mv_now"])):
        if m not in _integer(case):
            for key in ("mv_low", "mv_high", "move_low", "move_high"):
                case["tuning"][key][m] = None


@twist
def no_move_limits(case, rng):
    """An integer MV is then bounded by its MV limits alone."""
    for m in range(len(case["mv_now"])):
        case["tuning"]["move_low"][m] = case["tuning"]["move_high"][m] = None


@twist
def no_mv_limits(case, rng):
    for m in range(len(case["mv_now"])):
        case["tuning"]["mv_low"][m] = case["tuning"]["mv_high"][m] = None


@twist
def no_cv_limits(case, rng):
    case["tuning"]["cv_low"] = [None] * len(case["model"]["cv"])
    case["tuning"]["cv_high"] = [None] * len(case["model"]["cv"])


@twist
def wide_integer_moves(case, rng):
    for m in _integer(case):
        unit = _unit(case, m)
        case["tuning"]["move_low"][m], case["tuning"]["move_high"][m] = -3 * unit, 3 * unit


@twist
def one_sided_integer_moves(case, rng):
    for m in _integer(case):
        case["tuning"]["move_low"][m] = 0.0 if rng.random() < 0.5 else -_unit(case, m)
        case["tuning"]["move_high"][m] = 2 * _unit(case, m)


@twist
def move_limits_between_steps(case, rng):
    for m in _integer(case):
        case["tuning"]["move_low"][m] = -1.3 * _unit(case, m)
        case["tuning"]["move_high"][m] = 1.7 * _unit(case, m)
        for key, share in (("mv_low", -0.3), ("mv_high", 0.6)):
            if case["tuning"][key][m] is not None:
                case["tuning"][key][m] += share * _unit(case, m)


@twist
def active_cv_limits(case, rng):
    """The free response is outside the limits, and the setpoint too: eps stays positive."""
    free, r = np.array(case["free_response"]), np.array(case["setpoint"])
    for c in range(free.shape[1]):
        spread = np.ptp(free[:, c]) + abs(r[-1, c] - free[-1, c]) + 1e-3
        if rng.random() < 0.5:
            case["tuning"]["cv_high"][c] = float(min(free[:, c].min(), r[:, c].min()) - 0.3 * spread)
            case["tuning"]["cv_low"][c] = None
        else:
            case["tuning"]["cv_low"][c] = float(max(free[:, c].max(), r[:, c].max()) + 0.3 * spread)
            case["tuning"]["cv_high"][c] = None


@twist
def cv_limits_between_response_and_setpoint(case, rng):
    """The limit holds the CV away from its setpoint."""
    free, r = np.array(case["free_response"]), np.array(case["setpoint"])
    for c in range(free.shape[1]):
        middle = float(free[-1, c] + rng.uniform(0.1, 0.9) * (r[-1, c] - free[-1, c]))
        if r[-1, c] > free[-1, c]:
            case["tuning"]["cv_high"][c], case["tuning"]["cv_low"][c] = middle, None
        else:
            case["tuning"]["cv_low"][c], case["tuning"]["cv_high"][c] = middle, None


@twist
def both_cv_limits_violated(case, rng):
    """A corridor so narrow that high and low slack are both paid."""
    free = np.array(case["free_response"])
    for c in range(free.shape[1]):
        middle = float(free[:, c].mean())
        case["tuning"]["cv_low"][c] = case["tuning"]["cv_high"][c] = middle


@twist
def costly_slack(case, rng):
    case["tuning"]["slack_weight"] = [1e3 * x for x in case["tuning"]["slack_weight"]]


@twist
def free_slack(case, rng):
    case["tuning"]["slack_weight"] = [0.0 for _ in case["tuning"]["slack_weight"]]


@twist
def one_cv_without_weight(case, rng):
    case["tuning"]["cv_weight"][rng.integers(len(case["model"]["cv"]))] = 0.0


@twist
def no_cv_weight(case, rng):
    case["tuning"]["cv_weight"] = [0.0 for _ in case["tuning"]["cv_weight"]]


@twist
def no_move_weight(case, rng):
    case["tuning"]["move_weight"] = [0.0 for _ in case["tuning"]["move_weight"]]


@twist
def one_mv_without_weight(case, rng):
    case["tuning"]["move_weight"][rng.integers(len(case["mv_now"]))] = 0.0


@twist
def without_soft_mpc(case, rng):
    for key in ("soft_quadratic", "soft_linear"):
        case["tuning"][key] = [0.0 for _ in case["tuning"][key]]


@twist
def soft_quadratic_only(case, rng):
    case["tuning"]["soft_linear"] = [0.0 for _ in case["tuning"]["soft_linear"]]


@twist
def soft_linear_only(case, rng):
    case["tuning"]["soft_quadratic"] = [0.0 for _ in case["tuning"]["soft_quadratic"]]


@twist
def heavy_soft_linear(case, rng):
    """Many samples sit exactly on the edge of the deadzone."""
    case["tuning"]["soft_linear"] = [30.0 * x for x in case["tuning"]["soft_linear"]]


@twist
def no_deadzone(case, rng):
    case["tuning"]["deadzone"] = [0.0 for _ in case["tuning"]["deadzone"]]


@twist
def soft_weights_alone(case, rng):
    """Neither tracking nor moves cost anything: flat inside the deadzone."""
    for twist_name in ("no_cv_weight", "no_move_weight"):
        TWISTS[twist_name](case, rng)


@twist
def no_cost_at_all(case, rng):
    for twist_name in ("no_cv_weight", "no_move_weight", "without_soft_mpc", "free_slack"):
        TWISTS[twist_name](case, rng)


@twist
def heavy_move_weight(case, rng):
    case["tuning"]["move_weight"] = [1e3 * x for x in case["tuning"]["move_weight"]]


@twist
def light_move_weight(case, rng):
    case["tuning"]["move_weight"] = [1e-4 * x for x in case["tuning"]["move_weight"]]


@twist
def at_setpoint(case, rng):
    case["setpoint"] = copy.deepcopy(case["free_response"])


@twist
def half_a_step_away(case, rng):
    """One step and no step track equally well: a step ends as far beyond the setpoint as none before it."""
    m = (_integer(case) or [0])[0]
    S = np.array(case["model"]["coefficients"])[:, m, -1] * _unit(case, m)
    case["setpoint"] = (np.array(case["free_response"]) + S / 2).tolist()


@twist
def twin_mvs(case, rng):
    """Two MVs with the same effect, limits and cost: plans come in equally good pairs."""
    if len(case["mv_now"]) < 2 or len(_integer(case)) == 1:
        return
    for row in case["model"]["coefficients"]:
        row[1] = list(row[0])
    for key in ("move_weight", "mv_low", "mv_high", "move_low", "move_high"):
        case["tuning"][key][1] = case["tuning"][key][0]
    case["mv_now"][1], case["last_move"][1] = case["mv_now"][0], case["last_move"][0]
    names = case["model"]["mv"]
    for table in (case["structure"]["integer_step"], case["tuning"]["oscillation_rows"]):
        if names[0] in table:
            table[names[1]] = table[names[0]]


@twist
def gainless_mv(case, rng):
    """An MV that moves nothing."""
    m = rng.integers(len(case["mv_now"]))
    for row in case["model"]["coefficients"]:
        row[m] = [0.0] * len(row[m])


@twist
def impossible_start(case, rng):
    """Previous moves outside every limit and between steps."""
    blocks, mvs = max(map(len, oracles.read(case).lists)), len(case["mv_now"])
    units = np.array([_unit(case, m) for m in range(mvs)])
    case["previous_moves"] = (units * rng.normal(0, 4, (blocks, mvs))).tolist()


@twist
def plausible_start(case, rng):
    blocks, mvs = max(map(len, oracles.read(case).lists)), len(case["mv_now"])
    units = np.array([_unit(case, m) for m in range(mvs)])
    case["previous_moves"] = (units * rng.integers(-1, 2, (blocks, mvs))).tolist()


@twist
def mv_held_by_limits(case, rng):
    """One MV cannot move: both MV limits are where it is."""
    m = rng.integers(len(case["mv_now"]))
    case["tuning"]["mv_low"][m] = case["tuning"]["mv_high"][m] = case["mv_now"][m]


@twist
def mv_held_by_move_limits(case, rng):
    m = rng.integers(len(case["mv_now"]))
    case["tuning"]["move_low"][m] = case["tuning"]["move_high"][m] = 0.0


@twist
def on_the_low_limit_with_drift(case, rng):
    for m in range(len(case["mv_now"])):
        case["tuning"]["mv_low"][m] = case["mv_now"][m]
        case["mv_now"][m] += float(rng.choice([-1e-10, 0.0, 1e-10]))


@twist
def on_the_high_limit_with_drift(case, rng):
    for m in range(len(case["mv_now"])):
        case["tuning"]["mv_high"][m] = case["mv_now"][m]
        case["mv_now"][m] += float(rng.choice([-1e-10, 0.0, 1e-10]))


@twist
def whole_steps_to_the_limit_with_drift(case, rng):
    """The last step to a limit may not be lost to a drift of 1e-10."""
    for m in _integer(case):
        case["mv_now"][m] += float(rng.choice([-1e-10, 1e-10]))


@twist
def forced_moves(case, rng):
    """The MV must climb at every sample; the limit is far enough."""
    m = rng.integers(len(case["mv_now"]))
    hu, unit = case["structure"]["control_horizon"], _unit(case, m)
    case["tuning"]["move_low"][m] = unit if m in _integer(case) else 0.4 * unit
    case["tuning"]["move_high"][m] = 2 * unit
    case["tuning"]["mv_high"][m] = case["mv_now"][m] + unit * (hu + 2)
    case["last_move"][m] = unit


@twist
def forced_moves_beyond_the_limit(case, rng):
    """Nothing meets these limits."""
    m = rng.integers(len(case["mv_now"]))
    hu, unit = case["structure"]["control_horizon"], _unit(case, m)
    case["tuning"]["move_low"][m], case["tuning"]["move_high"][m] = unit, 2 * unit
    case["tuning"]["mv_high"][m] = case["mv_now"][m] + unit * (hu - 0.5)
    case["tuning"]["mv_low"][m] = min(case["mv_now"][m], case["tuning"]["mv_low"][m] or -1e9)


@twist
def no_whole_step_between_move_limits(case, rng):
    """Continuous moves would exist, whole steps do not."""
    for m in _integer(case)[:1]:
        unit = _unit(case, m)
        case["tuning"]["move_low"][m], case["tuning"]["move_high"][m] = 0.2 * unit, 0.8 * unit
        case["tuning"]["mv_high"][m] = case["mv_now"][m] + 20 * unit


@twist
def rounding_trap(case, rng):
    """The past move is a whole step up to 1e-7, and the MV sits on the limit it came to (thesis 6.5)."""
    names = case["model"]["mv"]
    for m in _integer(case):
        unit = case["structure"]["integer_step"][names[m]]
        case["last_move"][m] = TRAP / 2 * unit
        case["tuning"]["oscillation_rows"][names[m]] = True
        case["tuning"]["mv_low"][m] = case["mv_now"][m]


@twist
def just_reversed(case, rng):
    for m in _integer(case):
        name = case["model"]["mv"][m]
        case["tuning"]["oscillation_rows"][name] = True
        case["last_move"][m] = float(rng.choice([-1, 1])) * _unit(case, m)


@twist
def last_move_of_many_steps(case, rng):
    """Unreachable with oscillation rows and one step per sample."""
    for m in _integer(case)[:1]:
        case["last_move"][m] = float(rng.choice([-4, 2, 3])) * _unit(case, m)


@twist
def far_from_zero(case, rng):
    """CV and MV values a million sizes away from zero cost digits only if differences are taken late."""
    for key in ("free_response", "setpoint"):
        case[key] = (np.array(case[key]) + 1e5).tolist()
    for key in ("cv_low", "cv_high"):
        case["tuning"][key] = [None if x is None else x + 1e5 for x in case["tuning"][key]]


@twist
def setpoint_out_of_reach(case, rng):
    size = np.ptp(np.array(case["setpoint"]) - np.array(case["free_response"]), axis=0) + 1.0
    case["setpoint"] = (np.array(case["setpoint"]) + 20 * size * rng.choice([-1, 1])).tolist()


def random_case(rng, *, most_plans: int = 1500, twists: int | None = None) -> tuple[dict, str]:
    """A random shape with up to three twists, small enough for brute force, and a line that tells which."""
    while True:
        shape = rng.choice(list(SHAPES))
        case = small_case(rng, **SHAPES[shape])
        chosen = rng.choice(list(TWISTS), rng.integers(0, 4) if twists is None else twists, replace=False)
        for name in chosen:
            TWISTS[name](case, rng)
        if _consistent(case) and plan_count(case, most_plans) <= most_plans:
            return case, f"{shape}: {', '.join(chosen) or 'plain'}"


def _consistent(case: dict) -> bool:
    """Whether twists left the case valid: no crossed limits, start inside, integer moves bounded."""
    n = oracles.read(case)
    ordered = (n.ylo <= n.yhi).all() and (n.ulo <= n.uhi).all() and (n.dlo <= n.dhi).all()
    inside = (n.u0 >= n.ulo - 1e-9).all() and (n.u0 <= n.uhi + 1e-9).all()
    bounded = all(
        np.isfinite([n.dlo[m], n.dhi[m]]).all() or np.isfinite([n.ulo[m], n.uhi[m]]).all()
        for m in range(n.mvs)
        if n.step[m]
    )
    return bool(ordered and inside and bounded)


def plan_count(case: dict, most: int = 100_000) -> float:
    """How many integer plans meet the hard constraints; infinite for more than `most`."""
    count = 1
    for m in _integer(case):
        try:
            count *= len(oracles.integer_plans(case, m, most=most))
        except OverflowError:
            return math.inf
    return count


# ------------------------------------------------------------------------------- constructed known solutions


def dynamic_matrix(case: dict) -> np.ndarray:
    """The effect of a unit move of every block on the penalised CVs, "horizon cv block mv"."""
    n = oracles.read(case)
    blank = np.zeros((len(n.blocks), n.mvs))
    base, columns = oracles.predict(case, blank), []
    for b, m in np.ndindex(blank.shape):
        unit = blank.copy()
        unit[b, m] = 1.0
        columns.append((oracles.predict(case, unit) - base)[n.hw - 1 :])
    return np.stack(columns, axis=-1).reshape(*columns[0].shape, *blank.shape)


def random_plan(case: dict, rng) -> np.ndarray:
    """A plan within the limits, whole steps for integer MVs: moves that would leave a limit are not made."""
    n = oracles.read(case)
    plan = np.zeros((len(n.blocks), n.mvs))
    for b, m in np.ndindex(plan.shape):
        if n.step[m]:
            plan[b, m] = rng.integers(-1, 2) * n.step[m]
        else:
            plan[b, m] = rng.uniform(max(n.dlo[m], -1e3), min(n.dhi[m], 1e3))
        if oracles.violation(case, plan) > 0:
            plan[b, m] = 0.0
    return plan


def reachable_case(rng, **shape) -> tuple[dict, np.ndarray]:
    """A case whose setpoint is the response to a known plan, with P = 0: that plan costs nothing."""
    case = small_case(rng, **shape)
    for name in ("no_move_weight", "no_cv_limits"):
        TWISTS[name](case, rng)
    case["last_move"] = [0.0] * len(case["mv_now"])
    plan = random_plan(case, rng)
    case["setpoint"] = oracles.predict(case, plan).tolist()
    return case, plan


def stationary_case(rng, *, slack: bool = True, **shape) -> tuple[dict, np.ndarray]:
    """A case built around a plan that meets the optimality conditions, with active limits and a positive eps.

    The plan and multipliers of the limits it touches are drawn; the setpoint is then placed so that the
    gradient vanishes: with w = d cost/dy, Theta'w + 2 P x + A'mu = 0, and the deviation e follows from w
    through the inverse of the (monotone) slope of the deadzone penalty. Where the slope jumps over w, e is
    exactly the deadzone.
    The plan is whole steps for integer MVs, so it is the optimum of the mixed-integer problem, too.
    """
    case = small_case(rng, **shape)
    TWISTS["no_cv_limits"](case, rng)
    case["last_move"] = [0.0] * len(case["mv_now"])
    n = oracles.read(case)
    plan = random_plan(case, rng)
    counts = np.array(n.blocks if n.blocking == "moves" else [1] * len(n.blocks), dtype=float)
    gradient = 2 * counts[:, None] * n.P * plan
    for m in range(n.mvs):
        if not n.step[m]:
            b = rng.integers(len(n.blocks))  # this move is on its limit
            limit, sign = ("move_high", 1.0) if plan[b, m] >= 0 else ("move_low", -1.0)
            if (sign * plan[:, m] <= sign * plan[b, m]).all() and plan[b, m] != 0:
                case["tuning"][limit][m] = float(plan[b, m])
                gradient[b, m] += sign * rng.uniform(0, 3) / abs(plan[b, m])
        end = np.cumsum(oracles.sample_moves(case, plan)[:, m])
        if end.max() > 0:  # the highest position is on the MV limit
            k = int(end.argmax())
            case["tuning"]["mv_high"][m] = float(n.u0[m] + end[k])
            weight = np.zeros(len(n.blocks))
            for b, start in enumerate(n.starts):
                length = n.blocks[b] if n.blocking == "moves" else 1
                weight[b] = min(max(k + 1 - start, 0), length)
            gradient[:, m] += weight * rng.uniform(0, 2) / end[k]
    theta = dynamic_matrix(case)
    flat = theta.reshape(-1, plan.size)
    w, *_ = np.linalg.lstsq(flat.T, -gradient.ravel(), rcond=None)
    if np.abs(flat.T @ w + gradient.ravel()).max() > 1e-10 * max(1.0, np.abs(gradient).max()):
        raise ValueError("some block moves no penalised CV: no setpoint makes this plan stationary")
    w = w.reshape(theta.shape[:2])
    y = oracles.predict(case, plan)[n.hw - 1 :]
    if slack:
        c = rng.integers(n.cvs)
        j = int(y[:, c].argmax())
        size = np.abs(w[:, c]).max() + n.Q[c] * n.c[c]
        case["tuning"]["cv_high"][c] = float(y[j, c] - rng.uniform(0.1, 1) * n.c[c])
        case["tuning"]["slack_weight"][c] = float(size)
        w[j, c] -= size
    inner, jump = 2 * n.Q * n.c, n.S1
    outside = np.maximum(0.0, np.abs(w) - inner - jump) / (2 * (n.Q + n.S2))
    e = np.sign(w) * np.where(np.abs(w) <= inner, np.abs(w) / (2 * n.Q), n.c + outside)
    setpoint = np.array(case["setpoint"])
    setpoint[n.hw - 1 :] = y - e
    case["setpoint"] = setpoint.tolist()
    return case, plan


# ----------------------------------------------------------------------------------------------- thesis size


def published_response() -> np.ndarray | None:
    """S(1)..S(N) "cv mv n", or None without the data file; its index 0 is the step instant."""
    if not PUBLISHED.exists():
        return None
    return np.array(json.loads(PUBLISHED.read_text())["coefficients"])[:, :, 1:]


def synthetic_response(samples: int = 250) -> np.ndarray:
    """Second-order responses of the size of a gas-lifted well's, "cv mv n", dt = 10 s."""
    t = 10.0 * np.arange(1, samples + 1)

    def respond(gain, one, two, zero):
        a, b = (one - zero) / (one - two), (two - zero) / (two - one)
        return gain * (1 - a * np.exp(-t / one) - b * np.exp(-t / two))

    return np.array(
        [
            [respond(70.0, 170, 45, 240), respond(1.0, 125, 55, 0)],
            [respond(0.7, 250, 65, 310), respond(0.008, 390, 110, -140)],
        ]
    )


SITUATIONS = ("near", "step", "saturated", "out of reach")


def thesis_case(
    rng,
    situation: str = "near",
    *,
    blocking: str = "moves",
    response: np.ndarray | None = None,
    choke_weight: float = 250.0,
) -> dict:
    """A case of the thesis's size and tuning (Table 1), after a random past of 250 samples.

    Args:
        rng: random generator.
        situation: ``near`` the setpoint, after a setpoint ``step``, ``saturated`` inputs, ``out of reach``.
        blocking: ``moves`` or ``inputs``.
        response: "cv mv n"; synthetic if not given.
        choke_weight: [1/%^2].
    """
    S = synthetic_response() if response is None else response
    past, hp = 250, 250
    moves = np.zeros((past, 2))
    u = np.array([50.0, 7500.0])
    start = u + np.array([2.0 * rng.integers(-15, 16), rng.uniform(-2000, 1500)])
    if situation == "saturated":
        start = np.array([96.0, 9800.0]) if rng.random() < 0.6 else np.array([6.0, 5100.0])
    u = start.copy()
    for k in range(past):
        wish = [2.0 * rng.choice([-1, 0, 1], p=[0.06, 0.88, 0.06]), rng.normal(0, 60) * (rng.random() < 0.3)]
        new = np.clip(u + wish, [0.0, 0.0], [100.0, 10000.0])
        moves[k], u = new - u, new
    N = S.shape[2]
    level = np.array([11013.0, 185.0]) + S[:, :, -1] @ (start - [50.0, 7500.0])
    free = np.zeros((hp, 2))
    for j in range(1, hp + 1):
        age = np.arange(past, 0, -1)  # of the past moves, in samples, seen from now
        index = np.minimum(age + j, N) - 1
        free[j - 1] = level + np.einsum("cmk,km->c", S[:, :, index], moves)
    free += [rng.normal(0, 150), rng.normal(0, 2)]
    if situation == "near":
        setpoint = free[-1] + rng.normal(0, 0.7, 2) * [1000, 5]
    elif situation == "step":
        target = np.array([rng.uniform(5, 95), rng.uniform(4000, 9900)])
        setpoint = free[-1] + S[:, :, -1] @ (target - u)
    elif situation == "saturated":
        setpoint = np.array([16500.0, 230.0]) if start[0] > 50 else np.array([3500.0, 60.0])
    else:
        setpoint = free[-1] + np.array([-3000.0, 15.0]) * rng.uniform(0.5, 2) * rng.choice([-1, 1])
    return {
        "model": {
            "dt": 10.0,
            "cv": ["gas_rate", "oil_rate"],
            "mv": ["choke", "gas_lift"],
            "coefficients": S.tolist(),
        },
        "structure": {
            "prediction_horizon": hp,
            "control_horizon": 200,
            "first_penalised": 1,
            "blocks": list(THESIS_BLOCKS),
            "blocking": blocking,
            "integer_step": {"choke": 2.0},
        },
        "tuning": {
            "cv_weight": [1e-4, 0.1],
            "move_weight": [choke_weight, 0.2],
            "soft_quadratic": [1e-4, 0.1],
            "soft_linear": [1e-4, 0.1],
            "deadzone": [1000.0, 5.0],
            "cv_low": [0.0, 0.0],
            "cv_high": [20000.0, 400.0],
            "slack_weight": [1000.0, 1000.0],
            "mv_low": [0.0, 0.0],
            "mv_high": [100.0, 10000.0],
            "move_low": [-2.0, -200.0],
            "move_high": [2.0, 200.0],
            "oscillation_rows": {"choke": True},
        },
        "mv_now": u.tolist(),
        "last_move": moves[-1].tolist(),
        "free_response": free.tolist(),
        "setpoint": np.repeat(setpoint[None], hp, axis=0).tolist(),
    }
