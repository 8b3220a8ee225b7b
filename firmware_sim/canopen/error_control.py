"""Error control of one emulated device: EMCY and its history, heartbeats both ways, watchdogs, the order of SYNCs.

Each watchdog trips once, sends an EMCY, and clears by itself when its cause has gone. An EMCY's byte 3 is the number of
the watchdog, its bytes 4 to 7 the device's time in ms at which the watchdog tripped. 0x2210 keeps the last trip and
counts all. The drive handles a fault that a watchdog caused, and the fault stays latched. Source: CiA 301 (4.2), 7.2.7
(EMCY: objects 0x1001, 0x1003, 0x1014, 0x1015), 7.2.8.3.2 (heartbeats: 0x1016, 0x1017), table 27 (0x8100 … 0x8250),
7.2.5 (SYNC: object 0x1019, table 26); CiA 402-1, error codes 0x6320 "parameter error" and 0x8700 "sync controller".

**The order of SYNCs**: which ones are odd, and how many odd ones a device has received.

    odd SYNC         is                                                                   the device
    repeated         one with the counter of the SYNC before                              ignores it
    out of sequence  one whose counter runs backwards or, by the clock, further ahead     takes it; the count goes on
                     than time; one whose counter is 0 or beyond 0x1019                   from there. Ignores the latter
    early            one that comes in order and, by the clock, ahead of time             takes it
    wrong length     one with a counter if 0x1019 is 0, without one otherwise             ignores it

A counter that runs forward means SYNCs that were lost. Ahead of time is more than 0.4 periods ahead of its place after
the SYNC before, less the lateness of earlier SYNCs: a master that stalls may come back to its grid, and frames that
waited for a busy receiver may come in a row. That lateness is forgotten with a time constant of 100 SYNCs, so that a
master whose clock is slow gathers no lateness.

CAN itself may deliver a frame twice: if the last bit of its end-of-frame is disturbed, the sender repeats a frame
that receivers have taken already (ISO 11898-1). So a single odd SYNC is a warning. More than `TOLERATED` before
`CLEAN_SYNCS` in a row were right mean that SYNC can't serve as a time base.
"""

import struct
from collections import deque
from collections.abc import Callable
from enum import Enum, IntEnum

from adacd_hil.wire.contract_frames import NOT_VALID
from adacd_hil.wire.time_marks import NEVER_NS
from firmware_sim.canopen.object_dictionary import Abort, ObjectDictionary, Send, one_of, refuse

HISTORY_LENGTH = 4
"""Entries of 0x1003 in the EDS files."""

_EMERGENCY = struct.Struct("<HBBI")


_COUNT_SUB = 2  # 0x2210: counts are at sub-index 2 + number


class Watchdog(IntEnum):
    """Numbers of the watchdogs. A comment names the event that clears each."""

    SYNC = 1  # a SYNC comes while `SyncCounts.is_in_order`
    COMMAND = 2  # a valid command acts
    HEARTBEAT = 3  # the master's heartbeat comes, or monitoring ends
    OPERATIONAL = 4  # NMT start
    LENGTH = 5  # a right frame of an RPDO comes after one of wrong length
    SYNC_ORDER = 6  # 100 SYNCs in a row are right
    SYNC_LENGTH = 7  # a right SYNC comes
    COMMAND_PDO = 8  # Enable operation is withdrawn, or can be obeyed


ERROR_CODES = {
    # CiA 301 has no code for a missing SYNC (0x8140 is recovery from bus-off, 0x8240 a SYNC of the wrong length).
    Watchdog.SYNC: 0x8700,
    Watchdog.COMMAND: 0x8250,
    Watchdog.HEARTBEAT: 0x8130,
    Watchdog.OPERATIONAL: 0x8100,
    Watchdog.LENGTH: 0x8210,
    Watchdog.SYNC_ORDER: 0x8200,
    Watchdog.SYNC_LENGTH: 0x8240,
    Watchdog.COMMAND_PDO: 0x6320,
}
"""EMCY error code and 0x603F by watchdog."""

WARNINGS = frozenset({Watchdog.LENGTH, Watchdog.SYNC_ORDER, Watchdog.SYNC_LENGTH, Watchdog.COMMAND_PDO})
"""Those that never cause a fault."""


