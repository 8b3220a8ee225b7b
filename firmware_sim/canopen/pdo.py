"""The PDOs of one emulated device: RPDO1… and TPDO1… by CiA 301, whatever a master maps into them.

transmission type   RPDO                        TPDO
0                   acts at the next SYNC       at the SYNC after an event
1 … 240             acts at the next SYNC       at every n-th SYNC
254, 255            acts at once                on an event, and when the event timer ends

An event is a change of an object that describes the device's state (`events` of `Pdos`), or, in a PDO without such an
object, any change of its content, looked for at every SYNC. An RPDO's event timer is its deadline. Frames whose mapping
leads with the end-to-end header's objects are protected with the data ids of the message that has the PDO's default
COB-ID. Source: CiA 301 (4.2), 7.5.2.35 to 7.5.2.38.
"""

from collections.abc import Callable, Iterable, Mapping

from adacd_hil.wire.codec import MessageCodec
from adacd_hil.wire.e2e import E2eStatus
from adacd_hil.wire.time_marks import NEVER_NS
from firmware_sim.canopen.object_dictionary import ObjectDictionary, Send
from firmware_sim.canopen.pdo_record import EVENT_DRIVEN, PdoRecord

RECEIVE, TRANSMIT = 0x1400, 0x1800
COUNT = 8
"""PDOs of a device that are looked for, each way; our own have 4."""


class TransmitPdo(PdoRecord):
    """A TPDO of a device: sends the values of its mapped objects on SYNC, event or timer."""

    is_received = False

    def __init__(self, pdos: "Pdos", index: int, messages: Mapping[int, MessageCodec]) -> None:
        super().__init__(pdos.dictionary, index, messages, pdos.longest, pdos.refresh)
        self._pdos = pdos
        self.is_due = False
        """Whether an event has happened that the bus hasn't seen."""
        self._reads: tuple[Callable[[], int], ...] = ()
        message = self.message
        self._sender = None if message is None or not message.is_protected else message.sender()
        self.send: Callable[[], None] = lambda: None
        """Sends the present values."""
        self._syncs = 0
        self._allowed_ns = 0
        self._timer_due_ns = NEVER_NS
        self._sent = b""
        self.is_compared = False
        """Whether its events are the changes of its content."""

    def restart_sequence(self) -> None:
        """Restart the counter of protected frames; a plain PDO stays as it is. It takes effect with the next `bind`."""
        if self.message is not None and self.message.is_protected:
            self._sender = self.message.sender()

    def bind(self) -> None:
        """Set `send`, the function that sends a frame, and `is_compared` by the present type and mapping.

        Restart the count of SYNCs to a frame. Call it after a change of type or mapping.
        """
        self._reads = tuple(self._pdos.dictionary.reader(*key) for key in self.layout.keys)
        is_asynchronous = self.type == 0 or self.type in EVENT_DRIVEN
        self.is_compared = is_asynchronous and not self._pdos.events.intersection(self.layout.keys)
        self._syncs = 0
        self.send = self._make_sender()

    def begin_sending(self, t_ns: int) -> None:
        """Make the PDO due now, and stop its event timer; call it when the PDO becomes active."""
        self.is_due = True
        self._allowed_ns = t_ns
        self._timer_due_ns = NEVER_NS

    def _make_sender(self) -> Callable[[], None]:
        """Return a function that sends a frame of the mapped objects' present values.

        It protects the frame if the mapping begins with a header.
        """
        pdos, can_id, layout, reads, sender = self._pdos, self.can_id, self.layout, self._reads, self._sender
        send, header_bytes, length = pdos.send, layout.header_bytes, layout.length
        pack, pack_into = layout.packing.pack, layout.packing.pack_into
        profile = None if self.message is None else self.message.profile
        status_byte, status_shift = (0, 0) if profile is None else profile.status_place

        def send_protected() -> None:
            frame = bytearray(length)
            pack_into(frame, header_bytes, *[read() for read in reads])
            frame[status_byte] = pdos.header_status() << status_shift & 0xFF
            data = pdos.header = sender.protect(frame)  # type: ignore[union-attr]
            send(can_id, data)

        def send_plain() -> None:
            send(can_id, pack(*[read() for read in reads]))

        return send_protected if header_bytes else send_plain

    def on_sync(self) -> None:
        """Send a frame if this SYNC is the n-th of transmission type n.

        Type 0 sends if an event has happened since its last frame.
        """
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
        """Set `is_due` if the content has changed since the last call, or at the first one; keep the content.

        Only in a PDO whose events are such changes.
        """
        if self.is_compared:
            content = self.layout.packing.pack(*[read() for read in self._reads])
            if content != self._sent:
                self._sent = content
                self.is_due = True

    def poll(self, t_ns: int) -> int:
        """Send a frame for an event, after the inhibit time, or by the event timer; return when to call again, ns.

        It returns NEVER_NS without an event and a timer, which begins with the first frame. Both times are on the
        device's clock.
        """
        if (self.is_due and t_ns >= self._allowed_ns) or t_ns >= self._timer_due_ns:
            self.is_due = False
            self._allowed_ns = t_ns + self.inhibit_ns
            self._timer_due_ns = t_ns + self.timer_ns if self.timer_ns else NEVER_NS
            self.send()
        return self._allowed_ns if self.is_due else self._timer_due_ns


