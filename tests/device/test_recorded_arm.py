"""The arm from a run's log against what the same run's loop saw of it, bit for bit."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from fault_rig import run_realtime, scenario_of
from numpy.typing import NDArray
from rig import CODEC, CycleRig, SessionRig, scripted

from adacd_hil.device.arm_watch import ArmWatch
from adacd_hil.device.device_files import place_devices
from adacd_hil.device.recorded_arm import RecordedArm, Ticks
from adacd_hil.log.reader import RunLog
from adacd_hil.records import ArmBatch, ArmState, FaultReason
from adacd_hil.replay.logged_arms import logged_arms
from adacd_hil.settings.configuration import Settings

pytestmark = pytest.mark.slow

TROUBLES = [
    {"kind": "lose", "node": "sensor1", "frame": "torque", "count": 2, "at_s": 0.02},
    {"kind": "duplicate", "node": "all", "frame": "torque", "count": 3, "at_s": 0.04},
    {"kind": "corrupt", "node": "sensor2", "frame": "torque", "bits": 2, "count": 2, "at_s": 0.06},
    {"kind": "reorder", "node": "sensor1", "frame": "torque", "count": 1, "at_s": 0.08},
    {"kind": "corrupt", "node": "drive1", "frame": "feedback", "mask": "00001000", "count": 1, "at_s": 0.1},
    {"kind": "delay", "node": "sensor1", "frame": "torque", "delay_us": 1500.0, "duration_s": 0.01, "at_s": 0.12},
    {"kind": "emcy_storm", "node": "sensor1", "code": 0x0010, "rate_Hz": 500.0, "duration_s": 0.02, "at_s": 0.14},
    {"kind": "silence", "node": "all", "duration_s": 0.002, "at_s": 0.16},
    {"kind": "drive_fault", "node": "drive1", "code": 0x2310, "at_s": 0.2},
]


class Live(NamedTuple):
    """A run: what the arm was in each cycle, and the log."""

    settings: Settings
    states: list[ArmState]
    log: RunLog

    def recorded_arm(self) -> RecordedArm:
        return RecordedArm(self.settings, CODEC, place_devices(self.settings))

    def read(self) -> ArmBatch:
        """Read the arm from the log, all at once."""
        return self.recorded_arm().read(ticks_of(self.log), self.log.frames)

    def logged(self) -> ArmBatch:
        """Take what the log says that the arm was."""
        log = self.log
        return logged_arms(log.scheme.records, log.topics["/arm"].records, ticks_of(log))


@contextmanager
def live_states() -> Iterator[list[ArmState]]:
    """Collect the states of all cycles that are run while the block lasts."""
    states: list[ArmState] = []
    judge = ArmWatch.judge

    def listen(watch: ArmWatch, arm: ArmState) -> ArmState:
        states.append(judge(watch, arm))
        return states[-1]

    ArmWatch.judge = listen  # type: ignore[method-assign]
    try:
        yield states
    finally:
        ArmWatch.judge = judge  # type: ignore[method-assign]


def ticks_of(log: RunLog) -> Ticks:
    arm = log.topics["/arm"]
    return Ticks(arm["cycle"].astype(np.int64), arm.t_ns, arm["periods"])


def differences(live: list[ArmState], batch: ArmBatch) -> list[str]:
    """Name what isn't the same bit for bit, with the first cycle."""
    if len(live) != len(batch.cycle):
        return [f"{len(live)} cycles live, {len(batch.cycle)} recorded"]
    lines = []
    for name in ArmState._fields:
        found: NDArray[Any] = getattr(batch, name)
        due = np.array([getattr(state, name) for state in live], found.dtype)
        if found.tobytes() != due.tobytes():
            place = np.flatnonzero((found != due).reshape(len(due), -1).any(axis=1))[0]
            lines.append(f"{name} in cycle {live[place].cycle}: {found[place]}, live {due[place]}")
    return lines


