"""Stretches of logs: the same messages, whole cycles, nothing out of order."""

import pytest
from made_log import (
    ATTACHMENTS,
    MILLISECOND,
    RUN,
    SUMMARY,
    kinds,
    make_log,
    put_together,
    read_by_mcap,
    take_apart,
    write_parts,
)
from mcap.opcode import Opcode
from mcap.reader import make_reader

from adacd_hil.lab.logs.check.log_check import check_log
from adacd_hil.lab.logs.cut import TimeWindow, cut, find_contact
from adacd_hil.log.log_files import LogError
from adacd_hil.log.reader import each_once, read_log
from adacd_hil.records import ContactReport

INFINITE = float("inf")
CYCLES = 300
LATE_NS = 5_000_000_000


def write(path, **options):
    path.parent.mkdir(exist_ok=True, parents=True)
    path.write_bytes(make_log(**options))
    return path


def frame_times(number):
    """A message logged before its cycle, as a frame is that was stamped late."""
    return number * MILLISECOND + LATE_NS - 300_000, number * MILLISECOND + LATE_NS


@pytest.fixture
def log_path(tmp_path):
    chunks = tuple((start, start + 50) for start in range(0, CYCLES, 50))
    summary = {**SUMMARY, "messages": str(2 * CYCLES), "dropped": "2"}
    return write(tmp_path / "run.mcap", chunks=chunks, times=frame_times, summary=summary)


@pytest.mark.parametrize("name", ["bus.log", "arm.toml", "bus.blf"])
def test_what_no_log_command_has_made_is_not_replaced(log_path, tmp_path, name):
    (tmp_path / name).write_text("(1.0) can0 123#00\n")
    with pytest.raises(LogError, match="is no result of these commands"):
        cut(log_path, tmp_path / name, TimeWindow(0.040, 0.1205))
    assert (tmp_path / name).read_text() == "(1.0) can0 123#00\n"
    for _ in range(2):  # a result is
        cut(log_path, tmp_path / "out.mcap", TimeWindow(0.040, 0.1205))


def test_a_result_is_not_named_like_a_part_of_the_log_beside_it(log_path, tmp_path):
    with pytest.raises(LogError, match="would be taken for a part of the log beside it"):
        cut(log_path, tmp_path / "run_001.mcap", TimeWindow(0.040, 0.1205))
    cut(log_path, tmp_path / "other_001.mcap", TimeWindow(0.040, 0.1205))


def test_a_stretch_has_its_cycles_whole_and_all_that_explains_them(log_path, tmp_path):
    out = tmp_path / "out.mcap"
    done = cut(log_path, out, TimeWindow(0.040, 0.1205))
    messages, attachments, metadata = read_by_mcap(out)
    assert messages == [
        message for message in read_by_mcap(log_path)[0] if 40 <= (message[2] - LATE_NS) / MILLISECOND <= 120
    ]
    assert done == len(messages) == 2 * 81
    assert (attachments, metadata["run"]) == (ATTACHMENTS, RUN)
    assert metadata["summary"] == {
        "frames": "0",
        "messages": "162",
        "dropped": "2",
        "ending": "cut",
        "source": "run.mcap",
        "from_s": "0.04",
        "until_s": "0.1205",
    }
    assert {finding.rule for finding in check_log(out).findings} == {"dropped"}


def test_an_open_end_takes_the_rest(log_path, tmp_path):
    assert cut(log_path, tmp_path / "all.mcap", TimeWindow(-INFINITE, INFINITE)) == 2 * CYCLES
    assert cut(log_path, tmp_path / "end.mcap", TimeWindow(0.290, INFINITE)) == 20
    assert cut(log_path, tmp_path / "start.mcap", TimeWindow(-INFINITE, 0.010)) == 20


def test_only_the_asked_topics_are_taken(log_path, tmp_path):
    out = tmp_path / "out.mcap"
    cut(log_path, out, TimeWindow(0.0, 0.1), topics=("/b",))
    assert {topic for topic, *_ in read_by_mcap(out)[0]} == {"/b"}
    with out.open("rb") as file:
        assert [channel.topic for channel in make_reader(file).get_summary().channels.values()] == ["/b"]


@pytest.mark.parametrize(
    ("stretch", "topics", "text"),
    [
        (TimeWindow(7.0, 8.0), (), "has no message from 7 to 8 s"),
        (TimeWindow(0.0, 1.0), ("/c",), "has no topic /c; it has /a, /b"),
    ],
)
def test_a_stretch_of_nothing_is_an_error_and_leaves_no_file(stretch, topics, text, log_path, tmp_path):
    with pytest.raises(LogError, match=text):
        cut(log_path, tmp_path / "out.mcap", stretch, topics)
    assert list(tmp_path.iterdir()) == [log_path]


