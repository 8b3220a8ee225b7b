"""Logs made of sound logs: a stretch of one, or several in one. At the first damage both commands say so and stop.

Cut: `cut` takes whole cycles from our own logs, by their publish_time; from others it takes messages, by their
log_time. Times count from the first of them in the log.

Merge: several logs by log_time, of several hosts, or of a run and the emulator beside it. Each log keeps the order of
its own messages, with all its parts; a message comes as soon as no other log has an earlier one. Each log has channels
of its own, so that the channel, or a prefix, distinguishes a topic that two logs have. The run's metadata of the first
log stay `run`; those of the others become `run:NAME`, and an attachment that differs from one of the same name becomes
`NAME/attachment`.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata
from numpy.typing import NDArray

from adacd_hil.file_access import open_input
from adacd_hil.lab.logs.log_copy import CopySource, LogCopy, Messages
from adacd_hil.log.log_files import (
    CUT,
    DROPPED_KEY,
    ENDING_KEY,
    MERGED,
    PART_KEY,
    RUN_METADATA,
    SUMMARY_METADATA,
    LogError,
    TimeWindow,
    failing_as,
    find_parts,
    part_path,
    parts_of,
    summary_count,
)
from adacd_hil.log.mcap.chunks import ChunkError, Contents, Opening, message_contents, read_contents
from adacd_hil.log.mcap.mcap_records import (
    MAGIC,
    Definitions,
    FileGap,
    RawRecord,
    attachment_crc_fits,
    crc_of,
    parse,
    read_end,
    scan,
)
from adacd_hil.log.reader import LoggedContact, read_log
from adacd_hil.log.types.record_arrays import count_frames


class IntactLog:
    """Iterate for attachments and chunks; metadata and definitions fill up on the way.

    Iterating raises LogError at damage, at a missing part, and when a file can't be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.definitions = Definitions()
        self.metadata: dict[str, dict[str, str]] = {}
        """By name, the first of each name; `run` without the number of its part; without `summary`."""
        self._opening = Opening()
        self.dropped = 0
        """Packets that the parts say are not in them."""

    def __iter__(self) -> Iterator[Attachment | Contents]:
        parts = parts_of(self.path)
        for before, after in pairwise((-1, *parts)):
            if after != before + 1:
                raise LogError(f"{part_path(self.path, before + 1)} is missing: recover the log first")
        attached = set()
        for part in parts.values():
            for item in self._read(part):
                if isinstance(item, Attachment):
                    if item.name in attached:
                        continue
                    attached.add(item.name)
                yield item

    def _read(self, path: Path) -> Iterator[Attachment | Contents]:
        with failing_as(f"log {path} can't be read"), open_input(path) as file:
            _check_ends(path, file)
            for item in scan(file):
                if isinstance(item, FileGap):
                    raise _damaged(path, item.offset)
                if isinstance(item, RawRecord):
                    yield from self._take(path, item)

    def _take(self, path: Path, record: RawRecord) -> Iterator[Attachment | Contents]:
        """Give what is in a record of the data section; the summary only repeats it."""
        opcode, body = record.opcode, record.body
        if opcode == Opcode.CHUNK:
            yield self._open(path, record.offset, body)
        elif opcode == Opcode.MESSAGE:
            yield message_contents(record)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.definitions.take((record,))
        elif opcode == Opcode.ATTACHMENT:
            if not attachment_crc_fits(record):
                raise _damaged(path, record.offset)
            yield parse(opcode, body)
        elif opcode == Opcode.METADATA:
            self._take_metadata(parse(opcode, body))

    def _open(self, path: Path, offset: int, body: bytes) -> Contents:
        try:
            contents = read_contents(self._opening.open_checked(parse(Opcode.CHUNK, body)))
        except ChunkError:
            raise _damaged(path, offset) from None
        self.definitions.take(contents.definitions)
        return contents

    def _take_metadata(self, item: Metadata) -> None:
        if item.name == SUMMARY_METADATA:
            self.dropped += summary_count(item.metadata, DROPPED_KEY)
            return
        table = dict(item.metadata)
        if item.name == RUN_METADATA:
            table.pop(PART_KEY, None)
            if self.metadata.get(RUN_METADATA, table) != table:
                raise LogError(f"{self.path}: its parts are of different runs")
        self.metadata.setdefault(item.name, table)


def _check_ends(path: Path, file: IO[bytes]) -> None:
    """Raise LogError when a file has no beginning or no end, or when the data section fails its CRC."""
    if file.read(len(MAGIC)) != MAGIC:
        raise LogError(f"{path} is not an MCAP file")
    end = read_end(file)
    if end is None:
        raise LogError(f"{path} is cut, it has no end: recover it first")
    if end.data_crc and end.data_crc != crc_of(file, 0, end.data_end):
        raise LogError(f"{path} is damaged, it fails its CRC: recover it first")


