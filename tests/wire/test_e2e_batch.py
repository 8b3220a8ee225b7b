"""The compiled check of recorded frames against the receivers of both profiles."""

import numpy as np
import pytest

from adacd_hil.wire.e2e import Profile2Sender, Profile5Sender
from adacd_hil.wire.e2e_batch import counter_of, is_next

DATA_IDS_2 = bytes(range(16, 32))
DATA_ID_5 = b"\x8e\x86"
LENGTHS = {2: 6, 5: 20}


def frames_of(profile: int, count: int) -> np.ndarray:
    """Let a sender protect frames of random content, the bytes after them wrong on purpose."""
    sender = Profile2Sender(DATA_IDS_2) if profile == 2 else Profile5Sender(DATA_ID_5)
    generator = np.random.default_rng(7)
    rows = np.full((count, 64), 0xA5, np.uint8)
    for row in rows:
        frame = sender.protect(bytearray(generator.bytes(LENGTHS[profile])))
        row[: len(frame)] = list(frame)
    return rows


def check(profile: int, data: np.ndarray, row: int, last: int) -> bool:
    ids = np.zeros(16, np.uint8)
    given = DATA_IDS_2 if profile == 2 else DATA_ID_5
    ids[: len(given)] = list(given)
    return is_next(data, row, LENGTHS[profile], profile, ids, last)


@pytest.mark.parametrize(("profile", "circle"), [(2, 16), (5, 256)])
def test_each_frame_of_a_sender_follows_the_one_before_all_round_the_counter(profile: int, circle: int) -> None:
    data = frames_of(profile, circle + 2)
    assert [counter_of(data, row, profile) for row in range(len(data))] == [n % circle for n in range(len(data))]
    assert all(check(profile, data, row, (row - 1) % circle) for row in range(len(data)))


@pytest.mark.parametrize("profile", [2, 5])
def test_a_repeated_frame_and_one_after_a_lost_one_are_not_the_next(profile: int) -> None:
    data = frames_of(profile, 5)
    assert [check(profile, data, 4, last) for last in (2, 3, 4, 5)] == [False, True, False, False]


@pytest.mark.parametrize("profile", [2, 5])
def test_no_frame_with_a_wrong_bit_is_the_next(profile: int) -> None:
    right = frames_of(profile, 2)
    for bit in range(8 * LENGTHS[profile]):
        data = right.copy()
        data[1, bit // 8] ^= 1 << bit % 8
        assert not check(profile, data, 1, 0)
