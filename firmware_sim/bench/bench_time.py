"""How time passes on a bench: by SYNC, by the clock, and by the marks of a host in lockstep.

    sync   every SYNC is one period (0x1006), however long it took to come: the same frames in give the same frames
           out, bit for bit. A lost SYNC is seen by the gap in its counter, and its period is integrated too.
    wall   the body moves by the given clock on a 100 µs grid and a SYNC samples it where it is. The drives watch that
           SYNC keeps coming.

In `sync`, heartbeats, deadlines and the braking that they cause run by the given clock while no SYNC comes. A host in
lockstep states how much time passes (`adacd_hil.wire.time_marks`), and the bench tells it which frames come later. Once
a host has died, `outlive_host` lets the time pass that the arm needs to come to rest. Meanwhile the bench reports the
truth, a row per period, numbered and stamped on from the last SYNC.

The emulator's own log of these rows has the topics /truth and /events, the resolved scenario as an attachment, and a
line for each of the scenario's faults in the metadata: `fault_0` for bit 0 of the truth's field `faults`, and so on.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from adacd_hil.log.log_files import find_parts
from adacd_hil.log.recording.recorder import LogSummary, Recorder
from adacd_hil.log.types.topics import ChannelId, pack_truth
from adacd_hil.records import TRUTH_LAYOUT, Event, Vector
from adacd_hil.settings.toml_files import to_toml
from adacd_hil.wire.time_marks import NEVER_NS, MarkKind, unpack_mark
from firmware_sim.bench.bench_nodes import TICK_NS, BenchNodes, Movable
from firmware_sim.bench.injector import Injector, Outbox
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

    def __exit__(self, *_: object) -> None:
        self.close()


LONGEST_ORPHANAGE_NS = 5_000_000_000
"""How long an arm is watched whose host has died; braking takes 1 s at most, what coasts with friction a few more."""
_OVERDUE_PERIODS = 4
"""By the clock, without SYNC for so long the truth goes on by itself; a lost SYNC or two leave a gap as ever."""
_REST_RAD_S, _REST_NS = 0.02, 50_000_000
"""At rest: slower than that for so long, as far as the drives can tell."""


class BenchTime:
    """The time of one bench, and of the arm on it."""

    def __init__(
        self, is_wall: bool, nodes: BenchNodes, arm: Movable, injector: Injector, outbox: Outbox, rows: TruthFeed
    ) -> None:
        """Begin before power-on. `is_wall`: by the given clock, else by SYNC."""
        self.now_ns = 0
        """Of power-on plus, by SYNC, the periods since then; by wall, the clock's."""
        self.due_ns = NEVER_NS
        """When something is due by time."""
        self.has_moved = False
        """Whether the arm has moved, by SYNC: since the first one."""
        self.has_outlived = False
        """Whether a host has been outlived since the last SYNC."""
        self._is_wall = is_wall
        self._nodes = nodes
        self._arm = arm
        self._injector = injector
        self._outbox = outbox
        self._rows = rows
        self._arm_ns = 0
        self._moving_ns = 0  # when the arm last moved, or could
        self._is_orphaned = False  # time passes that no host gives
        self._granted = 0  # frames that had gone out when time was last granted
        self._granted_ns = 0  # on the host's clock
        self._ahead_ns = 0  # of the bench's time over the host's

    @property
    def host_ns(self) -> int:
        """The bench's time on the clock of a host in lockstep."""
        return self.now_ns - self._ahead_ns

    @property
    def is_at_rest(self) -> bool:
        """Whether the arm has stood still for a while and no drive powers its motor."""
        return self._has_rested(self.now_ns)

    def begin(self, t_ns: int) -> None:
        """Let time begin at `t_ns`."""
        self.now_ns = self._arm_ns = t_ns

    def advance_to(self, t_ns: int) -> None:
        """Let time pass without frames: heartbeats, event timers, watchdogs; by wall clock the arm moves too."""
        while self.due_ns <= t_ns:
            self._live(max(self.due_ns, self.now_ns))
        self.move_to(t_ns)

    def poll(self, t_ns: int) -> None:
        """Do what is due by time and remember when to look again."""
        self.due_ns = self._nodes.poll(t_ns)
        if self._injector.has_faults:
            self.due_ns = min(self.due_ns, self._injector.due_ns, self._outbox.due_ns)

    def advance_faults(self, stamp_ns: int, ahead_ns: int = 0) -> None:
        """Let faults begin and end by now, or by what is `ahead_ns` of it."""
        if self._injector.has_faults:
            is_paced = self._outbox.is_paced
            self._injector.advance(self.now_ns + ahead_ns, self.host_ns + ahead_ns if is_paced else stamp_ns)
            self._injector.flood(self._nodes.period_ns)

    def take_mark(self, data: bytes, _t_ns: int) -> None:
        """Let time pass until the host's next frame, or until something is sent."""
        mark = unpack_mark(data)
        if mark is None or mark[0] is not MarkKind.ADVANCE:
            return
        host_ns = mark[1]
        outbox = self._outbox
        if not outbox.is_paced or host_ns < self._granted_ns:
            outbox.is_paced = True
            self._ahead_ns = self.now_ns - host_ns
        target_ns = host_ns + self._ahead_ns
        while outbox.sent == self._granted and self.due_ns <= target_ns:
            self._live(max(self.due_ns, self.now_ns))
        if outbox.sent == self._granted:
            self.move_to(target_ns)
        self._granted = outbox.sent
        self._granted_ns = self.host_ns
        outbox.mark(MarkKind.GRANT, self._granted_ns)

    def note_sent(self) -> None:
        """Take what has gone out for an answer: a host in lockstep has been given it without asking."""
        self._granted = self._outbox.sent

    def live_through_lost_syncs(self, count: int) -> None:
        """By SYNC, let the periods pass whose SYNC never came."""
        drive1, drive2 = self._nodes.drives
        for _ in range(count):
            self.now_ns += self._nodes.period_ns
            drive1.on_lost_sync(self.now_ns)
            drive2.on_lost_sync(self.now_ns)
            self._nodes.move_arm(self._nodes.period_ns // TICK_NS)

    def outlive_host(self) -> None:
        """By SYNC, let the time pass that no host gives any more, until the arm is at rest, for 5 s at most.

        The drives then miss their SYNC as by the clock. Once per host; by the clock time passes anyway.
        """
        if self._is_wall or not self.has_moved or self.has_outlived:
            return
        self.has_outlived = self._is_orphaned = True
        for drive in self._nodes.drives:
            drive.is_free_running = True
        end_ns = self.now_ns + LONGEST_ORPHANAGE_NS
        self._arm_ns = self.now_ns
        self.poll(self.now_ns)
        while not self.is_at_rest and self.now_ns < end_ns:
            self.advance_to(self.now_ns + self._nodes.period_ns)
        for drive in self._nodes.drives:
            drive.is_free_running = False
        self._is_orphaned = False

    def move_to(self, t_ns: int) -> None:
        """Let the bench's time reach `t_ns`; by wall clock the arm too, by SYNC only if its host has died.

        A host that dies sends no SYNC. What its drives do then must end, so their braking goes by time.
        """
        self.now_ns = max(self.now_ns, t_ns)
        drive1, drive2 = self._nodes.drives
        if not (self._is_wall or self._is_orphaned or drive1.is_left_alone or drive2.is_left_alone):
            self._arm_ns = self.now_ns
            return
        period_ns, rows = self._nodes.period_ns, self._rows
        step_ns = TICK_NS if self._is_wall else period_ns
        overdue_ns = rows.sync_ns + _OVERDUE_PERIODS * period_ns if rows.cycle >= 0 else NEVER_NS
        while self._arm_ns + step_ns <= t_ns:
            self._arm_ns += step_ns
            self.has_moved = True
            if not self._is_wall:
                self._tell_on()  # by SYNC the arm is a period ahead of the last truth
            self._nodes.move_arm(step_ns // TICK_NS)
            if self._is_wall and self._arm_ns >= overdue_ns:
                self._tell_on()

    def _live(self, t_ns: int) -> None:
        """Reach `t_ns` and do what is due then."""
        self.move_to(t_ns)
        self.advance_faults(t_ns)
        self._outbox.release(self.now_ns)
        self.poll(self.now_ns)

    def _tell_on(self) -> None:
        """Without a SYNC, say what is true at the arm's time once per period, as long as the arm moves."""
        if self._has_rested(self._arm_ns):
            return
        period_ns = self._nodes.period_ns
        if not self._is_wall:
            self._rows.tell_next(period_ns)
            return
        overdue, rest_ns = divmod(self._arm_ns - self._rows.sync_ns, period_ns)
        if overdue >= _OVERDUE_PERIODS and rest_ns < TICK_NS:
            self._rows.tell_overdue(overdue, period_ns)

    def _has_rested(self, now_ns: int) -> bool:
        """Whether the arm has stood still for a while, and no drive could move it; asked while it may move."""
        is_powered = any(drive.motor_mode for drive in self._nodes.drives)
        if is_powered or max(map(abs, self._arm.drive_velocity_rad_s)) > _REST_RAD_S:
            self._moving_ns = now_ns
        return now_ns - self._moving_ns >= _REST_NS
