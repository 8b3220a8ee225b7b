"""Logs damaged at random, for damage_campaign.py: what check and recover must make of each.

Judged by code that is not ours: mcap's own reader lists the messages of the undamaged and of the recovered log.
"""

import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Chunk, Footer, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "log"))

import recorded_run

from adacd_hil.lab.logs.check.log_check import check_log
from adacd_hil.lab.logs.recover import recover
from adacd_hil.log.log_files import LOG_NAME, PART_KEY, LogError

KINDS = ("cut", "flip", "flips", "zeros", "cut and flip")
CYCLES = 400
PERIOD_NS = 8_000_000
"""Far apart, so that few cycles make a chunk: about 13 chunks."""
CHUNK_HEAD = 53
"""Bytes of a chunk before what is compressed by zstd."""
MessageKey = tuple[str, int, int, int, bytes]


@dataclass(frozen=True)
class DamageResult:
    """One damaged log. `violations`: in what check or recover did not do as they must."""

    seed: int
    kind: str
    place: int
    found: bool
    saved: int
    exit_status: int
    violations: list[str]


class Place(NamedTuple):
    """A record: its bytes, and of a chunk which of all messages are in it."""

    start: int
    end: int
    messages: range = range(0)


@dataclass(frozen=True)
class Undamaged:
    """The log that is damaged, and what is in it."""

    data: bytes
    chunks: list[Place]
    attachment_places: dict[str, Place]
    summary: Place
    messages: dict[MessageKey, int]  # with their place in the order
    attachments: dict[str, bytes]
    metadata: dict[str, dict[str, str]]


def records(path: Path) -> Iterator[Any]:
    """List what mcap's reader finds in a file, up to where it gives up."""
    with path.open("rb") as file:
        try:
            yield from StreamReader(file, validate_crcs=True).records
        except (McapError, ValueError):
            return


def messages_of(path: Path) -> list[MessageKey]:
    """List the messages of a file in order, as mcap's reader finds them."""
    topics: dict[int, str] = {}
    found = []
    for record in records(path):
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message):
            key = topics[record.channel_id], record.log_time, record.publish_time, record.sequence, record.data
            found.append(key)
    return found


def make_undamaged(folder: Path, cycles: int = CYCLES) -> Undamaged:
    """Write a log of random numbers."""
    path = folder / "whole.mcap"
    period_ns, recorded_run.PERIOD_NS = recorded_run.PERIOD_NS, PERIOD_NS
    try:
        recorded_run.record(path, recorded_run.make_run(cycles, has_fd=True))
    finally:
        recorded_run.PERIOD_NS = period_ns
    data = path.read_bytes()
    chunks: list[Place] = []
    with path.open("rb") as file:
        for chunk in (record for record in StreamReader(file, emit_chunks=True).records if isinstance(record, Chunk)):
            start, first = data.index(chunk.data), chunks[-1].messages.stop if chunks else 0
            count = sum(isinstance(record, Message) for record in breakup_chunk(chunk))
            chunks.append(Place(start - CHUNK_HEAD, start + len(chunk.data), range(first, first + count)))
    found = messages_of(path)
    messages = {key: place for place, key in enumerate(found)}
    assert len(messages) == len(found), "two messages are equal"
    everything = list(records(path))
    attachments = {record.name: record.data for record in everything if isinstance(record, Attachment)}
    places = {
        name: Place(data.index(text) - 100, data.index(text) + len(text) + 4) for name, text in attachments.items()
    }
    metadata = {record.name: record.metadata for record in everything if isinstance(record, Metadata)}
    summary = next(Place(record.summary_start, len(data)) for record in everything if isinstance(record, Footer))
    return Undamaged(data, chunks, places, summary, messages, attachments, metadata)


def damage(whole: Undamaged, seed: int) -> tuple[bytes, str, list[Place]]:
    """Damage it as the seed says; return it, how, and where."""
    generator = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    data, size = bytearray(whole.data), len(whole.data)
    places = []
    if "flip" in kind:
        for _ in range(int(generator.integers(2, 6)) if kind == "flips" else 1):
            place = int(generator.integers(size))
            data[place] ^= 1 << int(generator.integers(8))
            places.append(Place(place, place + 1))
    if kind == "zeros":
        place, count = int(generator.integers(size)), int(2 ** generator.integers(1, 15))
        data[place : place + count] = bytes(len(data[place : place + count]))
        places.append(Place(place, min(size, place + count)))
    if "cut" in kind:
        place = int(generator.integers(size))
        del data[place:]
        places.append(Place(place, size))
    return bytes(data), kind, places


def run_trial(whole: Undamaged, seed: int, folder: Path) -> DamageResult:
    """Damage a log, check it, recover it, judge the result."""
    data, kind, places = damage(whole, seed)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / LOG_NAME
    path.write_bytes(data)
    violations: list[str] = []
    has_found = check_log(path).errors > 0
    if has_found != (data != whole.data):
        violations.append("check finds nothing" if data != whole.data else "check finds what isn't there")
    saved, status = 0, 1
    try:
        recovery = recover(path)
    except LogError:
        if is_intact(whole.chunks[0], places):
            violations.append("nothing is saved though the first chunk is intact")
    else:
        status = 3 if recovery.losses.is_any else 0
        saved = recovery.messages
        violations += judge(whole, recovery.out, places, recovery.losses.is_any)
        checked = check_log(recovery.out)
        if checked.errors:
            violations.append(f"the recovered log fails its check: {checked.findings[0].text}")
    if path.read_bytes() != data:
        violations.append("the source was altered")
    shutil.rmtree(folder)
    return DamageResult(seed, kind, places[0].start, has_found, saved, status, violations)


def judge(whole: Undamaged, out: Path, places: list[Place], is_lossy: bool) -> list[str]:
    """Compare a recovered log with the undamaged one."""
    found = messages_of(out)
    wrong = sum(key not in whole.messages for key in found)
    if wrong:
        return [f"{wrong} messages that the log never had"]
    violations = []
    order = [whole.messages[key] for key in found]
    if order != sorted(set(order)):
        violations.append("messages are out of order or twice")
    if is_intact(whole.chunks[0], places) or is_intact(whole.summary, places):  # else nothing defines the channels
        intact = {message for chunk in whole.chunks if is_intact(chunk, places) for message in chunk.messages}
        if missing := intact - set(order):
            violations.append(f"{len(missing)} messages of intact chunks are missing")
    attachments = {record.name: record.data for record in records(out) if isinstance(record, Attachment)}
    metadata = {record.name: record.metadata for record in records(out) if isinstance(record, Metadata)}
    if any(whole.attachments.get(name) != text for name, text in attachments.items()):
        violations.append("an attachment that the log never had")
    intact_names = {name for name, place in whole.attachment_places.items() if is_intact(place, places)}
    if missing_names := intact_names - set(attachments):
        violations.append(f"intact attachments are missing: {', '.join(missing_names)}")
    if not is_lossy:
        if len(found) != len(whole.messages):
            violations.append(f"{len(whole.messages) - len(found)} messages are missing, and it says that nothing is")
        run = {key: text for key, text in whole.metadata["run"].items() if key != PART_KEY}
        if attachments != whole.attachments or metadata.get("run") != run:
            violations.append("attachments or metadata are not what they were, and it says that nothing is lost")
    return violations


def is_intact(record: Place, places: list[Place]) -> bool:
    """Say whether a record was not damaged."""
    return all(place.end <= record.start or record.end <= place.start for place in places)
