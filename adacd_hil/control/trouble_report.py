"""What the bus's controller reports in error frames, as events.

A controller that nobody answers reports thousands of times a second; every frame is in the log anyway.
"""

from adacd_hil.device.arm_watch import Notices
from adacd_hil.records import Event
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.error_frames import TroubleKind, decode_error


class TroubleReport(Notices):
    """Makes events of error frames."""

    def accept(self, frame: Frame) -> None:
        """Take an error frame."""
        trouble = decode_error(frame)
        level = "info" if trouble.kind is TroubleKind.ERROR_ACTIVE else "warning"
        self.say(frame.t_ns, trouble.kind, Event(level, "bus", trouble.text))
