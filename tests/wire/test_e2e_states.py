"""All states × all events of the end-to-end check, against a plain transcription of the standard's algorithms.

The transcriptions keep the standard's names (AUTOSAR FO PRS E2E Protocol, E2E_P02Check and E2E_P05Check) and differ
from it where `adacd_hil.wire.e2e` says so: the first frame with a right CRC may be used (the standard's INITIAL) and
ends the silence before it, and Profile 5 has the SYNC of Profile 2.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from adacd_hil.wire.e2e import (
    PROFILE_2_TOLERANCE,
    PROFILE_5_TOLERANCE,
    PROFILES,
    E2eReceiver,
    E2eSender,
    E2eStatus,
    ProtectedReceiver,
    Protection,
    Tolerance,
)

P02, P05 = PROFILES[Protection.PROFILE_2], PROFILES[Protection.PROFILE_5]
DATA_IDS = bytes.fromhex("f5ddf3da0f18165dd62cbdd0acdb4f41")
DATA_ID = b"\x86\x8e"
LENGTH = 6


@dataclass
class Event:
    """What one cycle brings: nothing, or a frame whose counter is `delta` beyond that of the last right one."""

    delta: int = 0
    is_crc_ok: bool = True
    is_new: bool = True


MISS = Event(is_new=False)
BAD = Event(delta=9, is_crc_ok=False)
REPEAT = Event(delta=0)
NEXT = Event(delta=1)


@dataclass
class StandardP02:
    """E2E_P02Check; the configuration comes first."""

    MaxDeltaCounterInit: int
    MaxNoNewOrRepeatedData: int
    SyncCounterInit: int
    WaitForFirstData: bool = True
    LastValidCounter: int = 0
    MaxDeltaCounter: int = 0
    NoNewOrRepeatedDataCounter: int = 0
    SyncCounter: int = 0
    Status: str = "NONEWDATA"

    def check(self, NewDataAvailable: bool, ReceivedCounter: int, is_crc_ok: bool) -> str:
        if self.MaxDeltaCounter < 15:
            self.MaxDeltaCounter = self.MaxDeltaCounter + 1
        if not NewDataAvailable:
            if self.NoNewOrRepeatedDataCounter < 15:
                self.NoNewOrRepeatedDataCounter = self.NoNewOrRepeatedDataCounter + 1
            self.Status = "NONEWDATA"
        elif not is_crc_ok:
            self.Status = "WRONGCRC"
        elif self.WaitForFirstData:
            self.WaitForFirstData = False
            self.MaxDeltaCounter = self.MaxDeltaCounterInit
            self.LastValidCounter = ReceivedCounter
            self.NoNewOrRepeatedDataCounter = 0  # not in the standard
            self.Status = "INITIAL"
        else:
            if ReceivedCounter >= self.LastValidCounter:
                DeltaCounter = ReceivedCounter - self.LastValidCounter
            else:
                DeltaCounter = 16 + ReceivedCounter - self.LastValidCounter
            if DeltaCounter == 0:
                if self.NoNewOrRepeatedDataCounter < 15:
                    self.NoNewOrRepeatedDataCounter = self.NoNewOrRepeatedDataCounter + 1
                self.Status = "REPEATED"
            elif DeltaCounter == 1:
                self.MaxDeltaCounter = self.MaxDeltaCounterInit
                self.LastValidCounter = ReceivedCounter
                if self.NoNewOrRepeatedDataCounter <= self.MaxNoNewOrRepeatedData:
                    self.NoNewOrRepeatedDataCounter = 0
                    if self.SyncCounter > 0:
                        self.SyncCounter = self.SyncCounter - 1
                        self.Status = "SYNC"
                    else:
                        self.Status = "OK"
                else:
                    self.NoNewOrRepeatedDataCounter = 0
                    self.SyncCounter = self.SyncCounterInit
                    self.Status = "SYNC"
            elif DeltaCounter > self.MaxDeltaCounter:
                self.NoNewOrRepeatedDataCounter = 0
                self.SyncCounter = self.SyncCounterInit
                if self.SyncCounter > 0:
                    self.MaxDeltaCounter = self.MaxDeltaCounterInit
                    self.LastValidCounter = ReceivedCounter
                self.Status = "WRONGSEQUENCE"
            else:
                self.MaxDeltaCounter = self.MaxDeltaCounterInit
                self.LastValidCounter = ReceivedCounter
                if self.NoNewOrRepeatedDataCounter <= self.MaxNoNewOrRepeatedData:
                    self.NoNewOrRepeatedDataCounter = 0
                    if self.SyncCounter > 0:
                        self.SyncCounter = self.SyncCounter - 1
                        self.Status = "SYNC"
                    else:
                        self.Status = "OKSOMELOST"
                else:
                    self.NoNewOrRepeatedDataCounter = 0
                    self.SyncCounter = self.SyncCounterInit
                    self.Status = "SYNC"
        return self.Status


@dataclass
class StandardP05:
    """E2E_P05Check; `Counter` is None where the standard expects the sender's very first frame."""

    MaxDeltaCounter: int
    Counter: int | None = None

    def check(self, NewDataAvailable: bool, ReceivedCounter: int, is_crc_ok: bool) -> str:
        if not NewDataAvailable:
            return "NONEWDATA"
        if not is_crc_ok:
            return "ERROR"
        if self.Counter is None:
            self.Counter = ReceivedCounter
            return "INITIAL"
        DeltaCounter = (ReceivedCounter - self.Counter) % 256
        self.Counter = ReceivedCounter
        if DeltaCounter > self.MaxDeltaCounter:
            return "WRONGSEQUENCE"
        if DeltaCounter == 0:
            return "REPEATED"
        if DeltaCounter == 1:
            return "OK"
        return "OKSOMELOST"


