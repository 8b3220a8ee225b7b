"""Hands that guide the arm, walls that stop it, what a prescribed force takes, and what a scenario may say of all."""

import dataclasses
import math

import numpy as np
import pytest
from general_arm import TORQUE, GeneralArm, TouchedArm, point_of, truth_of, without_friction

from firmware_sim.arm.hardware_settings import MechanicsSettings
from firmware_sim.arm.touch_forces import THING_STATE, TOUCH_HEADER, change_touch, touch
from firmware_sim.arm.touch_settings import (
    TICK_S,
    BodySettings,
    ContactSettings,
    HandSettings,
    WallSettings,
    contact_table,
)
from firmware_sim.body.body import Body, largest_rate_rad_s
from firmware_sim.scenario.scenario import Scenario

POSE = (0.3, 0.7)
FREE = MechanicsSettings(stop_low_deg=(-720.0, -720.0), stop_high_deg=(720.0, 720.0))


def kinetic_J(truth: dict[str, np.ndarray]) -> float:
    a1, a2, a3 = truth["theta"][:3]
    dq1, dq2 = truth["dq"]
    coupling = a2 * math.cos(truth["q"][1])
    return 0.5 * (a1 + 2.0 * coupling) * dq1**2 + (a3 + coupling) * dq1 * dq2 + 0.5 * a3 * dq2**2


def hand(**changes) -> HandSettings:
    values = {"at_s": 0.1, "duration_s": 3.0, "link": 2, "point_m": 0.30} | changes
    return HandSettings(**values)


@pytest.mark.long
def test_a_hand_guides_the_tip_along_a_line_and_stops_at_its_end():
    start = point_of(2, 0.3, POSE)
    end = start + np.array([-0.12, 0.05])
    arm = TouchedArm(q=POSE, damping=0.02, hands=(hand(move_to_m=tuple(end.tolist()), speed_m_s=0.1),))
    seen = arm.play(3.0)
    tips = point_of(2, 0.3, (seen["q1"], seen["q2"])).T
    assert tips[:1000] == pytest.approx(np.tile(start, (1000, 1)), abs=1e-12)
    way = (end - start) / 0.13
    # Half-way through its 1.3 s the tip follows the point that moves at 0.1 m/s, by what its friction takes to pull.
    behind = start + way * 0.1 * 0.65 - tips[7500]
    assert abs(behind @ np.array([-way[1], way[0]])) < 2e-3
    assert abs(behind @ way) < 5e-3
    assert tips[-1] == pytest.approx(end, abs=1e-4)
    assert np.hypot(*(tips[7500] - tips[7000])) == pytest.approx(0.1 * 0.05, rel=0.1)


def test_a_hand_lets_go_at_its_time():
    arm = TouchedArm(q=POSE, hands=(hand(duration_s=0.4, direction_deg=90.0, speed_m_s=0.2),))
    seen = arm.play(0.5)
    assert seen["index"].tolist() == [-1.0] * 1000 + [0.0] * 4000
    assert seen["force"].max() > 1.0
    assert seen["energy"][-1] == pytest.approx(-arm.energy_J(), rel=1e-3)
    later = arm.play(0.3)
    assert set(later["index"]) == {-1.0}
    assert not later["tau1"].any()


def test_a_hand_that_holds_takes_spring_force_both_ways_with_spring_and_damper():
    arm = TouchedArm(q=POSE, dq=(0.4, -0.2), hands=(hand(at_s=0.0, force_limit_N=1000.0),))
    start = point_of(2, 0.3, POSE)
    seen = arm.play(0.5)
    for tick in (1, 300, 1500, 4000):
        q, dq = (seen["q1"][tick], seen["q2"][tick]), np.array([seen["dq1"][tick], seen["dq2"][tick]])
        jacobian = arm.jacobian(2, 0.3, q)
        force = 400.0 * (start - point_of(2, 0.3, q)) - 40.0 * jacobian @ dq
        assert seen["force"][tick] == pytest.approx(np.hypot(*force), rel=1e-9)
        assert (seen["tau1"][tick], seen["tau2"][tick]) == pytest.approx(tuple(jacobian.T @ force), rel=1e-9)
    assert min(seen["tau1"]) < 0.0 < max(seen["tau1"])


def test_a_hand_is_never_stronger_than_its_limit():
    arm = TouchedArm(q=POSE, motor=(6.0, 2.0), hands=(hand(at_s=0.0, force_limit_N=12.0),))
    seen = arm.play(0.3)
    assert seen["force"].max() == pytest.approx(12.0, rel=1e-12)
    assert seen["force"][-1] == pytest.approx(12.0, rel=1e-12)
    start = point_of(2, 0.3, POSE)
    q, dq = arm.q, arm.dq
    pull = 400.0 * (start - point_of(2, 0.3, q)) - 40.0 * arm.jacobian(2, 0.3, q) @ dq
    change_touch(arm.things, 0.3, *q, arm.touch_state, False)
    found = touch(arm.things, 0.3, *arm.q, *arm.dq, arm.touch_state, np.zeros_like(arm.touch_state))
    assert found == pytest.approx(tuple(arm.jacobian(2, 0.3, q).T @ (12.0 * pull / np.hypot(*pull))), rel=1e-9)


