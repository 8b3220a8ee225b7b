"""A torque-sensed arm of seven joints is identified and watched on its record; Pinocchio moves it."""

import dataclasses

import numpy as np
import pytest
from planar_arm import THETA
from serial_arms import GRAVITY, SEVEN_JOINT_URDF, planar_chain, seven_joint_arm
from simulated_arm import Multisine, simulate
from smooth_motion import smooth_motion, torque_of

from adacd_hil.scheme.identify import offline
from adacd_hil.scheme.identify.offline import OfflineSettings, Record
from adacd_hil.scheme.model.chain import mass_matrix

pinocchio = pytest.importorskip("pinocchio")

NOISE_NM = 0.03
SETTINGS = OfflineSettings(noise_Nm=(NOISE_NM,) * 7)
F_V = np.array([0.5, 0.5, 0.4, 0.4, 0.05, 0.05, 0.05])
F_C = np.array([0.3, 0.3, 0.25, 0.25, 0.03, 0.03, 0.03])
OFFSET_NM = np.array([0.1, -0.2, 0.1, 0.0, 0.05, -0.05, 0.02])
FILTERED_NOISE_NM = NOISE_NM * np.sqrt(0.5 * SETTINGS.detection_cutoff_rad_s * SETTINGS.period_s)
PAYLOAD_AT_M = (0.02, 0.0, 0.15)

# A point on a moving link, in its frame; a force on it in the world's axes, N; the outermost joint that it loads.
PUSHES = [
    ("link2", (0.0, -0.25, 0.10), (20.0, -10.0, 5.0), 1),
    ("link4", (0.0, 0.20, 0.05), (-15.0, 10.0, 0.0), 3),
    ("link7", (0.06, 0.0, 0.10), (8.0, 12.0, -6.0), 6),
    ("link5", (0.08, 0.05, -0.10), (0.0, -15.0, 10.0), 4),
]
PUSH_S = 0.3


def push_begins(index):
    """Return when a push begins, s."""
    return 0.7 + index


def model_of_the_arm():
    """Build Pinocchio's model with a frame at each pushed point."""
    model = pinocchio.buildModelFromXML(SEVEN_JOINT_URDF)
    model.gravity.linear = np.array(GRAVITY)
    for index, (link, point, _, _) in enumerate(PUSHES):
        joint = model.frames[model.getFrameId(link)].parentJoint
        placement = pinocchio.SE3(np.eye(3), np.array(point))
        model.addFrame(pinocchio.Frame(f"push{index}", joint, placement, pinocchio.FrameType.OP_FRAME))
    return model


def push(t_s):
    """Return the force that acts at a time."""
    for index, (_, _, newtons, _) in enumerate(PUSHES):
        if push_begins(index) <= t_s < push_begins(index) + PUSH_S:
            return f"push{index}", np.array(newtons)
    return None


def record_of(arm, model, seed, seconds, force=None):
    """Return the record of a random motion and the true external torque."""
    motion = Multisine(seed, arm.position_low, arm.position_high, arm.velocity_limit)
    q, dq, tau_J, tau_ext = simulate(pinocchio, model, motion, seconds, F_V, F_C, OFFSET_NM, NOISE_NM, seed, force)
    return Record(q, dq, tau_J), tau_ext


class Case:
    """The arm, its records and what is made of them."""

    def __init__(self):
        self.arm = seven_joint_arm()
        self.columns = offline.model_of(self.arm.chain)
        self.model = model_of_the_arm()
        self.before = offline.prior(self.columns)
        self.fitted, _ = record_of(self.arm, self.model, 1, 8.0)
        self.unseen, _ = record_of(self.arm, self.model, 2, 4.0)
        self.estimate = offline.identify(self.columns, self.fitted, self.before, SETTINGS)
        self.certificate = offline.certify(self.columns, self.unseen, self.estimate, SETTINGS)

    def detect(self, record):
        return offline.detect(self.columns, record, self.estimate, SETTINGS, self.certificate.lack_Nm)


@pytest.fixture(scope="module")
def case():
    return Case()