@pytest.fixture(scope="module")
def troubled(tmp_path_factory: pytest.TempPathFactory) -> Live:
    """Play a run with many faults in lockstep, the last of which begins a second attempt."""
    settings = scripted(finish_s=0.3, acknowledge_faults=1, acknowledge_fault_after_s=0.05)
    rig = SessionRig(tmp_path_factory.mktemp("troubled"), settings, scenario_of(TROUBLES), is_modelled=True)
    with live_states() as states:
        _, log = rig.run()
    return Live(settings, states, log)


@pytest.fixture(scope="module")
def read(troubled: Live) -> ArmBatch:
    return troubled.read()


def test_lost_repeated_wrong_and_late_frames_come_out_as_the_loop_took_them(troubled: Live, read: ArmBatch) -> None:
    assert differences(troubled.states, read) == []
    assert differences(troubled.states, troubled.logged()) == []


def test_the_run_that_is_compared_has_old_values_and_a_fault(read: ArmBatch) -> None:
    assert set(np.unique(read.age_tau_J)) == {0, 1, 2}
    assert set(np.unique(read.age_q)) >= {0, 1, 2}
    assert set(np.unique(read.fault)) == {FaultReason.NONE, FaultReason.DRIVE}
    assert np.count_nonzero(~read.is_complete) >= 10


def _piece(ticks: Ticks, frames: NDArray[Any], cycles: slice) -> tuple[Ticks, NDArray[Any]]:
    """Cut out some cycles with their frames and those that were logged since the cycle before."""
    first, last, _ = cycles.indices(len(ticks.cycle))
    low_ns = ticks.t_ns[first - 1] if first else -1
    high_ns = ticks.t_ns[last - 1] if last else -1
    is_inside = (frames["cycle_t_ns"] > low_ns) & (frames["cycle_t_ns"] <= high_ns)
    return Ticks(*(column[cycles] for column in ticks)), frames[is_inside]


def test_a_run_read_in_pieces_is_the_same_run(troubled: Live) -> None:
    arm = troubled.recorded_arm()
    ticks, frames = ticks_of(troubled.log), troubled.log.frames
    states = iter(troubled.states)
    for first, last in ((0, 0), (0, 1), (1, 230), (230, 231), (231, 700), (700, len(ticks.cycle))):
        batch = arm.read(*_piece(ticks, frames, slice(first, last)))
        assert differences([next(states) for _ in range(last - first)], batch) == []


def test_frames_that_come_after_their_cycle_in_real_time_are_of_the_cycle_before(tmp_path: Path) -> None:
    rows = [
        {"kind": "delay", "node": "sensor1", "frame": "torque", "delay_us": 800.0, "duration_s": 0.02, "at_s": 0.05},
        {"kind": "lose", "node": "sensor1", "frame": "heartbeat", "at_s": 0.06},
    ]
    with live_states() as states:
        outcome = run_realtime(tmp_path, rows, finish_s=0.6)
    batch = Live(scripted(finish_s=0.6, acknowledge_after_s=0.6), states, outcome.log).read()
    assert differences(states, batch) == []
    assert FaultReason.HEARTBEAT in batch.fault
    assert batch.age_tau_J.max() == 1


def test_a_host_that_skipped_periods_is_late_in_its_recording_too(tmp_path: Path) -> None:
    rig = CycleRig(tmp_path, finish_s=0.1)
    for cycle, periods in ((230, 2), (240, 3), (250, 9)):
        rig.after_sync[cycle] = lambda periods=periods: rig.clock.sleep_until_ns(
            rig.clock.now_ns() + periods * rig.settings.bus.period_ns
        )
    with live_states() as states:
        rig.run()
    live = Live(rig.settings, states, rig.read())
    batch = live.read()
    assert differences(states, batch) == []
    assert differences(states, live.logged()) == []
    assert batch.periods.max() == 9
    assert FaultReason.DEADLINE in batch.fault
