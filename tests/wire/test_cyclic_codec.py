"""The compiled codec against the scalar one, the column codec and the receivers of both profiles."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adacd_hil.device.contract import load_contract
from adacd_hil.settings.configuration import load_settings
from adacd_hil.wire.codec import MessageCodec, parse_codec
from adacd_hil.wire.codec_columns import ColumnCodec, signal_rows
from adacd_hil.wire.cyclic_codec import counter_of, decode_signal, is_next
from adacd_hil.wire.e2e import E2eStatus, Profile2Receiver, Profile2Sender, Profile5Receiver, Profile5Sender

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


CONTRACTS = {name: load_contract(load_settings(name)) for name in ("stock", "fd", "paper")}
MESSAGES = [(contract, name) for contract, codec in CONTRACTS.items() for name in sorted(codec.messages)]


def decode_compiled(message: MessageCodec, frames: list[bytes]) -> list[tuple[float, ...]]:
    """Decode frames by the compiled codec, all signals."""
    data = np.array([list(frame) for frame in frames], np.uint8).reshape(len(frames), message.length)
    rows = signal_rows(message.signals)
    return [tuple(decode_signal(data, row, signal) for signal in rows) for row in range(len(frames))]


def decode_columns(message: MessageCodec, frames: list[bytes]) -> list[tuple[float, ...]]:
    """Decode frames by the column codec."""
    decoder = ColumnCodec(message)
    values = np.empty((len(frames), decoder.count))
    decoder.decode(np.array([list(frame) for frame in frames], np.uint8).reshape(len(frames), message.length), values)
    return [tuple(row) for row in values.tolist()]


@pytest.mark.parametrize(("contract", "name"), MESSAGES)
@settings(max_examples=20, deadline=None)
@given(data=st.data())
def test_all_codecs_decode_every_frame_to_the_same_values(contract: str, name: str, data: st.DataObject) -> None:
    message = CONTRACTS[contract].message(name)
    frames = data.draw(st.lists(st.binary(min_size=message.length, max_size=message.length), min_size=1, max_size=5))
    one_by_one = [message.decode(frame) for frame in frames]
    assert decode_columns(message, frames) == one_by_one
    assert decode_compiled(message, frames) == one_by_one


@st.composite
def layouts(draw: st.DrawFn) -> list[tuple[int, int, bool, float, float]]:
    """Draw signals of one frame: first bit, bits, sign, scale, offset."""
    signals, bit = [], 0
    while bit < 64:
        scale, offset = draw(st.floats(1e-6, 1e6)), draw(st.floats(-1e6, 1e6))
        size = draw(st.sampled_from([size for size in (1, 2, 4, 8) if bit + 8 * size <= 64]))
        parts = [8 * size] if size > 1 or draw(st.booleans()) else draw(st.sampled_from(([3, 5], [1, 7], [2, 2, 4])))
        for bits in parts:
            signals.append((bit, bits, draw(st.booleans()), scale, offset))
            bit += bits
    return signals


@settings(max_examples=60, deadline=None)
@given(layout=layouts(), frames=st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=5))
def test_all_codecs_agree_whatever_the_layout(
    layout: list[tuple[int, int, bool, float, float]], frames: list[bytes]
) -> None:
    lines = [
        f' SG_ s{n} : {bit}|{bits}@1{"-" if is_signed else "+"} ({scale!r},{offset!r}) [0|0] "" HOST'
        for n, (bit, bits, is_signed, scale, offset) in enumerate(layout)
    ]
    head = 'VERSION "1"\n\nBU_: HOST\n\nBO_ 1 Any: 8 HOST\n'
    text = (
        head
        + "\n".join(lines)
        + '\n\nBA_DEF_ "WireVersion" INT 1 9;\nBA_DEF_DEF_ "WireVersion" 1;\nBA_ "WireVersion" 1;\n'
    )
    message = parse_codec(text.encode(), Path("any.dbc")).message("Any")
    one_by_one = [message.decode(frame) for frame in frames]
    assert [values[: len(layout)] for values in one_by_one] == [message.decode_values(frame) for frame in frames]
    assert decode_columns(message, frames) == one_by_one
    assert decode_compiled(message, frames) == one_by_one


@pytest.mark.parametrize("profile", [2, 5])
@settings(deadline=None)
@given(data=st.data())
def test_the_compiled_check_and_the_receiver_agree_on_damaged_frames(profile: int, data: st.DataObject) -> None:
    frames = frames_of(profile, 3)[:, : LENGTHS[profile]]
    damaged = data.draw(st.sampled_from(range(8 * LENGTHS[profile])) | st.none())
    if damaged is not None:
        frames[2, damaged // 8] ^= 1 << damaged % 8
    which = data.draw(st.sampled_from((1, 2)))
    receiver = Profile2Receiver(DATA_IDS_2, LENGTHS[2]) if profile == 2 else Profile5Receiver(DATA_ID_5, LENGTHS[5])
    receiver.check(frames[0].tobytes())
    if which == 2:
        receiver.check(frames[1].tobytes())
    last = receiver.counter
    assert last is not None
    is_ok = receiver.check(frames[2].tobytes()) is E2eStatus.OK
    assert check(profile, frames, 2, last) == is_ok
