"""Cycles at zero torque on the fixed grid: SYNC out, feedback and torque in, zero torque out; for tests and tares."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from adacd_hil.clock import Clock
from adacd_hil.control.exchange import Evidence, Exchange
from adacd_hil.control.gate import Gate
from adacd_hil.control.pacing import make_pacer
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_watch import Recurrence
from adacd_hil.device.network import Master
from adacd_hil.records import JOINTS, ArmCommand, ArmState, CycleRecord, FaultReason
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Frame, Tap

DISABLE_CYCLES = 20
"""Cycles of disabling at the end; drives need two."""


class ZeroTorqueCycle(NamedTuple):
    """One cycle: what the arm reported, how it went, and its frames, True for sent."""

    state: ArmState
    record: CycleRecord
    frames: list[tuple[bool, Frame]]


class ZeroTorqueLoop:
    """Cycles of an arm that has been started. `is_enabling`: the drives are asked to enable, with zero torque."""

    def __init__(
        self, settings: Settings, bus: Tap, clock: Clock, arm: Arm, master: Master, is_enabling: bool = False
    ) -> None:
        self.pacer = make_pacer(settings, clock, bus, arm.sync_id)
        self._period_ns = settings.bus.period_ns
        self._clock = clock
        self._bus, self._arm, self._master = bus, arm, master
        self._is_enabling = is_enabling
        self._is_interrupted = False
        self._exchange = Exchange(settings, bus, arm, master, clock)
        self._evidence = Evidence(settings, bus, arm, self._exchange, clock)
        self._heartbeats = Recurrence(settings.bus.heartbeat_ms * 1e-3, settings.bus.period_s)
        self._max_age_cycles = settings.bus.max_age_cycles
        self._gate = Gate(settings.arm, settings.bus.period_s)
        self._tau_d, self._tau_c = np.zeros(JOINTS), np.zeros(JOINTS)

    @property
    def is_interrupted(self) -> bool:
        """Whether somebody asked for the end."""
        return self._is_interrupted

    def interrupt(self) -> None:
        """End after the present cycle. Safe in a signal handler."""
        self._is_interrupted = True

    def run(
        self,
        duration_s: float,
        observe: Callable[[ZeroTorqueCycle], None],
        is_over: Callable[[], bool] = lambda: False,
    ) -> FaultReason:
        """Cycle for a while, then disable the drives; returns what a device faulted with. Raises BusError."""
        last_ns = self._clock.now_ns() + round(duration_s * 1e9) - self._period_ns
        fault = FaultReason.NONE
        while self._clock.now_ns() < last_ns and not (self._is_interrupted or is_over() or fault):
            cycle = self._cycle(self._is_enabling, quick_stop=False)
            fault = self._fault(cycle.state)
            observe(cycle)
        self.disable(quick_stop=fault is not FaultReason.NONE)
        return fault

    def _fault(self, state: ArmState) -> FaultReason:
        """Say what ends a test with enabled drives; without torque nothing has to."""
        if not self._is_enabling:
            return FaultReason.NONE
        if state.is_enabled and max(*state.age_q, *state.age_tau_J) > self._max_age_cycles:
            return FaultReason.DATA_AGE
        return state.fault

    def disable(self, quick_stop: bool = False) -> None:
        """Take the drives out of operation. Raises BusError."""
        for _ in range(DISABLE_CYCLES):
            self._cycle(False, quick_stop)

    def _cycle(self, is_enabling: bool, quick_stop: bool) -> ZeroTorqueCycle:
        bus = self._bus
        tick = self.pacer.next()
        state = self._exchange.read(tick)
        self._gate.limit(self._tau_d, is_enabling and state.is_enabled, self._tau_c)
        bus.held_ns = self.pacer.spend(self._exchange.feedback_ns)
        self._arm.write(ArmCommand(self._tau_c, is_enabling, quick_stop))
        record = self._evidence.record(tick, state, self.pacer.overruns, log_queue_bytes=0)
        if self._heartbeats.is_due(tick.cycle):
            self._master.send_heartbeat()
        return ZeroTorqueCycle(state, record, bus.take())


class IdleCycle:
    """Keeps an arm at zero torque and reads it; in lockstep with a VirtualClock, else on the grid."""

    def __init__(self, settings: Settings, bus: Tap, arm: Arm, master: Master, clock: Clock) -> None:
        self._bus, self._arm, self._master = bus, arm, master
        self._pacer = make_pacer(settings, clock, bus, arm.sync_id)
        self._exchange = Exchange(settings, bus, arm, master, clock)
        self._heartbeats = Recurrence(settings.bus.heartbeat_ms * 1e-3, settings.bus.period_s)
        self._off = ArmCommand(np.zeros(JOINTS), enable=False, quick_stop=False)

    def step(self) -> ArmState:
        """Do one cycle and return what the arm reported. Raises BusError, of it SilenceError in lockstep."""
        tick = self._pacer.next()
        state = self._exchange.read(tick)
        self._bus.held_ns = self._pacer.spend(self._exchange.feedback_ns)
        self._arm.write(self._off)
        if self._heartbeats.is_due(tick.cycle):
            self._master.send_heartbeat()
        self._bus.take()  # nobody logs them
        return state
