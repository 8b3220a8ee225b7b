"""When an adaptation may end: eq. (15), the motion seen, the excitation."""

import numpy as np
import pytest

from adacd_hil.scheme.identify.excitation import add_information, eigenvalue_range, has_moved
from adacd_hil.scheme.identify.termination import is_quiet
from adacd_hil.scheme.memory import Motion
from adacd_hil.structured import zeros_of


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


MOVED = {"q_low": (-0.5, -0.5), "q_high": (0.5, 0.5), "dq_low": (-1.0, -1.0), "dq_high": (1.0, 1.0)}


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, True),
        ({"q_low": (0.1, -0.5)}, False),
        ({"q_high": (0.5, -0.1)}, False),
        ({"dq_low": (-1.0, -0.1)}, False),
        ({"dq_high": (0.1, 1.0)}, False),
        ({"dq_high": (1.0, -0.2)}, False),
        ({"q_low": (np.nan, -0.5)}, False),
        ({"q_low": (-0.2, -0.2), "q_high": (0.3, 0.3)}, True),
        ({"dq_low": (-0.2, -0.2), "dq_high": (0.2, 0.2)}, True),
    ],
)
def test_the_arm_has_moved_when_each_joint_went_far_and_both_ways(changed, expected):
    motion = zeros_of(Motion, {"n": 2, "p": 1})[0]
    for name, value in (MOVED | changed).items():
        motion[name] = value
    assert has_moved(motion, 0.5, 0.2) == expected


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
    found = eigenvalue_range(information_of(columns), scale, np.zeros((count, count)))[0]
    np.testing.assert_allclose(found, expected, rtol=1e-8)
