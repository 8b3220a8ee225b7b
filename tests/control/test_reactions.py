"""What an arm does about a contact: the desired motion of each reaction, and arms that meet people and walls."""

import numpy as np
import pytest
from contact_rig import Rig, Sample, reports, rig_settings
from desired_motion import START_DEG, Desired

from adacd_hil.control.controller import Floating
from adacd_hil.control.motions import Admittance, corner_to_corner
from adacd_hil.records import ContactKind, Reaction, SchemeState, Vector
from adacd_hil.settings.configuration import Settings
from firmware_sim.arm.touch_settings import BodySettings, ContactSettings
from firmware_sim.scenario.scenario import Scenario

PERIOD_S = 1e-3


def reacting(collision: str, contact: str = "stop", **more: object) -> Settings:
    wishes = {"contact": [contact] * 2, "collision": [collision] * 2, "start": "measured", "rebound_s": 0.2, **more}
    return rig_settings(reaction=wishes)


def monitoring(settings: Settings, cycles: int = 500) -> Desired:
    desired = Desired(settings)
    desired.step(SchemeState.MONITOR, cycles=cycles)
    return desired


@pytest.mark.parametrize("reaction", [Reaction.STOP, Reaction.WITHDRAW, Reaction.ADMITTANCE, Reaction.SLOW_DOWN])
def test_no_reaction_jumps(reaction: Reaction) -> None:
    desired = monitoring(reacting("stop"))
    before = np.array([[desired.q_d.copy(), desired.dq_d.copy(), desired.ddq_d.copy()]])
    course = np.concatenate([before, desired.step(SchemeState.REACT, reaction, (-3.0, 2.0), 400)])
    assert np.abs(np.diff(course[:, 0], axis=0)).max() < 2.5 * PERIOD_S
    assert np.abs(np.diff(course[:, 1], axis=0)).max() < np.radians(2000.0) * PERIOD_S


def test_a_stop_brakes_and_stays() -> None:
    desired = monitoring(reacting("stop"))
    course = desired.step(SchemeState.REACT, Reaction.STOP, (-3.0, 2.0), 400)
    assert np.abs(course[-1, 1]).max() == 0.0
    assert np.all(np.diff(course[:, 0], axis=0) >= 0.0)


def test_an_arm_that_slows_down_keeps_to_its_path_and_comes_back_to_speed() -> None:
    settings = reacting("stop", slow_share=0.25)
    undisturbed = monitoring(settings, 3000)
    path = monitoring(settings, 1).step(SchemeState.MONITOR, cycles=3000)[:, 0]
    desired = monitoring(settings, 400)
    slow = desired.step(SchemeState.REACT, Reaction.SLOW_DOWN, cycles=500)
    fast = desired.step(SchemeState.MONITOR, cycles=500)
    distance = [np.abs(path - row).sum(axis=1).min() for row in np.concatenate([slow, fast])[::50, 0]]
    assert max(distance) < 2e-3
    np.testing.assert_allclose(slow[300, 0] - slow[299, 0], slow[300, 1] * PERIOD_S, rtol=0.05, atol=1e-6)
    lost = 0.75 * 0.5
    behind = monitoring(settings, 1400 - round(lost / PERIOD_S))
    np.testing.assert_allclose(desired.q_d, behind.q_d, atol=2e-3)
    assert np.any(undisturbed.q_d != desired.q_d)


def test_another_reaction_takes_over_from_where_the_arm_is() -> None:
    desired = monitoring(reacting("withdraw"))
    desired.step(SchemeState.REACT, Reaction.STOP, (-3.0, 2.0), 30)
    before = desired.q_d.copy()
    course = desired.step(SchemeState.REACT, Reaction.WITHDRAW, (-3.0, 2.0), 600)
    assert np.abs(course[0, 0] - before).max() < 2e-3
    assert course[-1, 0, 0] < before[0]
    assert np.abs(course[-1, 1]).max() == 0.0


def test_a_blow_that_ends_is_followed() -> None:
    desired = monitoring(reacting("withdraw"))
    desired.step(SchemeState.REACT, Reaction.WITHDRAW, (-3.0, -1.0), 10)
    desired.follows = False
    desired.q, desired.dq = desired.q - 0.02, np.array([-2.0, -4.0])
    pushed = desired.step(SchemeState.REACT, Reaction.WITHDRAW, (-3.0, -1.0), 3)
    assert np.abs(pushed[-1, 0] - desired.q).max() > 0.01
    thrown = desired.step(SchemeState.REACT, Reaction.WITHDRAW, (-0.5, -0.1), 1)
    np.testing.assert_allclose(thrown[0, 0], desired.q, atol=5e-3)
    np.testing.assert_allclose(thrown[0, 1], desired.dq, atol=0.1)


