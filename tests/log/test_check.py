"""Every rule of the check is broken by one file, and told where; sound files break none."""

import pytest
from made_log import (
    ATTACHMENTS,
    RUN,
    SUMMARY,
    TYPE,
    Part,
    kinds,
    make_log,
    message,
    new,
    payload,
    put_together,
    rechunk,
    take_apart,
    write_parts,
)
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Schema
from mcap.writer import CompressionType, Writer

from adacd_hil.lab.logs.check.content_checks import text_problem
from adacd_hil.lab.logs.check.findings import RULES
from adacd_hil.lab.logs.check.log_check import check_log, find_logs
from adacd_hil.log.log_files import LogError

WHOLE = make_log()
SCHEMA = Schema(id=1, name=TYPE.name, encoding="ros2msg", data=TYPE.text.encode())
CHANNEL = Channel(id=1, topic="/a", message_encoding="cdr", metadata={"fields": "cycle value"}, schema_id=1)


def operated(edit, has_right_crcs=True, whole=WHOLE):
    parts = take_apart(whole)
    edit(parts)
    return put_together(parts, has_right_crcs)


def first(parts, opcode):
    return next(part for part in parts if part.opcode == opcode)


def before(opcode, *added):
    """Put parts before the first of a kind."""

    def edit(parts):
        place = parts.index(first(parts, opcode))
        parts[place:place] = added

    return edit


def without(opcode, count=None):
    def edit(parts):
        for part in kinds(parts, opcode)[:count]:
            parts.remove(part)

    return edit


def put(opcode, place, form, value):
    return lambda parts: first(parts, opcode).put(place, form, value)


def both(*edits):
    def edit(parts):
        for each in edits:
            each(parts)

    return edit


def uncovered(every):
    """Take the CRC of the data section and of all chunks, or of the first."""

    def edit(parts):
        put(Opcode.DATA_END, 0, "<I", 0)(parts)
        for part in kinds(parts, Opcode.CHUNK)[: None if every else 1]:
            part.put(24, "<I", 0)

    return edit


def at_top(record):
    return before(Opcode.CHUNK, new(record))


def header(library, profile):
    def edit(parts):
        parts[0].body = new(Header(profile, library)).body

    return edit


def spoiled_attachment(parts):
    part = first(parts, Opcode.ATTACHMENT)
    part.body = part.body.replace(ATTACHMENTS["config.toml"], b"x = 2\n")


def chunk_with(data):
    return lambda parts: rechunk(first(parts, Opcode.CHUNK), lambda held: held + data)


def without_channel_of_summary(parts):
    parts.remove(kinds(parts, Opcode.CHANNEL)[-1])


def another(opcode):
    return lambda parts: before(opcode, Part(opcode, first(parts, opcode).body))(parts)


def twice_indexed(parts):
    place = parts.index(first(parts, Opcode.CHUNK_INDEX))
    parts.insert(place, Part(Opcode.CHUNK_INDEX, parts[place].body, parts[place].offset))


