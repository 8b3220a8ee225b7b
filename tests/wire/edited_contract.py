"""Contracts of the package with other words in their DBC."""

from pathlib import Path

from adacd_hil.wire.codec import Codec
from adacd_hil.wire.dbc_contract import contract_folder, parse_codec


def edited(*changes: tuple[str, str], name: str = "arm") -> Codec:
    """Parse a DBC, as of a file `x`, after changes each of which must change something. Raises CodecError."""
    text = (contract_folder() / f"{name}.dbc").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return parse_codec(text.encode(), Path("x"))
