"""An arm that does not get ready: the log says what kept it."""

from pathlib import Path

import pytest
from rig import transition

from adacd_hil.cli.embedded_run import resolve, run_embedded
from adacd_hil.log.reader import read_log

pytestmark = pytest.mark.slow

OUTSIDE = "lasts_s = 1.0\nstart_deg = [80.0, 0.0]\n"
DEAF = """
lasts_s = 1.0

[[faults]]
kind = "freeze_counter"
node = "drive1"
frame = "command"
since = "power_on"
at_s = 0.0
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("scenario", "line"),
    [
        (OUTSIDE, "COMMISSION -> FAULT: COMMISSION_TIMEOUT; joint 1: position 80.00 deg, ±75 deg allowed"),
        (
            "lasts_s = 1.0\ntorque_offset_Nm = [3.0, 0.0]\n",
            "COMMISSION -> FAULT: COMMISSION_TIMEOUT; joint 1 is loaded: |tau_J| up to 3.0",
        ),
        (
            DEAF,
            "ENABLE -> FAULT: ENABLE_TIMEOUT; Drive1: SWITCH_ON_DISABLED, mode 10, OPERATION_ENABLED",
        ),
    ],
)
def test_a_timeout_names_its_cause(scenario: str, line: str, tmp_path: Path) -> None:
    file = tmp_path / "not-ready.toml"
    file.write_text(scenario)
    summary, _ = run_embedded(resolve("paper", str(file), None, None), "lockstep", tmp_path)
    assert transition(read_log(summary.log.path), "FAULT").startswith(line)
