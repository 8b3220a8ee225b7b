"""The bit rates that the contract is made for: DBC attributes `Baudrate` and `BaudrateCANFD`, bit/s."""

import cantools
from cantools.database.can import Database

from adacd_hil.wire.codec import Codec

DEFAULT_BITRATE = 1_000_000
"""Of a DBC that doesn't say."""


def read_bitrates(codec: Codec) -> tuple[int, int]:
    """Return the nominal and the data bit rate; the data bit rate of a classic bus is 0."""
    database = cantools.database.load_string(codec.text.decode("utf-8"), "dbc")
    attributes = database.dbc.attributes if isinstance(database, Database) and database.dbc else {}
    found = {name: int(attributes[name].value) for name in ("Baudrate", "BaudrateCANFD") if name in attributes}
    return found.get("Baudrate") or DEFAULT_BITRATE, found.get("BaudrateCANFD", 0)
