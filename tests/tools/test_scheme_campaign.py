"""tools/campaigns/scheme_campaign.py: the bound that it compares with, in noise that is known."""

import numpy as np
import pytest
from campaign_bound import Bound, fit, threshold_sigma, whiten

WHITE = np.zeros((1, 2, 2))
STEP = np.stack([np.stack([np.ones(250), np.zeros(250)], 1), np.stack([np.zeros(250), np.ones(250)], 1)])


def test_the_bound_of_a_step_in_white_noise_is_that_of_its_mean():
    bound = Bound(WHITE, 0.02**2 * np.eye(2), STEP)
    needed = (threshold_sigma() * 0.02 / 0.03) ** 2  # samples
    assert bound.delay_s(0, 0.03) == pytest.approx((np.ceil(needed) - 0.5) * 1e-3)
    assert bound.smallest_Nm(1) == pytest.approx(threshold_sigma() * 0.02 / np.sqrt(101))
    assert bound.delay_s(1, 1e-3) == np.inf


def test_a_contact_is_found_by_the_torque_of_both_joints():
    bound = Bound(WHITE, 0.02**2 * np.eye(2), STEP)
    one, both = np.full((50, 2), [0.03, 0.0]), np.full((50, 2), [0.03, 0.03])
    assert bound.contact_delay_s(one) == bound.delay_s(0, 0.03)
    assert bound.contact_delay_s(both) < bound.contact_delay_s(one)


def test_the_autoregression_of_noise_is_found_without_the_samples_that_don_t_count():
    generator = np.random.default_rng(1)
    white = generator.standard_normal((8000, 2))
    noise, matrix = white.copy(), np.array([[0.8, 0.3], [0.0, 0.5]])
    for k in range(1, len(noise)):
        noise[k] += matrix @ noise[k - 1]
    assert whiten(noise, matrix[np.newaxis]) == pytest.approx(white)
    noise[5000:5100] = 50.0
    is_good = np.ones(len(noise), bool)
    is_good[4999:5101] = False
    coefficients, covariance = fit(noise, is_good)
    assert coefficients[0] == pytest.approx(matrix, abs=0.05)
    assert covariance == pytest.approx(np.eye(2), abs=0.06)
