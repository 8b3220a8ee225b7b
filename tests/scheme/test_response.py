"""Which reaction a contact gets, and what changes it."""

import numpy as np
import pytest
from contact_course import Course
from smooth_motion import settings_with

from adacd_hil.records import ContactLevel, Reaction, SchemeState
from adacd_hil.scheme.contact.course import BLIND_S, TURNED_CYCLES

SETTINGS = settings_with(
    scheme="certified",
    reaction={"contact": ["slow_down", "stop"], "collision": ["admittance", "withdraw"]},
    detector={"collision_Nm": [2.0, 1.0]},
)
PUSH = np.array([6.0, 3.0])
BLIND = round(BLIND_S / SETTINGS.bus.period_s)


class Contact:
    """A contact followed cycle by cycle."""

    def __init__(self, level, link, is_model_valid=True, settings=SETTINGS):
        self.response = Course(settings)
        self.is_model_valid = is_model_valid
        self.level, self.link = level, link
        self.response.step(link, PUSH, level, is_valid=is_model_valid)

    def step(self, tau=PUSH, cycles=1, level=None, link=None, is_latched=False):
        self.level, self.link = level or self.level, link or self.link
        self.response.m.link = self.link
        for _ in range(cycles):
            self.response.step(self.link, tau, self.level, is_latched=is_latched, is_valid=self.is_model_valid)
        return self.response.reaction


@pytest.mark.parametrize(
    ("level", "link", "reaction"),
    [
        (ContactLevel.CONTACT, 1, Reaction.SLOW_DOWN),
        (ContactLevel.CONTACT, 2, Reaction.STOP),
        (ContactLevel.COLLISION, 1, Reaction.ADMITTANCE),
        (ContactLevel.COLLISION, 2, Reaction.WITHDRAW),
    ],
)
def test_each_level_and_link_has_its_reaction(level, link, reaction):
    assert Contact(level, link).response.reaction is reaction


def test_unless_configured_a_contact_stops_the_arm_and_a_collision_is_withdrawn_from():
    for link in (1, 2):
        settings = settings_with(scheme="certified")
        assert Contact(ContactLevel.CONTACT, link, settings=settings).response.reaction is Reaction.STOP
        assert Contact(ContactLevel.COLLISION, link, settings=settings).response.reaction is Reaction.WITHDRAW


def test_a_contact_that_grows_gets_the_reaction_of_a_collision_and_keeps_it():
    contact = Contact(ContactLevel.CONTACT, 2)
    assert contact.step(level=ContactLevel.COLLISION) is Reaction.WITHDRAW
    assert contact.step(level=ContactLevel.CONTACT) is Reaction.WITHDRAW
    assert contact.response.m.level == ContactLevel.COLLISION


def test_a_link_that_turns_out_to_be_another_gets_its_own_reaction():
    assert Contact(ContactLevel.COLLISION, 1).step(link=2) is Reaction.WITHDRAW


def test_an_arm_that_slows_down_goes_on_until_somebody_must_acknowledge():
    contact = Contact(ContactLevel.CONTACT, 1)
    assert contact.response.goes_on
    assert contact.step(is_latched=True) is Reaction.STOP
    assert not contact.response.goes_on


WITHDRAWN, FLOATING, STOPPED = Reaction.WITHDRAW, Reaction.FLOAT, Reaction.STOP


@pytest.mark.parametrize(
    ("pushes", "reactions", "is_model_valid"),
    [
        ([(1.0, 30), (0.0, 300)], [WITHDRAWN], True),
        ([(1.0, BLIND), (-1.0, TURNED_CYCLES - 1), (-1.0, 1)], [WITHDRAWN, FLOATING], True),
        ([(-1.0, BLIND), (-0.2, 100), (-1.0, TURNED_CYCLES - 1), (0.0, 1)], [WITHDRAWN], True),
        ([(1.0, BLIND), (-1.0, TURNED_CYCLES)], [STOPPED], False),
    ],
    ids=["what lets go", "the other side", "what a blow leaves in the estimate", "no model to float by"],
)
def test_a_withdrawal_that_pushes_something_on_the_other_side_floats(pushes, reactions, is_model_valid):
    contact = Contact(ContactLevel.COLLISION, 2, is_model_valid)
    found = [contact.step(tau=share * PUSH, cycles=cycles) for share, cycles in pushes]
    assert found[-len(reactions) :] == reactions
    assert bool(contact.response.m.is_two_sided) is (reactions != [WITHDRAWN])


def test_a_withdrawal_given_up_is_not_begun_again():
    contact = Contact(ContactLevel.COLLISION, 2)
    contact.step(cycles=BLIND)
    contact.step(tau=-PUSH, cycles=TURNED_CYCLES)
    assert contact.step(link=1, cycles=10) is Reaction.FLOAT


def test_a_late_host_stops_the_arm_and_the_end_of_it_asks_for_nothing():
    response = Course(SETTINGS)
    assert not response.step(0, PUSH)
    assert response.reaction is Reaction.STOP
    response.step(0, PUSH, state=SchemeState.MONITOR)
    assert response.reaction is Reaction.NONE


def test_the_paper_s_scheme_withdraws_from_each_contact_and_gives_no_withdrawal_up():
    paper = settings_with(reaction={"contact": ["slow_down", "stop"], "collision": ["stop", "stop"]})
    contact = Contact(ContactLevel.COLLISION, 1, settings=paper)
    assert contact.response.reaction is Reaction.WITHDRAW
    contact.step(cycles=BLIND)
    assert contact.step(tau=-PUSH, cycles=10 * TURNED_CYCLES) is Reaction.WITHDRAW
    contact.response.step(0, PUSH, state=SchemeState.MONITOR)
    assert contact.response.reaction is Reaction.WITHDRAW  # until the next contact
