"""A torque-sensed arm of seven joints is identified and watched on its record."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from foreign_arms import rigid_torque, sines
from planar_arm import THETA
from serial_arms import mass_matrix, planar_chain, seven_joint_arm
from smooth_motion import smooth_motion, torque_of

from adacd_hil.lab.serial_arm import offline
from adacd_hil.lab.serial_arm.chain import point_mass
from adacd_hil.lab.serial_arm.offline import OfflineSettings, Record

NOISE_NM = 0.03
SETTINGS = OfflineSettings(noise_Nm=(NOISE_NM,) * 7)
F_V = np.array([0.5, 0.5, 0.4, 0.4, 0.05, 0.05, 0.05])
F_C = np.array([0.3, 0.3, 0.25, 0.25, 0.03, 0.03, 0.03])
OFFSET_NM = np.array([0.1, -0.2, 0.1, 0.0, 0.05, -0.05, 0.02])
FILTERED_NOISE_NM = NOISE_NM * np.sqrt(0.5 * SETTINGS.detection_cutoff_rad_s * SETTINGS.period_s)
PAYLOAD_AT_M = (0.02, 0.0, 0.15)

PUSHES = [
    (6.0, -5.0),
    (-4.0, 3.0, -2.0, 3.0),
    (1.0, -2.0, 1.0, 2.0, -0.5, 1.0, 0.8),
    (3.0, -3.0, 2.0, -1.5, 1.0),
]
"""Torques, Nm, of pushes on links, each loads the joints up to its own."""


def record_of(arm, seed, seconds, tau_ext=0.0, carried=0.0):
    """Return the record of a random motion under an external torque (k, n); carried: added to the links' parameters."""
    _, motion = sines(7, seconds, SETTINGS.period_s, seed)
    q, dq, _ = motion
    tau_J = rigid_torque(SimpleNamespace(chain=arm.chain, theta_full=arm.theta_full + carried), motion)
    noise = NOISE_NM * np.random.default_rng(seed).standard_normal(q.shape)
    return Record(q, dq, tau_J + F_V * dq + F_C * np.sign(dq) + OFFSET_NM + noise - tau_ext)


class Case:
    """The arm, its records and what is made of them."""

    def __init__(self):
        self.arm = seven_joint_arm()
        self.columns = offline.model_of(self.arm.chain)
        self.before = offline.prior(self.columns)
        self.fitted = record_of(self.arm, 1, 8.0)
        self.unseen = record_of(self.arm, 2, 4.0)
        self.estimate = offline.identify(self.columns, self.fitted, self.before, SETTINGS)
        self.certificate = offline.certify(self.columns, [self.unseen], self.estimate, SETTINGS)

    def detect(self, record):
        return offline.detect(self.columns, record, self.estimate, SETTINGS, self.certificate.lack_Nm)


@pytest.fixture(scope="module")
def case():
    return Case()


def test_an_arm_of_which_nothing_is_known_raises_no_alarm_in_free_motion(case):
    detected = offline.detect(case.columns, case.unseen, case.before, SETTINGS, np.zeros(7))
    assert detected.contacts == ()


def test_pushes_are_found_with_link_and_direction(case):
    begins, tau_ext = [700 + 1000 * index for index in range(len(PUSHES))], np.zeros((4200, 7))
    for begin, torques in zip(begins, PUSHES, strict=True):
        tau_ext[begin : begin + 300, : len(torques)] = torques
    contacts = case.detect(record_of(case.arm, 3, 4.2, tau_ext)).contacts
    assert [link for _, link, _ in contacts] == [len(torques) - 1 for torques in PUSHES]
    assert [direction for *_, direction in contacts] == [tuple(np.sign(tau_ext[begin])) for begin in begins]
    assert all(0 <= sample - begin <= 3 for (sample, *_), begin in zip(contacts, begins, strict=True))


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
    assert offline.certify(case.columns, [unseen], estimate, SETTINGS).margin < 0.2
    assert offline.certify(case.columns, [unseen], estimate, settings).margin > 1.0
    still = Record(unseen.q[:1], np.zeros((1, 7)), unseen.tau_J[:1])
    M = mass_matrix(case.arm.chain, unseen.q[0], case.arm.theta_full)
    threshold = offline.detect(case.columns, still, estimate, settings, np.zeros(7)).threshold[0]
    expected = 6.0 * np.hypot(FILTERED_NOISE_NM, 0.05 * np.linalg.norm(M, axis=1))
    np.testing.assert_allclose(threshold, expected, rtol=0.05, atol=0.01)


