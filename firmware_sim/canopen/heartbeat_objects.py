"""Heartbeats of one emulated device, its own and the master's.

Source: CiA 301 (4.2), 7.2.8.3.2 and objects 0x1016, 0x1017.
"""

from collections.abc import Callable
from typing import Protocol

from firmware_sim.canopen.object_dictionary import NEVER_NS, Abort, ObjectDictionary, Send, refuse


class HeartbeatProducer:
    """0x1017: sends the NMT state every so many ms; the boot-up message is the first heartbeat."""

    def __init__(
        self, dictionary: ObjectDictionary, send: Send, state: Callable[[], int], now_ns: Callable[[], int]
    ) -> None:
        self._can_id = 0x700 + dictionary.node_id
        self._send = send
        self._state = state
        self._now_ns = now_ns
        self._period_ns = 0
        self._due_ns = NEVER_NS
        dictionary.watch(0x1017, 0, self._set_period)

    def restart(self, t_ns: int) -> None:
        """Begin a period."""
        self._due_ns = t_ns + self._period_ns if self._period_ns else NEVER_NS

    def poll(self, t_ns: int) -> int:
        """Send what is due; return when the next one is."""
        if t_ns >= self._due_ns:
            self._due_ns = max(self._due_ns, t_ns - self._period_ns) + self._period_ns
            self._send(self._can_id, bytes([self._state()]))
        return self._due_ns

    def _set_period(self, period_ms: int) -> None:
        self._period_ns = period_ms * 1_000_000
        self.restart(self._now_ns())


class HeartbeatListener(Protocol):
    """Who is told of the master's heartbeat."""

    now_ns: int

    def lose_heartbeat(self, t_ns: int) -> None:
        """React to silence."""

    def find_heartbeat(self, t_ns: int) -> None:
        """React to the end of the silence."""


class HeartbeatConsumer:
    """0x1016:1: monitors one node from its first heartbeat on. A lost heartbeat is found again when one arrives."""

    def __init__(self, dictionary: ObjectDictionary, listener: HeartbeatListener) -> None:
        self.is_lost = False
        """Whether the heartbeat is monitored and missing."""
        self._listener = listener
        self._node_id = 0
        self._timeout_ns = 0
        self._due_ns = NEVER_NS
        dictionary.watch(0x1016, 1, self._configure, _check_node)

    def on_heartbeat(self, node_id: int, t_ns: int) -> None:
        """Take note of a heartbeat."""
        if self._timeout_ns == 0 or node_id != self._node_id:
            return
        self._due_ns = t_ns + self._timeout_ns
        self._find(t_ns)

    def poll(self, t_ns: int) -> int:
        """Notice a silence; return when to look again."""
        if t_ns >= self._due_ns:
            self._due_ns = NEVER_NS
            self.is_lost = True
            self._listener.lose_heartbeat(t_ns)
        return self._due_ns

    def _configure(self, value: int) -> None:
        self._node_id = (value >> 16) & 0x7F
        self._timeout_ns = (value & 0xFFFF) * 1_000_000
        self._due_ns = NEVER_NS
        self._find(self._listener.now_ns)  # what isn't monitored any more isn't missing

    def _find(self, t_ns: int) -> None:
        if self.is_lost:
            self.is_lost = False
            self._listener.find_heartbeat(t_ns)


def _check_node(value: int) -> None:
    """Accept a node that can exist, or a time of 0: off."""
    if value & 0xFFFF and not 1 <= value >> 16 <= 127:
        refuse(Abort.VALUE_RANGE)
