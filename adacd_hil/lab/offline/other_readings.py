"""Finds mistakes in the map of a recording: other interpretations of its columns that fit the arm's motion better.

A reading is such an interpretation: it turns, exchanges, scales or couples columns, q = T q_recorded, tau = R
tau_recorded. The arm's equation, linear in theta, is fitted to each, behind the filter of the fit. A reading is
reported with the key of the map if it explains the torque of the test, with the inertia of a possible arm, and the
map's does not. `control/device_readings.py` does the same for the two joints on the bus. A turned or exchanged torque
needs no new regressor: with A_i = sum w w' of joint i and b_ij = sum w tau_j the residual of any choice of signs and
places is a quadratic form. Indistinguishable: an arm without gravity and its mirror image.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from adacd_hil.lab.offline.column_checks import BEYOND_EFFORT, torques_and_limits
from adacd_hil.lab.offline.recording_map import ANGLE_RAD, RecordingMap
from adacd_hil.lab.serial_arm import offline
from adacd_hil.lab.serial_arm.offline import ArmModel, OfflineSettings, Record
from adacd_hil.lab.serial_arm.urdf import STANDARD_GRAVITY_M_S2
from adacd_hil.records import Vector

_MOST_S: Final = 10.0
"""Longest part of fit and of test that is used."""
_PERIOD_S: Final = 1e-2
"""Shortest distance of used samples: the filter of the fit is much slower."""
_MOST_SIGNS: Final = 7
"""Most joints for which all choices of signs are tried."""
EXPLAINED: Final = 0.9
"""Least share of each joint's torque that a reported reading explains."""
_BETTER: Final = 0.2
"""Largest ratio of its unexplained share to the map's; any ratio will do if the map's arm is impossible."""
_ALIKE: Final = 1.3
"""Factor on the best unexplained share within which a simpler reading is preferred, and others are reported, too."""
_LATE: Final = (1, 2, 4, 6)
"""Samples, of about `_PERIOD_S`, by which columns are tried to be late."""
_LATE_ABOVE: Final = 0.01
"""Share that the map leaves unexplained, below which nothing is called late: filters delay by little, too."""
_RIDGE: Final = 1e-8
_IDLE_FRICTION: Final = 0.05
"""Share of the largest friction: power that a joint without friction may seem to give."""
UNITS: Final = {"deg": "degrees", "rad": "radians"}


class Reading(NamedTuple):
    """A tried interpretation of the recording's columns.

    Text, remedy: its description and the key of the map to change. Both are "" for the map's own. weight: number of
    differences from the map. unexplained: of the joint with the largest one, the share of torque that the fit leaves in
    the test. is_possible: an arm can have the fitted parameters; False untested if too much is unexplained.
    """

    text: str
    remedy: str
    weight: int
    unexplained: float
    is_possible: bool


class _Motion(NamedTuple):
    """An interpretation of the motion: q = T q_recorded, tau = R tau_recorded, each (n, n).

    R None: torques as recorded. model: the arm's. turned: the joint whose position has the other sign, if that is the
    only change. is_of_velocities: T turns the velocities, too. late: samples by which each position, with its velocity,
    then each torque is late (2 n,); () if none is.
    """

    text: str
    remedy: str
    model: ArmModel
    T: Vector
    R: Vector | None = None
    turned: int | None = None
    is_of_velocities: bool = True
    late: tuple[int, ...] = ()


class _Torques(NamedTuple):
    """An interpretation of the torques: joint i has `factors[i]` times the torque in the column of joint `places[i]`.

    turned: the joints whose sign is not the map's.
    """

    factors: Vector
    places: tuple[int, ...]
    text: str = ""
    remedy: str = ""
    turned: tuple[int, ...] = ()


class _Equations(NamedTuple):
    """Normal equations of fit or test, by joint, from its filtered rows w (p,) and torques.

    A (n, p, p): sums of w w'. b (n, n, p): sums of w times each torque column. S (n, n): products of the torques. u
    (n,), U: products of the filtered constant with the torques, and with itself.
    """

    A: Vector
    b: Vector
    S: Vector
    u: Vector
    U: float

    @property
    def spread(self) -> Vector:
        """Sum of squares (n,) of each torque column about its best constant."""
        return np.maximum(np.diag(self.S) - self.u**2 / max(self.U, 1e-18), 1e-18)


