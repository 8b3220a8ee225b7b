"""The paper's motion, and moves from rest to rest."""

import numpy as np
import pytest

from adacd_hil.control.motions import QuinticMove, corner_to_corner

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


@pytest.mark.parametrize(
    ("half_period_s", "peak_deg_s"),
    [(AS_PRINTED_S, (100, 50)), (np.array([2.25, 2.25]), (50, 100))],
    ids=["", "synchronous"],
)
def test_the_peak_speeds_are_the_papers(half_period_s: np.ndarray, peak_deg_s: tuple[int, int]) -> None:
    speeds = np.degrees([np.abs(motion(t, half_period_s)[1]) for t in np.linspace(0.0, 9.0, 9001)])
    np.testing.assert_allclose(speeds.max(axis=0), peak_deg_s, rtol=1e-5)


@pytest.mark.parametrize("elapsed_s", [0.3, 1.3, 5.0, 7.77])
@pytest.mark.parametrize("order", [1, 2])
def test_velocity_and_acceleration_are_the_derivatives(elapsed_s: float, order: int) -> None:
    step_s = 1e-5
    ahead, behind = motion(elapsed_s + step_s)[order - 1], motion(elapsed_s - step_s)[order - 1]
    np.testing.assert_allclose((ahead - behind) / (2 * step_s), motion(elapsed_s)[order], rtol=1e-6, atol=1e-6)


SPEED, ACCELERATION = np.radians([90.0, 60.0]), np.radians([300.0, 200.0])


def moves() -> list[tuple[QuinticMove, np.ndarray, np.ndarray, np.ndarray]]:
    """Return random moves with their start, their end, and their motion (n, 3, 2)."""
    random = np.random.default_rng(5)
    found = []
    for reach in np.exp(random.uniform(np.log(1e-3), np.log(2.0), 200)):
        start, end = random.uniform(-reach, reach, (2, 2))
        move = QuinticMove(start, end, SPEED, ACCELERATION, 0.01)
        motion = np.zeros((201, 3, 2))
        for row, elapsed_s in zip(motion, np.linspace(0.0, move.duration_s, 201), strict=True):
            move.evaluate(float(elapsed_s), *row)
        found.append((move, start, end, motion))
    return found


def test_a_move_uses_its_speed_or_its_acceleration_limit_and_no_more() -> None:
    used = []
    for move, _, _, motion in moves():
        share = max(np.max(np.abs(motion[:, 1]) / SPEED), np.max(np.abs(motion[:, 2]) / ACCELERATION))
        assert share <= 1.0 + 1e-9
        used.append(1.0 if move.duration_s == 0.01 else share)
    assert min(used) > 0.99
