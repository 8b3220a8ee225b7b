"""Cycles at zero torque on the fixed grid: SYNC out, feedback and torque in, zero torque out; for tests and tares."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from adacd_hil.clock import Clock
from adacd_hil.control.exchange import Exchange
from adacd_hil.control.pacing import make_pacer
from adacd_hil.device.arm import Arm
from adacd_hil.device.drive import DISABLE_CYCLES
from adacd_hil.device.network import Master
from adacd_hil.records import JOINTS, ArmCommand, ArmState, CycleRecord, FaultReason
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Frame, Tap


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
        self._bus = bus
        self._is_enabling = is_enabling
        self._is_interrupted = False
        self._exchange = Exchange(settings, bus, arm, master, self.pacer, clock)
        self._max_age_cycles = settings.bus.max_age_cycles

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
            cycle = self.step(self._is_enabling)
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
            self.step(quick_stop=quick_stop)

    def step(self, is_enabling: bool = False, quick_stop: bool = False) -> ZeroTorqueCycle:
        """Do one cycle. Raises BusError, of it SilenceError in lockstep."""
        turn = self._exchange.turn()
        self._exchange.leave()
        record = self._exchange.end(turn, ArmCommand(np.zeros(JOINTS), is_enabling, quick_stop))
        return ZeroTorqueCycle(turn.arm, record, self._bus.take())