def find_readings(
    described: RecordingMap,
    model: ArmModel,
    settings: OfflineSettings,
    fitted: list[Record],
    tested: list[Record],
    has_velocities: bool,
) -> list[Reading]:
    """Return the interpretations that explain the test's torque far better than the map does, best first.

    An arm can have their parameters, and they explain at least `EXPLAINED` of each joint's torque. They leave at most
    `_BETTER` of the share that the map leaves unexplained, unless no arm can have the map's parameters. Of nearly equal
    ones only those with the fewest differences from the map are returned. At most `_MOST_S` of fit and of test are
    used. [] if there is none, or the map's own can't be computed. has_velocities: they were measured, not derived.
    """
    fitted, tested = _thinned(fitted, settings), _thinned(tested, settings)
    step = _step(settings)
    settings = replace(settings, period_s=step * settings.period_s, fit_every=max(1, round(settings.fit_every / step)))
    units = [] if described.joints == 1 else list(_other_units(described, tested))
    tried: list[Reading] = []
    motions = _motions(described, model, has_velocities)
    for motion in itertools.chain(motions, _late(described, model, settings.period_s)):
        if motion.late and not any(each.weight == 0 and each.unexplained > _LATE_ABOVE for each in tried):
            break
        fit, test = (_equations(part, settings, motion) for part in (fitted, tested))
        if fit is not None and test is not None:
            # Beside another motion, one torque or all may be turned, and no unit differs.
            most_turned, other_units = (1, []) if motion.text else (model.joints, units)
            for torques in _torques(described, most_turned, other_units):
                tried.append(_judge(described, fit, test, motion, torques, fitted))
    of_map = next((each for each in tried if each.weight == 0), None)
    if of_map is None:
        return []
    limit = min(1.0 - EXPLAINED, _BETTER * of_map.unexplained if of_map.is_possible else 1.0)
    right = [each for each in tried if each.weight and each.is_possible and each.unexplained <= limit]
    best = min((each.unexplained for each in right), default=0.0)
    alike = [each for each in right if each.unexplained <= max(_ALIKE * best, best + 1e-4)]
    simplest = min((each.weight for each in alike), default=0)
    return sorted((each for each in alike if each.weight == simplest), key=lambda each: each.unexplained)


def is_possible(model: ArmModel, theta: Vector, q: Vector, dq: Vector) -> bool:
    """Return whether an arm can have these parameters: positive inertias in about 8 poses of q, braking friction.

    By its mean power in the motion, each joint's friction may drive it on a little: up to `_IDLE_FRICTION` of the
    largest friction. q, dq: (k, n).
    """
    F_v, F_c = theta[model.place_of("F_v")], theta[model.place_of("F_c")]
    speed, square = np.abs(dq).mean(axis=0), (dq**2).mean(axis=0)
    idle = _IDLE_FRICTION * (np.abs(F_c).max() + np.abs(F_v).max() * speed.mean()) * speed
    if np.any(F_c * speed + F_v * square < -idle):
        return False
    return bool(np.all(mass_rows(model, q, 8) @ theta > 0.0))


