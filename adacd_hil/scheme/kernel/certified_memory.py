"""Data of the certified scheme's compiled step: constants from the settings, memory, and block.

Three structured arrays of one element, as in `kernel_samples`; the block is
`records.certified_layout`. The parameters, in order: the dynamic ones, torque offsets, lags, further friction.
"""

import math

import numpy as np

from adacd_hil.records import JOINTS, POSITION_TERMS, CertifiedBlock, Vector, block_sizes
from adacd_hil.scheme.detect import sensitivity, sight, tail, undone_filter
from adacd_hil.scheme.identify import (
    anchor,
    belief,
    certificate,
    doubt,
    evidence,
    fit_check,
    missing_torque,
    place_bound,
)
from adacd_hil.scheme.kernel.kernel_samples import Numbers, limits_of
from adacd_hil.scheme.memory import Constants, Memory
from adacd_hil.scheme.model import filter_bank, further_friction, regressor, torque_by_place
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.scheme_settings import CROSS_TALK, FRICTION_TERMS
from adacd_hil.structured import Structured, packed, zeros_of

SETTLED = 3.0
"""After a gap a moving arm waits so many time constants of the learnt filter before it learns again: the filter
restarts with a measured velocity, which lags, and takes this long to forget that error."""

LEAST_PLACES = 32
"""Least number of places in the ring: enough at 0.5 ms and longer periods, so that these share their machine code."""


def parameter_names(settings: Settings) -> tuple[str, ...]:
    """Return the names of all parameters of the certified scheme (p,), in the order of its theta.

    The dynamic ones, then offsets, lags, further friction; then, where the settings have them, cross-talk and the
    torque that depends on the position.
    """
    return settings.estimator.parameter_names + settings.further_names


def _by_kind(values: tuple[float, ...], names: tuple[str, ...]) -> Vector:
    """Return the value for each name (p,) by its kind.

    values: of inertia, viscous and Coulomb friction, gravity, offset, lag, further friction. A name of no other kind
    gets the last one.
    """
    inertia, viscous, coulomb, gravity, offset, lag, further = values
    prefixes = (("F_v", viscous), ("F_c", coulomb), ("offset", offset), ("lag", lag))
    exact = {"a1": inertia, "a2": inertia, "a3": inertia, "a4": gravity, "a5": gravity}
    found = [exact.get(name, next((v for p, v in prefixes if name.startswith(p)), further)) for name in names]
    return np.array(found)


def prior_of(settings: Settings) -> Vector:
    """Return the prior mean of an unknown arm (p,): zeros, but for the velocity's usual lag."""
    return _by_kind((0.0, 0.0, 0.0, 0.0, 0.0, settings.certified.lag_s, 0.0), parameter_names(settings))


def prior_std_of(settings: Settings) -> Vector:
    """Return the prior standard deviation of each parameter of an unknown arm (p,), in the parameter's unit."""
    names = parameter_names(settings)
    std = _by_kind(settings.certified.prior_std, names)
    for j, name in enumerate(names):
        if name.startswith(CROSS_TALK):
            std[j] = settings.certified.cross_talk_std
        elif name.startswith(POSITION_TERMS):
            std[j] = settings.arm.position_torque_Nm / place_bound.LARGEST_OF_STD
        else:
            std[j] *= next((share for term, share in further_friction.SHARES.items() if name.startswith(term)), 1.0)
    return std


def _drift_std_of(settings: Settings) -> Vector:
    """Return the standard deviation of each parameter's drift in a second of monitoring (p,); 0 for cross-talk."""
    names = parameter_names(settings)
    std = _by_kind(settings.certified.drift_std, names)
    std[[name.startswith(CROSS_TALK) for name in names]] = 0.0
    return std


def _first_of(term: str, names: tuple[str, ...]) -> int:
    """Return the index of the first joint's parameter of a term; the number of names if it is missing."""
    return names.index(f"{term}1") if f"{term}1" in names else len(names)


