"""Anchors: evidence of a torque sensor's zero that is independent of the fit.

A lean and an offset have the same column of the regressor, on every motion, so a fit cannot separate them. Independent
knowledge can. An anchor judges the fitted offset and never pulls it: that would push a lean into friction.

    REST      the reading at rest before the drives are enabled. A motor without power, friction and brake transmits no
              torque, so the reading is the offset, even if a person leans. `holding_Nm`, the torque that the motor side
              can hold, is the most by which a lean shifts it; if that is unknown the reading bounds no offset.
    TARE      the zero of the configuration, if a tare gives its uncertainty.
    ACCEPTED  the zero that the user has accepted in place of all others.
    LAST      the zero found by the arm's last certificate, used for a joint that no other anchor bounds.

The fitted offset o must keep to each anchor a that there is, a row of `evidence`:

    |o - a| <= SIGMAS sqrt(u P_oo + sigma_a² + b² t + (0.1 F_c)² + 0.005²) + holding_Nm (of REST)

u P_oo: the belief's variance in the unit of its residuals; b² t: drift since; 0.1 F_c: friction that differs by
direction looks like an offset. Before the drives are enabled the reading at rest must keep to the tare likewise.

Shapes: anchor_Nm, anchor_std (4, n), inf for a missing anchor; holding_Nm (n,), inf where not known.
"""

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.identify import evidence
from adacd_hil.scheme.identify.evidence import OFFSETS
from adacd_hil.scheme.memory import AnchorConstants, Constants, Memory
from adacd_hil.scheme.model.regressor import F_C1
from adacd_hil.settings.configuration import Settings

REST, TARE, ACCEPTED, LAST = range(4)
KINDS = evidence.ANCHORS
NAMES = ("the reading at rest", "the tare", "the user's word", "the last certificate")
_HELD = "the sensor has moved, a cable pulls on it, or the motor holds more at rest than `arm.holding_torque_Nm` says"
_MOVED = "the sensor has moved, or a cable pulls on it"
REST_STD_NM = 0.004
"""Uncertainty of the reading at rest beside its noise: the sensor's hysteresis, and its warming until the
certificate."""
MODEL_STD_NM = 0.005
"""Other errors of the model in the offset of a clean arm."""
ASYMMETRY = 0.1
"""Part of the Coulomb friction by which its two directions may differ."""


def constants_of(settings: Settings) -> AnchorConstants:
    """Return the anchors' constants: `zero_drift_Nm2_s`, `rest_cycles`, and the following (n,).

    `holding_Nm`; `zero_Nm`, `zero_std_Nm`: of the configuration; `last_zero_Nm`, `last_zero_std_Nm`: of the last
    certificate, without one the configuration's zero and inf. A deviation or holding torque that isn't known is inf.
    """
    arm, history = settings.arm, settings.history
    return AnchorConstants(
        zero_Nm=np.array(arm.torque_offset_Nm),
        last_zero_Nm=np.array(history.offset_Nm if history.is_known else arm.torque_offset_Nm),
        last_zero_std_Nm=_or_unknown(history.offset_std_Nm if history.is_known else None),
        holding_Nm=_or_unknown(arm.holding_torque_Nm),
        zero_std_Nm=_or_unknown(arm.torque_offset_std_Nm),
        zero_drift_Nm2_s=settings.tare.drift_Nm_sqrt_s**2,
        rest_cycles=settings.commission_cycles,
    )


def unanchored_joints(settings: Settings) -> list[int]:
    """Return the joints, from 0, whose torque offset neither tare, last certificate nor reading at rest bounds.

    A bound counts if it is `beta_Nm` at most. That of the reading at rest includes the torque that the motor holds
    without power.
    """
    arm, history = settings.arm, settings.history
    bounds_Nm = (
        evidence.ANCHOR_SIGMAS * _or_unknown(arm.torque_offset_std_Nm),
        evidence.ANCHOR_SIGMAS * _or_unknown(history.offset_std_Nm if history.is_known else None),
        evidence.ANCHOR_SIGMAS * REST_STD_NM + _or_unknown(arm.holding_torque_Nm),
    )
    tightest_Nm = np.min(bounds_Nm, axis=0)
    return [i for i in range(JOINTS) if not tightest_Nm[i] <= settings.certified.beta_Nm]


def _or_unknown(values: tuple[float, ...] | None) -> Vector:
    return np.full(JOINTS, np.inf) if values is None else np.array(values)


