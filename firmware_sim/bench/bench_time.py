"""The time of a bench, and the log of its truth.

`BenchTime.advance` moves the arm and the bench's time; besides it only `BenchTime.delay_sample` moves the arm. A SYNC
samples the arm where it is. The clock mode determines the caller of `advance`:

    sync   every SYNC is one period (0x1006), however long it took to come: the same frames in give the same frames
           out, bit for bit. A gap in the SYNC counter is as many lost periods. Between SYNCs the arm waits, and
           heartbeats, deadlines and event timers go by the given clock.
    wall   the given clock, on a 100 µs grid. The drives watch that SYNC keeps coming.

A host in lockstep sends marks (`adacd_hil.wire.time_marks`) in place of the clock, and gets the later frames in answer.
Once a host has died, time passes by the clock in both modes: while a drive brakes because a deadline ended, and in
`outlive_host` until the arm is at rest. Meanwhile the bench adds a row of truth per period, numbered and stamped from
the last SYNC.

The emulator's own log of these rows has the topics /truth and /events, the resolved scenario as an attachment, and a
line for each of the scenario's faults in the metadata: `fault_0` for bit 0 of the truth's field `faults`, and so on.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from adacd_hil.log.log_files import SCENARIO_NAME, find_parts
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.log.types.truth_topic import TRUTH, TRUTH_LAYOUT, truth_channels
from adacd_hil.records import Vector
from adacd_hil.settings.toml_text import to_toml
from adacd_hil.wire.time_marks import NEVER_NS, MarkKind, unpack_mark
from firmware_sim.bench.bench_nodes import TICK_NS, BenchNodes
from firmware_sim.bench.injector import Injector, Outbox
from firmware_sim.nodes.device import MovableArm
from firmware_sim.nodes.drive_profile import REST_RAD_S
from firmware_sim.scenario.scenario import Scenario

OnTruth = Callable[[int, int, Vector], None]
"""Called with cycle, t_ns of the SYNC frame, and a block by TRUTH_LAYOUT that is valid until the next call."""


class TruthFeed:
    """Gives the rows of truth of one bench their cycle numbers and time stamps, and passes them to `on_truth`."""

    def __init__(self, fill: Callable[[Vector], None], on_truth: OnTruth | None) -> None:
        """`fill`: fills a block with the present truth.

        `on_truth`: called with (cycle, t_ns, block) for each row; None: rows are only counted. The next row overwrites
        the block.
        """
        self.on_truth = on_truth
        self.cycle = -1
        """Of the last row, -1 before the first."""
        self._fill = fill
        self._block = np.zeros(TRUTH_LAYOUT.size)
        self._sync_stamp_ns = self._sync_cycle = 0

    def add_sync_row(self, cycle: int, stamp_ns: int) -> None:
        """Add the row of truth of SYNC number `cycle`, stamped `stamp_ns`: call `on_truth` with the present truth.

        Later rows count from this SYNC. Without `on_truth` only the numbers are stored.
        """
        self._sync_stamp_ns, self._sync_cycle = stamp_ns, cycle
        self.add_later_row(0, 0)

    def add_later_row(self, periods: int, period_ns: int) -> None:
        """Add the row of truth `periods` periods after the last SYNC's row: call `on_truth` with the present truth.

        Its stamp is that SYNC's plus `periods` times `period_ns`. Without `on_truth` only `cycle` changes.
        """
        self.cycle = self._sync_cycle + periods
        if self.on_truth is not None:
            self._fill(self._block)
            self.on_truth(self.cycle, self._sync_stamp_ns + periods * period_ns, self._block)


class TruthLog(Recorder):
    """Log file of the truth; its `write` serves as a Bench's `on_truth`."""

    def __init__(
        self,
        path: Path,
        *,
        blocking: bool,
        metadata: Mapping[str, str] | None = None,
        scenario: Scenario | None = None,
        epoch_ns: int = 0,
    ) -> None:
        """Create the file. `blocking`: wait for the writer rather than lose a cycle.

        scenario: attached, and its faults and truth are named in the metadata. epoch_ns: added to t_ns for the log's
        times.

        Raises LogExistsError if there is a log already, LogError if it can't be written.
        """
        faults = () if scenario is None else scenario.faults
        truth = {} if scenario is None or not scenario.truth else {"truth": scenario.truth}
        super().__init__(
            path,
            attachments={} if scenario is None else {SCENARIO_NAME: to_toml(scenario).encode()},
            metadata={
                **(metadata or {}),
                **truth,
                **{f"fault_{index}": row.timed_text for index, row in enumerate(faults)},
            },
            epoch_ns=epoch_ns,
            blocking=blocking,
            messages=(),
            channels=truth_channels(),
        )

    def write(self, cycle: int, t_ns: int, block: Vector) -> None:
        """Log the truth of one cycle; `block` is laid out by TRUTH_LAYOUT.

        With a full ring it waits if the log is `blocking`, else it drops and counts the cycle.
        """
        self.cycle(t_ns, ((TRUTH.id, TRUTH.pack(cycle, block=block)),))

    def discard(self) -> None:
        """Close the log and delete all its parts. Raises OSError if one can't be deleted."""
        self.close()
        for part in find_parts(self.path).values():
            part.unlink()


