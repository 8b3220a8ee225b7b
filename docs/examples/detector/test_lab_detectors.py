"""Tests of a lab's detector: it keeps the contract, and finds a push."""

import numpy as np
from lab_detectors import MeanOfTwenty

from adacd_hil.api import check_detector


def test_it_keeps_the_contract():
    check_detector("mean of 20", MeanOfTwenty)


def test_a_step_of_1_Nm_is_over_a_half_after_10_samples():
    statistic = MeanOfTwenty(1e-3).take(np.ones((20, 2)), np.zeros((20, 2)))
    assert int(np.argmax(statistic[:, 0] > 0.5)) == 10