def _damaged(path: Path, offset: int) -> LogError:
    return LogError(f"{path} is damaged at byte {offset}: recover it first")


class Cut(NamedTuple):
    """The result of `cut`."""

    path: Path
    out: Path
    stretch: TimeWindow
    messages: int


def default_out(path: Path) -> Path:
    """Name the result of cutting `path`."""
    return path.with_name(f"{path.stem}.{CUT}{path.suffix}")


def find_contact(path: Path, contact: int, around_s: float) -> TimeWindow:
    """Return the stretch around the contact of this number, from 1, of a log. Raises LogError."""
    log = read_log(path, ("/contact",))
    begun = contacts_begun(log.contacts)
    if not 1 <= contact <= len(begun):
        raise LogError(f"log {path} has {len(begun)} contacts: there is no contact {contact}")
    at_s = (begun[contact - 1].t_ns + log.epoch_ns - _start_ns(path)) * 1e-9
    return TimeWindow(at_s - around_s, at_s + around_s)


def contacts_begun(contacts: Iterable[LoggedContact]) -> list[LoggedContact]:
    """Take the first report of each contact: all reports of one name the cycle in which it began."""
    begun: dict[int, LoggedContact] = {}
    for contact in contacts:
        begun.setdefault(contact.report.cycle, contact)
    return list(begun.values())


def _start_ns(path: Path) -> int:
    """Return the time of the first message."""
    log = IntactLog(path)
    contents = (item for item in log if not isinstance(item, Attachment) and len(item.starts))
    return int(_times(next(contents), is_ours=RUN_METADATA in log.metadata)[0])


def cut(
    path: Path,
    out: Path,
    stretch: TimeWindow,
    topics: Collection[str] = (),
    progress: Callable[[str], None] = lambda _: None,
) -> Cut:
    """Cut a stretch out of the log whose first part is `path`, of all topics or of `topics`.

    Raises LogError when the log is damaged, when nothing is in the stretch, or when `out` is the log itself.
    """
    if out.exists() and path.exists() and out.samefile(path):
        raise LogError(f"{out} is the log itself; --out names another file")
    log = IntactLog(path)
    with LogCopy(out, [path]) as copy:
        source = copy.source(topics=frozenset(topics) or None)
        start_ns: int | None = None
        progress(f"reading {path.name}")
        for item in log:
            if isinstance(item, Attachment):
                copy.attach(item)
                continue
            copy.add_all_metadata(log.metadata)
            source.define(log.definitions.channels, log.definitions.schemas)
            times = _times(item, is_ours=RUN_METADATA in log.metadata)
            if start_ns is None and len(times):
                start_ns = int(times[0])
            copy.add(source.take(item, _is_within(times, start_ns or 0, stretch)))
        copy.add_all_metadata(log.metadata)
        source.define(log.definitions.channels, log.definitions.schemas)
        known = {channel.topic for channel in log.definitions.channels.values()}
        if unknown := sorted(set(topics) - known):
            raise LogError(f"log {path} has no topic {', '.join(unknown)}; it has {', '.join(sorted(known))}")
        if not copy.file.messages:
            raise LogError(f"log {path} has no message from {stretch.start_s:g} to {stretch.end_s:g} s")
        copy.file.flush()
        summary = {
            "frames": str(count_frames(source.topics, copy.file.counts)),
            "messages": str(copy.file.messages),
            DROPPED_KEY: str(log.dropped),
            ENDING_KEY: CUT,
            "source": path.name,
            "from_s": f"{stretch.start_s:.9g}",
            "until_s": f"{stretch.end_s:.9g}",
        }
        messages = copy.file.messages
        copy.finish(summary)
    return Cut(path, out, stretch, messages)


def _times(contents: Contents, is_ours: bool) -> NDArray[np.int64]:
    return (contents.publish_times if is_ours else contents.log_times).astype(np.int64)


def _is_within(times: NDArray[np.int64], start_ns: int, stretch: TimeWindow) -> NDArray[np.bool_]:
    first_ns, end_ns = stretch.bounds_ns(start_ns)
    return np.asarray((times >= first_ns) & (times < end_ns))


class Merge(NamedTuple):
    """The result of `merge`. `shared`: topics that more than one log has."""

    out: Path
    names: tuple[str, ...]
    messages: int
    shared: tuple[str, ...]


def log_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """Name logs by their files, and by their folders where the files have one name."""
    names = tuple(path.stem for path in paths)
    if len(set(names)) < len(names):
        names = tuple(f"{path.absolute().parent.name}_{path.stem}" for path in paths)
    if len(set(names)) < len(names):
        names = tuple(f"{name}_{number}" for number, name in enumerate(names, start=1))
    return names