class ErrorReporter:
    """Sends EMCYs with inhibit time; keeps the history of their codes, newest first, and the tripped watchdogs."""

    def __init__(
        self, dictionary: ObjectDictionary, send: Send, register: Callable[[], int], is_allowed: Callable[[], bool]
    ) -> None:
        """Serve the device's error objects: 0x1001, 0x1003, 0x1014, 0x1015 and 0x2210.

        `register`: present 0x1001. `is_allowed`: whether the NMT state lets EMCY be sent.
        """
        self._send = send
        self._register = register
        self._is_allowed = is_allowed
        self._waiting: deque[bytes] = deque()
        self._inhibit_ns = 0
        self._allowed_ns = 0
        self._is_valid = True
        self._cob_id = 0x80 + dictionary.node_id
        self._history: deque[int] = deque(maxlen=HISTORY_LENGTH)
        self.tripped: set[Watchdog] = set()
        self._last = 0
        self._last_ms = 0
        self._counts = dict.fromkeys(Watchdog, 0)
        dictionary.serve(0x1001, 0, register)
        dictionary.serve(0x1003, 0, lambda: len(self._history))
        for sub in range(1, HISTORY_LENGTH + 1):
            dictionary.serve(0x1003, sub, lambda sub=sub: self._past_error(sub))  # type: ignore[misc]
        dictionary.watch(0x1003, 0, lambda _: self._history.clear(), one_of(0))
        dictionary.watch(0x1014, 0, self._validate, self._check_cob_id)
        dictionary.watch(0x1015, 0, self._set_inhibit)
        dictionary.serve(0x2210, 1, lambda: self._last)
        dictionary.serve(0x2210, 2, lambda: self._last_ms & 0xFFFFFFFF)
        for watchdog in Watchdog:
            dictionary.serve(0x2210, _COUNT_SUB + watchdog, lambda w=watchdog: self._counts[w] & 0xFFFF)  # type: ignore[misc]

    def report_error(self, code: int, t_ns: int, number: int = 0, time_ms: int = 0) -> None:
        """Add a code other than 0 to the history, and send an EMCY, at once or after the inhibit time.

        It sends none if 0x1014 or the NMT state forbids it. number: of the watchdog, 0 for none. t_ns, time_ms: on the
        device's clock.
        """
        if code != 0:
            self._history.appendleft(code)
        if self._is_valid and self._is_allowed():
            self._waiting.append(_EMERGENCY.pack(code, self._register(), number, time_ms & 0xFFFFFFFF))
            self.send_waiting(t_ns)

    def report_at_once(self, code: int, t_ns: int) -> None:
        """Add a code to the history, and send an EMCY now, before those that wait for the inhibit time.

        That time begins anew. It sends none if 0x1014 or the NMT state forbids it. t_ns: on the device's clock.
        """
        self._history.appendleft(code)
        if self._is_valid and self._is_allowed():
            self._allowed_ns = t_ns + self._inhibit_ns
            self._send(self._cob_id, _EMERGENCY.pack(code, self._register(), 0, 0))

    def trip(self, watchdog: Watchdog, t_ns: int, time_ms: int) -> None:
        """Mark a watchdog as tripped, count the trip and send its EMCY.

        A watchdog that is tripped already changes nothing. time_ms: on the device's clock.
        """
        if watchdog in self.tripped:
            return
        self.tripped.add(watchdog)
        self._last, self._last_ms = watchdog, time_ms
        self._counts[watchdog] += 1
        self.report_error(ERROR_CODES[watchdog], t_ns, watchdog, time_ms)

    def clear(self, watchdog: Watchdog, t_ns: int, time_ms: int) -> None:
        """Mark a watchdog as no longer tripped, and send an EMCY with code 0. Raises KeyError if it isn't tripped."""
        self.tripped.remove(watchdog)
        self.report_error(0, t_ns, watchdog, time_ms)

    def forget_messages(self) -> None:
        """Drop the waiting EMCYs, the history and the running inhibit time, as a loss of power does.

        Tripped watchdogs and their counts stay.
        """
        self._waiting.clear()
        self._history.clear()
        self._allowed_ns = 0

    def forget_trips(self) -> None:
        """Clear the tripped watchdogs, the counts of all trips, and the last trip with its time; send no EMCY.

        A reset of the node calls it.
        """
        self.tripped.clear()
        self._last = self._last_ms = 0
        self._counts = dict.fromkeys(Watchdog, 0)

    def send_waiting(self, t_ns: int) -> int:
        """Send the waiting EMCYs that the inhibit time allows.

        Return when the next may follow, ns, NEVER_NS if none waits.
        """
        while self._waiting and t_ns >= self._allowed_ns:
            self._allowed_ns = t_ns + self._inhibit_ns
            self._send(self._cob_id, self._waiting.popleft())
        return self._allowed_ns if self._waiting else NEVER_NS

    def _past_error(self, sub: int) -> int:
        if sub > len(self._history):
            refuse(Abort.NO_DATA)
        return self._history[sub - 1]

    def _check_cob_id(self, value: int) -> None:
        if value & ~NOT_VALID != self._cob_id:
            refuse(Abort.VALUE_RANGE)

    def _validate(self, value: int) -> None:
        self._is_valid = not value & NOT_VALID

    def _set_inhibit(self, tenths_ms: int) -> None:
        self._inhibit_ns = tenths_ms * 100_000


