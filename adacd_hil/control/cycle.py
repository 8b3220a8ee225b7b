"""The loop: read, decide, limit, write, then count and log.

One cycle: SYNC k goes out, feedback and torque of k come in, the scheme decides, the controller follows the desired
motion, the gate limits, the commands go out and act at SYNC k+1. In lockstep the next cycle begins at once; in real
time it begins on the grid.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from adacd_hil.clock import Clock
from adacd_hil.control.controller import Controller, Floating
from adacd_hil.control.exchange import Exchange
from adacd_hil.control.fault_recovery import BOUNDS, STOP, FaultReport, SelfChecks, StopEscalation
from adacd_hil.control.first_motion import FirstMotion, is_shown
from adacd_hil.control.gate import Gate, GateFlag
from adacd_hil.control.operator import Operator, RunNarration
from adacd_hil.control.pacing import Pacer
from adacd_hil.control.reference import MOTION, Reference
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_report import DataShares, DataWatch
from adacd_hil.device.arm_watch import ArmWatch, EventSource, Recurrence
from adacd_hil.device.drive import DISABLE_CYCLES
from adacd_hil.device.network import Master
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.log.types.topics import (
    CONTROL,
    CYCLE,
    ChannelId,
    pack_arm,
    pack_contact,
    pack_frame_checks,
    pack_scheme,
)
from adacd_hil.records import (
    CERTIFICATE_EVENTS,
    CONTROL_LAYOUT,
    ArmCommand,
    ArmState,
    CycleRecord,
    Event,
    FaultReason,
    Request,
    SchemeOutput,
    SchemeState,
)
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.scheme.pipeline.new_pipeline import new_pipeline
from adacd_hil.scheme.supervisor.kept_request import KeptRequest
from adacd_hil.scheme.supervisor.supervisor import POWERED
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Tap

FAULT_LINGER_S = 0.5
"""How long a faulted run goes on, so that the drives' quick stop is in the log."""
FINISH_S = 10.0
"""How long an arm may take to park once it is to finish, three times the longest way; then it ends where it is."""
FRAME_CHECKS_S = 1.0
"""How often the counts of the frame checks are logged."""

_ENABLING = POWERED | {SchemeState.ENABLE}


@dataclass(frozen=True)
class RunResult:
    """How an attempt ended. `fault`: NONE when it ended as asked. `data`: how much of the cyclic data came.

    `cycles`: number of the last cycle + 1; `overruns`: skipped periods; both since the session's first cycle. `state`:
    the last one. `enabled`: drives that last reported Operation enabled.
    """

    cycles: int
    overruns: int
    state: SchemeState
    fault: FaultReason
    is_interrupted: bool
    data: DataShares
    enabled: tuple[str, ...]


