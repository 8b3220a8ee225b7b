"""Devices of other contracts on real SocketCAN, CAN FD included: booted, mapped, enabled, moved, stopped."""

from pathlib import Path

import numpy as np
import pytest
from experiment_runs import emulator, run_on_vcan

from adacd_hil.log.reader import read_log

pytestmark = [pytest.mark.vcan, pytest.mark.slow]


@pytest.mark.parametrize(
    ("config", "contract", "length"),
    [("fd_500us", "arm_fd_500us", 16), ("stock", "arm_stock", 8)],  # arm_fd differs in layout only
)
def test_an_arm_of_another_contract_runs(tmp_path: Path, config: str, contract: str, length: int) -> None:
    settings = tmp_path / "short.toml"
    settings.write_text(f'extends = "{config}"\n[operator]\nscript = [{{ at_s = 0.3, request = "finish" }}]\n')
    with emulator(tmp_path, "--scenario", "idle", "--contract", contract):
        played = run_on_vcan(tmp_path, "--config", str(settings), "--clock", "lockstep")
    assert played.status == 0, played.stderr
    log = read_log(played.log)
    feedback = log.frames[log.frames["can_id"] == 0x181]
    assert set(feedback["length"].tolist()) == {length}
    assert np.abs(np.degrees(log.scheme["q"][-1])).max() > 5.0  # on its way to the corner, or there
    assert (log.cycle["frames_missing"] > 0).sum() <= 1
