"""The pipeline: the paper's scheme in closed loop with an arm, and both schemes cycle by cycle."""

from dataclasses import replace

import numpy as np
import pytest
from excited_arm import SETTINGS as CERTIFIED
from excited_arm import ExcitedLoop, arm_state
from planar_arm import THETA
from smooth_motion import PLACES, PaperKernel, settings_with, smooth_motion, torque_of

from adacd_hil.control.motions import corner_to_corner
from adacd_hil.records import FaultReason, SchemeState
from adacd_hil.scheme.kernel import paper_kernel
from adacd_hil.scheme.pipeline.new_pipeline import new_pipeline
from adacd_hil.scheme.supervisor import findings
from adacd_hil.settings.configuration_files import load_settings

PAPER = load_settings("paper", "P")
NEVER_ALARM = {"detector": {"threshold_Nm": [50.0, 50.0]}}


class PaperMotion:
    """The paper's motion by cycles: from corner to corner, each joint in its own time."""

    def __init__(self, settings):
        self.amplitude = np.radians(settings.trajectory.amplitude_deg)
        self.half_period_s = np.array(settings.trajectory.half_period_s)

    def at(self, cycle):
        """Return q_d, dq_d, ddq_d (3, 2)."""
        motion = np.zeros((3, 2))
        corner_to_corner(cycle * 1e-3, self.amplitude, self.half_period_s, *motion)
        return motion


class PaperLoop(ExcitedLoop):
    """The arm on the paper's motion, watched by the paper's scheme."""

    def __init__(self, settings=PAPER):
        super().__init__(settings, motion=PaperMotion(settings))

    def monitor(self):
        outputs = self.run_until(SchemeState.MONITOR, 20_000)
        return outputs + self.run(300)


@pytest.mark.slow
@pytest.mark.parametrize("is_standing", [True, False])
def test_without_motion_or_without_enough_information_the_adaptation_never_ends(is_standing):
    """Eq. (15) alone would end it after 5 s, of an arm that stands still with theta_hat = 0."""
    loop = PaperLoop(settings_with(termination={"timeout_s": 8.0, "excitation_Nm2s": 2e-4 if is_standing else 1.0}))
    if is_standing:
        loop.move = lambda _output: None
    last = loop.run_until(SchemeState.FAULT, 9000)[-1]
    assert last.fault is FaultReason.ADAPT_TIMEOUT
    assert last.block[PLACES["quiet_s"]] >= 5.0


@pytest.mark.slow
def test_the_gradient_law_ends_its_adaptation_too():
    assert len(PaperLoop(settings_with(estimator={"law": "gradient"}, **NEVER_ALARM)).monitor()) < 8000


@pytest.mark.parametrize("scheme", ["paper", "certified"])
def test_an_output_is_not_changed_by_the_next_cycle(scheme):
    pipeline = new_pipeline(replace(CERTIFIED, scheme=scheme))
    first = pipeline.step(arm_state(0, q=(0.1, 0.2)))
    kept = first.block.copy(), first.tau_ext_hat.copy()
    for cycle in range(1, 20):
        pipeline.step(arm_state(cycle, q=(0.3, 0.4), tau_J=(1.0, 1.0)))
    np.testing.assert_array_equal(first.block, kept[0])
    np.testing.assert_array_equal(first.tau_ext_hat, kept[1])


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"q": np.array((np.nan, 0.0))}, FaultReason.NOT_A_NUMBER),
        ({"dq": np.array((0.0, np.inf))}, FaultReason.NOT_A_NUMBER),
        ({"tau_J": np.array((0.0, np.nan))}, FaultReason.NOT_A_NUMBER),
        ({"q": np.array((1.4, 0.0))}, FaultReason.LIMIT),
        ({"q": np.array((0.0, -2.2))}, FaultReason.LIMIT),
        ({"dq": np.array((-4.5, 0.0))}, FaultReason.LIMIT),
        ({"dq": np.array((0.0, 5.5))}, FaultReason.LIMIT),
        ({"fault": FaultReason.SENSOR}, FaultReason.SENSOR),
    ],
)
def test_a_moving_arm_that_is_not_well_faults(changes, reason):
    for scheme in ("paper", "certified"):
        pipeline = new_pipeline(replace(CERTIFIED, scheme=scheme))
        states = [pipeline.step(arm_state(k)).state for k in range(20)]
        assert states[-1] is SchemeState.ADAPT
        assert pipeline.step(arm_state(20, **changes)).fault is reason


