"""The common cause of contacts: an arm with a wrong certificate meets the same cause again and again.

While a contact lasts and the arm still moves, the residual r of a filter is compared with the residual w = -W_f c of
each single error c of the model: a payload at the tip, a joint's Coulomb or viscous friction. A torque offset is not
among them: a person who leans on the arm again and again leaves the same residual. From sums over the samples,
including those held back from before the contact,

    size = Σ r w / Σ w²,    share = (Σ r w)² / (Σ w² Σ r²),    sigma = RESIDUAL_NM sqrt(correlated / Σ w²)

A joint that rested before held some torque, which the filter forgets as fast as its share s of standstill. The part
that such a torque explains is removed from r and w: r - s Σ r s / Σ s², w likewise. The residual of a good model in n
samples, n RESIDUAL_NM², is subtracted from Σ r²; for a contact that was detected early that is much.

A payload is named if contacts give enough evidence of it, in both directions of its pull, or if ALIKE contacts in a
row, each right after going on, agree in the mass; another error likewise.

Contacts without a common cause take the certificate back, too, where a person is unlikely: MANY in a row, each but the
first within HELD_S of going on; or weak ones, less than WEAK times their threshold, that are likelier at OFTEN_PER_H
than at RARELY_PER_H by ODDS. Three in 6.8 min are.

An arm that meets the next contact AT_REST_S after going on would never move far enough to show its cause: the
thresholds of the joints in contact double, to MOST_STRAIN times at most, and fall back as in `sensitivity`.

The sums over w and s are parts of one table: v = (w of each of the h causes, s of the row's joint, 0 of the others),

    L = Σ v v'/R,   b = Σ v r/R

with R the number of periods that a sample stands for, inverted.

Shapes: c (h, p), v, b (h + n,), L (h + n, h + n), the lower half.
"""

from collections import deque
from functools import partial
from typing import NamedTuple

import numpy as np

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.detect import sensitivity
from adacd_hil.scheme.memory import Constants, Memory
from adacd_hil.scheme.model import filter_bank, regressor
from adacd_hil.settings.configuration import Settings

WITHIN_S = 60.0
"""How far back the end of a contact may lie."""
RESIDUAL_NM = 0.012
"""Residual of a good model, Nm rms."""
FEWEST_LOADED, FEWEST = 3, 3
"""Smallest number of contacts that agree in a payload, or in another error."""
SHARE, SHARE_OF_ALL = 0.75, 0.9
"""Part of one contact's squared residual that an error must explain; part of all of theirs, for a payload."""
LEAST_SHARE = 0.5
"""Part of a contact's Σ r² that always stays, however large the residual of a good model."""
SPREAD_LOADED, SPREAD = 0.15, 0.3
"""Largest difference of the contacts' sizes, as a part of the size, beside 2 sigma."""
SURE = 8.0
"""Smallest size of an error, in sigmas."""
BOTH_WAYS = 0.1
"""Part of the evidence for a payload in which it pulls the other way: a person who pushes twice pushes one way."""
ALIKE = 4
"""So many contacts, each so soon after going on that it is weak evidence, agree in an error within SPREAD_LOADED."""
PLAUSIBLE = 4.0
"""Largest plausible friction, in deviations of the prior."""
AT_ONCE_S = 3.0
"""An error other than a payload causes the next contact within this time after going on; a person may wait."""
AT_REST_S, MOST_STRAIN = 0.2, 4.0
"""If a contact follows within this time of going on, the arm reacts at rest, and the thresholds of the contact's joints
double, up to this many times the normal ones."""
MANY, HELD_S = 10, 0.3
"""So many contacts in a row, each this soon after going on, are not a person's. After the first, the run reports that
it may be a load. MANY is also the largest number remembered."""
WEAK = 1.5
"""The residual of a weak contact peaks below so many times its threshold."""
RARELY_PER_H, OFTEN_PER_H, ODDS = 1.0, 30.0, 1000.0
"""Rates of weak contacts per hour, by a person and by a wrong model; how many times likelier the latter must be."""
LOAD = 0
"""Index of a payload among the causes."""
_FRICTIONS = (("Coulomb friction", "Nm"), ("viscous friction", "Nm s/rad"))
CAUSES = 1 + len(_FRICTIONS) * JOINTS
STANDING = 0.6
"""Smallest share of standstill in a filter's memory for which a sample of the joint is not used as evidence."""


def causes_of(settings: Settings, count: int) -> Vector:
    """Return the change of the parameters (h, p) by each cause of one unit.

    h: a payload of 1 kg, then Coulomb and viscous friction of joint 1, of joint 2. count: number p of parameters.
    """
    unit = np.eye(count)
    rows = [regressor.payload_direction(settings.arm.link_length_m, count, settings.gravity_m_s2)]
    rows += [unit[place + i] for i in range(JOINTS) for place in (regressor.F_C1, regressor.F_V1)]
    return np.array(rows)