def test_the_parameters_are_found_within_their_uncertainty(case):
    """From nothing known but that a human could stand beside the arm."""
    truth = np.concatenate([case.columns.base.map @ case.arm.theta_full, F_V, F_C, OFFSET_NM])
    deviation = np.sqrt(np.diag(case.estimate.P))
    assert np.max(np.abs(case.estimate.theta - truth) / deviation) < 4.0
    assert np.max(deviation[case.columns.place_of("F_c")]) < 0.02
    assert np.max(deviation / np.sqrt(np.diag(case.before.P))) < 0.1


def test_the_frozen_model_leaves_no_more_than_noise_on_unseen_motion(case):
    np.testing.assert_array_less(case.certificate.residual_rms_Nm, 3.0 * FILTERED_NOISE_NM)
    np.testing.assert_array_less(case.certificate.residual_max_Nm, 0.06)
    np.testing.assert_array_less(case.certificate.lack_Nm, 2.0 * FILTERED_NOISE_NM)
    assert case.certificate.margin > 1.1


def test_free_motion_is_no_contact(case):
    detected = case.detect(case.unseen)
    assert detected.contacts == ()
    assert np.median(detected.threshold) < 0.05


def test_an_arm_of_which_nothing_is_known_raises_no_alarm_in_free_motion(case):
    detected = offline.detect(case.columns, case.unseen, case.before, SETTINGS)
    assert detected.contacts == ()


def test_pushes_are_found_with_link_and_direction(case):
    record, tau_ext = record_of(case.arm, case.model, 3, 4.2, push)
    contacts = case.detect(record).contacts
    begins = [round(push_begins(index) / SETTINGS.period_s) for index in range(len(PUSHES))]
    assert [contact.link for contact in contacts] == [outermost for *_, outermost in PUSHES]
    for contact, begin in zip(contacts, begins, strict=True):
        assert 0 <= contact.sample - begin <= 3
        pushed = np.abs(tau_ext[begin]) > 0.3
        np.testing.assert_array_equal(np.array(contact.direction)[pushed], np.sign(tau_ext[begin])[pushed])
        assert np.abs(tau_ext[begin, contact.first_joint]) > 0.3


def test_noise_of_the_velocity_is_no_contact_and_raises_the_threshold_by_the_mass_that_it_moves(case):
    """1 mrad/s at 50 rad/s: 50 mNm per kg m² of the joint's row of M."""
    random = np.random.default_rng(5)
    noisy = (
        Record(record.q, record.dq + 1e-3 * random.standard_normal(record.dq.shape), record.tau_J)
        for record in (case.fitted, case.unseen)
    )
    settings = dataclasses.replace(SETTINGS, velocity_noise_rad_s=1e-3)
    fitted, unseen = noisy
    estimate = offline.identify(case.columns, fitted, case.before, settings)
    assert offline.certify(case.columns, unseen, estimate, SETTINGS).margin < 0.2
    assert offline.certify(case.columns, unseen, estimate, settings).margin > 1.0
    still = Record(unseen.q[:1], np.zeros((1, 7)), unseen.tau_J[:1])
    M = mass_matrix(case.arm.chain, unseen.q[0], case.arm.theta_full)
    threshold = offline.detect(case.columns, still, estimate, settings).threshold[0]
    expected = 6.0 * np.hypot(FILTERED_NOISE_NM, 0.05 * np.linalg.norm(M, axis=1))
    np.testing.assert_allclose(threshold, expected, rtol=0.05, atol=0.01)


@pytest.mark.parametrize("joint", range(7))
def test_a_step_of_a_fifth_of_a_newton_metre_is_found_on_each_joint(case, joint):
    """A push toward +q takes load off the joint: for the same motion tau_J falls by tau_ext."""
    begin = int(np.argmax(np.abs(case.unseen.dq[1000:, joint]))) + 1000
    tau_J = case.unseen.tau_J.copy()
    tau_J[begin:, joint] -= 0.2
    end = begin + 100
    detected = case.detect(Record(case.unseen.q[:end], case.unseen.dq[:end], tau_J[:end]))
    (contact,) = detected.contacts
    assert begin <= contact.sample <= begin + 10
    assert (contact.link, contact.first_joint) == (joint, joint)
    assert contact.direction == tuple(int(i == joint) for i in range(7))