class HeartbeatProducer:
    """Sends the NMT state every n ms, n being the value of 0x1017. A value of 0 ends that."""

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

    def begin_heartbeats(self, t_ns: int) -> None:
        """Make the next heartbeat due one period after `t_ns`; never if the period is 0."""
        self._due_ns = t_ns + self._period_ns if self._period_ns else NEVER_NS

    def send_due(self, t_ns: int) -> int:
        """Send a heartbeat if it is due; return when the next is due, ns.

        Of several missed periods it sends one; the next is due a whole number of periods after the first. NEVER_NS
        without heartbeats. Both times are on the device's clock.
        """
        if t_ns >= self._due_ns:
            self._due_ns = t_ns + self._period_ns - (t_ns - self._due_ns) % self._period_ns
            self._send(self._can_id, bytes([self._state()]))
        return self._due_ns

    def _set_period(self, period_ms: int) -> None:
        self._period_ns = period_ms * 1_000_000
        self.begin_heartbeats(self._now_ns())


class HeartbeatConsumer:
    """Monitors the heartbeat of the node in 0x1016:1, from its first heartbeat on.

    A lost one is found again when one arrives.
    """

    def __init__(
        self,
        dictionary: ObjectDictionary,
        on_silence: Callable[[int], None],
        on_return: Callable[[int], None],
        now_ns: Callable[[], int],
    ) -> None:
        """Watch 0x1016:1, which sets node and timeout.

        `on_silence`: called with t_ns when the heartbeat stays away. `on_return`: called with t_ns when a lost one is
        there again, or when a write of 0x1016:1 ends or restarts its monitoring.
        """
        self.is_lost = False
        """Whether the heartbeat is monitored and missing."""
        self._on_silence, self._on_return, self._now_ns = on_silence, on_return, now_ns
        self._node_id = 0
        self._timeout_ns = 0
        self._due_ns = NEVER_NS
        dictionary.watch(0x1016, 1, self._configure, _check_node)

    def on_heartbeat(self, node_id: int, t_ns: int) -> None:
        """Restart the timeout if the heartbeat is of the monitored node, and report the return of a lost one.

        Other nodes' heartbeats have no effect.
        """
        if self._timeout_ns == 0 or node_id != self._node_id:
            return
        self._due_ns = t_ns + self._timeout_ns
        self._find(t_ns)

    def find_silence(self, t_ns: int) -> int:
        """Report the heartbeat as lost if its timeout is over; return when to call again, ns.

        NEVER_NS before the first heartbeat and while it is lost. Both times are on the device's clock.
        """
        if t_ns >= self._due_ns:
            self._due_ns = NEVER_NS
            self.is_lost = True
            self._on_silence(t_ns)
        return self._due_ns

    def _configure(self, value: int) -> None:
        self._node_id = (value >> 16) & 0x7F
        self._timeout_ns = (value & 0xFFFF) * 1_000_000
        self._due_ns = NEVER_NS
        self._find(self._now_ns())  # a node that isn't monitored any more isn't missing

    def _find(self, t_ns: int) -> None:
        """Report the return of a lost heartbeat; otherwise do nothing."""
        if self.is_lost:
            self.is_lost = False
            self._on_return(t_ns)


def _check_node(value: int) -> None:
    """Abort the SDO write (VALUE_RANGE) of a value of 0x1016 that has a timeout and a node id outside 1 to 127."""
    if value & 0xFFFF and not 1 <= value >> 16 <= 127:
        refuse(Abort.VALUE_RANGE)


TOLERATED = 3
CLEAN_SYNCS = 100

_AHEAD = 0.4  # of a period: less than half-way between a SYNC in its place and a second one
_FORGETTING = 0.99  # of lateness, per SYNC
_LOST_SUB = 5  # of 0x2211


class SyncKind(Enum):
    """How one SYNC compares with those before. Except for RIGHT, the value is its sub-index of 0x2211."""

    RIGHT = 0
    REPEATED = 1
    OUT_OF_SEQUENCE = 2
    EARLY = 3
    WRONG_LENGTH = 4


