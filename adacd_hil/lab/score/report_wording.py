"""One wording of each number, state and rate, for reports; those that a replay needs, too, are in `score.wording`."""

import math
from collections.abc import Collection, Sequence
from typing import Final

import numpy as np

from adacd_hil.lab.score.rates import CONFIDENCE_TEXT
from adacd_hil.printable import number_of
from adacd_hil.records import SchemeState
from adacd_hil.score.judge import Score
from adacd_hil.score.wording import NONE

_MORE_DIGITS: Final = 3


_TELLING_PER_H: Final = 3.0
"""The bound after an hour without a false alarm."""


STATE_WORDS: Final = {
    SchemeState.INIT: "starting",
    SchemeState.COMMISSION: "checking at rest",
    SchemeState.ENABLE: "enabling",
    SchemeState.ADAPT: "learning",
    SchemeState.CERTIFY: "testing",
    SchemeState.MONITOR: "watching",
    SchemeState.REACT: "reacting",
    SchemeState.STOPPED: "stopped",
    SchemeState.PAYLOAD: "payload change",
    SchemeState.FAULT: "fault",
}
"""States as a report names them."""


def lacks_text(needed: Collection[str], there: Collection[str]) -> str:
    """Return a phrase on the needed topics that a log has not even without messages; "" if there is none."""
    lacking = [topic for topic in needed if topic not in there]
    return f"it has no {' and no '.join(lacking)}, so that not all that happened is known" if lacking else ""


def state_words(name: str | None) -> str:
    """Return the words for a state by its name in `SchemeState`; a dash for None."""
    return NONE if name is None else STATE_WORDS[SchemeState[name]]


def number_text(value: float | None, digits: int, unit: str = "") -> str:
    """Return a number as text with `digits` decimals and a true minus sign; a dash for None, NaN and infinity.

    unit: appended to a number; "" for none.
    """
    if value is None or not math.isfinite(value):
        return NONE
    text = f"{value:z.{digits}f}".replace("-", "−")
    return f"{text} {unit}" if unit else text


def pair_text(values: Sequence[float] | None, digits: int) -> str:
    """Return the values of both joints as "1.00 / 2.00" with `digits` decimals; a dash for None."""
    return NONE if values is None else " / ".join(number_text(value, digits) for value in values)


def yes_text(value: bool | None) -> str:
    """Return "yes" or "no"; a dash for None."""
    return NONE if value is None else "yes" if value else "no"


def signs_text(direction: tuple[int, int] | None) -> str:
    """Return the signs of both joints as "+ / −", 0 as "0"; a dash for None."""
    return NONE if direction is None else " / ".join({1: "+", -1: "−", 0: "0"}[sign] for sign in direction)


def signed_text(value: float) -> str:
    """Return a number as text with one decimal, its sign, "+" included, and a true minus sign."""
    return f"{value:+.1f}".replace("-", "−")


def centimetres(value_m: float | None) -> float | None:
    """Return a length in cm; None for None."""
    return None if value_m is None else 100.0 * value_m


def uncertain_text(value: float | None, sigma: float | None, digits: int, unit: str) -> str:
    """Return a value with its standard deviation, "1.00 ± 0.10 Nm"; a dash if either is None.

    digits: decimals of both; up to `_MORE_DIGITS` more for a standard deviation that would read as 0.
    """
    if value is None or sigma is None:
        return NONE
    if 0.0 < sigma < 0.5 * 10.0**-digits:
        digits = min(-math.floor(math.log10(sigma)), digits + _MORE_DIGITS)
    return f"{number_text(value, digits)} ± {number_text(sigma, digits)} {unit}"


def score_sentence(score: Score) -> str:
    """Return a clause with the contacts found and missed, the longest delay, and the false alarms.

    Contacts while detection was not armed are named apart.
    """
    armed = [contact for contact in score.contacts if contact.is_armed]
    delays_ms = [contact.delay_ms for contact in armed if contact.delay_ms is not None]
    within = f" within {max(delays_ms):.0f} ms" if delays_ms else ""
    if not armed:
        found = "no contact while the arm was watched"
    elif score.missed:
        found = f"{len(delays_ms)} of {number_of(len(armed), 'contact')} detected{within}, {score.missed} missed"
    else:
        found = f"{'the one contact' if len(armed) == 1 else f'all {len(armed)} contacts'} detected{within}"
    false = number_of(len(score.false_alarms), "false alarm") if score.false_alarms else "none false"
    if not armed and not score.false_alarms:
        false = "no false alarm"
    disarmed = [contact for contact in score.contacts if not contact.is_armed]
    outside = f", {len(disarmed)} more while it was not watched" if disarmed else ""
    early = sum(contact.detected_ns is not None for contact in disarmed)
    outside += f" ({early} of them detected)" if early else ""
    return f"{found}{outside}, {false}"


def rate_sentence(false_alarms: int, bound_per_h: float) -> str:
    """Return a clause with the number of false alarms, and the upper bound of their rate.

    A bound above `_TELLING_PER_H` is replaced by words that the time is too short.
    """
    count = number_of(false_alarms, "false alarm") if false_alarms else "No false alarms"
    if bound_per_h > _TELLING_PER_H:
        return f"{count} in that time, which is too short to tell a rate by counting"
    return f"{count} in that time: by counting alone, at most {bound_per_h:.3g} per hour at {CONFIDENCE_TEXT}"


DELAY_FIGURES: Final = {"median": 0.5, "p90": 0.9, "max": 1.0}
"""Quantiles of delays, by name."""


def delay_figures(delays_ms: Sequence[float]) -> dict[str, float | None]:
    """Return the `DELAY_FIGURES` of delays, by name; None without delays."""
    return {name: float(np.quantile(delays_ms, share)) if delays_ms else None for name, share in DELAY_FIGURES.items()}


def delays_phrase(delays_ms: Sequence[float]) -> str:
    """Return a phrase with the `DELAY_FIGURES` of delays, ms, beginning with a comma; "" without delays."""
    figures = ", ".join(
        f"{name} {delay:.1f} ms" for name, delay in delay_figures(delays_ms).items() if delay is not None
    )
    return f", delay: {figures}" if figures else ""


def percent_text(share: float) -> str:
    """Return a share (0…1) in percent as text with two significant digits, from 99.5 % on without decimals.

    A share above 0 and below 0.005 % gives "less than 0.01 %".
    """
    if 0.0 < share < 5e-5:
        return "less than 0.01 %"
    return f"{100.0 * share:.2g} %" if share < 0.995 else f"{100.0 * share:.0f} %"