def _enough_std_of(settings: Settings) -> Vector:
    """Return the standard deviation (p,) below which each parameter is known well enough for a complete fit.

    That of an offset is combined with the bound on the torque that depends on the position.
    """
    std = _by_kind(settings.certified.enough_std, parameter_names(settings))
    base = len(settings.estimator.parameter_names)
    offsets = slice(base, base + JOINTS)
    std[offsets] = np.hypot(std[offsets], settings.arm.position_torque_Nm)
    return std


def _payload_rest_std_of(settings: Settings, count: int) -> Vector:
    """Return the standard deviation (p,) by which a payload's parameters differ from those of a point mass at the tip.

    count: p. Those of gravity follow from those of inertia; 0 for all others.
    """
    inertia_std, arm = settings.certified.payload_inertia_std, settings.arm
    std = np.zeros(count)
    std[:3] = inertia_std
    if settings.estimator.gravity:
        std[[regressor.A4, regressor.A5]] = settings.gravity_m_s2 * inertia_std / np.array(arm.link_length_m)
    return std


def constants_of(settings: Settings) -> Structured:
    """Return the settings of the certified scheme's compiled step, converted to cycles, coefficients and vectors.

    As a structured array (1,) with the fields of `Constants`.
    """
    certified, names = settings.certified, parameter_names(settings)
    period_s = settings.bus.period_s
    cutoff = np.array(certified.cutoffs_rad_s)
    decay, weight_old, weight_new = rates = np.zeros((3, cutoff.size))
    filter_bank.discretise(cutoff, period_s, *rates)
    base = len(settings.estimator.parameter_names)
    theta_cad = np.zeros(len(names))
    theta_cad[: len(settings.arm.cad_theta)] = settings.arm.cad_theta
    inertia, viscous, coulomb, gravity = settings.termination.excitation_scale
    correlated = 2.0 / (cutoff[filter_bank.LEARNT] * period_s * certified.learn_every)
    prior_std = prior_std_of(settings)
    return packed(
        Constants(
            period_s=period_s,
            second_cycles=round(1.0 / period_s),
            level_rad=settings.level_rad,
            cutoff=cutoff,
            decay=decay,
            weight_old=weight_old,
            weight_new=weight_new,
            first_offset=base,
            first_cross_talk=_first_of(CROSS_TALK, names),
            first_position=_first_of(POSITION_TERMS[0], names),
            position_torque_Nm=settings.arm.position_torque_Nm,
            width_rad_s=certified.coulomb_width_rad_s,
            terms=np.array([FRICTION_TERMS.index(term) for term in certified.friction_terms]),
            dahl_rad=np.array(certified.dahl_rad),
            theta_cad=theta_cad,
            prior=prior_of(settings),
            prior_std=prior_std,
            enough_std=_enough_std_of(settings),
            drift_std=_drift_std_of(settings),
            model_error=_by_kind(certified.model_error, names),
            payload_direction=regressor.payload_direction(
                settings.arm.link_length_m, len(names), settings.gravity_m_s2
            ),
            payload_rest_std=_payload_rest_std_of(settings, len(names)),
            correlated=max(correlated, 1.0),
            recover_cycles=round(certified.recover_s / period_s),
            settle_cycles=round(SETTLED / (cutoff[filter_bank.LEARNT] * period_s)),
            fit_cycles=np.array([round(fit_s / period_s) for fit_s in certified.fit_s]),
            test_cycles=np.array([round(test_s / period_s) for test_s in certified.test_s]),
            refine_cycles=round(certified.refine_s / period_s),
            scale=_by_kind((inertia, viscous, coulomb, gravity, coulomb, 0.005, coulomb), names)[: base + 2 * JOINTS],
            travel_rad=np.radians(settings.termination.travel_deg),
            velocity_rad_s=np.radians(settings.termination.velocity_deg_s),
            smoothing=math.exp(-certified.smoothing_rad_s * period_s),
            noise=sensitivity.noise_constants(certified, period_s),
            anchor=anchor.constants_of(settings),
            causes=doubt.causes_of(settings, len(names)),
            evidence=evidence.constants_of(settings, prior_std),
            step_samples=fit_check.step_samples_of(settings),
            waiting=_waiting_of(settings),
            tail=tail.constants_of(settings),
            sight=sight.constants_of(settings),
            missing_torque=missing_torque.constants_of(settings, prior_std),
            collision_Nm=np.array(settings.detector.collision_Nm),
            limits=limits_of(settings),
            residual_Nm=certified.residual_Nm,
            learn_every=certified.learn_every,
            beta_Nm=certified.beta_Nm,
            excitation_Nm2s=certified.excitation_Nm2s,
            condition=certified.condition,
            model_sigmas=certified.model_sigmas,
            torque_noise_Nm=certified.torque_noise_Nm,
            noise_sigmas=certified.noise_sigmas,
            still_rad_s=certified.still_rad_s,
            standstill_share=certified.standstill_share,
            payload_std_kg=certified.payload_std_kg,
            stribeck_rad_s=certified.stribeck_rad_s,
        )
    )


