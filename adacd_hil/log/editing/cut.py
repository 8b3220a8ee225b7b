"""A stretch of a log as a log of its own, with everything that explains it.

Of our own logs whole cycles are taken, by their publish_time; of others messages, by their log_time. Times count from
the first of them in the log.
"""

from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.records import Attachment
from numpy.typing import NDArray

from adacd_hil.log.editing.intact import IntactLog
from adacd_hil.log.editing.log_copy import LogCopy
from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap.chunk_contents import Contents
from adacd_hil.log.mcap_file import ENDING_KEY, RUN_METADATA
from adacd_hil.log.reader import LoggedContact, read_log
from adacd_hil.log.stretch import Stretch
from adacd_hil.log.summary import CUT, DROPPED_KEY, count_frames


class Cut(NamedTuple):
    """What `cut` did."""

    path: Path
    out: Path
    stretch: Stretch
    messages: int


def default_out(path: Path) -> Path:
    """Name the result of cutting `path`."""
    return path.with_name(f"{path.stem}.{CUT}{path.suffix}")


def find_contact(path: Path, contact: int, around_s: float) -> Stretch:
    """Return the stretch around the contact of this number, from 1, of a log. Raises LogError."""
    log = read_log(path, ("/contact",))
    begun = contacts_begun(log.contacts)
    if not 1 <= contact <= len(begun):
        raise LogError(f"log {path} has {len(begun)} contacts: there is no contact {contact}")
    at_s = (begun[contact - 1].t_ns + log.epoch_ns - _start_ns(path)) * 1e-9
    return Stretch(at_s - around_s, at_s + around_s)


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
    stretch: Stretch,
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


def _is_within(times: NDArray[np.int64], start_ns: int, stretch: Stretch) -> NDArray[np.bool_]:
    first_ns, end_ns = stretch.bounds_ns(start_ns)
    return np.asarray((times >= first_ns) & (times < end_ns))
