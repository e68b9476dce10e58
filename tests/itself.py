"""A plant in JAX that is a step-response model itself, so that predictions are right."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from jaxmpc.model.step_response import StepResponseModel, advance_free_response, shift_free_response
from jaxmpc.process.plant import JaxPlant, Outputs


class Itself(JaxPlant):
    """Of its disturbances, `drift` only adds to all CVs; the others are the DVs of the model, under any names."""

    model: StepResponseModel
    cv: Any  # at the start
    mv: Any
    dt: float = eqx.field(static=True, default=10.0)
    disturbance_names: tuple[str, ...] = eqx.field(static=True, default=("drift",))

    def init(self) -> Any:
        free = jnp.zeros_like(self.model.coefficients[:, 0])
        dvs = jnp.zeros(len(self.disturbance_names) - 1)
        return free, jnp.asarray(self.mv), dvs, jnp.asarray(self.cv)

    def step(self, state, mv, disturbance):
        free, before, dvs, _ = state
        steps = jnp.concatenate([self.model.coefficients, self.model.dv_coefficients], axis=1)
        change = jnp.concatenate([mv - before, disturbance[1:] - dvs])
        free = advance_free_response(free, steps, change)
        state = shift_free_response(free), mv, disturbance[1:], self.cv + free[:, 0] + disturbance[0]
        return state, self.measure(state)

    def measure(self, state):
        return Outputs(state[3], state[1])
