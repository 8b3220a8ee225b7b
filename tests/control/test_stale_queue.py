"""After an emergency stop nobody acknowledges; what waits in the transmit queue must not get out when power returns."""

from pathlib import Path

import pytest
from rig import CycleRig, messages, torque_of

from adacd_hil.control.fault_recovery import Recovery
from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.wire.bus import TransmitQueueError

pytestmark = pytest.mark.slow

STOP_CYCLE = 800


@pytest.mark.parametrize("queue_length", [10, 512])
def test_recovery_leaves_no_old_command_to_get_out(tmp_path: Path, queue_length: int) -> None:
    """From one SYNC on nobody acknowledges, and the queue fills up."""
    rig = CycleRig(tmp_path, queue_length=queue_length)

    def stop() -> None:
        rig.queue.is_acknowledged = False

    rig.after_sync[STOP_CYCLE] = stop
    with pytest.raises(TransmitQueueError):
        rig.run()
    assert len(rig.queue.waiting_frames) == queue_length
    assert {0x201, 0x202} <= set(rig.queue.waiting_frames)
    assert any(torque_of(frame) for frame in rig.sent[-10:])
    rig.sent.clear()
    operator = ScriptedOperator(rig.settings.operator)
    recovery = Recovery(rig.tap, rig.clock, operator, rig.recorder, lambda _: None, lambda: False)
    assert recovery.empty()
    rig.queue.is_acknowledged = True
    assert rig.sent == []
    assert messages(rig.read(), "recovery") == ["transmit queue emptied"]
