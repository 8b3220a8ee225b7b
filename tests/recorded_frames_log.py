"""A short recording with a frame of every kind that a playback meets, 1 ms apart."""

from adacd_hil.log.frames.mcap_frames import FrameWriter, RecordedFrame

KINDS = (
    {"can_id": 0x000, "data": b"\x01\x00", "is_tx": True},
    {"can_id": 0x080, "data": b"\x07", "is_tx": True},
    {"can_id": 0x181, "data": bytes(8)},
    {"can_id": 0x18DAF110, "data": b"\x01", "is_extended": True},
    {"can_id": 0x201, "data": bytes(6), "is_tx": True},
    {"can_id": 0x7A5, "data": b"\x02"},
    {"can_id": 0x181, "data": b"", "length": 8, "is_remote": True},
    {"can_id": 0x004, "data": bytes(8), "is_error": True},
    {"can_id": 0x181, "data": bytes(8), "is_fd": True, "has_rate_switch": True},
    {"can_id": 0x123, "data": b"", "is_extended": True},
)


def write_frames(path):
    with path.open("wb") as file:
        writer = FrameWriter(file)
        for number, kind in enumerate(KINDS):
            writer.write_frame(RecordedFrame(**{"t_ns": 1_000_000 * number, "length": len(kind["data"]), **kind}))
        writer.finish()
    return path
