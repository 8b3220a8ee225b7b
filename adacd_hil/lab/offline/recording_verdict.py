"""The verdict on a recording: whether the model explains its torque, the reasons if not, the user's next step.

**Share.** Of each joint's torque, the part that the frozen model explains in the test:

    share = 1 - sum (tau_f - W_f theta)² / sum (tau_f - c u_f)²

with the filter of the fit on both; u_f is the filtered constant and c its best factor, so that neither the filter's
effect nor an offset counts as explained. A torque that is noise has a share of 0.

**Margin.** The smallest ratio of threshold to residual in the test, with thresholds from noise and the parameters' P.

A joint is explained if its share is at least `WHOLE`, or if the residual stays below its threshold and the share is at
least `HALF`: no model explains more of a torque that is mostly noise. The test is explained if all joints are, and no
finding on columns, length, units, inertia or the map is against it. With a margin below 1 the model lacks more than
noise; the verdict then names the smallest contact that still shows.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from adacd_hil.lab.offline.column_checks import (
    CLIPPED_REMEDY,
    CORRECT_UNITS,
    IN_MAP,
    LEFT_OUT_REMEDY,
    RecordingFinding,
    clipped_torque,
    find_faults,
    joined_names,
)
from adacd_hil.lab.offline.other_readings import UNITS, find_readings, mass_rows
from adacd_hil.lab.offline.recording_import import ForeignRecording, samples
from adacd_hil.lab.offline.recording_map import ANGLE_RAD, RecordingMap
from adacd_hil.lab.serial_arm import offline
from adacd_hil.lab.serial_arm.offline import ArmModel, ModelEstimate, OfflineCertificate, OfflineSettings
from adacd_hil.lab.signal_noise import low_pass
from adacd_hil.records import Vector

WHOLE: Final = 0.99
HALF: Final = 0.5
NOTHING: Final = 0.1
"""Largest share of a torque that is unrelated to the motion."""
_NOISE_TIMES: Final = 1.5
"""Factor on the filtered noise, up to which a torque is called noise."""
_SHORTEST_FIT_S, _SHORTEST_TEST_S = 2.0, 1.0
_SIGMAS: Final = 3.0
_UNKNOWN: Final = 0.3
"""Share of its initial deviation: a parameter that keeps more of it was not excited."""
_MILLI: Final = (300.0, 3000.0)
"""Range of the factor on the URDF's masses that the torques need if they are mNm."""
_ODD_SCALE: Final = 2.0
_ODD_MASSES: Final = 0.3
"""Relative error that the parameters of a URDF may have."""
_HEAVIEST_KG, _LIGHTEST_KG = 300.0, 0.01
"""Inertia over the square of the reach; beyond this no arm of a lab has it."""
_HEAVY_KG, _LIGHT_KG = 30.0, 0.1
"""The same; beyond this few arms have it."""
_MOSTLY: Final = 0.8
"""Share of the torque that must be explained before the scale of the parameters is judged."""


class JointShare(NamedTuple):
    """Result of the test for a joint. share: explained part of its torque, nan without torque.

    margin: smallest ratio of threshold to residual. torque_Nm: rms behind the filter of the fit, about its best
    constant. is_explained: by share and margin.
    """

    name: str
    share: float
    margin: float
    torque_Nm: float  # rms behind the filter of the fit, about its best constant
    is_explained: bool


@dataclass(frozen=True)
class Verdict:
    """Whether the torque of the test is explained. headline: the result in one line. joints: results by joint.

    reasons: why it isn't explained, remarks: further facts, a sentence each. remedy: the user's next step, "" for none.
    """

    is_explained: bool
    headline: str
    joints: tuple[JointShare, ...]
    reasons: tuple[str, ...]
    remarks: tuple[str, ...]
    remedy: str  # the user's next step; "" if the user need not act

    def __repr__(self) -> str:
        return f"<Verdict: {self.headline}>"


@dataclass(frozen=True)
class Fitted:
    """A fit with its recordings and its test, to be judged. described: the map.

    before: the estimate at the fit's begin. certificate: of the test. estimate, deviation: parameters (p,) with P, and
    their standard deviations (p,).
    """

    described: RecordingMap
    model: ArmModel
    settings: OfflineSettings
    before: ModelEstimate
    estimate: ModelEstimate
    deviation: Vector
    certificate: OfflineCertificate
    fitted: tuple[ForeignRecording, ...]
    tested: ForeignRecording

    @property
    def fit_s(self) -> float:
        """Length of the fitted recordings, s."""
        return sum(recording.duration_s for recording in self.fitted)

    @property
    def has_velocities(self) -> bool:
        """Whether the velocities of all recordings were measured, not derived from the positions."""
        return all(recording.has_velocities for recording in (*self.fitted, self.tested))


