"""Fitting the well model to published step responses: how the shipped parameters were found (thesis 4.1).

`fit_well` adjusts the uncertain parameters until the model's own step responses, simulated with the plant's
Runge-Kutta steps, match given ones. The least-squares Jacobian is the exact derivative of that simulation.
Step responses at one working point do not determine every parameter, so each keeps to a prior, the shipped
well, within its uncertainty. Run ``python -m identify.well_fit DATA.json --out WELL.json``.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.check import check_keys
from jaxmpc.errors import InputError
from jaxmpc.files import check_target, read_json
from jaxmpc.model.step_response import FORMAT, StepResponseModel, make_model
from jaxmpc.process.well.equations import (
    CV_NAMES,
    DEFAULT_CHOKE,
    DEFAULT_LIFT,
    MV_NAMES,
    SHIPPED_STEADY_STATE,
    WellParameters,
    check_parameters,
    load_parameters,
    model,
    parameters_to_dict,
    save_parameters,
)
from jaxmpc.process.well.grids import TEST_STEPS
from jaxmpc.process.well.plant import STATE_SCALE, JaxOps, check_inputs, rates, runge_kutta, steady_state

RESPONSE_ERROR = 0.05  # standard error of a response, as a share of its peak: the model's, not the data's
RESPONSE_COUNT = 10.0  # independent values that one response is worth
RATE_ERROR = 0.01  # relative standard error of the steady rates at the working point

# Relative uncertainty of the parameters that are fitted; the two shape coefficients are absolute.
UNCERTAINTY = {
    "tubing_length": 0.1,
    "tubing_diameter": 0.1,
    "annulus_volume": 0.2,
    "perforation_depth": 0.2,
    "reservoir_pressure": 0.05,
    "productivity": 0.2,
    "near_well_resistance": 0.3,
    "near_well_time": 0.3,
    "gas_oil_ratio": 0.2,
    "choke_conductance": 0.1,
    "choke_linear": 0.1,
    "choke_quick": 0.1,
    "manifold_pressure": 0.1,
    "friction_factor": 0.2,
    "injection_conductance": 0.2,
    "supply_pressure": 0.1,
    "supply_droop": 0.3,
    "slip_base": 0.1,
    "slip_velocity": 0.3,
    "slip_floor": 0.3,
    "choke_time": 0.3,
    "lift_time": 0.3,
    "gas_meter": 0.1,
}
ABSOLUTE = ("choke_linear", "choke_quick")


class StepData(NamedTuple):
    """Step responses to fit to.

    Attributes:
        coefficients: ``"cv mv n"``, S(1)..S(n), CV change at 1..n samples after a unit step.
        dt: sampling interval [s].
        choke, lift: working point [%, m3/h].
        rates: steady gas and oil rates at the working point [m3/h]; None keeps them near the prior's.
    """

    coefficients: np.ndarray
    dt: float
    choke: float
    lift: float
    rates: np.ndarray | None


class Fit(NamedTuple):
    """Result of `fit_well`.

    Attributes:
        parameters: the fitted well.
        r_squared: ``"cv mv"``, share of the variance of each response that the well reproduces.
        largest_error: ``"cv mv"``, as a share of the response's peak [1].
        response: ``"cv mv n"``, the well's own step responses.
        cost: half the sum of squared weighted errors, before each step and at the end.
        converged: whether the last step changed no parameter by more than 1e-4 of its uncertainty.
    """

    parameters: WellParameters
    r_squared: np.ndarray
    largest_error: np.ndarray
    response: np.ndarray
    cost: list[float]
    converged: bool


def load_step_data(path: str | Path) -> StepData:
    """Read step responses, either a model written by `StepResponseModel.save` or a published table.

    A published table is a JSON object with ``coefficients[cv][mv][n]`` (entry k is the CV change k samples
    after a unit step, so that entry 0 is zero), ``sampling_seconds``, and the names ``cv`` and ``mv``, which
    start with gas and oil, and choke and gas lift. Optional: ``working_point`` with ``choke`` [%] and
    ``gas_lift`` [m3/h] (50 and 7500 by default), and ``gas_rate`` and ``oil_rate`` [m3/h].

    Raises:
        InputError: naming the field that is wrong.
    """
    body = read_json("step-response file", path)
    if not isinstance(body, dict):
        raise InputError("step-response file", str(path), "a JSON object")
    if body.get("format") == FORMAT:
        table = StepResponseModel.load(path)
        point = dict(table.working_point)
        coefficients = np.asarray(table.coefficients)
    else:
        keys = ("coefficients", "sampling_seconds", "cv", "mv")
        check_keys("data", body, keys)
        table = make_model(*(body[key] for key in keys), path="data")
        point = body.get("working_point", {})
        first, coefficients = np.split(np.asarray(table.coefficients), [1], axis=-1)
        largest = np.abs(table.coefficients).max(axis=-1, keepdims=True)
        if (np.abs(first) > 1e-6 * largest).any() or coefficients.shape[-1] == 0:
            expected = "entry 0, at the instant of the step, to be 0"
            raise InputError("data.coefficients", first[..., 0].tolist(), expected)
    known = {"cv": (table.cv_names, ("gas", "oil")), "mv": (table.mv_names, ("choke", "gas"))}
    for key, (names, starts) in known.items():
        if len(names) != 2 or not all(map(str.startswith, map(str.lower, names), starts)):
            raise InputError(f"data.{key}", list(names), f"two names that start with {' and '.join(starts)}")
    choke, lift = point.get("choke", DEFAULT_CHOKE), point.get("gas_lift", DEFAULT_LIFT)
    check_inputs(choke, lift)
    check_inputs(choke + TEST_STEPS[0], lift + TEST_STEPS[1])
    said = [point.get(name) for name in CV_NAMES]
    measured = None if None in said else np.array(said, dtype=np.float64)
    if measured is not None and not (np.isfinite(measured).all() and (measured > 0).all()):
        raise InputError("data.working_point", said, "gas and oil rates above zero [m3/h]")
    if (np.abs(coefficients).max(axis=-1) == 0).any():
        raise InputError("data.coefficients", "a response of zeros", "four responses that move")
    return StepData(coefficients, table.dt, float(choke), float(lift), measured)


def _unpack(theta, prior: WellParameters) -> WellParameters:
    """Parameters from the fitted vector, whose entries count uncertainties away from the prior."""
    changed = {}
    for value, (name, width) in zip(theta, UNCERTAINTY.items(), strict=True):
        centre = getattr(prior, name)
        changed[name] = centre + width * value if name in ABSOLUTE else centre * jnp.exp(width * value)
    return dataclasses.replace(prior, **changed)


def _measure(x, u, parameters):
    return jnp.stack(model(JaxOps, tuple(x), tuple(u), parameters)[1][:2])


def simulate_steps(parameters: WellParameters, x0, point, seconds: int, samples: int):
    """Step responses as a differentiable function of the parameters of the well.

    They begin in the steady state `x0` ``"8"`` at the working point ``"2"``, choke [%] and lift [m3/h]; a sample is a
    whole number of seconds.

    Returns:
        ``(steady, response)``: steady CVs ``"cv"`` [m3/h], and S(1)..S(samples) ``"cv mv n"``.
    """
    scale = jnp.asarray(STATE_SCALE)
    here = jnp.append(point, 0.0)

    def drift(s, parameters):
        return rates(s * scale, here, parameters) / scale

    # One Newton step from the solution, its matrix held constant, has the solution's derivative: -J^-1 df/dp.
    s = jax.lax.stop_gradient(x0 / scale)
    jacobian = jax.lax.stop_gradient(jax.jacfwd(drift)(s, parameters))
    start = (s - jnp.linalg.solve(jacobian, drift(s, parameters))) * scale
    steady = _measure(start, here, parameters)

    def response(change):
        u = here + change

        def sample(x, _):
            x = jnp.stack(runge_kutta(tuple(x), tuple(u), parameters, seconds, 1.0))
            return x, _measure(x, u, parameters)

        _, cv = jax.lax.scan(sample, start, length=samples)
        return ((cv - steady) / jnp.sum(change)).T

    changes = jnp.array([[TEST_STEPS[0], 0.0, 0.0], [0.0, TEST_STEPS[1], 0.0]])
    return steady, jax.vmap(response, out_axes=1)(changes)


@jax.jit
def _settle(theta, guess, point, prior):
    found = steady_state(point[0], point[1], 0.0, _unpack(theta, prior), guess)
    return found.x, found.converged


def _errors(theta, x0, point, target, measured, prior, seconds):
    """Weighted errors of responses, parameters and steady rates; and the responses."""
    steady, response = simulate_steps(_unpack(theta, prior), x0, point, seconds, target.shape[-1])
    # The samples of a response are not independent: all of them together count as `RESPONSE_COUNT`.
    peak = jnp.abs(target).max(axis=-1, keepdims=True)
    weight = np.sqrt(RESPONSE_COUNT / target.shape[-1]) / (RESPONSE_ERROR * peak)
    parts = (((response - target) * weight).ravel(), theta, (steady / measured - 1) / RATE_ERROR)
    return jnp.concatenate(parts), response


_value = jax.jit(_errors, static_argnums=6)
_slope = jax.jit(lambda *a: jax.jacfwd(lambda t: _errors(t, *a[1:])[0])(a[0]), static_argnums=6)


def fit_well(data: StepData, prior: WellParameters | None = None, steps: int = 30) -> Fit:
    """Fit the well to step responses by Levenberg-Marquardt.

    Minimises the squared errors of the four responses (weighted with `RESPONSE_ERROR` of their peaks), of the
    steady rates (`RATE_ERROR`), and of the parameters against the prior (`UNCERTAINTY`).

    Args:
        data: from `load_step_data`; its sampling interval must be a whole number of seconds.
        prior: where to start and what to stay near; the shipped well by default.
        steps: most iterations.

    Raises:
        InputError: for a sampling interval that is not a whole number of seconds.
    """
    if abs(data.dt - round(data.dt)) > 1e-9 or data.dt < 1:
        raise InputError("data.sampling_seconds", data.dt, "a whole number of seconds")
    prior = check_parameters(WellParameters() if prior is None else prior, "prior")
    point = jnp.array([data.choke, data.lift])
    theta, damping = jnp.zeros(len(UNCERTAINTY)), 1e-3
    x0, _ = _settle(theta, jnp.asarray(SHIPPED_STEADY_STATE), point, prior)
    measured = _measure(x0, jnp.append(point, 0.0), prior) if data.rates is None else jnp.asarray(data.rates)
    rest = (point, jnp.asarray(data.coefficients), measured, prior, round(data.dt))
    current, response = _value(theta, x0, *rest)
    cost, converged = [0.5 * float(current @ current)], False
    for _ in range(steps):
        jacobian = _slope(theta, x0, *rest)
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ current
        while damping < 1e8:
            move = -jnp.linalg.solve(normal + damping * jnp.diag(jnp.diag(normal)), gradient)
            x_new, found = _settle(theta + move, x0, point, prior)
            trial, trial_response = _value(theta + move, x_new, *rest)
            cost_new = 0.5 * float(trial @ trial)
            if bool(found) and np.isfinite(cost_new) and cost_new <= cost[-1]:
                break
            damping *= 10.0
        else:
            break  # no step improves the fit any more
        theta, x0, current, response = theta + move, x_new, trial, trial_response
        cost.append(cost_new)
        damping = max(damping / 10.0, 1e-9)
        converged = bool(jnp.max(jnp.abs(move)) < 1e-4)
        if converged:
            break
    fitted = WellParameters(**parameters_to_dict(_unpack(theta, prior)))
    target, response = data.coefficients, np.asarray(response)
    unexplained = ((response - target) ** 2).mean(axis=-1) / target.var(axis=-1)
    largest = np.abs(response - target).max(axis=-1) / np.abs(target).max(axis=-1)
    return Fit(fitted, 1 - unexplained, largest, response, cost, converged)


def main(arguments: list[str] | None = None) -> int:
    """Command line: fit the well to a file of step responses and write its parameters. Returns 0, or 2."""
    text = "Fit the well to step responses."
    parser = argparse.ArgumentParser(prog="python -m identify.well_fit", description=text)
    for name, kind, what in (
        ("data", str, "step responses: a model of `jaxmpc identify`, or a published table (JSON)"),
        ("--out", str, "where to write the parameters (JSON); printed by default"),
        ("--prior", str, "parameters to start from (JSON; default: the shipped well)"),
        ("--gas-rate", float, "steady gas rate at the working point [m3/h]"),
        ("--oil-rate", float, "steady oil rate at the working point [m3/h]"),
    ):
        parser.add_argument(name, type=kind, help=what)
    given = parser.parse_args(arguments)
    try:
        data = load_step_data(given.data)
        prior = load_parameters(given.prior) if given.prior else WellParameters()
        both, known = "--gas-rate and --oil-rate", (given.gas_rate, given.oil_rate)
        if known.count(None) == 1:
            raise InputError(both, "one of them", "both or neither [m3/h]")
        if None not in known:
            if not all(0 < rate < np.inf for rate in known):
                raise InputError(both, known, "above zero [m3/h]")
            data = data._replace(rates=np.array(known))
        if given.out:
            check_target("--out", given.out, filter(None, [given.data, given.prior]))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    fit = fit_well(data, prior)
    for (cv, mv), fitted, error in zip(
        itertools.product(CV_NAMES, MV_NAMES), fit.r_squared.flat, fit.largest_error.flat, strict=True
    ):
        said = f"{cv} <- {mv}: R2 {fitted:.4f}, largest error {100 * error:.1f} % of the peak"
        print(said, file=sys.stderr)
    if data.rates is None:
        print("Steady rates were not given and kept near the prior's.", file=sys.stderr)
    if not fit.converged:
        print("The fit did not converge; this is the best that was found.", file=sys.stderr)
    if given.out:
        facts: dict = {key: getattr(fit, key).tolist() for key in ("r_squared", "largest_error")}
        facts |= {"converged": fit.converged, "fitted_to": Path(given.data).name}
        print(save_parameters(fit.parameters, given.out, **facts), file=sys.stderr)
    else:
        print(json.dumps(parameters_to_dict(fit.parameters), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
