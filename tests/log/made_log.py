"""Small recordings made by hand, and surgery on the records of a log that leaves everything else as it must be."""

import io
import resource
import struct
import zlib
from contextlib import contextmanager
from dataclasses import dataclass

import can
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, AttachmentIndex, Chunk, ChunkIndex, Footer, MetadataIndex
from mcap.records import SummaryOffset as GroupOffset

from adacd_hil.log.mcap.chunked_file import LIBRARY, ChunkedFile
from adacd_hil.log.mcap.record_layout import MAGIC
from adacd_hil.log.types.message_types import ENCAPSULATION, Member, number_type

HEAD = struct.Struct("<BQ")
MESSAGE = struct.Struct("<BQHIQQ")
TYPE = number_type("adacd_hil_msgs/msg/Number", (Member("cycle", "uint64"), Member("value", "float64")))
MILLISECOND = 1_000_000
ATTACHMENTS = {"config.toml": b"x = 1\n", "arm.dbc": b"VERSION"}
RUN = {"epoch_ns": "0", "parameter_count": "7", "name": "Prüfung"}
SUMMARY = {"messages": "20", "frames": "0", "dropped": "0", "ending": "closed"}


@contextmanager
def disk_full_at(size):
    """Let this process write no file beyond a size, until the block ends, however it ends."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


class MemorySink(io.BytesIO):
    """What a log is written to, by our writers and mcap's."""

    def write(self, data, packets=0):
        return super().write(data)


def payload(number, value=0.5):
    return ENCAPSULATION + struct.pack("<IIQd", 0, number, number, value)


def message(channel, log_time, data, publish_time=None):
    publish_time = log_time if publish_time is None else publish_time
    return MESSAGE.pack(Opcode.MESSAGE, 22 + len(data), channel, 0, log_time, publish_time) + data


def make_log(
    topics=("/a", "/b"),
    chunks=((0, 5), (5, 10)),
    run=RUN,
    summary=SUMMARY,
    attachments=ATTACHMENTS,
    text=TYPE.text,
    make_payload=payload,
    times=lambda number: (number * MILLISECOND, number * MILLISECOND),
    library=LIBRARY,
    profile="",
):
    """Make a log: in each chunk a message of every topic for each of its numbers; `times`: log and publish time."""
    target = MemorySink()
    file = ChunkedFile(target.write, profile, library)
    for name, data in attachments.items():
        file.add_attachment(Attachment(create_time=0, log_time=0, name=name, media_type="text/plain", data=data))
    if run is not None:
        file.add_metadata("run", run)
    schema = file.define_schema(TYPE.name, "ros2msg", text.encode())
    channels = [file.define_channel(topic, "cdr", schema, {"fields": " ".join(TYPE.fields)}) for topic in topics]
    for start, stop in chunks:
        for number in range(start, stop):
            log_ns, publish_ns = times(number)
            for channel in channels:
                file.add_message(channel, log_ns, make_payload(number), publish_ns)
        file.flush()
    if summary is not None:
        file.add_metadata("summary", summary)
    file.complete()
    return target.getvalue()


@dataclass
class Part:
    """A record of a log; `offset`: where it was, -1 for a new one."""

    opcode: int
    body: bytes
    offset: int = -1

    @property
    def data(self):
        return HEAD.pack(self.opcode, len(self.body)) + self.body

    def read(self, kind):
        return kind.read(ReadDataStream(io.BytesIO(self.body)))

    def put(self, place, form, value):
        """Overwrite a number in the body."""
        body = bytearray(self.body)
        struct.pack_into(form, body, place, value)
        self.body = bytes(body)


def new(record):
    """Make a part of one of mcap's records."""
    builder = RecordBuilder()
    record.write(builder)
    data = builder.end()
    return Part(data[0], data[9:])


def take_apart(data):
    parts = []
    position = len(MAGIC)
    while position < len(data) - len(MAGIC):
        opcode, length = HEAD.unpack_from(data, position)
        parts.append(Part(opcode, data[position + 9 : position + 9 + length], position))
        position += 9 + length
    return parts


def kinds(parts, opcode):
    return [part for part in parts if part.opcode == opcode]