def merge(
    paths: Sequence[Path], out: Path, has_prefix: bool = False, progress: Callable[[str], None] = lambda _: None
) -> Merge:
    """Merge logs, each with all its parts, into `out`; with a prefix each topic begins with its log's name.

    Raises OSError, LogError when a log is damaged or when `out` is one of them.
    """
    later = {part for path in paths for number, part in find_parts(path).items() if number}
    paths = [path for path in paths if path not in later]
    if any(out.exists() and path.exists() and out.samefile(path) for path in paths):
        raise LogError(f"{out} is one of the logs; --out names another file")
    names = log_names(paths)
    with LogCopy(out, paths) as copy:
        attached: dict[str, bytes] = {}
        logs = [
            _Log(copy, path, name, f"/{name}" if has_prefix else "", number == 0, attached)
            for number, (path, name) in enumerate(zip(paths, names, strict=True))
        ]
        progress(f"merging {', '.join(names)}")
        _merge(logs, copy)
        copy.file.flush()
        counts = copy.file.counts
        all_topics = [{topic for number, topic in log.source.topics.items() if counts.get(number)} for log in logs]
        shared = {topic for topics in all_topics for topic in topics if sum(topic in other for other in all_topics) > 1}
        topics = {number: topic for log in logs for number, topic in log.source.topics.items()}
        summary = {
            "frames": "0" if has_prefix else str(count_frames(topics, counts)),
            "messages": str(copy.file.messages),
            DROPPED_KEY: str(sum(log.dropped for log in logs)),
            ENDING_KEY: MERGED,
            "sources": " ".join(names),
        }
        messages = copy.file.messages
        copy.finish(summary)
    return Merge(out, names, messages, tuple(sorted(shared)))


class _Log:
    """One of the logs, as blocks of messages with keys: the latest log time so far, which never runs backwards."""

    def __init__(
        self, copy: LogCopy, path: Path, name: str, prefix: str, is_first: bool, attached: dict[str, bytes]
    ) -> None:
        self.source: CopySource = copy.source(prefix)
        self._copy = copy
        self._log = IntactLog(path)
        self._name = name
        self._is_first = is_first
        self._attached = attached
        self._latest_ns = 0
        self._blocks = self._read()
        self.messages: Messages | None = None
        self.keys: NDArray[np.int64] = np.empty(0, np.int64)
        self.advance()

    @property
    def dropped(self) -> int:
        """Packets that the log says are not in it."""
        return self._log.dropped

    def advance(self) -> None:
        """Go on to the next block."""
        self.messages = next(self._blocks, None)
        if self.messages is not None:
            self.keys = np.maximum(np.maximum.accumulate(self.messages.log_times), self._latest_ns)
            self._latest_ns = int(self.keys[-1])

    def drop(self, count: int) -> None:
        """Leave the first messages of the block behind."""
        if self.messages is None or count == len(self.keys):
            self.advance()
            return
        self.messages = self.messages.select(np.arange(count, len(self.keys)))
        self.keys = self.keys[count:]

    def _read(self) -> Iterator[Messages]:
        for item in self._log:
            if isinstance(item, Attachment):
                self._attach(item)
                continue
            messages = self._take(item)
            if len(messages.ends):
                yield messages
        self._define()

    def _take(self, contents: Contents) -> Messages:
        self._define()
        return self.source.take(contents)

    def _define(self) -> None:
        is_own = {RUN_METADATA: RUN_METADATA if self._is_first else f"{RUN_METADATA}:{self._name}"}
        self._copy.add_all_metadata({is_own.get(name, name): table for name, table in self._log.metadata.items()})
        self.source.define(self._log.definitions.channels, self._log.definitions.schemas)

    def _attach(self, attachment: Attachment) -> None:
        if self._attached.get(attachment.name) == attachment.data:
            return
        if attachment.name in self._attached:
            attachment.name = f"{self._name}/{attachment.name}"
        self._attached[attachment.name] = attachment.data
        self._copy.attach(attachment)


def _merge(logs: Sequence[_Log], copy: LogCopy) -> None:
    """Add the messages of all logs in the order of their keys."""
    while rest := [log for log in logs if log.messages is not None]:
        bound = min(int(log.keys[-1]) for log in rest)
        counts = [int(np.searchsorted(log.keys, bound, side="right")) for log in rest]
        keys = np.concatenate([log.keys[:count] for log, count in zip(rest, counts, strict=True)])
        blocks = [
            log.messages.select(np.arange(count))
            for log, count in zip(rest, counts, strict=True)
            if log.messages is not None
        ]
        copy.add(_join(blocks).select(np.argsort(keys, kind="stable")))
        for log, count in zip(rest, counts, strict=True):
            log.drop(count)


def _join(blocks: Sequence[Messages]) -> Messages:
    """Put blocks one after the other."""
    sizes = np.cumsum([0, *(len(block.records) for block in blocks)])
    return Messages(
        np.concatenate([block.records for block in blocks]),
        np.concatenate([block.channels for block in blocks]),
        np.concatenate([block.log_times for block in blocks]),
        np.concatenate([block.ends + size for block, size in zip(blocks, sizes.tolist(), strict=False)]),
    )
