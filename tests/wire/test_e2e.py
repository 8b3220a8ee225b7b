"""End-to-end protection: the CRCs against the standard's examples and cantools, and what the receivers accept."""

from dataclasses import replace
from typing import NamedTuple

import pytest
from cantools.autosar.end_to_end import compute_profile2_crc, compute_profile5_crc
from hypothesis import given
from hypothesis import strategies as st

from adacd_hil.wire.e2e import (
    PROFILES,
    E2eProfile,
    E2eReceiver,
    E2eSender,
    E2eStatus,
    ProtectedReceiver,
    Protection,
    crc8,
    crc16,
)

P02, P05 = PROFILES[Protection.PROFILE_2], PROFILES[Protection.PROFILE_5]
DATA_IDS = bytes(range(10, 26))


class Profile(NamedTuple):
    """One profile with frames of one length."""

    profile: E2eProfile
    data_ids: bytes
    other_data_ids: bytes
    """Of another message of this length."""
    length: int
    counter_byte: int
    modulus: int

    def sender(self) -> E2eSender:
        return E2eSender(self.profile, self.data_ids)

    def receiver(self) -> E2eReceiver:
        return ProtectedReceiver(self.profile, self.data_ids, self.length)

    def stranger(self) -> E2eReceiver:
        return ProtectedReceiver(self.profile, self.other_data_ids, self.length)


def profile_2(length: int) -> Profile:
    return Profile(P02, DATA_IDS, bytes(range(100, 116)), length, counter_byte=1, modulus=16)


def profile_5(length: int) -> Profile:
    return Profile(P05, b"\x34\x12", b"\x34\x13", length, counter_byte=2, modulus=256)


BOTH = pytest.mark.parametrize("profile", [profile_2(6), profile_5(24)], ids=["P02", "P05"])


def frames(profile: Profile, count: int) -> list[bytes]:
    """Protect a row of frames; their payload is their number."""
    sender = profile.sender()
    empty = bytes(profile.length - 5)
    return [sender.protect(bytearray(4) + bytes([index % 256]) + empty) for index in range(count)]


@given(payload=st.binary(min_size=2, max_size=8), data_id=st.integers(0, 255))
def test_the_profile_2_crc_equals_cantools(payload: bytes, data_id: int) -> None:
    assert crc8(payload, 0, bytes([data_id])) == compute_profile2_crc(payload, data_id)


@given(payload=st.binary(min_size=4, max_size=64), data_id=st.integers(0, 0xFFFF))
def test_the_profile_5_crc_equals_cantools(payload: bytes, data_id: int) -> None:
    assert crc16(payload, 0, data_id.to_bytes(2, "little")) == compute_profile5_crc(payload, data_id)


def test_the_profile_5_example_of_the_standard_comes_out() -> None:
    # AUTOSAR FO PRS E2E Protocol, Profile 5 protocol examples, "short": data id 0x1234, counter 0, 8 bytes of zero
    assert E2eSender(P05, b"\x34\x12").protect(bytearray(8)).hex() == "1cca000000000000"


@pytest.mark.parametrize(
    ("sender", "sent"),
    [
        (E2eSender(P02, DATA_IDS), ["575001020304", "2c5101020304", "1d5201020304"]),
        (
            E2eSender(P05, b"\x34\x12"),
            ["cad60050010203040506070a", "bfd50150010203040506070a", "20d00250010203040506070a"],
        ),
    ],
    ids=["P02", "P05"],
)
def test_frames_worked_out_by_long_division_come_out(sender: E2eSender, sent: list[str]) -> None:
    status_and_payload = "0050" + sent[0][4:] if len(sent[0]) == 12 else "000000" + sent[0][6:]
    assert [sender.protect(bytearray.fromhex(status_and_payload)).hex() for _ in sent] == sent


@BOTH
def test_the_counter_begins_at_0_and_wraps(profile: Profile) -> None:
    sent = frames(profile, profile.modulus + 2)
    assert [frame[profile.counter_byte] for frame in sent] == [*range(profile.modulus), 0, 1]
    assert profile.receiver().counter_range == profile.modulus


@pytest.mark.parametrize(("profile", "largest"), [(profile_2(6), 3), (profile_5(24), 5)], ids=["P02", "P05"])
def test_the_largest_step_and_the_longest_silence_that_count_as_loss_and_what_confirms_a_sequence(
    profile: Profile, largest: int
) -> None:
    sent = frames(profile, 12)
    for step, status in ((largest, E2eStatus.OK_SOME_LOST), (largest + 1, E2eStatus.WRONG_SEQUENCE)):
        receiver = profile.receiver()
        receiver.check(sent[0])
        assert receiver.check(sent[step]) is status
    for missed, statuses in ((4, [E2eStatus.OK] * 3), (5, [E2eStatus.SYNC, E2eStatus.SYNC, E2eStatus.OK])):
        receiver = profile.receiver()
        receiver.check(sent[0])
        for _ in range(missed):
            receiver.miss()
        assert [receiver.check(frame) for frame in sent[1:4]] == statuses


