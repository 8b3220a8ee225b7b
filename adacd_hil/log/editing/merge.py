"""Several logs as one, by log_time: of several hosts, or of a run and the emulator beside it.

Each log keeps the order of its own messages, with all its parts; a message comes as soon as no other log has an
earlier one. Each has channels of its own, so that a topic that two logs have is told apart by its channel, or by a
prefix. What the first log says of its run stays `run`; that of the others is `run:NAME`, and an attachment that differs
from one of the same name is `NAME/attachment`.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.records import Attachment
from numpy.typing import NDArray

from adacd_hil.log.editing.intact import IntactLog
from adacd_hil.log.editing.log_copy import LogCopy, Messages, Source
from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap.chunk_contents import Contents
from adacd_hil.log.mcap_file import ENDING_KEY, RUN_METADATA
from adacd_hil.log.parts import find_parts
from adacd_hil.log.summary import DROPPED_KEY, MERGED, count_frames


class Merge(NamedTuple):
    """What `merge` did. `shared`: topics that more than one log has."""

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
        self.source: Source = copy.source(prefix)
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
