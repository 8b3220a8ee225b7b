"""The tare of the joint torque sensors: checks of a window at rest, and offsets solved from one or several poses.

At rest, drives off, pose k, joint i, the sensor reads gravity and its zero offset:

    tau_J[k, i] = Y_g(q[k])[i] (a4, a5)' + offset[i]

With vertical joint axes Y_g is zero and the offset is the mean over the poses. Otherwise a4 and a5 are estimated with
the offsets by least squares, or taken from the CAD model. Y_g are the gravity columns of the scheme's regressor.

Shapes: histories q, dq, tau_J (n, 2); per joint (2,); per pose (N, 2). Units: rad, rad/s, Nm. tau_J is in joint
direction, no offset subtracted.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adacd_hil.records import GRAVITY_PARAMETER_NAMES, JOINT_NAMES, JOINTS, PARAMETER_NAMES, Vector
from adacd_hil.scheme.model.regressor import A4, A5, regressor
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.schema import ConfigError

GRAVITY_POSES = 3
"""Fewest poses that estimate a4, a5 and two offsets and leave residuals to judge them by: 6 equations, 4 unknowns."""
_BLOCKS = 10
"""Parts of a window whose means show noise slower than the sample rate."""
_GRAVITY = (A4, A5)


class TareRefusedError(RuntimeError):
    """The tare is refused; the message is one line, for a torque or a motion with value, bound and unit."""


class ArmMovedError(TareRefusedError):
    """The arm moved during the measurement."""


@dataclass(frozen=True)
class Pose:
    """One pose, measured at rest: the mean of q, and, for each torque, its mean, standard error and noise, all (2,).

    samples: their number. drift_Nm: mean of the second half of the window less that of the first.
    """

    q: Vector
    mean_Nm: Vector
    standard_error_Nm: Vector
    std_Nm: Vector
    peak_to_peak_Nm: Vector
    drift_Nm: Vector
    samples: int


@dataclass(frozen=True)
class TareSolution:
    """Torque offsets solved from the poses, their standard errors (2,), and gravity.

    gravity_Nm (2,): a4, a5; zeros with vertical axes, of the CAD model if not estimated. residual_Nm (N, 2): of each
    pose. condition: number of the poses' equations; 1 if gravity isn't estimated.
    """

    offset_Nm: Vector
    standard_error_Nm: Vector
    gravity_Nm: Vector
    residual_Nm: Vector
    condition: float

    @property
    def spread_Nm(self) -> Vector:
        """Difference of the largest and the smallest residual of each joint, Nm (2,)."""
        spread: Vector = np.ptp(self.residual_Nm, axis=0)
        return spread


def check_plan(settings: Settings) -> None:
    """Raise ConfigError if these settings allow no tare: gravity needs a CAD model that is missing, or more poses.

    Without `estimator.gravity` all settings pass.
    """
    tare = settings.tare
    if not settings.estimator.gravity:
        return
    if tare.gravity_model == "cad" and not settings.arm.cad_theta:
        raise ConfigError("`tare.gravity_model` = 'cad' needs `arm.cad_theta` with a4 and a5")
    if tare.gravity_model == "estimated" and tare.poses < GRAVITY_POSES:
        raise ConfigError(
            f"`tare.poses` = {tare.poses} is below {GRAVITY_POSES}, which estimating gravity needs; "
            f"or set `tare.gravity_model` to 'cad'"
        )


def check_motion(q: Vector, dq: Vector, settings: Settings) -> None:
    """Raise ArmMovedError for a speed above `safety.rest_velocity_rad_s` or a travel above `tare.creep_limit_deg`.

    q, dq: (2,), or (n, 2) with n > 0; of one sample the travel is 0. NaN raises it, too.
    """
    q, dq = np.atleast_2d(q), np.atleast_2d(dq)
    speed = np.abs(dq).max(axis=0)
    bound_rad_s = settings.safety.rest_velocity_rad_s
    travel_deg = np.degrees(np.ptp(q, axis=0))
    bound_deg = settings.tare.creep_limit_deg
    for joint, name in enumerate(JOINT_NAMES):
        if not speed[joint] <= bound_rad_s:
            raise ArmMovedError(
                f"the arm moves: |dq[{name}]| = {speed[joint]:.3g} rad/s exceeds safety.rest_velocity_rad_s = "
                f"{bound_rad_s:g} rad/s"
            )
        if not travel_deg[joint] <= bound_deg:
            raise ArmMovedError(
                f"the arm creeps: q[{name}] went through {travel_deg[joint]:.3g} deg while it was measured, which "
                f"exceeds tare.creep_limit_deg = {bound_deg:g} deg"
            )


def measure_pose(q: Vector, dq: Vector, tau_J: Vector, settings: Settings) -> Pose:
    """Return a pose: means and noise of a window of samples at rest (n, 2 each).

    Raises ArmMovedError if the arm moved, TareRefusedError for fewer than 2 `_BLOCKS` samples, or noise or drift above
    the limits.
    """
    tare = settings.tare
    if len(tau_J) < 2 * _BLOCKS:
        raise TareRefusedError(f"{len(tau_J)} complete samples in a pose are below {2 * _BLOCKS}")
    check_motion(q, dq, settings)
    middle = len(tau_J) // 2
    pose = Pose(
        q=q.mean(axis=0),
        mean_Nm=tau_J.mean(axis=0),
        standard_error_Nm=_standard_error(tau_J),
        std_Nm=tau_J.std(axis=0, ddof=1),
        peak_to_peak_Nm=np.ptp(tau_J, axis=0),
        drift_Nm=tau_J[middle:].mean(axis=0) - tau_J[:middle].mean(axis=0),
        samples=len(tau_J),
    )
    _bound("standard deviation of tau_J", pose.std_Nm, tare.std_limit_Nm, "tare.std_limit_Nm")
    _bound(
        "peak-to-peak value of tau_J", pose.peak_to_peak_Nm, tare.peak_to_peak_limit_Nm, "tare.peak_to_peak_limit_Nm"
    )
    _bound("drift of tau_J from first to second half", pose.drift_Nm, tare.drift_limit_Nm, "tare.drift_limit_Nm")
    return pose


def _standard_error(tau_J: Vector) -> Vector:
    """Return the standard error of the mean (2,): the larger of that by samples and that by `_BLOCKS` blocks.

    Blocks show coloured noise.
    """
    by_sample = tau_J.std(axis=0, ddof=1) / math.sqrt(len(tau_J))
    means = np.array([block.mean(axis=0) for block in np.array_split(tau_J, _BLOCKS)])
    larger: Vector = np.maximum(by_sample, means.std(axis=0, ddof=1) / math.sqrt(_BLOCKS))
    return larger


def _bound(quantity: str, values: Vector, bound: float | Sequence[float], setting: str, remedy: str = "") -> None:
    """Raise TareRefusedError if the size of a joint's value exceeds its bound, or is NaN.

    bound: of both joints, or of each. quantity, setting, remedy: words of the message.
    """
    bounds = np.broadcast_to(bound, JOINTS)
    for joint, name in enumerate(JOINT_NAMES):
        if not abs(values[joint]) <= bounds[joint]:
            raise TareRefusedError(
                f"{quantity}[{name}] = {values[joint]:.4g} Nm exceeds {setting} = {bounds[joint]:g} Nm{remedy}"
            )


def gravity_columns(q: Vector, level_rad: float) -> Vector:
    """Return Y_g (2, 2): the torques at rest of a unit a4, and of a unit a5, in pose q (2,).

    level_rad: q1 at which link 1 is level.
    """
    rest = np.zeros(JOINTS)
    columns: Vector = regressor(q, rest, rest, len(PARAMETER_NAMES + GRAVITY_PARAMETER_NAMES), level_rad)
    return columns[:, list(_GRAVITY)]


def solve_tare(poses: Sequence[Pose], settings: Settings) -> TareSolution:
    """Return the least-squares solution of the poses: offsets, gravity, residuals.

    Raises TareRefusedError if an offset exceeds `tare.offset_limit_Nm`, the poses disagree by more than
    `tare.pose_limit_Nm`, or they don't determine gravity. Their disagreement is each residual with gravity, else the
    spread of the residuals.
    """
    solution = _solve(poses, settings)
    tare = settings.tare
    if settings.estimator.gravity:
        for number, residual in enumerate(solution.residual_Nm, start=1):
            remedy = "; something pushes on the arm there, or the mounting, arm.mounting_deg, is wrong"
            _bound(f"residual of pose {number}", residual, tare.pose_limit_Nm, "tare.pose_limit_Nm", remedy)
    else:
        remedy = "; friction, a cable or a hand pushes on the arm in one of them"
        _bound("spread between poses of tau_J", solution.spread_Nm, tare.pose_limit_Nm, "tare.pose_limit_Nm", remedy)
    mounting = "the mounting, arm.mounting_deg, is wrong"
    if not settings.estimator.gravity:
        mounting = "the mounting is not flat (estimator.gravity)"
    remedy = f"; something pushes on the arm, {mounting}, or the sensor is damaged"
    _bound("offset", solution.offset_Nm, tare.offset_limit_Nm, "tare.offset_limit_Nm", remedy)
    return solution


def _solve(poses: Sequence[Pose], settings: Settings) -> TareSolution:
    """Find the torque offsets, and gravity if it is estimated, by least squares; don't compare them with limits.

    Gravity is else that of the CAD model, or 0 for a flat arm, and the condition is 1. Raises TareRefusedError if
    gravity is estimated and the poses don't determine it.
    """
    torque = np.array([pose.mean_Nm for pose in poses])
    matrix = np.tile(np.eye(JOINTS), (len(poses), 1))
    gravity, is_estimated = np.zeros(len(_GRAVITY)), False
    if settings.estimator.gravity:
        columns = np.array([gravity_columns(pose.q, settings.level_rad) for pose in poses])
        is_estimated = settings.tare.gravity_model == "estimated"
        if is_estimated:
            matrix = np.hstack((columns.reshape(-1, len(_GRAVITY)), matrix))
        else:
            gravity = settings.cad_theta[list(_GRAVITY)]
            torque = torque - columns @ gravity
    condition = _check_condition(matrix, poses, settings) if is_estimated else 1.0
    unknowns, *_ = np.linalg.lstsq(matrix, torque.ravel(), rcond=None)
    residual = torque - (matrix @ unknowns).reshape(-1, JOINTS)
    if is_estimated:
        gravity = unknowns[: len(_GRAVITY)]
    errors = _errors_of_unknowns(matrix, poses, residual)
    return TareSolution(unknowns[-JOINTS:], errors[-JOINTS:], gravity, residual, condition)


def _errors_of_unknowns(matrix: NDArray[np.float64], poses: Sequence[Pose], residual: Vector) -> Vector:
    """Return the standard error of each unknown, one per column of the matrix of equations (2 N, unknowns).

    An equation's error is the noise of its mean, or the disagreement of the poses, if that is larger. The disagreement
    counts only with more equations than unknowns.
    """
    inverse = np.linalg.inv(matrix.T @ matrix)
    variance = np.array([pose.standard_error_Nm for pose in poses]) ** 2
    freedom = len(poses) - matrix.shape[1] / JOINTS
    if freedom > 0.0:
        variance = np.maximum(variance, (residual**2).sum(axis=0) / freedom)
    covariance = inverse @ (matrix.T * variance.ravel()) @ matrix @ inverse
    errors: Vector = np.sqrt(np.diag(covariance))
    return errors


def _check_condition(matrix: NDArray[np.float64], poses: Sequence[Pose], settings: Settings) -> float:
    """Return the condition number of the equations for (a4, a5, offsets).

    Raises TareRefusedError above `tare.condition_limit`; the message names the joint to move further.
    """
    _, values, directions = np.linalg.svd(matrix)
    condition = float(values[0] / values[-1]) if values[-1] > 0.0 else math.inf
    bound = settings.tare.condition_limit
    if condition <= bound:
        return condition
    # The hardly determined combination is a4 with the offset of joint 1, or a5 with the offset of joint 2.
    hidden = directions[-1] ** 2
    q = np.array([pose.q for pose in poses])
    level = f" - {math.degrees(settings.level_rad):g} deg" * (settings.level_rad != 0.0)
    if hidden[0] + hidden[2] >= hidden[1] + hidden[3]:
        angles, what, motion = q[:, 0], f"cos(q1{level})", "move joint 1 further between the poses"
    else:
        angles, what = q.sum(axis=1), f"cos(q1 + q2{level})"
        motion = "turn link 2 further between the poses, against the ground and not with link 1 only"
    levers = np.cos(angles - settings.level_rad)
    low, high = levers.min(), levers.max()
    raise TareRefusedError(
        f"condition number of {len(poses)} poses = {condition:.3g} exceeds tare.condition_limit = {bound:g}: "
        f"{what} only goes from {low:.2f} to {high:.2f}; {motion}"
    )