@dataclass
class SyncedP05:
    """E2E_P05Check and over it what E2E_P02Check does about SYNC."""

    standard: StandardP05
    MaxNoNewOrRepeatedData: int
    SyncCounterInit: int
    NoNewOrRepeatedDataCounter: int = 0
    SyncCounter: int = 0

    def check(self, NewDataAvailable: bool, ReceivedCounter: int, is_crc_ok: bool) -> str:
        status = self.standard.check(NewDataAvailable, ReceivedCounter, is_crc_ok)
        if status in {"NONEWDATA", "REPEATED"}:
            self.NoNewOrRepeatedDataCounter += 1
        elif status == "INITIAL":
            self.NoNewOrRepeatedDataCounter = 0
        elif status == "WRONGSEQUENCE":
            self.NoNewOrRepeatedDataCounter = 0
            self.SyncCounter = self.SyncCounterInit
        elif status in {"OK", "OKSOMELOST"}:
            if self.NoNewOrRepeatedDataCounter > self.MaxNoNewOrRepeatedData:
                self.SyncCounter = self.SyncCounterInit
                status = "SYNC"
            elif self.SyncCounter > 0:
                self.SyncCounter -= 1
                status = "SYNC"
            self.NoNewOrRepeatedDataCounter = 0
        return status


STATUS = {
    "INITIAL": E2eStatus.OK,
    "OK": E2eStatus.OK,
    "OKSOMELOST": E2eStatus.OK_SOME_LOST,
    "REPEATED": E2eStatus.REPEATED,
    "WRONGSEQUENCE": E2eStatus.WRONG_SEQUENCE,
    "WRONGCRC": E2eStatus.WRONG_CRC,
    "ERROR": E2eStatus.WRONG_CRC,
    "NONEWDATA": E2eStatus.NO_NEW_DATA,
    "SYNC": E2eStatus.SYNC,
}


def row_of_frames(sender: E2eSender, modulus: int) -> tuple[list[bytes], list[bytes]]:
    """Return the frame of each counter, and the same with a CRC that is wrong."""
    good = [sender.protect(bytearray(LENGTH)) for _ in range(modulus)]
    return good, [bytes([frame[0] ^ 0xFF]) + frame[1:] for frame in good]


@dataclass
class Bench:
    """One receiver beside its reference; both see the same events."""

    receiver: E2eReceiver
    reference: StandardP02 | StandardP05 | SyncedP05
    frames: tuple[list[bytes], list[bytes]]
    counter: int = 3
    found: list[tuple[E2eStatus, E2eStatus]] = field(default_factory=list)

    def feed(self, event: Event) -> None:
        good, bad = self.frames
        counter = (self.counter + event.delta) % len(good)
        if not event.is_new:
            status = self.receiver.miss()
        else:
            status = self.receiver.check((good if event.is_crc_ok else bad)[counter])
            if event.is_crc_ok:
                self.counter = counter
        self.found.append((status, STATUS[self.reference.check(event.is_new, counter, event.is_crc_ok)]))


P02_FRAMES = row_of_frames(E2eSender(P02, DATA_IDS), 16)
P05_FRAMES = row_of_frames(E2eSender(P05, DATA_ID), 256)