def judge_fit(fit: Fitted) -> Verdict:
    """Return the verdict on a fit: whether the model explains the torque of the test, reasons if not, next step.

    It isn't explained if a joint isn't, or a finding on columns, length, units, inertia or the map is against it. With
    a dead column or too short recordings, the model isn't judged further. Excitation and smallest contacts are remarked
    on only if the test is explained.
    """
    joints = _shares(fit)
    columns = find_faults(fit.described, fit.fitted, fit.tested)
    plain = [found for found in columns if found.is_dead] or list(_of_length(fit))
    findings = plain or _of_model(fit, joints, columns)
    findings += [] if plain else _of_friction(fit)
    is_explained = all(joint.is_explained for joint in joints) and not any(found.is_against for found in findings)
    findings += [*_of_excitation(fit), *_of_residual(fit, joints)] if is_explained else []
    against = [found for found in findings if found.is_against]
    remedies = [found.remedy for found in against if found.remedy]
    return Verdict(
        is_explained=is_explained,
        headline=_headline(fit, joints, is_explained),
        joints=joints,
        reasons=tuple(found.text for found in against),
        remarks=tuple(found.text for found in findings if not found.is_against),
        remedy=remedies[0] if remedies else "",
    )


def _of_model(fit: Fitted, joints: Sequence[JointShare], columns: Sequence[RecordingFinding]) -> list[RecordingFinding]:
    """Return findings on columns, scale, other interpretations and fit; the first is the likeliest cause, if any.

    columns: defects of columns as possible causes. They are remarks beside a wrong scale, and beside a mistake of the
    map. They are remarks, too, if all joints are explained, with no impossible inertia and no wrong column, and the
    margin is at least 1 or the least share at least `WHOLE`.
    """
    remarks = [found._replace(is_against=False) for found in columns]
    scale = list(_of_scale(fit, joints))
    if any(found.is_against for found in scale):
        return [*scale, *remarks]
    inertia = list(_of_inertia(fit))
    wrong = [found for found in columns if found.is_wrong]
    is_good = not inertia and not wrong and all(joint.is_explained for joint in joints)
    if is_good and fit.certificate.margin >= 1.0:
        return [*scale, *remarks]
    if not all(_is_noise(fit, joints)) and (readings := list(_of_readings(fit, joints, WHOLE if columns else 0.0))):
        return [*readings, *remarks]
    if is_good and not (columns and _least_share(joints) < WHOLE):
        return [*scale, *remarks]
    lack = list(_of_lack(fit, joints))
    causes = wrong or list(columns)
    if causes:
        return [*causes, *scale, *(found._replace(is_against=False) for found in lack)]
    return [*(list(_of_noise(fit, joints)) or inertia or lack), *scale]


def _is_noise(fit: Fitted, joints: Sequence[JointShare]) -> list[bool]:
    """Return, per joint, whether its `torque_Nm` is at most `_NOISE_TIMES` the filtered noise of the settings."""
    noise = offline.filtered_noise_Nm(fit.settings)
    return [joint.torque_Nm <= _NOISE_TIMES * noise[i] for i, joint in enumerate(joints)]


def _shares(fit: Fitted) -> tuple[JointShare, ...]:
    """Return each joint's result of the test, in their order: explained share, margin, rms torque, explained or not."""
    trace = offline.filtered(fit.model, fit.tested.records, fit.estimate, fit.settings)
    torque, residual, unit = trace.tau_f, trace.tau_ext_hat, trace.unit
    spread = torque - np.outer(unit, unit @ torque / (unit @ unit))
    squares, left = np.sum(spread**2, axis=0), np.sum(residual**2, axis=0)
    is_there = squares > 1e-18 * np.maximum(np.sum(torque**2, axis=0), 1e-12)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(is_there, 1.0 - left / squares, np.nan)
    rms = np.sqrt(squares / len(unit))
    return tuple(
        JointShare(name, each, margin, torque_Nm, each >= WHOLE or (margin >= 1.0 and each >= HALF))
        for name, each, margin, torque_Nm in zip(
            fit.described.urdf.joint_names,
            share.tolist(),
            fit.certificate.margins.tolist(),
            rms.tolist(),
            strict=True,
        )
    )


