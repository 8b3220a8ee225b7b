"""The file behind a thread: order, position and failure."""

import os

from made_log import disk_full_at

from adacd_hil.log.recording.log_file import Sink


def test_a_settled_sink_knows_whether_writing_failed():
    sink = Sink(os.open("/dev/full", os.O_WRONLY))
    sink.write(b"data")
    sink.settle()
    assert sink.error == "No space left on device after 0 bytes"
    sink.write(b"more")
    sink.close_file()
    assert sink.tell() == 8


def test_a_file_that_can_not_be_closed_is_reported(tmp_path):
    descriptor = os.open(tmp_path / "file", os.O_WRONLY | os.O_CREAT)
    sink = Sink(descriptor)
    sink.write(b"data")
    sink.settle()
    os.close(descriptor)
    sink.close_file()
    assert sink.error == "Bad file descriptor after 4 bytes"


def test_a_failure_ends_the_file_at_the_last_whole_write_though_there_is_room_again(tmp_path):
    path = tmp_path / "file"
    sink = Sink(os.open(path, os.O_WRONLY | os.O_CREAT))
    with disk_full_at(150):
        sink.write(b"a" * 100)
        sink.write(b"b" * 100)
        sink.settle()
    sink.write(b"c")
    sink.close_file()
    assert sink.error == "File too large after 100 bytes"
    assert path.read_bytes() == b"a" * 100
