"""The optional friction terms, column by column."""

import numpy as np
import pytest

from adacd_hil.scheme.model.further_friction import (
    ASYMMETRIC,
    DAHL_LONG,
    DAHL_SHORT,
    LOAD,
    STRIBECK,
    WIDTH,
    bend_bristles,
    fill_terms,
    smooth_sign,
)
from adacd_hil.settings.scheme_settings import FRICTION_TERMS

STILL, NO_WIDTH, V_S = 0.002, 0.0, 0.05
DQ, TAU_J = np.array([0.04, -0.3]), np.array([-2.0, 3.0])
BENT = np.array([[0.5, -1.0], [-0.4, 0.2]])


def columns(terms, dq=DQ, tau_J=TAU_J, width=NO_WIDTH, bent=BENT, first_column=3):
    Y_h = np.zeros((2, first_column + 2 * len(terms)))
    fill_terms(dq, tau_J, np.array(terms, float), (STILL, width, V_S), bent, first_column, Y_h)
    return Y_h[:, first_column:]


def test_the_numbers_of_the_terms_are_their_places_in_the_settings():
    names = [FRICTION_TERMS[term] for term in (STRIBECK, LOAD, ASYMMETRIC, WIDTH, DAHL_SHORT, DAHL_LONG)]
    assert names == ["stribeck", "load", "asymmetric", "width", "dahl_short", "dahl_long"]


@pytest.mark.parametrize(
    ("term", "expected"),
    [
        (STRIBECK, [np.exp(-0.64), -np.exp(-36.0)]),
        (LOAD, [2.0, -3.0]),
        (ASYMMETRIC, [1.0, 1.0]),
        (DAHL_SHORT, [-0.5, 0.0]),
        (DAHL_LONG, [-1.4, 1.2]),
    ],
)
def test_each_term_has_a_column_per_joint(term, expected):
    np.testing.assert_allclose(columns([term]), np.diag(expected), rtol=1e-12)


def test_the_columns_follow_the_order_of_the_settings():
    both = columns([LOAD, STRIBECK])
    np.testing.assert_array_equal(both, np.hstack([columns([LOAD]), columns([STRIBECK])]))


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


PERIOD_S = 1e-3
LENGTHS_RAD = np.array([0.001, 0.004])


@pytest.mark.parametrize("dq", [0.3, -0.3])
def test_bristles_bend_over_the_way_not_the_time_and_in_steady_sliding_the_column_is_nothing(dq):
    """After the way d from the opposite direction 2 / e of the reversal is left."""
    by_steps, at_once = np.full((2, 3), -np.sign(dq)), np.full((2, 3), -np.sign(dq))
    way_s = LENGTHS_RAD[1] / abs(dq)
    for _ in range(8):
        bend_bristles(np.full(3, dq), way_s / 8.0, STILL, LENGTHS_RAD, by_steps)
    bend_bristles(np.full(3, dq), way_s, STILL, LENGTHS_RAD, at_once)
    np.testing.assert_allclose(by_steps, at_once, rtol=1e-12)
    both = columns([DAHL_SHORT, DAHL_LONG], dq=np.full(2, dq), bent=at_once)
    left = -2.0 * np.sign(dq) * np.exp([-4.0, -1.0])
    np.testing.assert_allclose(both, np.hstack([left[0] * np.eye(2), left[1] * np.eye(2)]), rtol=1e-12)
    bend_bristles(np.full(3, dq), 40.0 * way_s, STILL, LENGTHS_RAD, at_once)
    np.testing.assert_allclose(columns([DAHL_SHORT, DAHL_LONG], dq=np.full(2, dq), bent=at_once), 0.0, atol=1e-15)


def test_nothing_bends_while_a_joint_stands_still_and_the_column_is_what_is_bent():
    bent = BENT.copy()
    for dq in (0.9 * STILL, -0.9 * STILL, 0.0):
        for _ in range(100):
            bend_bristles(np.array([dq, -dq]), PERIOD_S, STILL, LENGTHS_RAD, bent)
    np.testing.assert_array_equal(bent, BENT)
    both = columns([DAHL_SHORT, DAHL_LONG], dq=np.array([0.0, 0.9 * STILL]), bent=bent)
    np.testing.assert_array_equal(both, np.hstack([np.diag(BENT[0]), np.diag(BENT[1])]))
    bend_bristles(np.array([1.1 * STILL, 0.0]), PERIOD_S, STILL, LENGTHS_RAD, bent)
    assert np.all(bent[:, 0] > BENT[:, 0])
    np.testing.assert_array_equal(bent[:, 1], BENT[:, 1])
