"""The layout digest as a stranger computes it: from docs/protocol.md and the DBC, without our codec."""

import re
import zlib
from pathlib import Path

import cantools
import pytest
from cantools.database.can import Message

from adacd_hil.wire.dbc_contract import contract_folder, load_codec

PAGE = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text()
FILES = sorted(contract_folder().glob("*.dbc"))


def lines_of(message: Message) -> list[str]:
    """Write the lines of one message, by the list in docs/protocol.md."""
    attributes = {name: attribute.value for name, attribute in message.dbc.attributes.items()}
    protection = ""
    if attributes.get("E2EProfile", "") == "P05":
        data_id = attributes["E2EDataId"]
        protection = f"P05 {data_id & 0xFF:02x}{data_id >> 8:02x}"
    elif attributes.get("E2EDataIdList", ""):
        protection = attributes["E2EDataIdList"].lower()
    lines = [f"{message.frame_id:x} {message.name} {message.length} {protection}"]
    container, shared_byte = -1, -1
    for signal in sorted(message.signals, key=lambda signal: signal.start):
        byte, shift = divmod(signal.start, 8)
        if shift == 0 and signal.length in (8, 16, 32, 64):
            container += 1
            shift, mask = 0, 0
        else:
            container += byte != shared_byte
            shared_byte, mask = byte, 2**signal.length - 1
        low = -(2 ** (signal.length - 1)) if signal.is_signed else 0
        numbers = f"{container} {shift} {mask} {low} {float(signal.scale)!r} {float(signal.offset)!r}"
        lines.append(f" {signal.name} {numbers}")
    return lines


def text_of(path: Path) -> str:
    messages = sorted(cantools.database.load_file(path).messages, key=lambda message: message.frame_id)
    return "\n".join(line for message in messages for line in lines_of(message))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_digest_is_that_of_the_text_that_the_page_describes(path: Path) -> None:
    assert load_codec(path).layout_digest == zlib.crc32(text_of(path).encode("ascii"))


def test_the_page_has_the_digest_of_every_contract() -> None:
    rows = re.findall(r"^\| `(\w+)\.dbc` \| (0x[0-9A-F]{8}) \|$", PAGE, re.MULTILINE)
    assert rows == [(path.stem, f"0x{load_codec(path).layout_digest:08X}") for path in FILES]


def test_the_pages_example_is_part_of_the_text() -> None:
    (block,) = re.findall(r"begins and has\n\n```text\n(.*?)\n```", PAGE, re.DOTALL)
    first, second = block.split("\n…\n")
    text = text_of(contract_folder() / "arm.dbc")
    assert text.startswith(first + "\n counter")
    assert second in text
