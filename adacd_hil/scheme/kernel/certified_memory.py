"""What the certified scheme's compiled step works on: constants from the settings, memory, and block.

Three structured arrays of one element, as in `adacd_hil.scheme.kernel.paper_kernel`; the block is
`records.certified_layout`. The parameters, in order: the dynamic ones, torque offsets, lags, further friction.
"""

import math
from typing import Any

import numpy as np

from adacd_hil.compiled import Structured, packed, zeroed
from adacd_hil.records import JOINTS, PARAMETER_NAMES, POSITION_TERMS, Vector, certified_layout
from adacd_hil.scheme.detect import external_torque, margin, sensitivity
from adacd_hil.scheme.identify import anchor, belief, doubt, earlier, fit_check, last_certificate, missing_torque
from adacd_hil.scheme.kernel.paper_kernel import block_dtype, limits_of
from adacd_hil.scheme.model import filter_bank, regressor
from adacd_hil.settings.certified_settings import CROSS_TALK, FRICTION_TERMS
from adacd_hil.settings.configuration import Settings

SETTLED = 3.0
"""Time constants of the learnt filter for which a moving arm teaches nothing after a gap: the filter begins anew with a
measured velocity, which lags, and forgets that error only then."""


def parameter_names(settings: Settings) -> tuple[str, ...]:
    """Name all parameters of the certified scheme, in order: dynamic ones, offsets, lags, further friction."""
    return settings.estimator.parameter_names + settings.further_names


def _by_kind(values: tuple[float, ...], names: tuple[str, ...]) -> Vector:
    """Give each parameter the value of its kind, in the order of `CertifiedSettings`."""
    inertia, viscous, coulomb, gravity, offset, lag, further = values
    prefixes = (("F_v", viscous), ("F_c", coulomb), ("offset", offset), ("lag", lag))
    exact = {"a1": inertia, "a2": inertia, "a3": inertia, "a4": gravity, "a5": gravity}
    found = [exact.get(name, next((v for p, v in prefixes if name.startswith(p)), further)) for name in names]
    return np.array(found)


def prior_of(settings: Settings) -> Vector:
    """Return what is expected of an arm of which nothing is known (p,): nothing, but the velocity's usual lag."""
    return _by_kind((0.0, 0.0, 0.0, 0.0, 0.0, settings.certified.lag_s, 0.0), parameter_names(settings))


def prior_std_of(settings: Settings) -> Vector:
    """Return how far an arm of which nothing is known may be from that (p,)."""
    names = parameter_names(settings)
    std = _by_kind(settings.certified.prior_std, names)
    for j, name in enumerate(names):
        if name.startswith(CROSS_TALK):
            std[j] = settings.certified.cross_talk_std
        elif name.startswith(POSITION_TERMS):
            std[j] = settings.arm.position_torque_Nm / anchor.LARGEST_OF_STD
        else:
            std[j] *= next((share for term, share in regressor.SHARES.items() if name.startswith(term)), 1.0)
    return std


def _drift_std_of(settings: Settings) -> Vector:
    """Return how far each parameter may wander in a second of monitoring (p,); a sensor's cross-talk doesn't."""
    names = parameter_names(settings)
    std = _by_kind(settings.certified.drift_std, names)
    std[[name.startswith(CROSS_TALK) for name in names]] = 0.0
    return std


def _first_of(term: str, names: tuple[str, ...]) -> int:
    """Return the place of the first joint's parameter of a term; behind all where there is none."""
    return names.index(f"{term}1") if f"{term}1" in names else len(names)


def _enough_std_of(settings: Settings) -> Vector:
    """Return how well each parameter must be known (p,); an offset no better than the torque by place."""
    std = _by_kind(settings.certified.enough_std, parameter_names(settings))
    base = len(settings.estimator.parameter_names)
    offsets = slice(base, base + JOINTS)
    std[offsets] = np.hypot(std[offsets], settings.arm.position_torque_Nm)
    return std