def test_an_arm_that_learns_resists_a_push_whose_torque_it_forgets() -> None:
    desired = Desired(reacting("withdraw"))
    desired.step(SchemeState.CERTIFY, cycles=500)
    desired.step(SchemeState.REACT, Reaction.WITHDRAW, (-3.0, -1.0), 10)
    desired.follows = False
    desired.q, desired.dq = desired.q - 0.02, np.array([-2.0, -4.0])
    course = desired.step(SchemeState.REACT, Reaction.WITHDRAW, (-0.05, -0.02), 50)
    assert np.abs(course[:, 0] - desired.q).max(axis=1).min() > 0.01
    assert np.abs(course[:, 1]).max() < np.radians(120.0)


def test_a_run_that_ends_while_the_arm_reacts_does_not_move_it() -> None:
    desired = monitoring(reacting("stop"))
    desired.step(SchemeState.REACT, Reaction.STOP, (-3.0, 2.0), 20)
    moving = desired.dq_d.copy()
    desired.reference.park()
    braking = desired.step(SchemeState.REACT, Reaction.STOP, (-3.0, 2.0), 300)
    assert np.abs(braking[0, 1] - moving).max() < 0.02 < np.abs(moving).max()
    assert not desired.reference.is_parked(desired.cycle)
    course = desired.step(SchemeState.STOPPED, Reaction.STOP, cycles=300)
    assert np.ptp(course[:, 0], axis=0).max() == 0.0
    assert desired.reference.is_parked(desired.cycle)


def test_a_stop_acknowledged_while_the_arm_parks_parks_it() -> None:
    desired = monitoring(reacting("stop"))
    desired.reference.park()
    desired.step(SchemeState.MONITOR, cycles=100)
    stopped = desired.step(SchemeState.REACT, Reaction.STOP, (-3.0, 2.0), 300)
    assert np.abs(stopped[-1, 1]).max() == 0.0
    assert not desired.reference.is_parked(desired.cycle)
    desired.step(SchemeState.STOPPED, Reaction.STOP, cycles=100)
    course = desired.step(SchemeState.MONITOR, cycles=4000)
    np.testing.assert_allclose(course[-1, 0], np.radians(START_DEG), atol=1e-9)
    assert desired.reference.is_parked(desired.cycle)


def floating_torque(dq: tuple[float, float], q: tuple[float, float] = (0.0, 0.0), **more: object) -> Vector:
    """Return the torque of an arm that has come to rest and is then pushed along."""
    floating = Floating(reacting("float", **more))
    tau_d = np.zeros(2)
    floating.torque(np.zeros(2), np.zeros(2), np.zeros(2), THETA, tau_d)
    floating.torque(np.array(q), np.array(dq), np.sign(dq), THETA, tau_d)
    return tau_d


THETA = np.array([0.2, 0.03, 0.02, 0.5, 0.3, 0.4, 0.2])


def test_a_floating_arm_compensates_a_part_of_its_friction_and_is_damped() -> None:
    expected = 0.7 * (0.5 * 0.5 + 0.4) - 1.0 * 0.5
    assert floating_torque((0.5, 0.0))[0] == pytest.approx(expected, abs=1e-3)


def test_a_floating_arm_never_pushes_more_than_friction_takes() -> None:
    for speed in np.linspace(-4.0, 4.0, 41):
        tau_d = floating_torque((speed, speed))
        friction = THETA[3:5] * speed + THETA[5:7] * np.tanh(speed / 0.05)
        assert np.all(tau_d * np.sign(speed) <= np.abs(friction) + 1e-12)


def test_a_floating_arm_first_brakes_what_it_was_doing() -> None:
    settings = reacting("float")
    floating, tau_d = Floating(settings), np.zeros(2)
    floating.torque(np.zeros(2), np.array([1.5, 1.5]), np.array([-2.0, 2.0]), np.zeros(7), tau_d)
    assert tau_d[0] == pytest.approx(-settings.controller.Kd[0] * 1.5)
    assert tau_d[1] == pytest.approx(-settings.reaction.damping_Nm_s[1] * 1.5)


def test_a_floating_arm_resists_beyond_its_speed_and_position_limits() -> None:
    slow, fast = floating_torque((1.0, 0.0))[0], floating_torque((1.5, 0.0))[0]
    assert fast < slow - 10.0
    inside, outside = floating_torque((0.0, 0.0), (0.0, 2.0))[1], floating_torque((0.0, 0.0), (0.0, 2.1))[1]
    assert outside < inside == 0.0


def yielding(tau: tuple[float, float], cycles: int, dq_d: tuple[float, float] = (0.0, 0.0)) -> tuple[Vector, Vector]:
    admittance = Admittance(reacting("admittance"))
    q, dq, ddq = np.zeros(2), np.array(dq_d), np.zeros(2)
    for _ in range(cycles):
        admittance.step(np.array(tau), q, dq, ddq)
    return q, dq


def test_a_virtual_mass_comes_to_the_speed_that_its_damper_allows() -> None:
    wish = reacting("admittance").reaction
    _, dq = yielding((1.2, -0.4), 1000)
    np.testing.assert_allclose(dq, [1.0 / wish.drag_Nm_s[0], -0.3 / wish.drag_Nm_s[1]], rtol=1e-3)


