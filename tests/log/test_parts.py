"""A log in parts: each is a file of its own, and together they are the log that one file would have been."""

import shutil

import numpy as np
import pytest
from made_log import read_by_mcap
from mcap.reader import make_reader
from recorded_run import feed, make_run, payloads, record, start
from topic_bytes import topic_bytes

from adacd_hil.lab.logs.check.log_check import check_log
from adacd_hil.log.log_files import LogError, LogExistsError, find_parts, part_path
from adacd_hil.log.reader import read_log
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.settings.run_settings import LogSettings

pytestmark = pytest.mark.slow  # each log starts a process

BY_SIZE = LogSettings(part_MiB=1, part_min=0.0)
COUNT = 1800


@pytest.fixture(scope="module")
def run():
    return make_run(COUNT)


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    record(path, run, settings=LogSettings(part_MiB=0, part_min=0.0))
    return read_log(path)


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("parts") / "run.mcap"
    return path, record(path, run, settings=BY_SIZE)


@pytest.fixture
def log_path(recorded, tmp_path):
    """A copy to spoil."""
    shutil.copytree(recorded[0].parent, tmp_path / "copy")
    return tmp_path / "copy" / "run.mcap"


def assert_same_log(log, whole):
    assert log.problem == ""
    assert log.is_complete
    assert log.metadata == whole.metadata
    assert log.summary == whole.summary
    assert log.attachments == whole.attachments
    assert log.topics.keys() == whole.topics.keys()
    for topic, series in whole.topics.items():
        assert payloads(log.topics[topic]) == payloads(series), topic
    assert log.frames.tobytes() == whole.frames.tobytes()
    assert log.events == whole.events
    assert log.contacts == whole.contacts


def test_the_parts_together_are_the_log_that_one_file_would_have_been(recorded, whole):
    path, summary = recorded
    log = read_log(path)
    assert [part.name for part in find_parts(path).values()] == ["run.mcap", "run_001.mcap", "run_002.mcap"]
    assert summary.parts == 3
    assert (summary.frames, summary.dropped, summary.is_complete) == (int(whole.summary["frames"]), 0, True)
    assert len(find_parts(whole.path)) == 1
    assert_same_log(log, whole)
    assert check_log(path).findings == []
    assert [metadata_of(part) for part in find_parts(path).values()] == [
        (list(whole.attachments), str(number), ending)
        for number, ending in enumerate(("continued", "continued", "closed"))
    ]
    assert topic_bytes(path, "/events") == topic_bytes(whole.path, "/events")


def metadata_of(part):
    """What others find in a part by itself: names of attachments, its number, and how it ended."""
    _, attachments, metadata = read_by_mcap(part)
    return list(attachments), metadata["run"]["part"], metadata["summary"]["ending"]


def test_a_part_ends_after_its_size_before_compression_with_a_chunk(recorded):
    for part in list(find_parts(recorded[0]).values())[:-1]:
        with part.open("rb") as file:
            chunks = make_reader(file).get_summary().chunk_indexes
        size = sum(chunk.uncompressed_size for chunk in chunks)
        assert 2**20 <= size < 2**20 + 600_000  # a quarter of a second more


def test_a_part_ends_by_log_time(run, whole, tmp_path):
    path = tmp_path / "run.mcap"
    record(path, run, settings=LogSettings(part_MiB=0, part_min=0.4 / 60.0))
    assert_same_log(read_log(path), whole)
    starts_ns = [read_one(part).scheme.t_ns[0] for part in find_parts(path).values()]
    assert np.diff(starts_ns).tolist() == [500_000_000] * 3


def read_one(part):
    """Read a part by itself."""
    copy = part.parent / f"{part.stem}_alone" / "run.mcap"
    copy.parent.mkdir()
    return read_log(shutil.copy(part, copy))


@pytest.mark.parametrize("name", ["run_001.mcap", "run_1000.mcap"])
def test_where_parts_of_another_log_are_no_log_begins(name, tmp_path):
    (tmp_path / name).write_bytes(b"yesterday")
    with pytest.raises(LogExistsError, match=f"{name} is there already; choose another folder"):
        Recorder(tmp_path / "run.mcap")
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [(name, b"yesterday")]


def test_what_is_no_part_of_a_log_is_left_alone_beside_it(tmp_path):
    keep = ["run_1.mcap", "run_abc.mcap", "walk_001.mcap", "run_001.txt", "run_001_001.mcap"]
    for name in keep:
        (tmp_path / name).touch()
    record(tmp_path / "run.mcap", make_run(3))
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(["run.mcap", *keep])
    assert read_log(tmp_path / "run.mcap").is_complete


def test_a_part_whose_name_is_taken_gets_the_next_one(run, whole, tmp_path):
    path = tmp_path / "run.mcap"
    recorder = start(path, run, settings=BY_SIZE)
    part_path(path, 1).symlink_to(tmp_path / "target")
    part_path(path, 3).write_bytes(b"somebody else's")
    feed(recorder, run.cycles)
    assert recorder.close().is_complete
    assert not (tmp_path / "target").exists()
    assert part_path(path, 3).read_bytes() == b"somebody else's"
    part_path(path, 3).unlink()
    log = read_log(path)
    assert log.problem == "run_001.mcap is missing; run_003.mcap is missing"
    assert payloads(log.scheme) == payloads(whole.scheme)


def times_of(path):
    return set(read_one(path).scheme.t_ns.tolist())


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_part_that_is_missing_costs_only_itself(number, log_path, whole):
    missing = times_of(part_path(log_path, number))
    part_path(log_path, number).unlink()
    log = read_log(log_path)
    assert log.problem == f"{part_path(log_path, number).name} is missing"
    assert not log.is_complete
    assert set(log.scheme.t_ns.tolist()) == set(whole.scheme.t_ns.tolist()) - missing
    assert log.attachments == whole.attachments


def test_a_part_that_is_not_mcap_is_left_out(log_path):
    part_path(log_path, 1).write_text("notes")
    log = read_log(log_path)
    assert log.problem == f"{part_path(log_path, 1)} is not an MCAP file"
    assert 0 < len(log.scheme) < COUNT


def test_a_part_of_another_log_is_not_taken_for_ours(log_path, tmp_path):
    other = make_run(5)
    other.metadata = {"interface": "another"}
    record(tmp_path / "other.mcap", other)
    shutil.copy(tmp_path / "other.mcap", part_path(log_path, 1))
    shutil.copy(tmp_path / "other.mcap", part_path(log_path, 900))
    log = read_log(log_path)
    assert log.problem == (
        "run_001.mcap is a part of another log; run_003.mcap to run_899.mcap are missing; "
        "run_900.mcap is a part of another log"
    )
    assert not log.is_complete


def test_parts_that_are_all_of_another_log_are_refused(log_path):
    parts = list(find_parts(log_path).values())
    contents = [part.read_bytes() for part in parts]
    for part, content in zip(parts, [*contents[1:], contents[0]], strict=True):
        part.write_bytes(content)
    with pytest.raises(LogError, match=r"run\.mcap is a part of another log.*run_002\.mcap is a part"):
        read_log(log_path)


def test_a_part_by_itself_says_that_it_is_one(log_path):
    log = read_log(part_path(log_path, 1))
    assert log.problem == "run_001.mcap is part 1 of a log"
    assert len(log.scheme) > 0