@compiled
def clear(m: Memory) -> None:
    """Set the sums, the count of rows and `peak`, the largest residual over its threshold, to 0."""
    own = m.doubt
    own.L[:] = 0.0
    own.b[:] = 0.0
    own.load_ww[:] = 0.0
    own.rr = 0.0
    own.rows = 0.0
    own.peak = 0.0


@compiled
def begin(k: Constants, m: Memory) -> None:
    """Clear the sums, and add the samples from before the contact that wait in the ring.

    A joint's row is left out if its share of standstill is STANDING or more. Raise `peak`, from 0, by the present
    sample.
    """
    clear(m)
    _follow_peak(m)
    for s in range(int(m.ring.used)):
        for i in range(m.ring.tau.shape[1]):
            if m.ring.still[s, i] < STANDING:
                _add(k, m, i, m.ring.W[s, i], m.ring.tau[s, i], m.ring.still[s, i], 1.0 / k.learn_every)


@compiled
def weigh(k: Constants, m: Memory) -> None:
    """Add one sample of a contact to the sums, except of joints at rest, whose friction explains any torque.

    At rest: slower than SLOW_RAD_S, or with a share of standstill of STANDING or more. Raise `peak` by the sample.
    """
    _follow_peak(m)
    for i in range(m.filters.tau_f.shape[1]):
        still = m.sensitivity.still_smooth[filter_bank.LEARNT, i]
        if still < STANDING and abs(m.sensitivity.dq_old[i]) > regressor.SLOW_RAD_S:
            _add(k, m, i, m.filters.W_learnt[i], m.filters.tau_learnt[i], still, 1.0)


@compiled
def _follow_peak(m: Memory) -> None:
    """Raise `peak` to this sample's largest residual over its threshold, of all channels and joints."""
    for c in range(m.filters.y.shape[0]):
        for i in range(m.filters.y.shape[1]):
            m.doubt.peak = max(m.doubt.peak, abs(m.filters.y[c, i]) / m.sensitivity.h[c, i])


@compiled
def _add(k: Constants, m: Memory, i: int, w: Vector, tau: float, still: float, R: float) -> None:
    """Add one row w (p,) of joint i, from 0, with its torque `tau` to the sums.

    still: share of standstill in the filter's memory, 0 to 1. R: variance that weights the row.
    """
    own = m.doubt
    r = linalg.misfit(w, m.models.theta, tau)
    own.rr += r * r / R
    own.rows += 1.0 / R
    own.row[:] = 0.0
    for h in range(CAUSES):
        own.row[h] = -linalg.dot(w, k.causes[h])
    own.row[CAUSES + i] = still
    linalg.add_row(own.row, r, R, own.L, own.b)
    own.load_ww[0 if own.row[LOAD] < 0.0 else 1] += own.row[LOAD] ** 2 / R


class CommonCause(NamedTuple):
    """The common cause of contacts. text: its description; is_payload: an object was picked up, or put down.

    Also a contradiction of the certificate, which ends it as a common cause does.
    """

    text: str
    is_payload: bool


class _Weighed(NamedTuple):
    """One contact's sums over its samples, as `_weighed` returns them. rw, ww (h,): Σ r w and Σ w² by cause; rr: Σ r².

    load_ww (2,): evidence for a payload, by direction of pull. peak: largest residual over its threshold; 0 without a
    residual. waited_s: from going on to the contact's beginning; ended_s: time of its end.
    """

    rw: Vector
    ww: Vector
    rr: float
    load_ww: Vector
    peak: float
    waited_s: float
    ended_s: float