LONGEST_ORPHANAGE_NS = 5_000_000_000
"""How long an arm is watched whose host has died; braking takes 1 s at most, coasting with friction a few more."""
_FIRST_OVERDUE = 4
"""By the clock, rows of truth are added from so many periods after the last SYNC on; a lost SYNC or two leave a gap."""
_REST_NS = 50_000_000
"""At rest: at a drive's standstill for so long, by the velocity that the drives know."""


class BenchTime:
    """The time of one bench, and of the arm on it."""

    def __init__(
        self, is_wall: bool, nodes: BenchNodes, arm: MovableArm, injector: Injector, outbox: Outbox, rows: TruthFeed
    ) -> None:
        """Begin before power-on. `is_wall`: time goes by the clock of the caller, who gives the times, else by SYNC."""
        self.now_ns = 0
        """By SYNC: time of power-on plus the periods since then. By wall: the clock's time."""
        self.due_ns = NEVER_NS
        """When something is due by time."""
        self.has_begun = False
        """Whether a SYNC has sampled the arm."""
        self._is_wall = is_wall
        self._nodes = nodes
        self._arm = arm
        self._injector = injector
        self._outbox = outbox
        self._rows = rows
        self._arm_ns = 0  # up to here the arm has moved
        self._sync_ns = 0  # the last SYNC
        self._moving_ns = 0  # when the arm last moved, or could
        self._has_outlived = False  # a host, since the last SYNC
        self._is_orphaned = False  # time passes without a host
        self._granted = 0  # frames that had gone out when time was last granted
        self._granted_ns = 0  # on the host's clock
        self._ahead_ns = 0  # of the bench's time over the host's

    @property
    def host_ns(self) -> int:
        """The bench's time, ns, on the clock of a host in lockstep; the bench's own before lockstep began."""
        return self.now_ns - self._ahead_ns

    @property
    def is_at_rest(self) -> bool:
        """Whether the arm has stood still by the drives' velocities, and no drive has had power, for `_REST_NS`.

        A call while the arm moves or a drive has power restarts that time. Motion between two calls is missed.
        """
        return self._has_rested(self.now_ns)

    def begin(self, t_ns: int) -> None:
        """Set the time of bench and arm to `t_ns`."""
        self.now_ns = self._arm_ns = t_ns

    def advance(self, dt_ns: int) -> None:
        """Advance the bench's time by `dt_ns`, and move the arm by the whole ticks that have passed."""
        self.now_ns += dt_ns
        self._move_arm(self.now_ns)

    def advance_to(self, t_ns: int) -> None:
        """Advance the time to `t_ns` without frames: heartbeats, event timers and watchdogs act when they are due.

        Faults and held frames do, too.
        """
        while self.due_ns <= t_ns:
            self._act_at(max(self.due_ns, self.now_ns))
        self.reach(t_ns)

    def reach(self, t_ns: int) -> None:
        """Advance the bench's time to `t_ns` without letting timers act; an earlier time changes nothing.

        In clock mode `wall` the arm moves. In `sync` it waits, except while a drive brakes as it has lost its host, or
        in `outlive_host`. Where it moves, set-points are latched and rows of truth added, as `_advance_without_sync`
        does.
        """
        dt_ns = max(0, t_ns - self.now_ns)
        if self._is_wall or self._is_orphaned or any(drive.is_left_alone for drive in self._nodes.drives):
            self._advance_without_sync(dt_ns)
        else:
            self.now_ns += dt_ns
            self._arm_ns += dt_ns
            self._sync_ns += dt_ns

    def reach_sync(self, lost: int) -> None:
        """In clock mode `sync`, advance by one period per lost SYNC, then by the period before this SYNC.

        Nothing happens before the first SYNC, or in clock mode `wall`.
        """
        if not self._is_wall and self.has_begun:
            self.pass_lost_syncs(lost)
            self.advance(self._nodes.period_ns)

    def pass_lost_syncs(self, count: int) -> None:
        """Advance by `count` periods; at the end of each the drives count a lost SYNC, then set-points are latched."""
        for _ in range(count):
            self.advance(self._nodes.period_ns)
            for drive in self._nodes.drives:
                drive.on_lost_sync(self.now_ns)
            self._nodes.latch_motors()

    def delay_sample(self, late_ns: int) -> None:
        """Move the arm to `late_ns` after the bench's time, when a late SYNC reaches the devices."""
        self._move_arm(self.now_ns + late_ns)

    def end_sync(self, cycle: int, stamp_ns: int) -> None:
        """Latch the drives' set-points, and add the row of truth of a SYNC, none before the first cycle (`cycle` -1).

        Call it also if no device has heard the SYNC. stamp_ns: time of the SYNC frame, unused in lockstep.
        """
        self._sync_ns, self._has_outlived = self.now_ns, False
        self._nodes.latch_motors()
        if cycle >= 0:
            self._rows.add_sync_row(cycle, self.host_ns if self._outbox.is_paced else stamp_ns)

    def poll(self, t_ns: int) -> None:
        """Let the nodes act on timers that are due at `t_ns`; set `due_ns` to the next timer, fault or held frame."""
        self.due_ns = min(self._nodes.poll(t_ns), self._injector.due_ns, self._outbox.due_ns)

    def advance_faults(self, stamp_ns: int, ahead_ns: int = 0) -> None:
        """Begin and end the faults that are due within `ahead_ns` of now, and queue the frames of babbling nodes.

        Those frames are of the period that begins `ahead_ns` from now. Do nothing without faults in the scenario.
        stamp_ns: time of the faults' events, unused in lockstep, where the host's time counts.
        """
        is_paced = self._outbox.is_paced
        self._injector.advance(self.now_ns + ahead_ns, self.host_ns + ahead_ns if is_paced else stamp_ns)
        self._injector.flood(self._nodes.period_ns)

    def take_mark(self, data: bytes, _t_ns: int) -> None:
        """On an ADVANCE mark, let time pass to the mark's time or until a frame is sent; then send a GRANT mark.

        Time stays if frames have been sent since the last GRANT mark or `note_sent`. Lockstep begins with the first
        ADVANCE mark, anew with the next one after `Bench.release`, and with one that is earlier than the last grant.
        Other data has no effect.
        """
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
            self._act_at(max(self.due_ns, self.now_ns))
        if outbox.sent == self._granted:
            self.reach(target_ns)
        self._granted = outbox.sent
        self._granted_ns = self.host_ns
        outbox.mark(MarkKind.GRANT, self._granted_ns)

    def note_sent(self) -> None:
        """Store that the host has all frames sent so far: only later ones end the next `take_mark` early."""
        self._granted = self._outbox.sent

    def outlive_host(self) -> None:
        """In clock mode `sync`, advance the time without a host until the arm is at rest, at most LONGEST_ORPHANAGE_NS.

        The drives then miss SYNC as in clock mode `wall`. Do nothing before the first SYNC, and in later calls until
        the next SYNC.
        """
        if self._is_wall or not self.has_begun or self._has_outlived:
            return
        self._has_outlived = self._is_orphaned = True
        for drive in self._nodes.drives:
            drive.is_free_running = True
        end_ns = self.now_ns + LONGEST_ORPHANAGE_NS
        self.poll(self.now_ns)
        while not self.is_at_rest and self.now_ns < end_ns:
            self.advance_to(self.now_ns + self._nodes.period_ns)
        for drive in self._nodes.drives:
            drive.is_free_running = False
        self._is_orphaned = False

    def _act_at(self, t_ns: int) -> None:
        """Advance to `t_ns`, then let faults, held frames and the nodes' timers act that are due."""
        self.reach(t_ns)
        self.advance_faults(t_ns)
        self._outbox.release(self.now_ns)
        self.poll(self.now_ns)

    def _advance_without_sync(self, dt_ns: int) -> None:
        """Latch the drives' set-points, and advance arm and time by `dt_ns` without a SYNC.

        Add a row of truth per period until the arm rests, in clock mode `wall` from period number `_FIRST_OVERDUE`
        after the last SYNC on; none before the first row of a SYNC.
        """
        end_ns, period_ns = self.now_ns + dt_ns, self._nodes.period_ns
        first = _FIRST_OVERDUE if self._is_wall else 1
        self._nodes.latch_motors()
        while self._rows.cycle >= 0:
            periods = max(first, (self.now_ns - self._sync_ns) // period_ns + 1)
            row_ns = self._sync_ns + periods * period_ns
            if row_ns > end_ns:
                break
            self.advance(row_ns - self.now_ns)
            if not self._has_rested(row_ns):
                self._rows.add_later_row(periods, period_ns)
        self.advance(end_ns - self.now_ns)

    def _move_arm(self, until_ns: int) -> None:
        tick_count = (until_ns - self._arm_ns) // TICK_NS
        if tick_count > 0:
            self._arm_ns += tick_count * TICK_NS
            self._nodes.move_arm(tick_count)

    def _has_rested(self, now_ns: int) -> bool:
        """Return whether the arm has stood still for `_REST_NS` and no drive could move it.

        Call it often while the arm may move: each call with a moving arm or a powered drive restarts that time.
        """
        is_powered = any(drive.motor_mode for drive in self._nodes.drives)
        if is_powered or max(map(abs, self._arm.drive_velocity_rad_s)) > REST_RAD_S:
            self._moving_ns = now_ns
        return now_ns - self._moving_ns >= _REST_NS
