"""Anchors: a lean is no offset, an offset is no lean, and what isn't known is said."""

import re
from dataclasses import replace

import numpy as np
import pytest
from excited_arm import FREE, NAMES, OFFSETS, PERIOD_S, SETTINGS, TouchedLoop, arm_state, kernel_of, known, states
from long_cases import long_but

from adacd_hil.records import FaultReason, Request, SchemeState
from adacd_hil.scheme.detect import sight
from adacd_hil.scheme.identify import anchor, evidence
from adacd_hil.scheme.pipeline.certificate_watch import THIS_RUN_ONLY
from adacd_hil.scheme.pipeline.new_pipeline import new_pipeline

COMMISSION_S = 0.1
LARGEST_ERROR_NM = 0.06
"""A fit may hold the end of a lean; its certificate says within how much the anchors bound it."""
NOT_AT_ALL = "not at all: who has leaned on it since before the start is in its torque offset"
FRICTION = NAMES.index("F_c1")
MOVED_NM = (0.5, -0.5)
"""Zeros of the last certificate from which the sensors have moved since."""


def settings_with(timeout_s=None, **arm):
    safety = replace(SETTINGS.safety, commission_s=COMMISSION_S)
    termination = SETTINGS.termination
    if timeout_s is not None:
        safety = replace(safety, phase_timeout_s=timeout_s)
        termination = replace(termination, timeout_s=timeout_s)
    return replace(SETTINGS, safety=safety, termination=termination, arm=replace(SETTINGS.arm, **arm))


TARED = settings_with(torque_offset_std_Nm=(0.005, 0.005))
BOTH = settings_with(holding_torque_Nm=(0.0, 0.0), torque_offset_std_Nm=(0.005, 0.005))
UNKNOWN = settings_with()


def with_last(settings, offset_Nm=(0.0, 0.0)):
    """Return settings with a last certificate that knows the sensors' zeros, and any friction and inertia."""
    return known(np.full(7, 10.0), settings, offset_Nm)


@pytest.mark.parametrize(
    ("settings", "joint", "torque_Nm"),
    long_but(2, [(FREE, 0, 0.1), (with_last(UNKNOWN), 0, 0.3), (TARED, 1, -0.5), (FREE, 0, 1.0)]),
)
def test_a_lean_from_before_the_first_motion_gets_no_certificate_and_is_named(settings, joint, torque_Nm):
    loop = TouchedLoop(settings)
    loop.run_until(SchemeState.ENABLE)  # this arm's motors hold it from the first cycle on
    leant = loop.lean(joint, torque_Nm, 3.5)
    assert SchemeState.MONITOR not in states(leant)
    withheld = loop.said("anchor")[0]
    assert f"joint {joint + 1} has a fitted torque offset of" in withheld
    assert "somebody leans on it" in withheld
    assert not any(output.is_model_valid for output in leant)
    loop.recover()
    assert np.abs(loop.offset_error_Nm).max() < LARGEST_ERROR_NM


@pytest.mark.parametrize(
    ("settings", "leant_Nm", "joint_1", "joint_2"),
    [
        (TARED, 0.0, r"to ± 0\.0\d\d Nm by the tare", r"to ± 0\.0\d\d Nm by .*"),
        (BOTH, 0.0, r"to ± 0\.0\d\d Nm by the reading at rest", r"to ± 0\.0\d\d Nm by .*"),
        (with_last(UNKNOWN), 0.0, *[r"to ± 0\.0\d\d Nm by the last certificate"] * 2),
        (with_last(FREE, MOVED_NM), 0.0, *[r"to ± 0\.0\d\d Nm by the reading at rest"] * 2),
        (with_last(TARED, MOVED_NM), 0.0, *[r"to ± 0\.0\d\d Nm by the tare"] * 2),
        (settings_with(holding_torque_Nm=(0.02, 0.0)), 0.0, r"to ± 0\.0\d\d Nm by the reading at rest", "to .*"),
        (settings_with(holding_torque_Nm=(8.0, 0.0)), 0.0, NOT_AT_ALL, "to .*"),
        (UNKNOWN, 0.5, NOT_AT_ALL, NOT_AT_ALL),
    ],
)
def test_a_certificate_says_of_each_joint_what_anchors_it_and_warns_where_nothing_does(
    settings, leant_Nm, joint_1, joint_2
):
    loop = TouchedLoop(settings)
    loop.tau_ext[0] = leant_Nm
    loop.run_until(SchemeState.MONITOR)
    assert abs(loop.offset_error_Nm[0]) == pytest.approx(leant_Nm, abs=0.1)
    (text,) = loop.said("certificate")
    seen = re.escape(sight.describe_sight(loop.m))
    date = settings.history.date_utc
    compared = f"friction and inertia: within what the certificate of {date} allows" if date else THIS_RUN_ONLY
    assert re.fullmatch(rf"torque offsets anchored: joint 1 {joint_1}; joint 2 {joint_2}; {seen}; {compared}", text)
    (told,) = loop.told("certificate")
    open_joints = [number + 1 for number, said in enumerate((joint_1, joint_2)) if said == NOT_AT_ALL]
    assert loop.levels("certificate") == ["warning" if open_joints else "info"]
    assert told.count("warning: a lean on ") == bool(open_joints)
    assert re.findall(r"joint (\d)", told.partition(";")[0] if open_joints else "") == list(map(str, open_joints))
    assert told.endswith(sight.describe_push(loop.m))


