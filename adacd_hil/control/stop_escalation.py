"""The second stage of a stop: a drive that is still in Operation enabled after FAULT is taken out of it by NMT.

The first stage is a quick stop by command. Where somebody else commands the drive, too, or where it doesn't hear, that
is not enough: in Pre-operational it takes no command from anybody, and by its own watchdog it faults and brakes.
"""

from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_watch import Notices
from adacd_hil.device.drive import Cia402State
from adacd_hil.device.network import Master
from adacd_hil.records import Event, FaultReason

PATIENCE_CYCLES = 10
"""Cycles in which a quick stop by command shows in a drive's status: it acts at the next SYNC, and the status comes
with that one; eight more for lost frames."""


class StopEscalation(Notices):
    """Looks at the drives while FAULT is latched."""

    def __init__(self, arm: Arm, master: Master) -> None:
        super().__init__()
        self._arm, self._master = arm, master
        self._due = 0

    def step(self, cycles: int, t_ns: int, fault: FaultReason) -> None:
        """Send NMT pre-operational where it is due; `cycles`: since FAULT. Raises BusError.

        Without patience where somebody else is heard: who would command a drive against a quick stop.
        """
        patience = 1 if fault is FaultReason.FOREIGN_FRAMES else PATIENCE_CYCLES
        if cycles < max(self._due, patience):
            return
        for drive in self._arm.drives:
            if drive.state is Cia402State.OPERATION_ENABLED:
                self._due = cycles + PATIENCE_CYCLES
                self._master.leave_operational(drive.node_id)
                text = f"{drive.name} is in Operation enabled {cycles} cycles after FAULT: NMT pre-operational"
                self.say(t_ns, drive.name, Event("error", "stop", text))