@pytest.mark.parametrize(
    "profile", [profile_2(6), *map(profile_5, (8, 12, 16, 24, 64))], ids=lambda p: f"{p.modulus}-{p.length}"
)
@given(payload=st.binary(min_size=64, max_size=64), index=st.integers(0, 20))
def test_every_flipped_bit_is_found(profile: Profile, payload: bytes, index: int) -> None:
    sender = profile.sender()
    frame = b""
    for _ in range(index + 1):
        frame = sender.protect(bytearray(payload[: profile.length]))
    receiver = profile.receiver()
    found = set()
    for bit in range(8 * profile.length):
        flipped = bytearray(frame)
        flipped[bit // 8] ^= 1 << bit % 8
        found.add(receiver.check(bytes(flipped)))
    assert found == {E2eStatus.WRONG_CRC}
    assert receiver.check(frame) is E2eStatus.OK


@BOTH
def test_a_frame_of_another_length_is_not_taken(profile: Profile) -> None:
    receiver = profile.receiver()
    wrong = [length for length in range(65) if length != profile.length]
    for length in wrong:
        header = bytearray(profile.sender().protect(bytearray(max(length, 4)))[:length])
        assert receiver.check(bytes(header)) is E2eStatus.WRONG_CRC
    assert receiver.counts[E2eStatus.WRONG_CRC] == len(wrong)


@BOTH
def test_a_frame_of_another_message_is_not_taken(profile: Profile) -> None:
    other = profile.stranger()
    assert {other.check(frame) for frame in frames(profile, 40)} == {E2eStatus.WRONG_CRC}


@BOTH
def test_a_restart_forgets_the_sequence_and_keeps_the_counts(profile: Profile) -> None:
    receiver = profile.receiver()
    sent = frames(profile, 12)
    receiver.check(sent[0])
    receiver.check(sent[9])
    for _ in range(20):
        receiver.miss()
    counts = list(receiver.counts)
    receiver.restart_sequence()
    assert receiver.counts == counts
    assert [receiver.check(sent[3]), receiver.check(sent[4])] == [E2eStatus.OK, E2eStatus.OK]


@BOTH
def test_after_a_restart_the_tolerance_is_that_of_the_start(profile: Profile) -> None:
    receiver = profile.receiver()
    for _ in range(20):
        receiver.miss()
    receiver.restart_sequence()
    sent = frames(profile, 12)
    receiver.check(sent[0])
    assert receiver.check(sent[7]) is E2eStatus.WRONG_SEQUENCE


def test_without_protection_every_frame_is_ok_and_passes_as_it_is() -> None:
    receiver = E2eReceiver()
    assert (receiver.status, receiver.counter_range) == (E2eStatus.NO_NEW_DATA, 0)
    assert E2eSender().protect(bytearray(b"\x01\x02\x03")) == b"\x01\x02\x03"
    assert [receiver.check(frame) for frame in (b"\x01", b"\x01", b"")] == [E2eStatus.OK] * 3
    assert receiver.miss() is E2eStatus.NO_NEW_DATA
    receiver.restart_sequence()
    assert receiver.counts == [3, 0, 0, 0, 0, 1, 0]


@pytest.mark.parametrize(
    ("status", "number", "is_valid"),
    [
        (E2eStatus.OK, 0, True),
        (E2eStatus.OK_SOME_LOST, 1, True),
        (E2eStatus.REPEATED, 2, False),
        (E2eStatus.WRONG_SEQUENCE, 3, False),
        (E2eStatus.WRONG_CRC, 4, False),
        (E2eStatus.NO_NEW_DATA, 5, False),
        (E2eStatus.SYNC, 6, False),
    ],
)
def test_only_ok_frames_may_be_used(status: E2eStatus, number: int, is_valid: bool) -> None:
    assert int(status) == number
    assert status.is_valid is is_valid


@pytest.mark.parametrize(
    ("profile", "header_bytes", "bits", "status_place", "counter_place", "objects", "data_id_bytes", "is_id_list"),
    [
        (P02, 2, (8, 4, 4), (1, 4), (1, 0x0F), 2, 16, True),
        (P05, 4, (16, 8, 8), (3, 0), (2, 0xFF), 3, 2, False),
        (replace(P05, crc_bits=64, counter_bits=4, status_bits=4), 9, (64, 4, 4), (8, 4), (8, 0x0F), 3, 2, False),
    ],
    ids=["P02", "P05", "a wide CRC"],
)
def test_the_layout_of_a_header(
    profile: E2eProfile,
    header_bytes: int,
    bits: tuple[int, ...],
    status_place: tuple[int, int],
    counter_place: tuple[int, int],
    objects: int,
    data_id_bytes: int,
    is_id_list: bool,
) -> None:
    assert profile.header_bytes == header_bytes
    assert profile.signals == tuple(zip(("e2e_crc", "e2e_counter", "e2e_status"), bits, strict=True))
    assert (profile.status_place, profile.counter_place) == (status_place, counter_place)
    assert (profile.objects, profile.data_id_bytes, profile.is_id_list) == (objects, data_id_bytes, is_id_list)
    frame = bytearray(16)
    frame[counter_place[0]] = 0xA5
    assert profile.counter_of(frame) == 0xA5 & counter_place[1]


@BOTH
def test_the_step_of_a_frame_is_how_far_it_is_ahead(profile: Profile) -> None:
    receiver = profile.receiver()
    sent = frames(profile, profile.modulus + 1)
    assert receiver.step_of(sent[0]) is None
    receiver.check(sent[3])
    assert [receiver.step_of(sent[index]) for index in (3, 4, 9, 2, profile.modulus)] == [
        0,
        1,
        6,
        profile.modulus - 1,
        profile.modulus - 3,
    ]
    assert [receiver.step_of(sent[4][:-1]), receiver.step_of(sent[4] + b"\x00")] == [None, None]
    assert receiver.check(sent[4]) is E2eStatus.OK


@BOTH
def test_a_signature_is_told_without_a_change(profile: Profile) -> None:
    receiver = profile.receiver()
    sent = frames(profile, 3)
    receiver.check(sent[0])
    assert [receiver.is_signed(frame) for frame in (sent[2], bytes(profile.length), sent[2][:-1])] == [
        True,
        False,
        False,
    ]
    assert receiver.check(sent[1]) is E2eStatus.OK
    assert E2eReceiver().is_signed(b"")
