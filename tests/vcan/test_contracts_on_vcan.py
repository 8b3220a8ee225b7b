"""CAN FD on real SocketCAN: devices booted, mapped, enabled, moved, stopped.

The contract with a period of 0.5 ms stands for the others: arm_fd differs from it in layout, arm_stock from the classic
one in what its frames hold.
"""

from pathlib import Path

import numpy as np
import pytest
from experiment_runs import emulator, run_on_vcan

from adacd_hil.log.reader import read_log

pytestmark = [pytest.mark.vcan, pytest.mark.slow]

LENGTH = 16
"""Bytes of a feedback frame."""


@pytest.mark.long
def test_an_arm_on_can_fd_runs_at_half_a_millisecond(tmp_path: Path) -> None:
    settings = tmp_path / "short.toml"
    settings.write_text('extends = "fd_500us"\n[operator]\nscript = [{ at_s = 0.3, request = "finish" }]\n')
    with emulator(tmp_path, "--scenario", "idle", "--contract", "arm_fd_500us"):
        played = run_on_vcan(tmp_path, "--config", str(settings), "--clock", "lockstep")
    assert played.status == 0, played.stderr
    log = read_log(played.log)
    feedback = log.frames[log.frames["can_id"] == 0x181]
    assert set(feedback["length"].tolist()) == {LENGTH}
    assert np.abs(np.degrees(log.scheme["q"][-1])).max() > 5.0  # on its way to the corner, or there
    assert (log.cycle["frames_missing"] > 0).sum() <= 1
