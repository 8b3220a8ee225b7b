"""Mutations of files: of text, of bytes, and of MCAP, BLF and histories from the inside, where checksums fit again.

Each takes bytes and a generator and gives other bytes. The same seed gives the same file.
"""

import io
import random
import re
import struct
import zlib
from collections.abc import Callable, Sequence

from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from adacd_hil.control.device_record import DeviceRecord
from adacd_hil.control.history_file import CertificateRecord, devices_digest
from adacd_hil.settings.parsing import parse
from adacd_hil.settings.schema import ConfigError
from adacd_hil.settings.toml_files import parse_toml

Mutation = Callable[[bytes, random.Random], bytes]

NUMBERS = (
    "0", "-1", "1", "1e308", "-1e308", "1e-320", "nan", "inf", "-inf", "2147483648", "18446744073709551616", "1e400",
    "0x7fffffff", "9" * 5000, "1.0", "0.0", "-0.0", "1_0", "true", '"x"', "''", "[]", "[1, 2, 3]", "{}", "1979-05-27",
)  # fmt: skip
WORDS = (
    "", " ", "\0", "\x1b]0;owned\x07", "\x1b[2J", "\ud7ff", "é" * 300, "/dev/zero", "../../etc/passwd", "%s%n", "\r\n",
    "=", "[", "]", "{", "}", '"', "'", ",", ";", "#", "extends", "name", "paper", "certified", "P", "a" * 70_000,
)  # fmt: skip
_NUMBER = re.compile(rb"[-+]?\d[\w.+-]*")
_TOKEN = re.compile(rb"[A-Za-z_][\w.-]*|\"[^\"\n]*\"")
_DEEP = 20_000


def mutate_text(data: bytes, rng: random.Random) -> bytes:
    """Change a text in one to four places."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice(_TEXT)(data, rng)
    return data


def mutate_history(data: bytes, rng: random.Random) -> bytes:
    """Change an arm's history in one to four places; of what can still be read, the digests fit again."""
    data = mutate_text(data, rng)
    try:
        table = parse_toml(data)
        devices = [parse(DeviceRecord, device) for device in table["devices"]]
        records = [parse(CertificateRecord, record) for record in table["certificates"]]
    except (ConfigError, LookupError, TypeError):
        return data
    digest = devices_digest(devices)
    for record in records:
        old, digest = record.digest, record.digest_after(digest)
        if old:
            data = data.replace(old.encode(), digest.encode(), 1)
    return data


