"""Constants and memory of the certified scheme's compiled code, each declared once with its type and shape.

The docstring of a record of memory names the module that writes it; any module may read. In
compiled code, and in functions that describe its results, k is `Constants` and m is `Memory`.

Sizes: n joints; p parameters (dynamic ones, torque offsets, lags, further friction); t terms by place, f = p + n t;
filters of the bank, channels of its detection. The others are constants of the module that owns the record.
"""

from dataclasses import dataclass
from typing import Annotated

from adacd_hil.records import Vector
from adacd_hil.structured import Columns, PerJoint, PerParameter, Square

EachFilter = Annotated[Vector, "filters n"]
EachChannel = Annotated[Vector, "channels n"]
PlaceColumns = Annotated[Vector, "n t"]
EachTerm = Annotated[Vector, "f"]


class Sample:
    """Inputs of a cycle: an ArmState, `age` that of its oldest value, and the request in this cycle.

    sampled_ns: time of the SYNC on which it was sampled, or of the cycle.
    """

    cycle: int
    periods: int
    steps: int
    sampled_ns: int
    age: int
    fault: int
    request: int
    is_complete: int
    is_enabled: int
    is_late: int
    q: PerJoint
    dq: PerJoint
    tau_J: PerJoint


class Gaps:
    """Sample before the present one, and samples missing since: written by `certified_kernel`.

    has_gap: the filters resume at the next sample. is_steady: no sample is missing. last, between: q, dq, tau_J of the
    sample before, and of an interpolated one.
    """

    has_gap: float
    is_steady: float
    last: Annotated[Vector, "3 n"]
    between: Annotated[Vector, "3 n"]


class Regressor:
    """The regressor of a sample: written by `regressor`.

    Y_p, Y_h: see `torque_filter`. M: mass matrix of the model in use. X: columns of torque by position. bent: of the
    bristles, see `further_friction`.
    """

    Y_p: Columns
    Y_h: Columns
    M: Annotated[Vector, "n n"]
    X: PlaceColumns
    bent: Annotated[Vector, "2 n"]


class Filters:
    """The filter bank, and each filter's external torque, bare and smoothed: written by `filter_bank`.

    r: bare; y: by channel. rates: the filters' coefficients of the present period. W_learnt, tau_learnt: smoothed, for
    learning.
    """

    input_old: Annotated[Vector, "filters n p"]
    S: Annotated[Vector, "filters n p"]
    W_f: Annotated[Vector, "filters n p"]
    tau_f: EachFilter
    tau_old: EachFilter
    r: EachFilter
    rates: Annotated[Vector, "3 filters"]
    W_learnt: Columns
    tau_learnt: PerJoint
    y: EachChannel


class Models:
    """Model in use (theta, P), certified model and belief: written by `belief`.

    v, K: scratch. promotions: refined models since the certificate. since_learnt: samples since the last one that was
    put into the ring. recovering_cycles: left without learning. is_payload: a payload is learnt on top of the certified
    model.
    """

    theta: PerParameter
    certified: PerParameter
    belief: PerParameter
    v: PerParameter
    K: PerParameter
    P: Square
    P_certified: Square
    P_belief: Square
    promotions: float
    since_learnt: float
    are_lags_held: float
    recovering_cycles: float
    is_payload: float


class Candidate:
    """A candidate for the certified model, and its test: written by `refinement`.

    cycles: of the test. square, frozen_square: sums of squared residuals of the candidate, and of the model in use.
    worst: the candidate's largest residual over its threshold.
    """

    theta: PerParameter
    P: Square
    cycles: float
    square: float
    worst: float
    frozen_square: float


class Ring:
    """Samples to be learnt, which wait until no contact can have bent them: written by `belief`.

    used: number of samples that wait; next: place of the oldest, once it is full. It may have more places than samples
    wait.
    """

    W: Annotated[Vector, "places_in_ring n p"]
    tau: Annotated[Vector, "places_in_ring n"]
    R: Annotated[Vector, "places_in_ring n"]
    still: Annotated[Vector, "places_in_ring n"]
    used: float
    next: float