def test_of_a_strangers_log_messages_are_taken_by_log_time(tmp_path):
    log = write(tmp_path / "x.mcap", run=None, summary=None, times=lambda number: (number * MILLISECOND, 0))
    out = tmp_path / "out.mcap"
    assert cut(log, out, TimeWindow(0.002, 0.004)) == 4


def spoil_chunk(data):
    chunk = kinds(take_apart(data), Opcode.CHUNK)[-1]
    return data[: chunk.offset + 60] + b"\xff" + data[chunk.offset + 61 :]


def without_crc(data):
    """A log whose data section has no CRC, as others write them."""
    parts = take_apart(data)
    for part in kinds(parts, Opcode.DATA_END):
        part.put(0, "<I", 0)
    return put_together(parts, has_right_crcs=False)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda data: data[: len(data) // 2], r"byte \d+, \d+ bytes: no record"),
        (lambda data: data.replace("Prüfung".encode(), "Trüfung".encode()), "fails the CRC of the whole"),
        (lambda data: spoil_chunk(without_crc(data)), r"byte \d+, \d+ bytes: "),
        (lambda data: without_crc(data).replace(b"x = 1", b"x = 2"), r"byte \d+, \d+ bytes: attachment fails its CRC"),
    ],
)
def test_a_damaged_log_is_recovered_first(spoil, reason, log_path, tmp_path):
    log_path.write_bytes(spoil(log_path.read_bytes()))
    with pytest.raises(LogError, match=rf"^run\.mcap: {reason}.*: recover the log first"):
        cut(log_path, tmp_path / "out.mcap", TimeWindow(-INFINITE, INFINITE))
    assert list(tmp_path.iterdir()) == [log_path]


@pytest.mark.parametrize("spoil", [lambda data: data[:-1], without_crc])
def test_a_log_that_lacks_only_what_is_made_anew_or_crcs_is_cut(spoil, log_path, tmp_path):
    log_path.write_bytes(spoil(log_path.read_bytes()))
    assert cut(log_path, tmp_path / "out.mcap", TimeWindow(-INFINITE, INFINITE)) == 2 * CYCLES


def report(cycle, is_final):
    return cycle * MILLISECOND, ContactReport(cycle, 2, (1, 1), (0.0, 0.0), (0.0, 0.0), is_final)


def test_contacts_are_counted_by_the_cycle_that_they_began_in():
    reports = [
        report(3, False),
        report(3, False),
        report(3, True),
        report(9, False),
        report(20, False),
        report(20, True),
    ]
    assert [begun_ns for begun_ns, _ in each_once(reports)] == [3 * MILLISECOND, 9 * MILLISECOND, 20 * MILLISECOND]


def test_an_unknown_contact_is_an_error(log_path):
    with pytest.raises(LogError, match=r"has 0 contacts: there is no contact 1$"):
        find_contact(log_path, 1, 1.0)


def test_parts_are_one_log(tmp_path):
    path = write_parts(tmp_path, times=frame_times)
    whole = read_by_mcap(path)[0] + read_by_mcap(tmp_path / "run_001.mcap")[0]
    out = tmp_path / "cut.mcap"
    cut(path, out, TimeWindow(-INFINITE, INFINITE))
    messages, attachments, metadata = read_by_mcap(out)
    assert (messages, attachments, metadata["run"]) == (whole, ATTACHMENTS, RUN)
    assert check_log(out).findings == []
    assert read_log(out).problem == ""


def test_parts_that_are_missing_or_of_another_run_are_an_error(tmp_path):
    path = write_parts(tmp_path, times=frame_times)
    (tmp_path / "run_001.mcap").rename(tmp_path / "run_002.mcap")
    with pytest.raises(LogError, match=r"run\.mcap lacks run_001\.mcap: recover the log first"):
        cut(path, tmp_path / "out.mcap", TimeWindow(-INFINITE, INFINITE))
    (tmp_path / "run_002.mcap").unlink()
    write(tmp_path / "run_001.mcap", run={**RUN, "name": "other"})
    with pytest.raises(LogError, match=r"run\.mcap lacks run_001\.mcap \(of another run\): recover the log first"):
        cut(path, tmp_path / "out.mcap", TimeWindow(-INFINITE, INFINITE))
