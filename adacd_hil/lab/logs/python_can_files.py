"""The plugin of python-can for `.mcap`: `can_logger`, `can_player` and `can_logconvert` read and write our logs.

python-can finds the two classes by the entry points `can.io.message_reader` and `can.io.message_writer`. The reader's
messages carry their time in whole nanoseconds, which the writer uses.

A channel of digits is a number to python-can and a name here: "0" is its 0, "" its None.
"""

import logging
import os
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import IO, Any, cast

import can
from can.io.generic import BinaryIOMessageReader, BinaryIOMessageWriter
from numpy.typing import NDArray

from adacd_hil.lab.logs.frame_writer import FrameWriter
from adacd_hil.log.frames.can_io import to_frame
from adacd_hil.log.frames.mcap_frames import McapFrames
from adacd_hil.printable import in_line


class McapReader(BinaryIOMessageReader):
    """The messages of an MCAP file as python-can's, in its order; of a log of ours all parts.

    After iteration `problem` names missing data; it is also logged as a warning.
    """

    def __init__(self, file: Any, **_: Any) -> None:
        """Open a path, or read an open binary file.

        Raises OSError if the path can't be opened, LogError if the file can't be read or isn't MCAP.
        """
        super().__init__(file, mode="rb")
        try:
            is_path = isinstance(file, str | os.PathLike)
            self._frames = McapFrames(Path(file) if is_path else cast("IO[bytes]", self.file))
        except Exception:
            self.file.close()
            raise

    @property
    def problem(self) -> str:
        """One line on missing or unreadable parts, known after iteration; "" for a whole file."""
        return self._frames.problem

    def __iter__(self) -> Generator[can.Message, None, None]:
        for frames in self._frames:
            yield from to_messages(frames, self._frames.channels, self._frames.epoch_ns)
        if self.problem:  # for the terminal of python-can's tools, which know no `problem`
            logging.getLogger(__name__).warning("%s", in_line(self.problem))
        self.stop()


class McapWriter(BinaryIOMessageWriter):
    """Writes python-can's messages to an MCAP file with the topics and types of our logs."""

    def __init__(self, file: Any, append: bool = False, **_: Any) -> None:
        """Create a file, or write to an open binary one.

        Raises ValueError for `append`, FileExistsError for the path of a file that isn't empty.
        """
        if append:
            raise ValueError("nothing can be appended to an MCAP file; log to another one")
        if isinstance(file, str | os.PathLike) and Path(file).is_file() and Path(file).stat().st_size:
            raise FileExistsError(f"{os.fspath(file)} is there already; log to another file")
        super().__init__(file, mode="wb")
        self._writer = FrameWriter(cast("IO[bytes]", self.file))
        self._is_stopped = False

    def on_message_received(self, msg: can.Message) -> None:
        """Write a message. Raises ValueError for a message that no CAN frame can have, and for a time out of range."""
        self._writer.write_frame(to_frame(msg))

    def stop(self) -> None:
        """Complete and close the file; a second call has no effect."""
        if not self._is_stopped:
            self._is_stopped = True
            self._writer.finish()
            super().stop()


_MOST_DIGITS = 9
"""A channel of fewer digits is a number."""


class TimedMessage(can.Message):
    """A message with its time in whole nanoseconds, besides python-can's `timestamp`."""

    def __init__(self, t_ns: int, **fields: Any) -> None:
        super().__init__(timestamp=t_ns / 1_000_000_000, **fields)
        self.t_ns = t_ns


def to_messages(frames: NDArray[Any], channels: list[str], epoch_ns: int = 0) -> Iterator[TimedMessage]:
    """Yield a python-can message for each frame, a row of RECORDED_FRAME_DTYPE; `epoch_ns` is added to its time.

    channels: name of each CAN channel, by its number in a row. In a message, a name of digits is an int, "" is None.
    """
    names = [int(name) if name.isdecimal() and len(name) < _MOST_DIGITS else name or None for name in channels]
    for row in frames:
        (t_ns, _, can_id, is_tx, is_error, length, _, channel, is_extended, is_remote, is_fd, has_switch, has_error) = (
            row.item()
        )
        yield TimedMessage(
            t_ns + epoch_ns,
            arbitration_id=can_id,
            is_extended_id=is_extended,
            is_remote_frame=is_remote,
            is_error_frame=is_error,
            channel=names[channel],
            dlc=length,
            data=b"" if is_remote else row["data"][:length].tobytes(),
            is_fd=is_fd,
            is_rx=not is_tx,
            bitrate_switch=has_switch,
            error_state_indicator=has_error,
        )
