"""The emulated arm as the device nodes see it: timing, measurements, truth, braking."""

import dataclasses
import math

import numpy as np
import pytest
from general_arm import BRAKE, OFF, TORQUE, truth_of
from lab_arm import theta_of

from firmware_sim.arm.arms import ARMS
from firmware_sim.arm.touch_settings import ContactSettings
from firmware_sim.body.body import Body
from firmware_sim.scenario.scenario import PayloadSettings, Scenario, load_scenario


def step(at_s: float, **changes) -> ContactSettings:
    values = {"at_s": at_s, "link": 1, "point_m": 0.25, "force_N": 20.0, "duration_s": 0.05} | changes
    return ContactSettings(**values)


@pytest.mark.parametrize("profile", ARMS)
@pytest.mark.parametrize("payload_kg", [0.0, 1.0])
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_braking_drive_brings_every_arm_to_rest(profile, payload_kg, way):
    body = Body(Scenario(profile=profile, payload_kg=payload_kg, start_deg=(0.0, 40.0)))
    while abs(truth_of(body)["dq"][0]) < 2.5:
        body.advance((12.0, 3.0 * way), TORQUE)
    fastest = np.abs(truth_of(body)["dq"]).max()
    for _ in range(500):
        body.advance((12.0, 3.0), BRAKE)
        truth = truth_of(body)
        assert np.abs(truth["dq"]).max() < 1.05 * fastest
        assert np.all(np.abs(truth["tau_J"]) <= [12.0 + 1e-9, 6.0 + 1e-9])
    assert np.abs(truth_of(body)["dq"]).max() < 0.02
    for _ in range(300):
        body.advance((12.0, 3.0), BRAKE)
    rest = truth_of(body)
    assert rest["dq"].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(("ticks", "waited"), [(5, 70), (10, 70), (40, 70), (40, 20_000)])
def test_a_contact_acts_exactly_from_its_onset_to_its_end(ticks, waited):
    """tau_J is known, so what the arm does in the last period before the onset and in the first after it tells."""
    body = Body(Scenario(contacts=(step(0.02), step(0.1, link=2, point_m=0.2, angle_deg=-90.0))))
    body.advance((0.0, 0.0), OFF, waited)
    body.start_scenario()
    rows = []
    for tick in range(0, 1_600, ticks):
        truth = truth_of(body)
        if tick == 5 * ticks:
            body.start_scenario()  # again: without effect
        rows.append((tick, truth["contact_force"], truth["contact_link"], truth["contact_index"], truth["dq"][0]))
        body.advance((0.0, 0.0), OFF, ticks)
    for tick, force_N, link, index, dq1 in rows:
        first, second = 200 <= tick < 700, 1000 <= tick < 1500
        assert force_N == (20.0 if first or second else 0.0)
        assert link == (1.0 if first else 2.0 if second else 0.0)
        assert index == (0.0 if first else 1.0 if second else -1.0)
        assert (dq1 != 0.0) == (tick > 200)


def test_truth_tells_the_torque_of_the_contact_and_the_friction_that_holds_against_it():
    scenario = Scenario(profile="M", contacts=(step(0.0, force_N=0.4, duration_s=1.0),))
    body = Body(scenario)
    body.start_scenario()
    for _ in range(20):
        body.advance((0.02, 0.03), TORQUE)
    truth = truth_of(body)
    assert truth["dq"].tolist() == [0.0, 0.0]
    assert truth["tau_ext"] == pytest.approx([0.1, 0.0], abs=1e-15)
    assert truth["tau_friction"] == pytest.approx([0.12, 0.03], rel=1e-9)


def test_truth_tells_the_parameters_with_payload():
    scenario = dataclasses.replace(
        load_scenario("idle"), payloads=(PayloadSettings(0.005, 1.0), PayloadSettings(0.008, 0.0))
    )
    body = Body(scenario)
    for cycle in range(-7, 12):
        if cycle == 0:
            body.start_scenario()
        payload_kg = 1.0 if 5 <= cycle < 8 else 0.0
        truth = truth_of(body)
        assert truth["payload"] == payload_kg
        assert truth["theta"] == pytest.approx(theta_of(ARMS["P"], payload_kg), rel=1e-14)
        body.advance((0.0, 0.0), OFF)


def test_asking_for_the_truth_changes_nothing():
    ends = []
    for is_asked in (True, False):
        body = Body(load_scenario("paper", profile="M"))
        body.start_scenario()
        for cycle in range(200):
            if is_asked:
                truth_of(body)
            body.advance((math.sin(0.02 * cycle), 0.3), TORQUE)
        ends.append((body.sample(), list(map(bytes, truth_of(body).values()))))
    assert ends[0] == ends[1]
