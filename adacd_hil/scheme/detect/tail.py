"""The tail of the residuals: no threshold is below what the largest residual seen lets expect for an hour.

A threshold follows from noise and from what the belief leaves open. What is neither, a friction that sticks at one
place or a sensor that errs, shows as a residual that comes near. With excursions above a level that die out like a
Gaussian's, nu of them a second that are independent, and the largest of T seconds known, the largest of 1 / RATE is

    m(T) = sqrt(ln(nu / RATE) / ln(nu T)) times that,    nu = cut-off / pi,    T >= 1 s, m <= LARGEST

The largest counts when its block is over and the one after it: what is held back from a contact is no residual. It
counts as no more than the threshold without this floor at that moment, so who pushes a little below the threshold again
and again raises it to m times the largest of those, and no further. It is forgotten over FORGOTTEN_S without contact.

Shapes: peak, peak_now, peak_last, tail_Nm (2 C - 1, n). Units: Nm.
"""

import math
from typing import Any

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.detect import sensitivity
from adacd_hil.scheme.model import bank
from adacd_hil.settings.configuration import Settings

HOUR_S = 3600.0
RATE_HZ = 1.0 / HOUR_S
"""Excursions over the floor that are expected: one an hour."""
NONE_SEEN = -math.log(0.05)
"""What comes to none in T seconds has at most this many over T, at 95 %: Poisson's, as the report has it."""
LARGEST = 3.0
FORGOTTEN_S = 600.0
BLOCK_S = 0.064
"""Longer than a touch is held back before it is seen."""


def constants_of(settings: Settings) -> dict[str, Vector]:
    """Return `excursions_Hz` (2 C - 1,) and `block_cycles`."""
    a = np.array(settings.certified.cutoffs_rad_s)
    return {
        "excursions_Hz": np.concatenate([a, a[1:]]) / np.pi,
        "block_cycles": np.array(max(round(BLOCK_S / settings.bus.period_s), 1)),
    }


def shapes_of(channels: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of what is remembered, by name."""
    each = (channels, JOINTS)
    return {"peak": each, "peak_now": each, "peak_last": each, "tail_Nm": each, "block_used": (), "tail_s": ()}


@compiled
def begin(m: Any) -> None:
    """Begin with a model that no residual has been seen of."""
    m["peak"][:] = 0.0
    m["tail_Nm"][:] = 0.0
    m["tail_s"] = 0.0
    discard(m)


@compiled
def discard(m: Any) -> None:
    """Throw away the residuals of the last block and the one under way: a contact is near."""
    m["peak_now"][:] = 0.0
    m["peak_last"][:] = 0.0
    m["block_used"] = 0.0


@compiled
def follow(k: Any, m: Any) -> None:
    """Take in one sample without contact."""
    filters = m["r"].shape[0]
    for c in range(m["y"].shape[0]):
        still = m["still_smooth"][c] if c < filters else m["still"][bank.filter_of(c, filters)]
        for i in range(m["y"].shape[1]):
            if still[i] < sensitivity.MOVING:
                seen = min(abs(m["y"][c, i]), m["h_model"][c, i])
                m["peak_now"][c, i] = max(m["peak_now"][c, i], seen)
    m["block_used"] += 1.0
    if m["block_used"] < k["block_cycles"]:
        return
    block_s = m["block_used"] * k["period_s"]
    m["block_used"] = 0.0
    if np.max(m["peak_last"]) > 0.0:
        m["tail_s"] += block_s
    for c in range(m["y"].shape[0]):
        factor = _factor(k["excursions_Hz"][c], m["tail_s"])
        for i in range(m["y"].shape[1]):
            m["peak"][c, i] = max(m["peak"][c, i] * (1.0 - block_s / FORGOTTEN_S), m["peak_last"][c, i])
            m["tail_Nm"][c, i] = factor * m["peak"][c, i]
            m["peak_last"][c, i] = m["peak_now"][c, i]
            m["peak_now"][c, i] = 0.0


def rate_per_h(excursions_Hz: float, seen_s: float, largest_share: float) -> float:
    """Return how many excursions over a threshold an hour has if the tail is a Gaussian's: 3600 nu (nu T)^(-1 / s²).

    largest_share: s, of its threshold that the residual has come to in seen_s, T; 1 / s = m(T) comes to RATE.
    """
    if not largest_share > 0.0:
        return 0.0
    seen = max(excursions_Hz * max(seen_s, 1.0), 1.01)
    return float(HOUR_S * excursions_Hz * seen ** (-1.0 / largest_share**2))


def describe(k: Any, m: Any) -> str:
    """Say what the residuals seen so far let expect of false alarms: by counting alone, and by a Gaussian tail."""
    seen_s = max(float(m["tail_s"]), float(k["block_cycles"] * k["period_s"]))
    shares = m["peak"] / np.maximum(np.maximum(m["h_model"], m["tail_Nm"]), 1e-12)
    rates_per_h = [
        rate_per_h(float(nu_Hz), seen_s, share)
        for nu_Hz, joints in zip(k["excursions_Hz"], shares.tolist(), strict=True)
        for share in joints
    ]
    return (
        f"false alarms per hour: at most {NONE_SEEN * HOUR_S / seen_s:.0f} by counting the {seen_s:.2f} s of the "
        f"test alone, at 95 %, {sum(rates_per_h):.1g} if residuals have the tail of a Gaussian"
    )


@compiled
def _factor(excursions_Hz: float, seen_s: float) -> float:
    """Return m(T)."""
    share = math.log(excursions_Hz / RATE_HZ) / math.log(max(excursions_Hz * max(seen_s, 1.0), 1.01))
    return float(min(np.sqrt(max(share, 1.0)), LARGEST))
