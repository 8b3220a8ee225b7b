"""Commands that missed their SYNC, as events.

The commands of cycle k act at SYNC k + 1, pipelined ones at k + 2. Those that are not on the bus when that SYNC goes
out act one later.
"""

from adacd_hil.device.arm_watch import Notices
from adacd_hil.records import Event


class LateCommands(Notices):
    """Counts them and makes events of them."""

    def __init__(self, is_pipelined: bool = False) -> None:
        super().__init__()
        self._cycles = 2 if is_pipelined else 1  # from a command to the SYNC at which it acts
        self.count = 0
        """Of the present cycle."""

    def note(self, cycle: int, count: int, t_ns: int) -> None:
        """Take note of the commands that still wait as SYNC of `cycle` goes out, at `t_ns`."""
        self.count = count
        if count == 0:
            return
        from_cycle = cycle - self._cycles
        what = f"1 command of cycle {from_cycle}" if count == 1 else f"{count} commands of cycle {from_cycle}"
        text = f"{what} missed SYNC {cycle}, so acting one later"
        self.say(t_ns, "late", Event("warning", "late commands", text), count)
