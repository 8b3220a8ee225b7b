"""The column codec against the scalar one."""

import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adacd_hil.device.contract import load_contract
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.codec import MessageCodec, parse_codec
from adacd_hil.wire.codec_columns import ColumnCodec

CONTRACTS = {name: load_contract(load_settings(name)) for name in ("stock", "fd", "paper")}


def decode_columns(message: MessageCodec, frames: list[bytes]) -> list[tuple[float, ...]]:
    """Decode frames by the column codec."""
    decoder = ColumnCodec(message)
    values = np.empty((len(frames), decoder.count))
    decoder.decode(np.array([list(frame) for frame in frames], np.uint8).reshape(len(frames), message.length), values)
    return [tuple(row) for row in values.tolist()]


@pytest.mark.parametrize("contract", CONTRACTS)
def test_both_codecs_decode_every_frame_to_the_same_values(contract: str) -> None:
    rng = random.Random(3)
    for message in CONTRACTS[contract].messages.values():
        frames = [rng.randbytes(message.length) for _ in range(20)]
        assert decode_columns(message, frames) == [message.decode(frame) for frame in frames]


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
def test_both_codecs_agree_whatever_the_layout(
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