def percent(share: float) -> str:
    """Format a share 0…1 as a percentage with one decimal, such as "97.3 %"; a negative one as "0.0 %", nan as "-".

    From 0.9995 on with two decimals, and from 0.99995 on as "100.0 %".
    """
    if math.isnan(share):
        return "-"
    digits = 1 if share < 0.9995 else 2
    return f"{100.0 * max(share, 0.0):.{digits}f} %" if share < 0.99995 else "100.0 %"


def _least_share(joints: Sequence[JointShare]) -> float:
    """Return the smallest share of the joints with torque; nan if none has."""
    return min((joint.share for joint in joints if not math.isnan(joint.share)), default=math.nan)


def _headline(fit: Fitted, joints: Sequence[JointShare], is_explained: bool) -> str:
    share = _least_share(joints)
    if math.isnan(share):
        return "NOT explained: no torque"
    least = f"{percent(share)} of the torque"
    where = " at the worst joint" if len(joints) > 1 else ""
    margin = f"margin {fit.certificate.margin:.2f}" if math.isfinite(fit.certificate.margin) else "no margin"
    if is_explained:
        return f"explained; {margin}" if fit.certificate.margin >= 1.0 else f"explained: {least}{where}; {margin}"
    if all(joint.is_explained for joint in joints):
        return f"NOT explained, although {least}{where} is; {margin}"
    return f"NOT explained: {least}{where}; {margin}"


def _of_length(fit: Fitted) -> Iterator[RecordingFinding]:
    """Report the lengths of fit and test if either is below its least length."""
    if fit.fit_s < _SHORTEST_FIT_S or fit.tested.duration_s < _SHORTEST_TEST_S:
        yield RecordingFinding(
            f"too short: {fit.fit_s:.2g} s fitted and {fit.tested.duration_s:.2g} s tested, {_SHORTEST_FIT_S:g} and "
            f"{_SHORTEST_TEST_S:g} s are the least, 10 s a good beginning",
            "record more, in which every joint turns fast and slow, both ways",
        )


def _of_readings(fit: Fitted, joints: Sequence[JointShare], least: float) -> Iterator[RecordingFinding]:
    """Report, in one finding, the likeliest mistake of the map, with up to two alternatives.

    Report nothing if no other reading explains the test's torque far better than the map, see `find_readings`, or if
    the likeliest explains less than the share `least` of a joint's torque.
    """
    fitted = [record for recording in fit.fitted for record in recording.records]
    readings = find_readings(fit.described, fit.model, fit.settings, fitted, fit.tested.records, fit.has_velocities)
    if not readings or 1.0 - readings[0].unexplained < least:
        return
    text = ", or ".join(reading.text for reading in readings[:3])
    by_map, where = percent(_least_share(joints)), " at the worst joint" if len(joints) > 1 else ""
    yield RecordingFinding(
        f"{text}: so {percent(1.0 - readings[0].unexplained)} of the torque is explained{where}, {by_map} as given",
        f"{IN_MAP}{', or '.join(dict.fromkeys(reading.remedy for reading in readings[:3]))}",
    )


def _of_noise(fit: Fitted, joints: Sequence[JointShare]) -> Iterator[RecordingFinding]:
    """Report unexplained joints whose torque is noise or unrelated to the motion, a finding per cause with its joints.

    Causes: noise of a passive joint, noise unrelated to the motion, another torque unrelated to the motion, mostly
    noise. Passive: the residual is within the threshold, and another joint is explained. Mostly noise: the residual is
    within the threshold, without another of these causes.
    """
    related, is_noise = _related_to_motion(fit), _is_noise(fit, joints)
    empty = [
        i for i, joint in enumerate(joints) if not joint.share >= NOTHING and (is_noise[i] or related[i] < NOTHING)
    ]
    has_others = any(joint.is_explained for joint in joints)
    passive = [
        i
        for i, joint in enumerate(joints)
        if is_noise[i] and has_others and joint.margin >= 1.0 and not joint.is_explained
    ]
    for chosen, text in (
        (
            passive,
            "the torque of {names} is noise, and by the model of the others it is tiny: a passive joint, or "
            "its torque is less than the noise",
        ),
        (
            [i for i in empty if is_noise[i] and i not in passive],
            "the torque of {names} is noise, unrelated to the motion: the sensor is dead, the column is another "
            "joint's, or the joint isn't driven",
        ),
        (
            [i for i in empty if not is_noise[i] and i not in passive],
            "the torque of {names} is unexplained: the sensor is dead, the column is another joint's, the joint isn't "
            "driven, or it moves in the test unlike in the fit",
        ),
    ):
        if chosen:
            names = joined_names([joints[i].name for i in chosen], len(joints))
            remedy = f"check the sensor of {names}, and {_torque_columns(fit.described, chosen)}"
            yield RecordingFinding(text.format(names=names), remedy)
    weak = [
        joint.name
        for i, joint in enumerate(joints)
        if i not in (*empty, *passive) and not joint.is_explained and joint.margin >= 1.0
    ]
    if weak:
        yield RecordingFinding(
            f"the torque of {joined_names(weak, len(joints))} is mostly noise: the part due to motion is smaller",
            "move faster and farther",
        )