class ReceivePdo(PdoRecord):
    """An RPDO of a device: writes received values to its mapped objects, at once or at SYNC."""

    is_received = True

    def __init__(self, pdos: "Pdos", index: int, messages: Mapping[int, MessageCodec]) -> None:
        super().__init__(pdos.dictionary, index, messages, pdos.longest, pdos.refresh)
        self._pdos = pdos
        message = self.message
        self.receiver = None if message is None or not message.is_protected else message.receiver()
        """Checks the frames of the contract's message; None where that isn't protected."""
        self.acted_ns: int | None = None
        """When its last frame acted; None before the first."""
        self.writes: tuple[Callable[[int], object], ...] = ()
        """Functions that take the received values, in the order of the mapping."""
        self.pending: tuple[int, ...] | None = None
        """Values that wait for SYNC."""
        self.is_command = False
        """Whether this PDO counts as the device's command."""
        self._is_length_wrong = False

    def restart_sequence(self) -> None:
        """Accept any counter in the next protected frame, drop a frame that waits for SYNC, and stop the deadline."""
        if self.receiver is not None:
            self.receiver.restart_sequence()
        self.forget()
        self.acted_ns = None

    def bind(self) -> None:
        """Set the functions that take received values by the present mapping, and `is_command` to False."""
        self.writes = tuple(self._pdos.writer(*key) for key in self.layout.keys)
        self.is_command = False

    def forget(self) -> None:
        """Drop a frame that waits for SYNC."""
        self.pending = None

    def on_frame(self, data: bytes, t_ns: int) -> None:
        """Check a frame; keep its values until SYNC, or write them at once for an event-driven type.

        A frame of wrong length, or one that fails the end-to-end check, changes no object. `Pdos.mind_length` is called
        for each frame of wrong length, and for the first good one after it. A later frame replaces the values that
        wait. t_ns: the bench's time.
        """
        layout = self.layout
        if len(data) != layout.length:
            self._is_length_wrong = True
            self._pdos.mind_length(False, self._pdos.own_ns(t_ns))
            return
        if layout.header_bytes and self.receiver is not None:
            if self.receiver.check(data) > E2eStatus.OK_SOME_LOST:
                return
            self._pdos.header = data
        if self._is_length_wrong:
            self._is_length_wrong = False
            self._pdos.mind_length(True, self._pdos.own_ns(t_ns))
        self.pending = layout.packing.unpack_from(data, layout.header_bytes)
        if self.type in EVENT_DRIVEN:
            self._pdos.act_at_once(self, self._pdos.own_ns(t_ns))


