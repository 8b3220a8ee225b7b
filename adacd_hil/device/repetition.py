"""What the cycle does every so many periods, and events that come again and again: said once a second, with a count."""

from collections.abc import Hashable

from adacd_hil.records import Event


class Recurrence:
    """Something that is done every so many cycles, and after skipped ones as soon as there is a cycle again."""

    def __init__(self, interval_s: float, period_s: float) -> None:
        self._cycles = max(1, round(interval_s / period_s))
        self._due_cycle = 0

    def is_due(self, cycle: int) -> bool:
        """Whether it is to be done in this cycle; asked once per cycle."""
        if cycle < self._due_cycle:
            return False
        self._due_cycle = cycle - cycle % self._cycles + self._cycles
        return True


REPEAT_NS = 1_000_000_000
"""Least time between two events of one kind."""


class RateLimitedEvents:
    """Collects events, each kind at once, then at most once a second with the count of those between.

    `take_events` gives those since the last call.
    """

    def __init__(self) -> None:
        self._said_ns: dict[Hashable, int] = {}
        self._unsaid: dict[Hashable, int] = {}
        self._events: list[Event] = []

    def say(self, t_ns: int, kind: Hashable, event: Event, count: int = 1) -> None:
        """Take an event of a kind at a time. `count`: how many it stands for."""
        if not self.is_due(kind, t_ns):
            self._unsaid[kind] = self._unsaid.get(kind, 0) + count
            return
        more = self._unsaid.pop(kind, 0)
        self._said_ns[kind] = t_ns
        self._events.append(event._replace(message=f"{event.message} (and {more} before)") if more else event)

    def is_due(self, kind: Hashable, t_ns: int) -> bool:
        """Tell whether an event of a kind would be said at once."""
        said_ns = self._said_ns.get(kind)
        return said_ns is None or t_ns - said_ns >= REPEAT_NS

    def take_events(self) -> list[Event]:
        """Return and forget the events since the last call."""
        events, self._events = self._events, []
        return events
