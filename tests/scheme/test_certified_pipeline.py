"""The certified pipeline: in closed loop with a small arm, and on recorded samples."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from excited_arm import PERIOD_S, SETTINGS, ExcitedLoop, arm_state, record
from planar_arm import PAYLOAD_1KG, THETA

from adacd_hil.records import ContactLevel, Reaction, Request, SchemeState, certified_layout, scheme_layout
from adacd_hil.scheme.kernel import certified_memory
from adacd_hil.scheme.pipeline.new_pipeline import new_pipeline

PLACES = certified_layout(7, SETTINGS.further_count, SETTINGS.channel_count).slices
BEFORE = 12
"""Cycles at rest until the first in which an arm learns."""
PRIOR = certified_memory.prior_of(SETTINGS)


def names(outputs):
    return [state.name for state, _ in itertools.groupby(output.state for output in outputs)]


def first_in(outputs, state):
    return next(k for k, output in enumerate(outputs) if output.state is state)


def column(outputs, name):
    return np.array([output.block[PLACES[name]] for output in outputs])


def theta_of(output):
    return output.block[PLACES["theta_hat"]]


def reports_of(outputs):
    return [output.contact for output in outputs if output.contact is not None]


@pytest.fixture(scope="module")
def whole():
    """Certified from zero; pushed while it monitors; 1 kg fitted; certified again."""
    loop = ExcitedLoop()
    learnt = loop.run_until(SchemeState.MONITOR) + loop.run(300)
    loop.tau_ext[0] = 1.0
    pushed = loop.run(150)
    loop.tau_ext[0] = 0.0
    pushed += loop.run_until(SchemeState.MONITOR) + loop.run(100)
    loop.request = Request.PAYLOAD
    fitted = loop.run(400)
    loop.theta = loop.theta + PAYLOAD_1KG
    loop.request = Request.PAYLOAD_CHANGED
    fitted += loop.run_until(SchemeState.MONITOR)
    return learnt, pushed, fitted


@pytest.fixture(scope="module")
def interrupted():
    """Pushed with 1 Nm for 0.3 s while it learns, then certified."""
    loop = ExcitedLoop()
    outputs = loop.run(711)
    loop.tau_ext[0] = 1.0
    outputs += loop.run(300)
    loop.tau_ext[0] = 0.0
    return outputs + loop.run_until(SchemeState.MONITOR)


def test_an_arm_learns_is_tested_and_monitors_and_what_passed_the_test_is_fed_forward(whole):
    learnt, _, _ = whole
    assert names(learnt) == ["COMMISSION", "ENABLE", "ADAPT", "CERTIFY", "MONITOR"]
    armed, tested = first_in(learnt, SchemeState.MONITOR), first_in(learnt, SchemeState.CERTIFY)
    assert (armed - first_in(learnt, SchemeState.ADAPT)) * PERIOD_S <= 2.5
    assert not any(output.is_model_valid or np.any(output.theta_ff) for output in learnt[:armed])
    assert all(output.is_model_valid for output in learnt[armed:])
    np.testing.assert_array_equal(learnt[armed].theta_ff, theta_of(learnt[tested + 1]))
    np.testing.assert_array_equal(learnt[armed].theta_ff, theta_of(learnt[armed]))


def test_each_test_of_a_fit_takes_its_whole_time(whole):
    learnt, _, fitted = whole
    for outputs, test_s in zip((learnt, fitted), SETTINGS.certified.test_s, strict=True):
        tested = [output for output in outputs if output.state is SchemeState.CERTIFY]
        assert len(tested) == round(test_s / PERIOD_S)


def test_a_push_while_it_monitors_is_reacted_to_reported_and_clears_and_leaves_the_model_as_it_was(whole):
    learnt, pushed, _ = whole
    assert names(pushed) == ["MONITOR", "REACT", "MONITOR"]
    begin = first_in(pushed, SchemeState.REACT)
    assert begin <= 20
    assert pushed[begin].contact_joints & 0b01
    assert (pushed[begin].reaction, pushed[-1].reaction) == (Reaction.STOP, Reaction.NONE)
    *first, final = reports_of(pushed)
    assert {report.is_final for report in first} == {False}
    assert final.is_final
    assert {report.cycle for report in (*first, final)} == {pushed[begin].cycle}
    assert (final.link, final.direction, final.level) == (1, (1, 0), ContactLevel.CONTACT)
    assert abs(final.tau_ext_peak[0] - 1.0) < 0.3
    assert pushed[-1].is_model_valid
    theta = column(pushed, "theta_hat")
    np.testing.assert_array_equal(theta, np.tile(theta_of(learnt[-1]), (len(theta), 1)))


def test_a_payload_is_learnt_on_top_of_the_certified_arm_in_a_second(whole):
    """Meanwhile the model before it is fed forward."""
    _, pushed, fitted = whole
    assert names(fitted) == ["PAYLOAD", "ADAPT", "CERTIFY", "MONITOR"]
    begin, armed = first_in(fitted, SchemeState.ADAPT), first_in(fitted, SchemeState.MONITOR)
    assert (armed - begin) * PERIOD_S <= 1.0
    np.testing.assert_array_equal(theta_of(fitted[begin + 1]), theta_of(pushed[-1]))
    np.testing.assert_allclose(theta_of(fitted[-1])[:3] - theta_of(pushed[-1])[:3], PAYLOAD_1KG[:3], atol=0.02)
    for output in fitted[:-1]:
        np.testing.assert_array_equal(output.theta_ff, pushed[-1].theta_ff)
    np.testing.assert_array_equal(fitted[-1].theta_ff, theta_of(fitted[-1]))


def test_a_touch_while_it_learns_is_reported_and_the_arm_is_learnt_anew_from_nothing(whole, interrupted):
    """As well as without the touch, by what its parameters differ in: inertia as large as 5 % of the arm's."""
    assert names(interrupted)[2:] == ["ADAPT", "REACT", "ADAPT", "CERTIFY", "MONITOR"]
    touched, armed = first_in(interrupted, SchemeState.REACT), first_in(interrupted, SchemeState.MONITOR)
    assert touched - 711 <= 50
    reports = reports_of(interrupted)
    assert (reports[0].is_final, reports[-1].is_final) == (False, True)
    assert (reports[-1].link, reports[-1].direction[0]) == (1, 1)
    again = interrupted[touched + first_in(interrupted[touched:], SchemeState.ADAPT) + 1]
    theta = np.concatenate([theta_of(again), again.block[PLACES["theta_further"]]])
    np.testing.assert_array_equal(theta, PRIOR)
    assert np.max(np.abs(theta_of(interrupted[touched]))) > 0.01
    assert again.block[PLACES["excitation"]] == 0.0
    np.testing.assert_allclose(theta_of(interrupted[-1])[:3], theta_of(whole[0][-1])[:3], atol=0.01)
    assert not any(output.is_model_valid for output in interrupted[:armed])
    assert interrupted[armed].is_model_valid


