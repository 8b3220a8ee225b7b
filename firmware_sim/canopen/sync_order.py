"""The order of SYNCs: which ones are odd, and how many of those one device has heard.

    odd SYNC         is                                                                   the device
    repeated         one with the counter of the SYNC before                              ignores it
    out of sequence  one whose counter runs backwards or, by the clock, further ahead     takes it; the count goes on
                     than time; one whose counter is 0 or beyond 0x1019                   from there. Ignores the latter
    early            one that comes in order and, by the clock, ahead of time             takes it
    wrong length     one with a counter where 0x1019 is 0, without where it isn't         ignores it

A counter that runs forward means SYNCs that were lost. Ahead of time is more than 0.4 periods ahead of its place after
the SYNC before, less the lateness of earlier SYNCs: a master that stalls may come back to its grid, and frames that
waited for a busy receiver may come in a row. That lateness is forgotten with a time constant of 100 SYNCs, so that a
master whose clock is slow gathers none.

CAN itself may deliver a frame twice: if the last bit of its end-of-frame is disturbed, the sender repeats what
receivers have taken already (ISO 11898-1). So a single odd SYNC is a warning. More than `TOLERATED` before
`CLEAN_SYNCS` in a row were right mean that SYNC is no time base.

Source: CiA 301 (4.2), 7.2.5 (SYNC), object 0x1019, table 26 (0x8200, 0x8240).
"""

from enum import Enum

from firmware_sim.canopen.object_dictionary import ObjectDictionary

TOLERATED = 3
CLEAN_SYNCS = 100

_AHEAD = 0.4  # of a period: less than half-way between a SYNC in its place and a second one
_FORGETTING = 0.99  # of lateness, per SYNC
_LOST_SUB = 5  # of 0x2211


class SyncKind(Enum):
    """The place of one SYNC in the order of those before. The value of an odd one is its sub-index of 0x2211."""

    RIGHT = 0
    REPEATED = 1
    OUT_OF_SEQUENCE = 2
    EARLY = 3
    WRONG_LENGTH = 4


class SyncOrder:
    """Judges every SYNC on the bus by its counter and, where time doesn't go by SYNC, by its time."""

    def __init__(self, is_timed: bool) -> None:
        """`is_timed`: when a SYNC comes says something that its counter doesn't."""
        self.kind = SyncKind.RIGHT
        """Of the last SYNC."""
        self.is_taken = True
        """Whether devices take the last SYNC."""
        self.counter = 0
        """Of the last SYNC that was taken, 0 before the first; counted where SYNC has none."""
        self.periods = 1
        """By how many the last SYNC went on; 1 where that isn't known."""
        self._is_timed = is_timed
        self._last_ns = 0
        self._lateness_ns = 0.0

    def restart(self) -> None:
        """Take the next SYNC for the first."""
        self.counter = 0

    def judge(self, counter: int, overflow: int, t_ns: int, period_ns: int) -> None:
        """Judge a SYNC of the right length. `counter`: 0 where it has none. `overflow`: 0x1019."""
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
        elif last:
            self.periods = (counter - last) % overflow
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
        if is_first:
            self._lateness_ns = period_ns  # nobody knows
            return
        if ahead_ns - self._lateness_ns > _AHEAD * period_ns:
            self.kind = SyncKind.EARLY if self.periods == 1 else SyncKind.OUT_OF_SEQUENCE
        self._lateness_ns = max(0.0, _FORGETTING * self._lateness_ns - ahead_ns)


class SyncCounts:
    """The odd SYNCs that one device has received: 0x2211."""

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self.odd = 0
        """Odd SYNCs of the right length since `CLEAN_SYNCS` in a row were right."""
        self._clean = 0
        self._counts = [0] * (_LOST_SUB + 1)
        for sub in range(1, _LOST_SUB + 1):
            dictionary.serve(0x2211, sub, lambda sub=sub: self._counts[sub] & 0xFFFF)  # type: ignore[misc]

    @property
    def is_in_order(self) -> bool:
        """Whether no odd SYNC is remembered."""
        return self.odd == 0

    @property
    def is_time_base(self) -> bool:
        """Whether SYNC can be relied on."""
        return self.odd <= TOLERATED

    def note(self, kind: SyncKind, lost: int) -> None:
        """Count a SYNC, and those that were lost before it."""
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

    def reset(self) -> None:
        """Forget everything, as at power-on."""
        self.odd = self._clean = 0
        self._counts = [0] * (_LOST_SUB + 1)
