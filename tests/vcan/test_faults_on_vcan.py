"""What happens on the wire when a process, an interface or a device goes away: candump is the witness.

SYNC comes every 10 ms here and everybody forgives 25 missing ones, because the machines that run this stall; the exact
times of every watchdog are tested in virtual time. A machine that stalls for longer than that while it matters is
measured doing so, and what fails then is skipped with the reason.
"""

import contextlib
import itertools
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from experiment_runs import BIN, emulator
from hang import HANG_S
from rig import torque_of

from adacd_hil.log.reader import read_log

pytestmark = [pytest.mark.vcan, pytest.mark.slow, pytest.mark.wallclock, pytest.mark.alone]

SYNC_WATCHDOG = 1  # number in byte 3 of an EMCY
WATCHDOG_S = 0.250
MARGIN_S = 0.150  # a stall that is forgiven
CONFIG = """
[bus]
period_us = 10000
heartbeat_ms = 200
max_age_cycles = 25
command_patience_cycles = 25
sync_patience_periods = 25.0

[realtime]
misses = 1000000

[safety]
commission_s = 0.2

[controller]
Kp = [40.0, 6.0]
Kd = [3.0, 0.3]

[operator]
script = [{ at_s = 60.0, request = "finish" }]
"""
ENABLED = (0x27, 0x6F)


class Witnessed(NamedTuple):
    """A frame as candump saw it."""

    t_s: float
    can_id: int
    data: bytes


class StallMeter:
    """Measures the longest time for which this machine didn't run a process that wanted to."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._measure, daemon=True)
        self._thread.start()

    def _measure(self) -> None:
        before_s = time.monotonic()
        while not self._is_over.wait(0.002):
            now_s = time.monotonic()
            self.longest_s = max(self.longest_s, now_s - before_s)
            before_s = now_s

    def stop(self) -> None:
        self._is_over.set()
        self._thread.join()


class Witness:
    """candump on vcan0; a thread takes what it writes, and tells who waits."""

    def __init__(self) -> None:
        command = ["candump", "-D", "-L", "-r", "16777216", "vcan0"]
        self._candump = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self._seen: list[Witnessed] = []
        self._news = threading.Condition()
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def _listen(self) -> None:
        assert self._candump.stdout is not None
        for line in self._candump.stdout:
            frame = parse(line)
            if frame is not None:
                with self._news:
                    self._seen.append(frame)
                    self._news.notify_all()

    def frames(self, since_s: float = 0.0) -> list[Witnessed]:
        """Return what was seen since a time."""
        with self._news:
            return [frame for frame in self._seen if frame.t_s >= since_s]

    def wait_for(self, is_it: Callable[[Witnessed], bool], what: str, since_s: float = 0.0) -> Witnessed:
        """Return the first frame since a time that is it; wait until there is one."""
        deadline_s = time.monotonic() + HANG_S
        looked_at = 0
        with self._news:
            while True:
                for frame in itertools.islice(self._seen, looked_at, None):
                    if frame.t_s >= since_s and is_it(frame):
                        return frame
                looked_at = len(self._seen)
                if not self._news.wait(max(0.0, deadline_s - time.monotonic())):
                    raise AssertionError(f"never saw {what}")

    def close(self) -> None:
        self._candump.kill()
        self._listener.join(HANG_S)
        self._candump.communicate()


class Scene:
    """Host, emulator and witness on vcan0, with the arm moving."""

    def __init__(self, folder: Path, emulator_process: "subprocess.Popen[str]", extra: str) -> None:
        self.emulator = emulator_process
        self.folder = folder
        config = folder / "campaign.toml"
        config.write_text(CONFIG + extra)
        self.witness = Witness()
        self.frames = self.witness.frames
        self.wait_on_wire = self.witness.wait_for
        command = [BIN / "adacd-hil", "run", "-i", "socketcan", "-c", "vcan0", "--config", config, "--out", folder]
        self.host = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        self.said: list[str] = []

    def wait_for(self, words: str) -> None:
        """Read the host's progress until a line has these words."""
        assert self.host.stderr is not None
        for line in self.host.stderr:
            self.said.append(line)
            if words in line:
                return
        raise AssertionError(f"the host never said {words!r}: {''.join(self.said)}")

    def wait_until_moving(self) -> None:
        self.wait_for("-> ADAPT")
        self.wait_on_wire(lambda frame: torque_of(frame) != 0, "a torque")

    def finish(self) -> int:
        """Wait for the host's end and return its exit status."""
        assert self.host.stderr is not None
        self.said.extend(self.host.stderr)
        return self.host.wait(HANG_S)

    def close(self) -> None:
        if self.host.poll() is None:
            self.host.send_signal(signal.SIGCONT)
            self.host.kill()
        self.host.wait(HANG_S)
        self.witness.close()
        assert self.host.stderr is not None
        self.host.stderr.close()


