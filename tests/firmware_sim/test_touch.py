"""The person's force: its torque by virtual work, its course over time, its place on the grid."""

import math

import numpy as np
import pytest
from general_arm import LENGTH_M, point_of

from firmware_sim.arm.touch_settings import TICK_S, ContactSettings, contact_force, contact_table, contact_torque


def contact(**changes) -> ContactSettings:
    values = {"at_s": 1.0, "link": 2, "point_m": 0.2, "force_N": 20.0, "duration_s": 0.05} | changes
    return ContactSettings(**values)


@pytest.mark.parametrize("link", [1, 2])
@pytest.mark.parametrize("frame", ["link", "world"])
def test_the_torque_of_a_contact_is_its_virtual_work(link, frame):
    generator = np.random.default_rng(3)
    for _ in range(30):
        q = generator.uniform(-3, 3, 2)
        point_m, angle_deg = generator.uniform(0, 0.3), generator.uniform(-360, 360)
        row = contact_table((contact(link=link, frame=frame, point_m=point_m, angle_deg=angle_deg),))[0]
        found = contact_torque(row, 20.0, LENGTH_M, q[0], q[1], 0.4, -0.9)
        link_angle = q[0] if link == 1 else q[0] + q[1]
        psi = math.radians(angle_deg) + (link_angle if frame == "link" else 0.0)
        force = 20.0 * np.array([math.cos(psi), math.sin(psi)])
        for joint in range(2):
            ahead, behind = q.copy(), q.copy()
            ahead[joint] += 1e-5
            behind[joint] -= 1e-5
            moved = point_of(link, point_m, ahead) - point_of(link, point_m, behind)
            assert found[joint] == pytest.approx(force @ moved / 2e-5, abs=1e-8)


def velocity_of(link: int, point_m: float, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """Return the velocity of the touched point, m/s (2,), by a central difference."""
    ahead, behind = (point_of(link, point_m, q + sign * 1e-6 * dq) for sign in (1.0, -1.0))
    return (ahead - behind) / 2e-6


@pytest.mark.parametrize("link", [1, 2])
@pytest.mark.parametrize(("angle_deg", "share"), [(0.0, 1.0), (180.0, -1.0), (60.0, 0.5), (90.0, 0.0)])
def test_a_force_along_the_motion_has_the_power_of_its_part_that_helps(link, angle_deg, share):
    generator = np.random.default_rng(5)
    row = contact_table((contact(link=link, frame="motion", angle_deg=angle_deg),))[0]
    for _ in range(50):
        q, dq = generator.uniform(-3, 3, 2), generator.uniform(-2, 2, 2) * generator.choice([0.01, 1.0])
        speed_m_s = float(np.hypot(*velocity_of(link, 0.2, q, dq)))
        force_N = 20.0 * speed_m_s / math.hypot(speed_m_s, 0.01)
        found = contact_torque(row, 20.0, LENGTH_M, *q, *dq)
        assert np.array(found) @ dq == pytest.approx(share * force_N * speed_m_s, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize(
    ("changes", "impulse_N_s"),
    [
        ({"shape": "step"}, 1.0),
        ({"shape": "half_sine"}, 2.0 / math.pi),
        ({"shape": "push"}, 0.75),
        ({"shape": "push", "ramp_s": 0.02}, 0.6),
        ({"shape": "push", "ramp_s": 0.025}, 0.5),
    ],
)
def test_a_contact_gives_the_impulse_of_its_shape(changes, impulse_N_s):
    one = contact(**changes)
    times_s = np.linspace(0.0, one.duration_s, 5_001)
    forces_N = [contact_force(contact_table((one,))[0], elapsed_s) for elapsed_s in times_s]
    assert np.trapezoid(forces_N, times_s) == pytest.approx(impulse_N_s, rel=1e-5)
    assert max(forces_N) == pytest.approx(20.0)
    if one.shape != "step":
        assert (forces_N[0], forces_N[-1]) == (0.0, pytest.approx(0.0, abs=1e-12))


def test_onset_and_end_lie_on_the_drives_ticks():
    one = contact(at_s=10.00004, duration_s=0.25)
    assert (one.onset_tick, one.end_tick) == (100_000, 102_500)
    assert contact(at_s=0.3).onset_tick * TICK_S == pytest.approx(0.3, abs=1e-15)
