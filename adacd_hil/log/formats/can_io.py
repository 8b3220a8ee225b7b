"""The plugin of python-can for `.mcap`: `can_logger`, `can_player` and `can_logconvert` read and write our logs.

python-can finds the two classes by the entry points `can.io.message_reader` and `can.io.message_writer`. The reader's
messages carry their time in whole nanoseconds, which the writer uses; other messages have python-can's float.
"""

import os
from collections.abc import Generator
from pathlib import Path
from typing import IO, Any, cast

import can
from can.io.generic import BinaryIOMessageReader, BinaryIOMessageWriter

from adacd_hil.log.formats.can_messages import channel_name, time_ns, to_messages
from adacd_hil.log.formats.mcap_frames import FrameWriter, McapFrames, RecordedFrame


class McapReader(BinaryIOMessageReader):
    """The messages of an MCAP file, in its order; of a log of ours all parts.

    `problem` names afterwards the missing data, "" for a whole file.
    """

    def __init__(self, file: Any, **_: Any) -> None:
        """Open a path or take an open binary file. Raises LogError when it can't be read or isn't MCAP."""
        super().__init__(file, mode="rb")
        try:
            is_path = isinstance(file, str | os.PathLike)
            self._frames = McapFrames(Path(file) if is_path else cast("IO[bytes]", self.file))
        except Exception:
            self.file.close()
            raise

    @property
    def problem(self) -> str:
        """What is missing."""
        return self._frames.problem

    def __iter__(self) -> Generator[can.Message, None, None]:
        for frames in self._frames:
            yield from to_messages(frames, self._frames.channels, self._frames.epoch_ns)
        self.stop()


class McapWriter(BinaryIOMessageWriter):
    """Writes messages to an MCAP file with the topics and types of our logs."""

    def __init__(self, file: Any, append: bool = False, **_: Any) -> None:
        """Create a file, or take an open binary one. Raises ValueError for `append`, FileExistsError for a log."""
        if append:
            raise ValueError("nothing can be appended to an MCAP file; log to another one")
        if isinstance(file, str | os.PathLike) and Path(file).is_file() and Path(file).stat().st_size:
            raise FileExistsError(f"{os.fspath(file)} is there already; log to another file")
        super().__init__(file, mode="wb")
        self._writer = FrameWriter(cast("IO[bytes]", self.file))
        self._is_stopped = False

    def on_message_received(self, msg: can.Message) -> None:
        """Write a message."""
        is_short = not (msg.is_remote_frame or msg.is_error_frame)
        data = bytes(msg.data)
        self._writer.write(
            RecordedFrame(
                t_ns=time_ns(msg),
                can_id=msg.arbitration_id,
                data=data,
                length=len(data) if is_short else msg.dlc,
                channel=channel_name(msg.channel),
                is_tx=not msg.is_rx,
                is_error=msg.is_error_frame,
                is_extended=msg.is_extended_id,
                is_remote=msg.is_remote_frame,
                is_fd=msg.is_fd,
                has_rate_switch=msg.is_fd and msg.bitrate_switch,
                has_error_state=msg.is_fd and msg.error_state_indicator,
            )
        )

    def stop(self) -> None:
        """End the file; twice is once."""
        if not self._is_stopped:
            self._is_stopped = True
            self._writer.finish()
            super().stop()
