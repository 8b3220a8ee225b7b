"""The rules on definitions (schemas, channels, .msg texts) and messages (order of times, cdr payloads)."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from adacd_hil.lab.logs.check.findings import Findings
from adacd_hil.lab.logs.joint_states import is_joint_state
from adacd_hil.lab.logs.payload_sizes import is_own, payload_size
from adacd_hil.log.mcap.chunks import Contents
from adacd_hil.log.mcap.mcap_records import CHANNEL_NUMBERS
from adacd_hil.log.mcap.record_layout import MESSAGE_HEAD
from adacd_hil.log.types.message_types import ENCAPSULATION, FD_FRAME, FD_FRAME_DTYPE, JOINT_STATE, LOG, SEPARATOR
from adacd_hil.log.types.unpacking import is_log

_ANY_SIZE = -1
_LAST_ENCAPSULATION = 0x0D
"""DDS-XTypes 7.6.3.1.2."""


class DefinitionCheck:
    """Checks the schemas and channels of a file.

    Call it for those of the data section, then of the summary, then `finish`.
    """

    def __init__(self, findings: Findings) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.all_channels: dict[int, Channel] = {}
        """Those of the summary, too."""
        self.summary_schemas: set[int] = set()
        self.summary_channels: set[int] = set()
        self._findings = findings
        self._summary_only: list[tuple[str, int, int]] = []
        self._duplicates: set[str] = set()
        self._read: set[int] = set()  # schemas whose text was read

    def schema(self, schema: Schema, offset: int, is_summary: bool) -> None:
        """Check a schema by the rules and against the data section's first one of its number; add findings.

        Stores the first schema of each number in the data section; of one in the summary only the number. The text is
        read if it is the first ros2msg schema of its number. offset: of its record or chunk in the file. is_summary: it
        stands in the summary.
        """
        name = f"schema {schema.id}"
        if schema.id == 0:
            self._findings.add_finding("schema-id", f"schema {schema.name!r} has the number 0", offset)
        if not schema.encoding and schema.data:
            self._findings.add_finding("schema-encoding", f"{name} has data but no encoding", offset)
        elif not schema.encoding:
            self._findings.add_finding("empty-schema", f"{name} ({schema.name!r}) is empty", offset)
        known = self.schemas.get(schema.id)
        if known is not None:
            self._compare(name, known, schema, ("name", "encoding", "data"), offset)
        self._place("schema", schema.id, schema.id in self.schemas, offset, is_summary)
        if is_summary:
            self.summary_schemas.add(schema.id)
        else:
            self.schemas.setdefault(schema.id, schema)
        if schema.encoding == "ros2msg" and schema.id not in self._read:
            self._read.add(schema.id)
            if problem := text_problem(schema.data):
                self._findings.add_finding("schema-text", f"{name} ({schema.name}): {problem}", offset)

    def channel(self, channel: Channel, offset: int, is_summary: bool) -> None:
        """Check a channel by the rules and against the data section's first one of its number; add findings.

        Its schema must be defined before. Stores in `channels` the data section's first channel of each number, in
        `all_channels` the data section's last one, or the summary's first one if that has none, and in
        `summary_channels` the summary's numbers; notes for `finish` those that only the summary has. offset: of its
        record or chunk in the file. is_summary: it stands in the summary.
        """
        name = f"channel {channel.id}"
        known = self.channels.get(channel.id)
        if known is not None:
            fields = ("schema_id", "topic", "message_encoding", "metadata")
            self._compare(name, known, channel, fields, offset)
        is_defined = channel.schema_id in self.schemas or (is_summary and channel.schema_id in self.summary_schemas)
        if channel.schema_id and not is_defined:
            text = f"{name} ({channel.topic}) has the schema {channel.schema_id}, which is not defined"
            self._findings.add_finding("undefined-schema", text, offset)
        self._place("channel", channel.id, channel.id in self.channels, offset, is_summary)
        if is_summary:
            self.summary_channels.add(channel.id)
            self.all_channels.setdefault(channel.id, channel)
        else:
            self.channels.setdefault(channel.id, channel)
            self.all_channels[channel.id] = channel

    def _compare(self, name: str, known: object, other: object, fields: tuple[str, ...], offset: int) -> None:
        different = [field for field in fields if getattr(known, field) != getattr(other, field)]
        if different:
            words = ", ".join(field.removesuffix("_id").replace("_", " ") for field in different)
            self._findings.add_finding("redefinition", f"{name} is defined again with another {words}", offset)

    def _place(self, kind: str, number: int, is_known: bool, offset: int, is_summary: bool) -> None:
        """Note a definition that only the summary has.

        Add a finding, once per number, for one that the data section repeats. kind: "schema" or "channel". is_known:
        the data section has defined the number. is_summary: this definition is in the summary.
        """
        name = f"{kind} {number}"
        if is_summary and not is_known:
            self._summary_only.append((kind, number, offset))
        elif not is_summary and is_known and name not in self._duplicates:
            self._duplicates.add(name)
            self._findings.add_finding("duplicate", f"{name} is defined more than once in the data section", offset)

    def finish(self, counts: NDArray[Any]) -> None:
        """Add findings on channels and schemas that only the summary defines.

        Each that messages use is an error; the others make one note. counts: messages by channel number.
        """
        used = {"channel": set(np.flatnonzero(counts).tolist())}
        used["schema"] = {self.all_channels[number].schema_id for number in used["channel"] & set(self.all_channels)}
        unused = []
        for kind, number, offset in self._summary_only:
            if number in used[kind]:
                self._findings.add_finding("summary-only", f"{kind} {number} is defined in the summary only", offset)
            else:
                unused.append(f"{kind} {number}")
        if unused:
            text = f"the summary alone defines what no message uses: {', '.join(unused)}"
            self._findings.add_finding("unused-summary-only", text)


class ContentCheck:
    """Checks the messages of a file, their order and payloads."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self._described: set[int] = set()
        self._latest = np.zeros(CHANNEL_NUMBERS, np.uint64)  # log time of each channel
        self._sizes = np.full(CHANNEL_NUMBERS, _ANY_SIZE, np.int64)
        self._is_cdr = np.zeros(CHANNEL_NUMBERS, np.bool_)
        self._checks: dict[int, Callable[[bytes], bool]] = {}  # of payloads that don't have that size

    def messages(self, contents: Contents, definitions: DefinitionCheck, offset: int) -> None:
        """Check times and cdr payloads of messages in a row; add findings.

        offset: of their chunk, or of the first message outside of chunks, in the file. Times are also compared with
        those of earlier calls.
        """
        for number in np.unique(contents.channels).tolist():
            if number not in self._described and number in definitions.channels:
                channel = definitions.channels[number]
                self._describe(channel, definitions.schemas.get(channel.schema_id))
        self._check_order(contents, definitions, offset)
        self._check_payloads(contents, definitions, offset)

    def _describe(self, channel: Channel, schema: Schema | None) -> None:
        """Store the payload size of a channel, whether its payloads are cdr, and, for varying sizes, their check."""
        self._described.add(channel.id)
        self._is_cdr[channel.id] = channel.message_encoding == "cdr"
        self._sizes[channel.id] = _ANY_SIZE if (size := payload_size(channel, schema)) is None else size
        for own, check in _VARYING:
            if schema is not None and is_own(channel, schema, own):
                self._checks[channel.id] = check

    def _check_order(self, contents: Contents, definitions: DefinitionCheck, offset: int) -> None:
        order = np.argsort(contents.channels, kind="stable")
        channels, times = contents.channels[order], contents.log_times[order]
        is_first = np.concatenate(([True], channels[1:] != channels[:-1]))
        before = np.concatenate((times[:1], times[:-1]))
        before[is_first] = self._latest[channels[is_first]]
        backwards = np.flatnonzero(times < before)
        if len(backwards):
            number = int(channels[backwards[0]])
            channel = definitions.channels.get(number)
            back_ns = int(before[backwards[0]]) - int(times[backwards[0]])
            text = (
                f"{len(backwards)} messages are earlier than the one before in their channel, the first on "
                f"{channel.topic if channel else number} by {back_ns} ns"
            )
            self._findings.add_finding("order", text, offset)
        np.maximum.at(self._latest, channels, times)

    def _check_payloads(self, contents: Contents, definitions: DefinitionCheck, offset: int) -> None:
        data = np.frombuffer(contents.data, np.uint8)
        sizes = contents.ends - contents.starts - MESSAGE_HEAD
        is_cdr = self._is_cdr[contents.channels]
        expected = self._sizes[contents.channels]
        is_odd, is_varying = sizes != expected, np.isin(contents.channels, [*self._checks])
        is_wrong = is_cdr & ((sizes < len(ENCAPSULATION)) | ((expected != _ANY_SIZE) & is_odd & ~is_varying))
        looked_at = np.flatnonzero(is_cdr & ~is_wrong)
        heads = data[contents.starts[looked_at, np.newaxis] + np.arange(MESSAGE_HEAD, MESSAGE_HEAD + 4)]
        is_wrong[looked_at] = (heads[:, 0] != 0) | (heads[:, 1] > _LAST_ENCAPSULATION)
        for place in np.flatnonzero(is_varying & is_odd & ~is_wrong).tolist():
            is_wrong[place] = not self._checks[int(contents.channels[place])](contents.payload(place))
        for place in np.flatnonzero(is_wrong)[:1].tolist():
            channel = definitions.channels[int(contents.channels[place])]
            count = np.count_nonzero(is_wrong)
            text = f"{count} messages aren't as their schemas say, the first on {channel.topic}"
            self._findings.add_finding("cdr", text, offset)