def test_a_payload_is_one_unknown(case):
    """1 kg at a known place: after 0.5 s the arm that was certified is certified again."""
    model = model_of_the_arm()
    body = pinocchio.Inertia(1.0, np.array(PAYLOAD_AT_M), np.zeros((3, 3)))
    model.appendBodyToJoint(7, body, pinocchio.SE3.Identity())
    record, _ = record_of(case.arm, model, 4, 2.0)
    first, rest = (Record(record.q[part], record.dq[part], record.tau_J[part]) for part in (np.s_[:500], np.s_[500:]))
    loaded = offline.with_payload(case.columns, case.estimate, 3.0, PAYLOAD_AT_M)
    estimate = offline.identify(case.columns, first, loaded, SETTINGS)
    assert offline.certify(case.columns, rest, case.estimate, SETTINGS).margin < 0.01
    assert offline.certify(case.columns, rest, estimate, SETTINGS).margin > 1.0


def test_a_joint_at_standstill_may_hold_its_friction(case):
    q = np.tile(case.unseen.q[0], (1000, 1))
    still = np.zeros_like(q)
    detected = case.detect(Record(q, still, still))
    F_c = case.estimate.theta[case.columns.place_of("F_c")]
    noise_only = SETTINGS.deviations * FILTERED_NOISE_NM
    np.testing.assert_array_less(F_c + 0.9 * noise_only, detected.threshold[-1])


def test_the_planar_arm_is_identified_as_a_chain_of_two():
    """The closed form's torque, the chain's estimate: a1, a2, a3 and friction agree."""
    t_s = np.arange(0.0, 8.0, 1e-3)
    q, dq, ddq = smooth_motion(t_s)
    truth = THETA["M"]
    columns = offline.model_of(planar_chain((0.0, 0.0, 0.0)))
    settings = OfflineSettings(noise_Nm=(1e-3, 1e-3))
    estimate = offline.identify(columns, Record(q, dq, torque_of(q, dq, ddq, truth)), offline.prior(columns), settings)
    a1, a2, a3 = truth[:3]
    theta_full = np.zeros(20)
    theta_full[[9, 11, 19]] = a1 - a3, a2 / 0.35, a3  # Izz_1, mx_2, Izz_2
    expected = np.concatenate([columns.base.map @ theta_full, truth[3:], [0.0, 0.0]])
    np.testing.assert_allclose(estimate.theta, expected, atol=2e-3)


def test_contacts_are_split_by_quiet_windows_and_told_by_their_outermost_joint():
    tau_ext_hat = np.zeros((60, 3))
    tau_ext_hat[5, 0] = -2.0
    tau_ext_hat[9, 1] = 2.0
    tau_ext_hat[16, 2] = 2.0  # a window after the first: the same contact, too late for its report
    tau_ext_hat[40, 2] = np.nan
    contacts = offline._contacts(tau_ext_hat, np.ones((60, 3)), 10)
    assert [(contact.sample, contact.link, contact.first_joint) for contact in contacts] == [(5, 1, 0), (40, 2, 2)]
    assert contacts[0].direction == (-1, 1, 0)


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (((5, 2), (5, 2), (5, 3)), r"tau_J has shape \(5, 3\), not \(k, n\) as q \(5, 2\)"),
        (((5,), (5,), (5,)), r"q has shape \(5,\), not \(k, n\)"),
    ],
)
def test_a_record_that_is_not_whole_is_refused(shapes, message):
    with pytest.raises(ValueError, match=message):
        Record(*(np.zeros(shape) for shape in shapes))


def test_a_value_that_is_not_a_number_is_refused():
    bad = np.zeros((5, 2))
    bad[3, 1] = np.nan
    with pytest.raises(ValueError, match=r"dq\[3, 1\] is not finite"):
        Record(np.zeros((5, 2)), bad, np.zeros((5, 2)))


def test_a_record_of_another_arm_is_refused(case):
    short = Record(*(np.zeros((5, 2)),) * 3)
    with pytest.raises(ValueError, match="the arm has 7 joints, the record 2, noise_Nm 7 values"):
        case.detect(short)