def test_changes_that_are_asked_for_twice_at_an_instant_are_done_once():
    body = BodySettings(at_s=0.05, link=1, x_m=0.224, y_m=0.122, region="hand_finger", gap_m=0.005)
    wall = WallSettings(x_m=0.0, y_m=0.5, normal_deg=-90.0, at_s=0.02)
    arm = TouchedArm(
        q=POSE, dq=(1.0, 1.5), motor=(3.0, 0.0), hands=(hand(duration_s=0.05),), bodies=(body,), walls=(wall,)
    )
    presences, pressed = set(), 0
    for _ in range(400):
        arm.play(TICK_S * 8)
        body_now = arm.touch_state[TOUCH_HEADER:].view(THING_STATE)[0]
        pressed += arm.own(0, "shift_m")[-1] >= 0.005 and body_now["shift_rate_m_s"] > 0.0
        change_touch(arm.things, arm.tick * TICK_S, *arm.q, arm.touch_state, False)
        once = arm.touch_state.copy()
        change_touch(arm.things, arm.tick * TICK_S, *arm.q, arm.touch_state, False)
        assert arm.touch_state.tobytes() == once.tobytes()
        presences.add(tuple(arm.own(thing, "presence")[-1] for thing in range(3)))
    assert len(presences) >= 4
    assert pressed > 10


def wall_before(end: int, q, direction_deg: float, away_m: float = 1e-9, **changes) -> WallSettings:
    """Put a wall in front of a link's end, seen along a direction."""
    angle = math.radians(direction_deg)
    place = point_of(end, (0.35, 0.30)[end - 1], q) + away_m * np.array([math.cos(angle), math.sin(angle)])
    return WallSettings(x_m=float(place[0]), y_m=float(place[1]), normal_deg=direction_deg + 180.0, **changes)


def test_a_wall_holds_the_tip_against_the_motors():
    """Joint 2 presses with 1.5 Nm, and joint 1 is held by its motor as the wall's force asks."""
    q = (0.2, 0.4)
    direction_rad = sum(q) + 0.5 * math.pi
    wall = wall_before(2, q, math.degrees(direction_rad), stiffness_N_m=2e4)
    arm = TouchedArm(q=q, damping=0.3, walls=(wall,))
    direction = np.array([math.cos(direction_rad), math.sin(direction_rad)])
    arm.motor = arm.jacobian(2, 0.30, q).T @ direction * 1.5 / 0.30
    assert arm.motor[1] == pytest.approx(1.5)
    seen = arm.play(2.0)
    assert seen["force"][-1] == pytest.approx(1.5 / 0.30, rel=5e-3)
    beyond_m = direction @ (point_of(2, 0.30, arm.q) - np.array([wall.x_m, wall.y_m]))
    assert beyond_m == pytest.approx(1.5 / 0.30 / 2e4, rel=5e-3)
    assert set(seen["link"][10:]) <= {0.0, 2.0}
    assert seen["link"][-1] == 2.0
    assert np.hypot(*(arm.q - q)) < 0.02


@pytest.mark.parametrize(("damping_s_m", "speed_m_s"), [(0.0, 0.05), (2.0, 0.05), (10.0, 0.05), (60.0, 0.02)])
def test_a_wall_gives_back_the_speed_that_hunt_and_crossley_say(damping_s_m, speed_m_s):
    """v/χ − ln(1 + χ v)/χ² before is −v'/χ − ln(1 − χ v')/χ² after, whatever the mass is."""
    q = (0.2, -2.0)
    wall = wall_before(1, q, math.degrees(0.2) + 90.0, 1e-7, stiffness_N_m=1e6, damping_s_m=damping_s_m)
    arm = TouchedArm(q=q, dq=(speed_m_s / 0.35, -speed_m_s / 0.35), substeps=8, walls=(wall,))
    seen = arm.play(0.02)
    gone_m_s = -0.35 * seen["dq1"][-1]
    before = 0.5 * speed_m_s**2
    after = 0.5 * gone_m_s**2
    if damping_s_m > 0.0:
        before = speed_m_s / damping_s_m - math.log1p(damping_s_m * speed_m_s) / damping_s_m**2
        after = -gone_m_s / damping_s_m - math.log1p(-damping_s_m * gone_m_s) / damping_s_m**2
    assert np.count_nonzero(seen["force"]) > 5
    assert gone_m_s < speed_m_s * (1.001 if damping_s_m == 0.0 else 0.95)
    assert after == pytest.approx(before, rel=5e-3)