class Doubt:
    """Remembers the contacts of a certificate, and finds the cause that explains the last ones, if there is one."""

    def __init__(self, settings: Settings, k: Constants, m: Memory) -> None:
        self._k, self._m = k, m
        self._correlated = 2.0 / (settings.certified.cutoffs_rad_s[filter_bank.LEARNT] * settings.bus.period_s)
        self._period_s = settings.bus.period_s
        self._contacts: deque[_Weighed] = deque(maxlen=MANY)
        self._monitored_s = 0.0
        self._waited_s = 0.0
        self._log_odds, self._weak = 0.0, 0
        self._contradiction: CommonCause | None = None

    def forget(self) -> None:
        """Forget all contacts, and the odds of weak ones, as a new certificate begins."""
        self._contacts.clear()
        self._log_odds, self._weak = 0.0, 0

    def go_on(self, cycle: int) -> None:
        """Store the cycle from which on the arm monitors again, to measure the time until the next contact."""
        self._monitored_s = cycle * self._period_s

    def begin_contact(self, cycle: int, is_touched: bool, contradiction: CommonCause | None = None) -> None:
        """Store how long the arm has monitored before it reacts in this cycle, and lower the odds of a wrong model.

        is_touched: it reacts to a contact. If that follows within AT_REST_S of going on, raise the thresholds of its
        joints. False: the cause is another, such as a late host, and the sums are cleared. contradiction: of the
        certificate, if the arm reacts to that; `end_contact` returns it.
        """
        self._contradiction = contradiction
        self._waited_s = cycle * self._period_s - self._monitored_s
        likelier = (OFTEN_PER_H - RARELY_PER_H) / 3600.0 * self._waited_s
        self._log_odds = max(self._log_odds - likelier, 0.0)
        self._weak = self._weak if self._log_odds > 0.0 else 0
        if not is_touched:
            clear(self._m)
        elif self._waited_s < AT_REST_S:
            sensitivity.raise_strain(self._m, MOST_STRAIN)

    def end_contact(self, cycle: int) -> CommonCause | None:
        """Store the contact that ends in this cycle; return the common cause of the last contacts, None without one.

        After a contradiction of the certificate store nothing and return the contradiction. Drop contacts that ended
        more than WITHIN_S ago. A weak contact, not at once after going on, raises the odds of a wrong model. A payload
        goes before an error of friction, and a cause without a name comes last.
        """
        if self._contradiction is not None:
            return self._contradiction
        now_s = cycle * self._period_s
        last = _weighed(self._m, self._waited_s, now_s)
        self._contacts.append(last)
        if 0.0 < last.peak < WEAK and last.waited_s >= AT_REST_S:
            self._log_odds += np.log(OFTEN_PER_H / RARELY_PER_H)
            self._weak += 1
        while self._contacts[0].ended_s < now_s - WITHIN_S:
            self._contacts.popleft()
        return self._payload() or self._other() or self._alike() or self._unexplained()

    def describe_again(self) -> str | None:
        """Return a warning if the last contact came within HELD_S of going on from another one; else None."""
        if len(self._contacts) < 2 or self._contacts[-1].waited_s > HELD_S:
            return None
        waited_s = self._contacts[-1].waited_s
        return (
            f"a contact again, {waited_s:.1f} s after going on: if nobody has touched the arm, a load was picked up or "
            "put down (`changed` learns it), or the model has become wrong (`relearn`)"
        )

    def _payload(self) -> CommonCause | None:
        """Return the payload that explains the last FEWEST_LOADED contacts, or more if these don't suffice; or None.

        There must be evidence for it in both directions of its pull.
        """
        for count in range(FEWEST_LOADED, len(self._contacts) + 1):
            last = list(self._contacts)[-count:]
            if self._common(last, LOAD, SPREAD_LOADED) is None:
                continue
            rw, ww, rr = (sum(parts) for parts in zip(*((c.rw[LOAD], c.ww[LOAD], c.rr) for c in last), strict=True))
            kg, sigma = self._size(last, LOAD)
            ways = np.sum([contact.load_ww for contact in last], axis=0)
            is_sure = abs(kg) > 0.5 * SURE * sigma and np.min(ways) > BOTH_WAYS * np.sum(ways)
            if not (is_sure and rw * rw > SHARE_OF_ALL * ww * rr):
                continue
            return _named(count, LOAD, kg, sigma)
        return None

    def _alike(self) -> CommonCause | None:
        """Return the error that explains each of the last ALIKE contacts with about the same size, or None.

        The error: a payload or a friction. Of several the one whose sizes differ least; None if that is a friction of
        an implausible size. None also unless each of the contacts came within HELD_S of going on.
        """
        last = list(self._contacts)[-ALIKE:]
        if len(last) < ALIKE or max(contact.waited_s for contact in last) > HELD_S:
            return None
        found: list[tuple[float, int, float]] = []
        for h in range(len(last[0].rw)):
            if not all(contact.rw[h] ** 2 >= SHARE * contact.ww[h] * contact.rr > 0.0 for contact in last):
                continue
            sizes = np.array([contact.rw[h] / contact.ww[h] for contact in last])
            size = float(np.mean(sizes))
            found.append((float(np.max(np.abs(sizes / size - 1.0))), h, size))
        spread, h, size = min(found, default=(np.inf, LOAD, 0.0))
        if spread > SPREAD_LOADED or not (h == LOAD or self._can_be(h, size)):
            return None
        return _named(ALIKE, h, size, SPREAD * abs(size))

    def _other(self) -> CommonCause | None:
        """Return the error of friction that explains the last FEWEST contacts, or None.

        Each of them but the first must have come within AT_ONCE_S of going on. The size must be plausible, and over
        SURE deviations. Of several errors the one that explains most of the squared residuals.
        """
        last = list(self._contacts)[-FEWEST:]
        if len(last) < FEWEST or max(contact.waited_s for contact in last[1:]) > AT_ONCE_S:
            return None
        for h in sorted(range(1, len(last[0].rw)), key=partial(_explained, last), reverse=True):
            size = self._common(last, h, SPREAD)
            ww = sum(contact.ww[h] for contact in last)
            if size is not None and abs(size) > SURE * self._sigma(ww) and self._can_be(h, size):
                return _named(len(last), h, *self._size(last, h))
        return None

    def _unexplained(self) -> CommonCause | None:
        """Return a cause without a name if a person is unlikely to touch as often or as lightly, else None.

        As often: MANY contacts, each but the first within HELD_S of going on. As lightly: weak contacts with odds over
        ODDS.
        """
        last = list(self._contacts)[-MANY:]
        text = ""
        if len(last) == MANY and max(contact.waited_s for contact in last[1:]) < HELD_S:
            text = f"{MANY} contacts came within {HELD_S:g} s of going on each"
        elif self._log_odds > np.log(ODDS):
            text = f"{self._weak} contacts came to less than {WEAK:g} times their threshold"
        if not text:
            return None
        return CommonCause(
            f"{text}, and no one error explains them: light touches, a torque sensor that has moved, or another arm",
            is_payload=False,
        )

    def _can_be(self, h: int, size: float) -> bool:
        """Return whether friction h can be `size` more than the model's.

        The sum may not be clearly negative, nor over PLAUSIBLE deviations of the prior.
        """
        cause = self._k.causes[h]
        total = float(cause @ self._m.models.theta) + size
        return -SPREAD * abs(size) <= total <= PLAUSIBLE * float(cause @ self._k.prior_std)

    def _common(self, contacts: list[_Weighed], h: int, spread: float) -> float | None:
        """Return the size of cause h that fits all contacts best by least squares, in its unit.

        None if the cause explains less than `SHARE` of a contact's squared residual. None, too, if a contact's own size
        differs from the common one by more than `spread` times that plus 2 sigma, or if a contact tells nothing of the
        cause.
        """
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

    def _size(self, contacts: list[_Weighed], h: int) -> tuple[float, float]:
        """Return the size of cause h and twice its standard deviation, from all contacts but the first.

        The change may have happened during the first.
        """
        ww = sum(contact.ww[h] for contact in contacts[1:])
        return float(sum(contact.rw[h] for contact in contacts[1:]) / ww), 2.0 * self._sigma(ww)

    def _sigma(self, ww: float) -> float:
        """Return the standard deviation of a cause's size, in its unit. ww: sum of w² over the samples."""
        return float(RESIDUAL_NM * np.sqrt(self._correlated / ww))


