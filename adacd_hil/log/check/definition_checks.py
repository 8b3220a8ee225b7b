"""The rules on schemas and channels."""

from mcap.records import Channel, Schema

from adacd_hil.log.check.findings import Findings


class DefinitionCheck:
    """Watches the definitions of a file, in the data section and then in the summary."""

    def __init__(self, findings: Findings) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.summary_schemas: set[int] = set()
        self.summary_channels: set[int] = set()
        self._findings = findings
        self._summary_only: list[tuple[str, int]] = []
        self._duplicates: set[str] = set()

    def schema(self, schema: Schema, offset: int, is_summary: bool) -> None:
        """Take in a schema."""
        name = f"schema {schema.id}"
        if schema.id == 0:
            self._findings.add("schema-id", f"schema {schema.name!r} has the number 0", offset)
        if not schema.encoding and schema.data:
            self._findings.add("schema-encoding", f"{name} has data but no encoding", offset)
        elif not schema.encoding:
            self._findings.add("empty-schema", f"{name} ({schema.name!r}) is empty", offset)
        known = self.schemas.get(schema.id)
        if known is not None:
            pairs = (("name", "name"), ("encoding", "encoding"), ("data", "data"))
            self._compare(name, known, schema, pairs, offset)
        self._place(name, schema.id in self.schemas, offset, is_summary)
        if is_summary:
            self.summary_schemas.add(schema.id)
        else:
            self.schemas.setdefault(schema.id, schema)

    def channel(self, channel: Channel, offset: int, is_summary: bool) -> None:
        """Take in a channel."""
        name = f"channel {channel.id}"
        known = self.channels.get(channel.id)
        if known is not None:
            pairs = (
                ("schema", "schema_id"),
                ("topic", "topic"),
                ("message encoding", "message_encoding"),
                ("metadata", "metadata"),
            )
            self._compare(name, known, channel, pairs, offset)
        is_defined = channel.schema_id in self.schemas or (is_summary and channel.schema_id in self.summary_schemas)
        if channel.schema_id and not is_defined:
            text = f"{name} ({channel.topic}) has the schema {channel.schema_id}, which is not defined"
            self._findings.add("undefined-schema", text, offset)
        self._place(name, channel.id in self.channels, offset, is_summary)
        if is_summary:
            self.summary_channels.add(channel.id)
        else:
            self.channels.setdefault(channel.id, channel)

    def _compare(
        self, name: str, known: object, other: object, pairs: tuple[tuple[str, str], ...], offset: int
    ) -> None:
        different = [what for what, field in pairs if getattr(known, field) != getattr(other, field)]
        if different:
            self._findings.add("redefinition", f"{name} is defined again with another {', '.join(different)}", offset)

    def _place(self, name: str, is_known: bool, offset: int, is_summary: bool) -> None:
        if is_summary and not is_known:
            self._summary_only.append((name, offset))
        elif not is_summary and is_known and name not in self._duplicates:
            self._duplicates.add(name)
            self._findings.add("duplicate", f"{name} is defined more than once in the data section", offset)

    def finish(self, has_messages: bool) -> None:
        """Judge what the summary alone defines."""
        rule = "summary-only" if has_messages else "unused-summary-only"
        for name, offset in self._summary_only:
            self._findings.add(rule, f"{name} is defined in the summary only", offset)
