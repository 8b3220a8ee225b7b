"""The emulator's own log: what was true at every SYNC, as one MCAP file with the topic /truth."""

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from adacd_hil.log.channels import ChannelId, pack_truth
from adacd_hil.log.recorder import LogSummary, Recorder
from adacd_hil.records import Vector

TRUTH_NAME = "truth.mcap"


class TruthLog:
    """Writes the truth; `write` is a Bench's `on_truth`."""

    def __init__(
        self, path: Path, *, blocking: bool, epoch_ns: int = 0, metadata: Mapping[str, str] | None = None
    ) -> None:
        """Create the file. `blocking`: wait for the writer rather than lose a cycle. Raises LogError."""
        self.path = path
        self._recorder = Recorder(path, blocking=blocking, epoch_ns=epoch_ns, metadata=metadata, is_truth=True)

    def write(self, cycle: int, t_ns: int, block: Vector) -> None:
        """Log the truth of one cycle; `block` is laid out by TRUTH_LAYOUT."""
        self._recorder.cycle(t_ns, ((ChannelId.TRUTH, pack_truth(cycle, block)),))

    def close(self) -> LogSummary:
        """End the file and say how it went; twice is once."""
        return self._recorder.close()

    def __enter__(self) -> "TruthLog":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
