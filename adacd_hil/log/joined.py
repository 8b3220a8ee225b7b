"""A walk over all parts of a log, as if they were one file; a part that is missing or damaged costs only itself."""

from collections.abc import Collection
from itertools import pairwise
from pathlib import Path

from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap_file import CONTINUED, ENDING_KEY, PART_KEY, RUN_METADATA, SUMMARY_METADATA
from adacd_hil.log.mcap_walk import PayloadLayout, Topic, Walk
from adacd_hil.log.parts import find_parts, part_path

_COUNTS = {"frames", "messages", "dropped"}


class JoinedWalk:
    """What a log holds. `problem` says in one line what is missing, "" for a whole log."""

    def __init__(self, path: Path, layout: PayloadLayout, topics: Collection[str] | None = None) -> None:
        """Read the log whose first part is `path`, of the messages only those of `topics` when given.

        Raises LogError when nothing of it can be read.
        """
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, str] = {}
        self.summary: dict[str, str] = {}
        self.topics: dict[str, Topic] = {}
        self.parts = 0
        self._bytes_before = 0
        self._joined = -1  # the latest part
        self._problems: list[str] = []
        parts = _parts_of(path)
        first_error: LogError | None = None
        for before, number in pairwise((-1, *parts)):
            self._note_missing(path, before + 1, number)
            try:
                walk = Walk(parts[number], layout, topics)
            except LogError as error:
                first_error = first_error or error
                self._problems.append(str(error))
                continue
            self._join(walk, number, parts[number].name, is_alone=list(parts) == [0])
        if first_error is not None and not self.parts:
            raise first_error
        last = max(parts)
        if self._joined == last and self.summary.get(ENDING_KEY) == CONTINUED:
            self._note_missing(path, last + 1, last + 2)

    @property
    def problem(self) -> str:
        """What is missing."""
        return "; ".join(self._problems)

    def _note_missing(self, path: Path, start: int, stop: int) -> None:
        if start < stop:
            names = [part_path(path, number).name for number in sorted({start, stop - 1})]
            self._problems.append(f"{' to '.join(names)} {'is' if len(names) == 1 else 'are'} missing")

    def _join(self, walk: Walk, number: int, name: str, is_alone: bool) -> None:
        metadata = walk.metadata.get(RUN_METADATA, {})
        part = metadata.pop(PART_KEY, str(number))
        is_foreign = bool(self.metadata and metadata) and metadata != self.metadata
        if is_foreign or (part != str(number) and not is_alone):
            self._problems.append(f"{name} is a part of another log")
            return
        if part != str(number):
            self._problems.append(f"{name} is part {part} of a log")
            number = int(part) if part.isdecimal() else number
        if walk.problem:
            self._problems.append(walk.problem if is_alone else f"{name}: {walk.problem}")
        self.parts += 1
        self._joined = number
        self.metadata = self.metadata or metadata
        self.attachments = {**walk.attachments, **self.attachments}
        for topic_name, topic in walk.topics.items():
            mine = self.topics.setdefault(topic_name, topic)
            if mine is topic:
                topic.places = [places + self._bytes_before for places in topic.places]
            elif not mine.join(topic, self._bytes_before):
                self._problems.append(f"{name}: {topic_name} has another type than before")
        self._bytes_before += walk.record_bytes
        self._sum_up(walk.metadata.get(SUMMARY_METADATA, {}))

    def _sum_up(self, summary: dict[str, str]) -> None:
        both = self.summary.keys() & summary.keys() & _COUNTS
        sums = {key: str(_count(self.summary, key) + _count(summary, key)) for key in both}
        self.summary = {**self.summary, **summary, **sums}
        if not summary:
            self.summary.pop(ENDING_KEY, None)


def _parts_of(path: Path) -> dict[int, Path]:
    try:
        return find_parts(path) or {0: path}
    except OSError:
        return {0: path}


def _count(summary: dict[str, str], key: str) -> int:
    text = summary.get(key, "0")
    return int(text) if text.isdecimal() else 0
