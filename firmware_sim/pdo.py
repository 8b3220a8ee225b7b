"""The PDOs of one emulated device: RPDO1… and TPDO1… by CiA 301, whatever a master maps into them.

A PDO is written while it is invalid (bit 31 of its COB-ID): number of entries to 0, entries, number of entries, valid.

transmission type   RPDO                        TPDO
0                   acts at the next SYNC       at the SYNC after an event
1 … 240             acts at the next SYNC       at every n-th SYNC
254, 255            acts at once                on an event, and when the event timer ends

An event is a change of an object that says how the device is (`events` of `Pdos`), or, in a PDO without such an object,
any change of its content, looked for at every SYNC. An RPDO's event timer is its deadline. Frames whose mapping leads
with the end-to-end header's objects are protected with the data ids of the message that has the PDO's default COB-ID.
Source: CiA 301 (4.2), 7.5.2.35 to 7.5.2.38.
"""

from collections.abc import Callable, Mapping
from typing import Protocol

from adacd_hil.wire.codec import MessageCodec
from adacd_hil.wire.e2e import E2eStatus
from firmware_sim.object_dictionary import NEVER_NS, Abort, ObjectDictionary, Send, refuse
from firmware_sim.pdo_mapping import NOTHING, check_entry, lay_out

RECEIVE, TRANSMIT = 0x1400, 0x1800
COUNT = 4
_NOT_VALID = 1 << 31  # of a COB-ID
_IS_EXTENDED = 1 << 29
_CYCLIC, _EVENT_DRIVEN = range(1, 241), (254, 255)
_TYPES = (0, *_CYCLIC, *_EVENT_DRIVEN)
_MAPPING = 0x200  # from a communication record to its mapping record

LISTENED_IDS = frozenset(base + node for base in (0x200, 0x300, 0x400, 0x500) for node in range(1, 33))
"""Identifiers that an RPDO may have: those of RPDO1 to 4 of nodes 1 to 32. A real controller's acceptance filter is no
wider, and the emulator's kernel filter is this one."""


def _is_restricted(can_id: int) -> bool:
    """Whether an identifier is none for PDOs: CiA 301, table 34, and SYNC and EMCY."""
    lowest = (0x000, 0x080, 0x101, 0x581, 0x601, 0x6E0, 0x701)
    highest = (0x07F, 0x100, 0x180, 0x5FF, 0x67F, 0x6FF, 0x7FF)
    return any(low <= can_id <= high for low, high in zip(lowest, highest, strict=True))


class PdoUser(Protocol):
    """What a device does with its PDOs."""

    def act(self, t_ns: int) -> None:
        """Act on a frame that doesn't wait for SYNC; its values have been written."""

    def mind_length(self, is_right: bool, t_ns: int) -> None:
        """Take note of the length of a frame for the device."""


