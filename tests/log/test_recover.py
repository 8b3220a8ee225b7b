"""Recovered logs: everything intact is in them, nothing else is, and they say what was lost."""

import pytest
from damage_trials import make_undamaged, run_trial
from made_log import (
    ATTACHMENTS,
    RUN,
    SUMMARY,
    Part,
    flipped,
    kinds,
    make_log,
    message,
    new,
    payload,
    put_together,
    read_by_mcap,
    take_apart,
    write_parts,
)
from mcap.opcode import Opcode
from mcap.records import Metadata

from adacd_hil.lab.logs.check.log_check import check_log
from adacd_hil.lab.logs.log_info import read_info
from adacd_hil.lab.logs.recover import recover
from adacd_hil.log.log_files import LogError, find_parts
from adacd_hil.log.reader import read_log

CHUNKS = tuple((start, start + 3) for start in range(0, 12, 3))
COUNT = 24
THREE = ("continued", "continued", "closed")
WHOLE = make_log(chunks=CHUNKS, summary={**SUMMARY, "messages": str(COUNT)})


def recovered(tmp_path, data):
    path = tmp_path / "log.mcap"
    path.write_bytes(data)
    recovery = recover(path)
    assert path.read_bytes() == data
    assert check_log(recovery.out).errors == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == ["log.mcap", "log.recovered.mcap"]
    return recovery, *read_by_mcap(recovery.out)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "log.mcap"
    path.write_bytes(WHOLE)
    return read_by_mcap(path)


def test_of_an_undamaged_log_nothing_is_lost(whole, tmp_path):
    recovery, messages, attachments, metadata = recovered(tmp_path, WHOLE)
    assert (recovery.losses.is_any, recovery.losses.describe(), recovery.messages) == (False, "", COUNT)
    assert (messages, attachments) == whole[:2]
    assert metadata["run"] == RUN
    assert metadata["summary"] == {
        "frames": "0",
        "messages": str(COUNT),
        "dropped": "0",
        "ending": "recovered",
        "source": "log.mcap",
        "source_ending": "closed",
    }
    assert check_log(recovery.out).warnings == 0


def test_a_cut_log_keeps_every_whole_chunk_and_says_that_the_end_is_lost(whole, tmp_path):
    chunks = kinds(take_apart(WHOLE), Opcode.CHUNK)
    recovery, messages, attachments, metadata = recovered(tmp_path, WHOLE[: chunks[2].offset + 30])
    assert messages == whole[0][:12]
    assert attachments == ATTACHMENTS
    assert (recovery.losses.is_any, recovery.losses.is_cut, recovery.losses.messages) == (True, True, None)
    assert metadata["summary"]["lost"] == "the end, an unknown number of messages"
    assert metadata["summary"]["lost_messages"] == "unknown"
    assert read_log(recovery.out).problem == "recovered without the end, an unknown number of messages"
    assert [finding.rule for finding in check_log(recovery.out).findings] == ["lost"]


@pytest.mark.parametrize("more", [WHOLE, b"more"])
def test_bytes_behind_the_end_are_no_part_of_a_whole_log(more, whole, tmp_path):
    recovery, messages, _, _ = recovered(tmp_path, WHOLE + more)
    assert messages == whole[0]
    assert (recovery.losses.is_any, recovery.losses.bytes, recovery.losses.messages) == (True, len(more), None)
    path = tmp_path / "log.mcap"
    assert read_info(path).problems
    assert f"{len(more)} bytes" in read_log(path).problem
    assert [finding.rule for finding in check_log(path).findings] == ["magic"]


@pytest.mark.parametrize("number", range(len(CHUNKS)))
def test_a_damaged_chunk_costs_only_itself(number, whole, tmp_path):
    """Also the first, with all definitions: the summary has them too."""
    chunk = kinds(take_apart(WHOLE), Opcode.CHUNK)[number]
    data = flipped(WHOLE, chunk.offset + 9 + len(chunk.body) - 8)
    recovery, messages, _, metadata = recovered(tmp_path, data)
    assert messages == whole[0][: 6 * number] + whole[0][6 * number + 6 :]
    assert (recovery.losses.chunks, recovery.losses.messages) == (1, 6)
    assert metadata["summary"]["lost_messages"] == "6"
    assert len(recovery.losses.holes_s) == (number < len(CHUNKS) - 1)
    if number == 1:
        assert recovery.losses.holes_s[0] == pytest.approx(0.004)
        assert recovery.losses.describe() == "6 messages, 1 chunks, 0.004 s between what was saved"


