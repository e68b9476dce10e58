"""Step responses of transfer functions, against closed forms and a fine simulation."""

import math

import numpy as np
import pytest

from jaxmpc.model.transfer_function import TransferFunction

T = np.array([0.5, 1.0, 3.0, 10.0])
TWO = 1 - (5.0 * np.exp(-T / 5.0) - 2.0 * np.exp(-T / 2.0)) / 3.0


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (TransferFunction(2.0, (4.0,), 1.0), 2.0 * (1 - np.exp(-np.maximum(T - 1, 0) / 4))),
        (TransferFunction(2.0, (4.0,), 0.7), 2.0 * (1 - np.exp(-np.maximum(T - 0.7, 0) / 4))),
        (TransferFunction(3.0, (math.inf, math.inf)), 3.0 * T**2 / 2),
        (TransferFunction(1.0, (5.0, 2.0)), TWO),
        (TransferFunction(1.0, (5.0, 5.0)), 1 - (1 + T / 5) * np.exp(-T / 5)),  # equal lags
        (TransferFunction(2.0, (4.0, math.inf)), 2.0 * (T - 4 * (1 - np.exp(-T / 4)))),
        (TransferFunction(2.0, (4.0,), 0.0, 3.0), 2.0 * (1 + (3 / 4 - 1) * np.exp(-T / 4))),
        (TransferFunction(2.0, (5.0, 2.0), 0.0, -3.0), 2 * (TWO - (np.exp(-T / 5) - np.exp(-T / 2)))),
        (TransferFunction(2.0, (), 1.0), np.array([0.0, 2.0, 2.0, 2.0])),
        (TransferFunction(1.0, (1e-4,)), np.ones(4)),
    ],
)
def test_step_responses_are_those_of_their_transfer_functions(function, expected):
    np.testing.assert_allclose(function.step_response(T), expected, rtol=1e-12, atol=1e-14)


def test_nearly_equal_lags_are_as_exact_as_equal_ones():
    near = TransferFunction(1.0, (5.0, 5.0 + 1e-9)).step_response(T)
    np.testing.assert_allclose(near, 1 - (1 + T / 5) * np.exp(-T / 5), rtol=1e-8)
