"""A stretch of a sound log: of our own logs whole cycles, by their publish_time, of others' messages by their log_time.

Times count from the first of them in the log. A log of which anything is lost is recovered first.
"""

from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np
from mcap.records import Attachment
from numpy.typing import NDArray

from adacd_hil.lab.logs.log_copy import LogCopy
from adacd_hil.lab.logs.salvaged_log import SalvagedLog
from adacd_hil.log.log_files import RUN_METADATA, LogError
from adacd_hil.log.log_parts import CUT
from adacd_hil.log.mcap.chunks import Contents
from adacd_hil.log.reader import begin_of_log, each_once, read_log
from adacd_hil.log.time_window import TimeWindow
from adacd_hil.log.types.topics import CONTACT


def default_out(path: Path) -> Path:
    """Return the path of the result of cutting `path`, such as run.cut.mcap."""
    return path.with_name(f"{path.stem}.{CUT}{path.suffix}")


def find_contact(path: Path, contact: int, around_s: float) -> TimeWindow:
    """Return the time window around a contact's detection, s since the log's begin.

    It reaches `around_s` to both sides, even beyond the log. contact: its number, from 1. Raises LogError if the log
    can't be read or has no such contact.
    """
    log = read_log(path, (CONTACT.name,))
    begun = each_once(log.contacts)
    if not 1 <= contact <= len(begun):
        raise LogError(f"log {path} has {len(begun)} contacts: there is no contact {contact}")
    at_s = (begun[contact - 1][0] - begin_of_log(path)) * 1e-9
    return TimeWindow(at_s - around_s, at_s + around_s)


def cut(
    path: Path,
    out: Path,
    stretch: TimeWindow,
    topics: Collection[str] = (),
    progress: Callable[[str], None] = lambda _: None,
) -> int:
    """Copy a time window of the log whose first part is `path` to the new log `out`; return its number of messages.

    Messages count by publish_time in a log of ours, else by log_time, and those at the window's end are left out.
    Attachments and metadata are copied whole. An earlier result of `cut` or `recover` at `out` is replaced, at the end.
    stretch: its times are s since the first message. topics: those that are copied; (): all. progress: called with a
    line per part. Raises LogError if the log is damaged, lacks a topic, or has no message in the window; also if `out`
    is the log itself, another file, or named like a part of a log, or can't be written.
    """
    log = SalvagedLog(path, progress)
    known = set()
    with LogCopy(out, log, frozenset(topics) or None) as copy:
        bounds_ns: tuple[int, int] | None = None
        for item in log:
            if isinstance(item, Attachment):
                copy.add_attachment(item)
                continue
            times = _times(log, item)
            if bounds_ns is None and len(times):
                bounds_ns = stretch.bounds_ns(int(times[0]))
            first_ns, end_ns = bounds_ns or (0, 0)
            known |= {channel.topic for channel in log.definitions.channels.values()}
            copy.add_messages(item, (times >= first_ns) & (times < end_ns))
        if losses := log.losses.describe():
            what = log.losses.notes[0] if log.losses.notes else f"{path} lacks {losses}"
            raise LogError(f"{what}: recover the log first, or wait until its run has ended")
        if unknown := sorted(set(topics) - known):
            raise LogError(f"log {path} has no topic {', '.join(unknown)}; it has {', '.join(sorted(known))}")
        if not copy.messages:
            raise LogError(f"log {path} has no message from {stretch.start_s:g} to {stretch.end_s:g} s")
        copy.finish(CUT, {"from_s": f"{stretch.start_s:.9g}", "until_s": f"{stretch.end_s:.9g}"})
    return copy.messages


def _times(log: SalvagedLog, contents: Contents) -> NDArray[np.int64]:
    """Return the times (n,), ns, by which messages are cut: publish_time in a log of ours, else log_time."""
    is_ours = RUN_METADATA in log.metadata
    return (contents.publish_times if is_ours else contents.log_times).astype(np.int64)
