"""When an adaptation may end: eq. (15), the motion seen, the excitation."""

import numpy as np
import pytest

from adacd_hil.scheme.identify.excitation import add_information, eigenvalue_range
from adacd_hil.scheme.identify.termination import is_quiet


@pytest.mark.parametrize(
    ("tau_ext_hat", "expected"),
    [
        ((0.0, 0.0), True),
        ((0.1, -0.1), True),
        ((np.nextafter(0.1, 1.0), 0.0), False),
        ((0.0, -np.nextafter(0.1, 1.0)), False),
        ((np.nan, 0.0), False),
        ((0.0, np.nan), False),
        ((np.inf, 0.0), False),
    ],
)
def test_a_sample_is_quiet_only_within_beta_on_both_joints(tau_ext_hat, expected):
    assert is_quiet(np.array(tau_ext_hat), 0.1) == expected


def information_of(columns, period_s=1e-3):
    information = np.zeros((columns.shape[2],) * 2)
    for W_f in columns:
        add_information(W_f, period_s, information)
    return information


@pytest.mark.long
@pytest.mark.parametrize("count", [7, 9])
@pytest.mark.parametrize("seed", range(10))
def test_the_smallest_eigenvalue_is_that_of_lapack(seed, count):
    random = np.random.default_rng(seed)
    columns = random.standard_normal((40, 2, count)) * random.uniform(0.01, 3.0, count)
    scale = random.uniform(0.01, 1.0, count)
    full = np.einsum("nij,nik->jk", columns, columns) * 1e-3
    expected = np.linalg.eigvalsh(scale[:, None] * full * scale)[0]
    found = eigenvalue_range(information_of(columns), scale, np.full((count + 2, count + 2), -1.0))[0]
    np.testing.assert_allclose(found, expected, rtol=1e-8)
