"""What becomes of a run whose host misses too many periods."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rig import SessionRig, transition

from adacd_hil.device.arm_watch import DeadlineWatch
from adacd_hil.log.reader import RunLog
from adacd_hil.records import ArmState, FaultReason, SchemeState
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.settings.run_settings import RealtimeSettings

STALL_CYCLE = 600
ON_TIME = ArmState(
    0, 0, 1, np.zeros(2), np.zeros(2), np.zeros(2), (0, 0), (0, 0), is_enabled=True, is_complete=True,
    fault=FaultReason.NONE,
)  # fmt: skip


def judged(steps: list[tuple[int, int]], fault: FaultReason = FaultReason.NONE, **realtime: Any) -> ArmState:
    """Tell a watch at 1 kHz of cycles by the periods since the one before, times a count; return its last judgement."""
    settings = RealtimeSettings(**({"misses": 3, "misses_window_s": 0.1} | realtime))
    watch, cycle = DeadlineWatch(dataclasses.replace(load_settings(), realtime=settings)), 0
    for periods in [periods for periods, count in steps for _ in range(count)]:
        cycle += periods
        arm = watch.judge(ON_TIME._replace(cycle=cycle, periods=periods, fault=fault))
    return arm


@pytest.mark.parametrize(
    ("steps", "is_late"),
    [
        ([(3, 1)], False),
        ([(4, 1)], True),
        ([(2, 1), (1, 40), (2, 1), (1, 40), (2, 1)], True),
        ([(2, 1), (1, 49)] * 20, False),
        ([(4, 1), (1, 99)], True),
        ([(4, 1), (1, 100)], False),
    ],
    ids=["a stall", "a longer one", "they add up within the window", "further apart", "in it yet", "a window later"],
)
def test_a_host_is_late_while_it_has_missed_too_many_periods_within_the_window(
    steps: list[tuple[int, int]], is_late: bool
) -> None:
    assert judged(steps, on_misses="hold").is_late is is_late
    assert judged(steps, on_misses="hold").fault is FaultReason.NONE  # the arm is held
    assert judged(steps).fault is (FaultReason.DEADLINE if is_late else FaultReason.NONE)


def test_many_misses_that_leave_the_window_at_once_are_all_forgotten() -> None:
    assert not judged([(2, 4), (1, 92), (8, 1)], misses=9, on_misses="hold").is_late


def test_a_fault_of_the_arm_keeps_its_name() -> None:
    assert judged([(9, 1)], FaultReason.SENSOR).fault is FaultReason.SENSOR


def play(folder: Path, on_misses: str, misses: int = 3, emergency: str = "") -> RunLog:
    """Let an arm that is soon adapted move, and its host stall for 5 ms in the middle, before an EMCY of drive 1."""
    rig = SessionRig(folder, finish_s=0.7)
    settings = rig.session.settings
    rig.session.settings = dataclasses.replace(
        settings,
        bus=dataclasses.replace(settings.bus, command_patience_cycles=250, sync_patience_periods=25.0),
        termination=dataclasses.replace(
            settings.termination, hold_s=0.1, beta_Nm=100.0, travel_deg=0.0, velocity_deg_s=0.0, excitation_Nm2s=0.0
        ),
        detector=dataclasses.replace(settings.detector, threshold_Nm=(50.0, 50.0)),
        operator=dataclasses.replace(settings.operator, acknowledge_after_s=0.0),
        realtime=RealtimeSettings(misses=misses, on_misses=on_misses),
    )
    clock = rig.session.clock
    rig.before_sync[STALL_CYCLE] = lambda: clock.sleep_until_ns(clock.now_ns() + 5_100_000)
    if emergency:
        rig.before_sync[STALL_CYCLE + 10] = lambda: rig.bus.deliver(0x081, bytes.fromhex(emergency))
    return rig.run()[1]


@pytest.mark.slow
def test_a_host_that_stalls_faults_with_a_quick_stop_and_says_how_many_it_missed(tmp_path: Path) -> None:
    log = play(tmp_path, "stop")
    assert FaultReason(int(log.scheme["fault"][-1])) is FaultReason.DEADLINE
    assert transition(log, "FAULT") == "MONITOR -> FAULT: DEADLINE; 4 periods missed within 1 s; 3 are too many"
    assert log.control["quick_stop"][-1]


@pytest.mark.slow
def test_a_drive_that_faults_after_a_stall_of_the_host_is_told_with_the_stall_before_it(tmp_path: Path) -> None:
    said = transition(play(tmp_path, "stop", misses=5, emergency="0087010000000000"), "FAULT")
    assert said.startswith("MONITOR -> FAULT: DRIVE; 4 periods missed within 1 s; 5 are too many; Drive1: ")


@pytest.mark.slow
def test_a_host_that_stalls_brakes_the_arm_and_holds_it_and_reports_no_contact(tmp_path: Path) -> None:
    log = play(tmp_path, "hold")
    state = log.scheme["state"]
    (began,) = np.flatnonzero((state[1:] == SchemeState.REACT) & (state[:-1] == SchemeState.MONITOR)) + 1
    is_held = state[began:] == SchemeState.STOPPED
    assert is_held.any()
    speed = np.abs(log.control["dq_d"][began:][: np.argmax(is_held) + 1])
    assert speed[0].max() > 0.1
    assert np.all(speed[-1] == 0.0)
    assert np.all(np.diff(speed, axis=0) <= 0.0)  # it brakes, and goes nowhere first
    assert not log.contacts
    assert transition(log, "REACT") == "MONITOR -> REACT: DEADLINE; 4 periods missed within 1 s; 3 are too many"
