"""A certificate: its contradictions, its description of the arm, and the last run's certificate as evidence.

**The last certificate.** A hand that drags from before the first motion to the end of learning, or moves like a mass,
looks like a part of the arm in that run. The last certificate knows the arm without it, or with another. It is a source
of `evidence`, and as within a run **less is the arm's**: a fit gets no certificate while one of these quantities is too
large: a joint's friction at some speed, an inertia, or a joint's viscous friction. The last is the friction at the
highest of these speeds less that at the lowest, over their difference. The limit is passed if

    c theta > last + floor + LAST_SIGMAS sqrt(share² last² + std² + c P c')

until the user confirms that the arm is free of contact. share: `history.friction_share`, `inertia_share`, the variation
from run to run. Not applied with a payload that was announced. It judges the fit, and never pulls it.
"""

from typing import NamedTuple

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import FRICTION_SPEEDS_RAD_S, JOINTS
from adacd_hil.scheme.identify import anchor, earlier, evidence, fit_check, missing_torque, place_bound
from adacd_hil.scheme.identify.evidence import FRICTIONS, INERTIAS, LAST, OFFSETS, VISCOUS
from adacd_hil.scheme.memory import Constants, Memory
from adacd_hil.settings.configuration import Settings

NOTHING, ANCHOR, CHANGED, MORE, MORE_THAN_LAST, BY_PLACE, TOO_MUCH_BY_PLACE, BLIND, READING = range(9)
"""Contradictions for which a certificate is withheld or taken back: values of the kernel's `withheld_by`.

READING: before the first motion, between the reading at rest and the tare."""
FLOOR_NM, FLOOR_KGM2, FLOOR_NM_S = 0.02, 0.006, 0.02
"""Differences of friction, inertia, viscous friction below these are ignored."""


class Certificate(NamedTuple):
    """A certificate's description of the arm at the time of certification; `_std`: standard deviations.

    parameters: a1 … F_c2, and those of gravity where there are any (p,); friction_Nm (6,): joint 1 at
    `records.FRICTION_SPEEDS_RAD_S`, then joint 2; inertia_kgm2 (3,): a1, a2, a3; offset_Nm (n,): of the torque sensors,
    the configuration's included; is_payload: a payload was learnt on top of an earlier certificate; text: of the event.
    """

    parameters: tuple[float, ...]
    friction_Nm: tuple[float, ...]
    friction_std_Nm: tuple[float, ...]
    inertia_kgm2: tuple[float, ...]
    inertia_std_kgm2: tuple[float, ...]
    offset_Nm: tuple[float, ...]
    offset_std_Nm: tuple[float, ...]
    is_payload: bool
    text: str

    def __repr__(self) -> str:
        inertia = ", ".join(f"{value:.3g}" for value in self.inertia_kgm2)
        return f"<Certificate{' with a payload' if self.is_payload else ''}: a1, a2, a3 = {inertia} kg m²>"


def begin(settings: Settings, m: Memory) -> None:
    """Load the last certificate as a source of evidence: value, variance and slack (Q,) of each quantity.

    slack: size up to which a difference is ignored. The variance is inf for the torque offsets, and for all quantities
    without a last certificate. A viscous friction is computed from two frictions. Their deviations count as
    independent, which overestimates its own.
    """
    history = settings.history
    counts = (FRICTIONS, INERTIAS, JOINTS, JOINTS)
    slope = np.zeros((JOINTS, OFFSETS))
    for i, speeds in enumerate(slope):
        speeds[[len(FRICTION_SPEEDS_RAD_S) * i, len(FRICTION_SPEEDS_RAD_S) * (i + 1) - 1]] = (-1.0, 1.0)
    slope /= FRICTION_SPEEDS_RAD_S[-1] - FRICTION_SPEEDS_RAD_S[0]
    quantities = np.vstack((np.eye(OFFSETS), np.zeros((JOINTS, OFFSETS)), slope))
    last, variance = np.zeros(sum(counts)), np.full(sum(counts), np.inf)
    if history.is_known:
        last = quantities @ (*history.friction_Nm, *history.inertia_kgm2)
        share = np.repeat((history.friction_share, history.inertia_share, 0.0, history.friction_share), counts)
        variance = quantities**2 @ np.square((*history.friction_std_Nm, *history.inertia_std_kgm2))
        variance += np.square(share * last)
        variance[OFFSETS:VISCOUS] = np.inf
    evidence.set_source(m, LAST, last, variance, np.repeat((FLOOR_NM, FLOOR_KGM2, 0.0, FLOOR_NM_S), counts))


