"""Host and emulated arm as two processes on real SocketCAN."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from experiment_runs import BIN, emulator, run_on_vcan

from adacd_hil.log.reader import read_log
from adacd_hil.settings.configuration_files import load_settings

pytestmark = [pytest.mark.vcan, pytest.mark.slow]

SEED = "7"
TWO_CONTACTS = 'extends = "demo_paper"\n[operator]\nscript = [{ at_s = 14.5, request = "finish" }]\n'


STALLING = """
[bus]
command_patience_cycles = 250
max_age_cycles = 100
[realtime]
misses = 1000000
sample_period = "nominal"
"""


@pytest.mark.wallclock
@pytest.mark.realtime
def test_real_time_at_1_khz_detects_the_same_contacts(tmp_path: Path) -> None:
    # A shared machine stalls for longer than an arm should forgive. Here it may: stalls are counted, not hidden, and
    # contacts are judged only where the bus kept up as it has to on an arm.
    config = tmp_path / "patient.toml"
    config.write_text(TWO_CONTACTS + STALLING)
    with emulator(tmp_path, "--seed", SEED):
        played = run_on_vcan(tmp_path, "--config", str(config), "--clock", "realtime")
    stall = longest_stall_cycles(played.log)
    if stall > load_settings().bus.max_age_cycles:
        assert played.status in (0, 3, 4), played.stderr  # through, with a gap in the log, or stopped
        pytest.skip(
            f"the machine stalled for {stall} ms, so the contacts can't be compared; exit status {played.status}"
        )
    assert (played.status, played.json["dropped"]) == (0, 0), played.stderr
    report = subprocess.run(
        [BIN / "adacd-hil", "report", str(tmp_path), "--json"], capture_output=True, text=True, check=True
    )
    (described,) = json.loads(report.stdout)
    contacts = described["contacts"]
    assert (len(contacts), described["missed"], described["false_alarms"]) == (2, 0, 0)
    assert [contact["link_detected"] for contact in contacts] == [1, 1]
    assert all(contact["direction_ok"] for contact in contacts)
    assert described["cycle"]["clock"] == "realtime"


def longest_stall_cycles(path: Path) -> int:
    """Return the longest time without complete data in a log, in cycles, skipped ones included."""
    cycles = read_log(path).topics["/cycle"]
    complete = cycles["cycle"][cycles["frames_missing"] == 0]
    return int(np.diff(complete).max(initial=1)) - 1
