"""The joint controller."""

import numpy as np
import pytest

from adacd_hil.control.controller import HANDOVER_S, Controller
from adacd_hil.scheme.model.regressor import inverse_dynamics
from adacd_hil.settings.configuration_files import load_settings

SETTINGS = load_settings("paper", "S")
THETA = np.array([0.4, 0.07, 0.04, 0.03, 0.02, 0.1, 0.05])
Q, DQ, DDQ = np.array([0.2, -0.4]), np.array([1.0, -2.0]), np.array([3.0, 4.0])


def torque(controller: Controller, q: np.ndarray = Q, dq: np.ndarray = DQ) -> np.ndarray:
    tau_d = np.zeros(2)
    controller.torque(q, dq, Q, DQ, DDQ, tau_d)
    return tau_d


def test_on_the_desired_motion_there_is_no_torque_without_a_model() -> None:
    np.testing.assert_array_equal(torque(Controller(SETTINGS)), [0.0, 0.0])


def test_a_deviation_is_pulled_back_by_both_gains() -> None:
    tau_d = torque(Controller(SETTINGS), Q - [0.01, 0.02], DQ - [0.1, 0.2])
    np.testing.assert_allclose(tau_d, [500 * 0.01 + 25 * 0.1, 40 * 0.02 + 1.5 * 0.2], rtol=1e-12)


def test_a_new_model_never_steps_the_torque() -> None:
    controller = Controller(SETTINGS)
    course = [torque(controller)]
    for theta in (THETA, 2.0 * THETA):
        controller.feed_forward(theta)
        course += [torque(controller) for _ in range(300)]
    largest = np.abs(np.diff(course, axis=0)).max(axis=0)
    assert np.all(largest <= np.abs(inverse_dynamics(Q, DQ, DDQ, 2.0 * THETA, 0.0)) / 250)


@pytest.mark.parametrize("times", [1, 250])
def test_a_model_is_fed_forward_after_the_handover_which_the_same_again_does_not_restart(times: int) -> None:
    controller = Controller(SETTINGS)
    for cycle in range(round(HANDOVER_S / SETTINGS.bus.period_s)):
        if cycle < times:
            controller.feed_forward(THETA)
        reached = torque(controller)
    np.testing.assert_allclose(reached, inverse_dynamics(Q, DQ, DDQ, THETA, 0.0), rtol=1e-12)
