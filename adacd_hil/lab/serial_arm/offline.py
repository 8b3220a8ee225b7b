"""Identification and detection of an arm with n joints on recorded arrays, without bus or emulator.

The steps, each a function over a `Record`:

- `identify`: recursive least squares of all parameters that the torque shows: base parameters of the links, F_v and
  F_c of each joint, an offset of each torque sensor, and, where torques are those of motors, the inertia of each rotor
  as the joint feels it through the gear. It starts from prior knowledge, with true uncertainty (`prior`), and ends with
  the uncertainty P that is left.
- `certify`: the same parameters, frozen, on motion that was not used. It returns the size of the residual, and its
  excess over noise and P: the model's lack.
- `filtered`: measured torque and the frozen model's residual as the fit sees them: they show the explained part.
- `parameter_deviation`: standard deviation of the parameters, by the disagreement of parts of the fit.
- `detect`: the external torque of each joint, its threshold, and the contacts.

    tau_ext_hat = -(tau_f - W_f theta_hat),    threshold = k sqrt(noise² + lack² + w P w') + F_c at standstill

with w the joint's row of W_f. noise is the part of the sensor's white noise behind the filter (`_noise_gains`).
Filtered noise is not white: samples taken every D periods are correlated, so the fit counts one as a measurement of
variance
noise² (1 + 2 sum rho_jD), which gives a long record the information that it has.

White noise of the velocity goes through the filter's direct path a Y_p: it shows as a M delta_dq in the residual, which
is not correlated. With 1 mrad/s at a = 50 rad/s that is 0.1 Nm on an arm of 2 kg m², more than the torque sensor's. In
a fit it is noise of the regressor, which makes an arm look light: inertias came to 0.4 times the right ones with the
velocities of a cheap drive, 0.1 rad/s of noise. So the fit learns behind a second pole of the same cut-off, regressor
and torque alike, and weighs a sample by the M of a first fit, which leaves this noise out.

A force on a link loads the joints before it and not those behind: the link of a contact is that of the outermost joint
over its threshold until the isolation window ends. A force through a joint's axis is blind to that joint.

Only `_run` uses filters and estimator.

Shapes: k samples, n joints, p parameters. Filters with DC gain 1 (b = a). Units: Nm, or N for a prismatic joint.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg

from adacd_hil.compiled import compiled
from adacd_hil.lab.serial_arm import chain
from adacd_hil.lab.serial_arm.chain import BaseParameters, Chain, Indices
from adacd_hil.records import Vector
from adacd_hil.scheme.detect import external_torque, undone_filter
from adacd_hil.scheme.identify import estimator
from adacd_hil.scheme.model import torque_filter
from adacd_hil.settings.schema import setting

_PARTS = 12
"""Number of parts of a fit that are compared with each other: 8 to 24 gave the same on public recordings."""
_UNKNOWN_LINK = (
    10.0,
    *(2.0,) * 3,
    *(1.0,) * 6,
)  # kg, kg m, kg m²: no link of an arm that a human works beside has more
_UNKNOWN_JOINT = (10.0, 10.0, 1.0, 2.0)  # F_v, Nm s/rad; F_c and torque offset, Nm; rotor's inertia, kg m²


@dataclass(frozen=True)
class OfflineSettings:
    """Properties of a record's sensors, filters and thresholds."""

    noise_Nm: tuple[float, ...] = setting(unit="Nm", low=1e-6, meaning="rms of each torque sensor's white noise")
    period_s: float = setting(1e-3, unit="s", low=1e-5, high=0.1, meaning="time between two samples")
    velocity_noise_rad_s: float = setting(
        0.0, unit="rad/s", low=0.0, high=1.0, meaning="rms of the measured velocities' white noise"
    )
    fit_cutoff_rad_s: float = setting(10.0, unit="rad/s", low=0.1, high=2000.0, meaning="filter of the fit")
    detection_cutoff_rad_s: float = setting(
        50.0, unit="rad/s", low=0.1, high=2000.0, meaning="filter of certificate and detection"
    )
    fit_every: int = setting(20, unit="samples", low=1, high=10_000, meaning="between two corrections")
    deviations: float = setting(6.0, low=1.0, high=100.0, meaning="threshold over the residual's standard deviation")
    standstill_rad_s: float = setting(0.01, unit="rad/s", low=0.0, meaning="below it a joint may hold its friction")
    isolation_s: float = setting(0.05, unit="s", low=0.0, high=1.0, meaning="from detection until the link is told")


