"""After an emergency stop nobody acknowledges; what waits in the transmit queue must not get out when power returns."""

from pathlib import Path

import pytest
from rig import CycleRig, messages, torque_of

from adacd_hil.control.fault_recovery import Recovery
from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.wire.bus import TransmitQueueError

pytestmark = pytest.mark.slow

STOP_CYCLE = 800


def stopped_rig(folder: Path, queue_length: int) -> CycleRig:
    """Run until an emergency stop: from one SYNC on nobody acknowledges, and the queue fills up."""
    rig = CycleRig(folder, queue_length=queue_length)

    def stop() -> None:
        rig.queue.is_acknowledged = False

    rig.after_sync[STOP_CYCLE] = stop
    with pytest.raises(TransmitQueueError):
        rig.run()
    assert len(rig.queue.waiting_frames) == queue_length
    rig.sent.clear()
    return rig


@pytest.mark.parametrize("queue_length", [10, 512])
def test_without_recovery_an_old_torque_would_get_out(tmp_path: Path, queue_length: int) -> None:
    rig = stopped_rig(tmp_path, queue_length)
    rig.queue.is_acknowledged = True
    assert len(rig.sent) == queue_length
    assert any(torque_of(frame) for frame in rig.sent)
    rig.read()


@pytest.mark.parametrize("queue_length", [10, 512])
def test_recovery_leaves_no_old_command_to_get_out(tmp_path: Path, queue_length: int) -> None:
    rig = stopped_rig(tmp_path, queue_length)
    operator = ScriptedOperator(rig.settings.operator)
    recovery = Recovery(rig.tap, rig.clock, operator, rig.recorder, lambda _: None, lambda: False)
    assert recovery.empty()
    rig.queue.is_acknowledged = True
    assert rig.sent == []
    assert messages(rig.read(), "recovery") == ["transmit queue emptied"]
