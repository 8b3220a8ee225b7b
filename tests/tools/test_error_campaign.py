"""tools/campaigns/error_campaign.py: when it says that a step was found."""

import numpy as np
import pytest
from error_campaign import AGREES, WITHIN, find_steps

FILTERS, CHANNELS = 3, 5
RISING = np.tile(np.linspace(0.0, 1.0, WITHIN), (CHANNELS, 1))


def found(step_Nm, y=0.0, h=np.inf, onsets=(0,)):
    """After how many cycles a step on joint 2 is found, of channels that rise in a straight line."""
    residual, threshold = np.zeros((400, CHANNELS, 2)), np.full((400, CHANNELS, 2), np.inf)
    residual[:, :, 1], threshold[:, :, 1] = y, h
    cycles = np.zeros(len(onsets))
    find_steps.py_func(residual, threshold, RISING, FILTERS, np.array(onsets), 1, step_Nm, cycles)
    return cycles.tolist()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_step_is_found_with_the_first_sample_over_a_threshold(sign):
    first = int(np.argmax(RISING[0] > 0.5)) + 1
    assert found(sign, h=0.5, onsets=(0, 20)) == [first, first]
    assert found(0.49 * sign, h=0.5) == [np.inf]


def test_what_is_there_already_counts_with_its_sign():
    assert found(1.0, y=0.2, h=0.5)[0] < found(1.0, h=0.5)[0] < found(-1.0, y=0.2, h=0.5)[0]


def test_a_bare_channel_needs_the_smoothed_one_of_its_filter():
    h = np.array([np.inf, np.inf, 0.5 / AGREES, np.inf, 0.3])
    assert found(1.0, h=h) == [int(np.argmax(RISING[0] > 0.5)) + 1]
    assert found(1.0, h=np.array([np.inf, np.inf, np.inf, np.inf, 0.3])) == [np.inf]