@dataclass(frozen=True)
class Record:
    """A measurement, time-first (k, n), at a fixed period.

    Copies are made only of arrays that aren't contiguous float64. Raises ValueError if shapes differ or a value isn't
    finite.
    """

    q: Vector
    dq: Vector
    tau_J: Vector

    def __post_init__(self) -> None:
        for name in ("q", "dq", "tau_J"):
            values = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, values)
            if values.ndim != 2 or values.shape != self.q.shape:
                raise ValueError(f"{name} has shape {values.shape}, not (k, n) as q {self.q.shape}")
            if not np.all(np.isfinite(values)):
                sample, joint = np.argwhere(~np.isfinite(values))[0]
                raise ValueError(f"{name}[{sample}, {joint}] is not finite")


@dataclass(frozen=True)
class ArmModel:
    """The columns of an arm's regressor: base parameters of the links, F_v, F_c and torque offset of each joint.

    With has_rotors, the inertia of each rotor comes last. `model_of` makes it.
    """

    chain: Chain
    base: BaseParameters
    has_rotors: bool = False

    @cached_property
    def joints(self) -> int:
        """Number of joints, n."""
        return len(self.chain.axis)

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the p parameters in the order of theta: base, F_v of all joints, F_c of all, offset of all.

        With has_rotors the rotor inertias of all joints come last.
        """
        kinds = ("F_v", "F_c", "offset", *(("rotor",) if self.has_rotors else ()))
        per_joint = (f"{kind}{i + 1}" for kind in kinds for i in range(self.joints))
        return (*self.base.names, *per_joint)

    def place_of(self, kind: str) -> slice:
        """Return where in theta one kind of parameters is: "base", "F_v", "F_c", "offset" or "rotor".

        Without has_rotors, the slice of "rotor" is beyond the end of theta. Raises KeyError for another kind.
        """
        first, n = self.base.columns.size, self.joints
        starts = {"F_v": first, "F_c": first + n, "offset": first + 2 * n, "rotor": first + 3 * n}
        return slice(0, first) if kind == "base" else slice(starts[kind], starts[kind] + n)


def model_of(arm: Chain, has_rotors: bool = False) -> ArmModel:
    """Return the model of an arm, with the parameters that its torque shows; takes about 0.1 s for seven joints.

    has_rotors: torques are those of geared motors, which turn their rotors too; a link-side sensor doesn't see them.
    """
    return ArmModel(arm, chain.find_base(arm), has_rotors)


@dataclass(frozen=True)
class ModelEstimate:
    """Parameters theta (p,) and their covariance P (p, p), in the order of `ArmModel.parameter_names`."""

    theta: Vector
    P: Vector


def prior(model: ArmModel) -> ModelEstimate:
    """Return the estimate before any motion: zero, with deviations of any arm that a human could stand beside."""
    n, map_to_base = model.joints, model.base.map
    links = (map_to_base * np.tile(_UNKNOWN_LINK, n) ** 2) @ map_to_base.T
    rest = np.repeat(_UNKNOWN_JOINT if model.has_rotors else _UNKNOWN_JOINT[:-1], n) ** 2
    return ModelEstimate(np.zeros(len(model.parameter_names)), scipy.linalg.block_diag(links, np.diag(rest)))


def with_payload(
    model: ArmModel, estimate: ModelEstimate, mass_kg: float, at_m: tuple[float, float, float]
) -> ModelEstimate:
    """Return the estimate after an unknown mass was mounted at a known place: theta stays, P grows by one unknown.

    mass_kg: standard deviation of the mass, from zero. at_m: in the frame of the last link.
    """
    change = np.zeros(model.base.map.shape[1])
    change[-chain.PER_LINK :] = chain.point_mass(mass_kg, at_m)
    in_base = np.zeros(estimate.theta.size)
    in_base[model.place_of("base")] = model.base.map @ change
    return ModelEstimate(estimate.theta, estimate.P + np.outer(in_base, in_base))


@dataclass(frozen=True)
class OfflineCertificate:
    """Result of the test of a frozen model on motion that was not used for the fit."""

    residual_rms_Nm: Vector  # (n,)
    residual_max_Nm: Vector  # (n,)
    lack_Nm: Vector  # (n,), standard deviation of the residual beyond noise and P
    threshold_Nm: Vector  # (n,), median over all samples, of noise, P and friction held at standstill
    margins: Vector  # (n,), smallest ratio of threshold to residual over all samples; below 1 is a false alarm

    @property
    def margin(self) -> float:
        """The smallest of all joints' margins, threshold over residual; below 1: false alarms."""
        return float(np.min(self.margins))


