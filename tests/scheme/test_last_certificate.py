"""What the arm's last certificate, of another run, says: a hand from before the first motion is more than that."""

import re
from dataclasses import replace

import numpy as np
import pytest
from excited_arm import DATE, FREE, NAMES, TouchedLoop, added, friction_of, kernel_of, known, states
from long_cases import long_but
from planar_arm import PAYLOAD_1KG, THETA

from adacd_hil.records import Request, SchemeState
from adacd_hil.scheme.identify import certificate, evidence, fit_check
from adacd_hil.scheme.pipeline.certificate_watch import BY_WORD, THIS_RUN_ONLY


@pytest.mark.parametrize(
    ("hand", "named"),
    long_but(
        1,
        [
            (added(F_c1=0.2), r"friction of joint 1 at [\d.]+ rad/s is 0\.(19|20|21)\d Nm more"),
            (added(F_v2=0.15), r"friction of joint 2 at 1\.2 rad/s is 0\.1[789]\d Nm more"),
            (added(a1=0.08), r"a1 is 0\.0[78]\d kg m² more"),
        ],
    ),
)
def test_a_hand_from_before_the_first_motion_is_more_than_the_last_certificate_said(hand, named):
    loop = TouchedLoop(known(THETA["P"]))
    loop.theta = THETA["P"] + hand
    assert SchemeState.MONITOR not in states(loop.run(6000))
    assert re.search(rf"{named} than in the certificate of {DATE}, bound 0\.\d\d\d", loop.said("touch")[0])
    assert "`accept` says that nobody touches the arm, which has changed" in loop.said("touch")[0]
    loop.theta = THETA["P"]
    loop.recover()
    for name in ("a1", "F_c1", "F_v2"):
        assert loop.error_of(name) < 0.02


def test_an_arm_that_has_changed_is_certified_at_the_users_word_and_carries_it():
    loop = TouchedLoop(known(THETA["P"]))
    loop.theta = THETA["P"] + added(F_c1=0.3)  # a new seal
    loop.run(4000)
    loop.request = Request.ACCEPT
    loop.recover()
    assert loop.said("touch")[-1] == (
        f"the user says that nobody touches the arm: the certificate of {DATE} is not compared"
    )
    assert loop.said("certificate")[0].endswith(f"; {BY_WORD}the certificate of {DATE}")


def test_a_payload_that_is_announced_is_not_compared():
    loop = TouchedLoop(known(THETA["P"]))
    loop.run_until(SchemeState.MONITOR)
    loop.request = Request.PAYLOAD
    loop.run_until(SchemeState.PAYLOAD)
    loop.theta = THETA["P"] + PAYLOAD_1KG
    loop.request = Request.PAYLOAD_CHANGED
    loop.recover()
    assert loop.said("touch") == []
    assert loop.said("certificate")[1].endswith(THIS_RUN_ONLY)
    first, second = loop.pipeline.certificates
    assert (first.is_payload, second.is_payload) == (False, True)
    assert second.inertia_kgm2[0] - first.inertia_kgm2[0] == pytest.approx(PAYLOAD_1KG[0], abs=0.01)


def test_what_a_certificate_says_of_the_arm_is_the_model_at_the_quantities_that_are_compared():
    loop = TouchedLoop(FREE)
    loop.run_until(SchemeState.MONITOR)
    (certificate,) = loop.pipeline.certificates
    np.testing.assert_allclose(certificate.friction_Nm, friction_of(THETA["P"]), atol=0.02)
    np.testing.assert_allclose(certificate.inertia_kgm2, THETA["P"][:3], atol=0.01)
    np.testing.assert_allclose(certificate.friction_Nm, friction_of(np.array(certificate.parameters)))
    assert 0.0 < max(certificate.friction_std_Nm) < 0.05
    assert certificate.text == loop.said("certificate")[0]


class Asked:
    """A kernel's memory with a fit that is known to `std`, and a last certificate that is known without error."""

    def __init__(self, std=0.0, **shares):
        settings = known(np.full(7, 0.1))
        history = replace(settings.history, friction_std_Nm=(0.0,) * 6, inertia_std_kgm2=(0.0,) * 3, **shares)
        settings = replace(settings, history=history)
        self.k, self.m = kernel_of(settings)
        self.m.models.P_belief = (std**2 + 1e-12) * np.eye(len(NAMES))
        self.m.fit_check.fit_square, self.m.fit_check.fit_rows = 1.0, 4.0

    def agrees_with(self, name, change):
        self.m.models.belief = 0.1
        self.m.models.belief[NAMES.index(name)] += change
        evidence.fit(self.k, self.m, self.m.models.belief, self.m.models.P_belief, fit_check.fit_unit(self.m))
        return certificate.is_no_more(self.k, self.m)


def test_a_viscous_hand_stands_out_from_a_joints_viscous_friction_before_it_does_from_the_friction_at_any_speed():
    """Of friction that is mostly Coulomb's a fifth is more than the hand makes at any speed."""
    asked = Asked(friction_share=0.2, inertia_share=0.0)  # 0.1 Nm and 0.1 Nm s/rad
    bound = 0.02 + 4.0 * 0.2 * 0.1
    assert asked.agrees_with("F_v2", 0.99 * bound)
    assert not asked.agrees_with("F_v2", 1.01 * bound)
    assert certificate.describe_more(asked.m, DATE) == [
        f"viscous friction of joint 2 is 0.101 Nm s/rad more than in the certificate of {DATE}, bound 0.100 Nm s/rad"
    ]


@pytest.mark.parametrize(("name", "floor"), [("F_c2", 0.02), ("a3", 0.006)])
def test_less_than_the_floor_is_nothing(name, floor):
    asked = Asked(friction_share=0.0, inertia_share=0.0)
    assert asked.agrees_with(name, 0.99 * floor)
    assert not asked.agrees_with(name, 1.01 * floor)
    assert not asked.agrees_with(name, np.nan)


def test_runs_may_differ_by_a_share_and_a_fit_by_what_is_not_known_of_it():
    asked = Asked(friction_share=0.2, inertia_share=0.0)
    bound = 0.02 + 4.0 * 0.2 * (0.1 + 0.2 * 0.1)
    assert asked.agrees_with("F_c1", 0.99 * bound)
    assert not asked.agrees_with("F_c1", 1.01 * bound)
    assert Asked(std=0.02, friction_share=0.2, inertia_share=0.0).agrees_with("F_c1", 1.1 * bound)
