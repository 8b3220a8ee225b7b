"""What the writer is told at its start, as JSON on its standard input.

The messages of the DBC are told too, as far as frames are decoded by them: to read a DBC takes longer than all else
that the writer does before it is ready.
"""

import base64
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from adacd_hil.log.channels import MessageLike

MOST_VIEWERS = 8
"""Viewers of a live view at a time, unless --live-viewers says otherwise."""


@dataclass(frozen=True)
class ToldSignal:
    """A signal of a DBC message; the fields are those of `SignalLike`."""

    name: str
    unit: str
    scale: float
    offset: float
    container: int
    shift: int
    mask: int
    raw_low: int
    raw_high: int


@dataclass(frozen=True)
class ToldMessage:
    """A message of a DBC."""

    name: str
    can_id: int
    length: int
    signals: tuple[ToldSignal, ...]


@dataclass(frozen=True)
class LiveSetup:
    """Where the live view is served (port 0: any that is free), and the arm that it draws.

    robot_description: a URDF. is_upright: gravity acts on the joints. origins, names: of web pages that may watch, and
    of this machine, beside those of log/live/admission.py. most_viewers: at a time.
    """

    host: str
    port: int
    robot_description: str
    link_length_m: tuple[float, float]
    is_upright: bool = False
    origins: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    most_viewers: int = MOST_VIEWERS


@dataclass(frozen=True)
class Setup:
    """`messages`: of the DBC; `is_truth` makes the emulator's own log, which has none.

    `path`: absolute, of the first part. A part ends after `part_bytes` before compression or `part_ns` of log time,
    never where these are 0. `live`: served, unless None.
    """

    path: Path
    is_truth: bool
    is_blocking: bool
    messages: tuple[ToldMessage, ...]
    parameter_count: int
    epoch_ns: int
    part_bytes: int
    part_ns: int
    attachments: dict[str, bytes]
    metadata: dict[str, str]
    further_count: int = 0
    channel_count: int = 0
    live: LiveSetup | None = None

    def to_json(self) -> bytes:
        """Write it."""
        table: dict[str, Any] = asdict(self)
        table["path"] = str(self.path)
        table["attachments"] = {name: base64.b64encode(data).decode() for name, data in self.attachments.items()}
        return json.dumps(table).encode()

    @staticmethod
    def from_json(text: bytes) -> "Setup":
        """Read it."""
        table = json.loads(text)
        table["path"] = Path(table["path"])
        table["messages"] = tuple(
            ToldMessage(**{**message, "signals": tuple(ToldSignal(**signal) for signal in message["signals"])})
            for message in table["messages"]
        )
        table["attachments"] = {name: base64.b64decode(data) for name, data in table["attachments"].items()}
        if live := table["live"]:
            tuples = {name: tuple(live[name]) for name in ("link_length_m", "origins", "names")}
            table["live"] = LiveSetup(**{**live, **tuples})
        return Setup(**table)


def tell_messages(messages: Iterable[MessageLike]) -> tuple[ToldMessage, ...]:
    """Put messages of a DBC into a form that can be told."""
    names = [field.name for field in fields(ToldSignal)]
    return tuple(
        ToldMessage(
            name=message.name,
            can_id=message.can_id,
            length=message.length,
            signals=tuple(ToldSignal(*(getattr(signal, name) for name in names)) for signal in message.signals),
        )
        for message in messages
    )
