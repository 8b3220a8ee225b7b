"""Scenarios: what can be said in TOML, what is refused, and whether the built-in ones do what they promise."""

import math

import numpy as np
import pytest

from adacd_hil.settings.schema import ConfigError
from firmware_sim.arm.arms import ARMS
from firmware_sim.arm.touch_settings import contact_force, contact_table, contact_torque
from firmware_sim.scenario.scenario import builtin_scenarios, load_scenario

CONTACT = "{ at_s = 1.0, link = 2, point_m = 0.2, force_N = 10.0, duration_s = 0.1 }"
LATER = "{ at_s = 2.0, link = 1, point_m = 0.2, force_N = 10.0, duration_s = 0.1 }"
OVERLAPPING = "{ at_s = 1.05, link = 1, point_m = 0.2, force_N = 10.0, duration_s = 0.1 }"


def test_paper_and_idle_come_with_the_package():
    assert {"idle", "paper"} <= set(builtin_scenarios())


def test_nobody_touches_the_idle_arm():
    scenario = load_scenario("idle")
    assert (scenario.contacts, scenario.payloads, scenario.payload_kg) == ((), (), 0.0)
    assert (scenario.name, scenario.profile, scenario.noise) == ("idle", "P", True)


def test_profile_and_seed_of_the_caller_outweigh_the_file():
    scenario = load_scenario("paper", profile="M", seed=77)
    assert (scenario.profile, scenario.seed, scenario.arm) == ("M", 77, ARMS["M"])


def test_the_paper_scenario_starts_in_the_corner_of_the_motion():
    assert load_scenario("paper").start_rad == pytest.approx([-math.pi / 6, -math.pi / 3])


def test_the_paper_scenario_leaves_both_adaptations_alone():
    scenario = load_scenario("paper")
    assert [(change.at_s, change.mass_kg) for change in scenario.payloads] == [(26.5, 1.0)]
    for contact in scenario.contacts:
        assert 9.0 < contact.at_s < 24.0 or 36.0 < contact.at_s < 51.0


def test_the_paper_scenario_touches_each_link_both_ways_before_and_after_the_payload():
    contacts = load_scenario("paper").contacts
    ways = [(contact.link, math.copysign(1, contact.angle_deg)) for contact in contacts]
    assert ways == [(1, 1), (1, -1), (2, 1), (2, -1)] * 2
    assert [contact.at_s for contact in contacts] == [10, 13, 16, 19, 38, 41.4, 44, 47.4]


@pytest.mark.parametrize("index", range(8))
def test_every_contact_of_the_paper_scenario_is_well_above_the_threshold(index):
    contact = load_scenario("paper").contacts[index]
    row = contact_table((contact,))[0]
    sign = math.copysign(1, contact.angle_deg)
    for elbow_rad in np.radians(np.linspace(-68, 68, 35)):
        tau1, tau2 = contact_torque(row, contact_force(row, 0.0), 0.35, 0.1, elbow_rad, 0.0, 0.0)
        assert sign * tau1 >= 2.5
        if contact.link == 1:
            assert tau2 == 0.0
        else:
            assert sign * tau2 >= 1.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("profil = 'M'", "unknown key `profil`; did you mean `profile`?"),
        ("profile = 'X'", "`profile` = 'X' must be one of P, S, M"),
        ("seed = -1", "`seed` = -1 is below 0"),
        ("noise = 1", "`noise` = 1 must be of type bool"),
        ('about = "one\\ntwo"', "`about` has 2 lines, 1 expected"),
        ("lasts_s = 0.0", "`lasts_s` = 0.0 s is below 0.1 s"),
        ("start_deg = [0.0]", "`start_deg` has 1 values, 2 expected"),
        ("payload_kg = 21.0", "`payload_kg` = 21.0 kg is above 20 kg"),
        ("contacts = [{ at_s = 1.0 }]", "missing key `contacts[0].link`"),
        (f"contacts = [{CONTACT.replace('force_N', 'force_n')}]", "did you mean `contacts[0].force_N`?"),
        (
            f"contacts = [{CONTACT.replace('0.2', '0.31')}]",
            "`contacts[0].point_m` = 0.31 m is beyond the end of link 2",
        ),
        (
            f"contacts = [{CONTACT}, {LATER.replace('0.2', '0.36')}]",
            "`contacts[1].point_m` = 0.36 m is beyond the end of link 1 at 0.35 m",
        ),
        (f"contacts = [{CONTACT}, {OVERLAPPING}]", "`contacts[1].at_s` = 1.05 s is before the end"),
        (f"contacts = [{LATER}, {CONTACT}]", "`contacts[1].at_s` = 1.0 s is before the end"),
        (
            "payloads = [{ at_s = 2.0, mass_kg = 1.0 }, { at_s = 2.0, mass_kg = 0.0 }]",
            "`payloads[1].at_s` = 2.0 s is not after the change before it at 2.0 s",
        ),
        ("payloads = [{ at_s = 2.0, kg = 1.0 }]", "unknown key `payloads[0].kg`"),
        ("contacts = 3", "`contacts` = 3 must be a list"),
        ("start_deg = [", "scenario.toml"),
    ],
)
def test_a_scenario_that_cannot_be_is_refused_with_its_key(tmp_path, text, message):
    path = tmp_path / "scenario.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as refusal:
        load_scenario(str(path))
    assert message in str(refusal.value)
    assert "scenario.toml" in str(refusal.value)


def test_a_misspelt_scenario_is_answered_with_the_nearest_name():
    with pytest.raises(ConfigError, match="scenario 'papr' is neither built in nor a file; did you mean 'paper'"):
        load_scenario("papr")


def test_a_scenario_without_a_near_name_is_answered_with_some_names():
    with pytest.raises(ConfigError, match="built in: "):
        load_scenario("zzzzz")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"nowhere\.toml does not exist"):
        load_scenario(str(tmp_path / "nowhere.toml"))


def test_contacts_that_follow_each_other_without_a_gap_are_accepted(tmp_path):
    path = tmp_path / "two.toml"
    path.write_text(f"contacts = [{CONTACT}, {OVERLAPPING.replace('1.05', '1.1')}]", encoding="utf-8")
    scenario = load_scenario(str(path))
    assert scenario.name == "two"
    assert len(scenario.contacts) == 2