def forget(m: Memory) -> None:
    """Empty the last certificate's source of evidence: the user confirms that the arm is free of contact."""
    evidence.empty_source(m, LAST)


def is_compared(m: Memory) -> bool:
    """Return whether the fit is compared with a last certificate.

    It is if there is one, `forget` hasn't emptied its source of evidence, and no payload was announced.
    """
    return bool(m.evidence.variance[LAST, 0] != np.inf and not m.models.is_payload)


@compiled
def withhold(m: Memory, cause: int) -> None:
    """Set `withheld_by` to the contradiction that withholds or revokes the certificate; NOTHING: there is none."""
    m.withheld_by = cause


@compiled
def contradicted_by(k: Constants, m: Memory) -> int:
    """Return the first contradiction of the fit, one of ANCHOR to TOO_MUCH_BY_PLACE, or NOTHING.

    In order: with the anchors, within the fit's own samples and steps, with kept beliefs, with the bound on torque by
    position, with the last certificate. The second is BY_PLACE if a torque by position explains it, else CHANGED; the
    beliefs of the fit's steps from before the change are kept then. Store the comparisons as evidence. Kept beliefs may
    be dropped, see `earlier.is_no_more`.
    """
    if not anchor.is_within(k, m, m.models.belief, m.models.P_belief):
        return ANCHOR
    last_step = fit_check.last_step_before_change(k, m)
    if last_step != fit_check.NONE:
        earlier.keep_steps(k, m, last_step)
        return BY_PLACE if missing_torque.is_found(k, m) else CHANGED
    evidence.fit(k, m, m.models.belief, m.models.P_belief, fit_check.fit_unit(m))
    if not earlier.is_no_more(k, m):
        return MORE
    if not place_bound.is_bounded(k, m):
        return TOO_MUCH_BY_PLACE
    return NOTHING if is_no_more(k, m) else MORE_THAN_LAST


@compiled
def is_no_more(k: Constants, m: Memory) -> bool:
    """Return whether no friction or inertia of the fit exceeds the last certificate's limit.

    True without a last certificate, or with a payload. Call `evidence.fit` before. Store the comparison as evidence.
    """
    is_agreed = True
    for q in range(m.evidence.fitted.shape[0]):
        excess = evidence.weigh(k, m, LAST, q)
        is_agreed = is_agreed and excess <= 1.0
    return bool(is_agreed or m.models.is_payload != 0.0)


def describe_more(m: Memory, date_utc: str) -> list[str]:
    """Return a line for each quantity of which the fit has more than the last certificate allows, with its bound.

    Of a joint's friction only the speed with the largest excess. [] without one. date_utc: of the last certificate, as
    text.
    """
    difference, limit = m.evidence.difference[LAST], m.evidence.limit[LAST]
    return [
        f"{what} is {difference[q]:.3f} {unit} more than in the certificate of {date_utc}, bound {limit[q]:.3f} {unit}"
        for q, what, unit in evidence.named(difference / limit)
    ]


def certificate_of(k: Constants, m: Memory, text: str) -> Certificate:
    """Return a certificate of the model in use: its parameters, frictions, inertias and offsets, with deviations.

    The offsets include the configuration's zeros. text: of the event that reports the certificate.
    """
    base, first, theta, P = int(k.first_offset), FRICTIONS, m.models.theta, m.models.P
    rows = k.evidence.columns[:OFFSETS]
    values = rows @ theta
    std = np.sqrt([row @ P @ row for row in rows])
    offsets = slice(base, base + JOINTS)
    return Certificate(
        parameters=tuple(theta[:base].tolist()),
        friction_Nm=tuple(values[:first].tolist()),
        friction_std_Nm=tuple(std[:first].tolist()),
        inertia_kgm2=tuple(values[first:].tolist()),
        inertia_std_kgm2=tuple(std[first:].tolist()),
        offset_Nm=tuple((k.anchor.zero_Nm + theta[offsets]).tolist()),
        offset_std_Nm=tuple(np.sqrt(np.diag(P)[offsets]).tolist()),
        is_payload=bool(m.models.is_payload),
        text=text,
    )