def test_a_virtual_mass_has_bounds() -> None:
    settings = reacting("admittance")
    _, dq = yielding((50.0, 50.0), 300)
    assert np.all(dq <= np.radians(settings.reaction.yield_limit_deg_s))
    q, dq = yielding((50.0, 50.0), 8000)
    bound = settings.arm.position_limit_rad - np.radians(settings.reaction.position_margin_deg)
    np.testing.assert_allclose(q, bound, atol=2e-3)


def test_a_virtual_mass_that_nobody_pushes_brakes() -> None:
    limit = np.radians(reacting("admittance").reaction.acceleration_limit_deg_s2[0])
    _, dq = yielding((0.1, 0.0), 10, (1.0, 0.0))
    assert dq[0] == pytest.approx(1.0 - 10 * PERIOD_S * limit)
    assert yielding((0.0, 0.0), 1000, (1.0, -1.0))[1] == pytest.approx([0.0, 0.0], abs=1e-6)


def forces(samples: list[Sample]) -> Vector:
    return np.array([sample.true("contact_force")[0] for sample in samples])


def meet(settings: Settings, duration_s: float = 1.5, **scenario: object) -> list[Sample]:
    return Rig(settings, Scenario(start_deg=START_DEG, seed=7, **scenario)).run(duration_s)  # type: ignore[arg-type]


CHEST = BodySettings(at_s=0.3, link=2, x_m=0.531, y_m=0.077, region="chest")


def beside(lever_m: float, across_m: float, at_s: float) -> BodySettings:
    """Return a clamped arm of a person beside link 2's place 0.6 s after the start."""
    q, dq, ddq = np.zeros(2), np.zeros(2), np.zeros(2)
    corner_to_corner(0.6, np.radians([30.0, 60.0]), np.array([1.125, 4.5]), q, dq, ddq)
    along = np.array([np.cos(q.sum()), np.sin(q.sum())])
    at = 0.35 * np.array([np.cos(q[0]), np.sin(q[0])]) + lever_m * along + across_m * np.array([-along[1], along[0]])
    return BodySettings(at_s=at_s, link=2, x_m=at[0], y_m=at[1], region="lower_arm_wrist", clamped=True, radius_m=0.01)


def test_a_clamp_is_recognised_and_not_pushed_open() -> None:
    bodies = (beside(0.25, 0.01, 0.2), beside(0.25, -0.035, 0.575))
    squeezed, held = (meet(reacting(name), 1.6, bodies=bodies) for name in ("withdraw", "stop"))
    (final,) = reports(squeezed)
    assert final.is_two_sided
    assert squeezed[-1].output.reaction is Reaction.FLOAT
    assert forces(squeezed)[-500:].max() < 1.0 < forces(held)[-500:].max()


def test_a_chest_throws_the_arm_back_without_a_fault_or_a_second_collision() -> None:
    samples = meet(reacting("withdraw"), bodies=(CHEST,))
    touching = np.flatnonzero(forces(samples) > 0.5)
    assert touching.size > 0
    assert np.diff(touching).max() < 20
    assert samples[-1].output.state is SchemeState.STOPPED


@pytest.mark.parametrize("is_clamped", [False, True])
def test_a_withdrawal_is_never_worse_than_a_stop(is_clamped: bool) -> None:
    body = BodySettings(at_s=0.3, link=2, x_m=0.531, y_m=0.077, region="abdomen", clamped=is_clamped)
    stop, withdrawal = (forces(meet(reacting(name), bodies=(body,))) for name in ("stop", "withdraw"))
    assert withdrawal.max() <= 1.01 * stop.max()
    assert withdrawal.sum() <= 1.01 * stop.sum()


def test_an_arm_that_slows_down_goes_on_when_the_contact_has_cleared() -> None:
    push = ContactSettings(at_s=0.6, link=1, point_m=0.3, force_N=2.0, duration_s=0.4, shape="push", ramp_s=0.1)
    samples = meet(reacting("stop", "slow_down", clear_s=0.2), contacts=(push,))
    states = [sample.output.state for sample in samples]
    assert SchemeState.REACT in states
    assert SchemeState.STOPPED not in states
    assert states[-1] is SchemeState.MONITOR
    assert min(abs(sample.true("dq")[0]) for sample in samples[700:900]) > 0.1
    (final,) = reports(samples)
    assert (final.link, final.kind, final.reaction) == (1, ContactKind.PUSH, Reaction.SLOW_DOWN)


def test_a_floating_arm_that_is_pushed_gives_way_and_comes_to_rest() -> None:
    push = ContactSettings(at_s=0.5, link=2, point_m=0.2, force_N=8.0, duration_s=0.5, shape="push", ramp_s=0.2)
    samples = meet(reacting("float", "float"), 2.0, contacts=(push,))
    q = np.array([sample.true("q") for sample in samples])
    dq = np.array([sample.true("dq") for sample in samples])
    assert q[1000, 1] > q[520, 1] + 0.2
    assert np.abs(dq[-1]).max() < 0.05
    assert np.abs(dq).max() < np.radians(300.0)