def mass_rows(model: ArmModel, q: Vector, poses: int) -> Vector:
    """Return the rows (m, n, p) whose product with theta is the inertia about each joint, kg m², or kg if it slides.

    The m poses, about `poses`, are spread evenly over the samples q (k, n).
    """
    units = np.eye(model.joints)
    spread = q[:: max(1, len(q) // poses)]
    return np.array([[offline.mass_terms(model, pose, unit) for unit in units] for pose in spread])


def _step(settings: OfflineSettings) -> int:
    """Return the distance, in samples, of those that are used: `_PERIOD_S` or a little less, and at least 1."""
    return max(1, math.floor(_PERIOD_S / settings.period_s + 1e-9))


def _thinned(records: list[Record], settings: OfflineSettings) -> list[Record]:
    """Return the first `_MOST_S` of the records in all, with only every `_step`-th sample.

    A record left with fewer than two samples is dropped.
    """
    step, room = _step(settings), round(_MOST_S / settings.period_s)
    kept = []
    for record in records:
        rows = slice(0, max(0, room), step)
        room -= len(record.q)
        if len(record.q[rows]) > 1:
            kept.append(Record(record.q[rows], record.dq[rows], record.tau_J[rows]))
    return kept


def _equations(records: list[Record], settings: OfflineSettings, motion: _Motion) -> _Equations | None:
    """Return the sum of all records' normal equations under an interpretation of the motion.

    None if a record's filtered regressor isn't finite.
    """
    model, rows = motion.model, []
    for record in (_in_time(record, motion.late) for record in records):
        tau_J = record.tau_J if motion.R is None else record.tau_J @ motion.R.T
        dq = record.dq @ motion.T.T if motion.is_of_velocities else record.dq
        rows.append(offline.fit_rows(model, Record(record.q @ motion.T.T, dq, tau_J), settings))
    if not all(np.all(np.isfinite(W)) for W, _ in rows):
        return None
    n, p = model.joints, len(model.parameter_names)
    W = np.concatenate([np.zeros((0, n, p)), *(each for each, _ in rows)])
    tau = np.concatenate([np.zeros((0, n)), *(each for _, each in rows)])
    constant, by_joint = W[:, 0, model.place_of("offset").start], W.swapaxes(0, 1)
    A, b = by_joint.swapaxes(1, 2) @ by_joint, tau.T @ by_joint
    return _Equations(A, b, tau.T @ tau, constant @ tau, float(constant @ constant))


def _judge(
    described: RecordingMap,
    fit: _Equations,
    test: _Equations,
    motion: _Motion,
    torques: _Torques,
    fitted: list[Record],
) -> Reading:
    """Fit the arm to `fit` under an interpretation of motion and torques, and return the interpretation as a `Reading`.

    Its unexplained share is that of the worst joint in `test`. Only the map's own reading, and readings that explain at
    least `EXPLAINED`, are tested for parameters that an arm can have; the test is made on the motion of `fitted`.
    """
    factors, places, joints = torques.factors, list(torques.places), range(motion.model.joints)
    weight = 1.0 / (factors**2 * fit.spread[places])
    A = np.tensordot(weight, fit.A, axes=1)
    b = np.sum([weight[i] * factors[i] * fit.b[i, places[i]] for i in joints], axis=0)
    scale = np.sqrt(np.maximum(np.diag(A), 1e-30))
    theta = np.linalg.solve(A / np.outer(scale, scale) + _RIDGE * np.eye(len(scale)), b / scale) / scale
    left = [
        factors[i] ** 2 * test.S[places[i], places[i]]
        - 2.0 * factors[i] * theta @ test.b[i, places[i]]
        + theta @ test.A[i] @ theta
        for i in joints
    ]
    unexplained = float(np.max(np.maximum(left, 0.0) / (factors**2 * test.spread[places])))
    turned = list(torques.turned)
    differences = bool(motion.text) + (min(len(turned), 2) or bool(torques.text))
    texts, remedies = [motion.text, torques.text], [motion.remedy, torques.remedy]
    if turned == [motion.turned]:
        texts = [f"{described.urdf.joint_names[turned[0]]} counts the other way round, position and torque"]
    is_right = differences == 0 or unexplained <= 1.0 - EXPLAINED
    if is_right:
        q, dq = (np.concatenate([getattr(record, name) for record in fitted]) @ motion.T.T for name in ("q", "dq"))
        is_right = is_possible(motion.model, theta, q, dq)
    text, remedy = ", and ".join(filter(None, texts)), ", ".join(filter(None, dict.fromkeys(remedies)))
    return Reading(text, remedy, differences, unexplained, is_right)


def _other_units(described: RecordingMap, tested: list[Record]) -> Iterator[tuple[int, float]]:
    """Yield (joint, factor), factors 0.001 and 1000, that leave all torques within `BEYOND_EFFORT` times the effort.

    The 99 % quantile of each joint's torque counts; a joint without an effort in the URDF is always within.
    """
    largest, effort = torques_and_limits(np.concatenate([record.tau_J for record in tested]), described.urdf)
    for joint, factor in itertools.product(range(described.joints), (1e-3, 1e3)):
        scaled = np.where(np.arange(described.joints) == joint, factor * largest, largest)
        if np.all(scaled <= BEYOND_EFFORT * effort):
            yield joint, factor


def _torques(described: RecordingMap, most_turned: int, units: list[tuple[int, float]]) -> Iterator[_Torques]:
    """Yield interpretations of the torques, the map's own first.

    The others: some or all with the other sign, one in another unit, two exchanged, and, beyond three joints, all in
    reverse order. Signs are tried on the first `_MOST_SIGNS` joints only. most_turned: most torques that have the other
    sign, unless all have. units: joints and the factors to try on their torques.
    """
    n, names = described.joints, described.urdf.joint_names
    straight, ones = tuple(range(n)), np.ones(n)
    Nm = np.array(described.factors("tau_J"))
    for choice in itertools.product((1.0, -1.0), repeat=min(n, _MOST_SIGNS)):
        turned = tuple(i for i, sign in enumerate(choice) if sign < 0.0)
        signs = np.concatenate((choice, ones[len(choice) :]))
        if not turned:
            yield _Torques(ones, straight)
        elif len(turned) in (*range(most_turned + 1), n):
            some = "all torques have" if len(turned) == n > 1 else f"the torque of {_both(names, turned)} has"
            yield _Torques(signs, straight, f"{some} the other sign", described.scaled("tau_J", signs), turned)
    for i, factor in units:
        factors = np.where(np.arange(n) == i, factor, 1.0)
        much = "1000 times too large" if factor < 1.0 else "1000 times too small"
        yield _Torques(factors, straight, f"the torque of {names[i]} is {much}", described.scaled("tau_J", factors))
    for pair in itertools.combinations(range(n), 2):
        text = f"the torques of {_both(names, pair)} are exchanged"
        places = _exchanged(n, *pair)
        yield _Torques(Nm / Nm[places], tuple(places), text, "exchange them in `columns.tau_J`")
    if n > 3:
        text, remedy = "the torques begin with the outermost joint", "turn the order round in `columns.tau_J`"
        yield _Torques(Nm / Nm[::-1], straight[::-1], text, remedy)


def _motions(described: RecordingMap, model: ArmModel, has_velocities: bool) -> Iterator[_Motion]:
    """Yield interpretations of the motion, the map's own first, with texts "".

    The others: positions in another unit, a position with the other sign, two exchanged with and without their torques,
    sums or differences of neighbours, the other `arm.has_rotors`, gravity along another axis or none. Beyond two joints
    also positions that count from the base, and beyond three joints all columns in reverse order. With measured
    velocities, another unit of the positions is tried with and without that of the velocities.
    """
    n, straight, names = model.joints, np.eye(model.joints), described.urdf.joint_names
    yield _Motion("", "", model, straight)
    for unit in UNITS:
        if unit != described.units.q:
            factor = ANGLE_RAD[unit] / ANGLE_RAD[described.units.q]
            found = _Motion(f"the positions are {UNITS[unit]}", f'`units.q` = "{unit}"', model, factor * straight)
            yield found
            if has_velocities:
                yield found._replace(is_of_velocities=False)
    for i in range(n):
        signs = np.where(np.arange(n) == i, -1.0, 1.0)
        text = f"the position of {names[i]} counts the other way round"
        yield _Motion(text, described.scaled("q", signs), model, np.diag(signs), turned=i)
    both_columns = "`columns.q`, `columns.tau_J`"
    for pair in itertools.combinations(range(n), 2):
        places, both = _exchanged(n, *pair), _both(names, pair)
        swap, swap_torques = (_moved(described.factors(key), places) for key in ("q", "tau_J"))
        yield _Motion(f"the positions of {both} are exchanged", "exchange them in `columns.q`", model, swap)
        text = f"{both} are exchanged, positions and torques"
        yield _Motion(text, f"exchange them in {both_columns}", model, swap, swap_torques)
    if n > 3:
        text, remedy = "the columns begin with the outermost joint", f"turn the order round in {both_columns}"
        turned, turned_torques = (_moved(described.factors(key), range(n)[::-1]) for key in ("q", "tau_J"))
        yield _Motion(text, remedy, model, turned, turned_torques)
    # A column may count from the base, or with the joint before, as behind belts: then torques do the same power.
    for i, (sign, what) in itertools.product(range(1, n), ((-1.0, "sum"), (1.0, "difference"))):
        T = straight.copy()
        T[i, i - 1] = sign
        text = f"the column of {names[i]} has the {what} of {_both(names, (i - 1, i))}"
        yield from _coupled(text, model, T)
    if n > 2:
        text = "each position counts from the base, not from the link before"
        yield from _coupled(text, model, straight - np.eye(n, k=-1))
    text = "the torques turn no rotors"
    if not model.has_rotors:
        text = "the torques are those of geared motors, which turn their rotors too"
    turning = offline.model_of(model.chain, not model.has_rotors)
    yield _Motion(text, f"`arm.has_rotors` = {str(turning.has_rotors).lower()}", turning, straight)
    gravity_of_map = model.chain.gravity_m_s2
    size = float(np.linalg.norm(gravity_of_map)) or float(np.linalg.norm(STANDARD_GRAVITY_M_S2))
    for axis, direction in zip(
        ("", "+x", "+y", "+z", "-x", "-y", "-z"), (np.zeros(3), *np.eye(3), *-np.eye(3)), strict=True
    ):
        gravity = size * direction + 0.0
        if not np.allclose(gravity, gravity_of_map):
            text = f"gravity acts along {axis} of the URDF's root" if axis else "there is no gravity in the torques"
            remedy = f"`arm.gravity_m_s2` = [{', '.join(f'{value:g}' for value in gravity)}]"
            other = offline.model_of(model.chain._replace(gravity_m_s2=gravity), model.has_rotors)
            yield _Motion(text, remedy, other, straight)


def _late(described: RecordingMap, model: ArmModel, period_s: float) -> Iterator[_Motion]:
    """Yield interpretations with one or all positions, or torques, late by each number of samples in `_LATE`."""
    n, names = model.joints, described.urdf.joint_names
    for samples, (first, what) in itertools.product(_LATE, ((0, "position"), (n, "torque"))):
        for joints in [*((i,) for i in range(n)), *([tuple(range(n))] if n > 1 else [])]:
            late = tuple(samples * (i - first in joints) for i in range(2 * n))
            whose = f"all {what}s are" if len(joints) > 1 else f"the {what} of {names[joints[0]]} is"
            text = f"{whose} late, by about {1e3 * samples * period_s:.0f} ms"
            remedy = "record all columns at one time, or shift what is late"
            yield _Motion(text, remedy, model, np.eye(n), late=late)


def _in_time(record: Record, late: tuple[int, ...]) -> Record:
    """Return the record with its late columns shifted back, and `max(late)` fewer samples; late: as of `_Motion`.

    A record of at most as many samples is returned as it is.
    """
    if not late or len(record.q) <= max(late):
        return record
    n, rows = record.q.shape[1], len(record.q) - max(late)
    shifted = [np.column_stack([column[by : by + rows] for column, by in zip(table.T, lates, strict=True)])
               for table, lates in ((record.q, late[:n]), (record.dq, late[:n]), (record.tau_J, late[n:]))]  # fmt: skip
    return Record(*shifted)


def _coupled(text: str, model: ArmModel, T: Vector) -> Iterator[_Motion]:
    """Yield interpretations with the positions T q: with torques as recorded, and with torques of the same power."""
    remedy = "record the joints' own positions and torques, or write them into new columns"
    yield _Motion(text, remedy, model, T)
    yield _Motion(f"{text}, and so do the torques", remedy, model, T, np.linalg.inv(T).T.astype(np.float64))


def _moved(units: Sequence[float], places: Sequence[int]) -> Vector:
    """Return M (n, n) that gives joint i the column of joint places[i], in the unit that the map gives joint i.

    units (n,): factors of the map, unit and `scale`, with which each column was read in its old place.
    """
    sizes = np.array(units)
    return np.asarray(np.eye(len(sizes))[list(places)] * np.divide.outer(sizes, sizes))


def _exchanged(n: int, i: int, j: int) -> list[int]:
    """Return the list 0 to n - 1 with i and j exchanged."""
    places = list(range(n))
    places[i], places[j] = j, i
    return places


def _both(names: Sequence[str], joints: Sequence[int]) -> str:
    return " and ".join(names[joint] for joint in joints)
