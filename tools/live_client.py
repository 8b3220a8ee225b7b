"""A headless viewer: subscribes to a live view and reports rate and age of each topic.

    python tools/live_client.py ws://127.0.0.1:8765 --seconds 10 --json

Expected is the rate that the server keeps, over the time by the log that passed between the topic's first and last
message; topics that are shown whole, and those that come more seldom, have none to compare with. The age of a message
is the wall clock when it arrives minus its log time, so it means something only in real time and on the host of the
run, or one whose clock agrees with it.
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adacd_hil.cli.options import HOST, PORT
from adacd_hil.lab.live.client import LiveMessage, live_client
from adacd_hil.lab.live.feed import EVERY_MESSAGE, rate_of
from adacd_hil.log.log_files import LogError

WALL_NS = 1_000_000_000_000_000_000
"""Log times below this, the year 2001, are those of lockstep: they have no age."""


@dataclass
class Topic:
    """What came of one topic."""

    log_ns: list[int] = field(default_factory=list)
    ages_ms: list[float] = field(default_factory=list)
    received_bytes: int = 0

    def accept(self, message: LiveMessage, wall_ns: int) -> None:
        """Take in a message."""
        self.log_ns.append(message.log_ns)
        self.ages_ms.append((wall_ns - message.log_ns) * 1e-6)
        self.received_bytes += len(message.payload)

    def describe(self, rate_Hz: int) -> dict[str, Any]:
        """Compare with the rate of the topic. Frames of one cycle count once."""
        times_ns = np.array(self.log_ns)
        described: dict[str, Any] = {"received": len(times_ns), "bytes": self.received_bytes}
        if rate_Hz != EVERY_MESSAGE and len(times_ns) > 1:
            slots = np.unique(times_ns // (1_000_000_000 // rate_Hz))
            expected = int(slots[-1] - slots[0]) + 1
            lasted_s = (times_ns[-1] - times_ns[0]) * 1e-9
            described |= {"slots": len(slots), "expected": expected, "stated_rate_Hz": rate_Hz}
            described["rate_Hz"] = round((len(slots) - 1) / lasted_s, 2) if lasted_s > 0.0 else 0.0
        if len(times_ns) and times_ns[0] > WALL_NS:
            p50, p99 = np.percentile(self.ages_ms, (50, 99)).tolist()
            described |= {"age_p50_ms": round(p50, 2), "age_p99_ms": round(p99, 2)}
        return described


def watch(url: str, seconds: float) -> dict[str, dict[str, Any]]:
    """Receive everything for a while, or until the server ends. Raises LogError."""
    with live_client(url) as client:
        topics = {name: Topic() for name in client.topics}
        end_s = time.monotonic() + seconds
        while client.is_open and (left_s := end_s - time.monotonic()) > 0.0:
            if (message := client.receive(left_s)) is not None:
                topics[message.topic].accept(message, time.time_ns())
        return {name: topic.describe(rate_of(name)) for name, topic in sorted(topics.items())}


def as_text(topics: dict[str, dict[str, Any]]) -> str:
    """Write the table."""
    lines = [f"{'topic':<28} {'received':>8} {'slots':>11} {'Hz':>7} {'of':>4} {'age p50':>8} {'p99 ms':>8}"]
    for name, topic in topics.items():
        slots = f"{topic['slots']}/{topic['expected']}" if "expected" in topic else ""
        rate, stated = topic.get("rate_Hz", ""), topic.get("stated_rate_Hz", "")
        ages = f"{topic['age_p50_ms']:>8.1f} {topic['age_p99_ms']:>8.1f}" if "age_p50_ms" in topic else ""
        lines.append(f"{name:<28} {topic['received']:>8} {slots:>11} {rate:>7} {stated:>4} {ages}")
    return "\n".join(lines)


def main() -> None:
    """Watch and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("url", nargs="?", default=f"ws://{HOST}:{PORT}")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    try:
        topics = watch(options.url, options.seconds)
    except LogError as error:
        sys.exit(f"live_client: {error}")
    print(json.dumps(topics, indent=2) if options.json else as_text(topics))


if __name__ == "__main__":
    main()