class SyncOrder:
    """Judges each SYNC of the right length by its counter and, where time doesn't go by SYNC, by its time."""

    def __init__(self, is_timed: bool) -> None:
        """`is_timed`: judge the time of a SYNC, too; False where time goes by SYNC."""
        self.kind = SyncKind.RIGHT
        """Of the last SYNC."""
        self.is_taken = True
        """Whether devices take the last SYNC."""
        self.counter = 0
        """Of the last SYNC that was taken, 0 before the first; counted if SYNC has no counter."""
        self.periods = 1
        """Periods from the SYNC before to the last one; 1 if unknown."""
        self._is_timed = is_timed
        self._last_ns = 0
        self._lateness_ns = 0.0

    def forget_last(self) -> None:
        """Forget the last SYNC's counter, so that the next SYNC is judged as the first."""
        self.counter = 0

    def judge(self, counter: int, overflow: int, t_ns: int, period_ns: int) -> None:
        """Set `kind`, `is_taken`, `counter` and `periods` by a SYNC of the right length.

        A SYNC that isn't taken leaves `counter`. `counter`: 0 without one. `overflow`: 0x1019, 0 for SYNCs without
        counter. `t_ns`: when it came, used and kept only if SYNC is judged by time. `period_ns`: 0x1006; 0: not set, so
        no SYNC is early.
        """
        last = self.counter
        self.kind, self.is_taken, self.periods = SyncKind.RIGHT, True, 1
        if overflow == 0:
            counter = last + 1
        elif not 1 <= counter <= overflow:
            self.kind, self.is_taken = SyncKind.OUT_OF_SEQUENCE, False
            return
        elif counter == last:
            self.kind, self.is_taken = SyncKind.REPEATED, False
            return
        else:
            self.periods = (counter - last) % overflow if last else 1
        self.counter = counter
        if self._is_timed:
            self._judge_time(t_ns, period_ns, is_first=last == 0)
        elif overflow and self.periods > overflow // 2:
            self.kind = SyncKind.OUT_OF_SEQUENCE
        if self.kind is SyncKind.OUT_OF_SEQUENCE:
            self.periods = 1

    def _judge_time(self, t_ns: int, period_ns: int, is_first: bool) -> None:
        ahead_ns = self.periods * period_ns - (t_ns - self._last_ns)
        self._last_ns = t_ns
        if is_first or period_ns == 0:
            self._lateness_ns = period_ns  # the lateness is unknown
            return
        if ahead_ns - self._lateness_ns > _AHEAD * period_ns:
            self.kind = SyncKind.EARLY if self.periods == 1 else SyncKind.OUT_OF_SEQUENCE
        self._lateness_ns = max(0.0, _FORGETTING * self._lateness_ns - ahead_ns)


class SyncCounts:
    """Counts of one device in 0x2211: of lost SYNCs, and of odd ones.

    Odd ones are repeated, out of sequence, early or of wrong length.
    """

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self.odd = 0
        """Odd SYNCs of the right length since `CLEAN_SYNCS` in a row were right."""
        self._clean = 0
        self._counts = [0] * (_LOST_SUB + 1)
        for sub in range(1, _LOST_SUB + 1):
            dictionary.serve(0x2211, sub, lambda sub=sub: self._counts[sub] & 0xFFFF)  # type: ignore[misc]

    @property
    def is_in_order(self) -> bool:
        """Whether no SYNC was repeated, early or out of sequence since the last `CLEAN_SYNCS` right ones in a row."""
        return self.odd == 0

    @property
    def is_time_base(self) -> bool:
        """Whether SYNC can serve as time base: at most TOLERATED were repeated, early or out of sequence, see `odd`."""
        return self.odd <= TOLERATED

    def count_sync(self, kind: SyncKind, lost: int) -> None:
        """Count a SYNC that isn't right by its kind, and `lost` SYNCs before it, in 0x2211.

        One that is repeated, early or out of sequence adds to `odd`; `CLEAN_SYNCS` right ones in a row set `odd` to 0,
        but no count in 0x2211. Lost SYNCs and those of wrong length change neither `odd` nor the row.
        """
        self._counts[_LOST_SUB] += lost
        if kind is not SyncKind.RIGHT:
            self._counts[kind.value] += 1
        if kind is SyncKind.RIGHT:
            self._clean += 1
            if self._clean >= CLEAN_SYNCS:
                self.odd = 0
        elif kind is not SyncKind.WRONG_LENGTH:
            self.odd += 1
            self._clean = 0

    def forget_counts(self) -> None:
        """Set all counts, those of 0x2211 included, to 0, as at power-on."""
        self.odd = self._clean = 0
        self._counts = [0] * (_LOST_SUB + 1)
