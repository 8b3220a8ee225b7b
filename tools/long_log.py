"""Makes a log of any length from a short one: repeats the run, with stamps and cycles that go on.

    python tools/long_log.py runs/demo --hours 8 --out runs/long
    python tools/long_log.py runs/demo --hours 8 --out runs/long --loop 32 38

Without --loop the whole run is repeated, so that each repetition is another attempt with adaptation, contacts and
payload change. It begins a whole number of rounds of SYNC's counter later, so a replay comes to the same as the log.
With --loop FROM UNTIL the run goes up to UNTIL, s since the beginning of the log, and what lies between the two is
repeated: a long stay in one state. The stretch has to be a multiple of 6 s, so that seconds and counters fit; where it
is joined the arm jumps, so there is nothing to replay.

Logs of both sides are made: run.mcap, and truth.mcap where there is one, in parts as a run writes them.
"""

import argparse
import os
import sys
from collections import Counter
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from mcap.records import Attachment

from adacd_hil.lab.logs.salvaged_log import SalvagedLog
from adacd_hil.log.log_files import (
    CLOSED,
    CONTINUED,
    ENDING_KEY,
    FIELDS_KEY,
    LOG_NAME,
    PART_KEY,
    RUN_METADATA,
    TRUTH_NAME,
    LogError,
    part_path,
)
from adacd_hil.log.log_parts import DROPPED_KEY
from adacd_hil.log.mcap.chunks import Contents
from adacd_hil.log.mcap.record_layout import MESSAGE_HEAD
from adacd_hil.log.recording.log_file import McapFile, Sink
from adacd_hil.log.types.message_types import MessageType
from adacd_hil.log.types.record_arrays import FRAME_TOPICS
from adacd_hil.log.types.topics import LogChannel

SECOND_NS: Final = 1_000_000_000
ROUND_S: Final = 6
"""Whole seconds and whole rounds of SYNC's counter, 240 cycles, at any period that divides 25 ms."""
PART_BYTES: Final = 512 << 20
PART_S: Final = 1800.0
LOG_TIME, PUBLISH_TIME, STAMP = 15, 23, 35
"""Where a message record has its times."""
LOGS: Final = (LOG_NAME, TRUTH_NAME)


class Block(NamedTuple):
    """Message records that follow each other (size,). Columns (n,): where each begins, its channel and its cycle.

    cycles: where the number of its cycle is among the bytes, of those that have one.
    """

    records: np.ndarray
    starts: np.ndarray
    channels: np.ndarray
    cycles: np.ndarray

    def times_ns(self) -> np.ndarray:
        """Return when the cycle of each message was."""
        return words_of(self.records)[self.starts + PUBLISH_TIME]

    def only(self, chosen: np.ndarray) -> "Block":
        """Return some of the messages."""
        ends = np.append(self.starts[1:], len(self.records))
        lengths = (ends - self.starts)[chosen]
        starts = np.cumsum(lengths) - lengths
        moved = np.repeat(self.starts[chosen] - starts, lengths)
        places = np.arange(lengths.sum()) + moved
        of_message = np.searchsorted(self.starts, self.cycles, side="right") - 1
        is_kept = np.isin(of_message, np.flatnonzero(chosen))
        new = np.searchsorted(np.flatnonzero(chosen), of_message[is_kept])
        cycles = self.cycles[is_kept] - self.starts[of_message[is_kept]] + starts[new]
        return Block(self.records[places], starts, self.channels[chosen], cycles)


def words_of(records: np.ndarray) -> np.ndarray:
    """Return the 8 bytes that begin at each byte, as one number."""
    words: np.ndarray = np.ndarray((len(records) - 7,), np.int64, records, strides=(1,))
    return words


