"""The second look at an ArmState: what the devices' heartbeats and the host's own lateness make of it."""

from collections.abc import Callable

from adacd_hil.device.deadline import DeadlineWatch
from adacd_hil.device.recurrence import Recurrence
from adacd_hil.records import ArmState, FaultReason
from adacd_hil.settings.configuration import Settings

_LOOKS = 0.1
"""How often heartbeats are looked at, in their periods."""


class ArmWatch:
    """Takes for a fault of the arm a device that has fallen silent or left Operational, or a host that is late.

    `lost`: what is wrong with which device, one line each.
    """

    def __init__(self, settings: Settings, watch: Callable[[int], list[str]]) -> None:
        """`watch` names what is wrong with the heartbeats at a time in ns."""
        self.lost: list[str] = []
        self.deadline = DeadlineWatch(settings)
        self._watch = watch
        self._looks = Recurrence(_LOOKS * settings.bus.heartbeat_ms * 1e-3, settings.bus.period_s)

    def judge(self, arm: ArmState) -> ArmState:
        """Take in one cycle; return it as it is, or with what is wrong."""
        if self._looks.is_due(arm.cycle):
            self.lost = self._watch(arm.t_ns)
        if self.lost and arm.fault is FaultReason.NONE:
            arm = arm._replace(fault=FaultReason.HEARTBEAT)
        return self.deadline.judge(arm)
