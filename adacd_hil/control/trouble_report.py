"""What the bus's controller reports in error frames, as events: each kind at once, then at most once a second."""

from adacd_hil.records import Event
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.error_frames import TroubleKind, decode_error

_REPEAT_NS = 1_000_000_000
"""A controller that nobody answers reports thousands of times a second; every frame is in the log anyway."""


class TroubleReport:
    """Collects error frames and makes events of them."""

    def __init__(self) -> None:
        self._events: list[Event] = []
        self._said_ns: dict[TroubleKind, int] = {}
        self._unsaid: dict[TroubleKind, int] = {}

    def accept(self, frame: Frame) -> None:
        """Take an error frame."""
        trouble = decode_error(frame)
        kind = trouble.kind
        said_ns = self._said_ns.get(kind)
        if said_ns is not None and frame.t_ns - said_ns < _REPEAT_NS:
            self._unsaid[kind] = self._unsaid.get(kind, 0) + 1
            return
        more = self._unsaid.pop(kind, 0)
        self._said_ns[kind] = frame.t_ns
        level = "info" if kind is TroubleKind.ERROR_ACTIVE else "warning"
        self._events.append(Event(level, "bus", trouble.text + (f" (and {more} before)" if more else "")))

    def take_events(self) -> list[Event]:
        """Return and forget the events since the last call."""
        events, self._events = self._events, []
        return events