class Motion:
    """Ranges of position and velocity of the joints in a fit, and its information matrix: written by `excitation`.

    samples: their number.
    """

    q_low: PerJoint
    q_high: PerJoint
    dq_low: PerJoint
    dq_high: PerJoint
    information: Square
    scratch: Square
    samples: float


class Fit:
    """Progress of a fit and its test: written by `termination`.

    tested: samples of the test. excitation, condition: smallest eigenvalue of the scaled information matrix, and the
    largest over it.
    """

    tested: float
    test_limit_Nm: float
    excitation: float
    condition: float


class Sensitivity:
    """Noise, standstill, friction at rest, and the thresholds by them: written by `sensitivity`.

    still, still_smooth, low_speed: shares of standstill and of low speed in a filter's memory. h: thresholds; h_model:
    without standstill and the tail's floor. doubt: deviation by the model's uncertainty. hold, held: torque that
    friction may hold at rest. roughness, velocity_roughness: noise over that of the settings, squared. unit, strain:
    factors on variances and on thresholds. used, peak_share: largest residual over its threshold. wide: of the torque
    with a filter undone.
    """

    still: EachFilter
    still_smooth: EachFilter
    low_speed: EachFilter
    doubt: EachFilter
    held: EachFilter
    h: EachChannel
    h_model: EachChannel
    roughness: PerJoint
    roughness_now: PerJoint
    roughness_kept: PerJoint
    velocity_roughness: PerJoint
    unit: PerJoint
    strain: PerJoint
    used: PerJoint
    peak_share: PerJoint
    hold: PerJoint
    dq_old: PerJoint
    ddq_old: PerJoint
    torque_changes: PerJoint
    torque_change_Nm: PerJoint
    torque_step_Nm: PerJoint
    torque_pull_Nm: PerJoint
    rest_tau: PerJoint
    rest_square: PerJoint
    wide_sigma: PerJoint
    wide_threshold: PerJoint
    unit_by_sign: Annotated[Vector, "2 n"]
    rest_samples: float


class LostSamples:
    """Variance of the external torque by missing samples, Nm²: written by `lost_samples`."""

    lost_Nm2: EachFilter


class Tail:
    """Largest residuals of free motion: written by `tail`.

    peak, peak_now, peak_last: by sign, kept, of the present block, of the one before. tail_Nm: floors of thresholds by
    them.
    """

    peak: Annotated[Vector, "2 channels n"]
    peak_now: Annotated[Vector, "2 channels n"]
    peak_last: Annotated[Vector, "2 channels n"]
    tail_Nm: EachChannel
    block_used: float
    tail_s: float


class Sight:
    """Smallest detectable push: written by `sight`.

    seen, seen_: counts and worst values of the test. sum_, mean_push_Nm, dim_s: of monitoring.
    """

    seen_worst_Nm: PerJoint
    seen_push_Nm: PerJoint
    sum_push_Nm: PerJoint
    sum_cycles: PerJoint
    mean_push_Nm: PerJoint
    dim_s: PerJoint
    seen: Annotated[Vector, "bins n"]


class Evidence:
    """Each source's value of each quantity, and the fit's difference from it: written by `evidence`.

    floor, slack: least allowed difference, and one that is added. difference, limit: of the last comparison; without
    one 0 and inf. fitted: values of the model that is judged.
    """

    value: Annotated[Vector, "sources quantities"]
    variance: Annotated[Vector, "sources quantities"]
    floor: Annotated[Vector, "sources quantities"]
    slack: Annotated[Vector, "sources quantities"]
    difference: Annotated[Vector, "sources quantities"]
    limit: Annotated[Vector, "sources quantities"]
    age_s: Annotated[Vector, "sources"]
    fitted: Annotated[Vector, "quantities"]
    fitted_variance: Annotated[Vector, "quantities"]


class Anchor:
    """Anchors of the torque offsets: written by `anchor`.

    rest_count: samples in the reading at rest. anchor_Nm, anchor_std: by kind of anchor, inf for a missing one.
    """

    rest_count: float
    anchor_Nm: Annotated[Vector, "kinds n"]
    anchor_std: Annotated[Vector, "kinds n"]


