"""What the arm reported in each cycle of a live run, and what its log says of it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from fault_rig import scenario_of
from numpy.typing import NDArray
from rig import SessionRig, scripted

from adacd_hil.device.arm_watch import ArmWatch
from adacd_hil.device.contract import load_contract
from adacd_hil.device.recorded_arm import RecordedArm, Ticks
from adacd_hil.log.reader import RunLog
from adacd_hil.records import ArmBatch, ArmState
from adacd_hil.replay.logged_arms import logged_arms
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.codec import Codec


class Live(NamedTuple):
    """A run: what the arm was in each cycle, and the log."""

    settings: Settings
    codec: Codec
    states: list[ArmState]
    log: RunLog

    def recorded_arm(self) -> RecordedArm:
        return RecordedArm(self.settings, self.codec)

    def read(self) -> ArmBatch:
        """Read the arm from the log, all at once."""
        return self.recorded_arm().read(ticks_of(self.log), self.log.frames)

    def logged(self) -> ArmBatch:
        """Take what the log says that the arm was."""
        log = self.log
        return logged_arms(log.scheme.records, log.topics["/arm"].records, ticks_of(log))


@contextmanager
def live_states() -> Iterator[list[ArmState]]:
    """Collect the states of all cycles that are run while the block lasts."""
    states: list[ArmState] = []
    judge = ArmWatch.judge

    def listen(watch: ArmWatch, arm: ArmState) -> ArmState:
        states.append(judge(watch, arm))
        return states[-1]

    ArmWatch.judge = listen  # type: ignore[method-assign]
    try:
        yield states
    finally:
        ArmWatch.judge = judge  # type: ignore[method-assign]


def play(
    folder: Path, rows: list[dict[str, Any]], config: str = "paper", finish_s: float = 1.0, acknowledge_faults: int = 0
) -> Live:
    """Run a session in lockstep with a scenario's faults."""
    operator = {"acknowledge_faults": acknowledge_faults, "acknowledge_fault_after_s": 0.05}
    settings = scripted(config, finish_s, **operator)
    codec = load_contract(settings)
    rig = SessionRig(folder, settings, scenario_of(rows), codec=codec, is_modelled=True)
    with live_states() as states:
        _, log = rig.run()
    return Live(settings, codec, states, log)


def ticks_of(log: RunLog) -> Ticks:
    arm = log.topics["/arm"]
    return Ticks(arm["cycle"].astype(np.int64), arm.t_ns, arm["periods"])


def differences(live: list[ArmState], batch: ArmBatch) -> list[str]:
    """Name what isn't the same bit for bit, with the first cycle."""
    if len(live) != len(batch.cycle):
        return [f"{len(live)} cycles live, {len(batch.cycle)} recorded"]
    lines = []
    for name in ArmState._fields:
        found: NDArray[Any] = getattr(batch, name)
        due = np.array([getattr(state, name) for state in live], found.dtype)
        if found.tobytes() != due.tobytes():
            place = np.flatnonzero((found != due).reshape(len(due), -1).any(axis=1))[0]
            lines.append(f"{name} in cycle {live[place].cycle}: {found[place]}, live {due[place]}")
    return lines
