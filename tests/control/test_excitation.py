"""The excitation: where it begins, that it is one motion, and what it keeps to."""

from dataclasses import replace

import numpy as np

from adacd_hil.control.motions import Excitation
from adacd_hil.settings.configuration_files import load_settings

SETTINGS = load_settings("certified", "P")
PERIOD_S = SETTINGS.excitation.period_s
CORNER = -np.radians(SETTINGS.trajectory.amplitude_deg)


def motion(t_s, settings=SETTINGS):
    """Return q_d, dq_d, ddq_d (n, 2) at these times."""
    excitation = Excitation(settings)
    q_d, dq_d, ddq_d = np.zeros((3, len(t_s), 2))
    for k, at_s in enumerate(t_s):
        excitation.evaluate(at_s, q_d[k], dq_d[k], ddq_d[k])
    return q_d, dq_d, ddq_d


def test_it_begins_at_rest_in_the_start_corner_of_the_trajectory_and_is_back_after_each_period():
    q_d, dq_d, ddq_d = (values[0] for values in motion([0.0]))
    np.testing.assert_array_equal(q_d, CORNER)
    assert np.max(np.abs(dq_d)) < np.radians(0.5)
    assert np.max(np.abs(ddq_d)) < np.radians(1.0)
    for later, first in zip(
        motion(PERIOD_S * np.array([1, 2, 2.3])), motion(PERIOD_S * np.array([0, 0, 0.3])), strict=True
    ):
        np.testing.assert_allclose(later, first, atol=1e-11)


def test_velocity_and_acceleration_are_those_of_the_position():
    t_s, step_s = np.linspace(0.01, PERIOD_S, 50), 1e-5
    _, dq_d, ddq_d = motion(t_s)
    later, earlier = motion(t_s + step_s), motion(t_s - step_s)
    np.testing.assert_allclose((later[0] - earlier[0]) / (2.0 * step_s), dq_d, atol=1e-6)
    np.testing.assert_allclose((later[1] - earlier[1]) / (2.0 * step_s), ddq_d, atol=1e-5)


def test_it_keeps_to_the_trajectory_s_corners_and_to_the_speeds_it_was_made_for():
    q_d, dq_d, ddq_d = (np.max(np.abs(np.degrees(values)), axis=0) for values in motion(np.arange(2400) * 1e-3))
    assert np.all(q_d <= 1.01 * np.array(SETTINGS.trajectory.amplitude_deg))
    assert np.all(dq_d <= [100.5, 120.5])
    assert np.all(ddq_d <= [705.0, 905.0])


def test_it_grows_with_the_trajectory():
    arm = replace(SETTINGS.arm, position_limit_deg=(75.0, 120.0))
    trajectory = replace(SETTINGS.trajectory, amplitude_deg=(15.0, 120.0))
    wide = replace(SETTINGS, arm=arm, trajectory=trajectory)
    t_s = np.linspace(0.0, 1.0, 7)
    np.testing.assert_allclose(motion(t_s, wide)[0], motion(t_s)[0] * [0.5, 2.0], rtol=1e-12)


def test_the_paper_has_none():
    assert Excitation(SETTINGS).is_on
    assert not Excitation(load_settings("paper", "P")).is_on
