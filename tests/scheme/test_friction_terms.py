"""The optional friction terms, column by column."""

import numpy as np
import pytest

from adacd_hil.config import FRICTION_TERMS
from adacd_hil.scheme.friction import ASYMMETRIC, LOAD, STRIBECK, WIDTH, fill_terms, smooth_sign

STILL, NO_WIDTH, V_S = 0.002, 0.0, 0.05
DQ, TAU_J = np.array([0.04, -0.3]), np.array([-2.0, 3.0])


def columns(terms, dq=DQ, tau_J=TAU_J, width=NO_WIDTH, first_column=3):
    Y_h = np.zeros((2, first_column + 2 * len(terms)))
    fill_terms(dq, tau_J, np.array(terms, float), (STILL, width, V_S), first_column, Y_h)
    return Y_h[:, first_column:]


def test_the_numbers_of_the_terms_are_their_places_in_the_settings():
    names = [FRICTION_TERMS[term] for term in (STRIBECK, LOAD, ASYMMETRIC, WIDTH)]
    assert names == ["stribeck", "load", "asymmetric", "width"]


@pytest.mark.parametrize(
    ("term", "expected"),
    [
        (STRIBECK, [np.exp(-0.64), -np.exp(-36.0)]),
        (LOAD, [2.0, -3.0]),
        (ASYMMETRIC, [1.0, 1.0]),
    ],
)
def test_each_term_has_a_column_per_joint(term, expected):
    np.testing.assert_allclose(columns([term]), np.diag(expected), rtol=1e-12)


def test_the_columns_follow_the_order_of_the_settings():
    both = columns([LOAD, STRIBECK])
    np.testing.assert_array_equal(both, np.hstack([columns([LOAD]), columns([STRIBECK])]))


def test_columns_before_the_first_are_left_alone():
    Y_h = np.full((2, 7), 9.0)
    fill_terms(DQ, TAU_J, np.array([1.0]), (STILL, NO_WIDTH, V_S), 5, Y_h)
    np.testing.assert_array_equal(Y_h[:, :5], 9.0)


def test_the_width_column_is_what_a_wider_tanh_would_change():
    """d/d(log width) of tanh(dq / width), by finite differences."""
    width, step = 0.1, 1e-6
    wider, narrower = (np.tanh(DQ / (width * np.exp(sign * step))) for sign in (1.0, -1.0))
    expected = np.diag((wider - narrower) / (2.0 * step))
    np.testing.assert_allclose(columns([WIDTH], width=width), expected, rtol=1e-7)


def test_a_sign_has_no_width_to_be_found():
    np.testing.assert_array_equal(columns([WIDTH]), 0.0)


def test_far_from_standstill_the_width_does_not_overflow():
    np.testing.assert_allclose(columns([WIDTH], dq=np.array([1e3, -1e3]), width=1e-3), 0.0, atol=1e-200)


@pytest.mark.parametrize(
    ("dq", "width", "expected"),
    [
        (0.0019, 0.0, 0.0),
        (-0.0019, 0.0, 0.0),
        (0.0021, 0.0, 1.0),
        (-0.0021, 0.0, -1.0),
        (0.0019, 0.01, np.tanh(0.19)),
        (-0.5, 0.01, -1.0),
    ],
)
def test_a_joint_that_may_stand_still_has_no_direction_unless_it_is_smooth(dq, width, expected):
    assert smooth_sign(dq, STILL, width) == pytest.approx(expected, rel=1e-12)


def test_a_joint_that_stands_still_has_no_column():
    np.testing.assert_array_equal(columns([STRIBECK, LOAD, ASYMMETRIC], dq=np.zeros(2)), 0.0)