def _related_to_motion(fit: Fitted) -> Vector:
    """Return the share (n,) of each torque that simple terms of the joint's own motion explain, whatever the model.

    They are fitted to one of fit and test, and evaluated on the other, and the larger share is taken; terms: filtered
    position, its sine and cosine, velocity, its sign, acceleration, and a constant.
    """
    period_s, cutoff = fit.settings.period_s, fit.settings.fit_cutoff_rad_s
    shares = []
    for i in range(fit.model.joints):
        tables = []
        for recordings in (fit.fitted, (fit.tested,)):
            rows = []
            for record in (record for recording in recordings for record in recording.records):
                q, dq = record.q[:, i], record.dq[:, i]
                terms = np.column_stack([np.ones_like(q), np.sin(q), np.cos(q), q, dq, np.sign(dq), record.tau_J[:, i]])
                once = low_pass(terms, (cutoff,), period_s)
                smooth = low_pass(once, (cutoff,), period_s)
                rows.append(np.hstack([cutoff * (once - smooth)[:, 4:5], smooth]))
            tables.append(np.concatenate(rows))
        shares.append(max(_predicted_share(*tables), _predicted_share(*tables[::-1])))
    return np.array(shares)


def _predicted_share(fitted: Vector, tested: Vector) -> float:
    """Return the share of `tested`'s last column that its other columns explain with coefficients fitted to `fitted`.

    Both (k, c): the last column is the torque, the column with index 1 the filtered constant. Negative if worse than a
    constant.
    """
    coefficients = np.linalg.lstsq(fitted[:, :-1], fitted[:, -1], rcond=1e-6)[0]
    unit, torque = tested[:, 1], tested[:, -1]
    spread = torque - unit * (unit @ torque) / max(float(unit @ unit), 1e-18)
    left = torque - tested[:, :-1] @ coefficients
    return 1.0 - float(left @ left) / max(float(spread @ spread), 1e-18)


def _of_scale(fit: Fitted, joints: Sequence[JointShare]) -> Iterator[RecordingFinding]:
    """Report a unit of torques or angles by which the torques differ from the URDF's masses, or an impossible inertia.

    Joints without torque don't count. The ratio to the masses is judged if it is over `_SIGMAS` deviations and every
    joint's share over `_MOSTLY`; an angle needs shares of `WHOLE`. A ratio that isn't reported as a unit is a remark if
    it is over `_ODD_SCALE` or below its reciprocal. The inertia about joint 1 is judged if no unit was reported and
    every share is at least `HALF`.
    """
    scale, sigma = _scale_of_urdf(fit)
    mass_kg = _mass_at_reach(fit)
    units, least = fit.described.units, _least_share(joints)
    if scale is not None and abs(scale) > _SIGMAS * sigma and least > _MOSTLY:
        text = f"the torques are {scale:.3g} times those that the masses of the URDF need"
        meant = _milli(abs(scale), mass_kg, units.tau_J)
        turns = {unit: ANGLE_RAD[unit] / ANGLE_RAD[units.q] for unit in UNITS if unit != units.q}
        angle = [unit for unit, factor in turns.items() if 0.8 < abs(scale) / factor < 1.25]
        if meant:
            yield RecordingFinding(f"{text}: they are {meant}", f'{IN_MAP}`units.tau_J` = "{meant}"')
            return
        if angle and least >= WHOLE:
            remedy = f'{IN_MAP}`units.q` = "{angle[0]}"'
            yield RecordingFinding(f"{text}: the positions are {UNITS[angle[0]]}", remedy)
            return
        if not 1.0 / _ODD_SCALE <= abs(scale) <= _ODD_SCALE:
            yield RecordingFinding(
                f"{text}: a unit, a gear or a gain is wrong, or the masses of the URDF are", is_against=False
            )
    if mass_kg is not None and least >= HALF and not _LIGHTEST_KG <= mass_kg <= _HEAVIEST_KG:
        yield RecordingFinding(
            f"the inertia about {joints[0].name} is that of {mass_kg:.2g} kg at the arm's reach",
            CORRECT_UNITS,
        )


