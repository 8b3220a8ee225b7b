"""Bodies in the arm's way: blows against closed forms, balances of energy and momentum, clamping, coming and going."""

import math

import numpy as np
import pytest
from general_arm import TouchedArm, normal_of, point_of
from reaction_campaign import limit_N

from firmware_sim.arm.touch_forces import touch
from firmware_sim.arm.touch_settings import (
    BODY_REGIONS,
    TICK_S,
    BodySettings,
    ContactSettings,
)
from firmware_sim.body.body import largest_rate_rad_s, touch_table

POSE = (0.3, 0.7)
SOFT = {"mass_kg": 1.5, "stiffness_N_m": 2000.0}


def beside(
    link: int = 2, point_m: float = 0.2, side: int = 1, away_m: float = 1e-9, q=POSE, **settings
) -> BodySettings:
    """Put a body beside a point of a link, its surface `away_m` off."""
    reach_m = away_m + settings.get("radius_m", 0.0)
    center = point_of(link, point_m, q) + side * reach_m * normal_of(link, q)
    values = {"at_s": 0.0, "link": link, "x_m": float(center[0]), "y_m": float(center[1])} | settings
    return BodySettings(**values)


def toward(link: int, point_m: float, velocity_m_s, q=POSE) -> np.ndarray:
    """Joint velocities that give a link's point this velocity, the other link still if link 1 is meant."""
    jacobian = TouchedArm(q=q).jacobian(link, point_m, q)
    if link == 1:
        return np.array([float(np.linalg.lstsq(jacobian[:, :1], velocity_m_s, rcond=None)[0][0]), 0.0])
    return np.linalg.solve(jacobian, velocity_m_s)


def strike(body: BodySettings, point_m: float, side: int = 1, speed_m_s: float = 0.01, **arm) -> TouchedArm:
    dq = toward(body.link, point_m, side * speed_m_s * normal_of(body.link, POSE))
    return TouchedArm(q=POSE, dq=dq, bodies=(body,), **arm)


def reduced_mass(arm: TouchedArm, body: BodySettings, point_m: float) -> float:
    return 1.0 / (1.0 / body.mass + arm.mobility(body.link, point_m, POSE, normal_of(body.link, POSE)))


# Blows of 10 mm/s move the arm so little that its effective mass is constant; the model is linear in the speed.
BLOWS = [
    ("P", 2, 0.2, 1, {"region": "skull_forehead"}),
    ("P", 1, 0.25, 1, {"region": "chest"}),
    ("M", 1, 0.30, -1, {"mass_kg": 0.3, "stiffness_N_m": 5e4, "radius_m": 0.05}),
]


@pytest.mark.long
@pytest.mark.parametrize(("profile", "link", "point_m", "side", "kind"), BLOWS)
def test_an_elastic_blow_has_the_force_time_and_speeds_of_two_masses(profile, link, point_m, side, kind):
    body = beside(link, point_m, side, **kind)
    arm = strike(body, point_m, side, profile=profile, substeps=2)
    mass_kg = reduced_mass(arm, body, point_m)
    rate_rad_s = math.sqrt(body.stiffness / mass_kg)
    seen = arm.play(2.0 * math.pi / rate_rad_s)
    touched = seen["force"] > 0.0
    assert seen["force"].max() == pytest.approx(0.01 * math.sqrt(body.stiffness * mass_kg), rel=2e-3)
    assert np.count_nonzero(touched) * TICK_S == pytest.approx(math.pi / rate_rad_s, abs=1.5 * TICK_S)
    assert arm.own(0, "shift_rate_m_s")[-1] == pytest.approx(0.01 * 2.0 * mass_kg / body.mass, rel=1e-3)
    q, dq = arm.q, arm.dq
    after_m_s = side * normal_of(link, POSE) @ arm.jacobian(link, point_m, q) @ dq
    mobility = mass_kg * arm.mobility(link, point_m, POSE, normal_of(link, POSE))
    assert after_m_s == pytest.approx(0.01 * (1.0 - 2.0 * mobility), rel=5e-3)
    assert set(seen["link"][touched]) == {link}