def _is_fd_frame(payload: bytes) -> bool:
    assert FD_FRAME_DTYPE.fields is not None
    head, place = int(FD_FRAME_DTYPE.fields["data"][1]), int(FD_FRAME_DTYPE.fields["count"][1])
    return len(payload) >= head and len(payload) == head + int.from_bytes(payload[place : place + 4], "little")


_VARYING = ((FD_FRAME, _is_fd_frame), (LOG, is_log), (JOINT_STATE, is_joint_state))
"""Types of payloads that vary in size, and their checks; joint states of others have our text, and other joints."""


_PRIMITIVES = {
    *("bool", "byte", "char", "string", "wstring", "float32", "float64"),
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
}
_LINE = re.compile(
    r"(?P<type>[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*){0,2})(<=\d+)?(?P<array>\[(<=)?\d*\])?"
    r"\s+(?P<name>[A-Za-z]\w*)\s*(?P<rest>.*)"
)
_PARTS = "---"
"""Between the parts of a service or an action, whose events rosbag2 records."""
_CONSTANT = re.compile(r"=\s*\S.*")


def text_problem(data: bytes) -> str:
    """Return the defect in the text of a ros2msg schema, in words; "" if there is none."""
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        return "is not UTF-8"
    first, *others = re.split(rf"^={{{len(SEPARATOR)}}}$\n?", text, flags=re.MULTILINE)
    types = {"": first}
    for other in others:
        head, _, body = other.partition("\n")
        if not head.startswith("MSG: "):
            return f"a type has no name: {head!r}"
        types[head.removeprefix("MSG: ").strip()] = body
    known = {_short(name) for name in types}
    for name, body in types.items():
        for line in body.splitlines():
            if problem := _line_problem(line.strip(), known):
                return f"{name or 'the type'}: {problem}"
    return ""


def _line_problem(line: str, known: set[str]) -> str:
    """Return the defect in a line of a ros2msg schema's text, in words; "" without one.

    known: names of the types that the text defines, as package/Type.
    """
    if not line or line.startswith("#") or line == _PARTS:
        return ""
    match = _LINE.fullmatch(line)
    if match is None:
        return f"no field: {line!r}"
    rest = match["rest"]
    if rest.startswith("=") and not (_CONSTANT.fullmatch(rest) and match["type"] in _PRIMITIVES):
        return f"no constant: {line!r}"
    if match["type"] in _PRIMITIVES or _short(match["type"]) in known:
        return ""
    names = {name.rsplit("/")[-1] for name in known}
    return "" if "/" not in match["type"] and match["type"] in names else f"unknown type {match['type']}"


def _short(name: str) -> str:
    """Return package/Type for package/msg/Type; a name without a slash as it is."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}" if len(parts) > 1 else name
