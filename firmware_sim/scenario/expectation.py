"""What a host makes of a scenario: what its file expects, what a run came to, and where the two differ.

Section `[expect]` of a scenario says what a healthy host of configuration `paper` makes of it, as that host is: where
it does badly, the expectation says so. `[expect_certified]` takes its place, as a whole, for a host of configuration
`certified`; without it both make the same of it. Counts are exact unless the key that ends in `_most` gives them room.

Ends of a run:

    finished   parked and disabled when the time was over
    fault      the host went to FAULT and nobody acknowledged it
    refused    the host did not put the devices into operation
    lost       the bus failed in operation, or nobody answered any more
"""

from dataclasses import dataclass, fields
from typing import Final, NamedTuple

from adacd_hil.records import FaultReason
from adacd_hil.settings.schema import ConfigError, setting

ENDS: Final = ("finished", "fault", "refused", "lost")
REASONS: Final = tuple(reason.name for reason in FaultReason if reason is not FaultReason.NONE)

Pair = tuple[float, float]


@dataclass(frozen=True)
class ExpectSettings:
    """What a healthy host makes of a scenario."""

    adaptations: int = setting(low=0, high=1000, meaning="adaptations that come to their end")
    contacts: int = setting(low=0, high=100_000, meaning="true contacts that are detected")
    contacts_most: int | None = setting(None, low=0, high=100_000, meaning="at most; absent: exactly `contacts`")
    false_alarms: int = setting(0, low=0, high=100_000, meaning="detections without a contact")
    false_alarms_most: int | None = setting(
        None, low=0, high=100_000, meaning="at most; absent: exactly `false_alarms`"
    )
    missed: int = setting(0, low=0, high=100_000, meaning="contacts that armed detection doesn't see")
    missed_most: int | None = setting(None, low=0, high=100_000, meaning="at most; absent: exactly `missed`")
    end: str = setting("finished", choices=ENDS, meaning="how the run ends")
    fault: str | None = setting(None, choices=REASONS, meaning="why the host first goes to FAULT; absent: it doesn't")
    fault_s: Pair | None = setting(None, unit="s", low=0.0, high=1e6, meaning="between when and when it does so")
    adaptation_s: Pair | None = setting(
        None, unit="s", low=0.0, high=1e6, meaning="shortest and longest first adaptation"
    )
    delay_ms: float | None = setting(
        None, unit="ms", low=0.0, high=1e6, meaning="longest time from a contact's onset to its detection"
    )
    force_N: float | None = setting(None, unit="N", low=0.0, high=1e6, meaning="largest contact force")

    def __post_init__(self) -> None:
        for key in _COUNTS:
            least, most = getattr(self, key), getattr(self, f"{key}_most")
            if most is not None and most < least:
                raise ConfigError(f"`expect.{key}_most` = {most} is below `expect.{key}` = {least}")
        for key in ("fault_s", "adaptation_s"):
            pair = getattr(self, key)
            if pair is not None and pair[1] < pair[0]:
                raise ConfigError(f"`expect.{key}[1]` = {pair[1]:g} s is below `expect.{key}[0]` = {pair[0]:g} s")
        if self.end == "fault" and self.fault is None:
            raise ConfigError("`expect.end` = 'fault' lacks the key `expect.fault`")
        if self.fault_s is not None and self.fault is None:
            raise ConfigError("`expect.fault_s` lacks the key `expect.fault`")

    @property
    def text(self) -> str:
        """What is expected, in a few words."""
        words = [f"{self._count('adaptations')} adapted", f"{self._count('contacts')} detected"]
        words += [f"{self._count(key)} {word}" for key, word in _TROUBLES if self._count(key) != "0"]
        if self.fault is not None:
            words.append(self.fault)
        if self.end not in ("finished", "fault"):
            words.append(self.end)
        return ", ".join(words)

    def _count(self, key: str) -> str:
        least, most = getattr(self, key), getattr(self, f"{key}_most", None)
        return f"{least}" if most is None else f"{least}-{most}"


_COUNTS: Final = ("contacts", "false_alarms", "missed")
_TROUBLES: Final = (("false_alarms", "false"), ("missed", "missed"))


class ScenarioOutcome(NamedTuple):
    """What a run came to, named as in `ExpectSettings`. Times since motion start; None: there is none."""

    end: str
    fault: str | None
    fault_s: float | None
    adaptations: int
    adaptation_s: float | None
    contacts: int
    false_alarms: int
    missed: int
    delay_ms: float | None
    force_N: float

    @property
    def text(self) -> str:
        """The same few words as those of an expectation."""
        return ExpectSettings(
            adaptations=self.adaptations,
            contacts=self.contacts,
            false_alarms=self.false_alarms,
            missed=self.missed,
            end=self.end,
            fault=self.fault,
        ).text


def deviations(expect: ExpectSettings, outcome: ScenarioOutcome) -> tuple[str, ...]:
    """Say, a line each, where a run differs from what was expected; nothing where it doesn't."""
    found = []
    for key in ("end", "fault", "adaptations"):
        wanted, got = getattr(expect, key), getattr(outcome, key)
        if got != wanted:
            found.append(f"{key}: {got or 'none'}, expected {wanted or 'none'}")
    for key in _COUNTS:
        least, most, got = getattr(expect, key), getattr(expect, f"{key}_most"), getattr(outcome, key)
        if not least <= got <= (least if most is None else most):
            found.append(f"{key}: {got}, expected {least if most is None else f'{least} to {most}'}")
    for key in ("fault_s", "adaptation_s"):
        pair, time_s = getattr(expect, key), getattr(outcome, key)
        if pair is not None and not (time_s is not None and pair[0] <= time_s <= pair[1]):
            found.append(f"{key}: {_number(time_s)} s, expected {pair[0]:g} to {pair[1]:g} s")
    for key in ("delay_ms", "force_N"):
        bound, got = getattr(expect, key), getattr(outcome, key)
        if bound is not None and got is not None and got > bound:
            unit = next(field.metadata["unit"] for field in fields(ExpectSettings) if field.name == key)
            found.append(f"{key}: {_number(got)} {unit}, expected at most {bound:g} {unit}")
    return tuple(found)


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.4g}"
