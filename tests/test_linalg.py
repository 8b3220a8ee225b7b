"""The linear algebra of compiled code against numpy's."""

import numpy as np
import pytest

from adacd_hil import linalg


def positive_definite(count=6, seed=3):
    root = np.random.default_rng(seed).standard_normal((count, count + 2))
    return root @ root.T


def test_a_cholesky_factor_and_its_solutions_are_those_of_numpy():
    A, b = positive_definite(), np.linspace(-1.0, 2.0, 6)
    L, x = A.copy(), b.copy()
    assert linalg.factor(L, 0.0)
    np.testing.assert_allclose(np.tril(L), np.linalg.cholesky(A), rtol=1e-12)
    linalg.solve_lower(L, x)
    np.testing.assert_allclose(np.tril(L) @ x, b, rtol=1e-9)
    linalg.solve_upper(L, x)
    np.testing.assert_allclose(A @ x, b, rtol=1e-9)


@pytest.mark.parametrize("pivot", [0.0, -0.5, np.nan])
def test_a_matrix_that_is_not_positive_definite_has_no_factor_unless_a_least_pivot_is_given(pivot):
    A = np.diag([1.0, pivot, 4.0])
    assert not linalg.factor(A.copy(), 0.0)
    regular = np.diag([1.0, -0.5, 4.0])
    assert linalg.factor(regular, 0.25)
    assert np.diag(regular).tolist() == [1.0, 0.5, 2.0]


def test_of_a_symmetric_matrix_the_lower_half_is_read():
    A, x = positive_definite(), np.array([0.5, 0.0, -2.0, 1.0, 0.0, 3.0])
    upper_lost = np.tril(A)
    assert linalg.quadratic(upper_lost, x) == pytest.approx(x @ A @ x)
    assert linalg.factor(upper_lost, 0.0)


def test_a_form_that_rounding_makes_negative_is_zero():
    assert linalg.quadratic(np.array([[-1e-18]]), np.ones(1)) == 0.0


def test_a_misfit_is_predicted_less_measured():
    assert linalg.misfit(np.array([1.0, 2.0]), np.array([3.0, 0.5]), 1.5) == 2.5
    assert linalg.dot(np.array([1.0, 2.0]), np.array([3.0, 0.5])) == 4.0


def test_rows_add_up_to_the_sums_of_weighted_least_squares():
    random = np.random.default_rng(2)
    rows, residuals, R = random.standard_normal((20, 5)), random.standard_normal(20), random.uniform(0.1, 2.0, 20)
    rows[:, 2] = 0.0
    L, b = np.zeros((5, 5)), np.zeros(5)
    for each in zip(rows, residuals, R, strict=True):
        linalg.add_row(*each, L, b)
    np.testing.assert_allclose(L, np.tril(rows.T @ (rows / R[:, None])), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(b, rows.T @ (residuals / R), rtol=1e-12, atol=1e-15)