def put_together(parts, has_right_crcs=True):
    """Write a log of parts: what pointed to a part points to where it is, and both sections fit their CRCs."""
    position, places = len(MAGIC), {}
    for part in parts:
        places[part.offset] = position
        position += len(part.data)
    for part in parts:
        if part.offset >= 0:
            _move(part, places)
    if has_right_crcs:
        _set_crcs(parts)
    return MAGIC + b"".join(part.data for part in parts) + MAGIC


def _move(part, places):
    def at(place):
        return places.get(place, place)

    if part.opcode == Opcode.CHUNK_INDEX:
        index = part.read(ChunkIndex)
        index.chunk_start_offset = at(index.chunk_start_offset)
        index.message_index_offsets = {channel: at(place) for channel, place in index.message_index_offsets.items()}
        part.body = new(index).body
    elif part.opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
        index = part.read(AttachmentIndex if part.opcode == Opcode.ATTACHMENT_INDEX else MetadataIndex)
        index.offset = at(index.offset)
        part.body = new(index).body
    elif part.opcode == Opcode.SUMMARY_OFFSET:
        group = part.read(GroupOffset)
        group.group_start = at(group.group_start)
        part.body = new(group).body
    elif part.opcode == Opcode.FOOTER:
        footer = part.read(Footer)
        footer.summary_start, footer.summary_offset_start = at(footer.summary_start), at(footer.summary_offset_start)
        part.body = new(footer).body


def _set_crcs(parts):
    crc = zlib.crc32(MAGIC)
    for part in parts:
        if part.opcode == Opcode.DATA_END:
            part.put(0, "<I", crc)
            crc = 0
        elif part.opcode == Opcode.FOOTER:
            part.put(16, "<I", zlib.crc32(part.data[:-4], crc))
        else:
            crc = zlib.crc32(part.data, crc)


def rechunk(part, edit):
    """Change what a chunk holds."""
    chunk = part.read(Chunk)
    data = edit(zstandard.decompress(chunk.data))
    chunk.data, chunk.uncompressed_size, chunk.uncompressed_crc = zstandard.compress(data), len(data), zlib.crc32(data)
    part.body = new(chunk).body


def write_parts(folder, endings=("continued", "closed"), runs=None, summary=SUMMARY, **options):
    """Write a log of a part per ending, of 20 messages each; none where the ending is None."""
    for number, ending in enumerate(endings):
        if ending is None:
            continue
        start = 10 * number
        chunks = ((start, start + 5), (start + 5, start + 10))
        run = {**(runs[number] if runs else RUN), "part": str(number)}
        data = make_log(chunks=chunks, run=run, summary={**summary, "ending": ending}, **options)
        (folder / (f"run_{number:03d}.mcap" if number else "run.mcap")).write_bytes(data)
    return folder / "run.mcap"


def read_by_mcap(path):
    """Read a log with mcap: messages as (topic, log time, publish time, payload), attachments, metadata."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = reader.iter_messages(log_time_order=False)
        messages = [
            (channel.topic, message.log_time, message.publish_time, message.data) for _, channel, message in found
        ]
        attachments = {attachment.name: attachment.data for attachment in reader.iter_attachments()}
        return messages, attachments, {record.name: record.metadata for record in reader.iter_metadata()}


BLF_FRAME, BLF_ERROR, BLF_MARKER = 86, 73, 96


def blf_object(kind, body, version=1, flags=2, t_ns=0, size=None):
    head = struct.pack("<LHHQ", flags, 0, 0, t_ns)
    size = 32 + len(body) if size is None else size
    record = struct.pack("<4sHHLL", b"LOBJ", 32, version, size, kind) + head + body
    return record + bytes(len(record) % 4)


def blf_frame(number=0):
    return blf_object(BLF_FRAME, struct.pack("<HBBL8s", 1, 0, 8, 0x181, bytes([number % 256] * 8)), t_ns=number)


def write_blf(path, inner, method=2, size=None, cut=0):
    """Write a BLF of one container that holds `inner`, `cut` bytes short; `size`: of the container, as it says."""
    with can.BLFWriter(path):
        pass
    packed = struct.pack("<H6xI4x", method, len(inner)) + (zlib.compress(inner) if method == 2 else inner)
    container = struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(packed) if size is None else size, 10) + packed
    path.write_bytes((path.read_bytes()[:144] + container + bytes(len(container) % 4))[: -cut or None])
    return path


def flipped(data, place, bit=0):
    damaged = bytearray(data)
    damaged[place] ^= 1 << bit
    return bytes(damaged)
