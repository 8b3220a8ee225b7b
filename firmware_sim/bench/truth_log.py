"""The truth at every SYNC: its rows, and the emulator's own log of them with the topics /truth and /events.

Where no SYNC comes, rows go on from the last one, one per period. The log has the resolved scenario as an attachment,
and a line for each of the scenario's faults in the metadata, `fault_0` for bit 0 of the truth's field `faults`, and so
on.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType

import numpy as np

from adacd_hil.log.log_files import find_parts
from adacd_hil.log.recording.recorder import LogSummary, Recorder
from adacd_hil.log.types.topics import ChannelId, pack_truth
from adacd_hil.records import TRUTH_LAYOUT, Event, Vector
from adacd_hil.settings.toml_files import to_toml
from firmware_sim.scenario.scenario import Scenario

OnTruth = Callable[[int, int, Vector], None]
"""Called with cycle, t_ns of the SYNC frame, and a block by TRUTH_LAYOUT that is valid until the next call."""


class TruthFeed:
    """Numbers and stamps the rows of one bench."""

    def __init__(self, fill: Callable[[Vector], None], on_truth: OnTruth | None) -> None:
        """`fill`: fills a block with what is true now."""
        self.on_truth = on_truth
        self.cycle = -1
        """Of the last row, -1 before the first."""
        self.sync_ns = 0
        """The bench's time at the last SYNC."""
        self._fill = fill
        self._block = np.zeros(TRUTH_LAYOUT.size)
        self._stamp_ns = self._sync_stamp_ns = self._sync_cycle = 0

    def tell_sync(self, cycle: int, stamp_ns: int, now_ns: int) -> None:
        """Tell the row of a SYNC at the bench's `now_ns`."""
        self.sync_ns, self._sync_stamp_ns, self._sync_cycle = now_ns, stamp_ns, cycle
        self._tell(cycle, stamp_ns)

    def tell_next(self, period_ns: int) -> None:
        """Tell a row a period after the last one."""
        self._tell(self.cycle + 1, self._stamp_ns + period_ns)

    def tell_overdue(self, periods: int, period_ns: int) -> None:
        """Tell a row so many periods after the last SYNC."""
        self._tell(self._sync_cycle + periods, self._sync_stamp_ns + periods * period_ns)

    def _tell(self, cycle: int, stamp_ns: int) -> None:
        self.cycle, self._stamp_ns = cycle, stamp_ns
        if self.on_truth is not None:
            self._fill(self._block)
            self.on_truth(cycle, stamp_ns, self._block)


SCENARIO_NAME = "scenario.toml"
"""The attachment."""


class TruthLog:
    """Writes the truth; `write` is a Bench's `on_truth`."""

    def __init__(
        self,
        path: Path,
        *,
        blocking: bool,
        epoch_ns: int = 0,
        metadata: Mapping[str, str] | None = None,
        scenario: Scenario | None = None,
    ) -> None:
        """Create the file. `blocking`: wait for the writer rather than lose a cycle.

        Raises LogExistsError when there is one already, LogError.
        """
        self.path = path
        faults = () if scenario is None else scenario.faults
        self._recorder = Recorder(
            path,
            attachments={} if scenario is None else {SCENARIO_NAME: to_toml(scenario).encode()},
            metadata={**(metadata or {}), **{f"fault_{index}": row.timed_text for index, row in enumerate(faults)}},
            epoch_ns=epoch_ns,
            blocking=blocking,
            is_truth=True,
        )

    def write(self, cycle: int, t_ns: int, block: Vector) -> None:
        """Log the truth of one cycle; `block` is laid out by TRUTH_LAYOUT."""
        self._recorder.cycle(t_ns, ((ChannelId.TRUTH, pack_truth(cycle, block)),))

    def event(self, t_ns: int, level: str, name: str, text: str) -> None:
        """Log something that happened: a fault that begins or ends. `level`: info, warning or error."""
        self._recorder.event(t_ns, Event(level, name, text))

    def close(self) -> LogSummary:
        """End the file and say how it went; twice is once."""
        return self._recorder.close()

    def discard(self) -> None:
        """End the log and remove it. Raises OSError."""
        self.close()
        for part in find_parts(self.path).values():
            part.unlink()

    def __enter__(self) -> "TruthLog":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
