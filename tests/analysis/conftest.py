"""A short run, played once, and its replay."""

from pathlib import Path

import pytest
from analysis.replay_rig import record

from adacd_hil.control.operator import ScriptedOperator
from adacd_hil.replay.replay import replay
from adacd_hil.replay.replayed_outcome import Replay


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("replayed"))


@pytest.fixture(scope="session")
def whole(log: Path) -> Replay:
    return replay(log, script_of=ScriptedOperator)