class PlaceBound:
    """The fit's largest torque that depends on the position: written by `place_bound`."""

    by_place_Nm: PerJoint


class FitCheck:
    """Steps and kept samples of a fit, which the fit must explain at its end: written by `fit_check`.

    fit_square, fit_rows: sum of squared residuals over their variances, and their number. steps_used: number of steps
    so far. samples_every: learnt samples for each one that is kept. factor, apart, later: scratch.
    """

    fit_square: float
    fit_rows: float
    fit_samples: float
    steps_used: float
    samples_kept: float
    samples_every: float
    samples_left_out: float
    samples_W: Annotated[Vector, "room n p"]
    samples_tau: Annotated[Vector, "room n"]
    steps_theta: Annotated[Vector, "steps p"]
    steps_P: Annotated[Vector, "steps p p"]
    steps_square: Annotated[Vector, "steps"]
    steps_rows: Annotated[Vector, "steps"]
    factor: Square
    apart: PerParameter
    later: PerParameter


class Earlier:
    """State of kept beliefs: their number, refused fits in a row, whether they have lapsed: written by `earlier`."""

    kept_count: float
    refused_fits: float
    has_lapsed: float


class Doubt:
    """Evidence on the cause of a certified model's contacts: sums of `doubt`, which writes them.

    row: scratch. load_ww: evidence for a payload by direction of its pull. rr, rows: Σ r², number of rows. peak:
    largest residual over its threshold.
    """

    L: Annotated[Vector, "causes_n causes_n"]
    b: Annotated[Vector, "causes_n"]
    row: Annotated[Vector, "causes_n"]
    load_ww: Annotated[Vector, "2"]
    rr: float
    rows: float
    peak: float


class MissingTorque:
    """Evidence for torque that the model lacks: sums of `missing_torque`, which writes them.

    X_f, X_learnt: filtered columns by position. basic, full: coefficients of the fits without and with these. yy,
    weight: Σ r²/R and, by joint, Σ 1/R. ways: samples by joint and direction. M, row, scale: scratch. samples, wanted:
    learnt since the last check, and before the next.
    """

    X_old: PlaceColumns
    X_f: PlaceColumns
    X_learnt: PlaceColumns
    ring_X: Annotated[Vector, "places_in_ring n t"]
    L: Annotated[Vector, "n f f"]
    M: Annotated[Vector, "f f"]
    b: EachTerm
    basic: EachTerm
    full: EachTerm
    row: EachTerm
    scale: EachTerm
    last_found: Annotated[Vector, "places"]
    yy: float
    weight: PerJoint
    ways: Annotated[Vector, "n 2"]
    samples: float
    wanted: float
    rms_Nm: PerJoint


class Watch:
    """Counts that decide when a cycle leaves a task to Python: written by `cycle`.

    has_forgotten: FORGET was asked for the present contact. monitored_cycles: since the last SECOND. until_push_cycles:
    until the check for PUSHED, 0 without one.
    """

    has_forgotten: float
    monitored_cycles: float
    until_push_cycles: float


class Memory:
    """The memory of the certified scheme.

    wide_history: the last external torques by the filter that is undone, newest first, see `undone_filter`.
    withheld_by: contradiction for which a certificate is withheld or taken back, see `certificate`.
    """

    gaps: Gaps
    regressor: Regressor
    filters: Filters
    wide_history: Annotated[Vector, "wide n"]
    models: Models
    candidate: Candidate
    ring: Ring
    motion: Motion
    fit: Fit
    sensitivity: Sensitivity
    lost: LostSamples
    tail: Tail
    sight: Sight
    evidence: Evidence
    anchor: Anchor
    place_bound: PlaceBound
    fit_check: FitCheck
    earlier: Earlier
    withheld_by: float
    doubt: Doubt
    missing_torque: MissingTorque
    watch: Watch