def begin(k: Constants, m: Memory) -> None:
    """Set the anchors before the first sample: the tare and the last certificate; all others are missing."""
    own = m.anchor
    own.anchor_std[:] = np.inf
    own.anchor_std[TARE] = k.anchor.zero_std_Nm
    own.anchor_Nm[LAST] = k.anchor.last_zero_Nm - k.anchor.zero_Nm
    own.anchor_std[LAST] = k.anchor.last_zero_std_Nm


@compiled
def measure(k: Constants, m: Memory, tau_J: Vector, is_resting: bool) -> None:
    """Add one sample before the drives are enabled to the reading at rest; drop the reading if the arm moves.

    tau_J (n,): Nm. The reading is a mean over about the last `rest_cycles` samples, so a person who leaned before and
    has gone is forgotten. If a joint's holding torque is unknown, the reading doesn't become its anchor. Set the age of
    all anchors to 0.
    """
    own = m.anchor
    own.rest_count = min(own.rest_count + 1.0, k.anchor.rest_cycles) if is_resting else 0.0
    evidence.set_age(m, 0, KINDS, 0.0)
    for i in range(tau_J.shape[0]):
        if not is_resting:
            own.anchor_std[REST, i] = np.inf
            continue
        own.anchor_Nm[REST, i] += (tau_J[i] - own.anchor_Nm[REST, i]) / own.rest_count
        if k.anchor.holding_Nm[i] != np.inf:
            own.anchor_std[REST, i] = np.sqrt(_rest_variance(k, m, i))


@compiled
def _rest_variance(k: Constants, m: Memory, joint: int) -> float:
    noise = k.torque_noise_Nm**2 * m.sensitivity.roughness[joint] / max(m.anchor.rest_count, 1.0)
    return float(noise + REST_STD_NM**2)


@compiled
def is_rest_refused(k: Constants, m: Memory) -> bool:
    """Return whether a joint's reading at rest differs from its tare by more than noise and the torque the motor holds.

    False without a tare, with an unknown holding torque, or while the reading has fewer than `rest_cycles` samples: the
    supervisor counts as many before the arm goes on. Store the comparison as evidence.
    """
    own = m.anchor
    if own.rest_count < k.anchor.rest_cycles:
        return False
    is_refused = False
    for i in range(own.anchor_Nm.shape[1]):
        q, std, slack = OFFSETS + i, own.anchor_std[TARE, i], k.anchor.holding_Nm[i]
        variance = std**2 if np.isfinite(std + slack) else np.inf
        for kind in range(KINDS):
            evidence.skip_row(m, kind, q)
        evidence.put_fitted(m, q, own.anchor_Nm[REST, i], _rest_variance(k, m, i))
        evidence.set_row(m, TARE, q, own.anchor_Nm[TARE, i], variance, 0.0, slack)
        excess = abs(evidence.weigh(k, m, TARE, q))
        is_refused = is_refused or not excess <= 1.0
    return is_refused


@compiled
def is_within(k: Constants, m: Memory, theta: Vector, P: Vector) -> bool:
    """Return whether the torque offsets of a model are within the bounds of all anchors.

    Store the comparison as evidence. theta (p,), P (p, p): the model. A missing anchor bounds nothing. The last
    certificate is used only for a joint without a bound of `beta_Nm`.
    """
    is_within = True
    evidence.fit(k, m, theta, P, min(np.max(m.sensitivity.unit), 1.0))
    for i in range(m.anchor.anchor_Nm.shape[1]):
        q, friction = OFFSETS + i, ASYMMETRY * max(theta[F_C1 + i], 0.0)
        for kind in range(KINDS):
            variance = _variance(k, m, kind, i) + friction**2 + MODEL_STD_NM**2
            if kind == LAST and np.min(m.evidence.limit[:LAST, q]) <= k.beta_Nm:
                variance = np.inf
            slack = k.anchor.holding_Nm[i] if kind == REST else 0.0
            evidence.set_row(m, kind, q, m.anchor.anchor_Nm[kind, i], variance, 0.0, slack)
            excess = abs(evidence.weigh(k, m, kind, q))
            is_within = is_within and excess <= 1.0
    return bool(is_within)


@compiled
def _variance(k: Constants, m: Memory, kind: int, joint: int) -> float:
    """Return the variance of an anchor, Nm²: its own, and the sensor's drift since it was measured."""
    return float(m.anchor.anchor_std[kind, joint] ** 2 + k.anchor.zero_drift_Nm2_s * m.evidence.age_s[kind])


@compiled
def is_excluded(m: Memory, joint: int, offset_Nm: float) -> bool:
    """Return whether `offset_Nm` of a joint, from 0, is outside an anchor's bounds of the last judged fit."""
    bounds_Nm = m.evidence.limit[:KINDS, OFFSETS + joint]
    return not bool(np.all(np.abs(offset_Nm - m.anchor.anchor_Nm[:, joint]) <= bounds_Nm))


