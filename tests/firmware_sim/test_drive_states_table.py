"""The emulated drive's tables against the standard's, over every word that the bus can carry."""

import pytest

from firmware_sim.nodes.drive_profile import STATE_BITS, DriveEvent, DriveState, decode_command

S, E = DriveState, DriveEvent

# IEC 61800-7-201, table "state coding": bits 6…0 of the statusword, x where the standard leaves a bit open.
CODING = {
    S.START: "x0xx0000",
    S.NOT_READY_TO_SWITCH_ON: "x0xx0000",
    S.SWITCH_ON_DISABLED: "x1xx0000",
    S.READY_TO_SWITCH_ON: "x01x0001",
    S.SWITCHED_ON: "x01x0011",
    S.OPERATION_ENABLED: "x01x0111",
    S.QUICK_STOP_ACTIVE: "x00x0111",
    S.FAULT_REACTION_ACTIVE: "x0xx1111",
    S.FAULT: "x0xx1000",
}
# The same standard, table "command coding": bits 7…0 of the controlword; the rising edge of bit 7 is fault reset.
COMMANDS = [
    ("0xxxx110", E.SHUTDOWN),
    ("0xxx0111", E.SWITCH_ON),
    ("0xxx1111", E.ENABLE_OPERATION),
    ("0xxxxx0x", E.DISABLE_VOLTAGE),
    ("0xxxx01x", E.QUICK_STOP),
]


def fits(word: int, pattern: str) -> bool:
    return all(bit in ("x", given) for bit, given in zip(pattern, f"{word & 0xFF:08b}", strict=True))


def expected_command(word: int, previous: int) -> DriveEvent | None:
    if word & 0x80:
        return None if previous & 0x80 else E.FAULT_RESET
    (event,) = [event for pattern, event in COMMANDS if fits(word, pattern)]
    return event


@pytest.mark.parametrize("state", DriveState)
def test_every_state_is_coded_as_the_standard_codes_it(state: DriveState) -> None:
    """Bit 4, voltage enabled, is set from initialisation on; before it nothing is claimed."""
    assert fits(STATE_BITS[state], CODING[state])
    assert STATE_BITS[state] & 0x10 == (0 if state in (S.START, S.NOT_READY_TO_SWITCH_ON) else 0x10)


@pytest.mark.parametrize("previous", [0x0000, 0xFFFF])
def test_every_controlword_is_the_command_that_the_standard_says(previous: int) -> None:
    wrong = [word for word in range(0x10000) if decode_command(word, previous) is not expected_command(word, previous)]
    assert wrong == []