@dataclass(frozen=True)
class NoiseConstants:
    """Constants of `sensitivity`: variances by channel (2 C - 1,), and the weight of a sample in each mean (`_share`).

    torque_variance: (k_tau sigma_tau)², Nm²; torque_gain: the same for a noise of 1 Nm. velocity_variance: nu²,
    rad²/s⁴.
    """

    torque_variance: Vector
    torque_gain: Vector
    velocity_variance: Vector
    velocity_noise_rad_s: float
    roughness_share: float
    roughness_loss: float
    strain_share: float
    unit_share: float
    unit_test_share: float
    velocity_std_rad_s: float


@dataclass(frozen=True)
class AnchorConstants:
    """Constants of `anchor`: torque offsets and their standard deviations (n,), inf where unknown.

    zero: of the configuration; last_zero: of the last certificate. holding_Nm: torque that a motor without power can
    hold. zero_drift_Nm2_s: growth of the variance.
    """

    zero_Nm: Vector
    last_zero_Nm: Vector
    last_zero_std_Nm: Vector
    holding_Nm: Vector
    zero_std_Nm: Vector
    zero_drift_Nm2_s: float
    rest_cycles: float


@dataclass(frozen=True)
class EvidenceConstants:
    """Constants of `evidence`: see its `constants_of`.

    Columns (Q, p), prior variances, largest torques (Q,), sigmas (S,), less_counts (S, Q).
    """

    columns: Vector
    columns_prior: Vector
    torque_Nm: Vector
    sigmas: Vector
    less_counts: Vector


@dataclass(frozen=True)
class TailConstants:
    """Constants of `tail`, see its `constants_of`; excursions_Hz: by channel (2 C - 1,)."""

    excursions_Hz: Vector
    block_cycles: float


@dataclass(frozen=True)
class SightConstants:
    """Constants of `sight`, see its `constants_of`; shown: by channel (2 C - 1,)."""

    mean_cycles: float
    shown: Vector


@dataclass(frozen=True)
class TermConstants:
    """Constants of `missing_torque`: prior deviations (f,), and numbers of learnt samples.

    first: before the first check; longest: before each later one at most.
    """

    prior_std: Vector
    first: float
    longest: float


@dataclass(frozen=True)
class Limits:
    """Bounds of position, speed and rest for the checks of `kernel_samples.observe`."""

    position_limit_rad: Vector
    velocity_limit_rad_s: Vector
    rest_velocity_rad_s: float
    rest_torque_Nm: float


@dataclass(frozen=True)
class Constants:
    """The constants of the certified scheme; names as in `CertifiedSettings` and the other sections.

    causes (h, p): see `doubt`. step_samples: learnt samples from one step of `fit_check` to the next. waiting: number
    of samples that wait in the ring.
    """

    period_s: float
    second_cycles: float
    level_rad: float
    cutoff: Vector
    decay: Vector
    weight_old: Vector
    weight_new: Vector
    first_offset: float
    first_cross_talk: float
    first_position: float
    position_torque_Nm: float
    width_rad_s: float
    stribeck_rad_s: float
    terms: Vector
    dahl_rad: Vector
    theta_cad: Vector
    causes: Vector
    step_samples: float
    waiting: float
    prior: Vector
    prior_std: Vector
    enough_std: Vector
    drift_std: Vector
    model_error: Vector
    payload_direction: Vector
    payload_std_kg: float
    payload_rest_std: Vector
    correlated: float
    residual_Nm: float
    learn_every: float
    recover_cycles: float
    settle_cycles: float
    fit_cycles: Vector
    test_cycles: Vector
    beta_Nm: float
    refine_cycles: float
    excitation_Nm2s: float
    condition: float
    scale: Vector
    travel_rad: float
    velocity_rad_s: float
    smoothing: float
    model_sigmas: float
    torque_noise_Nm: float
    noise_sigmas: float
    still_rad_s: float
    standstill_share: float
    collision_Nm: Vector
    noise: NoiseConstants
    anchor: AnchorConstants
    evidence: EvidenceConstants
    tail: TailConstants
    sight: SightConstants
    missing_torque: TermConstants
    limits: Limits