class Pdos:
    """All PDOs of one device."""

    def __init__(
        self,
        dictionary: ObjectDictionary,
        send: Send,
        messages: Mapping[int, MessageCodec],
        longest: int,
    ) -> None:
        """Make a PDO for each of COUNT communication records each way that the dictionary has.

        Serve the objects of the end-to-end header, 0x2100 and 0x2101. `messages`: the contract's, by identifier.
        `longest`: the longest frame, bytes.
        """
        self.dictionary = dictionary
        self.send = send
        self.longest = longest
        self.act: Callable[[int], None] = lambda _t_ns: None
        """Called when a frame that doesn't wait for SYNC has been written."""
        self.mind_length: Callable[[bool, int], None] = lambda _is_right, _t_ns: None
        """Called with (is_right, t_ns) for each frame of wrong length, and for the first right one after it."""
        self.header = bytes(4)
        """Header of the last protected frame, received or sent."""
        self.header_status: Callable[[], int] = int
        """Status field of a header that is sent."""
        self.events: frozenset[tuple[int, int]] = frozenset()
        """Objects whose changes the device announces by `notify`."""
        self._is_commanded = False  # a command has acted since the last SYNC, without waiting for one
        self._writers: dict[tuple[int, int], Callable[[int], object]] = {}
        self.on_refresh: Callable[[], None] = lambda: None
        """Called at the end of each `refresh`: other PDOs may be exchanged than before."""
        self._is_operational = False
        self._now_ns = 0
        self.own_ns: Callable[[int], int] = lambda t_ns: t_ns
        """Turns the bench's time, with which frames come, into the device's."""
        self.on_sync: tuple[Callable[[], None], ...] = ()
        """Functions that send the frames of a SYNC."""
        self.answers: frozenset[int] = frozenset()
        """Identifiers of the frames that follow every SYNC."""
        self._asynchronous: tuple[TransmitPdo, ...] = ()
        self._compared: tuple[TransmitPdo, ...] = ()
        self._receiving: tuple[ReceivePdo, ...] = ()
        self._waiting: tuple[ReceivePdo, ...] = ()
        self._sending: frozenset[TransmitPdo] = frozenset()
        self.receive = tuple(ReceivePdo(self, i, messages) for i in _records(self, RECEIVE))
        self.transmit = tuple(TransmitPdo(self, i, messages) for i in _records(self, TRANSMIT))
        dictionary.serve(0x2100, 1, lambda: self.header[0])
        dictionary.serve(0x2100, 2, lambda: self.header[1])
        dictionary.serve(0x2101, 1, lambda: int.from_bytes(self.header[:2], "little"))
        dictionary.serve(0x2101, 2, lambda: self.header[2])
        dictionary.serve(0x2101, 3, lambda: self.header[3])

    @property
    def is_commandable(self) -> bool:
        """Whether an active RPDO brings target torque, or, if none does, the controlword."""
        return any(pdo.is_command for pdo in self._receiving)

    def brings(self, index: int, subindex: int) -> bool:
        """Return whether an active RPDO has an object in its mapping."""
        return any((index, subindex) in pdo.layout.keys for pdo in self._receiving)

    def accept_values(self, index: int, subindex: int, write: Callable[[int], object]) -> None:
        """Register `write` for an object's values that come by RPDO.

        It replaces the checked write of the object in PDOs that are bound from now on.
        """
        self._writers[index, subindex] = write

    def writer(self, index: int, subindex: int) -> Callable[[int], object]:
        """Return the function that takes an object's values from RPDOs: by `accept_values`, else by a checked write.

        The latter drops a value that the object can't take.
        """
        return self._writers.get((index, subindex)) or (lambda value: self.dictionary.take_over(index, subindex, value))

    def handlers(self) -> list[tuple[int, Callable[[bytes, int], None]]]:
        """Return pairs (identifier, function that takes data and time) of the RPDOs that are active now."""
        return [(pdo.can_id, pdo.on_frame) for pdo in self._receiving]

    def set_operational(self, is_operational: bool, t_ns: int) -> None:
        """Begin or end the exchange of PDOs, as the device enters or leaves NMT state Operational at `t_ns`."""
        self._is_operational = is_operational
        self._now_ns = t_ns
        self.refresh()

    def refresh(self) -> None:
        """Update which PDOs are active, after a change of the NMT state or of a PDO's objects; then call `on_refresh`.

        TPDOs that become active are due at once; frames that wait in an RPDO no longer active or no longer synchronous
        are dropped. All active TPDOs begin to count SYNCs anew.
        """
        self._receiving = tuple(pdo for pdo in self.receive if self._is_operational and pdo.is_active)
        sending = tuple(pdo for pdo in self.transmit if self._is_operational and pdo.is_active)
        exchanged: tuple[ReceivePdo | TransmitPdo, ...] = (*self._receiving, *sending)
        for pdo in exchanged:
            pdo.bind()
        for waiting in self.receive:
            if waiting not in self._receiving or not waiting.is_synchronous:
                waiting.forget()
        for begun in sending:
            if begun not in self._sending:
                begun.begin_sending(self._now_ns)
        self._sending = frozenset(sending)
        self.answers = frozenset(pdo.can_id for pdo in sending if pdo.type == 1)
        self.on_sync = tuple(pdo.send if pdo.type == 1 else pdo.on_sync for pdo in sending if pdo.is_synchronous)
        self._asynchronous = tuple(pdo for pdo in sending if not pdo.is_synchronous)
        self._compared = tuple(pdo for pdo in self._asynchronous if pdo.is_compared)
        self._waiting = tuple(pdo for pdo in self._receiving if pdo.is_synchronous)
        self._find_commands()
        self.on_refresh()

    def _find_commands(self) -> None:
        """Mark the RPDOs that count as commands: all with target torque, or, without any, all with the controlword."""
        for key in ((0x6071, 0), (0x6040, 0)):
            found = [pdo for pdo in self._receiving if key in pdo.layout.keys]
            if found:
                for pdo in found:
                    pdo.is_command = True
                return

    def restart_sequences(self) -> None:
        """Restart the counters of all protected frames, sent and received; drop frames that wait for SYNC.

        Stop the deadlines of RPDOs. The counters of TPDOs restart with their next `bind`.
        """
        pdos: tuple[ReceivePdo | TransmitPdo, ...] = (*self.receive, *self.transmit)
        for pdo in pdos:
            pdo.restart_sequence()

    def act_on_sync(self, t_ns: int) -> bool:
        """Write the values of frames that waited for SYNC. Return whether a command has acted since the SYNC before."""
        is_commanded, self._is_commanded = self._is_commanded, False
        return self._act(self._waiting, t_ns) or is_commanded

    def act_at_once(self, pdo: ReceivePdo, t_ns: int) -> None:
        """Write the received values of an event-driven RPDO to their objects, then call `self.act`.

        At the next SYNC a command among them counts as one that has come.
        """
        self._is_commanded |= self._act((pdo,), t_ns)
        self.act(t_ns)

    @staticmethod
    def _act(pdos: Iterable[ReceivePdo], t_ns: int) -> bool:
        """Write the waiting values of RPDOs, and return whether one of them was a command."""
        is_commanded = False
        for pdo in pdos:
            values = pdo.pending
            if values is not None:
                pdo.pending = None
                pdo.acted_ns = t_ns
                for write, value in zip(pdo.writes, values, strict=False):
                    write(value)
                is_commanded = is_commanded or pdo.is_command
        return is_commanded

    @property
    def deadline_ns(self) -> int:
        """Time on the device's clock from which some active RPDO is late: its last frame acted an event timer ago, ns.

        It is NEVER_NS if no RPDO has an event timer and an earlier frame.
        """
        ends = [pdo.acted_ns + pdo.timer_ns for pdo in self._receiving if pdo.timer_ns and pdo.acted_ns is not None]
        return min(ends, default=NEVER_NS)

    @property
    def rejected_frames(self) -> int:
        """Number of received frames so far that failed the end-to-end check."""
        receivers = [pdo.receiver for pdo in self.receive if pdo.receiver is not None]
        return sum(receiver.counts[s] for receiver in receivers for s in E2eStatus if not s.is_valid)

    def notify(self) -> None:
        """Make all active TPDOs due whose events are state changes, not changes of their content."""
        for pdo in self._sending:
            if not pdo.is_compared:
                pdo.is_due = True

    def compare(self) -> bool:
        """Check the TPDOs whose events are changes of their content, and return whether one of them is due.

        Those of type 0 are left out: they check at SYNC by themselves.
        """
        for pdo in self._compared:
            pdo.compare()
        return any(pdo.is_due for pdo in self._compared)

    def poll(self, t_ns: int) -> int:
        """Send event-driven TPDOs that are due; return when to call again, ns, NEVER_NS without any."""
        due_ns = NEVER_NS
        for pdo in self._asynchronous:
            due_ns = min(due_ns, pdo.poll(t_ns))
        return due_ns


def _records(pdos: Pdos, first: int) -> list[int]:
    return [index for index in range(first, first + COUNT) if pdos.dictionary.has(index, 1)]