def _weighed(m: Memory, waited_s: float, now_s: float) -> _Weighed:
    """Return a contact's sums, without the torque that joints held at rest, and the peak of its residual.

    From `rr` the squared residual of a good model is subtracted, too; at least LEAST_SHARE stays. waited_s: from going
    on to the contact's beginning. now_s: time of its end since the run's start.
    """
    own, squares = m.doubt, m.doubt.L.diagonal()
    ss, rs, ws = np.maximum(squares[CAUSES:], 1e-12), own.b[CAUSES:], own.L[CAUSES:, :CAUSES].T
    rw = own.b[:CAUSES] - ws @ (rs / ss)
    ww = np.maximum(squares[:CAUSES] - (ws * ws) @ (1.0 / ss), 0.0)
    rr = float(own.rr - np.sum(rs * rs / ss))
    rr = max(rr - RESIDUAL_NM**2 * float(own.rows), LEAST_SHARE * rr)
    return _Weighed(rw, ww, rr, own.load_ww.copy(), float(own.peak), waited_s, now_s)


def _explained(contacts: list[_Weighed], h: int) -> float:
    """Return how much of the contacts' squared residuals cause h explains, Nm²; 0.0 without contacts.

    A contact that the cause does not touch adds 0.
    """
    return float(sum(contact.rw[h] ** 2 / contact.ww[h] for contact in contacts if contact.ww[h] > 0.0))


def _named(count: int, h: int, size: float, deviation: float) -> CommonCause:
    """Return the description of cause h as the common cause of `count` contacts; size, deviation: in its unit."""
    if h == LOAD:
        text = f"{abs(size):.2f} ± {deviation:.2f} kg {'picked up' if size > 0.0 else 'put down'}"
    else:
        joint, kind = divmod(h - 1, len(_FRICTIONS))
        name, unit = _FRICTIONS[kind]
        more = "more" if size > 0.0 else "less"
        text = f"{abs(size):.2f} ± {deviation:.2f} {unit} {more} {name} of joint {joint + 1} than was certified"
    return CommonCause(f"{count} contacts look like {text}", is_payload=h == LOAD)