def constants_of(settings: Settings) -> Structured:
    """Put the settings into the form that the compiled step reads."""
    certified, names = settings.certified, parameter_names(settings)
    period_s = settings.bus.period_s
    cutoff = np.array(certified.cutoffs_rad_s)
    decay, weight_old, weight_new = np.zeros_like(cutoff), np.zeros_like(cutoff), np.zeros_like(cutoff)
    filter_bank.discretise(cutoff, period_s, decay, weight_old, weight_new)
    base = len(settings.estimator.parameter_names)
    theta_cad = np.zeros(len(names))
    theta_cad[: len(settings.arm.cad_theta)] = settings.arm.cad_theta
    inertia, viscous, coulomb, gravity = settings.termination.excitation_scale
    correlated = 2.0 / (cutoff[filter_bank.LEARNT] * period_s * certified.learn_every)
    values: dict[str, Any] = {
        "period_s": period_s,
        "cutoff": cutoff,
        "decay": decay,
        "weight_old": weight_old,
        "weight_new": weight_new,
        "base": base,
        "first_coulomb": PARAMETER_NAMES.index("F_c1"),
        "first_term": base + 2 * JOINTS,
        "has_cross_talk": certified.cross_talk_std > 0.0,
        "first_cross_talk": _first_of(CROSS_TALK, names),
        "first_position": _first_of(POSITION_TERMS[0], names),
        "position_torque_Nm": settings.arm.position_torque_Nm,
        "width_rad_s": certified.coulomb_width_rad_s,
        "stribeck_rad_s": certified.stribeck_rad_s,
        "terms": [FRICTION_TERMS.index(term) for term in certified.friction_terms],
        "dahl_rad": certified.dahl_rad,
        "theta_cad": theta_cad,
        "prior": prior_of(settings),
        "prior_std": prior_std_of(settings),
        "enough_std": _enough_std_of(settings),
        "drift_std": _drift_std_of(settings),
        "model_error": _by_kind(certified.model_error, names),
        "payload_direction": regressor.payload_direction(settings.arm.link_length_m, len(names)),
        "payload_std_kg": certified.payload_std_kg,
        "payload_inertia_std": certified.payload_inertia_std,
        "correlated": max(correlated, 1.0),
        "residual_Nm": certified.residual_Nm,
        "learn_every": certified.learn_every,
        "recover_cycles": round(certified.recover_s / period_s),
        "settle_cycles": round(SETTLED / (cutoff[filter_bank.LEARNT] * period_s)),
        "fit_cycles": [round(fit_s / period_s) for fit_s in certified.fit_s],
        "test_cycles": [round(test_s / period_s) for test_s in certified.test_s],
        "beta_Nm": certified.beta_Nm,
        "refine_cycles": round(certified.refine_s / period_s),
        "excitation_Nm2s": certified.excitation_Nm2s,
        "condition": certified.condition,
        "scale": _by_kind((inertia, viscous, coulomb, gravity, coulomb, 0.005, coulomb), names)[: base + 2 * JOINTS],
        "travel_rad": np.radians(settings.termination.travel_deg),
        "velocity_rad_s": np.radians(settings.termination.velocity_deg_s),
        "smoothing": math.exp(-certified.smoothing_rad_s * period_s),
        **sensitivity.noise_constants(certified, period_s),
        **anchor.constants_of(settings),
        **doubt.constants_of(settings, len(names)),
        **earlier.constants_of(settings, prior_std_of(settings)),
        **last_certificate.constants_of(settings),
        **margin.tail_constants(settings),
        **margin.sight_constants(settings),
        **missing_torque.constants_of(settings, prior_std_of(settings)),
        "model_sigmas": certified.model_sigmas,
        "torque_noise_Nm": certified.torque_noise_Nm,
        "noise_sigmas": certified.noise_sigmas,
        "still_rad_s": certified.still_rad_s,
        "standstill_share": certified.standstill_share,
        "collision_Nm": settings.detector.collision_Nm,
        **limits_of(settings),
    }
    return packed(values)