def test_a_model_that_fails_its_test_is_learnt_anew_from_nothing():
    loop = ExcitedLoop(replace(SETTINGS, certified=replace(SETTINGS.certified, beta_Nm=0.001)))
    outputs = loop.run_until(SchemeState.CERTIFY) + loop.run_until(SchemeState.ADAPT) + loop.run(1)
    assert names(outputs)[2:] == ["ADAPT", "CERTIFY", "ADAPT"]
    np.testing.assert_array_equal(theta_of(outputs[-1]), PRIOR[:7])
    assert not outputs[-1].is_model_valid


def test_a_test_that_a_touch_has_broken_off_is_no_certificate_for_an_arm_that_then_stands_still():
    """The fit is forgotten; at rest no model at all would pass the test."""
    loop = ExcitedLoop()
    loop.run_until(SchemeState.CERTIFY)
    loop.run(300)
    loop.tau_ext[0] = 1.0
    assert names(loop.run_until(SchemeState.REACT)) == ["CERTIFY", "REACT"]
    loop.tau_ext[0] = 0.0
    outputs = loop.run_until(SchemeState.ADAPT)
    standing = arm_state(0, loop.q, tau_J=loop.tau)
    outputs += [loop.pipeline.step(standing._replace(cycle=loop.cycle + k)) for k in range(1000)]
    assert names(outputs) == ["REACT", "ADAPT"]
    np.testing.assert_array_equal(outputs[-1].theta_ff, 0.0)
    assert not outputs[-1].is_model_valid