class LongLog:
    """A log that is repeated."""

    def __init__(self, path: Path) -> None:
        """Read the log. Raises LogError when it is damaged."""
        self.blocks: list[Block] = []
        self.attachments: dict[str, bytes] = {}
        self.first_cycle_at: dict[int, int] = {}
        """By channel, where a record has the number of its attempt's first cycle."""
        log = SalvagedLog(path)
        for item in log:
            if isinstance(item, Attachment):
                self.attachments[item.name] = item.data
                continue
            types = {
                number: MessageType(
                    log.definitions.schemas[channel.schema_id].name,
                    log.definitions.schemas[channel.schema_id].data.decode(),
                    tuple(channel.metadata.get(FIELDS_KEY, "").split()),
                )
                for number, channel in log.definitions.channels.items()
            }
            self._add(item, types)
        if lost := log.losses.describe():
            raise LogError(f"{path} lacks {lost}")
        self.channels = [
            LogChannel(number, channel.topic, types[number])
            for number, channel in sorted(log.definitions.channels.items())
        ]
        self.metadata = log.metadata[RUN_METADATA]
        times_ns = np.concatenate([block.times_ns() for block in self.blocks])
        self.start_ns = int(times_ns[0])
        self.lasts_ns = int(times_ns.max()) - self.start_ns
        self.cycle_ns = self._cycle_ns()

    def _add(self, item: Contents, types: dict[int, MessageType]) -> None:
        records = np.frombuffer(item.data, np.uint8)
        cycles = np.full(len(item.starts), -1)
        for number in np.unique(item.channels).tolist():
            fields = fields_of(types[number])
            if "cycle" in fields:
                mine = item.channels == number
                cycles[mine] = item.starts[mine] + MESSAGE_HEAD + fields["cycle"]
            if "first_cycle" in fields:
                self.first_cycle_at[number] = MESSAGE_HEAD + fields["first_cycle"]
        block = Block(records, item.starts, item.channels, cycles[cycles >= 0])
        if len(item.starts):
            self.blocks.append(block.only(np.ones(len(item.starts), np.bool_)))

    def _cycle_ns(self) -> int:
        """Tell the period from the first and the last cycle, which lie so many periods apart."""
        found = []
        for block in (self.blocks[0], self.blocks[-1]):
            place = int(block.cycles[-1])
            message = int(np.searchsorted(block.starts, place, side="right")) - 1
            found.append((int(words_of(block.records)[place]), int(block.times_ns()[message])))
        (first, first_ns), (last, last_ns) = found
        return round((last_ns - first_ns) / (last - first) / 1e3) * 1000

    def between(self, from_ns: int, until_ns: int) -> list[Block]:
        """Return the messages between two times since the beginning."""
        found = []
        for block in self.blocks:
            since_ns = block.times_ns() - self.start_ns
            chosen = (since_ns >= from_ns) & (since_ns < until_ns)
            if chosen.any():
                found.append(block if chosen.all() else block.only(chosen))
        return found


def fields_of(message_type: MessageType) -> dict[str, int]:
    """Return where the fields of a message are; none of one whose size varies."""
    try:
        dtype = message_type.dtype
    except LogError:
        return {}
    return {name: int(field[1]) for name, field in (dtype.fields or {}).items()}


