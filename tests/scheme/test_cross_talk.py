"""Torque sensors that show some of each other's torque, and too much or too little of their own."""

from dataclasses import replace

import numpy as np
import pytest
from excited_arm import SETTINGS, play, record
from planar_arm import THETA

from adacd_hil.records import SchemeState
from adacd_hil.scheme.kernel import certified_memory

SHARE = 0.02
SENSORS = np.array([[1.0 + SHARE, SHARE], [SHARE, 1.0 - SHARE]])
"""What the sensors show of the true torques (2, 2)."""
UNKNOWING = replace(SETTINGS, certified=replace(SETTINGS.certified, cross_talk_std=0.0))
CROSS_TALK = [certified_memory.parameter_names(SETTINGS).index(f"cross_talk{joint}") for joint in (1, 2)]


@pytest.mark.parametrize("profile", ["P", "M"])
def test_an_arm_with_such_sensors_is_certified_as_soon_as_any_other_and_raises_no_alarm(profile):
    measured = record(THETA[profile], 20.0)
    played = play(measured._replace(tau_J=measured.tau_J @ SENSORS.T))
    armed = np.argmax(played.state == SchemeState.MONITOR)
    assert 0 < armed <= 2000
    assert set(played.state[armed:]) == {SchemeState.MONITOR}
    assert np.abs(played.theta[-1, CROSS_TALK]).max() < 2.0 * SHARE  # inertia takes some of it, too


def test_a_model_that_shall_not_know_of_it_has_no_column_for_it():
    names = certified_memory.parameter_names(UNKNOWING)
    assert not any(name.startswith("cross_talk") for name in names)
    assert len(names) == len(certified_memory.parameter_names(SETTINGS)) - 2
