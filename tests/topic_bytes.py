"""The messages of a topic as bytes: equal for two logs that hold the same, bit for bit."""

from pathlib import Path

from mcap.reader import make_reader

from adacd_hil.log.log_files import find_parts


def topic_bytes(log: Path, topic: str) -> bytes:
    """Return the payloads of a topic, one after the other, as mcap's reader finds them in all parts of a log."""
    found = []
    for part in find_parts(log).values():
        with part.open("rb") as file:
            found += [each.data for _, _, each in make_reader(file).iter_messages([topic], log_time_order=False)]
    return b"".join(found)
