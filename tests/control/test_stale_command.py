"""A process that is stopped in the middle of a cycle must not go on with the torque that it had in mind."""

from pathlib import Path

import numpy as np
import pytest
from rig import CycleRig, torque_of

from adacd_hil.wire.bus import Frame

pytestmark = pytest.mark.slow

STALL_CYCLE = 800


@pytest.mark.parametrize(("stall_ns", "is_zero"), [(2_900_000, False), (3_100_000, True)])
def test_a_command_that_comes_later_than_the_age_budget_carries_no_torque(
    tmp_path: Path, stall_ns: int, is_zero: bool
) -> None:
    rig = CycleRig(tmp_path)
    rig.after_sync[STALL_CYCLE] = lambda: rig.clock.sleep_until_ns(rig.clock.now_ns() + stall_ns)
    rig.run()
    log = rig.read()
    (row,) = np.flatnonzero(log.control["cycle"] == STALL_CYCLE)
    assert np.all(log.control["tau_c"][row - 1] != 0.0)
    assert np.all(log.control["tau_c"][row] == 0.0) == is_zero
    is_sent = (log.frames["can_id"] == 0x201) & (log.frames["cycle_t_ns"] == log.control.t_ns[row])
    sent = [torque_of(Frame(0x201, data.tobytes()[:6], 0)) for data in log.frames["data"][is_sent]]
    assert (sent == [0]) == is_zero