def _milli(scale: float, mass_kg: float | None, unit: str) -> str:
    """Return the likely unit of torques if the map's is wrong by a factor of 1000, such as "mNm"; else "".

    scale: torques over those that the URDF's masses need. mass_kg: of `_mass_at_reach`.

    Some URDFs have masses of a thousandth for the sake of a simulator: with a plausible inertia, torques are not mNm.
    """
    low, high = _MILLI
    if low <= scale <= high and unit in ("Nm", "A") and (mass_kg is None or mass_kg > _HEAVY_KG):
        return f"m{unit}"
    if low <= 1.0 / scale <= high and unit in ("mNm", "mA") and (mass_kg is None or mass_kg < _LIGHT_KG):
        return unit[1:]
    return ""


def _scale_of_urdf(fit: Fitted) -> tuple[float | None, float]:
    """Return the ratio of the identified parameters to those of the URDF's masses, and its standard deviation.

    None and 0 if the URDF has no masses.
    """
    theta_full = fit.described.urdf.theta_full
    base = fit.model.place_of("base")
    expected = fit.model.base.map @ theta_full
    if not np.any(expected):
        return None, 0.0
    P = fit.estimate.P[base, base]
    spread = _ODD_MASSES * np.maximum(np.abs(expected), 0.1 * np.abs(expected).max())
    weighed = np.linalg.solve(P + np.diag(spread**2), expected)
    along = float(weighed @ expected)
    return float(weighed @ fit.estimate.theta[base]) / along, math.sqrt(float(weighed @ P @ weighed)) / along


def _mass_at_reach(fit: Fitted) -> float | None:
    """Return the mass, kg, that has joint 1's largest inertia if it is at the outermost joint of the stretched arm.

    The inertia is the largest of about 8 poses of the test's first stretch. None if the arm has no reach, a joint
    slides, or the inertia isn't positive.
    """
    arm = fit.described.urdf.chain
    reach_m = float(np.sum(np.linalg.norm(arm.translation[1:], axis=1)))
    if reach_m <= 0.0 or np.any(arm.is_prismatic):
        return None
    inertia = float(np.max(mass_rows(fit.model, fit.tested.records[0].q, 8)[:, 0] @ fit.estimate.theta))
    return inertia / reach_m**2 if inertia > 0.0 else None


def _of_inertia(fit: Fitted) -> Iterator[RecordingFinding]:
    """Report the most negative inertia, by its deviation, if it is below 0 by more than `_SIGMAS` deviations.

    No masses have it. All joints are looked at, in about 16 poses of the test's first stretch.
    """
    urdf, rows = fit.described.urdf, mass_rows(fit.model, fit.tested.records[0].q, 16)
    inertia = rows @ fit.estimate.theta
    sigma = np.maximum(np.linalg.norm(rows * fit.deviation, axis=-1), 1e-300)
    worst = np.unravel_index(np.argmin(inertia / sigma), inertia.shape)
    if inertia[worst] < -_SIGMAS * sigma[worst]:
        unit = "kg" if urdf.chain.is_prismatic[worst[1]] else "kg m²"
        yield RecordingFinding(
            f"the inertia about {urdf.joint_names[worst[1]]} is negative, {inertia[worst]:.3g} ± {sigma[worst]:.1g} "
            f"{unit}: no masses make it",
            "check signs and order of the columns, and the URDF",
        )


def _of_friction(fit: Fitted) -> Iterator[RecordingFinding]:
    """Report, as remarks, joints whose viscous or Coulomb friction is negative by more than `_SIGMAS` deviations."""
    theta, deviation = fit.estimate.theta, fit.deviation
    for joint, name in enumerate(fit.described.urdf.joint_names):
        F_v, F_c = (fit.model.place_of(kind).start + joint for kind in ("F_v", "F_c"))
        if any(theta[place] < -_SIGMAS * deviation[place] for place in (F_v, F_c)):
            yield RecordingFinding(
                f"friction of {name} is negative: F_v {theta[F_v]:.3g} ± {deviation[F_v]:.1g} Nm s/rad, F_c "
                f"{theta[F_c]:.3g} ± {deviation[F_c]:.1g} Nm; it drives the joint, or its curve is no straight line",
                is_against=False,
            )