class FilteredRecord(NamedTuple):
    """Records behind a filter, (k, n), Nm; unit (k,): the filter's output for a constant 1 Nm."""

    tau_ext_hat: Vector  # predicted minus measured torque
    deviation: Vector  # of tau_ext_hat, by noise and P
    friction: Vector  # that a joint at standstill may hold
    tau_f: Vector  # measured torque
    unit: Vector


@dataclass(frozen=True)
class OfflineDetection:
    """External torque and threshold of each sample and joint (k, n), Nm, and the contacts in order.

    A contact: index of the sample of its detection; its link, from 0; the sign (n,) of tau_ext_hat of each joint when
    it crossed its threshold, 0 if it did not within the isolation window.
    """

    tau_ext_hat: Vector
    threshold: Vector
    contacts: tuple[tuple[int, int, tuple[int, ...]], ...]


def identify(model: ArmModel, record: Record, before: ModelEstimate, settings: OfflineSettings) -> ModelEstimate:
    """Return the estimate `before`, corrected by a record of free motion; `before` stays as it is.

    With noise of velocities, the record is fitted twice: the first result gives the mass matrix that passes that noise
    on. Raises ValueError if record or `noise_Nm` and model differ in their number of joints.
    """
    theta_M = before.theta
    for has_velocity_noise in (False, True) if settings.velocity_noise_rad_s else (True,):
        theta, P = before.theta.copy(), before.P.copy()
        weighed = settings if has_velocity_noise else replace(settings, velocity_noise_rad_s=0.0)
        _trace(model, record, ModelEstimate(theta, P), weighed, theta_M, is_learning=True)
        theta_M = theta
    return ModelEstimate(theta, P)