@pytest.mark.parametrize("changes", [{"dq": (0.06, 0.0)}, {"dq": (0.0, -0.06)}, {"tau_J": (1.1, 0.0)}])
def test_an_arm_that_moves_or_is_loaded_is_not_commissioned(changes):
    pipeline = new_pipeline(settings_with(safety={"commission_s": 0.01}))
    states = [pipeline.step(arm_state(k, **changes)).state for k in range(100)]
    assert states[-1] is SchemeState.COMMISSION


def test_a_model_without_positive_definite_mass_is_not_fed_forward():
    """Of an arm at rest: theta_hat = 0."""
    easy = {"hold_s": 0.1, "travel_deg": 0.0, "velocity_deg_s": 0.0, "excitation_Nm2s": 0.0}
    pipeline = new_pipeline(settings_with(safety={"commission_s": 0.01}, termination=easy))
    outputs = [pipeline.step(arm_state(k)) for k in range(120)]
    assert outputs[-1].state is SchemeState.MONITOR
    assert not outputs[-1].is_model_valid


def test_an_adaptation_begins_without_the_evidence_of_the_last():
    settings = settings_with(termination={"beta_Nm": 50.0, "hold_s": 0.1, "excitation_Nm2s": 0.0})
    kernel = PaperKernel(settings)
    q, dq, ddq = smooth_motion(np.arange(3000) * 1e-3)
    for row in zip(q, dq, torque_of(q, dq, ddq, THETA["M"]), strict=True):
        moving = kernel.step(paper_kernel.LEARN, **dict(zip(("q", "dq", "tau_J"), row, strict=True)))
    assert moving & findings.ADAPTED
    assert kernel.out.excitation > 1e-5
    kernel.begin()
    kernel.step(paper_kernel.LEARN, dq=0.0)
    assert kernel.out.quiet_s == settings.bus.period_s
    assert not any(kernel.step(paper_kernel.LEARN) & findings.ADAPTED for _ in range(200))
    assert kernel.out.excitation < 1e-12


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("missing", ["q", "dq"])
def test_an_adaptation_needs_travel_and_speed_of_its_own(missing, sign):
    """What joint 2 did before this adaptation does not count in it."""
    easy = {"beta_Nm": 50.0, "hold_s": 0.1, "excitation_Nm2s": 0.0, "travel_deg": 20.0}
    kernel = PaperKernel(settings_with(termination=easy))
    moves = {"q": [(-0.5, -0.5), (0.5, 0.5)], "dq": [(-1.0, -1.0), (1.0, 1.0)]}
    seen = []
    for this_time in (moves, moves | {missing: [(0.4, sign * 0.3), (0.8, sign * 0.3)]}):
        kernel.begin()
        for k in range(200):
            found = kernel.step(paper_kernel.LEARN, q=this_time["q"][k % 2], dq=this_time["dq"][k % 2])
        seen.append(bool(found & findings.ADAPTED))
    assert seen == [True, False]


def test_an_adaptation_forgets_what_the_filters_held():
    pipeline = new_pipeline(settings_with(safety={"commission_s": 0.01}))
    outputs = [pipeline.step(arm_state(k, tau_J=(0.5, 0.0), is_enabled=k > 500)) for k in range(510)]
    begin = next(k for k, output in enumerate(outputs) if output.state is SchemeState.ADAPT)
    assert abs(outputs[begin].tau_ext_hat[0]) > 0.4
    assert outputs[begin + 1].tau_ext_hat[0] == 0.0