HEAD_OF_INDEX = 6
MESSAGE = message(1, 0, payload(0))[9:]
BROKEN = {
    "magic": (WHOLE[:-1] + b"x", {"magic", "record"}),
    "magic at the start": (b"x" + WHOLE[1:], {"magic", "record", "data-crc"}),
    "magic, more behind it": (WHOLE + b"more", {"magic"}),
    "record": (operated(put(Opcode.MESSAGE_INDEX, 2, "<I", 17)), {"record", "message-index", "chunk-index"}),
    "header": (operated(before(Opcode.CHUNK, new(Header("", "x")))), {"header"}),
    "header, none": (operated(without(Opcode.HEADER)), {"header"}),
    "data-end": (operated(without(Opcode.DATA_END)), None),
    "footer": (operated(without(Opcode.FOOTER)), {"footer", "magic", "record"}),
    "place": (
        operated(
            lambda parts: before(Opcode.CHUNK, Part(Opcode.STATISTICS, first(parts, Opcode.STATISTICS).body))(parts)
        ),
        {"place"},
    ),
    "library": (operated(header("", "")), {"library"}),
    "profile": (operated(header("x", "ros3")), {"profile"}),
    "unknown-record": (operated(before(Opcode.CHUNK, Part(0x80, b"mine"))), {"unknown-record"}),
    "chunk-crc": (operated(put(Opcode.CHUNK, 24, "<I", 5)), None),
    "chunk-crc, compression": (operated(put(Opcode.CHUNK, 32, "<4s", b"zsto")), None),
    "data-crc": (operated(put(Opcode.DATA_END, 0, "<I", 5), has_right_crcs=False), {"data-crc"}),
    "summary-crc": (operated(put(Opcode.FOOTER, 16, "<I", 5), has_right_crcs=False), {"summary-crc"}),
    "attachment-crc": (operated(spoiled_attachment), {"attachment-crc"}),
    "no-crc": (operated(uncovered(every=True), has_right_crcs=False), {"no-crc"}),
    "no-crc, cut": (operated(both(uncovered(every=True), without(Opcode.DATA_END)), has_right_crcs=False), None),
    "some-crc": (operated(uncovered(every=False), has_right_crcs=False), {"some-crc", "no-crc"}),
    "no-crc, summary": (operated(put(Opcode.FOOTER, 16, "<I", 0), has_right_crcs=False), {"no-crc"}),
    "schema-id": (operated(at_top(Schema(id=0, name="x", encoding="x", data=b"x"))), {"schema-id", "statistics"}),
    "schema-encoding": (
        operated(at_top(Schema(id=7, name="x", encoding="", data=b"x"))),
        {"schema-encoding", "statistics"},
    ),
    "empty-schema": (operated(at_top(Schema(id=7, name="x", encoding="", data=b""))), {"empty-schema", "statistics"}),
    "redefinition": (
        operated(at_top(Schema(id=1, name="x", encoding="ros2msg", data=SCHEMA.data))),
        {"redefinition", "duplicate"},
    ),
    "redefinition, channel": (
        operated(before(Opcode.DATA_END, new(Channel(1, "/z", "cdr", CHANNEL.metadata, 1)))),
        {"redefinition", "duplicate"},
    ),
    "duplicate": (operated(before(Opcode.DATA_END, new(CHANNEL))), {"duplicate"}),
    "undefined-schema": (
        operated(before(Opcode.DATA_END, new(Channel(9, "/z", "cdr", {}, 77)))),
        {"undefined-schema", "statistics", "summary-channels"},
    ),
    "undefined-channel": (
        operated(before(Opcode.CHUNK, Part(Opcode.MESSAGE, MESSAGE))),
        {"undefined-channel", "statistics", "unindexed-messages", "counts"},
    ),
    "summary-only": (
        operated(
            both(
                before(Opcode.DATA_END, Part(Opcode.MESSAGE, message(9, 9_000_000, payload(0))[9:])),
                before(Opcode.STATISTICS, new(Channel(9, "/z", "cdr", {}, 1))),
            )
        ),
        None,
    ),
    "unused-summary-only": (
        operated(before(Opcode.STATISTICS, new(Channel(9, "/z", "cdr", {}, 1)))),
        {"unused-summary-only", "summary-offset"},
    ),
    "unused-summary-only, no message": (
        make_log(chunks=(), summary={**SUMMARY, "messages": "0"}),
        {"unused-summary-only"},
    ),
    "chunk-record": (operated(chunk_with(new(Header("", "x")).data)), {"chunk-record", "chunk-index"}),
    "chunk-record, rest": (operated(chunk_with(b"rest of a record")), {"chunk-record", "chunk-index"}),
    "chunk-times": (operated(put(Opcode.CHUNK, 0, "<Q", 1)), {"chunk-times", "chunk-index"}),
    "chunk-times, end": (operated(put(Opcode.CHUNK, 8, "<Q", 1)), {"chunk-times", "chunk-index"}),
    "chunk-size": (operated(put(Opcode.CHUNK, 16, "<Q", 1000)), {"chunk-size", "chunk-index"}),
    "message-index": (operated(put(Opcode.MESSAGE_INDEX, HEAD_OF_INDEX, "<Q", 3)), {"message-index"}),
    "message-index, offset": (operated(put(Opcode.MESSAGE_INDEX, HEAD_OF_INDEX + 8, "<Q", 3)), {"message-index"}),
    "message-index, one gone": (operated(without(Opcode.MESSAGE_INDEX, 1)), {"message-index", "chunk-index"}),
    "no-message-index": (operated(without(Opcode.MESSAGE_INDEX, 2)), {"no-message-index", "chunk-index"}),
    "unindexed-messages": (
        operated(before(Opcode.DATA_END, Part(Opcode.MESSAGE, message(1, 9_000_000, payload(0))[9:]))),
        {"unindexed-messages", "statistics", "counts"},
    ),
    "chunk-index": (operated(put(Opcode.CHUNK_INDEX, 24, "<Q", 5)), {"chunk-index"}),
    "chunk-index, offsets": (operated(put(Opcode.CHUNK_INDEX, 38, "<Q", 5)), {"chunk-index"}),
    "chunk-index, one gone": (operated(without(Opcode.CHUNK_INDEX, 1)), {"chunk-index", "summary-offset"}),
    "chunk-index, twice": (operated(twice_indexed), {"chunk-index", "summary-offset"}),
    "no-chunk-index": (operated(without(Opcode.CHUNK_INDEX)), {"no-chunk-index", "summary-offset"}),
    "summary-channels": (operated(without_channel_of_summary), {"summary-channels", "summary-offset"}),
    "attachment-index": (operated(put(Opcode.ATTACHMENT_INDEX, 32, "<Q", 5)), {"attachment-index"}),
    "attachment-index, one gone": (
        operated(without(Opcode.ATTACHMENT_INDEX, 1)),
        {"attachment-index", "summary-offset"},
    ),
    "metadata-index": (operated(put(Opcode.METADATA_INDEX, 8, "<Q", 5)), {"metadata-index"}),
    "summary-offset": (operated(put(Opcode.SUMMARY_OFFSET, 9, "<Q", 5)), {"summary-offset"}),
    "statistics": (operated(put(Opcode.STATISTICS, 0, "<Q", 5)), {"statistics"}),
    "statistics, two": (operated(another(Opcode.STATISTICS)), {"statistics", "summary-offset"}),
    "statistics, start": (operated(put(Opcode.STATISTICS, 26, "<Q", 5)), {"statistics"}),
    "statistics, of a channel": (operated(put(Opcode.STATISTICS, 48, "<Q", 5)), {"statistics"}),
    "order": (make_log(times=lambda number: (10**9 - number, number)), {"order"}),
    "schema-text": (make_log(text=TYPE.text.replace("float64 value", "float65 value")), {"schema-text"}),
    "cdr": (make_log(make_payload=lambda number: payload(number) + b"x"), {"cdr"}),
    "cdr, head": (make_log(make_payload=lambda number: b"\1" + payload(number)[1:]), {"cdr"}),
    "counts": (make_log(summary={**SUMMARY, "messages": "21"}), {"counts"}),
    "counts, frames": (make_log(summary={**SUMMARY, "frames": "21"}), {"counts"}),
    "ending": (make_log(summary={**SUMMARY, "ending": "control process died"}), {"ending"}),
    "ending, none": (make_log(summary=None), {"ending"}),
    "dropped": (make_log(summary={**SUMMARY, "dropped": "3"}), {"dropped"}),
    "lost": (make_log(summary={**SUMMARY, "ending": "recovered", "lost": "the end"}), {"lost"}),
}


