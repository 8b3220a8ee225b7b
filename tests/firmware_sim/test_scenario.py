"""Scenarios: what can be said in TOML, what is refused, and whether the built-in ones do what they promise."""

import math

import pytest

from adacd_hil.settings.schema import ConfigError
from firmware_sim.scenario.scenario import load_scenario

CONTACT = "{ at_s = 1.0, link = 2, point_m = 0.2, force_N = 10.0, duration_s = 0.1 }"
LATER = "{ at_s = 2.0, link = 1, point_m = 0.2, force_N = 10.0, duration_s = 0.1 }"
OVERLAPPING = "{ at_s = 1.05, link = 1, point_m = 0.2, force_N = 10.0, duration_s = 0.1 }"


def test_the_paper_scenario_touches_each_link_both_ways_before_and_after_the_payload():
    contacts = load_scenario("paper").contacts
    ways = [(contact.link, math.copysign(1, contact.angle_deg)) for contact in contacts]
    assert ways == [(1, 1), (1, -1), (2, 1), (2, -1)] * 2
    assert [contact.at_s for contact in contacts] == [10, 13, 16, 19, 38, 41.4, 44, 47.4]


BODY = "at_s = 1.0, link = 2, x_m = 0.5, y_m = 0.3"
INSIDE = "at_s = 0.0, link = 2, x_m = 0.5, y_m = 0.01, radius_m = 0.03"
HAND = "at_s = 1.0, link = 2, duration_s = 1.0"
BODY_NEEDS = "a body needs a region, or mass_kg and stiffness_N_m"
FEW = "adaptations = 1, contacts = 0"
BROAD = "stop_damping_Nm_s = [1e4, 1e4]"
HIGH = "stop_high_deg = [9.0, 10.0]"
STRONG = CONTACT.replace("10.0", "101.0")
PAYLOAD = "{ at_s = 2.0, mass_kg = 1.0 }"
MOVED = "point_m = 0.2, move_to_m = [0.1, 0.2]"
WEAK = "continuous_torque_Nm = [5.0, 0.0], peak_torque_Nm = [5.0, 0.0]"

