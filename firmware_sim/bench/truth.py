"""The emulator's own log: what was true at every SYNC, as one MCAP file with the topics /truth and /events.

With the scenario it explains itself: the resolved scenario is attached, and each of its faults has a line in the
metadata, `fault_0` for bit 0 of the truth's field `faults`, and so on.
"""

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from adacd_hil.log.channels import ChannelId, pack_truth
from adacd_hil.log.parts import find_parts
from adacd_hil.log.recorder import LogSummary, Recorder
from adacd_hil.records import Event, Vector
from adacd_hil.settings.toml_files import to_toml
from firmware_sim.scenario.scenario import Scenario

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