def check(path, data):
    path.write_bytes(data)
    return check_log(path)


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_rule_is_found_with_its_severity(name, tmp_path):
    data, expected = BROKEN[name]
    found = check(tmp_path / "log.mcap", data)
    rules = {finding.rule for finding in found.findings}
    assert name.split(",")[0].removesuffix(" at the start") in rules, found.findings
    if expected is not None:
        assert rules == expected, found.findings
    severities = {RULES[rule] for rule in rules}
    assert (found.errors > 0, found.warnings > 0) == ("error" in severities, "warning" in severities)


def test_every_rule_is_broken_by_a_file():
    named = {name.split(",")[0].removesuffix(" at the start") for name in BROKEN}
    assert set(RULES) - named == {"missing-part", "foreign-part"}


SOUND = {
    "as it was written": WHOLE,
    # mcap's writer in C++, rosbag2's, takes 0 for no time yet
    "statistics that begin later than zero": operated(put(Opcode.STATISTICS, 26, "<Q", 1_000_000)),
    "no CRC of a chunk": operated(put(Opcode.CHUNK, 24, "<I", 0)),
    "no CRC of the data section": operated(put(Opcode.DATA_END, 0, "<I", 0), has_right_crcs=False),
}


@pytest.mark.parametrize("data", SOUND.values(), ids=SOUND)
def test_a_sound_log_breaks_no_rule(data, tmp_path):
    """One CRC is enough to vouch for the messages."""
    found = check(tmp_path / "log.mcap", data)
    assert (found.findings, found.files, found.messages) == ([], 1, 20)


@pytest.mark.parametrize("compression", CompressionType)
def test_what_mcaps_own_writer_makes_breaks_no_rule(compression, tmp_path):
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file, compression=compression, enable_crcs=True, enable_data_crcs=True)
        writer.start("ros2", "somebody")
        schema = writer.register_schema("x/msg/X", "ros2msg", b"string[<=3] names\nuint8 A=1\nfloat32 x 1.5\n")
        channel = writer.register_channel("/x", "cdr", schema)
        for number in range(3):
            writer.add_message(channel, number, b"\0\1\0\0" + bytes(number), 0)
        writer.add_attachment(0, 0, "notes.txt", "text/plain", b"notes")
        writer.finish()
    assert check_log(tmp_path / "log.mcap").findings == []


