"""A damaged log made whole again from its trusted records: see salvage.py.

The result is one file, whatever the number of parts: definitions, attachments, metadata and messages as they were, and
an index, statistics and a summary made anew, whose `ending` is "recovered" and names the lost parts. The source stays
as it is, and the result appears under its name only when it is whole.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from mcap.records import Attachment

from adacd_hil.lab.logs.log_copy import LogCopy
from adacd_hil.lab.logs.salvage import Losses
from adacd_hil.lab.logs.salvaged_log import SalvagedLog
from adacd_hil.log.log_parts import LOST_KEY, RECOVERED


class LogRecovery(NamedTuple):
    """The result of `recover`: source, new log, numbers of saved messages, attachments and metadata records, losses.

    Attachments and metadata count once per name; the summary of the source doesn't count.
    """

    path: Path
    out: Path
    messages: int
    attachments: int
    metadata: int
    losses: Losses


def recover(path: Path, out: Path | None = None, progress: Callable[[str], None] = lambda _: None) -> LogRecovery:
    """Save the trusted records of all parts of a log to the new log `out`. path: the log's first part.

    An earlier result of `recover` or `cut` at `out` is replaced, at the end. out: None: such as run.recovered.mcap.
    progress: called with a line per part. Raises LogError if no record can be trusted, a file can't be read or written,
    or `out` is the log itself, another file, or named like a part of a log.
    """
    out = out or path.with_name(f"{path.stem}.{RECOVERED}{path.suffix}")
    log = SalvagedLog(path, progress)
    with LogCopy(out, log) as copy:
        for item in log:
            if isinstance(item, Attachment):
                copy.add_attachment(item)
            else:
                copy.add_messages(item)
        copy.finish(RECOVERED, {"source_ending": log.ending, **_describe(log.losses)})
    return LogRecovery(path, out, copy.messages, len(log.attachments), len(log.metadata), log.losses)


def _describe(losses: Losses) -> dict[str, str]:
    described = {"unvouched_messages": str(losses.unvouched)} if losses.unvouched else {}
    if losses.is_any:
        described |= {
            LOST_KEY: losses.describe(),
            "lost_chunks": str(losses.chunks),
            "lost_messages": "unknown" if losses.messages is None else str(losses.messages),
            "lost_bytes": str(losses.bytes),
            "holes_s": f"{sum(losses.holes_s):.3f}",
        }
    return described