@compiled
def innovation(k: Constants, m: Memory, joint: int) -> float:
    """Return (o - a) / (P_oo + sigma_a² + b² t) for the joint's anchor of least sigma_a, 1/Nm; 0 without an anchor.

    For the reading at rest the divisor has holding_Nm² besides. o, P_oo: the fit's offset and its variance. theta less
    the offset's column of P times the result is the model corrected by the anchor as by a measurement of the offset.
    joint: from 0.
    """
    offset = int(k.first_offset) + joint
    kind = int(np.argmin(m.anchor.anchor_std[:, joint]))
    known = _variance(k, m, kind, joint)
    if known == np.inf:
        return 0.0
    if kind == REST:
        known += k.anchor.holding_Nm[joint] ** 2
    return float(
        (m.models.belief[offset] - m.anchor.anchor_Nm[kind, joint]) / (m.models.P_belief[offset, offset] + known)
    )


def accept(m: Memory, offset_Nm: Vector, std_Nm: Vector) -> None:
    """Drop all anchors, and set anchor ACCEPTED to the offsets (n,) that the user accepts as the sensors' zero.

    The offsets count from the configuration's zero, as a fit's do. std_Nm (n,): their standard deviations. Set the age
    of all anchors to 0.
    """
    m.anchor.anchor_std[:] = np.inf
    m.anchor.anchor_Nm[ACCEPTED] = offset_Nm
    m.anchor.anchor_std[ACCEPTED] = std_Nm
    evidence.set_age(m, 0, KINDS, 0.0)


def accept_reading(m: Memory) -> None:
    """Drop the tare as an anchor: the user accepts the reading at rest, which contradicts it."""
    m.anchor.anchor_std[TARE] = np.inf


@compiled
def is_open(k: Constants, m: Memory, joint: int) -> bool:
    """Return whether no anchor bounds the last judged torque offset of a joint, from 0, to `beta_Nm` or closer."""
    return bool(not (np.min(m.evidence.limit[:KINDS, OFFSETS + joint]) <= k.beta_Nm))


def tightest(k: Constants, m: Memory, joint: int) -> int | None:
    """Return the number of the anchor that bounds a joint's last judged offset most closely; None if it `is_open`.

    joint: from 0.
    """
    return None if is_open(k, m, joint) else int(np.argmin(m.evidence.limit[:KINDS, OFFSETS + joint]))


def open_joints(k: Constants, m: Memory) -> list[int]:
    """Return the joints, from 0, whose last judged torque offset no anchor bounds to `beta_Nm`."""
    return [i for i in range(JOINTS) if is_open(k, m, i)]


def judged_Nm(m: Memory) -> Vector:
    """Return a copy of the torque offsets (n,) that anchors judged last: a fit's, or readings at rest."""
    return np.array(m.evidence.fitted[OFFSETS : OFFSETS + JOINTS])


def describe(k: Constants, m: Memory) -> str:
    """Return as text the anchor that bounds each joint's last judged offset most closely, and the bound, Nm.

    A joint without a bound of `beta_Nm` or closer is described as not anchored.
    """
    texts = []
    for i in range(JOINTS):
        kind = tightest(k, m, i)
        texts.append(
            f"joint {i + 1} not at all: who has leaned on it since before the start is in its torque offset"
            if kind is None
            else f"joint {i + 1} to ± {m.evidence.limit[kind, OFFSETS + i]:.3f} Nm by {NAMES[kind]}"
        )
    return f"torque offsets anchored: {'; '.join(texts)}"


def describe_refused(m: Memory, is_reading: bool) -> list[str]:
    """Return a line for each joint and anchor that contradict each other in the last judged torques, with the bound.

    is_reading: the judged torques were readings at rest, else torque offsets of a fit. [] without a contradiction.
    """
    lines = []
    for i, value in enumerate(judged_Nm(m).tolist()):
        for kind in range(KINDS):
            expected, limit = m.anchor.anchor_Nm[kind, i], m.evidence.limit[kind, OFFSETS + i]
            if not abs(value - expected) <= limit:
                what = (
                    f"reads {value:.3f} Nm at rest" if is_reading else f"has a fitted torque offset of {value:.3f} Nm"
                )
                lines.append(
                    f"joint {i + 1} {what}, by {NAMES[kind]} it is {expected:.3f} ± {limit:.3f} Nm: "
                    f"somebody leans on it, {_HELD if kind == REST and not is_reading else _MOVED}"
                )
    return lines
