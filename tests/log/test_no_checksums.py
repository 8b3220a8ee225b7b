"""MCAP files without checksums, as many recorders write them, are whole: counted, read, recovered."""

import io
import struct
from itertools import product

import pytest
from click.testing import CliRunner
from made_log import HEAD, kinds, take_apart
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

from adacd_hil.lab.cli.log_command import check, info_as_text, recovery_as_text
from adacd_hil.lab.logs.check.log_check import check_log
from adacd_hil.lab.logs.log_info import read_info
from adacd_hil.lab.logs.recover import recover
from adacd_hil.log.frames.frame_log import read_frames
from adacd_hil.log.reader import read_log
from adacd_hil.log.types.message_types import CAN_FRAME, pack_can_frame

COUNT = 60
NOTES = b"ends in zeros\0\0\0\0\0"


def make(compression=CompressionType.NONE, tail="", **options):
    """Write frames with mcap's writer, without any CRC unless asked for; `tail` says what the summary lacks."""
    stream = io.BytesIO()
    options = {"enable_crcs": False, "enable_data_crcs": False, "chunk_size": 1000, **options}
    if tail == "statistics":
        options["use_statistics"] = False
    elif tail == "definitions":
        options |= {"repeat_channels": False, "repeat_schemas": False}
    elif tail == "all":
        options |= {"use_statistics": False, "repeat_channels": False, "repeat_schemas": False}
        options |= {"use_summary_offsets": False, "index_types": IndexType.NONE}
    writer = Writer(stream, compression=compression, **options)
    writer.start("ros2", "a recorder")
    schema = writer.register_schema(CAN_FRAME.name, "ros2msg", CAN_FRAME.text.encode())
    channel = writer.register_channel("/from_can_bus", "cdr", schema)
    writer.add_attachment(1, 1, "notes", "text/plain", NOTES)
    for number in range(COUNT):
        t_ns = 1_000_000 * (number + 1)
        writer.add_message(
            channel, t_ns, pack_can_frame(struct.pack("<II", 0, t_ns), 0x181, bytes([number] * 8), 8, False), t_ns
        )
    writer.finish()
    data = stream.getvalue()
    place = data.index(NOTES) + len(NOTES)  # mcap's writer can't leave out this CRC
    return data[:place] + (data[place : place + 4] if options["enable_crcs"] else bytes(4)) + data[place + 4 :]


KINDS = list(product(CompressionType, ("", "statistics", "definitions", "all"), (True, False)))


@pytest.mark.parametrize(("compression", "tail", "use_chunking"), KINDS)
def test_a_log_without_a_checksum_is_whole(compression, tail, use_chunking, tmp_path):
    path = tmp_path / "bag.mcap"
    path.write_bytes(make(compression, tail, use_chunking=use_chunking))
    info = read_info(path)
    assert (info.messages, info.problems, [topic.messages for topic in info.topics]) == (COUNT, [], [COUNT])
    assert info.attachments == {"notes": 18}
    frames = read_frames(path)
    assert (frames.frames["data"][:, 0].tolist(), frames.problem) == (list(range(COUNT)), "")
    assert read_log(path).problem == ""
    assert {finding.rule for finding in check_log(path).findings if finding.severity == "error"} <= {"summary-channels"}
    recovery = recover(path)
    assert (recovery.messages, recovery.attachments, recovery.losses.is_any) == (COUNT, 1, False)
    assert recovery.losses.unvouched == COUNT
    assert f"{COUNT} messages are unchecked" in recovery_as_text(recovery)
    assert "end" not in info_as_text(info).splitlines()[0]
    with recovery.out.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert [message.data[-8] for _, _, message in reader.iter_messages()] == list(range(COUNT))
        assert [item.data for item in reader.iter_attachments()] == [NOTES]


def test_a_sound_log_without_a_checksum_is_clean_and_one_note_says_so(tmp_path):
    (tmp_path / "bag.mcap").write_bytes(make())
    done = CliRunner().invoke(check, [str(tmp_path / "bag.mcap")])
    note, verdict = done.stdout.splitlines()
    assert (done.exit_code, ": clean;" in verdict) == (0, True)
    assert note.startswith("note: bag.mcap: nothing vouches")
    assert "5 chunks, the data section, the summary (no-crc)" in note


def streamed(data):
    """Count the messages that mcap's reader of streams gets, up to what it can't read."""
    count = 0
    try:
        for record in StreamReader(io.BytesIO(data)).records:
            count += isinstance(record, Message)
    except (McapError, EOFError, ValueError, struct.error):
        pass
    return count


@pytest.mark.parametrize("use_chunking", [True, False])
@pytest.mark.parametrize("compression", CompressionType)
def test_of_a_cut_log_without_a_checksum_all_is_saved_that_a_reader_of_streams_gets(
    compression, use_chunking, tmp_path
):
    path = tmp_path / "bag.mcap"
    whole = make(compression, use_chunking=use_chunking)
    for length in range(900, whole.rindex(b"ends in zeros") + len(whole) * 2 // 3, 397):
        path.write_bytes(whole[:length])
        recovery = recover(path)
        assert recovery.messages == recovery.losses.unvouched == streamed(whole[:length]), length
        assert recovery.losses.is_any
        assert read_info(path).problems


def test_where_one_record_has_a_checksum_those_without_are_not_trusted(tmp_path):
    path = tmp_path / "bag.mcap"
    checked = make(enable_crcs=True)
    path.write_bytes(checked[: len(checked) // 2].replace(b"\x07\x07\x07", b"\x07\x08\x07", 1))
    recovery = recover(path)
    assert recovery.losses.unvouched == 0
    assert recovery.losses.chunks == 1


NAME = 4
"""Bytes of the name of a compression, which is zstd."""


def damaged(data, number, change):
    """Change the contents of a chunk; `change` gets where they begin."""
    chunk = kinds(take_apart(data), Opcode.CHUNK)[number]
    changed = bytearray(data)
    change(changed, chunk.offset + HEAD.size + len(chunk.body) - struct.unpack_from("<Q", chunk.body, 32 + NAME)[0])
    return bytes(changed)


def test_a_chunk_that_does_not_open_costs_only_itself_and_the_statistics_say_how_much(tmp_path):
    path = tmp_path / "bag.mcap"

    def spoil(data, start):
        data[start : start + 4] = bytes(4)

    path.write_bytes(damaged(make(CompressionType.ZSTD), 2, spoil))
    recovery = recover(path)
    assert recovery.losses.chunks == 1
    assert recovery.losses.messages == COUNT - recovery.messages > 0
    assert recovery.losses.unvouched == recovery.messages


def test_of_a_chunk_without_checksum_that_is_no_row_of_messages_nothing_is_saved(tmp_path):
    path = tmp_path / "bag.mcap"
    whole = make()
    second = kinds(take_apart(whole), Opcode.CHUNK)[1]
    place = whole.index(bytes([Opcode.MESSAGE]), second.offset + HEAD.size + 40)
    path.write_bytes(whole[: place + 4] + b"\xff" + whole[place + 5 :])
    recovery = recover(path)
    assert (recovery.losses.chunks, recovery.losses.messages) == (1, COUNT - recovery.messages)
