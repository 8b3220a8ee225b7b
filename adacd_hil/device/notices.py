"""Events that come again and again: each kind at once, then at most once a second with the count of those between."""

from collections.abc import Hashable

from adacd_hil.records import Event

REPEAT_NS = 1_000_000_000


class Notices:
    """Collects events; `take_events` gives those since the last call."""

    def __init__(self) -> None:
        self._said_ns: dict[Hashable, int] = {}
        self._unsaid: dict[Hashable, int] = {}
        self._events: list[Event] = []

    def say(self, t_ns: int, kind: Hashable, event: Event, count: int = 1) -> None:
        """Take an event of a kind at a time. `count`: how many it stands for."""
        said_ns = self._said_ns.get(kind)
        if said_ns is not None and t_ns - said_ns < REPEAT_NS:
            self._unsaid[kind] = self._unsaid.get(kind, 0) + count
            return
        more = self._unsaid.pop(kind, 0)
        self._said_ns[kind] = t_ns
        self._events.append(event._replace(message=f"{event.message} (and {more} before)") if more else event)

    def take_events(self) -> list[Event]:
        """Return and forget the events since the last call."""
        events, self._events = self._events, []
        return events