def mutate_bytes(data: bytes, rng: random.Random) -> bytes:
    """Change bytes in one to four places."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice(_BYTES)(data, rng)
    return data


def _replace_match(pattern: "re.Pattern[bytes]", words: Sequence[str]) -> Mutation:
    def mutate(data: bytes, rng: random.Random) -> bytes:
        places = [match.span() for match in pattern.finditer(data)]
        if not places:
            return data
        start, end = rng.choice(places)
        return data[:start] + rng.choice(words).encode("utf-8", "surrogatepass") + data[end:]

    return mutate


def _edit_line(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    place = rng.randrange(len(lines))
    how = rng.randrange(5)
    if how == 0:
        del lines[place]
    elif how == 1:
        lines.insert(rng.randrange(len(lines) + 1), lines[place])
    elif how == 2:
        other = rng.randrange(len(lines))
        lines[place], lines[other] = lines[other], lines[place]
    elif how == 3:
        lines[place] = lines[place][: rng.randrange(len(lines[place]) + 1)]
    else:
        lines[place] += lines[rng.randrange(len(lines))]
    return b"\n".join(lines)


def _swap_tokens(data: bytes, rng: random.Random) -> bytes:
    places = [match.span() for match in _TOKEN.finditer(data)]
    if len(places) < 2:
        return data
    (start, end), (from_, to) = rng.choice(places), rng.choice(places)
    return data[:start] + data[from_:to] + data[end:]


def _nest(data: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(data) + 1)
    bracket = rng.choice((b"[", b"{", b"a.", b"((", b'{"a":'))
    return data[:place] + bracket * _DEEP + data[place:]


def _insert_word(data: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(data) + 1)
    return data[:place] + rng.choice(WORDS).encode("utf-8", "surrogatepass") + data[place:]


def _flip(data: bytes, rng: random.Random) -> bytes:
    if not data:
        return data
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 3, 20))):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _remove(data: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(data) + 1)
    return data[:start] + data[start + rng.choice((1, 2, 8, 100, 4096)) :]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(data) + 1)
    return data[:start] + data[start : start + rng.choice((1, 8, 100, 4096))] * rng.choice((2, 3, 50)) + data[start:]


def _number(data: bytes, rng: random.Random) -> bytes:
    """Overwrite a binary number by one at an edge."""
    size = rng.choice((1, 2, 4, 8))
    if len(data) <= size:
        return data
    bits = 8 * size
    value = rng.choice((0, 1, 2**bits - 1, 2 ** (bits - 1), 2 ** (bits - 1) - 1, rng.getrandbits(bits)))
    start = rng.randrange(min(len(data), rng.choice((64, 4096, len(data)))) - size + 1) if len(data) > 64 else 0
    return data[:start] + value.to_bytes(size, "little") + data[start + size :]


_BYTES: tuple[Mutation, ...] = (_flip, _flip, _cut, _remove, _repeat, _number, _number, _number)
_TEXT: tuple[Mutation, ...] = (
    *(_replace_match(_NUMBER, NUMBERS),) * 4,
    *(_replace_match(_TOKEN, (*WORDS, *NUMBERS)),) * 2,
    _edit_line,
    _edit_line,
    _swap_tokens,
    _swap_tokens,
    _insert_word,
    _nest,
    _flip,
    _cut,
    _remove,
    _repeat,
)


def mutate_mcap(data: bytes, rng: random.Random) -> bytes:
    """Change an MCAP file: its bytes, or what its records hold, with sizes and checksums that fit again."""
    return mutate_bytes(data, rng) if rng.random() < 0.4 else _rewrite_mcap(data, rng)


def _rewrite_mcap(data: bytes, rng: random.Random) -> bytes:
    """Read all records of a whole log and write them anew, some changed."""
    out = io.BytesIO()
    compression = rng.choice((CompressionType.ZSTD, CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE))
    writer = Writer(out, chunk_size=rng.choice((1 << 12, 1 << 18, 1 << 18)), compression=compression)
    writer.start()
    what = rng.choice(("attachment", "metadata", "schema", "channel", "message", "message", "message", "order"))
    share = rng.choice((0.001, 0.01, 1.0)) if what == "message" else rng.choice((0.3, 1.0))

    def is_chosen(kind: str) -> bool:
        return kind == what and rng.random() < share

    schema_ids, channel_ids, messages = {0: 0}, {}, []
    for record in _records(data):
        if isinstance(record, Attachment):
            text = mutate_text(record.data, rng) if is_chosen("attachment") else record.data
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, text)
        elif isinstance(record, Metadata):
            table = dict(record.metadata)
            for key in list(table):
                if is_chosen("metadata"):
                    table[key] = rng.choice((*WORDS, *NUMBERS))
            writer.add_metadata(record.name, table)
        elif isinstance(record, Schema):
            text = mutate_text(record.data, rng) if is_chosen("schema") else record.data
            schema_ids[record.id] = writer.register_schema(record.name, record.encoding, text)
        elif isinstance(record, Channel):
            topic, schema = record.topic, schema_ids.get(record.schema_id, 0)
            if is_chosen("channel"):
                topic = rng.choice((topic, "", "/", "/" + rng.choice(WORDS[:12]), "/scheme", "/events"))
                schema = rng.choice((schema, 0, *schema_ids.values()))
            channel_ids[record.id] = writer.register_channel(topic, record.message_encoding, schema, record.metadata)
        else:
            messages.append(record)
    if what == "order":
        rng.shuffle(messages)
    for message in messages:
        body, log_ns, publish_ns = message.data, message.log_time, message.publish_time
        if is_chosen("message"):
            body = mutate_bytes(body, rng)
            log_ns, publish_ns = (rng.choice((ns, ns, 0, 2**63, 2**64 - 1, ns + 10**15)) for ns in (log_ns, publish_ns))
        writer.add_message(channel_ids[message.channel_id], log_ns, body, publish_ns, message.sequence)
    writer.finish()
    return out.getvalue()


def _records(data: bytes) -> list:
    """List definitions, attachments, metadata and messages of a whole file, each definition once."""
    found, seen = [], set()
    for record in StreamReader(io.BytesIO(data), emit_chunks=True).records:
        for inner in breakup_chunk(record) if isinstance(record, Chunk) else (record,):
            key = (type(inner), inner.id) if isinstance(inner, Schema | Channel) else None
            if key not in seen:
                found.append(inner)
            if key is not None:
                seen.add(key)
    return [record for record in found if type(record).__name__ in _REWRITTEN]


_REWRITTEN = ("Attachment", "Metadata", "Schema", "Channel", "Message")


def mutate_blf(data: bytes, rng: random.Random) -> bytes:
    """Change a BLF file: its bytes, or what its compressed containers hold."""
    if rng.random() < 0.5:
        return mutate_bytes(data, rng)
    out, position = bytearray(), 144
    out += data[:position]
    while position + 16 <= len(data):
        signature, head, _, size, kind = struct.unpack_from("<4sHHII", data, position)
        end = position + max(size, 16) + size % 4
        body = data[position + head : position + size]
        if signature == b"LOBJ" and kind == 10 and len(body) > 16:
            inner = mutate_bytes(zlib.decompress(body[16:]), rng)
            packed = body[:8] + struct.pack("<II", len(inner), 0) + zlib.compress(inner)
            record = struct.pack("<4sHHII", signature, head, 1, head + len(packed), kind) + packed
            out += record + bytes(-len(record) % 4)
        else:
            out += data[position:end]
        position = end
    return bytes(out)