def new_memory(settings: Settings) -> Structured:
    """Return the memory before the first sample: a gap, and a belief that is the prior."""
    certified = settings.certified
    filter_count, channel_count = settings.filter_count, settings.channel_count
    count = len(parameter_names(settings))
    learn_s = settings.bus.period_s * certified.learn_every
    waiting = max(round(certified.hold_back_s / learn_s), 1)
    joint, parameter = (JOINTS,), (count,)
    columns, square = (JOINTS, count), (count, count)
    shapes: dict[str, tuple[int, ...]] = {
        "has_gap": (),
        "is_steady": (),
        # bank
        "Y_p": columns,
        "Y_h": columns,
        "input_old": (filter_count, *columns),
        "S": (filter_count, *columns),
        "W_f": (filter_count, *columns),
        "tau_f": (filter_count, JOINTS),
        "W_learnt": columns,
        "tau_learnt": joint,
        "tau_old": (filter_count, JOINTS),
        "rates": (3, filter_count),
        "last": (3, JOINTS),
        "between": (3, JOINTS),
        # model in use
        "theta": parameter,
        "P": square,
        "M": (JOINTS, JOINTS),
        "promotions": (),
        "certified": parameter,
        "P_certified": square,
        # belief
        "belief": parameter,
        "P_belief": square,
        "v": parameter,
        "K": parameter,
        "ring_W": (waiting, *columns),
        "ring_tau": (waiting, JOINTS),
        "ring_R": (waiting, JOINTS),
        "ring_still": (waiting, JOINTS),
        "ring_used": (),
        "ring_next": (),
        "since_learnt": (),
        "are_lags_held": (),
        "recovering_cycles": (),
        # evidence
        "is_payload": (),
        "samples": (),
        "tested": (),
        "test_limit_Nm": (),
        "q_low": joint,
        "q_high": joint,
        "dq_low": joint,
        "dq_high": joint,
        "information": square,
        "scratch": square,
        "excitation": (),
        "condition": (),
        # candidate
        "candidate": parameter,
        "P_candidate": square,
        "candidate_cycles": (),
        "candidate_square": (),
        "frozen_square": (),
        "candidate_worst": (),
        # detection
        "r": (filter_count, JOINTS),
        "y": (channel_count, JOINTS),
        "h": (channel_count, JOINTS),
        "h_model": (channel_count, JOINTS),
        "still": (filter_count, JOINTS),
        "still_smooth": (filter_count, JOINTS),
        "doubt": (filter_count, JOINTS),
        "bent": (2, JOINTS),
        "rest_samples": (),
        "rest_tau": joint,
        "rest_square": joint,
        "roughness": joint,
        "torque_changes": joint,
        "torque_change_Nm": joint,
        "torque_step_Nm": joint,
        "torque_pull_Nm": joint,
        # anchors of the offsets
        "rest_count": (),
        "anchor_age_s": (),
        "anchor_Nm": (anchor.KINDS, *joint),
        "anchor_std": (anchor.KINDS, *joint),
        "bound_Nm": (anchor.KINDS, *joint),
        "judged_Nm": joint,
        # what was known earlier
        **earlier.shapes_of(count),
        **fit_check.shapes_of(count),
        **last_certificate.shapes_of(),
        **doubt.shapes_of(),
        **margin.tail_shapes(channel_count),
        **margin.sight_shapes(),
        **anchor.place_shapes(),
        **missing_torque.shapes_of(count, waiting),
        **sensitivity.shapes_of(filter_count),
        "withheld_by": (),
        "dq_old": joint,
        "ddq_old": joint,
        "roughness_now": joint,
        "roughness_kept": joint,
        "velocity_roughness": joint,
        "unit": joint,
        "strain": joint,
        "used": joint,
        "peak_share": joint,
        "hold": joint,
        "held": (filter_count, JOINTS),
        # contact
        "history": (external_torque.WIDE_SAMPLES + 1, JOINTS),
        "wide_sigma": joint,
        "wide_threshold": joint,
    }
    memory = zeroed(shapes)
    memory["has_gap"] = 1.0
    memory["last"] = np.nan
    memory["roughness"] = 1.0
    memory["roughness_now"] = 1.0
    memory["roughness_kept"] = 1.0
    memory["velocity_roughness"] = 1.0
    memory["unit"] = 1.0
    memory["strain"] = 1.0
    state = memory[0]
    prior, prior_std = prior_of(settings), prior_std_of(settings)
    belief.begin(prior, prior_std, state["belief"], state["P_belief"])
    belief.begin(prior, prior_std, state["theta"], state["P"])
    constants = constants_of(settings)[0]
    anchor.begin(constants, state)
    missing_torque.clear(constants, state)
    last_certificate.begin(constants, state)
    return memory


def new_block(settings: Settings) -> Structured:
    """Return a block before the first sample: zeros, and thresholds that nothing exceeds."""
    base = len(settings.estimator.parameter_names)
    further = len(parameter_names(settings)) - base
    layout = certified_layout(base, further, settings.channel_count)
    block = np.zeros(1, block_dtype(layout))
    for name in ("threshold", "threshold_bank", "paper_threshold"):
        block[name] = np.inf
    return block