def _waiting_of(settings: Settings) -> int:
    """Return the number of learnt samples in `certified.hold_back_s`, which wait in the ring; at least 1."""
    learn_s = settings.bus.period_s * settings.certified.learn_every
    return max(round(settings.certified.hold_back_s / learn_s), 1)


def sizes_of(settings: Settings) -> dict[str, int]:
    """Return the sizes of arrays by the names that the annotations of `Memory` use, such as "p" or "filters"."""
    count = len(parameter_names(settings))
    return {
        "n": JOINTS,
        "p": count,
        "t": torque_by_place.PLACE_TERMS,
        "f": count + JOINTS * torque_by_place.PLACE_TERMS,
        "places": JOINTS * torque_by_place.PLACE_TERMS,
        "filters": settings.filter_count,
        "channels": settings.channel_count,
        "wide": undone_filter.WIDE_SAMPLES + 1,
        "places_in_ring": max(LEAST_PLACES, _waiting_of(settings)),
        "kinds": anchor.KINDS,
        "sources": evidence.SOURCES,
        "quantities": evidence.QUANTITIES,
        "steps": fit_check.STEPS,
        "room": fit_check.ROOM,
        "causes_n": doubt.CAUSES + JOINTS,
        "bins": sight.BINS,
    }


def new_memory(settings: Settings) -> Structured:
    """Return the kernel's memory (1,) before the first sample: after a gap, with the prior as belief and model."""
    memory = zeros_of(Memory, sizes_of(settings))
    k: Constants = constants_of(settings)[0]
    m: Memory = memory[0]
    m.gaps.has_gap = 1.0
    m.gaps.last[:] = np.nan
    prior, prior_std = prior_of(settings), prior_std_of(settings)
    belief.begin(prior, prior_std, m.models.belief, m.models.P_belief)
    belief.begin(prior, prior_std, m.models.theta, m.models.P)
    sensitivity.begin(m)
    evidence.begin(m)
    anchor.begin(k, m)
    missing_torque.clear(k, m)
    certificate.begin(settings, m)
    return memory


def new_block(settings: Settings) -> Structured:
    """Return the values that a cycle fills and logs (1,), before the first sample: zeros, infinite thresholds."""
    base = len(settings.estimator.parameter_names)
    further = len(parameter_names(settings)) - base
    block = zeros_of(CertifiedBlock, block_sizes(base, further, settings.channel_count))
    for name in ("threshold", "threshold_bank", "paper_threshold"):
        block[name] = np.inf
    return block


def numbers_of(settings: Settings) -> Numbers:
    """Return new constants, memory and block of the kernel for one run, as they are before the first sample."""
    block = new_block(settings)
    return Numbers(constants_of(settings), new_memory(settings), block, block.view(np.float64))
