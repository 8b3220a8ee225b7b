"""What contacts have in common: a certificate that is wrong meets the same cause again and again.

While a contact lasts and the arm still moves, the residual r of a filter is compared with what each single error c of
the model would leave, w = -W_f c: a payload at the tip, a joint's Coulomb or viscous friction. Not a torque offset: who
leans on the arm again and again leaves the same. From sums over the samples, held-back ones from before the contact
included,

    size = Σ r w / Σ w²,    share = (Σ r w)² / (Σ w² Σ r²),    sigma = RESIDUAL_NM sqrt(correlated / Σ w²)

Shapes: c (h, p), sums (h,).
"""

from collections import deque
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.config import Settings
from adacd_hil.records import JOINTS, PARAMETER_NAMES, Vector
from adacd_hil.scheme import belief

WITHIN_S = 60.0
"""How far back the end of a contact may lie."""
FILTER = 1
"""Of the bank: fast enough to forget within 0.1 s that the arm has rested."""
RESIDUAL_NM = 0.012
"""Rms that a good model leaves behind it."""
FEWEST_LOADED, FEWEST = 2, 3
"""Contacts that agree in a payload, or in another error."""
MOST = 10
SHARE, SHARE_OF_ALL = 0.75, 0.9
"""Of a contact's squared residual that one error explains; of all their residuals, that a payload does."""
SPREAD_LOADED, SPREAD = 0.15, 0.3
"""By how much of its size the contacts may differ, beside 2 sigma."""
SURE = 8.0
"""Sigmas that a size is at least."""
PLAUSIBLE = 4.0
"""Deviations of the prior that a friction is at most."""
AT_ONCE_S = 3.0
"""Another error than a payload strikes again so soon after the arm goes on; a person may wait."""
_FRICTIONS = (("Coulomb friction", "Nm"), ("viscous friction", "Nm s/rad"))
RESTING = 0.2
"""Share of standstill in a filter's memory from which on a joint counts as resting."""


def constants_of(settings: Settings, count: int) -> dict[str, Vector]:
    """Return `causes` (h, p): a payload of 1 kg, then by joint Coulomb and viscous friction."""
    unit = np.eye(count)
    first = PARAMETER_NAMES.index("F_c1"), PARAMETER_NAMES.index("F_v1")
    rows = [belief.payload_direction(settings.arm.link_length_m, count)]
    rows += [unit[place + i] for i in range(JOINTS) for place in first]
    return {"causes": np.array(rows)}


def shapes_of() -> dict[str, tuple[int, ...]]:
    """Return the shapes of what is remembered, by name."""
    causes = (1 + len(_FRICTIONS) * JOINTS,)
    return {"cause_rw": causes, "cause_ww": causes, "contact_rr": ()}


@compiled
def begin(k: Any, m: Any) -> None:
    """Begin a contact, with the samples that were held back."""
    m["cause_rw"][:] = 0.0
    m["cause_ww"][:] = 0.0
    m["contact_rr"] = 0.0
    for s in range(int(m["ring_used"])):
        for i in range(m["ring_tau"].shape[1]):
            if m["ring_R"][s, i] != np.inf:
                _add(k, m, m["ring_W"][s, i], m["ring_tau"][s, i], k["learn_every"])


@compiled
def weigh(k: Any, m: Any) -> None:
    """Take in one sample of a contact; of a joint that rests, friction may hold anything."""
    for i in range(m["tau_f"].shape[1]):
        if m["still"][FILTER, i] < RESTING:
            _add(k, m, m["W_f"][FILTER, i], m["tau_f"][FILTER, i], 1.0)


@compiled
def _add(k: Any, m: Any, w: Vector, tau: float, weight: float) -> None:
    r = -tau
    for j in range(w.shape[0]):
        r += w[j] * m["theta"][j]
    m["contact_rr"] += weight * r * r
    for h in range(m["cause_rw"].shape[0]):
        left = 0.0
        for j in range(w.shape[0]):
            left -= w[j] * k["causes"][h, j]
        m["cause_rw"][h] += weight * r * left
        m["cause_ww"][h] += weight * left * left


class Verdict(NamedTuple):
    """What contacts look like. text: in words; is_payload: something was picked up, or put down."""

    text: str
    is_payload: bool


class _Weighed(NamedTuple):
    """One contact's sums (h,). waited_s: from when the arm went on to its begin; ended_s: when it was over."""

    rw: Vector
    ww: Vector
    rr: float
    waited_s: float
    ended_s: float