def p02(tolerance: Tolerance) -> Bench:
    reference = StandardP02(tolerance.max_delta, tolerance.max_missing, tolerance.sync_frames)
    return Bench(ProtectedReceiver(P02, DATA_IDS, LENGTH, tolerance), reference, P02_FRAMES)


def p05(tolerance: Tolerance) -> Bench:
    reference = SyncedP05(StandardP05(tolerance.max_delta), tolerance.max_missing, tolerance.sync_frames)
    return Bench(ProtectedReceiver(P05, DATA_ID, LENGTH, tolerance), reference, P05_FRAMES)


def p05_without_sync(tolerance: Tolerance) -> Bench:
    endless = Tolerance(tolerance.max_delta, max_missing=1_000_000, sync_frames=0)
    return Bench(ProtectedReceiver(P05, DATA_ID, LENGTH, endless), StandardP05(tolerance.max_delta), P05_FRAMES)


BEFORE = {
    "nothing yet": [],
    "OK": [NEXT, NEXT],
    "OK_SOME_LOST": [NEXT, Event(delta=2)],
    "REPEATED": [NEXT, REPEAT],
    "WRONG_SEQUENCE": [NEXT, Event(delta=8)],
    "WRONG_CRC": [NEXT, BAD],
    "NO_NEW_DATA": [NEXT, MISS],
    "SYNC": [NEXT, Event(delta=8), NEXT],
}
SILENCES = {"no frame": MISS, "repeated": REPEAT, "wrong CRC": BAD}
DELTAS = {16: list(range(16)), 256: [*range(18), 127, 128, 129, *range(240, 256)]}
AFTER = [NEXT, NEXT, Event(delta=2), NEXT]
TOLERANCES_2 = [PROFILE_2_TOLERANCE, Tolerance(1, 0, 0), Tolerance(3, 2, 3), Tolerance(1, 14, 2)]
TOLERANCES_5 = [PROFILE_5_TOLERANCE, Tolerance(1, 0, 0), Tolerance(3, 2, 3), Tolerance(9, 14, 2)]
ROWS = [
    *((p02, tolerance) for tolerance in TOLERANCES_2),
    *((p05, tolerance) for tolerance in TOLERANCES_5),
    *((p05_without_sync, tolerance) for tolerance in TOLERANCES_5[:2]),
]
ALL = pytest.mark.parametrize(
    ("make", "tolerance"),
    ROWS,
    ids=[f"{make.__name__}-{t.max_delta}-{t.max_missing}-{t.sync_frames}" for make, t in ROWS],
)


@pytest.mark.parametrize("before", BEFORE)
@ALL
def test_every_event_in_every_state_is_judged_as_the_standard_says(
    make: Callable[[Tolerance], Bench], tolerance: Tolerance, before: str
) -> None:
    statuses = set()
    for silence in SILENCES.values():
        for missed in (*range(7), *range(12, 18)):
            for delta in DELTAS[len(make(tolerance).frames[0])]:
                for is_crc_ok in (True, False):
                    bench = make(tolerance)
                    for event in (*BEFORE[before], *[silence] * missed, Event(delta, is_crc_ok), *AFTER):
                        bench.feed(event)
                    ours, theirs = zip(*bench.found, strict=True)
                    assert ours == theirs, f"{missed} times {silence}, then {delta}, CRC ok {is_crc_ok}"
                    statuses.update(ours)
    never = set()
    if make is p05_without_sync:
        never.add(E2eStatus.SYNC)
    if make is not p02 and tolerance.max_delta == 1:
        never.add(E2eStatus.OK_SOME_LOST)
    assert statuses == set(E2eStatus) - never


@ALL
def test_a_long_random_walk_is_judged_as_the_standard_says(
    make: Callable[[Tolerance], Bench], tolerance: Tolerance
) -> None:
    rng = random.Random(5)
    bench = make(tolerance)
    modulus = len(bench.frames[0])
    choices = [NEXT] * 6 + [MISS, REPEAT, BAD, Event(delta=2), Event(delta=4), Event(delta=-2 % modulus)]
    for _ in range(3000):
        kind = rng.choice(choices)
        for _ in range(rng.choice((1, 1, 1, 2, 6, 14))):
            bench.feed(kind)
    ours, theirs = zip(*bench.found, strict=True)
    assert ours == theirs
    assert sum(bench.receiver.counts) == len(ours)
    assert [count for _, count in bench.receiver.tally()] == [ours.count(status) for status in E2eStatus]
