"""What was written into the devices, read again while the arm runs: one object at a time, without waiting for it.

A device that has reset itself to its defaults, or into which somebody else has written, runs the arm with other limits
and other watchdogs than the host believes. Objects are those that the set-up has written or compared.

Expedited SDO uploads: a request of 8 bytes, and in some later cycle its answer. Source: CiA 301 (4.2), clause 7.2.4.3.
"""

from collections.abc import Iterable
from typing import NamedTuple

from adacd_hil.device.notices import Notices
from adacd_hil.device.recurrence import Recurrence
from adacd_hil.device.slave import Slave
from adacd_hil.records import Event
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Bus, Frame

_UPLOAD = 0x40
_ABORT = 0x80
_REQUEST, _RESPONSE = 0x600, 0x580
_ANSWER_S = 0.5
"""Longest wait for an answer, as in the set-up."""


class _Object(NamedTuple):
    slave: Slave
    place: tuple[int, int]
    """Index and sub-index."""
    expected: int

    @property
    def name(self) -> str:
        return f"{self.slave.name} (node {self.slave.node_id}): {self.slave.describe(*self.place)}"


class ParameterWatch(Notices):
    """Reads one object after the other, round and round."""

    def __init__(self, settings: Settings, bus: Bus) -> None:
        super().__init__()
        self._bus = bus
        self._objects: tuple[_Object, ...] = ()
        self._next = 0
        self._asked: _Object | None = None
        self._asked_cycle = 0
        self._answer_cycles = round(_ANSWER_S / settings.bus.period_s)
        self._due = Recurrence(settings.devices.reread_ms * 1e-3, settings.bus.period_s)
        self._is_on = settings.devices.reread_ms > 0
        self.difference = ""
        """The first object that is no longer what it was, in one line; empty while none is."""

    def follow(self, slaves: Iterable[Slave]) -> None:
        """Read again from now on what the set-up of these devices has left in them."""
        found = [[_Object(slave, place, value) for place, value in slave.known.items()] for slave in slaves]
        # By turns, so that no device waits for all objects of another.
        longest = max(map(len, found), default=0)
        self._objects = tuple(objects[k] for k in range(longest) for objects in found if k < len(objects))

    def step(self, cycle: int, t_ns: int) -> None:
        """Ask for the next object when it is due. Raises BusError."""
        asked = self._asked
        if asked is not None and cycle - self._asked_cycle > self._answer_cycles:
            text = f"{asked.name} is not answered"
            self.say(t_ns, asked.slave.name, Event("warning", "parameters", text))
            self._asked = asked = None
        if asked is not None or not (self._is_on and self._objects and self._due.is_due(cycle)):
            return
        self._asked = chosen = self._objects[self._next]
        self._asked_cycle = cycle
        self._next = (self._next + 1) % len(self._objects)
        index, sub = chosen.place
        request = bytes((_UPLOAD, index & 0xFF, index >> 8, sub, 0, 0, 0, 0))
        self._bus.send(_REQUEST + chosen.slave.node_id, request)

    def accept(self, frame: Frame) -> bool:
        """Take an answer; False when it is none that was asked for."""
        asked, data = self._asked, frame.data
        if asked is None or frame.can_id != _RESPONSE + asked.slave.node_id or len(data) != 8:
            return False
        if (data[1] | data[2] << 8, data[3]) != asked.place:
            return False
        self._asked = None
        if data[0] == _ABORT:
            code = int.from_bytes(data[4:], "little")
            text = f"{asked.name} can't be read again: 0x{code:08X}"
            self.say(frame.t_ns, asked.name, Event("warning", "parameters", text))
            self._objects = tuple(one for one in self._objects if one is not asked)
            self._next = self._next % max(len(self._objects), 1)
        elif data[0] & 0xE2 == 0x42:  # expedited, with or without its size
            size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
            self._compare(asked, int.from_bytes(data[4 : 4 + size], "little"), size)
        return True

    def _compare(self, asked: _Object, found: int, size: int) -> None:
        expected = asked.expected & (1 << 8 * size) - 1
        if found != expected and not self.difference:
            self.difference = f"{asked.name} is 0x{found:X}, 0x{expected:X} was set up"
