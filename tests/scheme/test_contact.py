"""What is told of a collision: strength and link."""

import numpy as np
import pytest
from contact_course import Course
from smooth_motion import PLACES, PaperKernel, run_kernel, settings_with

from adacd_hil.records import SchemeState
from adacd_hil.scheme.contact.contact_report import integrated_report
from adacd_hil.scheme.detect.undone_filter import follow_contact
from adacd_hil.scheme.kernel import paper_kernel

T = 1e-3


def half_sine(size, duration_s, samples=1000, begin=100):
    t_s = (np.arange(samples) - begin) * T
    inside = (t_s >= 0.0) & (t_s <= duration_s)
    return np.where(inside, size * np.sin(np.pi * t_s / duration_s), 0.0)


@pytest.mark.parametrize(("a", "b"), [(10.0, 10.0), (10.0, 2.0), (50.0, 50.0)])
def test_a_torque_step_is_seen_in_full_after_five_samples_whatever_the_filter(a, b):
    tau_ext = np.outer(np.arange(300) >= 100, (2.0, -1.0))
    still = np.zeros_like(tau_ext)
    settings = settings_with(filter={"a_rad_s": a, "b_rad_s": b})
    wide = run_kernel(settings, still, still, -tau_ext, np.zeros(7), 0)[:, PLACES["tau_ext_wide_hat"]]
    np.testing.assert_allclose(wide[106:], tau_ext[106:], rtol=1e-9)


class Touch(PaperKernel):
    """An arm at rest in MONITOR that is touched; steps the compiled kernel and the contact's course together."""

    def __init__(self, window_cycles=50):
        self.settings = settings_with(detector={"isolation_window_s": window_cycles * T})
        super().__init__(self.settings)
        self.course, self.reports = Course(self.settings), []

    def run(self, tau_ext):
        has_begun, tau_ext_hat = False, self.out.tau_ext_hat
        for torque in tau_ext:
            mode = paper_kernel.ARMED | (paper_kernel.REPORTING if self.course.m.is_open else 0)
            joints = self.step(mode, tau_J=-torque) >> paper_kernel.CONTACT_SHIFT
            has_begun = has_begun or joints != 0
            state = SchemeState.REACT if has_begun else SchemeState.MONITOR
            if self.course.step(joints, tau_ext_hat, state=state):
                found = self.course.m, tau_ext_hat, self.m.integral, self.m.peak
                self.reports.append(integrated_report(*found, self.settings.filter.a_rad_s))
        return self.reports


def on_joints(first, second):
    return np.column_stack((first, second))


STEP = np.where(np.arange(400) >= 100, 1.0, 0.0)


@pytest.mark.parametrize(
    ("second", "window_cycles", "links"),
    [
        (0.1 * STEP, 50, [1, 1]),
        (-0.5 * STEP, 50, [1, 2]),
        (0.5 * STEP, 10, [1, 1]),
        (0.1 * STEP, 0, [1]),
    ],
    ids=["below", "crosses later", "crosses after the window", "no window"],
)
def test_a_report_comes_at_once_and_again_when_the_window_ends_in_which_joint_2_may_change_the_link(
    second, window_cycles, links
):
    """Detected 16.3 ms after the step, which is between 99 and 100."""
    reports = Touch(window_cycles).run(on_joints(STEP, second))
    assert [report.is_final for report in reports] == [False, True][-len(links) :]
    assert {report.cycle for report in reports} == {116}
    assert [report.link for report in reports] == links
    assert reports[0].direction == (1, 0)


def test_torque_on_joint_2_that_is_gone_before_the_window_ends_still_counts():
    """0.3 Nm for 80 ms is over the threshold from 69 ms to 100 ms only."""
    brief = np.where((np.arange(400) >= 40) & (np.arange(400) < 120), 0.3, 0.0)
    assert Touch(window_cycles=100).run(on_joints(STEP, brief))[-1].link == 2


@pytest.mark.parametrize(("first", "second"), [(1.0, 0.5), (-1.0, 0.5), (1.0, -0.5), (-1.0, -0.5), (1.0, 0.0)])
def test_the_direction_is_the_sign_of_each_joint_torque(first, second):
    reports = Touch().run(on_joints(first * STEP, second * STEP))
    assert reports[-1].direction == (np.sign(first), np.sign(second))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("duration_s", [0.02, 0.05])
def test_the_final_report_has_the_peak_of_the_contact(duration_s, sign):
    reports = Touch().run(on_joints(sign * half_sine(5.0, duration_s), 0.0 * half_sine(5.0, duration_s)))
    assert abs(reports[-1].tau_ext_peak[0] / (sign * 5.0) - 1.0) < 0.04


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("duration_s", [0.005, 0.02, 0.05])
def test_the_final_report_has_the_impulse_of_the_contact(duration_s, sign):
    """Within 6 %: what passed before |tau_ext_hat| reached half of the threshold is in the filter state only."""
    push = half_sine(10.0, duration_s)
    reports = Touch().run(on_joints(sign * push, 0.0 * push))
    assert abs(reports[-1].impulse[0] / (sign * np.sum(push) * T) - 1.0) < 0.06


def test_the_impulse_of_a_short_touch_is_kept_until_the_window_ends():
    """0.02 Nms raises tau_ext_hat to 0.2 Nm; 120 ms later it is below half of the threshold."""
    push = half_sine(0.02 / (0.004 * 2.0 / np.pi), 0.004)
    reports = Touch(window_cycles=200).run(on_joints(push, 0.0 * push))
    assert abs(reports[-1].impulse[0] / 0.02 - 1.0) < 0.06


def test_the_direction_is_that_of_the_first_contact_of_the_joint():
    """A person who lets go and is pulled along does not turn it round."""
    push = np.where(np.arange(400) < 130, STEP * 3.0, -20.0 * STEP)
    reports = Touch().run(on_joints(push, 0.0 * push))
    assert [report.direction for report in reports] == [(1, 0), (1, 0)]


def test_a_later_contact_has_no_direction_of_the_one_before():
    course = Course(settings_with())
    course.step(1, np.array([3.0, 0.0]))
    course.step(0, np.zeros(2), state=SchemeState.MONITOR)
    course.step(2, np.array([0.0, -2.0]))
    assert course.m.direction.tolist() == [0, -1]


@pytest.mark.parametrize(("share", "integral"), [(0.4, 0.0), (0.6, 0.06)])
def test_a_contact_begins_at_half_of_the_threshold(share, integral):
    found, peak = np.zeros(2), np.zeros(2)
    tau_ext_hat = np.full(2, share)
    for _ in range(100):
        follow_contact(tau_ext_hat, tau_ext_hat, np.ones(2), T, False, found, peak)
    np.testing.assert_allclose(found, integral, rtol=1e-9)
