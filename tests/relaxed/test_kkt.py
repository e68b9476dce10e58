"""The independent judge of relaxed problems: near zero at every kind of solution, large where something is wrong."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc import status
from jaxmpc.relaxed.problem import evaluate
from jaxmpc.relaxed.solve import solve_relaxed
from tests import problems
from tests.oracles.foreign import foreign_solution, solution_of
from tests.oracles.kkt import KktResiduals, kkt_residuals
from tests.posed import pose_case, solve_one

FIELDS = tuple(field.name for field in dataclasses.fields(KktResiduals))
SHAPES = {
    "moves": dict(hp=12, blocks=[1, 1, 2, 2], integer={}),
    "inputs": dict(hp=12, blocks=[1, 1, 2, 2], integer={}, blocking="inputs"),
    "envelope": dict(hp=10, blocks=[1, 1, 2, 2], integer={0: 2.0}),
}
SHAPELESS = (  # twists that change numbers, never a shape, and leave a feasible relaxed problem
    "continuous_mvs_without_limits",
    "no_move_limits",
    "no_mv_limits",
    "no_cv_limits",
    "active_cv_limits",
    "both_cv_limits_violated",
    "cv_limits_between_response_and_setpoint",
    "costly_slack",
    "free_slack",
    "one_cv_without_weight",
    "no_cv_weight",
    "no_move_weight",
    "one_mv_without_weight",
    "without_soft_mpc",
    "soft_quadratic_only",
    "soft_linear_only",
    "heavy_soft_linear",
    "no_deadzone",
    "soft_weights_alone",
    "heavy_move_weight",
    "light_move_weight",
    "at_setpoint",
    "mv_held_by_limits",
    "mv_held_by_move_limits",
    "on_the_low_limit_with_drift",
    "on_the_high_limit_with_drift",
    "forced_moves",
    "setpoint_out_of_reach",
)


def relaxed(body: dict, envelope: int | None = None):
    """Constant part, hard rows and instance of a case."""
    levels = int(bool(body["structure"]["integer_step"])) if envelope is None else envelope
    posed = pose_case(body, envelope=levels, summed=False)
    return posed.qp, posed.rows, posed.instance


def stacked(bodies):
    """Relaxed problems of one shape as a batch: constant parts, hard rows, instances."""
    parts = [relaxed(body) for body in bodies]
    stack = lambda k: jax.tree.map(lambda *leaves: jnp.stack(leaves), *(part[k] for part in parts))  # noqa: E731
    return stack(0), parts[0][1], stack(2)


@eqx.filter_jit
def solve_and_judge(qps, rows, instances):
    def one(qp, instance):
        solution = solve_relaxed(qp, instance, instance.lower, instance.upper)
        return solution, kkt_residuals(qp, rows, instance, solution)

    return eqx.filter_vmap(one)(qps, instances)


_residuals = jax.jit(kkt_residuals)


def judge(qp, rows, instance, solution, **limits) -> dict[str, float]:
    """The five residuals by name."""
    found = _residuals(qp, rows, instance, solution, **limits)
    return {name: float(getattr(found, name)) for name in FIELDS}


# ------------------------------------------------------------------------------------------------ solved ones


@pytest.mark.parametrize("shape", SHAPES)
def test_solved_problems_with_known_optima_have_small_residuals(shape):
    cases = [problems.stationary_case(np.random.default_rng(seed), **SHAPES[shape]) for seed in range(24)]
    qps, rows, instances = stacked([body for body, _ in cases])
    solution, residuals = solve_and_judge(qps, rows, instances)
    assert (np.asarray(solution.status) == status.OPTIMAL).all()
    assert np.asarray(residuals.worst).max() <= 1e-6
    scale = np.asarray(qps.scale)
    for lane, (_, plan) in enumerate(cases):
        known = jnp.asarray(plan.T.ravel() / scale[lane])  # four blocks are a rung: nothing is padded
        qp, instance = jax.tree.map(lambda leaf, k=lane: leaf[k], (qps, instances))
        value = float(evaluate(qp, instance, known))
        assert float(solution.objective[lane]) == pytest.approx(value, rel=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_solved_problems_with_every_twist_have_small_residuals(shape):
    """Infinite limits, weights of zero, active output limits, moves that cannot move."""
    rng = np.random.default_rng(5)
    bodies, names = [], []
    for name in (*SHAPELESS, *SHAPELESS):
        body = problems.small_case(rng, **SHAPES[shape])
        problems.TWISTS[name](body, rng)
        if len(bodies) >= len(SHAPELESS):
            problems.ideal_values(body, np.random.default_rng(len(bodies)))
        bodies.append(body)
        names.append(name)
    qps, rows, instances = stacked(bodies)
    solution, residuals = solve_and_judge(qps, rows, instances)
    solved = np.asarray(solution.status) == status.OPTIMAL
    assert solved.mean() > 0.9  # an integer MV without limits, or one forced where oscillation rows forbid
    for name in FIELDS:
        worst = np.where(solved, np.asarray(getattr(residuals, name)), 0.0)
        assert worst.max() <= 1e-6, (name, names[int(worst.argmax())], worst.max())


@pytest.mark.slow
def test_a_batch_of_residuals_is_each_alone():
    bodies = [problems.small_case(np.random.default_rng(seed), **SHAPES["moves"]) for seed in range(4)]
    qps, rows, instances = stacked(bodies)
    solution, together = solve_and_judge(qps, rows, instances)
    moved = eqx.tree_at(lambda s: s.x, solution, solution.x + 0.01)
    together = eqx.filter_vmap(lambda q, i, s: kkt_residuals(q, rows, i, s))(qps, instances, moved)
    for k in range(4):
        alone = kkt_residuals(_lane(qps, k), rows, _lane(instances, k), _lane(moved, k))
        for name in FIELDS:
            np.testing.assert_allclose(
                getattr(together, name)[k], getattr(alone, name), rtol=1e-9, atol=1e-12
            )


def _lane(tree, k):
    return jax.tree.map(lambda leaf: leaf[k], tree)


# ---------------------------------------------------------------------------------- a solution without a solver

# what some moves of the constructed solution are; the last two have an envelope, and one of them is at its kink
FIXED, AT_UPPER, FREE, AT_KINK, SLOPED = 0, 1, 2, 5, 6


@pytest.fixture(scope="module")
def constructed():
    """A problem built around moves and prices that are drawn, so that they solve it exactly; all kinds of terms."""
    rng = np.random.default_rng(11)
    qp, rows, instance = relaxed(problems.small_case(rng, **SHAPES["moves"]), envelope=2)
    theta, n, predictions = np.asarray(qp.theta), qp.theta.shape[1], len(qp.theta)
    horizon = predictions // 2
    bend, jump, c = (np.asarray(v) for v in (qp.soft_quadratic, qp.soft_linear, qp.deadzone))
    side = rng.choice([-1.0, 1.0], predictions)
    kind = rng.integers(0, 3, predictions)  # inside, on the edge, outside of the deadzone
    beyond = np.where(kind == 2, rng.uniform(0.1, 1.0, predictions) * c, 0.0)
    t = side * np.where(kind == 0, 0.5 * c, c + beyond)
    share = rng.uniform(0.1, 0.9, predictions)
    row_price = side * np.select([kind == 0, kind == 1], [0.0, share * jump], 2 * bend * beyond + jump)
    # high limit of CV 0: violated equally at two samples, which share rho; low limit of CV 1: touched, unpaid in full
    rho = np.asarray(qp.slack_weight)
    high, low = np.full(predictions, np.inf), np.full(predictions, -np.inf)
    high[:horizon] = t[:horizon].max() + c[0]
    high[[2, 5]] = t[[2, 5]] - 0.3 * c[0]
    low[horizon:] = t[horizon:].min() - c[horizon]
    low[horizon + 3] = t[horizon + 3]
    limit_price = np.zeros(predictions)
    limit_price[2], limit_price[5] = 0.4 * rho[0], 0.6 * rho[0]
    limit_price[horizon + 3] = -0.5 * rho[1]
    # hard rows: the second is at its upper limit
    hard_price = np.zeros(len(rows))
    hard_price[1] = 0.7
    force = (2 * np.asarray(qp.quadratic) * t + row_price + limit_price) @ theta + hard_price @ rows
    move_weight = rng.uniform(0.5, 2.0, n) * np.abs(force).max()
    x = -force / (2 * move_weight)  # a free move balances the other forces
    steep, envelope_price = np.zeros((2, n)), np.zeros((2, n))
    x[AT_KINK], steep[0, AT_KINK], envelope_price[0, AT_KINK] = (
        0.0,
        2.0 * abs(force[AT_KINK]),
        -force[AT_KINK],
    )
    # half of the force is taken by the slope, which the second level leaves alone: the move is less than one step
    x[SLOPED], steep[:, SLOPED] = 0.5 * x[SLOPED], 0.5 * abs(force[SLOPED])
    envelope_price[0, SLOPED] = -0.5 * force[SLOPED]
    lower, upper, low_price, high_price = x - 1.0, x + 1.0, np.zeros(n), np.zeros(n)
    lower[FREE], upper[FREE] = -np.inf, np.inf
    for j in (FIXED, AT_UPPER):
        x[j] += -0.2 * abs(x[j]) - 0.05  # pushed back by its limit
        upper[j], lower[j] = x[j], (x[j] if j == FIXED else -np.inf)
        high_price[j] = -(force[j] + 2 * move_weight[j] * x[j])
    w = rows @ x
    row_low, row_high = w - 1.0, w + 1.0
    row_high[1], row_low[2], row_high[3] = w[1], -np.inf, np.inf
    weights = jnp.asarray(move_weight), jnp.asarray(steep)
    qp = eqx.tree_at(lambda q: (q.move_weight, q.steep), qp, weights)
    values = (t - theta @ x, high, low, lower, upper, row_low, row_high)
    instance = eqx.tree_at(
        lambda i: (i.offset, i.limit_high, i.limit_low, i.lower, i.upper, i.row_low, i.row_high),
        instance,
        tuple(jnp.asarray(v) for v in values),
    )
    prices = row_price, envelope_price, limit_price, low_price, high_price, np.zeros(len(rows)), hard_price
    return qp, rows, instance, solution_of(x, *prices)


def test_a_constructed_solution_has_no_residual_but_rounding(constructed):
    residuals = judge(*constructed)
    assert max(residuals.values()) < 1e-12, residuals


def add(name: str, index, amount: float):
    """Change one number of a solution."""
    return lambda solution: eqx.tree_at(
        lambda s: getattr(s, name), solution, getattr(solution, name).at[index].add(amount)
    )


def both(*changes):
    """One change after the other."""

    def apply(solution):
        for change in changes:
            solution = change(solution)
        return solution

    return apply


PERTURBED = {
    # a pair of opposite prices leaves the gradient alone, so that one condition is broken at a time
    "negative price of a limit": (
        both(add("lower_price", FIXED, -0.5), add("upper_price", FIXED, -0.5)),
        {"dual"},
    ),
    "price of an infinite limit": (
        both(add("lower_price", AT_UPPER, 0.5), add("upper_price", AT_UPPER, 0.5)),
        {"dual", "gap"},
    ),
    "price of a limit that is not touched": (
        both(add("lower_price", 4, 0.5), add("upper_price", 4, 0.5)),
        {"complementarity", "gap"},
    ),
    "price of a limit that does not balance": (add("upper_price", AT_UPPER, 0.5), {"stationarity", "gap"}),
    "price of a hard row that is not touched": (
        both(add("row_low_price", 0, 0.5), add("row_high_price", 0, 0.5)),
        {"complementarity", "gap"},
    ),
    "price of a hard row that has no limit": (
        both(add("row_low_price", 2, 0.5), add("row_high_price", 2, 0.5)),
        {"dual", "complementarity", "gap"},
    ),
    "negative price of a hard row": (
        add("row_low_price", 3, -0.5),
        {"stationarity", "dual", "complementarity", "gap"},
    ),
    "move beyond its limit": (
        add("x", AT_UPPER, 0.1),
        {"stationarity", "primal", "complementarity", "gap"},
    ),
}


@pytest.mark.parametrize("name", PERTURBED)
def test_a_perturbation_makes_exactly_the_expected_residuals_grow(constructed, name):
    qp, rows, instance, solution = constructed
    change, expected = PERTURBED[name]
    residuals = judge(qp, rows, instance, change(solution))
    assert {key for key, value in residuals.items() if value > 1e-5} == expected, residuals
    assert all(value < 1e-12 for key, value in residuals.items() if key not in expected), residuals


def test_a_row_price_outside_the_subdifferential_is_seen(constructed):
    qp, rows, instance, solution = constructed
    t = np.asarray(qp.theta @ solution.x + instance.offset)
    inside = int(np.argmax(np.abs(t) < 0.9 * np.asarray(qp.deadzone)))
    priced = add("row_price", inside, 0.1 * float(qp.soft_linear[inside]))(solution)
    residuals = judge(qp, rows, instance, priced)
    assert residuals["complementarity"] > 1e-6
    assert residuals["dual"] == 0.0
    # with S = 0 no row price beyond s is possible at all, wherever t is
    flat = eqx.tree_at(lambda q: q.soft_quadratic, qp, qp.soft_quadratic * 0.0)
    edge = add("row_price", inside, 1.5 * float(qp.soft_linear[inside]))(solution)
    assert judge(flat, rows, instance, edge)["dual"] > 1e-6


def test_an_envelope_price_outside_the_subdifferential_is_seen(constructed):
    qp, rows, instance, solution = constructed
    kink, slope = float(qp.steep[0, AT_KINK]), float(qp.steep[0, SLOPED])
    greedy = judge(qp, rows, instance, add("envelope_price", (0, AT_KINK), 3.0 * kink)(solution))
    assert greedy["dual"] > 1e-5
    # at the kink any price up to the slope is right but for the gradient
    shifted = judge(qp, rows, instance, add("envelope_price", (0, AT_KINK), 0.2 * kink)(solution))
    assert shifted["dual"] == 0.0
    assert shifted["complementarity"] < 1e-12
    assert shifted["stationarity"] > 1e-5
    toward = float(jnp.sign(solution.envelope_price[0, SLOPED]))
    for level, amount in ((0, -0.5), (1, 0.5)):  # a slope that is not paid, and one that is not reached
        wrong = judge(
            qp, rows, instance, add("envelope_price", (level, SLOPED), amount * toward * slope)(solution)
        )
        assert wrong["dual"] == 0.0
        assert wrong["complementarity"] > 1e-6


def test_limit_prices_beyond_rho_or_of_no_limit_are_seen(constructed):
    qp, rows, instance, solution = constructed
    rho, horizon = np.asarray(qp.slack_weight), len(qp.theta) // 2
    greedy = add("limit_price", 2, 0.3 * rho[0])(solution)
    assert judge(qp, rows, instance, greedy)["dual"] > 1e-5
    shifted = both(add("limit_price", 2, -0.3 * rho[0]), add("limit_price", 5, 0.3 * rho[0]))(solution)
    moved = judge(qp, rows, instance, shifted)  # another split of rho is right but for the gradient
    assert moved["dual"] == 0.0
    assert moved["complementarity"] < 1e-12
    assert moved["stationarity"] > 1e-5
    missing = add("limit_price", horizon + 5, 0.1 * rho[1])(solution)  # CV 1 has no high limit
    assert judge(qp, rows, instance, missing)["dual"] > 1e-5
    unlimited = dataclasses.replace(qp, has_limits=False)
    assert judge(unlimited, rows, instance, solution)["dual"] > 1e-5
    unpaid = eqx.tree_at(lambda s: s.limit_price, solution, solution.limit_price * 0.0)
    assert judge(qp, rows, instance, unpaid)["complementarity"] > 1e-5


def test_hard_rows_and_tightened_limits_count_in_full(constructed):
    qp, rows, instance, solution = constructed
    tight = eqx.tree_at(lambda i: i.row_high, instance, instance.row_high.at[0].add(-1.5))
    residuals = judge(qp, rows, tight, solution)
    assert residuals["primal"] > 0.1
    assert all(value < 1e-12 for key, value in residuals.items() if key != "primal")
    cut = instance.upper.at[4].set(float(solution.x[4]) - 0.25)
    assert judge(qp, rows, instance, solution, upper=cut)["primal"] == pytest.approx(0.25)


def test_what_is_not_a_number_is_never_small(constructed):
    qp, rows, instance, solution = constructed
    for name in ("x", "row_price", "upper_price"):
        broken = kkt_residuals(qp, rows, instance, add(name, 0, np.nan)(solution))
        assert not float(broken.worst) <= 1.0


# -------------------------------------------------------------------------------------------- other people's


@pytest.mark.parametrize("solver", ["clarabel", "piqp"])
@pytest.mark.parametrize("name", ["plain", "active_cv_limits", "heavy_soft_linear", "mv_held_by_limits"])
def test_moves_and_prices_of_other_solvers_have_small_residuals_and_the_same_objective(solver, name):
    for seed in range(3):
        rng = np.random.default_rng(100 + seed)
        body = problems.small_case(rng, **SHAPES["envelope" if seed == 2 else "moves"])
        if name != "plain":
            problems.TWISTS[name](body, rng)
        qp, rows, instance = relaxed(body)
        theirs = foreign_solution(qp, rows, instance, solver)
        residuals = judge(qp, rows, instance, theirs)
        assert max(residuals.values()) <= 1e-6, residuals
        ours = solve_one(qp, instance)
        assert float(evaluate(qp, instance, theirs.x)) == pytest.approx(float(ours.objective), rel=1e-6)
