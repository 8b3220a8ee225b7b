"""Cycles with the drives disabled: SYNC out, feedback and torque in, Disable voltage and zero torque out."""

import numpy as np

from adacd_hil.clock import Clock, VirtualClock
from adacd_hil.config import Settings
from adacd_hil.control.cycle import FEEDBACK_SHARE, SilenceError
from adacd_hil.control.realtime import GridPacer, LockstepPacer, Pacer
from adacd_hil.device.arm import Arm
from adacd_hil.device.network import Master
from adacd_hil.records import JOINTS, ArmCommand, ArmState
from adacd_hil.wire.bus import Bus, Frame


class IdleCycle:
    """Keeps an arm at zero torque and reads it; in lockstep with a VirtualClock, else on the grid."""

    def __init__(self, settings: Settings, bus: Bus, arm: Arm, master: Master, clock: Clock) -> None:
        bus_settings = settings.bus
        self._bus, self._arm, self._master, self._clock = bus, arm, master, clock
        self._is_lockstep = isinstance(clock, VirtualClock)
        self._pacer: Pacer
        if isinstance(clock, VirtualClock):
            self._pacer = LockstepPacer(clock, bus_settings.period_ns)
            self._patience_s = bus_settings.feedback_timeout_ms * 1e-3
        else:
            self._pacer = GridPacer(clock, bus_settings.period_ns)
            self._patience_s = FEEDBACK_SHARE * bus_settings.period_s
        self._heartbeat_cycles = max(1, round(bus_settings.heartbeat_ms * 1e-3 / bus_settings.period_s))
        self._off = ArmCommand(np.zeros(JOINTS), enable=False, quick_stop=False)

    def step(self) -> ArmState:
        """Do one cycle and return what the arm reported. Raises BusError, and SilenceError in lockstep."""
        bus, arm = self._bus, self._arm
        tick = self._pacer.next()
        while (late := bus.receive(0.0)) is not None:  # belongs to the cycle before
            self._accept(late)
        sync_ns = self._clock.now_ns()
        arm.synchronise(tick.cycle, tick.t_ns, tick.periods)
        patience_s = self._patience_s
        while not arm.has_all_frames and (frame := bus.receive(patience_s)) is not None:
            self._accept(frame)
            if not self._is_lockstep:
                patience_s = self._patience_s - (frame.t_ns - sync_ns) * 1e-9
        if self._is_lockstep and arm.missing_frames == len(arm.drives) + len(arm.sensors):
            raise SilenceError(
                f"no answer from {', '.join(arm.missing_names())} to SYNC of cycle {tick.cycle} on {bus.channel} "
                f"within {self._patience_s:g} s"
            )
        state = arm.state()
        arm.write(self._off)
        if tick.cycle % self._heartbeat_cycles == 0:
            self._master.send_heartbeat()
        return state

    def _accept(self, frame: Frame) -> None:
        if not self._arm.accept(frame):
            self._master.accept(frame)
