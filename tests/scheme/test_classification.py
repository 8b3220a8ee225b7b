"""Push and hit told apart, on shapes that were not used to choose the bound."""

import numpy as np
import pytest

from adacd_hil.records import ContactKind
from adacd_hil.scheme.contact.contact_kind import classify
from adacd_hil.settings.scheme_settings import KIND_S

SIGMA = np.array([0.03, 0.015])
PERIOD_S = 1e-3


def window(shape, force_Nm=2.0, threshold_Nm=0.15, seed=0):
    """Return the torques (n, 2) of a contact from its onset to KIND_S after it was over a threshold."""
    t_s = np.arange(600) * PERIOD_S
    tau = np.outer(shape(t_s), [force_Nm, 0.4 * force_Nm]) + np.random.default_rng(seed).normal(size=(600, 2)) * SIGMA
    detected = int(np.argmax(shape(t_s) * force_Nm > threshold_Nm))
    return tau[: detected + round(KIND_S / PERIOD_S)]


def half_sine(duration_s):
    return lambda t_s: np.where(t_s < duration_s, np.sin(np.pi * t_s / duration_s), 0.0)


def ramp(rise_s):
    return lambda t_s: np.minimum(t_s / rise_s, 1.0)


@pytest.mark.parametrize("duration_s", [0.02, 0.05, 0.1])
@pytest.mark.parametrize("force_Nm", [0.6, 20.0])
def test_a_blow_is_a_hit(duration_s, force_Nm):
    assert classify(window(half_sine(duration_s), force_Nm), SIGMA, PERIOD_S) is ContactKind.HIT


@pytest.mark.parametrize("rise_s", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("force_Nm", [0.6, 20.0])
def test_what_grows_slowly_is_a_push(rise_s, force_Nm):
    assert classify(window(ramp(rise_s), -force_Nm, -0.15), SIGMA, PERIOD_S) is ContactKind.PUSH


def test_a_hand_that_changes_sides_still_pushes():
    tau = window(half_sine(0.05))
    tau[-20:] -= [1.5, 0.6]
    assert classify(tau, SIGMA, PERIOD_S) is ContactKind.PUSH


def test_nothing_at_all_is_no_push_and_one_sample_is_enough():
    assert classify(np.zeros((5, 2)), np.ones(2), PERIOD_S) is ContactKind.HIT
    assert classify(np.ones((1, 2)), np.ones(2), PERIOD_S) is ContactKind.PUSH