def test_the_last_certificates_zero_counts_from_the_configurations():
    configured = replace(with_last(UNKNOWN, (0.4, -0.3)), arm=replace(UNKNOWN.arm, torque_offset_Nm=(0.3, -0.4)))
    loop = TouchedLoop(configured, (0.1, 0.1))  # what the loop measures has the configuration's subtracted
    loop.run_until(SchemeState.MONITOR)
    assert loop.said("anchor") == []
    (certificate,) = loop.pipeline.certificates
    np.testing.assert_allclose(certificate.offset_Nm, (0.4, -0.3), atol=0.02)


def test_a_sensor_that_has_moved_since_its_tare_keeps_the_drives_off_and_the_time_out_says_why():
    loop = TouchedLoop(
        settings_with(0.6, holding_torque_Nm=(0.0, 0.0), torque_offset_std_Nm=(0.005, 0.005)), (0.5, 0.0)
    )
    outputs = loop.run(700)
    assert states(outputs) <= {SchemeState.INIT, SchemeState.COMMISSION, SchemeState.FAULT}
    assert outputs[-1].fault is FaultReason.COMMISSION_TIMEOUT
    (said,) = loop.said("anchor")
    assert re.search(r"joint 1 reads 0\.49\d Nm at rest, by the tare it is 0\.000 ± 0\.0\d\d Nm: somebody", said)
    assert "the drives stay off" in said
    assert any("joint 1 reads " in line for line in loop.pipeline.describe_withheld())


def test_the_user_may_let_the_reading_stand_in_place_of_the_tare():
    loop = TouchedLoop(BOTH, (0.5, 0.0))
    loop.run(300)
    assert loop.pipeline.state is SchemeState.COMMISSION
    loop.request = Request.ACCEPT
    loop.run_until(SchemeState.MONITOR)
    assert re.fullmatch(
        r"the user accepts 0\.49\d, -?0\.00\d Nm at rest: the tare is not used", loop.said("anchor")[-1]
    )
    (text,) = loop.said("certificate")
    assert text.count("by the reading at rest") == 2


def test_who_leans_on_brakes_before_the_start_is_seen_by_the_tare_beyond_what_they_hold():
    settings = settings_with(holding_torque_Nm=(0.3, 0.3), torque_offset_std_Nm=(0.005, 0.005))
    inside, beyond = TouchedLoop(settings, (0.2, 0.0)), TouchedLoop(settings, (0.4, 0.0))
    inside.run(300)
    beyond.run(300)
    assert inside.said("anchor") == []
    assert "± 0.3" in beyond.said("anchor")[0]


def test_who_has_leaned_before_the_start_and_gone_is_forgotten():
    loop = TouchedLoop(BOTH, (0.5, 0.0))
    loop.run(1000)
    loop.offset_Nm[:] = 0.0
    outputs = loop.run_until(SchemeState.ENABLE, 2000)
    assert len(outputs) * PERIOD_S < 10 * COMMISSION_S


def test_the_user_may_accept_an_offset_and_the_certificate_then_carries_it():
    loop = TouchedLoop(FREE)
    loop.run_until(SchemeState.ADAPT)
    loop.offset_Nm[0] = 0.4  # the sensor has moved after its reading at rest
    loop.run(3000)
    assert loop.said("certificate") == []
    loop.request = Request.ACCEPT
    loop.run_until(SchemeState.MONITOR, 6000)
    assert re.match(r"the user accepts 0\.(39|40)\d, ", loop.said("anchor")[-1])
    (text,) = loop.said("certificate")
    assert re.search(r"joint 1 to ± 0\.0\d\d Nm by the user's word; joint 2 to ± 0\.0\d\d Nm by the user's word", text)


