"""A run in real time, prepared for the rules of run_rules.py: raw frames of its log, and the arm's truth.

The log has the frames in the order in which the host sent and read them; here they are decoded anew.
"""

from pathlib import Path

import numpy as np
from wire_record import Passed, WireRecord
from witnessed_run import Played, Truth

from adacd_hil.log.log_files import DBC_NAME
from adacd_hil.log.reader import read_log
from adacd_hil.log.types.truth_topic import TRUTH
from adacd_hil.settings.configuration import Settings
from firmware_sim.scenario.scenario import Scenario


def judged_log(log_path: Path, truth_path: Path, settings: Settings, scenario: Scenario) -> Played:
    """Read a log of `run` and the truth of the emulator that it ran against, both stamped by the wall clock.

    Raises LogError.
    """
    log = read_log(log_path)
    frames = log.frames
    is_frame = ~frames["is_error"]
    passed = [
        Passed(int(t_ns), bool(is_tx), int(can_id), data[:length].tobytes())
        for t_ns, is_tx, can_id, data, length in zip(
            frames["t_ns"][is_frame], frames["is_tx"][is_frame], frames["can_id"][is_frame],
            frames["data"][is_frame], frames["length"][is_frame], strict=True,
        )
    ]  # fmt: skip
    wire = WireRecord(log.attachments[DBC_NAME], passed)
    truth = read_log(truth_path, (TRUTH.name,)).truth
    sync_wall_ns = wire.sync_t_ns + log.epoch_ns
    sync = np.searchsorted(sync_wall_ns, truth.t_ns + settings.bus.period_ns // 4, side="right") - 1
    return Played(
        settings=settings,
        scenario=scenario,
        wire=wire,
        truth=Truth(np.asarray(sync, np.int64), truth.block),
        log=log,
        summary=None,
        crash="",
        overdue="",
        finish_ns=None,
        end_ns=passed[-1].t_ns if passed else 0,
        enabled_at_end=(False, False),
    )
