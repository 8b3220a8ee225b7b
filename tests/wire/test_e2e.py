"""End-to-end protection: against cantools' independent implementation, and what the receiver accepts."""

import pytest
from cantools.autosar.end_to_end import compute_profile2_crc
from hypothesis import given
from hypothesis import strategies as st

from adacd_hil.wire.e2e import E2eReceiver, E2eSender, E2eStatus, crc8

DATA_IDS = bytes(range(10, 26))


def frames(count: int) -> list[bytes]:
    sender = E2eSender(DATA_IDS)
    return [sender.protect(bytearray((0, 0, index, 2, 3, 4))) for index in range(count)]


@given(payload=st.binary(min_size=2, max_size=8), data_id=st.integers(0, 255))
def test_the_crc_equals_cantools(payload: bytes, data_id: int) -> None:
    assert crc8(payload, data_id) == compute_profile2_crc(payload, data_id)


def test_the_counter_runs_from_0_to_15_and_wraps() -> None:
    assert [frame[1] & 0x0F for frame in frames(18)] == [*range(16), 0, 1]


def test_the_status_nibble_passes_through() -> None:
    assert E2eSender(DATA_IDS).protect(bytearray((0, 0x50, 1)))[1] & 0xF0 == 0x50


def test_an_unbroken_sequence_is_ok() -> None:
    receiver = E2eReceiver(DATA_IDS)
    assert {receiver.check(frame) for frame in frames(40)} == {E2eStatus.OK}


@pytest.mark.parametrize(
    ("lost", "status"),
    [(0, E2eStatus.OK), (1, E2eStatus.OK_SOME_LOST), (2, E2eStatus.OK_SOME_LOST), (3, E2eStatus.WRONG_SEQUENCE)],
)
def test_losses_are_tolerated_up_to_a_step_of_three(lost: int, status: E2eStatus) -> None:
    receiver = E2eReceiver(DATA_IDS)
    sent = frames(8)
    receiver.check(sent[0])
    assert receiver.check(sent[1 + lost]) is status


def test_after_a_wrong_sequence_the_next_frame_is_ok() -> None:
    receiver = E2eReceiver(DATA_IDS)
    sent = frames(10)
    receiver.check(sent[0])
    receiver.check(sent[7])
    assert receiver.check(sent[8]) is E2eStatus.OK


def test_a_repeated_frame_is_not_valid() -> None:
    receiver = E2eReceiver(DATA_IDS)
    frame = frames(1)[0]
    receiver.check(frame)
    assert receiver.check(frame) is E2eStatus.REPEATED


@given(bit=st.integers(0, 47), index=st.integers(0, 15))
def test_every_flipped_bit_is_found(bit: int, index: int) -> None:
    frame = bytearray(frames(16)[index])
    frame[bit // 8] ^= 1 << bit % 8
    assert E2eReceiver(DATA_IDS).check(bytes(frame)) is E2eStatus.WRONG_CRC


def test_a_frame_of_another_message_is_not_taken() -> None:
    other = E2eReceiver(bytes(range(100, 116)))
    assert other.check(frames(1)[0]) is E2eStatus.WRONG_CRC


def test_every_check_is_counted() -> None:
    receiver = E2eReceiver(DATA_IDS)
    sent = frames(6)
    for frame in (sent[0], sent[1], sent[1], sent[5], bytes(6)):
        receiver.check(frame)
    assert receiver.counts == [2, 0, 1, 1, 1]


def test_a_restart_forgets_the_sequence() -> None:
    receiver = E2eReceiver(DATA_IDS)
    sent = frames(9)
    receiver.check(sent[0])
    receiver.restart()
    assert receiver.check(sent[8]) is E2eStatus.OK


@pytest.mark.parametrize(
    ("status", "is_valid"),
    [
        (E2eStatus.OK, True),
        (E2eStatus.OK_SOME_LOST, True),
        (E2eStatus.REPEATED, False),
        (E2eStatus.WRONG_SEQUENCE, False),
        (E2eStatus.WRONG_CRC, False),
    ],
)
def test_only_ok_frames_may_be_used(status: E2eStatus, is_valid: bool) -> None:
    assert status.is_valid is is_valid