def test_the_word_that_comes_with_the_first_refusal_is_no_word_about_it():
    """`accept` is typed about something that was read; what is refused in the same cycle nobody has read."""
    loop = TouchedLoop(FREE)
    loop.run_until(SchemeState.ADAPT)
    loop.tau_ext[0] = 0.5
    state = SchemeState.ADAPT
    for _ in range(4000):
        loop.request = Request.ACCEPT
        state = loop.step().state
        if not loop.said("anchor")[-1].startswith("nothing to accept"):
            break
    assert state is SchemeState.ADAPT
    assert "nothing to accept" in loop.said("anchor")[-2]
    assert loop.said("anchor")[-1].startswith("joint 1 has")


def test_what_the_user_has_accepted_excuses_no_other_lean():
    loop = TouchedLoop(FREE)
    loop.run_until(SchemeState.ADAPT)
    loop.tau_ext[0] = 0.4
    loop.run(3000)
    loop.request = Request.ACCEPT
    loop.run(1)
    loop.tau_ext[0] = -0.4
    assert SchemeState.MONITOR not in states(loop.run(4000))


def test_a_reading_at_rest_begins_anew_when_the_arm_moves():
    pipeline = new_pipeline(FREE)
    m = pipeline.numbers.memory[0]
    for cycle in range(60):
        pipeline.step(arm_state(cycle, tau_J=(0.3, 0.0), is_enabled=False))
    pipeline.step(arm_state(60, dq=(0.5, 0.0), tau_J=(0.3, 0.0), is_enabled=False))
    assert m.anchor.rest_count == 0.0
    assert np.isinf(m.anchor.anchor_std[anchor.REST]).all()
    for cycle in range(61, 71):
        pipeline.step(arm_state(cycle, tau_J=(0.1, 0.0), is_enabled=False))
    assert m.anchor.anchor_Nm[anchor.REST, 0] == pytest.approx(0.1)


class Judged:
    """A kernel's memory with one joint's offset judged by an anchor."""

    def __init__(self, settings=FREE, std_Nm=0.01, friction_Nm=0.0):
        self.k, self.m = kernel_of(settings)
        self.theta, self.P = np.zeros(len(NAMES)), np.zeros((len(NAMES), len(NAMES)))
        self.P[OFFSETS, OFFSETS] = std_Nm**2
        self.theta[FRICTION] = friction_Nm
        self.m.anchor.anchor_std[anchor.REST] = 0.004

    def bound_Nm(self, kind=anchor.REST):
        anchor.is_within(self.k, self.m, self.theta, self.P)
        return float(self.m.evidence.limit[kind, evidence.OFFSETS])


def test_the_bound_is_four_deviations_of_all_that_is_not_known():
    assert Judged().bound_Nm() == pytest.approx(4.0 * np.sqrt(0.01**2 + 0.004**2 + 0.005**2))
    assert Judged(friction_Nm=0.2).bound_Nm() == pytest.approx(4.0 * np.sqrt(0.01**2 + 0.004**2 + 0.005**2 + 0.02**2))
    judged = Judged()
    judged.m.evidence.age_s = 3600.0
    drift_Nm = FREE.tare.drift_Nm_sqrt_s * 60.0
    assert judged.bound_Nm() == pytest.approx(4.0 * np.sqrt(0.01**2 + 0.004**2 + 0.005**2 + drift_Nm**2))
    assert Judged().bound_Nm(anchor.TARE) == np.inf


@pytest.mark.parametrize("offset_Nm", [1.01, -1.01, np.nan])
def test_an_offset_beyond_its_bound_is_not_kept(offset_Nm):
    judged = Judged()
    judged.theta[OFFSETS[0]] = 0.99 * judged.bound_Nm()
    assert anchor.is_within(judged.k, judged.m, judged.theta, judged.P)
    judged.theta[OFFSETS[0]] = offset_Nm * judged.bound_Nm()
    assert not anchor.is_within(judged.k, judged.m, judged.theta, judged.P)


def test_residuals_worse_than_expected_widen_no_bound():
    judged = Judged()
    before_Nm = judged.bound_Nm()
    judged.m.sensitivity.unit = 9.0
    assert judged.bound_Nm() == before_Nm
    judged.m.sensitivity.unit = 0.25
    assert judged.bound_Nm() < before_Nm