REFUSED = [
    ("profil = 'M'", "unknown key `profil`; did you mean `profile`?"),
    ('about = "one\\ntwo"', "`about` has 2 lines, 1 expected"),
    ("start_deg = [", "scenario.toml"),
    ("habits = [{ mode_s = 1.0 }]", "`habits` has 1 rows, 2 expected"),
    (f"contacts = [{CONTACT.replace('0.2', '0.31')}]", "`contacts[0].point_m` = 0.31 m is beyond the end of link 2"),
    (f"contacts = [{CONTACT}, {LATER.replace('0.2', '0.36')}]", "`contacts[1].point_m` = 0.36 m is beyond the end of"),
    (f"contacts = [{CONTACT}, {OVERLAPPING}]", "`contacts[1].at_s` = 1.05 s is before the end"),
    (f"contacts = [{CONTACT[:-2]}, ramp_s = 0.01 }}]", "ramp_s = 0.01 s belongs to shape 'push'"),
    (f"contacts = [{CONTACT[:-2]}, shape = 'push', ramp_s = 0.06 }}]", "ramp_s = 0.06 s is above half of duration_s"),
    (f"contacts = [{STRONG[:-2]}, frame = 'motion' }}]", "force_N = 101.0 N is above 100.0 N, the most with frame"),
    (f"payloads = [{PAYLOAD}, {PAYLOAD}]", "`payloads[1].at_s` = 2.0 s is not after the change before it at 2.0 s"),
    ("payloads = [{ at_s = 1.0, mass_kg = 0.0, center_m = [0.1, 0.0] }]", "`payloads[0].mass_kg` = 0 kg"),
    (f"bodies = [{{ {BODY}, region = 'hand_fingr' }}]", "did you mean 'hand_finger'?"),
    (f"bodies = [{{ {BODY} }}]", BODY_NEEDS),
    (f"bodies = [{{ {BODY}, mass_kg = 1.0 }}]", BODY_NEEDS),
    (f"bodies = [{{ {BODY}, region = 'face', mass_kg = 1.0 }}]", "mass_kg = 1.0 is given by region 'face'"),
    (f"bodies = [{{ {BODY}, region = 'face', clamped = true, gap_m = 0.1 }}]", "gap_m = 0.1 m: a clamped body"),
    (f"bodies = [{{ {INSIDE}, region = 'face' }}]", "is 0.02 m inside it"),
    (f"hands = [{{ {HAND}, point_m = 0.31 }}]", "`hands[0].point_m` = 0.31 m is beyond the end of link 2"),
    (f"hands = [{{ {HAND}, {MOVED}, direction_deg = 3.0 }}]", "direction_deg = 3.0 deg beside move_to_m"),
    ("walls = [{ x_m = 0.5, y_m = 0.3, normal_deg = 0.0 }]", "`walls[0]`: at at_s = 0 s the arm in its start pose"),
    ("mechanics = { stiffness_Nm_rad = [1000.0, 0.0] }", "needs a `rotor_inertia_kg_m2` above 0 kg m²"),
    ("mechanics = { backlash_rad = [0.0, 0.01] }", "`mechanics.backlash_rad[1]` = 0.01 needs a `stiffness_Nm_rad` ab"),
    ("mechanics = { damping_Nm_s = [1.0, 0.0] }", "`mechanics.damping_Nm_s[0]` = 1 needs a `stiffness_Nm_rad` above"),
    ("mechanics = { static_Nm = [0.03, 0.0] }", "`mechanics.static_Nm[0]` = 0.03 Nm is below the Coulomb friction of"),
    ("mechanics = { stop_low_deg = [-10.0, -10.0] }", "`mechanics.stop_low_deg` and `mechanics.stop_high_deg` come"),
    (f"mechanics = {{ stop_low_deg = [10.0, -10.0], {HIGH} }}", "`mechanics.stop_low_deg[0]` = 10 deg is not below"),
    (f"mechanics = {{ stop_low_deg = [5.0, -10.0], {HIGH} }}", "`start_deg[0]` = 0 deg is beyond the joint's stops"),
    (f"mechanics = {{ stop_low_deg = [-5.0, -10.0], {HIGH}, {BROAD} }}", "is above 160000 rad/s"),
    ("sensors = { hysteresis_Nm = [0.0, 6.0] }", "`sensors.hysteresis_Nm[1]` = 6.0 Nm is above half of its reach, 5"),
    ("sensors = { clock_error_ppm = [0.0, 20.0] }", "`sensors.sample_rate_Hz[1]` = 0.0 Hz leaves `clock_error_ppm`"),
    (f"drives = {{ {WEAK} }}", "`drives.continuous_torque_Nm[0]` = 5.0 Nm is not below `peak_torque_Nm` = 5.0 Nm"),
    ("drives = { derating_end_C = [140.0, 100.0] }", "`drives.derating_end_C[1]` = 100.0 °C is not above `derating_"),
    ("drives = { overheat_C = [110.0, 130.0] }", "`drives.overheat_C[0]` = 110.0 °C is not above `derating_start_C`"),
    ("expect = { adaptations = 1, contacts = 2, contacts_most = 1 }", "`expect.contacts_most` = 1 is below"),
    (f"expect = {{ {FEW}, fault = 'NONE' }}", "`expect.fault` = 'NONE' must be one of DATA_AGE"),
    (f"expect = {{ {FEW}, end = 'fault' }}", "`expect.end` = 'fault' lacks the key `expect.fault`"),
    (f"expect = {{ {FEW}, fault_s = [1.0, 2.0] }}", "`expect.fault_s` lacks the key `expect.fault`"),
    (f"expect = {{ {FEW}, adaptation_s = [6.0, 5.0] }}", "`expect.adaptation_s[1]` = 5 s is below"),
]


@pytest.mark.parametrize(("text", "message"), REFUSED)
def test_a_scenario_that_cannot_be_is_refused_in_one_line_with_its_key(tmp_path, text, message):
    path = tmp_path / "scenario.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as refusal:
        load_scenario(str(path))
    assert message in str(refusal.value)
    assert "scenario.toml" in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_contacts_that_follow_each_other_without_a_gap_are_accepted(tmp_path):
    path = tmp_path / "two.toml"
    path.write_text(f"contacts = [{CONTACT}, {OVERLAPPING.replace('1.05', '1.1')}]", encoding="utf-8")
    scenario = load_scenario(str(path))
    assert scenario.name == "two"
    assert len(scenario.contacts) == 2