def test_a_damped_blow_has_the_restitution_of_spring_and_damper_that_part_without_pull():
    """δ = (v/ω_d) e^(−ζωt) sin ω_d t; they part where K δ + c δ̇ = 0."""
    damping_ratio = 0.2
    bare = beside(**SOFT)
    mass_kg = reduced_mass(TouchedArm(q=POSE), bare, 0.2)
    rate = math.sqrt(2000.0 / mass_kg)
    body = beside(**SOFT, damping_N_s_m=2.0 * damping_ratio * mass_kg * rate)
    arm = strike(body, 0.2, substeps=4, speed_m_s=0.001)
    arm.play(1.2 * math.pi / rate)
    damped = math.sqrt(1.0 - damping_ratio**2)
    parting = math.pi - math.atan2(2.0 * damping_ratio * damped, 1.0 - 2.0 * damping_ratio**2)
    restitution = math.exp(-damping_ratio / damped * parting)
    assert arm.own(0, "shift_rate_m_s")[-1] == pytest.approx(0.001 * (1.0 + restitution) * mass_kg / 1.5, rel=2e-3)


@pytest.mark.parametrize("damping_N_s_m", [0.0, 3000.0])
@pytest.mark.parametrize("side", [1, -1])
def test_a_body_pushes_the_arm_off_and_never_pulls_it(side, damping_N_s_m):
    body = beside(1, 0.25, side, **SOFT, damping_N_s_m=damping_N_s_m)
    arm = strike(body, 0.25, side, speed_m_s=0.5, motor=(side * 0.5, 0.0), substeps=2)
    seen = arm.play(0.3)
    assert (side * seen["tau1"]).max() <= 0.0
    assert (side * seen["tau1"]).min() < -1.0
    assert arm.own(0, "shift_m")[-1] > 0.0


