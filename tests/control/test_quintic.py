"""The paper's motion, and ways to rest."""

import numpy as np
import pytest

from adacd_hil.control.motions import corner_to_corner, evaluate, to_rest

AMPLITUDE = np.radians([30.0, 60.0])
AS_PRINTED_S = np.array([1.125, 4.5])


def motion(elapsed_s: float, half_period_s: np.ndarray = AS_PRINTED_S) -> np.ndarray:
    out = np.zeros((3, 2))
    corner_to_corner(elapsed_s, AMPLITUDE, half_period_s, out[0], out[1], out[2])
    return out


@pytest.mark.parametrize(
    ("elapsed_s", "corner_deg"),
    [(0.0, (-30, -60)), (1.125, (30, None)), (2.25, (-30, 0)), (4.5, (-30, 60)), (9.0, (-30, -60)), (13.5, (-30, 60))],
)
def test_each_joint_is_in_its_corner_every_half_period(
    elapsed_s: float, corner_deg: tuple[float, float | None]
) -> None:
    q_deg = np.degrees(motion(elapsed_s)[0])
    expected = [corner_deg[0], q_deg[1] if corner_deg[1] is None else corner_deg[1]]
    np.testing.assert_allclose(q_deg, expected, atol=1e-9)


def test_the_peak_speeds_are_the_papers() -> None:
    speeds = np.degrees([np.abs(motion(t)[1]) for t in np.linspace(0.0, 9.0, 9001)])
    np.testing.assert_allclose(speeds.max(axis=0), [100.0, 50.0], rtol=1e-5)


def test_the_synchronous_motion_has_the_speeds_swapped() -> None:
    speeds = np.degrees([np.abs(motion(t, np.array([2.25, 2.25]))[1]) for t in np.linspace(0.0, 9.0, 9001)])
    np.testing.assert_allclose(speeds.max(axis=0), [50.0, 100.0], rtol=1e-5)


@pytest.mark.parametrize("elapsed_s", [0.3, 1.3, 5.0, 7.77])
@pytest.mark.parametrize("order", [1, 2])
def test_velocity_and_acceleration_are_the_derivatives(elapsed_s: float, order: int) -> None:
    step_s = 1e-5
    ahead, behind = motion(elapsed_s + step_s)[order - 1], motion(elapsed_s - step_s)[order - 1]
    np.testing.assert_allclose((ahead - behind) / (2 * step_s), motion(elapsed_s)[order], rtol=1e-6, atol=1e-6)


def on_the_way(elapsed_s: float) -> np.ndarray:
    start = np.array([[0.1, -0.2], [1.0, -2.0], [3.0, 4.0]])
    coefficients = to_rest(*start, np.array([-0.5, -1.0]), 0.8)
    out = np.zeros((3, 2))
    evaluate(coefficients, elapsed_s, out[0], out[1], out[2])
    return out


def test_a_way_to_rest_begins_with_the_present_motion() -> None:
    np.testing.assert_allclose(on_the_way(0.0), [[0.1, -0.2], [1.0, -2.0], [3.0, 4.0]], atol=1e-12)


def test_a_way_to_rest_ends_at_rest_in_its_goal() -> None:
    np.testing.assert_allclose(on_the_way(0.8), [[-0.5, -1.0], [0.0, 0.0], [0.0, 0.0]], atol=1e-9)
