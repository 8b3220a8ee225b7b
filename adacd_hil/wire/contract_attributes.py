"""Attributes of a contract's DBC: of the network `Baudrate`, `BaudrateCANFD` (bit/s; 0: classic), `BusPeriod_us`.

Of a message `Trigger`, `GenMsgCycleTime` (ms, period of an event frame), `GenMsgDelayTime` (ms, its inhibit time).
"""

from cantools.database.can import Database, Message

from adacd_hil.wire.codec import Codec
from adacd_hil.wire.dbc_decoder import DbcDecoder

DEFAULT_BITRATE = 1_000_000
"""Bit rate of a DBC without that attribute, bit/s."""


def read_bitrates(codec: "Codec | DbcDecoder") -> tuple[int, int]:
    """Return the nominal and the data bit rate, bit/s; without a valid value in the DBC they are 1 Mbit/s and 0.

    The data bit rate of a classic bus is 0, too.
    """
    nominal, data = (str(read_attribute(codec.database, name)) for name in ("Baudrate", "BaudrateCANFD"))
    return int(nominal) if nominal.strip("0").isdecimal() else DEFAULT_BITRATE, int(data) if data.isdecimal() else 0


def read_attribute(owner: Database | Message, name: str) -> int | str:
    """Return the value of an attribute of network or message, else its default; 0 if the DBC doesn't define it."""
    if owner.dbc is None or name not in owner.dbc.attribute_definitions:
        return 0
    attribute = owner.dbc.attributes.get(name)
    value = owner.dbc.attribute_definitions[name].default_value if attribute is None else attribute.value
    return value if isinstance(value, str) else int(value or 0)