class Writer:
    """Writes the long log, in parts."""

    def __init__(self, path: Path, log: LongLog) -> None:
        self._path = path
        self._log = log
        self._number = 0
        self._frames = self._messages = 0
        self._file = self._begin()

    def _begin(self) -> McapFile:
        part = part_path(self._path, self._number)
        self._sink = Sink(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644))
        self._part_ns: int | None = None
        self._counts: Counter[int] = Counter()
        # Nobody knows when a script would have asked for what in the repetitions: replay takes the requests as given.
        metadata = {**self._log.metadata, "operator": "repeated", PART_KEY: str(self._number)}
        return McapFile(self._sink, tuple(self._log.channels), self._log.attachments, metadata)

    def _end(self, ending: str) -> None:
        self._file.flush()
        topics = {channel.id: channel.topic for channel in self._log.channels}
        frames = sum(count for number, count in self._counts.items() if topics.get(number) in FRAME_TOPICS)
        self._file.finish(
            {ENDING_KEY: ending, DROPPED_KEY: "0", "frames": str(frames), "messages": str(self._file.messages)}
        )
        self._sink.close_file()

    def add(self, block: Block, later_ns: int, has_cycles: bool, is_attempt: bool = False) -> None:
        """Write messages so much later; has_cycles: the numbers of their cycles grow with it.

        is_attempt: of another attempt, whose first cycle is later, too.
        """
        records = block.records.copy()
        words = words_of(records)
        for place in (LOG_TIME, PUBLISH_TIME):
            words[block.starts + place] += later_ns
        words[block.starts + STAMP] += later_ns // SECOND_NS  # the lower half are the seconds
        if has_cycles:
            words[block.cycles] += later_ns // self._log.cycle_ns
        if is_attempt:
            for number, place in self._log.first_cycle_at.items():
                words[block.starts[block.channels == number] + place] += later_ns // self._log.cycle_ns
        times_ns = words[block.starts + LOG_TIME]
        columns = (
            block.starts,
            np.append(block.starts[1:], len(records)),
            block.channels,
            times_ns,
            words[block.starts + PUBLISH_TIME],
        )
        data = records.tobytes()
        self._counts.update(block.channels.tolist())
        for start, end, channel, log_ns, publish_ns in zip(*(column.tolist() for column in columns), strict=True):
            self._file.add_message(self._file.ids[channel], log_ns, data[start + MESSAGE_HEAD : end], publish_ns)
            self._file.end_packet()
        self._part_ns = int(times_ns[0]) if self._part_ns is None else self._part_ns
        is_long = int(times_ns[-1]) - self._part_ns >= PART_S * SECOND_NS
        if is_long or self._file.record_bytes >= PART_BYTES:
            self._end(CONTINUED)
            self._number += 1
            self._file = self._begin()

    def close(self) -> None:
        """End the log."""
        self._end(CLOSED)


def write(log: LongLog, path: Path, seconds: float, loop_s: tuple[float, float] | None, is_truth: bool) -> None:
    """Write a log of about that length. Raises ValueError when the loop is not one."""
    writer = Writer(path, log)
    if loop_s is None:
        round_ns = -(-(log.lasts_ns + 1) // (ROUND_S * SECOND_NS)) * ROUND_S * SECOND_NS
        for repetition in range(max(1, round(seconds * SECOND_NS / round_ns))):
            for block in log.blocks:
                # The emulator counts anew in each attempt.
                writer.add(block, repetition * round_ns, has_cycles=not is_truth, is_attempt=True)
    else:
        from_ns, until_ns = (round(bound_s * SECOND_NS) for bound_s in loop_s)
        for block in log.between(-1, until_ns):
            writer.add(block, 0, has_cycles=True)
        repeated = log.between(from_ns, until_ns)
        for later_ns in range(until_ns - from_ns, round(seconds * SECOND_NS) - until_ns, until_ns - from_ns):
            for block in repeated:
                writer.add(block, later_ns, has_cycles=True)
    writer.close()


def main() -> int:
    """Make the logs that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of the run to repeat")
    parser.add_argument("--hours", type=float, default=8.0, help="length; default: 8; 0.9 MB per second")
    parser.add_argument("--out", type=Path, required=True, help="folder for the logs, which must not be there yet")
    parser.add_argument("--loop", type=float, nargs=2, metavar=("FROM", "UNTIL"), help="repeat this stretch, s")
    chosen = parser.parse_args()
    if chosen.loop is not None and not (chosen.loop[1] - chosen.loop[0] > 0 == (chosen.loop[1] - chosen.loop[0]) % 6):
        parser.error(f"--loop {chosen.loop[0]:g} {chosen.loop[1]:g} is not a multiple of {ROUND_S} s")
    chosen.out.mkdir(parents=True, exist_ok=True)
    for name in LOGS:
        if (chosen.run / name).exists():
            write(LongLog(chosen.run / name), chosen.out / name, chosen.hours * 3600.0, chosen.loop, name == LOGS[1])
            print(chosen.out / name, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