def test_messages_in_a_row_outside_of_chunks_are_checked_together_up_to_the_next_record(tmp_path):
    """One by one, those of a log of 10 s took a minute."""
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file, use_chunking=False, enable_data_crcs=True)
        writer.start("ros2", "somebody")
        schema = writer.register_schema("x/msg/X", "ros2msg", b"uint8 x\n")
        for topic in ("/x", "/y"):
            channel = writer.register_channel(topic, "cdr", schema)
            for t_ns in (9, 8, 7):
                writer.add_message(channel, t_ns, b"\0\1\0\0x", 0)
        writer.finish()
    found = check_log(tmp_path / "log.mcap")
    back = "2 messages are earlier than the one before in their channel, the first on"
    assert [finding.text for finding in found.findings] == [f"{back} /x by 1 ns", f"{back} /y by 1 ns"]
    places = [finding.offset for finding in found.findings]
    assert places == sorted(set(places))
    assert found.messages == 6


def test_many_findings_of_one_rule_are_counted_and_ten_told(tmp_path):
    data = make_log(chunks=[(number, number + 1) for number in range(30)], make_payload=lambda number: b"")
    found = check(tmp_path / "log.mcap", data)
    assert [finding.rule for finding in found.findings].count("cdr") == 10
    assert found.errors == 31  # and `counts`


def test_a_finding_says_where(tmp_path):
    data = operated(put(Opcode.CHUNK, 24, "<I", 5))
    finding = check(tmp_path / "log.mcap", data).findings[0]
    assert (finding.file, finding.rule) == ("log.mcap", "chunk-crc")
    assert data[finding.offset] == Opcode.CHUNK


@pytest.mark.parametrize(
    ("endings", "text"),
    [
        (["continued", None, "closed"], "run_001.mcap is missing"),
        ([None, "closed"], "run.mcap is missing"),
        (["continued", "continued"], "run_002.mcap is missing: the part before says it follows"),
    ],
)
def test_a_missing_part_is_an_error(endings, text, tmp_path):
    found = check_log(write_parts(tmp_path, endings))
    assert [(finding.rule, finding.text) for finding in found.findings] == [("missing-part", text)]


def test_whole_parts_are_one_sound_log(tmp_path):
    found = check_log(write_parts(tmp_path, ["continued", "continued", "closed"]))
    assert (found.findings, found.files, found.messages) == ([], 3, 60)


def test_a_part_of_another_run_is_an_error(tmp_path):
    found = check_log(write_parts(tmp_path, ["continued", "closed"], [RUN, {**RUN, "name": "other"}]))
    assert [finding.text for finding in found.findings] == ["run_001.mcap is of another run: name differ"]


def test_a_part_alone_is_said_to_be_one(tmp_path):
    write_parts(tmp_path, ["continued", "closed"])
    found = check_log(tmp_path / "run_001.mcap")
    assert [finding.text for finding in found.findings] == ["run_001.mcap is part 1 of a log"]


def test_a_folder_stands_for_its_logs_without_their_later_parts(tmp_path):
    (tmp_path / "deep").mkdir()
    path = write_parts(tmp_path, ["continued", "closed"])
    (tmp_path / "deep" / "other.mcap").write_bytes(WHOLE)
    assert find_logs(tmp_path) == [tmp_path / "deep" / "other.mcap", path]
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match=f"^folder {tmp_path / 'empty'} has no .mcap file$"):
        find_logs(tmp_path / "empty")


def test_a_file_of_something_else_is_told_and_raises_nothing(tmp_path):
    for data in (b"", b"x", b"hello, this is text\n" * 1000, bytes(5000)):
        rules = {finding.rule for finding in check(tmp_path / "notes.txt", data).findings}
        assert {"magic", "header", "data-end", "footer"} <= rules


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (b"\xff", "is not UTF-8"),
        (b"float64 x\nno\n", "the type: no field: 'no'"),
        (b"pkg/Other x\n", "the type: unknown type pkg/Other"),
        (b"Time stamp\n", "the type: unknown type Time"),
        (b"uint8 A=\n", "the type: no constant: 'uint8 A='"),
        (b"uint8 x\n" + b"=" * 80 + b"\nuint8 y\n", "a type has no name: 'uint8 y'"),
        (b"pkg/Y y\n" + b"=" * 80 + b"\nMSG: pkg/Y\nbad\n", "pkg/Y: no field: 'bad'"),
        (b"pkg/msg/Y[<=3] y  # c\nstring<=5 s\nuint8 A=1\n\n# c\n" + b"=" * 80 + b"\nMSG: pkg/Y\nbool[] b true\n", ""),
        (b"ServiceEventInfo e\n---\nint64 a\n" + b"=" * 80 + b"\nMSG: x/ServiceEventInfo\nbyte a\n", ""),
        (b"Y y\n" + b"=" * 80 + b"\nMSG: pkg/Y\nfloat32 x 1.5\n", ""),
    ],
)
def test_the_text_of_a_schema_is_read_as_ros_would(text, problem):
    assert text_problem(text) == problem
