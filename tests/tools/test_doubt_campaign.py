"""tools/campaigns/doubt_campaign.py: one arm of each part, and its figures."""

import doubt_campaign
import pytest
from doubt_campaign import Played

LOADED = "2 contacts look like 0.19 ± 0.01 kg picked up: the certificate is taken back, `changed` learns it"
GOOD = Played(1, "0.2 kg", 0.2, LOADED, 0.19, 3, 1.5)


def figures(part, rows):
    return {name: (value, is_met) for name, value, _, is_met in doubt_campaign.FIGURES[part](rows)}


@pytest.mark.slow
def test_a_payload_is_played_until_it_is_named():
    played = doubt_campaign.play(2, "payload")
    assert (played.what, played.size) == ("0.2 kg", 0.2)
    assert "kg picked up" in played.said
    assert played.named == pytest.approx(0.2, rel=0.1)
    assert 2 <= played.contacts <= 8
    assert 0.0 < played.after_s < 10.0


@pytest.mark.slow
def test_friction_that_changes_is_played_until_the_certificate_is_taken_back():
    played = doubt_campaign.play(166024, "wrong")
    assert played.what == "viscous friction"
    assert "more viscous friction of joint" in played.said
    assert played.named == pytest.approx(played.size, rel=0.2)


@pytest.mark.slow
def test_touches_are_played_to_the_end():
    played = doubt_campaign.play(3, "touches")
    assert played.contacts > 5
    assert (played.said, played.named) == ("", 0.0)


@pytest.mark.parametrize(
    ("change", "is_met"),
    [
        ({}, True),
        ({"named": 0.21}, True),
        ({"named": 0.175}, False),
        ({"contacts": 6}, False),
        ({"said": "8 contacts came within", "named": 0.0}, False),
        ({"said": "", "named": 0.0}, False),
    ],
)
def test_a_payload_must_be_named_soon_and_within_a_tenth(change, is_met):
    rows = [GOOD._replace(**change), GOOD._replace(size=0.05, named=0.05)]
    found = figures("payload", rows)
    assert {name[:6]: met for name, (_, met) in found.items()}["0.2 kg"] is is_met


@pytest.mark.parametrize(("contacts", "said", "is_met"), [(3, "taken back", True), (0, "", True), (2, "", False)])
def test_what_an_error_meets_must_be_said(contacts, said, is_met):
    row = Played(1, "torque offset", 0.5, said, 0.0, contacts, 60.0)
    value, met = figures("wrong", [row])["torque offset: taken back, said, met by a contact"]
    assert met is is_met
    assert value.endswith("up to 0.50" if contacts == 0 else "up to 0.00")