def test_a_payload_is_one_unknown(case):
    """1 kg at a known place: after 0.5 s the arm that was certified is certified again."""
    carried = np.zeros(70)
    carried[60:] = point_mass(1.0, PAYLOAD_AT_M)
    record = record_of(case.arm, 4, 2.0, carried=carried)
    first, rest = (Record(record.q[part], record.dq[part], record.tau_J[part]) for part in (np.s_[:500], np.s_[500:]))
    loaded = offline.with_payload(case.columns, case.estimate, 3.0, PAYLOAD_AT_M)
    estimate = offline.identify(case.columns, first, loaded, SETTINGS)
    assert offline.certify(case.columns, [rest], case.estimate, SETTINGS).margin < 0.01
    assert offline.certify(case.columns, [rest], estimate, SETTINGS).margin > 1.0


def test_a_joint_at_standstill_may_hold_its_friction(case):
    q = np.tile(case.unseen.q[0], (1000, 1))
    still = np.zeros_like(q)
    detected = case.detect(Record(q, still, still))
    F_c = case.estimate.theta[case.columns.place_of("F_c")]
    noise_only = SETTINGS.deviations * FILTERED_NOISE_NM
    np.testing.assert_array_less(F_c + 0.9 * noise_only, detected.threshold[-1])


def test_contacts_are_split_by_quiet_windows_and_told_by_their_outermost_joint():
    tau_ext_hat = np.zeros((60, 3))
    tau_ext_hat[5, 0] = -2.0
    tau_ext_hat[9, 1] = 2.0
    tau_ext_hat[16, 2] = 2.0  # a window after the first: the same contact, too late for its report
    tau_ext_hat[40, 2] = np.nan
    contacts = offline.find_contacts(tau_ext_hat, np.ones((60, 3)), 10)
    assert contacts == ((5, 1, (-1, 1, 0)), (40, 2, (0, 0, 0)))


@pytest.mark.parametrize(
    ("shapes", "bad", "message"),
    [
        (((5, 2), (5, 2), (5, 3)), 0.0, r"tau_J has shape \(5, 3\), not \(k, n\) as q \(5, 2\)"),
        (((5,), (5,), (5,)), 0.0, r"q has shape \(5,\), not \(k, n\)"),
        (((5, 2), (5, 2), (5, 2)), np.nan, r"dq\[3, 1\] is not finite"),
    ],
)
def test_a_record_that_is_not_whole_is_refused(shapes, bad, message):
    q, dq, tau_J = (np.zeros(shape) for shape in shapes)
    dq.flat[-3] = bad
    with pytest.raises(ValueError, match=message):
        Record(q, dq, tau_J)


def test_a_record_of_another_arm_is_refused(case):
    short = Record(*(np.zeros((5, 2)),) * 3)
    with pytest.raises(ValueError, match="the arm has 7 joints, the record 2, noise_Nm 7 values"):
        case.detect(short)


def planar_record(rng, velocity_noise=0.0, torque_noise=1e-3, seconds=8.0, lacking=0.0):
    """Return a record of the planar arm M without gravity; lacking: Nm of a torque that no model here has."""
    t_s = np.arange(0.0, seconds, 1e-3)
    q, dq, ddq = smooth_motion(t_s)
    tau = torque_of(q, dq, ddq, THETA["M"]) + lacking * np.sin(3.0 * q) + torque_noise * rng.standard_normal(q.shape)
    return Record(q, dq + velocity_noise * rng.standard_normal(q.shape), tau)