def parameter_deviation(
    model: ArmModel,
    records: Sequence[Record],
    before: ModelEstimate,
    estimate: ModelEstimate,
    settings: OfflineSettings,
) -> Vector:
    """Return the standard deviation (p,) of an estimate that `identify` made of all records in turn, from `before`.

    The largest of three: P, by noise; the disagreement between parts of the records,

        P (sum g_b g_b') P B / (B - 1),    g_b = sum of w' r / variance over part b of B, less the parts' mean

    with r the residual of the fit (White's heteroscedastic covariance, by blocks as the residual of a wrong model is
    correlated); and, as such a residual may repeat with the motion, P of a fit in which the part of r beyond noise
    counts as if it came in p / 2 independent samples. On nine wrong models of the planar arm the true parameters were
    off by 0.9 to 5 of it (rms), and by 26 to 390 of P; only a torque that looks like another parameter was further off.
    Raises ValueError if a record or `noise_Nm` and model differ in their number of joints.
    """
    count, kinds = sum(len(record.q) for record in records), [estimate.P]
    scores = np.zeros((_PARTS, estimate.theta.size))
    squares, at = np.zeros(model.joints), 0
    for record in records:
        trace = _trace(
            model, record, estimate, settings, estimate.theta, scores=scores, at=at, length=-(-count // _PARTS)
        )
        squares += np.sum(trace.tau_ext_hat**2, axis=0)
        at += len(record.q)
    scores -= scores.mean(axis=0)
    spread = scores @ estimate.P
    kinds.append(spread.T @ spread * _PARTS / (_PARTS - 1))
    gain, _, R = _noise_gains(settings.fit_cutoff_rad_s, settings, is_smoothed=True)
    lack_square = np.maximum(squares / count - filtered_noise_Nm(settings) ** 2, 0.0)
    repeats = max(count / settings.fit_every / (0.5 * estimate.theta.size), 1.0)
    noise_Nm = np.sqrt(np.array(settings.noise_Nm) ** 2 + lack_square * repeats / (R * gain**2))
    wide = before
    for record in records:
        wide = identify(model, record, wide, replace(settings, noise_Nm=tuple(noise_Nm.tolist())))
    kinds.append(wide.P)
    return np.asarray(np.sqrt(np.max([np.diag(kind) for kind in kinds], axis=0)))


def filtered(
    model: ArmModel, records: Sequence[Record], estimate: ModelEstimate, settings: OfflineSettings
) -> FilteredRecord:
    """Return records behind the smoothed filter of the fit, with external torque and deviation by the frozen estimate.

    The samples are those of all records, at least one, in turn; the filter begins anew with each. Raises ValueError if
    a record or `noise_Nm` and model differ in their number of joints.
    """
    return _traces(model, records, estimate, settings, estimate.theta)


def fit_rows(model: ArmModel, record: Record, settings: OfflineSettings) -> tuple[Vector, Vector]:
    """Return every `fit_every`-th sample behind the filter of the fit: regressor (m, n, p) and torque (m, n).

    The first is the sample with index `fit_every` - 1; of a shorter record there is none. Raises ValueError if record
    or `noise_Nm` and model differ in their number of joints.
    """
    count = len(record.q) // settings.fit_every
    shape = (count, model.joints, len(model.parameter_names))
    rows = np.zeros(shape), np.zeros(shape[:2])
    zero = ModelEstimate(np.zeros(shape[2]), np.zeros((0, 0)))
    _trace(model, record, zero, settings, zero.theta, rows=rows)
    return rows


def mass_terms(model: ArmModel, q: Vector, dq: Vector) -> Vector:
    """Return the row (p,) whose product with theta is dq' M(q) dq, twice the kinetic energy, rotors included."""
    Y_p = np.zeros((model.joints, len(model.parameter_names)))
    Y_p[:, model.place_of("base")] = chain.split_regressor(model.chain, q, dq)[0][:, model.base.columns]
    if model.has_rotors:
        Y_p[:, model.place_of("rotor")] = np.diag(dq)
    return np.asarray(dq @ Y_p)


def filtered_noise_Nm(settings: OfflineSettings) -> Vector:
    """Return the rms noise of each torque sensor (n,), Nm, behind the filter of the fit."""
    gain, _, _ = _noise_gains(settings.fit_cutoff_rad_s, settings, is_smoothed=True)
    return gain * np.array(settings.noise_Nm)


def certify(
    model: ArmModel, records: Sequence[Record], estimate: ModelEstimate, settings: OfflineSettings
) -> OfflineCertificate:
    """Test an estimate on records of free motion that `identify` has not seen; return residuals and margins.

    records: at least one; the filter begins anew with each. A joint's margin is the smallest ratio of threshold to
    residual; below 1 there was a false alarm. The caller judges it. Raises ValueError if a record or `noise_Nm` and
    model differ in their number of joints.
    """
    trace = _traces(model, records, estimate, settings)
    residual = np.abs(trace.tau_ext_hat)
    mean_square = np.mean(residual**2, axis=0)
    lack = np.sqrt(np.maximum(mean_square - np.mean(trace.deviation**2, axis=0), 0.0))
    threshold = _threshold(trace, settings, np.zeros(model.joints))
    with np.errstate(divide="ignore"):
        margins = np.min(threshold / residual, axis=0)
    largest = np.max(residual, axis=0)
    return OfflineCertificate(np.sqrt(mean_square), largest, lack, np.median(threshold, axis=0), margins)


def detect(
    model: ArmModel,
    record: Record,
    estimate: ModelEstimate,
    settings: OfflineSettings,
    lack_Nm: Vector,
) -> OfflineDetection:
    """Return external torque, thresholds and contacts of a record, behind the filter of detection.

    lack_Nm (n,): the `lack_Nm` of the model's certificate, which widens the thresholds. Raises ValueError if
    record or `noise_Nm` and model differ in their number of joints.
    """
    trace = _trace(model, record, estimate, settings)
    threshold = _threshold(trace, settings, lack_Nm)
    window = round(settings.isolation_s / settings.period_s)
    return OfflineDetection(trace.tau_ext_hat, threshold, find_contacts(trace.tau_ext_hat, threshold, window))


def find_contacts(tau_ext_hat: Vector, threshold: Vector, window: int) -> tuple[tuple[int, int, tuple[int, ...]], ...]:
    """Return the contacts in samples of external torque and threshold (k, n): sample, link from 0, signs (n,) each.

    The sample is the first over a threshold. The link is that of the last joint over its threshold within the window:
    this sample and the next `window`. The signs are those of tau_ext_hat where a joint first crosses its threshold
    there, 0 if it doesn't. A contact ends when every joint has stayed within `ONSET_FRACTION` of its threshold for a
    whole window, so a push that sways around the threshold is one. NaN is over the threshold, with sign 0.
    """
    over = ~(np.abs(tau_ext_hat) <= threshold)
    touched = np.flatnonzero(np.any(~(np.abs(tau_ext_hat) <= undone_filter.ONSET_FRACTION * threshold), axis=1))
    firsts = touched[np.diff(touched, prepend=-window - 2) > window]
    loud = np.flatnonzero(np.any(over, axis=1))
    _, first_loud = np.unique(np.searchsorted(firsts, loud, side="right"), return_index=True)
    contacts = []
    for begin in loud[first_loud]:
        seen = over[begin : begin + window + 1]
        joints = np.flatnonzero(np.any(seen, axis=0))
        crossings = begin + np.argmax(seen, axis=0)
        direction = [0] * over.shape[1]
        for joint in joints:
            value = tau_ext_hat[crossings[joint], joint]
            direction[joint] = int(value > 0.0) - int(value < 0.0)
        contacts.append((int(begin), int(joints[-1]), tuple(direction)))
    return tuple(contacts)


def _threshold(trace: FilteredRecord, settings: OfflineSettings, lack_Nm: Vector) -> Vector:
    """Return the threshold of each sample and joint (k, n), Nm: `deviations` times the deviation, plus held friction.

    lack_Nm (n,): of the model's certificate, added to the deviation by squares.
    """
    return settings.deviations * np.sqrt(trace.deviation**2 + lack_Nm**2) + trace.friction


def _noise_gains(cutoff_rad_s: float, settings: OfflineSettings, is_smoothed: bool) -> tuple[float, float, float]:
    """Return the gains for white noise of a torque sensor and of a velocity, 1/s, behind the filters of this cut-off.

    A gain is the standard deviation of the output for noise of 1; of the velocity's noise that of M delta_dq. The third
    value is the variance that a sample of the fit counts with, in units of the filtered torque's. is_smoothed: behind
    the second low-pass, too. By the filters' two states x: x_new = A x + B u, y = C x + D u.
    Torque: y_1 = F u. Velocity: y_1 = a (u - F u). With V = A V A' + B B' the variance of y is C V C' + D², its
    covariance over j samples C A^(j - 1) (A V C' + B D).
    """
    hold = torque_filter.first_order_hold(cutoff_rad_s, cutoff_rad_s, settings.period_s)
    kept = hold.decay if is_smoothed else 0.0
    gains: list[float] = []
    R = 1.0
    for state, direct in ((1.0, hold.weight_new), (-cutoff_rad_s, cutoff_rad_s * (1.0 - hold.weight_new))):
        A = np.array([[hold.decay, 0.0], [(1.0 - kept) * state, kept]])
        B = np.array([hold.decay * hold.weight_new + hold.weight_old, (1.0 - kept) * direct])
        C, D = A[1], B[1]
        V = scipy.linalg.solve_discrete_lyapunov(A, np.outer(B, B))
        variance = C @ V @ C + D * D
        if not gains:
            power = np.linalg.matrix_power(A, settings.fit_every - 1)
            later = C @ power @ np.linalg.solve(np.eye(2) - power @ A, A @ V @ C + B * D)
            R += 2.0 * later / variance
        gains.append(math.sqrt(variance))
    return gains[0], gains[1], R


def _traces(
    model: ArmModel,
    records: Sequence[Record],
    estimate: ModelEstimate,
    settings: OfflineSettings,
    theta_M: Vector | None = None,
) -> FilteredRecord:
    """Return the samples of `_trace` of all records, at least one, in turn. Arguments and errors: as of `_trace`."""
    parts = [_trace(model, record, estimate, settings, theta_M) for record in records]
    return FilteredRecord(*map(np.concatenate, zip(*parts, strict=True)))


def _trace(
    model: ArmModel,
    record: Record,
    estimate: ModelEstimate,
    settings: OfflineSettings,
    theta_M: Vector | None = None,
    is_learning: bool = False,
    scores: Vector | None = None,
    at: int = 0,
    length: int = 1,
    rows: tuple[Vector, Vector] | None = None,
) -> FilteredRecord:
    """Run a record through the smoothed filter of the fit, or without theta_M through the one of detection.

    Fills all columns of the FilteredRecord. is_learning: correct theta and P of `estimate`, which must be contiguous,
    in place. theta_M (p,): of the mass matrix that carries the velocity's noise. scores (B, p): the sums of
    `parameter_deviation` are added to it, `length` samples a part; at: samples that were before this record. rows:
    overwritten by regressor and torque of the samples that a fit uses. Raises ValueError if record or `noise_Nm` and
    model differ in their number of joints.
    """
    n = model.joints
    if record.q.shape[1] != n or len(settings.noise_Nm) != n:
        raise ValueError(
            f"the arm has {n} joints, the record {record.q.shape[1]}, noise_Nm {len(settings.noise_Nm)} values"
        )
    is_smoothed = theta_M is not None
    cutoff_rad_s = settings.fit_cutoff_rad_s if is_smoothed else settings.detection_cutoff_rad_s
    hold = torque_filter.first_order_hold(cutoff_rad_s, cutoff_rad_s, settings.period_s)
    gain, velocity_gain, R = _noise_gains(cutoff_rad_s, settings, is_smoothed)
    shapes = (*(record.q.shape,) * 4, record.q.shape[:1])
    trace = FilteredRecord(*(np.zeros(shape) for shape in shapes))
    _run(
        model.chain,
        model.base.columns,
        model.has_rotors,
        record.q,
        record.dq,
        record.tau_J,
        hold,
        cutoff_rad_s,
        hold.decay if is_smoothed else 0.0,
        gain * np.array(settings.noise_Nm),
        R,
        velocity_gain * settings.velocity_noise_rad_s,
        settings.fit_every,
        settings.standstill_rad_s,
        is_learning,
        np.ascontiguousarray(estimate.theta if theta_M is None else theta_M),
        np.ascontiguousarray(estimate.theta),
        np.ascontiguousarray(estimate.P),
        trace,
        np.zeros((0, 0)) if scores is None else scores,
        at,
        length,
        (np.zeros((0, 0, 0)), np.zeros((0, 0))) if rows is None else rows,
    )
    return trace


@compiled
def _run(
    arm: Chain,
    columns: Indices,
    has_rotors: bool,
    q: Vector,
    dq: Vector,
    tau_J: Vector,
    hold: torque_filter.FirstOrderHold,
    cutoff_rad_s: float,
    smoothing: float,
    noise_Nm: Vector,
    R: float,
    passed_rad_s2: float,
    fit_every: int,
    standstill_rad_s: float,
    is_learning: bool,
    theta_M: Vector,
    theta: Vector,
    P: Vector,
    trace: FilteredRecord,
    scores: Vector,
    at: int,
    length: int,
    rows: tuple[Vector, Vector],
) -> None:
    """Filter a record, fill all columns of `trace` by sample, and correct theta and P if is_learning.

    columns: of the base parameters. smoothing: part that the second pole keeps over a period; 0 without one. noise_Nm
    (n,): of the filtered torque. R: variance of a sample of the fit in units of noise_Nm². passed_rad_s2: the
    velocity's noise behind the filter, still to be multiplied by the mass matrix, of theta_M. scores, at, length, rows:
    as of `_trace`; arrays of size 0 stay unused, and so does an empty P: then the deviations stay as they are.
    """
    n, p, a = q.shape[1], theta.size, cutoff_rad_s
    F_v, F_c, offset = columns.size, columns.size + n, columns.size + 2 * n
    Y_p, Y_h, input_old = np.zeros((n, p)), np.zeros((n, p)), np.zeros((n, p))
    S, W_f, W = np.zeros((n, p)), np.zeros((n, p)), np.zeros((n, p))
    tau_old, tau_f, tau, tau_f_hat = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    standstill, through, v, K = np.zeros(n), np.zeros(n), np.zeros(p), np.zeros(p)
    for i in range(n):
        Y_h[i, offset + i] = 1.0
    for k in range(q.shape[0]):
        momentum, remainder = chain.split_regressor(arm, q[k], dq[k])
        Y_p[:, :F_v] = momentum[:, columns]
        Y_h[:, :F_v] = remainder[:, columns]
        chain.fill_friction(dq[k], F_v, Y_h)
        if has_rotors:
            _fill_rotors(dq[k], Y_p)
        if k == 0:
            torque_filter.resume(a, a, Y_p, Y_h, tau_J[k], input_old, tau_old, S, W_f)
        else:
            torque_filter.advance(hold, tau_old, tau_J[k], tau_f)
            torque_filter.advance_regressor(hold, a, a, Y_p, Y_h, input_old, S, W_f)
        tau[:] = tau_f + smoothing * (tau - tau_f)
        W[:] = W_f + smoothing * (W - W_f)
        external_torque.follow_standstill(dq[k], standstill_rad_s, hold.decay, standstill)
        external_torque.predict(W, theta, tau_f_hat)
        external_torque.estimate_external(tau, tau_f_hat, 1.0, trace.tau_ext_hat[k])
        if passed_rad_s2 > 0.0 and k % fit_every == 0:
            through[:] = _squared_mass(arm, columns, has_rotors, q[k], theta_M)
        passed = passed_rad_s2**2 * through
        if P.size > 0:
            trace.deviation[k] = residual_deviation(W, P, np.sqrt(noise_Nm**2 + passed))
        trace.friction[k] = standstill * np.maximum(theta[F_c:offset], 0.0)
        trace.tau_f[k] = tau
        trace.unit[k] = W[0, offset]
        if k % fit_every == fit_every - 1:
            if rows[0].size > 0:
                rows[0][k // fit_every] = W
                rows[1][k // fit_every] = tau
            weight = 1.0 / np.sqrt(R * noise_Nm**2 + passed)
            W_scaled = np.expand_dims(weight, 1) * W
            if scores.size > 0:
                scores[(at + k) // length] += (weight * (tau - tau_f_hat)) @ W_scaled
            if is_learning:
                estimator.update(W_scaled, weight * tau, 1.0, True, theta, P, v, K)


@compiled
def _squared_mass(arm: Chain, columns: Indices, has_rotors: bool, q: Vector, theta: Vector) -> Vector:
    """Return the diagonal (n,) of M M', with the mass matrix M of theta at q. columns: of the base parameters."""
    n = q.size
    found, Y_p = np.zeros(n), np.zeros((n, theta.size))
    for j in range(n):
        unit = np.zeros(n)
        unit[j] = 1.0
        Y_p[:, : columns.size] = chain.split_regressor(arm, q, unit)[0][:, columns]
        if has_rotors:
            _fill_rotors(unit, Y_p)
        found += (Y_p @ theta) ** 2
    return found


@compiled
def _fill_rotors(dq: Vector, Y_p: Vector) -> None:
    """Write dq (n,) to the last n columns of Y_p (n, p), those of the rotors' inertia.

    Only joint i's row is written in its column; all other cells stay as they are.
    """
    n, p = Y_p.shape
    for i in range(n):
        Y_p[i, p - n + i] = dq[i]


@compiled
def residual_deviation(W_f: Vector, P: Vector, noise_Nm: Vector) -> Vector:
    """Return the standard deviation (n,) of tau_f - W_f theta: sqrt(noise² + w P w')."""
    found: Vector = np.sqrt(np.maximum(noise_Nm**2 + ((W_f @ P) * W_f).sum(axis=1), 0.0))
    return found