@pytest.mark.parametrize("link", [1, 2])
@pytest.mark.parametrize("side", [1, -1])
def test_a_bodys_torque_is_that_of_its_springs_force(link, side):
    generator = np.random.default_rng(5)
    for _ in range(30):
        q = generator.uniform(-2.5, 2.5, 2)
        point_m, depth_m = generator.uniform(0.02, 0.28), generator.uniform(0.0005, 0.01)
        body = beside(link, point_m, side, 1e-6, q, region="chest", radius_m=0.02)
        arm = TouchedArm(q=q, bodies=(body,))
        arm.play(TICK_S)
        # The link turns into the body until its surface is `depth_m` in.
        turn = 2.0 * side * depth_m / point_m
        bent = (q[0] + turn, q[1]) if link == 1 else (q[0], q[1] + turn)
        found = touch(arm.things, 0.0, *bent, 0.0, 0.0, arm.touch_state, np.zeros_like(arm.touch_state))
        normal = side * normal_of(link, bent)
        off = np.array([body.x_m, body.y_m]) - point_of(link, 0.0, bent)
        deep_m, place_m = 0.02 - off @ normal, side * off @ np.array([normal[1], -normal[0]])
        assert deep_m > 0.0
        torque_Nm = arm.jacobian(link, place_m, bent).T @ (-25_000.0 * deep_m * normal)
        assert found == pytest.approx(tuple(torque_Nm), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("region", ["hand_finger", "chest"])
def test_a_clamped_body_is_pressed_with_the_force_that_the_motor_gives(region):
    body = beside(1, 0.25, region=region, clamped=True)
    arm = TouchedArm(q=POSE, motor=(8.0, 0.0), damping=0.6, bodies=(body,))
    seen = arm.play(3.0)
    assert seen["force"][-1] == pytest.approx(8.0 / 0.25, rel=1e-3)
    deep_m = float((point_of(1, 0.25, arm.q) - np.array([body.x_m, body.y_m])) @ normal_of(1, arm.q))
    assert deep_m == pytest.approx(32.0 / body.stiffness, rel=5e-3)
    assert abs(arm.own(0, "shift_m")).max() == 0.0
    assert seen["energy"][-1] == pytest.approx(0.5 * 32.0**2 / body.stiffness, rel=5e-3)


def test_a_body_with_a_wall_behind_it_is_pushed_up_to_the_wall_and_clamped_there():
    body = beside(1, 0.25, region="hand_finger", gap_m=0.02)
    arm = TouchedArm(q=POSE, motor=(5.0, 0.0), damping=0.6, substeps=8, bodies=(body,))
    seen = arm.play(3.0)
    shift_m = arm.own(0, "shift_m")
    fastest_m_s = arm.own(0, "shift_rate_m_s").max()
    assert fastest_m_s > 0.1
    # No further than one integration step beyond the wall, and no creeping into it.
    assert 0.02 <= shift_m.max() <= 0.02 + fastest_m_s * TICK_S / 8
    assert shift_m[-1] == shift_m.max()
    assert seen["force"][-1] == pytest.approx(5.0 / math.hypot(0.25, 0.02), rel=1e-3)


def test_a_body_moves_only_in_its_free_direction():
    """60° beside the normal a blow pushes the body with a cosine of ½: its mass seems 4 times as large."""
    angle_deg = math.degrees(sum(POSE)) + 90.0 + 60.0
    body = beside(2, 0.2, mass_kg=0.5, stiffness_N_m=1e5, free_deg=angle_deg)
    arm = strike(body, 0.2, substeps=2)
    arm.play(0.03)
    mass_kg = 1.0 / (0.25 / 0.5 + arm.mobility(2, 0.2, POSE, normal_of(2, POSE)))
    assert arm.own(0, "shift_rate_m_s")[-1] == pytest.approx(0.5 * 2.0 * 0.01 * mass_kg / 0.5, rel=2e-3)


def test_a_body_in_the_arms_place_waits_until_the_arm_has_gone():
    body = beside(2, 0.2, 1, -0.02, region="chest", at_s=0.01, radius_m=0.05)
    arm = strike(body, 0.2, -1, speed_m_s=0.5)
    seen = arm.play(0.3)
    assert seen["force"].max() == 0.0
    assert (seen["index"] == -1.0).all()
    assert arm.own(0, "presence")[150] == 0.0
    assert arm.own(0, "presence")[-1] == 1.0


def test_the_energy_of_a_second_touch_counts_from_its_own_beginning():
    first = beside(1, 0.25, 1, 0.01, region="chest", duration_s=0.2)
    second = beside(1, 0.25, -1, 0.01, region="chest", at_s=0.0)
    arm = strike(first, 0.25, speed_m_s=0.3, damping=0.02)
    arm = TouchedArm(q=POSE, dq=arm.dq, damping=0.02, bodies=(first, second))
    seen = arm.play(0.6)
    one, two = seen["index"] == 0.0, seen["index"] == 1.0
    assert (np.count_nonzero(one) > 20, np.count_nonzero(two) > 20) == (True, True)
    between = (np.arange(one.size) > np.flatnonzero(one)[-1]) & (np.arange(one.size) < np.flatnonzero(two)[0])
    assert abs(seen["energy"][between]).max() == 0.0
    assert abs(seen["energy"][two][0]) < 0.1 * seen["energy"][two].max()


def test_a_link_that_came_round_the_body_touches_it_from_its_new_side():
    """Link 2 is drawn back past a body beyond its tip; what counts is where the body is when it is alongside again."""
    body = BodySettings(at_s=0.0, link=2, x_m=0.66, y_m=0.05, region="chest", radius_m=0.005)
    arm = TouchedArm(q=(0.0, 0.0), bodies=(body,))
    arm.play(TICK_S)
    side_before = arm.own(0, "side")[-1]
    arm.q[:] = 0.2, 0.0
    arm.play(TICK_S)
    arm.play(TICK_S)
    assert (side_before, arm.own(0, "side")[-1]) == (1.0, -1.0)


def test_a_deep_push_does_not_throw_the_body_through_the_link():
    body = beside(1, 0.25, mass_kg=500.0, stiffness_N_m=300.0, radius_m=0.01)
    arm = strike(body, 0.25, speed_m_s=0.5)
    seen = arm.play(0.3)
    assert seen["force"].max() > 2.0 * 300.0 * 0.01
    assert seen["tau1"].max() <= 0.0
    assert seen["dq1"][-1] < 0.0


@pytest.mark.parametrize(("profile", "region"), [("P", "skull_forehead"), ("M", "abdomen")])
def test_the_largest_rate_bounds_every_pose_and_is_reached_in_one(profile, region):
    rig = TouchedArm(profile=profile)
    for link in (1, 2):
        body = BodySettings(at_s=1.0, link=link, x_m=9.0, y_m=9.0, region=region, damping_N_s_m=1.0)
        bound = largest_rate_rad_s(touch_table(TouchedArm(profile=profile, bodies=(body,)).scenario))
        generator = np.random.default_rng(2)
        rates = []
        for _ in range(1000):
            q = generator.uniform(-3.1, 3.1, 2)
            turn = generator.uniform(-3.1, 3.1)
            point_m = generator.uniform(0.0, (0.35, 0.30)[link - 1])
            mobility = rig.mobility(link, point_m, q, (math.cos(turn), math.sin(turn)))
            rates.append(math.sqrt(body.stiffness * (mobility + 1.0 / body.mass)))
        assert 0.85 * bound < max(rates) < 1.0001 * bound


def test_things_that_are_never_there_together_do_not_add_up():
    body = {"link": 1, "x_m": 9.0, "y_m": 9.0, "region": "face"}
    one = BodySettings(at_s=0.0, duration_s=1.0, **body)
    later, also = BodySettings(at_s=1.0, **body), BodySettings(at_s=0.5, **body)
    alone = largest_rate_rad_s(TouchedArm(bodies=(one,)).things)
    assert largest_rate_rad_s(TouchedArm(bodies=(one, later)).things) == pytest.approx(alone)
    assert largest_rate_rad_s(TouchedArm(bodies=(one, also)).things) == pytest.approx(math.sqrt(2.0) * alone)


def test_the_strongest_of_several_is_reported_with_its_place_in_the_scenario():
    bodies = (beside(1, 0.2, stiffness_N_m=1000.0, mass_kg=10.0), beside(1, 0.2, stiffness_N_m=3000.0, mass_kg=10.0))
    contact = ContactSettings(at_s=99.0, link=1, point_m=0.1, force_N=1.0, duration_s=1.0)
    dq = toward(1, 0.2, 0.2 * normal_of(1, POSE))
    seen = TouchedArm(q=POSE, dq=dq, bodies=bodies, contacts=(contact,)).play(0.02)
    assert set(seen["index"][2:]) == {2.0}
    assert seen["tau1"][100] == pytest.approx(-0.2 * seen["force"][100] * 4.0 / 3.0, rel=1e-3)


# ISO/TS 15066:2016: m_H kg and K N/mm of table A.3; F N of table A.2, quasi-static; whether a blow may be twice as
# strong.
STANDARD = {
    "skull_forehead": (4.4, 150, 130, False),
    "face": (4.4, 75, 65, False),
    "neck": (1.2, 50, 150, True),
    "back_shoulder": (40, 35, 210, True),
    "chest": (40, 25, 140, True),
    "abdomen": (40, 10, 110, True),
    "pelvis": (40, 25, 180, True),
    "upper_arm_elbow": (3, 30, 150, True),
    "lower_arm_wrist": (2, 40, 160, True),
    "hand_finger": (0.6, 75, 140, True),
    "thigh_knee": (75, 50, 220, True),
    "lower_leg": (75, 60, 130, True),
}


def test_the_body_regions_have_the_numbers_of_the_standard():
    found = {
        name: (row.mass_kg, row.stiffness_N_m / 1e3, limit_N(name, True), limit_N(name, False) is not None)
        for name, row in BODY_REGIONS.items()
    }
    assert found == STANDARD
    assert limit_N("chest", False) == 280.0