def _of_excitation(fit: Fitted) -> Iterator[RecordingFinding]:
    """Report, as a remark, parameters that the motion hardly determines, given the noise of the residual.

    They keep more than `_UNKNOWN` of their initial deviation.
    """
    before, after = (np.sqrt(np.diag(estimate.P)) for estimate in (fit.before, fit.estimate))
    noise = np.maximum(fit.certificate.threshold_Nm / fit.settings.deviations, 1e-12)
    worse = max(1.0, float(np.max(fit.certificate.residual_rms_Nm / noise)))
    unknown = np.array(fit.model.parameter_names)[worse * after > _UNKNOWN * before].tolist()
    if unknown:
        some = ", ".join(unknown[:6]) + (f" and {len(unknown) - 6} more" if len(unknown) > 6 else "")
        yield RecordingFinding(
            f"too little excitation: the motion hardly determines {some}",
            "record motion of every joint, fast and slow, both ways",
            is_against=False,
        )


def _of_lack(fit: Fitted, joints: Sequence[JointShare]) -> Iterator[RecordingFinding]:
    """Report each unexplained joint with torque: its share and residual, whatever the cause.

    If the torque stays at one value as if clipped, report that, too.
    """
    for i, joint in enumerate(joints):
        if joint.is_explained or math.isnan(joint.share):
            continue
        bound = clipped_torque(samples((*fit.fitted, fit.tested), "tau_J")[:, i])
        largest, rms = fit.certificate.residual_max_Nm[i], fit.certificate.residual_rms_Nm[i]
        yield RecordingFinding(
            f"{joint.name}: {percent(joint.share)} is explained, {100.0 * WHOLE:.0f} % are needed; the residual "
            f"reaches {largest:.3g} Nm ({rms:.2g} rms), {_times_threshold(joint.margin)}"
            + (
                f"; the torque stays at {bound[0]:.3g} Nm for {percent(bound[1])} of the time, as if clipped"
                if bound
                else ""
            ),
            CLIPPED_REMEDY if bound else _lack_remedy(fit),
        )


def _lack_remedy(fit: Fitted) -> str:
    if fit.described.units.tau_J in ("A", "mA") and not fit.described.arm.has_rotors:
        return "torques of motors turn the rotors, too: `arm.has_rotors` = true"
    return (
        "look at the picture of --out where the residual is large: at reversals: friction; in fast motion: lengths, "
        "elasticity or late velocities"
    )


def _times_threshold(margin: float) -> str:
    if margin >= 1.0:
        return "within its threshold"
    return f"{1.0 / margin:.2g} times its threshold" if margin > 0.0 else "far beyond its threshold"


def _of_residual(fit: Fitted, joints: Sequence[JointShare]) -> Iterator[RecordingFinding]:
    """Report, as remarks, the smallest contacts that show, on joints with a margin below 1, or with loud noise.

    Loud: the threshold exceeds the rms torque.
    """
    certificate = fit.certificate
    contact_Nm = np.hypot(certificate.threshold_Nm, fit.settings.deviations * certificate.lack_Nm)
    over = [i for i, joint in enumerate(joints) if joint.margin < 1.0]
    loud = [i for i, joint in enumerate(joints) if i not in over and certificate.threshold_Nm[i] > joint.torque_Nm]
    if over:
        each = ", ".join(f"{joints[i].name} {contact_Nm[i]:.2g} Nm" for i in over)
        yield RecordingFinding(
            f"the model error exceeds the noise: contacts show from about {each} on", is_against=False
        )
    if loud:
        each = ", ".join(f"{joints[i].name} {contact_Nm[i]:.2g} Nm" for i in loud)
        noise = fit.settings.velocity_noise_rad_s
        source = f" of the velocities, {noise:.2g} rad/s," if noise and fit.has_velocities else ""
        remedy = f"; {LEFT_OUT_REMEDY}" if source else ""
        yield RecordingFinding(
            f"noise{source} hides contacts smaller than the torque itself: they show from about {each} on{remedy}",
            is_against=False,
        )


def _torque_columns(described: RecordingMap, joints: Sequence[int]) -> str:
    """Return "`columns.tau_J`" with the columns of these joints in parentheses, if the map names them."""
    columns = described.columns.tau_J
    named = f" ({', '.join(columns[i] for i in joints)})" if columns else ""
    return f"`columns.tau_J`{named}"