def test_a_wall_stops_the_ends_of_links_and_lets_their_middles_through():
    between = WallSettings(x_m=0.0, y_m=0.1, normal_deg=-90.0)
    arm = TouchedArm(q=(0.0, 0.0), dq=(1.0, 0.0), walls=(between,))
    seen = arm.play(0.25)
    tip_y = point_of(2, 0.3, (seen["q1"], seen["q2"]))[1]
    assert tip_y.max() < 0.105
    assert set(seen["link"]) == {0.0, 2.0}


def test_the_largest_rate_of_wall_and_hand_is_that_of_their_points():
    rig = TouchedArm()
    bends = np.linspace(0.0, math.pi, 101)
    turns = np.linspace(0.0, math.pi, 181)
    tip = max(rig.mobility(2, 0.3, (0.0, bend), (math.cos(a), math.sin(a))) for bend in bends for a in turns[::4])
    elbow = max(rig.mobility(1, 0.35, (0.0, bend), (0.0, 1.0)) for bend in bends)
    wall = WallSettings(x_m=9.0, y_m=9.0, normal_deg=180.0, stiffness_N_m=2e4, damping_s_m=0.4)
    found = largest_rate_rad_s(TouchedArm(walls=(dataclasses.replace(wall, at_s=1.0),)).things)
    assert found == pytest.approx(math.sqrt(2e4 * max(tip, elbow)), rel=2e-3)
    stiff = largest_rate_rad_s(TouchedArm(hands=(hand(damping_N_s_m=0.0),)).things)
    assert stiff == pytest.approx(math.sqrt(400.0 * tip), rel=2e-3)
    assert largest_rate_rad_s(TouchedArm(hands=(hand(),)).things) == pytest.approx(40.0 * tip, rel=2e-3)


PRESCRIBED = [
    {"link": 2, "point_m": 0.2, "force_N": 20.0, "shape": "step"},
    {"link": 1, "point_m": 0.3, "force_N": 30.0, "shape": "half_sine", "angle_deg": -60.0},
    {"link": 2, "point_m": 0.3, "force_N": 15.0, "shape": "push", "frame": "world"},
    {"link": 2, "point_m": 0.2, "force_N": 3.0, "frame": "motion", "angle_deg": 0.0},
    {"link": 2, "point_m": 0.2, "force_N": 3.0, "frame": "motion", "angle_deg": 180.0},
]


@pytest.mark.parametrize("changes", PRESCRIBED)
def test_a_prescribed_force_gives_the_arm_the_energy_that_is_logged(changes):
    """The first 0.1 s are free; the arm moves then where the force goes by its motion."""
    contact = ContactSettings(at_s=0.1, duration_s=0.05, **changes)
    own = dataclasses.replace(without_friction("P"), rated_torque_Nm=(12.0, 6.0))
    scenario = Scenario(own_arm=own, start_deg=(20.0, 40.0), contacts=(contact,), mechanics=FREE)
    truths, body = [], Body(scenario)
    body.start_scenario()
    for tick in range(1_600):
        truths.append(truth_of(body))
        body.advance((0.5, -0.2) if tick < 800 else (0.0, 0.0), TORQUE, 1)
    before, during, after = truths[999], truths[1_000:1_500], truths[1_500]
    gained_J = kinetic_J(after) - kinetic_J(before)
    assert abs(gained_J) > 0.005
    assert during[-1]["contact_energy"][0] == pytest.approx(-gained_J, rel=0.02)
    assert TICK_S * sum(truth["contact_power"][0] for truth in during) == pytest.approx(-gained_J, rel=0.02)
    assert {(truth["contact_link"][0], truth["contact_index"][0]) for truth in during} == {(changes["link"], 0.0)}
    assert (after["contact_energy"][0], after["contact_force"][0], after["contact_index"][0]) == (0.0, 0.0, -1.0)
    if changes.get("frame") == "motion":
        assert max(truth["contact_force"][0] for truth in during) < 3.0
        assert np.sign(gained_J) == (1.0 if changes["angle_deg"] == 0.0 else -1.0)


def test_the_strongest_hand_that_drags_brings_the_arm_to_rest_without_a_tremor():
    drag = ContactSettings(
        at_s=0.0, link=2, point_m=0.3, force_N=100.0, duration_s=1.0, frame="motion", angle_deg=180.0
    )
    substeps = Body(Scenario(contacts=(drag,))).parts.substeps
    arm = GeneralArm(without_friction("P"), q=(0.3, 1.5), dq=(0.3, -1.0), substeps=substeps)
    before_J = arm.energy_J()
    energies_J = []
    for _ in range(500):
        arm.run(1, contact=contact_table((drag,)))
        energies_J.append(arm.energy_J())
    assert np.diff(energies_J).max() <= 0.0
    assert energies_J[-1] < 1e-9 * before_J