def test_without_first_chunk_and_summary_no_message_is_saved(tmp_path):
    parts = take_apart(WHOLE)
    chunk = kinds(parts, Opcode.CHUNK)[0]
    data = flipped(flipped(WHOLE, chunk.offset + 60), len(WHOLE) - 20)
    recovery, messages, attachments, _ = recovered(tmp_path, data)
    assert (messages, attachments) == ([], ATTACHMENTS)
    assert recovery.losses.is_any


@pytest.mark.parametrize(("place", "bit"), [(1, 4), (1, 3), (8, 4)])
def test_records_are_found_again_behind_a_length_that_is_wrong(place, bit, whole, tmp_path):
    """Too small, too large, beyond the file, of the first message index; the chunk before and all behind are intact."""
    part = kinds(take_apart(WHOLE), Opcode.MESSAGE_INDEX)[0]
    recovery, messages, _, _ = recovered(tmp_path, flipped(WHOLE, part.offset + place, bit))
    assert messages == whole[0]
    assert not recovery.losses.is_any
    assert recovery.losses.bytes == 9 + len(part.body)


def test_nothing_is_lost_when_only_what_is_made_anew_is_damaged(whole, tmp_path):
    parts = take_apart(WHOLE)
    for opcode, place in (
        (Opcode.HEADER, 0),  # its opcode
        (Opcode.MESSAGE_INDEX, 20),
        (Opcode.CHUNK_INDEX, 20),
        (Opcode.STATISTICS, 20),
        (Opcode.DATA_END, 0),
        (Opcode.FOOTER, 0),
        (Opcode.CHUNK, 9),  # its start time
        (Opcode.CHUNK, 25),  # its size
    ):
        data = flipped(WHOLE, kinds(parts, opcode)[0].offset + place)
        recovery, messages, attachments, metadata = recovered(tmp_path, data)
        assert (messages, attachments, metadata["run"]) == (whole[0], ATTACHMENTS, RUN), opcode
        assert not recovery.losses.chunks, opcode
        if opcode not in (Opcode.STATISTICS, Opcode.FOOTER, Opcode.CHUNK_INDEX, Opcode.DATA_END):
            assert not recovery.losses.is_any, opcode
    for place in (0, len(WHOLE) - 1):
        assert recovered(tmp_path, flipped(WHOLE, place))[1] == whole[0]


def test_metadata_that_may_be_wrong_are_said(tmp_path):
    place = WHOLE.index("Prüfung".encode())
    recovery, _, _, metadata = recovered(tmp_path, flipped(WHOLE, place))
    assert metadata["run"]["name"] == "Qrüfung"
    assert (recovery.losses.is_any, recovery.losses.describe()) == (True, "metadata may be wrong")


IN_ATTACHMENT = WHOLE.index(b"x = 1")


@pytest.mark.parametrize(
    "data",
    [flipped(WHOLE, IN_ATTACHMENT), WHOLE[: IN_ATTACHMENT + 3] + bytes(7) + WHOLE[IN_ATTACHMENT + 10 :]],
    ids=["flipped", "its CRC is zeroed with it"],  # a CRC of 0 says that there is none
)
def test_a_damaged_attachment_is_left_out(data, tmp_path):
    recovery, messages, attachments, _ = recovered(tmp_path, data)
    assert attachments == {"arm.dbc": ATTACHMENTS["arm.dbc"]}
    assert (len(messages), recovery.losses.attachments) == (COUNT, 1)