def parse(line: str) -> Witnessed | None:
    """Read a line of candump -L; None for anything but a frame."""
    parts = line.split()
    if len(parts) < 3 or "#" not in parts[2]:
        return None
    can_id, _, data = parts[2].partition("#")
    try:
        return Witnessed(float(parts[0].strip("()")), int(can_id, 16), bytes.fromhex(data))
    except ValueError:
        return None


def is_drive_off(frame: Witnessed) -> bool:
    """Whether a status frame says that its drive is not in Operation enabled."""
    value, mask = ENABLED
    return frame.can_id in (0x281, 0x282) and int.from_bytes(frame.data[:2], "little") & mask != value


def is_emergency(frame: Witnessed, code: int) -> bool:
    return 0x081 <= frame.can_id <= 0x084 and int.from_bytes(frame.data[:2], "little") == code


def assert_drives_stop_by_themselves(played: Scene, number: signal.Signals) -> Witnessed:
    """Take the host away from a moving arm; return the frame by which a drive says that it is off."""
    played.wait_until_moving()
    last = played.frames()[-1]
    os.kill(played.host.pid, number)
    off = played.wait_on_wire(is_drive_off, "a drive off", last.t_s)
    sync = [frame for frame in played.frames() if frame.can_id == 0x080][-1]
    assert off.t_s - sync.t_s < WATCHDOG_S + MARGIN_S
    report = played.wait_on_wire(lambda frame: is_emergency(frame, 0x8700), "EMCY 0x8700", last.t_s)
    assert report.data[3] == SYNC_WATCHDOG
    return off


@contextlib.contextmanager
def scene(folder: Path, extra: str = "") -> Iterator[Scene]:
    """Let the arm move while the block lasts; `extra` ends the host's settings."""
    scenario = folder / "scenario.toml"
    scenario.write_text("start_deg = [-30.0, -60.0]\n")
    with emulator(folder, "--clock", "wall", "--scenario", str(scenario)) as process:
        played = Scene(folder, process, extra)
        meter = StallMeter()
        try:
            yield played
        except AssertionError as error:
            if meter.longest_s > WATCHDOG_S:
                failed = (str(error).splitlines() or ["an assertion"])[0]
                pytest.skip(f"the machine stalled for {meter.longest_s * 1000:.0f} ms; what failed: {failed}")
            raise
        finally:
            meter.stop()
            played.close()
            process.send_signal(signal.SIGCONT)


def test_drives_stop_by_themselves_when_the_host_dies(tmp_path: Path) -> None:
    with scene(tmp_path) as played:
        assert_drives_stop_by_themselves(played, signal.SIGKILL)


@pytest.mark.long
def test_drives_stop_by_themselves_when_the_host_is_stopped_and_it_wakes_up_without_torque(tmp_path: Path) -> None:
    with scene(tmp_path) as played:
        off = assert_drives_stop_by_themselves(played, signal.SIGSTOP)
        os.kill(played.host.pid, signal.SIGCONT)
        assert played.finish() == 4
        assert [frame for frame in played.frames(off.t_s) if torque_of(frame)] == []
        assert any("FAULT: " in line for line in played.said)


@pytest.mark.long
def test_an_interface_that_goes_down_and_comes_back_needs_an_acknowledgement(tmp_path: Path) -> None:
    with scene(tmp_path, "acknowledge_faults = 1\nacknowledge_fault_after_s = 0.5\n") as played:
        played.wait_until_moving()
        subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
        went_down = played.frames()[-1]
        played.wait_for("could not be emptied")
        subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)
        played.wait_for("-> ENABLE")
        played.wait_for("-> ADAPT")
        after = played.frames(went_down.t_s + 0.001)
        first_torque = next((i for i, frame in enumerate(after) if torque_of(frame)), len(after))
        first_reset = next(i for i, frame in enumerate(after) if frame.can_id == 0x000)
        assert first_reset < first_torque
        played.host.send_signal(signal.SIGINT)
        assert played.finish() == 130
    events = [entry.event.message for entry in read_log(tmp_path / "run.mcap").events]
    assert any("is down" in message for message in events), events
