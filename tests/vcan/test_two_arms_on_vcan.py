"""Two arms as processes on real SocketCAN, on one bus with one SYNC."""

import contextlib
import signal
import subprocess
from dataclasses import dataclass

import numpy as np
import pytest
from experiment_runs import BIN, Played, adacd_hil, firmware_sim
from hang import HANG_S
from test_on_vcan import longest_stall_cycles

from adacd_hil.clock import MonotonicClock
from adacd_hil.log.reader import RunLog, read_log
from adacd_hil.wire.can_interface import CanInterface
from adacd_hil.wire.socketcan import SocketCanBus

pytestmark = [pytest.mark.vcan, pytest.mark.slow, pytest.mark.realtime]

FIRST, SECOND = 0, 1
# User-mode Linux has one processor for two hosts and two arms, and stalls for longer than an arm should forgive. Here
# it may: soft control bears periods without a command. At 2 ms both run in virtual time, in test_two_arms.py.
MAX_AGE_CYCLES = 100
BORNE_CYCLES = 20
"""Periods with the same torque that this motion bears; after 74 a joint was 33° beyond its limit."""
PATIENT = f"""
[controller]
Kp = [20.0, 2.0]
Kd = [4.0, 0.3]
[safety]
commission_s = 0.5
phase_timeout_s = 60.0
[realtime]
misses = 1000000
[bus]
period_us = 10000
heartbeat_ms = 2000
command_patience_cycles = 250
max_age_cycles = {MAX_AGE_CYCLES}
sync_timeout_ms = 30000
"""
ARMS = (
    'arms = 2\nhost_node = 127\n[operator]\nscript = [{ at_s = 600.0, request = "finish" }]\n',
    'arms = 2\nhost_node = 126\nsync = "follow"\n'
    "[devices]\ndrive_node = [5, 6]\nsensor_node = [7, 8]\n"
    '[operator]\nscript = [{ at_s = 2.0, request = "finish" }]\n',
)


@dataclass(frozen=True)
class TwoArms:
    """What two hosts left behind."""

    hosts: tuple[Played, Played]
    logs: tuple[RunLog, RunLog]


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> TwoArms:
    """Let both arms move on one bus; the first host, which sends SYNC, is interrupted when the second has ended."""
    folder = tmp_path_factory.mktemp("shared")
    configs = []
    for arm, text in enumerate(ARMS):
        configs.append(folder / f"arm{arm + 1}.toml")
        configs[arm].write_text(PATIENT + text)
    with contextlib.ExitStack() as stack:
        for options in ((), ("--node-offset", "4", "--host-node", "126")):
            stack.enter_context(firmware_sim("run", "-i", "socketcan", "-c", "vcan0", "--scenario", "idle", *options))
        on_bus = ("run", "-i", "socketcan", "-c", "vcan0", "--json", "--config")
        command = [BIN / "adacd-hil", *on_bus, configs[FIRST], "--out", folder / "first"]
        first = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        stack.callback(first.kill)
        second = adacd_hil(folder, *on_bus, str(configs[SECOND]), "--out", str(folder / "second"))
        first.send_signal(signal.SIGINT)
        stdout, stderr = first.communicate(timeout=HANG_S)
    stall = max(longest_stall_cycles(folder / name / "run.mcap") for name in ("first", "second"))
    if stall > BORNE_CYCLES:
        pytest.skip(f"the machine stalled for {10 * stall} ms, longer than the arms bear")
    hosts = (Played(folder / "first", first.returncode, stdout, stderr), second)
    logs = (read_log(folder / "first" / "run.mcap"), read_log(folder / "second" / "run.mcap"))
    return TwoArms(hosts, logs)


def test_both_arms_end_as_asked(shared: TwoArms) -> None:
    first, second = shared.hosts
    assert (second.status, second.json["fault"]) == (0, "NONE"), second.stderr
    assert (first.status, first.json["fault"]) == (130, "NONE"), first.stderr


@pytest.mark.parametrize(("arm", "is_sent"), [(FIRST, True), (SECOND, False)])
def test_both_arms_move_by_the_sync_that_the_first_host_sends(shared: TwoArms, arm: int, is_sent: bool) -> None:
    log = shared.logs[arm]
    sync = log.frames[log.frames["can_id"] == 0x080]
    assert len(sync) > 50
    assert set(sync["is_tx"].tolist()) == {is_sent}
    assert np.abs(np.degrees(log.scheme["q"])).max() > 5.0


class _Adapter(CanInterface):
    """Says that a controller is there, and counts how often it is taken down."""

    restarts = 0
    is_virtual = False

    def take_down_and_up(self) -> None:
        self.restarts += 1


@pytest.mark.parametrize(("is_shared", "is_alive", "restarts"), [(True, True, 0), (True, False, 1), (False, True, 1)])
def test_a_shared_interface_is_not_taken_down_while_frames_are_on_it(
    is_shared: bool, is_alive: bool, restarts: int
) -> None:
    bus = SocketCanBus("vcan1", MonotonicClock(), is_shared=is_shared)
    bus._interface = adapter = _Adapter("vcan1")
    with contextlib.ExitStack() as stack:
        if is_alive:
            command = ["cangen", "vcan1", "-g", "20"]
            neighbour = stack.enter_context(subprocess.Popen(command))
            stack.callback(neighbour.terminate)
        bus.recover()
    bus.close()
    assert adapter.restarts == restarts