class _Pdo:
    """Communication and mapping record of one PDO."""

    is_received: bool

    def __init__(self, pdos: "Pdos", index: int, message: MessageCodec | None) -> None:
        dictionary = pdos.dictionary
        self.layout = NOTHING
        self._pdos = pdos
        self._message = message
        self.can_id = dictionary.value(index, 1) & 0x7FF
        self._is_valid = not dictionary.value(index, 1) & _NOT_VALID
        self.type = dictionary.value(index, 2)
        self.inhibit_ns = dictionary.value_or(0, index, 3) * 100_000
        self.timer_ns = dictionary.value_or(0, index, 5) * 1_000_000
        mapping = index + _MAPPING
        self._entries = [
            dictionary.value(mapping, sub) for sub in range(1, 65) if dictionary.has(mapping, sub)
        ]  # sub-indices without gaps
        self._count = dictionary.value(mapping, 0)
        self._lay_out(self._count)
        dictionary.watch(index, 1, self._identify, self._check_cob_id)
        dictionary.watch(index, 2, self._set_type, _check_type)
        dictionary.watch(index, 3, self._set_inhibit, self._check_inhibit)
        dictionary.watch(index, 5, self._set_timer)
        # Entries before their number: a reset restores them in this order.
        for place in range(len(self._entries)):
            dictionary.watch(mapping, place + 1, self._setter(place), self._entry_check(place))
        dictionary.watch(mapping, 0, self._map, self._check_count)

    @property
    def is_active(self) -> bool:
        """Whether it is exchanged in Operational."""
        return self._is_valid and self._count > 0

    @property
    def is_synchronous(self) -> bool:
        return self.type not in _EVENT_DRIVEN

    def restart(self) -> None:
        """Begin the end-to-end sequence anew."""
        raise NotImplementedError

    def bind(self) -> None:
        """Take over a new mapping."""
        raise NotImplementedError

    def _check_cob_id(self, value: int) -> None:
        can_id = value & 0x7FF
        if value & _IS_EXTENDED or value & 0x1FFFF800 or _is_restricted(can_id):
            refuse(Abort.VALUE_RANGE)
        if self.is_received and can_id not in LISTENED_IDS:
            refuse(Abort.VALUE_RANGE)
        if self._is_valid and not value & _NOT_VALID and can_id != self.can_id:
            refuse(Abort.DEVICE_STATE)

    def _identify(self, value: int) -> None:
        self.can_id = value & 0x7FF
        self._is_valid = not value & _NOT_VALID
        self._pdos.refresh()

    def _set_type(self, value: int) -> None:
        self.type = value
        self._pdos.refresh()

    def _check_inhibit(self, value: int) -> None:
        if self._is_valid and value * 100_000 != self.inhibit_ns:
            refuse(Abort.DEVICE_STATE)

    def _set_inhibit(self, tenths_ms: int) -> None:
        self.inhibit_ns = tenths_ms * 100_000

    def _set_timer(self, period_ms: int) -> None:
        self.timer_ns = period_ms * 1_000_000
        self._pdos.refresh()

    def _entry_check(self, place: int) -> Callable[[int], None]:
        def check(value: int) -> None:
            if value == self._entries[place]:
                return
            if self._is_valid or self._count != 0:
                refuse(Abort.DEVICE_STATE)
            if value != 0:
                check_entry(self._pdos.dictionary, value, self.is_received)

        return check

    def _setter(self, place: int) -> Callable[[int], None]:
        def set_entry(value: int) -> None:
            self._entries[place] = value

        return set_entry

    def _check_count(self, value: int) -> None:
        if value == self._count:
            return
        if self._is_valid:
            refuse(Abort.DEVICE_STATE)
        if value > len(self._entries):
            refuse(Abort.PDO_TOO_LONG)
        self._lay_out(value)

    def _map(self, value: int) -> None:
        self._count = value
        self._lay_out(value)
        self._pdos.refresh()

    def _lay_out(self, count: int) -> None:
        """Lay out the first `count` entries, or refuse and leave everything as it is."""
        layout = lay_out(self._pdos.dictionary, self._entries[:count], self.is_received, self._pdos.longest)
        if layout.header_bytes and not self._has_data_ids(layout.header_bytes):
            refuse(Abort.INCOMPATIBLE)
        self.layout = layout

    def _has_data_ids(self, header_bytes: int) -> bool:
        message = self._message
        return message is not None and message.is_protected and _header_bytes(message) == header_bytes


