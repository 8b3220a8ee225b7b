"""The findings of a log's check: broken rules, their places, and their severity."""

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

_TOLD = 10
"""Largest number of findings of one rule in one file that are listed; the rest are only counted."""


class Severity(StrEnum):
    """How bad a finding is.

    `error`: the file is damaged or written wrong. `warning`: it lacks something, or readers may stumble over it.
    `note`: it is sound, and a reader should know this.
    """

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


class LogFinding(NamedTuple):
    """One place where a log breaks a rule of `RULES`.

    `offset`: byte of the file, -1 for the file as a whole.
    """

    file: str
    severity: Severity
    rule: str
    text: str
    offset: int = -1


@dataclass
class Findings:
    """The findings of one file. `found` has the first `_TOLD` of each rule."""

    file: str
    found: list[LogFinding] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    """All findings by rule, those that aren't told too."""
    without_crc: Counter[str] = field(default_factory=Counter)
    """Parts of the file that have no CRC, by kind."""

    def add_finding(self, rule: str, text: str, offset: int = -1) -> None:
        """Count a finding of a rule of `RULES`; keep it in `found` if it is one of the rule's first `_TOLD`.

        offset: byte of the file, -1 for the file as a whole.
        """
        self.counts[rule] += 1
        if self.counts[rule] <= _TOLD:
            self.found.append(LogFinding(self.file, RULES[rule], rule, text, offset))

    def count(self, severity: Severity) -> int:
        """Return the number of all findings of a severity, including those that aren't in `found`."""
        return sum(count for rule, count in self.counts.items() if RULES[rule] is severity)


_ERROR, _WARNING, _NOTE = Severity
RULES: dict[str, Severity] = {
    # the file
    "magic": _ERROR,  # the file begins and ends with MCAP's magic, and nothing follows
    "record": _ERROR,  # every byte belongs to a record that can be read
    "header": _ERROR,  # one Header, before all else
    "data-end": _ERROR,  # one DataEnd
    "footer": _ERROR,  # one Footer
    "place": _ERROR,  # each kind of record is in its section
    "library": _WARNING,  # the Header names the program that wrote the file
    "profile": _WARNING,  # the Header's profile is empty, ros1 or ros2
    "unknown-record": _WARNING,  # every kind of record is known
    # CRCs
    "chunk-crc": _ERROR,  # every chunk can be opened and fits its CRC
    "data-crc": _ERROR,  # the data section fits its CRC
    "summary-crc": _ERROR,  # the summary fits its CRC
    "attachment-crc": _ERROR,  # every attachment fits its CRC
    "no-crc": _NOTE,  # CRCs vouch for all messages, attachments and the summary
    "some-crc": _WARNING,  # without a CRC of the data section, all chunks have a CRC or none
    # definitions
    "schema-id": _ERROR,  # no schema has the number 0
    "schema-encoding": _ERROR,  # a schema with data names its encoding
    "empty-schema": _WARNING,  # a schema isn't empty
    "redefinition": _ERROR,  # definitions of one number are equal
    "duplicate": _WARNING,  # the data section defines each number once
    "undefined-schema": _ERROR,  # the schema of a channel is defined before it
    "undefined-channel": _ERROR,  # the channel of a message is defined before it
    "summary-only": _ERROR,  # what the summary defines and messages use, the data section defines too
    "unused-summary-only": _NOTE,  # the data section defines what no message uses, too
    # chunks and indexes
    "chunk-record": _ERROR,  # a chunk holds schemas, channels and messages, whole ones
    "chunk-times": _ERROR,  # a chunk's times are those of its earliest and latest message
    "chunk-size": _ERROR,  # a chunk is as large as it says
    "message-index": _ERROR,  # the message indexes behind a chunk have exactly its messages
    "no-message-index": _WARNING,  # a chunk has message indexes
    "unindexed-messages": _WARNING,  # a file with indexes has no messages outside chunks
    "chunk-index": _ERROR,  # one chunk index for each chunk, with the chunk's values
    "no-chunk-index": _WARNING,  # the summary has chunk indexes
    "summary-channels": _ERROR,  # the summary defines the channels and schemas that it needs
    "attachment-index": _ERROR,  # one index for each attachment, with its values
    "metadata-index": _ERROR,  # one index for each metadata record, with its values
    "summary-offset": _ERROR,  # summary offsets and Footer say where the groups are
    "statistics": _ERROR,  # at most one Statistics, with the right counts and times
    # messages
    "order": _WARNING,  # log_time doesn't run backwards within a channel
    "schema-text": _ERROR,  # the text of a ros2msg schema can be read
    "cdr": _ERROR,  # a cdr message begins with its encapsulation and is as long as its schema says
    # our logs
    "missing-part": _ERROR,  # a log has all its parts
    "foreign-part": _ERROR,  # the parts of a log are of one run
    "counts": _ERROR,  # the summary's counts of messages and frames are right
    "ending": _WARNING,  # the summary says why the log ended, and that it was meant to
    "dropped": _WARNING,  # no packet was dropped on the way to the log
    "lost": _WARNING,  # nothing was lost before the log was recovered
}
"""Severity of a finding, by the rule that a log breaks."""