def test_both_schemes_count_from_sample_to_sample_by_the_stamps_or_by_whole_periods_where_told_so():
    """SYNCs that are late, and a sample that is lost; the paper's scheme gives the same bits alone and beside."""
    late_ns = np.random.default_rng(5).integers(0, 200_000, 600)
    samples = zip(*record(THETA["P"], 0.6, seed=4), strict=True)
    late = [arm_state(k, *values, t_ns=k * 1_000_000 + int(late_ns[k])) for k, values in enumerate(samples)]
    late[300] = late[300]._replace(is_complete=False, steps=0)
    late[301] = late[301]._replace(steps=2)
    found = []
    for sample_period in ("measured", "nominal"):
        settings = replace(SETTINGS, realtime=replace(SETTINGS.realtime, sample_period=sample_period))
        pipelines = new_pipeline(settings), new_pipeline(replace(settings, scheme="paper"))
        outputs, paper = ([pipeline.step(arm) for arm in late] for pipeline in pipelines)
        alone = np.array([output.block[scheme_layout(7).slices["tau_ext_hat"]] for output in paper])
        np.testing.assert_array_equal(column(outputs, "paper_tau_ext_hat"), alone)
        found.append(outputs)
    measured, nominal = found
    fresh = np.delete(np.arange(600), 300)
    interval_ns = np.diff(fresh * 1_000_000 + late_ns[fresh])
    np.testing.assert_array_equal(column(measured, "period_s")[fresh[1:], 0], interval_ns * 1e-9)
    np.testing.assert_allclose(column(nominal, "period_s")[fresh[1:], 0], np.diff(fresh) * 1e-3)
    for name in ("tau_ext_hat", "paper_tau_ext_hat"):
        assert np.max(np.abs(column(measured, name) - column(nominal, name))) > 1e-5


def test_the_block_is_laid_out_as_the_records_say():
    pipeline = new_pipeline(SETTINGS)
    outputs = [pipeline.step(arm_state(k, (0.1, 0.2), (0.03, 0.04), (0.5, 0.6))) for k in range(30)]
    block = outputs[-1].block
    assert block.shape == (certified_layout(7, SETTINGS.further_count, 5).size,)
    for name, value in (("q", [0.1, 0.2]), ("dq", [0.03, 0.04]), ("tau_J", [0.5, 0.6])):
        assert block[PLACES[name]].tolist() == value
    bank = block[PLACES["tau_ext_bank"]].reshape(5, 2)
    assert np.all(bank < 0.0)
    assert bank[4, 1] < bank[3, 1] < bank[0, 1]  # a faster filter sees more of the step
    np.testing.assert_array_equal(block[PLACES["theta_std"]][:2], SETTINGS.certified.prior_std[0])
    assert np.all(np.isfinite(block[PLACES["threshold_bank"]]))


def test_detection_is_off_until_the_drives_are_to_be_enabled():
    pipeline = new_pipeline(SETTINGS)
    outputs = [pipeline.step(arm_state(k, is_enabled=False)) for k in range(20)]
    assert outputs[-1].state is SchemeState.ENABLE
    is_off = np.isinf(column(outputs, "threshold_bank")).all(1)
    enabled = first_in(outputs, SchemeState.ENABLE)
    assert is_off[: enabled + 1].all()
    assert not is_off[enabled + 1 :].any()


def test_the_sensors_noise_is_measured_while_the_arm_is_commissioned_and_never_later():
    pipeline = new_pipeline(SETTINGS)
    noise = 0.08 * np.random.default_rng(3).standard_normal((400, 2))
    restless = [pipeline.step(arm_state(k, dq=(0.06, 0.06), tau_J=noise[k])) for k in range(400)]
    assert restless[-1].state is SchemeState.COMMISSION
    roughness = pipeline.numbers.memory[0].sensitivity.roughness
    np.testing.assert_allclose(roughness, (0.08 / SETTINGS.certified.torque_noise_Nm) ** 2, rtol=0.2)
    rest = [pipeline.step(arm_state(400 + k)) for k in range(BEFORE)]
    assert rest[-1].state is SchemeState.ADAPT
    before = roughness.copy()
    for k in range(50):
        pipeline.step(arm_state(412 + k, tau_J=5.0 * noise[k]))
    np.testing.assert_array_equal(roughness, before)
