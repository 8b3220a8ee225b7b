"""Cycles with the drives disabled: SYNC out, feedback and torque in, Disable voltage and zero torque out."""

import numpy as np

from adacd_hil.clock import Clock
from adacd_hil.control.exchange import Exchange
from adacd_hil.control.realtime import make_pacer
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_watch import Recurrence
from adacd_hil.device.network import Master
from adacd_hil.records import JOINTS, ArmCommand, ArmState
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Tap


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
