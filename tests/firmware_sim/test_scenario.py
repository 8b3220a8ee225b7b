"""Scenarios: what can be said in TOML, what is refused, and whether the built-in ones do what they promise."""

import math

import pytest

from adacd_hil.settings.schema import ConfigError
from firmware_sim.arm.arms import ARMS
from firmware_sim.scenario.scenario import load_scenario

CONTACT = "{ at_s = 1.0, link = 2, point_m = 0.2, force_N = 10.0, duration_s = 0.1 }"
LATER = "{ at_s = 2.0, link = 1, point_m = 0.2, force_N = 10.0, duration_s = 0.1 }"
OVERLAPPING = "{ at_s = 1.05, link = 1, point_m = 0.2, force_N = 10.0, duration_s = 0.1 }"


def test_nobody_touches_the_idle_arm():
    scenario = load_scenario("idle")
    assert (scenario.contacts, scenario.payloads, scenario.payload_kg) == ((), (), 0.0)
    assert (scenario.name, scenario.profile, scenario.noise) == ("idle", "P", True)


def test_profile_and_seed_of_the_caller_outweigh_the_file():
    scenario = load_scenario("paper", profile="M", seed=77)
    assert (scenario.profile, scenario.seed, scenario.arm) == ("M", 77, ARMS["M"])


def test_the_paper_scenario_touches_each_link_both_ways_before_and_after_the_payload():
    contacts = load_scenario("paper").contacts
    ways = [(contact.link, math.copysign(1, contact.angle_deg)) for contact in contacts]
    assert ways == [(1, 1), (1, -1), (2, 1), (2, -1)] * 2
    assert [contact.at_s for contact in contacts] == [10, 13, 16, 19, 38, 41.4, 44, 47.4]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("profil = 'M'", "unknown key `profil`; did you mean `profile`?"),
        ('about = "one\\ntwo"', "`about` has 2 lines, 1 expected"),
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
        ("payloads = [{ at_s = 1.0, mass_kg = 0.0, center_m = [0.1, 0.0] }]", "`payloads[0].mass_kg` = 0 kg"),
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


def test_contacts_that_follow_each_other_without_a_gap_are_accepted(tmp_path):
    path = tmp_path / "two.toml"
    path.write_text(f"contacts = [{CONTACT}, {OVERLAPPING.replace('1.05', '1.1')}]", encoding="utf-8")
    scenario = load_scenario(str(path))
    assert scenario.name == "two"
    assert len(scenario.contacts) == 2
