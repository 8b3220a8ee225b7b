"""A log from front to back, piece by piece, in constant memory: for what is longer than memory, or has to be fast.

On two processors one reads, checks and decompresses ahead while the other gathers the messages; topics that weren't
asked for cost nothing but their decompression.
"""

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.bus_frames import FRAME_DTYPE, is_of_frames
from adacd_hil.log.reader import LoggedEvent, Series, events_of, open_log, own_topics, series_of
from adacd_hil.log.summary import DROPPED_KEY, LOST_KEY
from adacd_hil.log.topic_records import Topic


class Piece(NamedTuple):
    """A stretch of a log that ends with whole cycles: consecutive pieces have all of it, in order.

    The records of a cycle are those with one publish time, one after the other in the file. An event that happens
    between two cycles counts as one.
    """

    series: Mapping[str, Series]
    """Topics of fixed size that were asked for, but those of bus frames; our own ones are there even when empty."""
    frames: NDArray[Any]
    """(n,) of reader.FRAME_DTYPE, or LONG_FRAME_DTYPE in a piece with FD frames; both ways, in the order of the bus."""
    payloads: Mapping[str, list[bytes]]
    """Topics of varying size that were asked for, such as /events."""


class LogStream:
    """A log read once from front to back in constant memory, all parts as one.

    What is damaged or missing is left out; `problem` says so.
    """

    def __init__(self, path: str | Path, topics: Collection[str] | None = None, cycles_per_piece: int = 20_000) -> None:
        """Begin to read the log whose first part is `path`, of the messages only those of `topics` when given.

        A folder stands for the run's log in it. Raises LogError when nothing of it can be read.
        """
        self._walk, self.epoch_ns = open_log(path, topics)
        self._topics = topics
        self._cycles_per_piece = cycles_per_piece

    @property
    def metadata(self) -> dict[str, str]:
        """Of the run."""
        return self._walk.metadata

    @property
    def attachments(self) -> dict[str, bytes]:
        """What the run was made with, by file name."""
        return self._walk.attachments

    def empty(self) -> Piece:
        """Give a piece without messages, with our own topics."""
        return Piece(series_of({}, {}, self._own_topics(), self.epoch_ns), np.empty(0, FRAME_DTYPE), {})

    @property
    def problem(self) -> str:
        """What is missing, one line, as far as has been read; "" for a whole log."""
        return self._walk.problem

    @property
    def is_complete(self) -> bool:
        """Whether all that was read is whole, no packet was dropped, and nothing was lost before a recovery."""
        return not self.problem and self.summary.get(DROPPED_KEY, "0") == "0" and LOST_KEY not in self.summary

    @property
    def summary(self) -> dict[str, str]:
        """Frames, messages, dropped and ending, of the parts that have been read to their ends."""
        return self._walk.summary

    def events(self, piece: Piece) -> list[LoggedEvent]:
        """Unpack what a piece has of /events."""
        return events_of(piece.payloads, self._walk.topics, self.epoch_ns)

    @property
    def parts(self) -> int:
        """How many files have been read."""
        return self._walk.parts

    def _own_topics(self) -> dict[str, Topic]:
        """List those of our topics that pieces have series of."""
        own = own_topics(self.metadata)
        return {
            name: topic
            for name, topic in own.items()
            if not is_of_frames(topic) and (self._topics is None or name in self._topics)
        }

    def __iter__(self) -> Iterator[Piece]:
        own = self._own_topics()
        for piece in self._walk.pieces(self._cycles_per_piece, self.epoch_ns):
            topics = {name: topic for name, topic in self._walk.topics.items() if not is_of_frames(topic)}
            yield Piece(series_of(piece.records, topics, own, self.epoch_ns), piece.frames, piece.payloads)
