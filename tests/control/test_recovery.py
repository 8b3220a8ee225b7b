"""After a fault: latched until it is acknowledged, then everything from the beginning, at the present position."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from rig import TROUBLE_CYCLE, SessionRig, messages, torques_from

from adacd_hil.control.session import SessionSummary
from adacd_hil.log.reader import RunLog
from adacd_hil.records import FaultReason, SchemeState
from adacd_hil.wire.bus import Frame

pytestmark = pytest.mark.slow

NMT_PRE_OPERATIONAL_DRIVE_1 = Frame(0x000, bytes((0x80, 1)), 0)


def faulting_rig(folder: Path, acknowledge_faults: int) -> SessionRig:
    """Make a run whose drive 1 drops out at the trouble cycle."""
    rig = SessionRig(folder, acknowledge_faults=acknowledge_faults)
    rig.before_sync[TROUBLE_CYCLE] = lambda: rig.bench.on_frame(NMT_PRE_OPERATIONAL_DRIVE_1)
    return rig


def states(log: RunLog) -> list[int]:
    """Return the states in the order in which they were entered."""
    state = log.scheme["state"]
    return state[np.insert(np.diff(state) != 0, 0, True)].tolist()


class Recovered(NamedTuple):
    """A run whose fault was acknowledged; `fault`, `first`, `adapt`: rows of FAULT, of the first and of ADAPT after."""

    summary: SessionSummary
    log: RunLog
    fault: int
    first: int
    adapt: int


@pytest.fixture(scope="module")
def recovered(tmp_path_factory: pytest.TempPathFactory) -> Recovered:
    summary, log = faulting_rig(tmp_path_factory.mktemp("recovered"), acknowledge_faults=1).run()
    state = log.scheme["state"]
    fault = int(np.flatnonzero(state == SchemeState.FAULT)[0])
    first, adapt = (
        fault + int(np.flatnonzero(is_it)[0])
        for is_it in (state[fault:] != SchemeState.FAULT, state[fault:] == SchemeState.ADAPT)
    )
    return Recovered(summary, log, fault, first, adapt)


def test_an_acknowledged_fault_begins_again_with_the_first_check(recovered: Recovered) -> None:
    summary = recovered.summary
    assert summary.recoveries == 1
    assert summary.result is not None
    assert summary.result.fault is FaultReason.NONE
    way_up = [SchemeState.COMMISSION, SchemeState.ENABLE, SchemeState.ADAPT]
    log, first = recovered.log, recovered.first
    assert states(log) == [*way_up, SchemeState.FAULT, *way_up]
    assert messages(log, "recovery") == ["fault acknowledged", "transmit queue emptied"]
    # What the devices said before the recovery is not taken for fresh, and the wait is no part of the run.
    assert log.cycle["frames_missing"][log.cycle["cycle"] == log.scheme["cycle"][first]] == [0]
    (acknowledged,) = [entry.t_ns for entry in log.events if entry.event.message == "fault acknowledged"]
    gap = int(np.argmax(np.diff(log.cycle.t_ns)))
    assert log.cycle.t_ns[gap] < acknowledged <= log.cycle.t_ns[gap + 1]


def test_a_fault_that_nobody_acknowledges_ends_the_run(tmp_path: Path) -> None:
    summary, log = faulting_rig(tmp_path, acknowledge_faults=0).run()
    assert (summary.recoveries, states(log)[-1]) == (0, SchemeState.FAULT)


def test_torque_begins_with_zero_where_the_arm_is_once_the_drives_are_enabled_again(recovered: Recovered) -> None:
    log, start = recovered.log, recovered.adapt
    quiet = slice(log.scheme.t_ns[recovered.fault], log.scheme.t_ns[recovered.adapt])
    command = log.topics["/decoded/Drive1Command"]
    is_quiet = (command.t_ns >= quiet.start) & (command.t_ns < quiet.stop)
    assert np.count_nonzero(is_quiet) > 200
    assert np.count_nonzero(command["target_torque"][is_quiet]) == 0
    np.testing.assert_allclose(log.control["q_d"][start], log.scheme["q"][start], atol=1e-4)
    assert np.abs(log.control["tau_c"][start]).max() < 0.2
    assert np.degrees(np.abs(log.scheme["q"][start])).max() > 5.0  # not the place where the run began
    assert np.any(torques_from(log, int(log.cycle["cycle"][-1]) - 1500) != 0)
