"""A diagnosis: named checks, each with a reason and a remedy, run in the order of a table.

A check whose prerequisite failed is skipped and says so; nothing later is then tried on a bus that isn't right.
"""

from collections.abc import Callable, Sequence
from enum import Enum
from typing import Generic, NamedTuple, TypeVar

from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.wire.bus import BusError


class Status(Enum):
    """How a check came out."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"
    SKIPPED = "skipped"


class CheckOutcome(NamedTuple):
    """What a check found. `remedy`: what to do about it; "" when there is nothing to do."""

    status: Status
    reason: str
    remedy: str = ""


class Finding(NamedTuple):
    """The outcome of a named check."""

    name: str
    status: Status
    reason: str
    remedy: str


Examination = TypeVar("Examination")


class Check(NamedTuple, Generic[Examination]):
    """One line of the table. `needs`: names of checks before it that must not have failed."""

    name: str
    run: Callable[[Examination], CheckOutcome]
    needs: tuple[str, ...] = ()


def ok(reason: str) -> CheckOutcome:
    """Say that there is nothing to do."""
    return CheckOutcome(Status.OK, reason)


def warning(reason: str, remedy: str) -> CheckOutcome:
    """Say that the arm can run, with less margin than it should have."""
    return CheckOutcome(Status.WARNING, reason, remedy)


def failed(reason: str, remedy: str) -> CheckOutcome:
    """Say that the arm must not or can't run."""
    return CheckOutcome(Status.FAILED, reason, remedy)


def skipped(reason: str) -> CheckOutcome:
    """Say that it can't be told here."""
    return CheckOutcome(Status.SKIPPED, reason)


def diagnose(
    checks: Sequence[Check[Examination]],
    examination: Examination,
    report: Callable[[Finding], None],
    earlier: Sequence[Finding] = (),
) -> list[Finding]:
    """Run the checks in order, reporting each as it is done. What the bus or a device raises fails the check.

    `earlier`: findings of another table that these checks may need.
    """
    findings: list[Finding] = []
    # check → the failed one behind it
    blocked = {finding.name: finding.name for finding in earlier if finding.status is Status.FAILED}
    for check in checks:
        cause = next((blocked[name] for name in check.needs if name in blocked), None)
        if cause is not None:
            outcome = skipped(f"needs `{cause}`, which failed")
            blocked[check.name] = cause
        else:
            outcome = _run(check, examination)
            if outcome.status is Status.FAILED:
                blocked[check.name] = check.name
        finding = Finding(check.name, *outcome)
        report(finding)
        findings.append(finding)
    return findings


def _run(check: Check[Examination], examination: Examination) -> CheckOutcome:
    try:
        return check.run(examination)
    except DeviceError as error:
        return failed(str(error), "check the device's power, wiring and node id; `adacd-hil scan` lists who is there")
    except BusError as error:
        return failed(str(error), "check wiring, termination and bit rate")


def summarise(findings: Sequence[Finding]) -> str:
    """Count the outcomes in one line."""
    counts = {status: sum(finding.status is status for finding in findings) for status in Status}
    return ", ".join(f"{count} {status.value}" for status, count in counts.items())