def _header_bytes(message: MessageCodec) -> int:
    """Return how many bytes a protected message's end-to-end header takes."""
    header = message.signals[: len(message.signals) - len(message.values)]
    sizes = {s.container: 1 if s.mask else (s.raw_high - s.raw_low).bit_length() // 8 for s in header}
    return sum(sizes.values())


class TransmitPdo(_Pdo):
    """One TPDO."""

    is_received = False

    def __init__(self, pdos: "Pdos", index: int, message: MessageCodec | None) -> None:
        super().__init__(pdos, index, message)
        self.is_due = False
        """Whether an event has happened that the bus hasn't seen."""
        self._reads: tuple[Callable[[], int], ...] = ()
        self._sender = None if message is None or not message.is_protected else message.sender()
        self.send: Callable[[], None] = lambda: None
        """Sends the present values."""
        self._syncs = 0
        self._allowed_ns = 0
        self._timer_due_ns = NEVER_NS
        self._sent = b""
        self.is_compared = False
        """Whether its events are the changes of its content."""

    def restart(self) -> None:
        """Count the protected frames from their beginning."""
        if self._message is not None and self._message.is_protected:
            self._sender = self._message.sender()

    def bind(self) -> None:
        """Take over a new mapping."""
        self._reads = tuple(self._pdos.dictionary.reader(*key) for key in self.layout.keys)
        is_asynchronous = self.type == 0 or self.type in _EVENT_DRIVEN
        self.is_compared = is_asynchronous and not self._pdos.events.intersection(self.layout.keys)
        self._syncs = 0
        self.send = self._make_sender()

    def begin(self, t_ns: int) -> None:
        """Become active: an event-driven PDO begins with a frame."""
        self.is_due = True
        self._allowed_ns = t_ns
        self._timer_due_ns = NEVER_NS

    def _make_sender(self) -> Callable[[], None]:
        """Bind what sending needs, so that a frame costs little more than reading its values."""
        pdos, can_id, layout, reads, sender = self._pdos, self.can_id, self.layout, self._reads, self._sender
        send, header_bytes, length = pdos.send, layout.header_bytes, layout.length
        pack, pack_into = layout.packing.pack, layout.packing.pack_into
        status_byte, status_shift = (1, 4) if header_bytes == 2 else (3, 0)

        def send_protected() -> None:
            frame = bytearray(length)
            pack_into(frame, header_bytes, *[read() for read in reads])
            frame[status_byte] = pdos.header_status() << status_shift & 0xFF
            data = pdos.header = sender.protect(frame)  # type: ignore[union-attr]
            send(can_id, data)

        def send_plain() -> None:
            send(can_id, pack(*[read() for read in reads]))

        def send_pair() -> None:
            send(can_id, pack(first(), second()))

        if header_bytes:
            return send_protected
        if len(reads) != 2:
            return send_plain
        first, second = reads
        return send_pair

    def on_sync(self) -> None:
        """Send what this SYNC asks for: every n-th, or an event that waited."""
        if self.type == 0:
            self.compare()
            if self.is_due:
                self.is_due = False
                self.send()
            return
        self._syncs += 1
        if self._syncs >= self.type:
            self._syncs = 0
            self.send()

    def compare(self) -> None:
        """Find an event in a PDO whose events are the changes of its content."""
        if self.is_compared:
            content = self.layout.packing.pack(*[read() for read in self._reads])
            if content != self._sent:
                self._sent = content
                self.is_due = True

    def poll(self, t_ns: int) -> int:
        """Send an event-driven PDO when an event or its timer asks for it; return when to look again."""
        if (self.is_due and t_ns >= self._allowed_ns) or t_ns >= self._timer_due_ns:
            self.is_due = False
            self._allowed_ns = t_ns + self.inhibit_ns
            self._timer_due_ns = t_ns + self.timer_ns if self.timer_ns else NEVER_NS
            self.send()
        return self._allowed_ns if self.is_due else self._timer_due_ns


class ReceivePdo(_Pdo):
    """One RPDO."""

    is_received = True

    def __init__(self, pdos: "Pdos", index: int, message: MessageCodec | None) -> None:
        super().__init__(pdos, index, message)
        self.receiver = None if message is None or not message.is_protected else message.receiver()
        """Checks the frames of the contract's message; None where that isn't protected."""
        self.acted_ns: int | None = None
        """When its last frame acted; None before the first."""
        self._writes: tuple[Callable[[int], object], ...] = ()
        self.pending: tuple[int, ...] | None = None
        """Values that wait for SYNC."""
        self._is_command = False
        self._is_length_wrong = False

    def restart(self) -> None:
        """Forget the sequence of the protected frames, and the last one."""
        if self.receiver is not None:
            self.receiver.restart()
        self.forget()
        self.acted_ns = None

    def bind(self) -> None:
        """Take over a new mapping."""
        self._writes = tuple(self._pdos.writer(*key) for key in self.layout.keys)
        self._is_command = False

    def forget(self) -> None:
        """Drop a frame that waits for SYNC."""
        self.pending = None

    def make_command(self) -> None:
        """Let this PDO count as the device's command."""
        self._is_command = True

    def on_frame(self, data: bytes, t_ns: int) -> None:
        """Take a frame in; one that fails a check changes nothing."""
        layout = self.layout
        if len(data) != layout.length:
            self._is_length_wrong = True
            self._pdos.user.mind_length(False, t_ns)
            return
        if layout.header_bytes and self.receiver is not None:
            if self.receiver.check(data) > E2eStatus.OK_SOME_LOST:
                return
            self._pdos.header = data
        if self._is_length_wrong:
            self._is_length_wrong = False
            self._pdos.user.mind_length(True, t_ns)
        self.pending = layout.packing.unpack_from(data, layout.header_bytes)
        if self.type in _EVENT_DRIVEN:
            if self.act(t_ns):
                self._pdos.is_commanded = True
            self._pdos.user.act(t_ns)

    def act(self, t_ns: int) -> bool:
        """Write what waits; tell whether that was a command."""
        values = self.pending
        if values is None:
            return False
        self.pending = None
        self.acted_ns = t_ns
        for write, value in zip(self._writes, values, strict=False):  # as many as mapped
            write(value)
        return self._is_command

    def is_late(self, t_ns: int) -> bool:
        """Whether its deadline is over."""
        return self.timer_ns > 0 and self.acted_ns is not None and t_ns - self.acted_ns >= self.timer_ns


class Pdos:
    """All PDOs of one device."""

    def __init__(
        self,
        dictionary: ObjectDictionary,
        send: Send,
        messages: Mapping[int, MessageCodec],
        longest: int,
        on_refresh: Callable[[], None],
    ) -> None:
        """`messages`: the contract's, by identifier. `longest`: frame, in bytes. `on_refresh`: after changes."""
        self.dictionary = dictionary
        self.send = send
        self.longest = longest
        self.user: PdoUser
        self.header = bytes(4)
        """Header of the last protected frame, received or sent."""
        self.header_status: Callable[[], int] = int
        """What goes into the status field of a header that is sent."""
        self.events: frozenset[tuple[int, int]] = frozenset()
        """Objects whose changes the device announces by `notify`."""
        self.is_commanded = False
        """Whether a command has acted since the last `act_on_sync`, without waiting for SYNC."""
        self._writers: dict[tuple[int, int], Callable[[int], object]] = {}
        self._on_refresh = on_refresh
        self._is_operational = False
        self._now_ns = 0
        self.on_sync: tuple[Callable[[], None], ...] = ()
        """What sends the frames that belong to a SYNC."""
        self._asynchronous: tuple[TransmitPdo, ...] = ()
        self._compared: tuple[TransmitPdo, ...] = ()
        self.has_compared = False
        """Whether a PDO's events are the changes of its content."""
        self._receiving: tuple[ReceivePdo, ...] = ()
        self._waiting: tuple[ReceivePdo, ...] = ()
        self._sending: frozenset[TransmitPdo] = frozenset()
        self.receive = tuple(ReceivePdo(self, i, _message(self, messages, i)) for i in _records(self, RECEIVE))
        self.transmit = tuple(TransmitPdo(self, i, _message(self, messages, i)) for i in _records(self, TRANSMIT))
        dictionary.serve(0x2100, 1, lambda: self.header[0])
        dictionary.serve(0x2100, 2, lambda: self.header[1])
        dictionary.serve(0x2101, 1, lambda: int.from_bytes(self.header[:2], "little"))
        dictionary.serve(0x2101, 2, lambda: self.header[2])
        dictionary.serve(0x2101, 3, lambda: self.header[3])

    @property
    def is_commandable(self) -> bool:
        """Whether a PDO is exchanged that brings commands."""
        return any(pdo._is_command for pdo in self._receiving)

    def accept(self, index: int, subindex: int, write: Callable[[int], object]) -> None:
        """Give received values of an object to a function instead of writing the object as SDO does."""
        self._writers[index, subindex] = write

    def writer(self, index: int, subindex: int) -> Callable[[int], object]:
        """Return what takes the received values of an object. A value that the object can't take is dropped."""
        return self._writers.get((index, subindex)) or (lambda value: self.dictionary.take_over(index, subindex, value))

    def handlers(self) -> list[tuple[int, Callable[[bytes, int], None]]]:
        """List the identifiers that are received now, with what takes their frames."""
        return [(pdo.can_id, pdo.on_frame) for pdo in self._receiving]

    def set_operational(self, is_operational: bool, t_ns: int) -> None:
        """Begin or end the exchange with the NMT state."""
        self._is_operational = is_operational
        self._now_ns = t_ns
        self.refresh()

    def refresh(self) -> None:
        """Take over a new configuration."""
        self._receiving = tuple(pdo for pdo in self.receive if self._is_operational and pdo.is_active)
        sending = tuple(pdo for pdo in self.transmit if self._is_operational and pdo.is_active)
        for pdo in (*self._receiving, *sending):
            pdo.bind()
        for waiting in self.receive:
            if waiting not in self._receiving or not waiting.is_synchronous:
                waiting.forget()
        for begun in sending:
            if begun not in self._sending:
                begun.begin(self._now_ns)
        self._sending = frozenset(sending)
        self.on_sync = tuple(pdo.send if pdo.type == 1 else pdo.on_sync for pdo in sending if pdo.is_synchronous)
        self._asynchronous = tuple(pdo for pdo in sending if not pdo.is_synchronous)
        self._compared = tuple(pdo for pdo in self._asynchronous if pdo.is_compared)
        self.has_compared = bool(self._compared)
        self._waiting = tuple(pdo for pdo in self._receiving if pdo.is_synchronous)
        self._find_commands()
        self._on_refresh()

    def _find_commands(self) -> None:
        """Choose the PDOs that count as command: those with target torque, or, without it, with controlword."""
        for key in ((0x6071, 0), (0x6040, 0)):
            found = [pdo for pdo in self._receiving if key in pdo.layout.keys]
            if found:
                for pdo in found:
                    pdo.make_command()
                return

    def restart(self) -> None:
        """Begin all end-to-end sequences anew."""
        for pdo in (*self.receive, *self.transmit):
            pdo.restart()

    def act_on_sync(self, t_ns: int) -> bool:
        """Let what waited for SYNC act; tell whether a command has acted since the SYNC before."""
        is_commanded, self.is_commanded = self.is_commanded, False
        for pdo in self._waiting:
            if pdo.pending is not None and pdo.act(t_ns):
                is_commanded = True
        return is_commanded

    def find_late(self, t_ns: int) -> bool:
        """Whether an RPDO's deadline is over."""
        return any(pdo.is_late(t_ns) for pdo in self._receiving)

    @property
    def deadline_ns(self) -> int:
        """When the next deadline of an RPDO ends."""
        ends = [pdo.acted_ns + pdo.timer_ns for pdo in self._receiving if pdo.timer_ns and pdo.acted_ns is not None]
        return min(ends, default=NEVER_NS)

    @property
    def rejected_frames(self) -> int:
        """Frames so far that failed the end-to-end check."""
        receivers = [pdo.receiver for pdo in self.receive if pdo.receiver is not None]
        return sum(receiver.counts[s] for receiver in receivers for s in E2eStatus if not s.is_valid)

    def notify(self) -> None:
        """Say that an object of `events` has changed."""
        for pdo in self._sending:
            if not pdo.is_compared:
                pdo.is_due = True

    def compare(self) -> bool:
        """Look for changes of content; tell whether a frame is due."""
        for pdo in self._compared:
            pdo.compare()
        return any(pdo.is_due for pdo in self._compared)

    def poll(self, t_ns: int) -> int:
        """Send what is due by event or time; return when to look again."""
        due_ns = NEVER_NS
        for pdo in self._asynchronous:
            due_ns = min(due_ns, pdo.poll(t_ns))
        return due_ns


def _records(pdos: Pdos, first: int) -> list[int]:
    return [index for index in range(first, first + COUNT) if pdos.dictionary.has(index, 1)]


def _message(pdos: Pdos, messages: Mapping[int, MessageCodec], index: int) -> MessageCodec | None:
    """Return the contract's message with the default COB-ID of a record."""
    return messages.get(pdos.dictionary.value(index, 1) & 0x7FF)


def _check_type(value: int) -> None:
    if value not in _TYPES:
        refuse(Abort.VALUE_RANGE)
