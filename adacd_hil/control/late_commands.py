"""Commands that missed their SYNC, as events: the first at once, then at most one a second.

The commands of cycle k act at SYNC k + 1, pipelined ones at k + 2. Those that are not on the bus when that SYNC goes
out act one later.
"""

from adacd_hil.records import Event

_REPEAT_NS = 1_000_000_000


class LateCommands:
    """Counts them and makes events of them."""

    def __init__(self, is_pipelined: bool = False) -> None:
        self._cycles = 2 if is_pipelined else 1  # from a command to the SYNC at which it acts
        self.count = 0
        """Of the present cycle."""
        self._unsaid = 0
        self._said_ns: int | None = None
        self._events: list[Event] = []

    def note(self, cycle: int, count: int, t_ns: int) -> None:
        """Take note of the commands that still wait as SYNC of `cycle` goes out, at `t_ns`."""
        self.count = count
        if count == 0:
            return
        if self._said_ns is not None and t_ns - self._said_ns < _REPEAT_NS:
            self._unsaid += count
            return
        more = f", as {self._unsaid} before" if self._unsaid else ""
        from_cycle = cycle - self._cycles
        what = f"1 command of cycle {from_cycle}" if count == 1 else f"{count} commands of cycle {from_cycle}"
        self._events.append(Event("warning", "late commands", f"{what} missed SYNC {cycle}, so acting one later{more}"))
        self._unsaid = 0
        self._said_ns = t_ns

    def take_events(self) -> list[Event]:
        """Return and forget the events since the last call."""
        events, self._events = self._events, []
        return events
