"""A motion in closed form, the torque that goes with it, and the compiled step run over it."""

import numpy as np

from adacd_hil.records import scheme_layout
from adacd_hil.scheme.kernel import paper_kernel
from adacd_hil.scheme.model.regressor import inverse_dynamics
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings, merge
from adacd_hil.settings.parsing import parse

PLACES = scheme_layout(7).slices


def settings_with(**sections) -> Settings:
    """Resolve the paper's settings with some replaced, each section a dict."""
    table = {"estimator": {"P0": [8.0, 4.0, 4.0, 0.5, 0.5, 0.5, 0.5]}, "arm": {}}
    paper = load_settings("paper", "P")
    table["arm"]["cad_theta"] = list(paper.arm.cad_theta)
    return parse(Settings, merge(table, sections))


def smooth_motion(t_s, speed=1.0):
    """Return q, dq, ddq (n, 2): two sines per joint, of no common period."""
    amplitudes, rates = np.array([[0.5, 0.9], [0.15, 0.2]]), speed * np.array([[1.7, 1.1], [4.1, 3.3]])
    phase = rates[:, None, :] * t_s[None, :, None] + np.array([[[0.3, 1.0]], [[0.0, 2.0]]])
    q = np.sum(amplitudes[:, None, :] * np.sin(phase), axis=0)
    dq = np.sum((amplitudes * rates)[:, None, :] * np.cos(phase), axis=0)
    ddq = np.sum((-amplitudes * rates**2)[:, None, :] * np.sin(phase), axis=0)
    return q, dq, ddq


def torque_of(q, dq, ddq, theta, tau_ext=None):
    """Return the joint torque (n, 2) that makes the arm move like this against the external torque (n, 2)."""
    tau = np.array([inverse_dynamics(*row, theta, 0.0) for row in zip(q, dq, ddq, strict=True)])
    return tau if tau_ext is None else tau - tau_ext


class PaperKernel:
    """The paper's compiled step with its arrays, sample by sample."""

    def __init__(self, settings):
        self.numbers = paper_kernel.numbers_of(settings)
        self.m, self.out = self.numbers.memory[0], self.numbers.block[0]
        self.begin()

    def begin(self):
        paper_kernel.begin_adaptation(*self.numbers[:3])

    def step(self, mode, is_fresh=1, periods=1, **sample):
        """Take in a sample, of which what isn't given stays as it was."""
        for name, value in sample.items():
            self.out[name] = value
        return paper_kernel.step(*self.numbers[:3], is_fresh, periods, mode)


def run_kernel(settings, q, dq, tau_J, theta_hat, mode, is_complete=None, periods=None, period_s=None):
    """Run the compiled step over a record; return blocks (n, size)."""
    kernel, count = PaperKernel(settings), q.shape[0]
    kernel.out.theta_hat = theta_hat
    blocks = np.zeros((count, kernel.numbers.values.size))
    for k in range(count):
        is_fresh = 1 if is_complete is None else int(is_complete[k])
        each_s = 0.0 if period_s is None else period_s[k]
        sample = {"q": q[k], "dq": dq[k], "tau_J": tau_J[k], "period_s": each_s}
        kernel.step(mode, is_fresh, 1 if periods is None else int(periods[k]), **sample)
        blocks[k] = kernel.numbers.values
    return blocks
