"""A damaged log made whole again from its trusted records: see salvage.py.

The result is one file, whatever the number of parts: definitions, attachments, metadata and messages as they were, and
an index, statistics and a summary made anew, whose `ending` says "recovered" and what was lost. The source stays as it
is, and nothing appears under the result's name before it is whole.
"""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from mcap.records import Attachment, Metadata

from adacd_hil.lab.logs.log_copy import LogCopy
from adacd_hil.log.log_files import (
    CONTINUED,
    DROPPED_KEY,
    ENDING_KEY,
    LOST_KEY,
    PART_KEY,
    RECOVERED,
    RUN_METADATA,
    SUMMARY_METADATA,
    LogError,
    part_path,
    parts_of,
    summary_count,
)
from adacd_hil.log.salvage import Losses, Salvage
from adacd_hil.log.types.record_arrays import count_frames


class LogRecovery(NamedTuple):
    """The result of `recover`."""

    path: Path
    out: Path
    messages: int
    attachments: int
    metadata: int
    losses: Losses
    missing_parts: tuple[str, ...]

    @property
    def is_lossy(self) -> bool:
        """Whether anything was lost, or may have been."""
        return self.losses.is_any or bool(self.missing_parts)

    @property
    def holes_s(self) -> float:
        """How long, all holes together, nothing was saved between what was."""
        return sum(hole.seconds for hole in self.losses.holes)

    def describe_loss(self) -> str:
        """Say in words what was lost; "" for nothing."""
        losses = self.losses
        messages = "an unknown number of messages" if losses.messages is None else f"{losses.messages} messages"
        words = (
            ("the end", losses.is_cut),
            (messages, losses.messages != 0),
            (f"{losses.chunks} chunks", losses.chunks),
            (f"{self.holes_s:.3f} s between what was saved", losses.holes),
            (f"{losses.attachments} attachments", losses.attachments),
            (f"{losses.metadata} metadata records", losses.metadata),
            (", ".join(self.missing_parts), self.missing_parts),
            ("metadata may be wrong", losses.is_doubtful),
        )
        return ", ".join(word for word, is_said in words if is_said) if self.is_lossy else ""


def default_out(path: Path) -> Path:
    """Name the result of recovering `path`."""
    return path.with_name(f"{path.stem}.{RECOVERED}{path.suffix}")


def recover(path: Path, out: Path | None = None, progress: Callable[[str], None] = lambda _: None) -> LogRecovery:
    """Save what can be trusted of the log whose first part is `path`, with all its parts, to `out`.

    Raises LogError when there is nothing, when a file can't be read, or when `out` is the log itself.
    """
    out = out or default_out(path)
    parts = parts_of(path)
    if out.exists() and any(part.exists() and out.samefile(part) for part in parts.values()):
        raise LogError(f"{out} is the log itself; --out names another file")
    with LogCopy(out, parts.values()) as copy:
        work = _Work(copy, path)
        for part in parts.values():
            progress(f"reading {part.name}")
            work.take(part)
        if not work.has_saved:
            raise LogError(f"{path}: nothing to save")
        return work.finish(parts)


class _Work:
    """The log in the making, part by part."""

    def __init__(self, copy: LogCopy, path: Path) -> None:
        self._copy = copy
        self._path = path
        self._source = copy.source()
        self._losses = Losses()
        self._attached: set[str] = set()
        self._metadata: dict[str, dict[str, str]] = {}
        self._is_vouched = False  # the metadata of the run
        self._dropped = 0
        self._ending = ""
        self._foreign: list[str] = []

    @property
    def has_saved(self) -> bool:
        """Whether there is anything in the log."""
        return bool(self._copy.file.messages or self._attached or self._metadata)

    def take(self, path: Path) -> None:
        """Take a part, unless it belongs to another run."""
        salvage = Salvage(path)
        self._ending = ""
        for item in salvage:
            if isinstance(item, Attachment):
                if item.name not in self._attached:
                    self._attached.add(item.name)
                    self._copy.attach(item)
            elif isinstance(item, Metadata):
                if item.name == RUN_METADATA and self._is_foreign(item.metadata, salvage.is_vouched):
                    self._foreign.append(f"{path.name} (of another run)")
                    return
                self._take_metadata(item, salvage.is_vouched)
            else:
                self._source.define(salvage.definitions.channels, salvage.definitions.schemas)
                self._copy.add(self._source.take(item))
        self._source.define(salvage.definitions.channels, salvage.definitions.schemas)
        self._losses.add(salvage.losses)

    def _is_foreign(self, metadata: dict[str, str], is_vouched: bool) -> bool:
        """Say whether a part is of another run: one damaged entry doesn't make it so."""
        mine, theirs = (
            {pair for pair in table.items() if pair[0] != PART_KEY}
            for table in (self._metadata.get(RUN_METADATA, metadata), metadata)
        )
        return mine != theirs and ((self._is_vouched and is_vouched) or len(mine - theirs) > 1)

    def _take_metadata(self, item: Metadata, is_vouched: bool) -> None:
        if item.name == SUMMARY_METADATA:
            self._dropped += summary_count(item.metadata, DROPPED_KEY)
            self._ending = item.metadata.get(ENDING_KEY, "")
        elif item.name not in self._metadata:
            self._metadata[item.name] = item.metadata
            self._is_vouched |= is_vouched and item.name == RUN_METADATA
            self._copy.add_all_metadata({item.name: item.metadata})

    def finish(self, parts: dict[int, Path]) -> LogRecovery:
        """End the log."""
        file = self._copy.file
        missing = [
            part_path(self._path, gap) for before, after in pairwise((-1, *parts)) for gap in range(before + 1, after)
        ]
        if self._ending == CONTINUED:
            missing.append(part_path(self._path, max(parts) + 1))
        recovery = LogRecovery(
            self._path,
            self._copy.path,
            file.messages,
            len(self._attached),
            len(self._metadata),
            self._losses,
            (*(part.name for part in missing), *self._foreign),
        )
        self._copy.finish(self._summary(recovery))
        return recovery

    def _summary(self, recovery: LogRecovery) -> dict[str, str]:
        file = self._copy.file
        file.flush()
        losses = recovery.losses
        summary = {
            "frames": str(count_frames(self._source.topics, file.counts)),
            "messages": str(file.messages),
            DROPPED_KEY: str(self._dropped),
            ENDING_KEY: RECOVERED,
            "source": self._path.name,
            "source_ending": self._ending,
        }
        if losses.unvouched:
            summary["unvouched_messages"] = str(losses.unvouched)
        if recovery.is_lossy:
            summary |= {
                LOST_KEY: recovery.describe_loss(),
                "lost_chunks": str(losses.chunks),
                "lost_messages": "unknown" if losses.messages is None else str(losses.messages),
                "lost_bytes": str(losses.bytes),
                "holes_s": f"{recovery.holes_s:.3f}",
            }
        return summary
