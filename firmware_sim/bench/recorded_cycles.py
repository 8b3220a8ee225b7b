"""The devices' answers to each SYNC of a recording, read as they are asked for.

An attempt begins with the first SYNC after an NMT reset, so a run that recovered from a fault has several. In each the
cycles count from its first SYNC by the SYNC counter, as the bench counts them; SYNCs that were lost leave a gap.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from adacd_hil.log.formats.frame_log import open_frames
from adacd_hil.wire.codec import Codec
from firmware_sim.canopen.contracts import answers_to_sync

RESETS: Final = (129, 130)
"""NMT commands that begin an attempt: reset node, reset communication."""
_SYNC_COUNTERS = 240
Answer = tuple[int, bytes]
"""Identifier and data."""


class RecordedCycle(NamedTuple):
    """What followed one SYNC."""

    attempt: int
    cycle: int
    answers: tuple[Answer, ...]


class RecordedCycles:
    """The cycles of a recording, forwards."""

    def __init__(self, path: Path, codec: Codec) -> None:
        """Open the recording. Raises LogError, CodecError."""
        self.attempt = -1
        """Number of the attempt in progress, -1 before the first."""
        self.answered = 0
        """Cycles so far that had an answer."""
        self.is_over = False
        """Whether the recording has no more."""
        self._answer_ids = answers_to_sync(codec)
        self._sync_id, self._nmt_id = (codec.message(name).can_id for name in ("Sync", "Nmt"))
        self._source = open_frames(path)
        self._cycles = self._read()
        self._next = self._fetch()

    @property
    def problem(self) -> str:
        """What is missing of the recording, one line."""
        return self._source.problem

    def begin(self) -> None:
        """Begin the next attempt."""
        self.attempt += 1

    def take(self, cycle: int) -> tuple[Answer, ...]:
        """Return the answers to a cycle of the attempt, nothing where the recording has none. Raises LogError."""
        wanted = (self.attempt, cycle)
        while self._next is not None and (self._next.attempt, self._next.cycle) < wanted:
            self._next = self._fetch()
        if self._next is None or (self._next.attempt, self._next.cycle) != wanted:
            return ()
        answers = self._next.answers
        self._next = self._fetch()
        self.answered += bool(answers)
        return answers

    def _fetch(self) -> RecordedCycle | None:
        found = next(self._cycles, None)
        self.is_over = found is None
        return found

    def _read(self) -> Iterator[RecordedCycle]:
        answers: list[Answer] = []
        attempt, cycle, counter = -1, 0, 0
        is_reset = True
        for can_id, data in self._frames():
            if can_id == self._nmt_id:
                is_reset = is_reset or data[:1] in (bytes([command]) for command in RESETS)
            elif can_id != self._sync_id:
                answers.append((can_id, data))
            else:
                if attempt >= 0:
                    yield RecordedCycle(attempt, cycle, tuple(answers))
                answers = []
                now = data[0] if data else 0
                if is_reset:
                    attempt, cycle, is_reset = attempt + 1, 0, False
                else:
                    cycle += (now - counter) % _SYNC_COUNTERS if now and counter else 1
                counter = now
        if attempt >= 0:
            yield RecordedCycle(attempt, cycle, tuple(answers))

    def _frames(self) -> Iterator[Answer]:
        """Give SYNC, NMT and the answers, in the order of the bus."""
        wanted = [self._sync_id, self._nmt_id, *self._answer_ids]
        for frames in self._source:
            is_data = ~frames["is_error"] & ~frames["is_remote"] & ~frames["is_extended"]
            chosen = frames[is_data & np.isin(frames["can_id"], wanted)]
            for can_id, length, data in zip(
                chosen["can_id"].tolist(), chosen["length"].tolist(), chosen["data"], strict=True
            ):
                yield can_id, data[:length].tobytes()
