"""The schemas and channels that a log defines, as they are met."""

from collections.abc import Iterable

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from adacd_hil.log.errors import LogError
from adacd_hil.log.mcap.mcap_records import RawRecord, parse


class Definitions:
    """Schemas and channels by their numbers."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def take(self, records: Iterable[RawRecord]) -> None:
        """Take in definitions. Raises LogError for one that makes no sense or contradicts an earlier one."""
        for record in records:
            known: dict[int, Schema] | dict[int, Channel] = self.channels
            if record.opcode == Opcode.SCHEMA:
                known = self.schemas
            definition = parse(record.opcode, record.body)
            if known.setdefault(definition.id, definition) != definition:
                raise LogError(f"{type(definition).__name__.lower()} {definition.id} is defined in two ways")