class Cycle:
    """The loop of one attempt, with everything that a cycle needs: call `compile`, then `run`."""

    def __init__(
        self,
        settings: Settings,
        bus: Tap,
        arm: Arm,
        master: Master,
        pacer: Pacer,
        operator: Operator,
        progress: Callable[[str], None],
        clock: Clock,
        touched_ns: Callable[[], int | None] = lambda: None,
    ) -> None:
        """Make the cycle's objects. `clock`: measures durations within a cycle.

        `touched_ns`: returns the time since which the arm is touched, None if unknown.
        """
        self._period_s = settings.bus.period_s
        self._frame_checks = Recurrence(FRAME_CHECKS_S, self._period_s)
        self._progress = progress
        self._narration = RunNarration(progress, touched_ns)
        self._bus, self._arm, self._master = bus, arm, master
        self._pacer, self._operator = pacer, operator
        self._exchange = Exchange(settings, bus, arm, master, pacer, clock)
        self._watch = ArmWatch(settings, master.failed_heartbeats)
        self._data = DataWatch(settings, arm)
        self._stale_ns = settings.bus.max_age_cycles * settings.bus.period_ns
        self._pipeline = new_pipeline(settings)
        self._controller = Controller(settings)
        self._floating = Floating(settings)
        self._gate = Gate(settings.arm, self._period_s)
        self._block = np.zeros(CONTROL_LAYOUT.size)
        fields = {name: self._block[place] for name, place in CONTROL_LAYOUT.slices.items()}
        self._q_d, self._dq_d, self._ddq_d = fields["q_d"], fields["dq_d"], fields["ddq_d"]
        self._tau_d, self._tau_c = fields["tau_d"], fields["tau_c"]
        self._reference = Reference(settings, self._q_d, self._dq_d, self._ddq_d)
        self._first_motion = FirstMotion(settings, arm)
        self._checks = SelfChecks(settings, arm, master.parameters, self._q_d, self._first_motion)
        self._faults = FaultReport(settings, arm, self._watch, self._pipeline, self._checks, master)
        self._escalation = StopEscalation(arm, master)
        self._sources: tuple[EventSource, ...] = (
            self._master,
            arm.strangers,
            self._data,
            master.parameters,
            self._escalation,
            self._exchange.events,
            self._first_motion,
            self._reference,
            self._faults.commission,
        )
        self._state = SchemeState.INIT
        self._first_cycle = -1  # before the first
        self._enabled_cycle: int | None = None
        self._faulted_cycle: int | None = None
        self._interrupts = 0
        self._is_finishing = False
        self._finish_cycle = 0
        self._kept = KeptRequest()

    def carry(self, request: Request) -> None:
        """Store an unserved request of the attempt before; `run` repeats it once the drives are enabled."""
        self._kept = KeptRequest(request)

    @property
    def unserved(self) -> Request:
        """Return the user's unserved request to end the run (FINISH) or to change the payload (PAYLOAD), else NONE."""
        return self._kept.request

    @property
    def certificates(self) -> tuple[Certificate, ...]:
        """Return the certificates of this attempt that were not taken back, the oldest first."""
        return self._pipeline.certificates

    def compile(self) -> None:
        """Compile all functions that the loop calls; call it before the drives are enabled."""
        self._pipeline.compile_cycle()
        self._reference.compile_motion()
        self._controller.compile_law()
        self._first_motion.compile_readings()

    def interrupt(self) -> None:
        """Ask the loop to park the arm and end; a second time, to end at once with a quick stop."""
        self._interrupts += 1

    def run(self, recorder: Recorder) -> RunResult:
        """Run and log cycles until the run is finished, faulted or interrupted; disable the drives; return the result.

        After a fault the cycles go on for FAULT_LINGER_S. Raises BusError if sending or receiving fails, in lockstep
        its SilenceError if no device answers; then the drives are not disabled here.
        """
        output = None
        self._pacer.resume()
        while not self._is_over(output):
            tick, arm = self._exchange.turn()
            arm = self._watch.judge(arm)
            request = self._checks.judge(arm, self._state) or self._request(arm.cycle)
            output = self._pipeline.step(arm, request)
            self._reference.step(arm, output)
            self._follow(arm, output)
            command, flags = self._limit(arm, output, self._exchange.leave())
            record = self._exchange.end(tick, arm, command, recorder.waiting_bytes)
            self._data.count_cycle(arm)
            self._faults.commission.count_cycle(self._state, arm)
            self._first_motion.add_cycle(arm, self._state, self._tau_c)
            self._look_after_devices(arm, output)
            self._log(recorder, record, arm, request, output, command, flags)
        fault = output.fault if output is not None else FaultReason.NONE
        if self._is_finishing and self._state in POWERED and not self._reference.is_parked(self._arm.cycle):
            why = (
                "interrupted again before it was parked"
                if self._interrupts > 1
                else f"not parked within {FINISH_S:g} s"
            )
            text = f"{why}: the drives are disabled where the arm is"
            recorder.event(tick.t_ns, Event("warning", "run", text))
            self._progress(text)
        if self._interrupts and output is not None:
            recorder.event(tick.t_ns, Event("warning", "interrupted", "the run was interrupted"))
        self._disable(recorder, quick_stop=fault is not FaultReason.NONE or self._interrupts > 1)
        return RunResult(
            self._arm.cycle + 1,
            self._pacer.overruns,
            self._state,
            fault,
            self._interrupts > 0,
            self._data.finish_shares(),
            tuple(drive.name for drive in self._escalation.enabled),
        )

    @property
    def reached(self) -> tuple[int, SchemeState]:
        """Return the number of the last cycle + 1, and the present state.

        Skipped cycles and those of earlier attempts count, too; 0 before the attempt's first cycle.
        """
        return self._arm.cycle + 1, self._state

    def _look_after_devices(self, arm: ArmState, output: SchemeOutput) -> None:
        """After a fault, set drives that a quick stop has not stopped to Pre-operational; else step `ParameterWatch`.

        The latter, only in states with power, reads the devices' parameters again. Raises BusError if a frame can't be
        sent.
        """
        if self._faulted_cycle is not None:
            self._escalation.step(arm.cycle - self._faulted_cycle, arm.t_ns, output.fault)
        elif output.state in POWERED:
            self._master.parameters.step(arm.cycle, arm.t_ns)

    def _request(self, cycle: int) -> Request:
        """Return this cycle's request for the scheme: FINISH after an interruption, a carried one, or the operator's.

        An interruption requests once, a carried request is made as soon as the drives have been enabled. Store PAYLOAD
        and FINISH until they are served, but no FINISH of an interruption. On FINISH begin to park the arm.
        """
        if self._interrupts and not self._is_finishing:
            return self._finish()
        elapsed_s = None if self._enabled_cycle is None else (cycle - self._enabled_cycle) * self._period_s
        carried = Request.NONE if elapsed_s is None else self._kept.take_carried()
        request = carried or self._operator.request(elapsed_s, self._state)
        self._kept.ask(request, self._state)
        return self._finish() if request is Request.FINISH else request

    def _finish(self) -> Request:
        """Return FINISH, and begin to park the arm if the state has power.

        The first call stores the present cycle, from which FINISH_S counts.
        """
        if not self._is_finishing:
            self._finish_cycle = self._arm.cycle
        self._is_finishing = True
        if self._state in POWERED:
            self._reference.park()
        return Request.FINISH

    def _follow(self, arm: ArmState, output: SchemeOutput) -> None:
        """Fill `_tau_d` with the torque of the floating law while the arm floats, else with the controller's.

        If the scheme's model is valid, first begin to blend the controller's feedforward to it. While the arm doesn't
        float, prepare the floating law to brake all joints first.
        """
        if output.is_model_valid:
            self._controller.feed_forward(output.theta_ff)
        if self._reference.is_floating:
            self._floating.torque(arm.q, arm.dq, output.tau_ext_hat, output.theta_ff, self._tau_d)
            return
        self._floating.begin()
        self._controller.torque(arm.q, arm.dq, self._q_d, self._dq_d, self._ddq_d, self._tau_d)

    def _limit(self, arm: ArmState, output: SchemeOutput, now_ns: int) -> tuple[ArmCommand, GateFlag]:
        """Return the command of this cycle, with the desired torque limited, and the gate's changes to the torque.

        The torque is zero unless the state has power, both drives are enabled, and the command leaves, at now_ns, no
        more than `bus.max_age_cycles` periods after SYNC. The command is a quick stop in FAULT, and for a desired
        torque that is not finite.
        """
        is_stale = now_ns - self._exchange.sync_ns > self._stale_ns
        is_open = output.state in POWERED and arm.is_enabled and not is_stale
        flags = self._gate.limit(self._tau_d, is_open, self._tau_c, max(arm.age_q))
        quick_stop = output.state is SchemeState.FAULT or (bool(flags) and GateFlag.NOT_A_NUMBER in flags)
        return ArmCommand(self._tau_c, output.state in _ENABLING, quick_stop), flags

    def _log(
        self,
        recorder: Recorder,
        record: CycleRecord,
        arm: ArmState,
        request: Request,
        output: SchemeOutput,
        command: ArmCommand,
        flags: GateFlag,
    ) -> None:
        """Hand messages, frames and events of the cycle to the recorder, print those for the user, store a new state.

        The events of all sources are taken, so that each is logged once.
        """
        t_ns = arm.t_ns
        if self._first_cycle < 0:
            self._first_cycle = arm.cycle
        messages = [
            (ChannelId.SCHEME, pack_scheme(output, request)),
            (ChannelId.ARM, pack_arm(arm, self._first_cycle)),
            (ChannelId.CONTROL, CONTROL.pack(arm.cycle, flags, command.enable, command.quick_stop, block=self._block)),
            (ChannelId.CYCLE, CYCLE.pack(*record)),
        ]
        if self._frame_checks.take_turn(arm.cycle):
            messages.append((ChannelId.FRAME_CHECKS, pack_frame_checks(self._arm.frame_checks())))
        if output.contact is not None:
            messages.append((ChannelId.CONTACT, pack_contact(output.contact)))
            self._narration.contact(t_ns, output.contact)
        recorder.cycle(t_ns, messages, self._bus.take_passed())
        events = [event for source in self._sources if source.events for event in source.take_events()]
        for event in (*events, *self._pipeline.take_events()):
            recorder.event(t_ns, event)
            if event.name in CERTIFICATE_EVENTS or event.name in (MOTION, BOUNDS, STOP) or is_shown(event):
                self._narration.event(t_ns, event.operator_text)
        if request is Request.FINISH and self._state in POWERED and not self._reference.is_parked(arm.cycle):
            self._narration.event(t_ns, f"parks, for {FINISH_S:g} s at most; then disables the drives")
        if output.state is not self._state:
            event = self._transition(output, arm)
            recorder.event(t_ns, event)
            self._follow_state(output.state, arm.cycle)
            self._narration.transition(t_ns, output, event.message)

    def _transition(self, output: SchemeOutput, arm: ArmState) -> Event:
        """Return the event of a change of state.

        Its text has the causes of a fault, of a stop without a contact, and of a return to COMMISSION.
        """
        text = f"{output.previous_state.name} -> {output.state.name}"
        if output.state is SchemeState.REACT and output.contact is None:
            late = "; ".join([FaultReason.DEADLINE.name, *self._watch.deadline.describe_misses()])
            why = late if arm.is_late else "what was learnt since contradicts the certificate"
            return Event("warning", "supervisor", f"{text}: {why}")
        if output.state is SchemeState.COMMISSION and output.previous_state is SchemeState.ENABLE:
            return Event("warning", "supervisor", f"{text}: the arm moves before all its drives are enabled")
        if output.state is not SchemeState.FAULT:
            return Event("info", "supervisor", text)
        details = "; ".join([output.fault.name, *self._faults.list_causes(output.fault)])
        return Event("error", "supervisor", f"{text}: {details}")

    def _follow_state(self, state: SchemeState, cycle: int) -> None:
        """Store a new state, and the cycle in which the drives were enabled or the fault came.

        At the first MONITOR compare the certificate with the link lengths. Drop a stored request that the state serves.
        """
        self._state = state
        if state in POWERED and self._enabled_cycle is None:
            self._enabled_cycle = cycle
        if state is SchemeState.FAULT:
            self._faulted_cycle = cycle
        if state is SchemeState.MONITOR and not self._first_motion.is_certified:
            self._first_motion.check_lengths(self._pipeline.certificates)
        self._kept.serve((state,))

    def _is_over(self, output: SchemeOutput | None) -> bool:
        """Return whether the loop ends: FAULT_LINGER_S after a fault, else at a second interrupt or if FINISH is done.

        FINISH is done once the arm is parked, has no power, or hasn't parked within FINISH_S.
        """
        if output is None:
            return False
        if self._faulted_cycle is not None:
            return output.cycle - self._faulted_cycle >= FAULT_LINGER_S / self._period_s
        if self._interrupts > 1:
            return True
        if not self._is_finishing:
            return False
        is_overdue = output.cycle - self._finish_cycle > FINISH_S / self._period_s
        return is_overdue or self._state not in POWERED or self._reference.is_parked(output.cycle)

    def _disable(self, recorder: Recorder, quick_stop: bool) -> None:
        """Send zero torque and the command to disable the drives for DISABLE_CYCLES cycles, without the scheme.

        quick_stop: the command is a quick stop instead of Disable voltage. The host's heartbeat goes on. Log the
        frames, and the counts of the frame checks.
        """
        self._tau_c[:] = 0.0
        command = ArmCommand(self._tau_c, enable=False, quick_stop=quick_stop)
        for _ in range(DISABLE_CYCLES):
            tick, arm = self._exchange.turn()
            self._exchange.leave()
            self._exchange.end(tick, arm, command)
            recorder.cycle(tick.t_ns, [], self._bus.take_passed())
        checks = pack_frame_checks(self._arm.frame_checks())
        recorder.cycle(tick.t_ns, [(ChannelId.FRAME_CHECKS, checks)], self._bus.take_passed())
