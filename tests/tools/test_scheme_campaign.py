"""tools/campaigns/scheme_campaign.py: its bound, its counting and its tables, on numbers made by hand."""

import numpy as np
import pytest
from campaign_bound import Bound, fit, threshold_sigma, whiten
from campaign_figures import figure_table, is_all_good, variant_table
from campaign_schemes import ADAPTING, ARMED, Outcome
from campaign_trials import alarms, is_moving, judge_contact
from lab import Motion, Recording, profile_arm

from firmware_sim.arm.touch_settings import ContactSettings

WHITE = np.zeros((1, 2, 2))
STEP = np.stack([np.stack([np.ones(250), np.zeros(250)], 1), np.stack([np.zeros(250), np.ones(250)], 1)])


def outcome_of(over: np.ndarray, tau_ext_hat: np.ndarray | None = None, phase: int = ARMED) -> Outcome:
    shape = (len(over), 2)
    tau = np.zeros(shape) if tau_ext_hat is None else tau_ext_hat
    return Outcome(np.full(len(over), phase), over, tau, tau, np.full(shape, 0.1), np.sign(tau), (0,), np.zeros((1, 7)))


def test_the_bound_of_a_step_in_white_noise_is_that_of_its_mean():
    bound = Bound(WHITE, 0.02**2 * np.eye(2), STEP)
    needed = (threshold_sigma() * 0.02 / 0.03) ** 2  # samples
    assert bound.delay_s(0, 0.03) == pytest.approx((np.ceil(needed) - 0.5) * 1e-3)
    assert bound.smallest_Nm(1) == pytest.approx(threshold_sigma() * 0.02 / np.sqrt(101))
    assert bound.delay_s(1, 1e-3) == np.inf


def test_a_contact_is_found_by_the_torque_of_both_joints():
    bound = Bound(WHITE, 0.02**2 * np.eye(2), STEP)
    one, both = np.full((50, 2), [0.03, 0.0]), np.full((50, 2), [0.03, 0.03])
    assert bound.contact_delay_s(one) == bound.delay_s(0, 0.03)
    assert bound.contact_delay_s(both) < bound.contact_delay_s(one)


def test_the_autoregression_of_noise_is_found_without_the_samples_that_don_t_count():
    generator = np.random.default_rng(1)
    white = generator.standard_normal((8000, 2))
    noise, matrix = white.copy(), np.array([[0.8, 0.3], [0.0, 0.5]])
    for k in range(1, len(noise)):
        noise[k] += matrix @ noise[k - 1]
    assert whiten(noise, matrix[np.newaxis]) == pytest.approx(white)
    noise[5000:5100] = 50.0
    is_good = np.ones(len(noise), bool)
    is_good[4999:5101] = False
    coefficients, covariance = fit(noise, is_good)
    assert coefficients[0] == pytest.approx(matrix, abs=0.05)
    assert covariance == pytest.approx(np.eye(2), abs=0.06)


def test_alarms_close_to_each_other_are_one_and_those_while_adapting_none():
    over = np.zeros(3000, np.int64)
    over[[100, 101, 400, 2000]] = 1
    assert alarms(outcome_of(over), 0, 3000) == 2
    assert alarms(outcome_of(over), 0, 1000) == 1
    assert alarms(outcome_of(over), 500, 1000) == 0
    assert alarms(outcome_of(over, phase=ADAPTING), 0, 3000) == 0


def test_a_joint_counts_as_moving_half_a_second_after_it_stood():
    dq_d = np.full((1200, 2), 0.5)
    dq_d[600:610, 1] = 0.0
    moving = is_moving(Motion("", 0.0 * dq_d, dq_d, 0.0 * dq_d))
    assert moving[:, 0].all()
    assert np.flatnonzero(~moving[:, 1]).tolist() == list(range(600, 1110))


def judged(found_over: list[int], sign: float = 1.0):
    contact = ContactSettings(at_s=0.1, link=2, point_m=0.2, force_N=20.0, duration_s=0.05, angle_deg=90.0)
    q = np.tile([0.0, 0.5], (300, 1))
    across = 0.35 * np.cos(0.5)
    tau_ext = np.zeros((300, 2))
    tau_ext[100:150] = [20.0 * (across + 0.2), 4.0]
    over = np.zeros(300, np.int64)
    over[103 : 103 + len(found_over)] = found_over
    zeros = np.zeros((300, 2))
    arm, motion = profile_arm("S"), Motion("", q, zeros, zeros)
    theta = np.zeros((300, 7))
    recording = Recording(arm, motion, (contact,), (), 0, q, zeros, zeros, zeros, tau_ext, theta)
    outcome = outcome_of(over, sign * 1.02 * tau_ext)
    return judge_contact(contact, recording, outcome, Bound(WHITE, 0.02**2 * np.eye(2), STEP))


def test_a_contact_is_judged_by_link_direction_size_and_place():
    row = judged([1, 1, 3])
    assert (row["delay_s"], row["found_link"], row["is_hidden"]) == (pytest.approx(3e-3), 2, False)
    assert row["is_direction_right"]
    assert row["peak_ratio"] == pytest.approx(1.02)
    assert row["force_ratio"] == pytest.approx(1.02)
    assert row["lever_error_m"] == pytest.approx(0.0, abs=1e-12)
    assert judged([1])["found_link"] == 1
    assert not judged([1], sign=-1.0)["is_direction_right"]
    assert judged([])["delay_s"] == np.inf


def watched(scheme: str, alarm_count: int, took_s: float):
    labels = {"scheme": scheme, "profile": "S", "seed": 1, "loaded": False, "friction": "plain"}
    told = {"took_s": (took_s,), "is_armed": True, "watched_s": 3600.0 * 24.0, "alarms": alarm_count}
    return labels | told | {"residual_Nm": [0.01, 0.02]}


def test_the_last_scheme_must_reach_what_is_wanted():
    parts = ("arms", "variants", "day", "steps", "contacts", "touches")
    bounds = {("S", loaded): Bound(WHITE, 0.02**2 * np.eye(2), STEP) for loaded in (False, True)}
    for last, is_good in ((0, True), (1, False)):
        rows = {part: [] for part in parts} | {
            part: [watched("paper", 3, 5.2), watched("certified", last, 2.1)] for part in ("arms", "variants", "day")
        }
        table = figure_table(rows, ("paper", "certified"), bounds)
        assert is_all_good(table) is is_good
        line = next(line for line in table.lines if line["name"].startswith("false alarms in 60 s, random"))
        assert (line["paper"], line["certified"]) == (3.0, last)
        assert "5.20" in variant_table(rows, ("paper", "certified"))