def planar_truth(columns):
    a1, a2, a3 = THETA["M"][:3]
    theta_full = np.zeros(20)
    theta_full[[9, 11, 19]] = a1 - a3, a2 / 0.35, a3  # Izz_1, mx_2, Izz_2
    return np.concatenate([columns.base.map @ theta_full, THETA["M"][3:], [0.0, 0.0]])


@pytest.mark.parametrize("noise_rad_s", [0.0, 0.02, 0.1])
def test_an_arm_does_not_look_lighter_by_the_noise_of_its_velocities(noise_rad_s):
    columns = offline.model_of(planar_chain((0.0, 0.0, 0.0)))
    record = planar_record(np.random.default_rng(3), noise_rad_s, torque_noise=0.01)
    settings = OfflineSettings(noise_Nm=(0.01, 0.01), velocity_noise_rad_s=noise_rad_s)
    estimate = offline.identify(columns, record, offline.prior(columns), settings)
    inertia = [columns.parameter_names.index(name) for name in ("Izz_1", "Izz_2")]
    np.testing.assert_allclose(estimate.theta[inertia], planar_truth(columns)[inertia], rtol=0.02)


def test_deviations_are_those_of_noise_where_the_model_is_right_and_larger_where_it_is_wrong():
    columns = offline.model_of(planar_chain((0.0, 0.0, 0.0)))
    settings, before = OfflineSettings(noise_Nm=(0.01, 0.01)), offline.prior(columns)
    truth, ratios, errors = planar_truth(columns), [], []
    for lacking in (0.0, 0.1):
        record = planar_record(np.random.default_rng(4), torque_noise=0.01, lacking=lacking)
        estimate = offline.identify(columns, record, before, settings)
        deviation = offline.parameter_deviation(columns, [record], before, estimate, settings)
        ratios.append(np.median(deviation / np.sqrt(np.diag(estimate.P))))
        errors.append(np.sqrt(np.mean(((estimate.theta - truth) / deviation) ** 2)))
    assert ratios[0] < 1.5
    assert ratios[1] > 10.0
    assert max(errors) < 3.0


def test_a_push_that_sways_around_its_threshold_is_one_contact():
    tau_ext_hat = np.zeros((200, 2))
    tau_ext_hat[20:160, 1] = 0.7
    tau_ext_hat[20:60, 1] = tau_ext_hat[120:130, 1] = 1.5
    assert [sample for sample, _, _ in offline.find_contacts(tau_ext_hat, np.ones((200, 2)), 30)] == [20]
    tau_ext_hat[70:110, 1] = 0.4
    assert [sample for sample, _, _ in offline.find_contacts(tau_ext_hat, np.ones((200, 2)), 30)] == [20, 120]


def test_the_filters_leave_the_noise_that_is_reckoned_with():
    settings = OfflineSettings(noise_Nm=(0.1, 0.1), velocity_noise_rad_s=0.0)
    columns = offline.model_of(planar_chain((0.0, 0.0, 0.0)))
    rng = np.random.default_rng(1)
    still = np.zeros((60_000, 2))
    record = Record(still, still, 0.1 * rng.standard_normal(still.shape))
    zero = offline.ModelEstimate(np.zeros(len(columns.parameter_names)), np.zeros((len(columns.parameter_names),) * 2))
    left = offline.filtered(columns, [record], zero, settings)
    np.testing.assert_allclose(left.tau_f.std(axis=0), offline.filtered_noise_Nm(settings), rtol=0.1)
    np.testing.assert_array_equal(left.tau_f, -left.tau_ext_hat)
    assert left.unit[-1] == pytest.approx(1.0)