def test_what_no_crc_vouches_for_is_saved_only_while_the_whole_fits_its_own(tmp_path):
    """Chunks without CRC, and messages outside of chunks."""
    parts = take_apart(WHOLE)
    for chunk in kinds(parts, Opcode.CHUNK):
        chunk.put(24, "<I", 0)
    end = parts.index(kinds(parts, Opcode.DATA_END)[0])
    parts.insert(end, Part(Opcode.MESSAGE, message(1, 10**9, payload(99))[9:]))
    data = put_together(parts)
    recovery, messages, _, _ = recovered(tmp_path, data)
    assert len(messages) == COUNT + 1
    recovery, messages, _, _ = recovered(tmp_path, flipped(data, data.index(b"x = 1")))
    assert messages == []
    assert recovery.losses.is_any


def test_an_index_that_looks_like_a_message_is_not_saved_as_one(whole, tmp_path):
    part = kinds(take_apart(WHOLE), Opcode.MESSAGE_INDEX)[0]
    assert part.opcode ^ 2 == Opcode.MESSAGE
    assert recovered(tmp_path, flipped(WHOLE, part.offset, 1))[1] == whole[0]


def test_other_metadata_come_along(tmp_path):
    parts = take_apart(WHOLE)
    parts.insert(3, new(Metadata("notes", {"a": "b"})))
    assert recovered(tmp_path, put_together(parts))[3]["notes"] == {"a": "b"}


def test_what_holds_nothing_is_an_error_and_leaves_no_file(tmp_path):
    path = tmp_path / "log.mcap"
    for data in (b"", WHOLE[:20], b"hello, this is text\n" * 1000, bytes(1000)):
        path.write_bytes(data)
        with pytest.raises(LogError, match=f"^{path}: nothing to save$"):
            recover(path)
        assert list(tmp_path.iterdir()) == [path]


def test_the_log_itself_is_not_overwritten(tmp_path):
    path = tmp_path / "log.mcap"
    path.write_bytes(WHOLE)
    with pytest.raises(LogError, match=f"^{path} is the log itself; --out names another file$"):
        recover(path, path)
    assert path.read_bytes() == WHOLE


def test_parts_become_one_log(tmp_path):
    recovery = recover(write_parts(tmp_path, THREE, summary={**SUMMARY, "dropped": "1"}))
    messages, attachments, metadata = read_by_mcap(recovery.out)
    assert (len(messages), attachments, recovery.losses.is_any) == (60, ATTACHMENTS, False)
    assert metadata["run"] == RUN
    assert metadata["summary"]["dropped"] == "3"
    log = read_log(recovery.out)
    assert (log.problem, len(find_parts(recovery.out))) == ("3 packets never reached the log", 1)


def test_parts_that_are_missing_or_of_another_run_cost_themselves(tmp_path):
    path = write_parts(tmp_path, ("continued", *THREE))
    (tmp_path / "run_001.mcap").unlink()
    (tmp_path / "run_003.mcap").unlink()
    (tmp_path / "run_002.mcap").write_bytes(make_log(run={**RUN, "part": "2", "name": "other"}))
    recovery = recover(path)
    assert recovery.losses.missing_parts == ["run_001.mcap", "run_002.mcap (of another run)"]
    assert recovery.losses.describe() == "run_001.mcap, run_002.mcap (of another run)"
    assert len(read_by_mcap(recovery.out)[0]) == 20
    write_parts(tmp_path, THREE)
    (tmp_path / "run_002.mcap").unlink()
    assert recover(path).losses.missing_parts == ["run_002.mcap"]


def test_a_part_whose_metadata_have_one_damaged_entry_is_still_of_the_run(tmp_path):
    path = write_parts(tmp_path)
    second = tmp_path / "run_001.mcap"
    second.write_bytes(flipped(second.read_bytes(), second.read_bytes().index("Prüfung".encode())))
    recovery = recover(path)
    assert recovery.messages == 40
    assert recovery.losses.describe() == "metadata may be wrong"


@pytest.mark.slow
def test_of_a_log_damaged_at_random_all_is_found_and_nothing_wrong_is_saved(tmp_path):
    undamaged = make_undamaged(tmp_path, cycles=60)
    results = [run_trial(undamaged, seed, tmp_path / "trial") for seed in range(15)]
    assert [result for result in results if result.violations] == []
    assert {result.exit_status for result in results} >= {0, 3}