class Doubt:
    """Remembers the contacts of a certificate, and tells whether one cause explains the last ones."""

    def __init__(self, settings: Settings, constants: Any, memory: Any) -> None:
        self._constants, self._memory = constants[0], memory[0]
        self._correlated = 2.0 / (settings.certified.cutoffs_rad_s[FILTER] * settings.bus.period_s)
        self._period_s = settings.bus.period_s
        self._contacts: deque[_Weighed] = deque(maxlen=MOST)
        self._monitored_s = 0.0
        self._waited_s = 0.0

    def forget(self) -> None:
        """Begin with a new certificate."""
        self._contacts.clear()

    def go_on(self, cycle: int) -> None:
        """Take in that the arm monitors from this cycle on."""
        self._monitored_s = cycle * self._period_s

    def begin(self, cycle: int, is_touched: bool) -> None:
        """Take in that the arm reacts, to a touch or, as where the host is late, to none."""
        self._waited_s = cycle * self._period_s - self._monitored_s
        if not is_touched:
            for name in ("cause_rw", "cause_ww", "contact_rr"):
                self._memory[name] = 0.0

    def end(self, cycle: int) -> Verdict | None:
        """Take in that it has ended; return what the last ones look like, if they have one cause."""
        now_s = cycle * self._period_s
        m = self._memory
        self._contacts.append(
            _Weighed(m["cause_rw"].copy(), m["cause_ww"].copy(), float(m["contact_rr"]), self._waited_s, now_s)
        )
        while self._contacts[0].ended_s < now_s - WITHIN_S:
            self._contacts.popleft()
        return self._payload() or self._other()

    def _payload(self) -> Verdict | None:
        for count in range(FEWEST_LOADED, len(self._contacts) + 1):
            last = list(self._contacts)[-count:]
            rw, ww, rr = (sum(column) for column in zip(*((c.rw[0], c.ww[0], c.rr) for c in last), strict=True))
            kg = self._common(last, 0, SPREAD_LOADED)
            if kg is not None and rw * rw > SHARE_OF_ALL * ww * rr and abs(kg) > SURE * self._sigma(ww):
                what = "picked up" if kg > 0.0 else "put down"
                text = f"{count} contacts look like {abs(kg):.2f} ± {2.0 * self._sigma(ww):.2f} kg {what}"
                return Verdict(text, is_payload=True)
        return None

    def _other(self) -> Verdict | None:
        last = list(self._contacts)[-FEWEST:]
        if len(last) < FEWEST or max(contact.waited_s for contact in last[1:]) > AT_ONCE_S:
            return None
        for h in sorted(range(1, len(last[0].rw)), key=partial(_explained, last), reverse=True):
            size = self._common(last, h, SPREAD)
            ww = sum(contact.ww[h] for contact in last)
            if size is not None and abs(size) > SURE * self._sigma(ww) and self._can_be(h, size):
                joint, kind = divmod(h - 1, len(_FRICTIONS))
                sigma = 2.0 * self._sigma(ww)
                return Verdict(f"{len(last)} contacts look like {_words(kind, joint, size, sigma)}", is_payload=False)
        return None

    def _can_be(self, h: int, size: float) -> bool:
        """Tell whether an arm may have so much more of a friction than the model: none has less than none."""
        cause = self._constants["causes"][h]
        total = float(cause @ self._memory["theta"]) + size
        return -SPREAD * abs(size) <= total <= PLAUSIBLE * float(cause @ self._constants["prior_std"])

    def _common(self, contacts: list[_Weighed], h: int, spread: float) -> float | None:
        """Return the size of cause h that explains each of the contacts, or None."""
        ww = sum(contact.ww[h] for contact in contacts)
        if not ww > 0.0:
            return None
        size = float(sum(contact.rw[h] for contact in contacts) / ww)
        for contact in contacts:
            rw, own = contact.rw[h], contact.ww[h]
            if not rw * rw >= SHARE * own * contact.rr or not own > 0.0:
                return None
            if abs(rw / own - size) > spread * abs(size) + 2.0 * self._sigma(own):
                return None
        return size

    def _sigma(self, ww: float) -> float:
        return float(RESIDUAL_NM * np.sqrt(self._correlated / ww))


def _explained(contacts: list[_Weighed], h: int) -> float:
    """Return how much of the contacts' squared residuals cause h explains."""
    return float(sum(contact.rw[h] ** 2 / contact.ww[h] for contact in contacts if contact.ww[h] > 0.0))


def _words(kind: int, joint: int, size: float, sigma: float) -> str:
    name, unit = _FRICTIONS[kind]
    more = "more" if size > 0.0 else "less"
    return f"{abs(size):.2f} ± {sigma:.2f} {unit} {more} {name} of joint {joint + 1} than was certified"
