"""tools/campaigns/cause_campaign.py: how a run counts, by the line of its fault."""

import pytest
from cause_campaign import STATEMENTS, outcome_of

from adacd_hil.control.first_motion import NO_CAUSE, TOO_SHORT
from adacd_hil.records import FaultReason

SENSOR_1 = "reverse the sensor of devices.sensor_node[0]"


@pytest.mark.parametrize(
    ("statement", "fault", "cause", "outcome"),
    [
        ("sensor 1 reversed", FaultReason.MISCONFIGURED, SENSOR_1, "certain"),
        ("sensor 1 reversed", FaultReason.MISCONFIGURED, f"either {SENSOR_1} or another", "among"),
        ("sensor 1 reversed", FaultReason.LIMIT, f"perhaps {SENSOR_1}", "among"),
        ("sensor 2 reversed", FaultReason.MISCONFIGURED, SENSOR_1, "wrong"),
        ("sensor 2 reversed", FaultReason.LIMIT, f"perhaps {SENSOR_1}", "wrong"),
        ("sensor 1 reversed", FaultReason.MISCONFIGURED, NO_CAUSE, "stopped"),
        ("sensor 1 reversed", FaultReason.LIMIT, TOO_SHORT, "stopped"),
        ("sensor 1 reversed", FaultReason.LIMIT, "joint 1: velocity 260 deg/s", "stopped"),
        ("right", FaultReason.NONE, "", "ran"),
        ("right", FaultReason.MISCONFIGURED, SENSOR_1, "wrong"),
    ],
)
def test_a_run_counts_by_the_cause_that_its_fault_names(
    statement: str, fault: FaultReason, cause: str, outcome: str
) -> None:
    assert statement in STATEMENTS
    assert outcome_of(statement, fault, f"ADAPT -> FAULT: {fault.name}; {cause}") == outcome
