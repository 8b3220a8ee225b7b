"""An arm and its host without a bus, for many contacts: the emulator's body, a known model, and the reactions.

It begins where an adaptation would have ended: the model is the arm's own, detection is on, the arm follows the
trajectory. Estimates come from the paper's kernel with a faster filter; contacts and collisions have two thresholds.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from adacd_hil.control.controller import Controller, Floating
from adacd_hil.control.gate import Gate
from adacd_hil.control.reference import Reference
from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.records import ArmState, ContactReport, FaultReason, Reaction, Request, SchemeOutput, SchemeState, Vector
from adacd_hil.scheme.contact import course
from adacd_hil.scheme.contact.contact_report import new_rows, put_row, recalled_report
from adacd_hil.scheme.kernel import paper_kernel
from adacd_hil.scheme.kernel.cycle import DECISION, decide, follow_contact, new_course
from adacd_hil.scheme.kernel.kernel_samples import SAMPLE, fill_sample
from adacd_hil.scheme.supervisor import findings
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings, merge
from adacd_hil.settings.parsing import parse
from firmware_sim.arm.sensing import POSITION_LSB_RAD, TORQUE_LSB_NM, VELOCITY_LSB_RAD_S, DriveMode, Measurement
from firmware_sim.arm.touch_settings import ticks
from firmware_sim.body.body import Body
from firmware_sim.scenario.scenario import Scenario

SIGMA_NM = np.array([0.03, 0.015])
"""Standard deviation of the external torque with the filter undone, profile P."""
CUT_OFF_rad_s = 50.0
LAG_SHARE = 0.6
"""The velocity is 1.6 ms behind the torque, which is delayed as much."""
_TORQUE = (DriveMode.TORQUE, DriveMode.TORQUE)
_TRUTH = TRUTH_LAYOUT.slices


def rig_settings(**sections: Any) -> Settings:
    """Return the settings of profile P for a rig, with some replaced, each section a dict."""
    paper = load_settings("paper", "P")
    table = {
        "arm": {"cad_theta": list(paper.arm.cad_theta)},
        "filter": {"a_rad_s": CUT_OFF_rad_s, "b_rad_s": CUT_OFF_rad_s},
        "detector": {"threshold_Nm": [0.15, 0.08], "collision_Nm": [2.0, 1.0]},
        "safety": {"commission_s": 0.01},
        "reaction": {"start": "measured", "rebound_s": 0.2},
        "realtime": {"sample_period": "nominal"},
    }
    return parse(Settings, merge(table, sections))


class Sample(NamedTuple):
    """One cycle of a rig."""

    output: SchemeOutput
    truth: Vector
    q_d: Vector
    tau_c: Vector

    def true(self, name: str) -> Vector:
        """Return a field of the truth."""
        return self.truth[_TRUTH[name]]


class Rig:
    """One arm that moves on; `step` is a cycle. acknowledge_after_s: what the user takes after a stop, 0: never."""

    def __init__(self, settings: Settings, scenario: Scenario, acknowledge_after_s: float = 0.0) -> None:
        self.settings = settings
        self._body = Body(scenario)
        self._ticks = ticks(settings.bus.period_s)
        self._body.start_scenario()
        self._theta = np.array(self._theta_of())
        self._constants, self._memory, self._block, self._values = paper_kernel.numbers_of(settings)
        paper_kernel.begin_adaptation(self._constants, self._memory, self._block)
        self._block[0]["theta_hat"][:] = self._theta
        self._collision_Nm = np.array(settings.detector.collision_Nm)
        self._course_constants, self._course_memory = new_course(settings)
        self._course_memory["is_model_valid"] = 1
        self._contact = self._course_memory["contact"][0]
        self._rows = new_rows(settings)
        certified = dataclasses.replace(settings, scheme="certified")
        course.fill_constants(certified, self._course_constants["contact"][0])
        self._sample, self._decision = np.zeros(1, SAMPLE), np.zeros(1, DECISION)
        self._q_d, self._dq_d, self._ddq_d = np.zeros(2), np.zeros(2), np.zeros(2)
        self._tau_d, self._tau_c = np.zeros(2), np.zeros(2)
        self._reference = Reference(settings, self._q_d, self._dq_d, self._ddq_d)
        self._controller, self._floating = Controller(settings), Floating(settings)
        self._controller.feed_forward(self._theta)
        self._gate = Gate(settings.arm, settings.bus.period_s)
        self._cycle = 0
        self._state = SchemeState.INIT
        self._stopped_cycles = 0
        self._acknowledge_cycles = round(acknowledge_after_s / settings.bus.period_s)
        arm = self._arm(self._body.sample())
        self._torques = [arm.tau_J] * 3
        self._q_d[:] = arm.q
        rest = findings.AT_REST | findings.UNLOADED
        while self._supervised is not SchemeState.MONITOR:
            is_late = self._supervised is SchemeState.ADAPT
            self._decide(arm, Request.NONE, rest | (findings.ADAPTED if is_late else 0))

    @property
    def _supervised(self) -> SchemeState:
        return SchemeState(self._course_memory[0].supervisor.state)

    def _decide(self, arm: ArmState, request: Request, observation: int) -> None:
        fill_sample(self._sample, arm, request)
        decide(self._course_constants[0], self._course_memory[0], self._sample[0], observation, self._decision[0])

    def _follow_contact(self) -> ContactReport | None:
        """Take the contact on; return its report that is due."""
        block, contact = self._block[0], self._contact
        put_row(
            self._rows, int(contact["kept_rows"]), block["q"], block["tau_ext_wide_hat"], SIGMA_NM, block["threshold"]
        )
        contact["kept_rows"] += 1
        torques = block["tau_ext_hat"], block["tau_ext_wide_hat"]
        of_run = self._course_constants[0], self._course_memory[0]
        is_due = follow_contact(*of_run, self._sample[0], self._decision[0], *torques)
        return recalled_report(self.settings, contact, self._rows, self._cycle) if is_due else None

    def _theta_of(self) -> Vector:
        truth = np.zeros(TRUTH_LAYOUT.size)
        self._body.truth(truth)
        return truth[_TRUTH["theta"]]

    def _arm(self, sample: Measurement) -> ArmState:
        return ArmState(
            self._cycle, self._cycle * 1_000_000, 1,
            np.array(sample.position_counts) * POSITION_LSB_RAD,
            np.array(sample.velocity_counts) * VELOCITY_LSB_RAD_S,
            np.array(sample.torque_counts) * TORQUE_LSB_NM,
            (0, 0), (0, 0), True, True, FaultReason.NONE,
        )  # fmt: skip

    def _look(self, arm: ArmState) -> int:
        """Run the kernel and tell contacts from collisions."""
        block = self._block[0]
        self._torques = [arm.tau_J, *self._torques[:2]]
        delayed = (1.0 - LAG_SHARE) * self._torques[1] + LAG_SHARE * self._torques[2]
        block["q"][:], block["dq"][:], block["tau_J"][:] = arm.q, arm.dq, delayed
        observation = paper_kernel.step(self._constants, self._memory, self._block, 1, 1, paper_kernel.ARMED)
        observation &= ~findings.COLLISION
        if np.any(np.abs(block["tau_ext_hat"]) > self._collision_Nm):
            observation |= findings.COLLISION
        is_outside = np.any(np.abs(arm.q) > self.settings.arm.position_limit_rad)
        if observation & findings.OVER_LIMIT and not is_outside:
            observation = observation & ~findings.OVER_LIMIT | findings.OVER_SPEED
        return observation

    def step(self) -> Sample:
        """Run one cycle: what the arm is told acts one cycle later."""
        arm = self._arm(self._body.sample())
        truth = np.zeros(TRUTH_LAYOUT.size)
        self._body.truth(truth)
        observation = self._look(arm)
        previous = self._state
        self._stopped_cycles = self._stopped_cycles + 1 if previous is SchemeState.STOPPED else 0
        is_asked = self._acknowledge_cycles and self._stopped_cycles >= self._acknowledge_cycles
        request = Request.ACKNOWLEDGE if is_asked else Request.NONE
        self._decide(arm, request, observation)
        tau_ext_hat = self._block[0]["tau_ext_hat"].copy()
        contact = self._follow_contact()
        decision, state = self._decision[0], self._supervised
        output = SchemeOutput(
            self._cycle, state, previous, FaultReason(decision["fault"]), int(decision["contact_joints"]), True,
            self._theta, tau_ext_hat, contact, self._values.copy(), Reaction(decision["reaction"]),
        )  # fmt: skip
        self._reference.step(arm, output)
        if self._reference.is_floating:
            self._floating.torque(arm.q, arm.dq, tau_ext_hat, self._theta, self._tau_d)
        else:
            self._floating.begin()
            self._controller.torque(arm.q, arm.dq, self._q_d, self._dq_d, self._ddq_d, self._tau_d)
        self._body.advance(
            self._tau_c, _TORQUE if state is not SchemeState.FAULT else (DriveMode.BRAKE,) * 2, self._ticks
        )
        self._gate.limit(self._tau_d, state is not SchemeState.FAULT, self._tau_c)
        self._state = state
        self._cycle += 1
        return Sample(output, truth, self._q_d.copy(), self._tau_c.copy())

    def run(self, duration_s: float) -> list[Sample]:
        """Run some time."""
        return [self.step() for _ in range(round(duration_s / self.settings.bus.period_s))]


def reports(samples: list[Sample], is_final: bool = True) -> list[ContactReport]:
    """List the reports of a record."""
    found = [sample.output.contact for sample in samples]
    return [report for report in found if report is not None and report.is_final == is_final]
