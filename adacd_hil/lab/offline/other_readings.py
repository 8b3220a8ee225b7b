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

from adacd_hil.lab.offline.recording_map import RecordingMap
from adacd_hil.records import Vector
from adacd_hil.scheme.identify import offline
from adacd_hil.scheme.identify.offline import ArmModel, OfflineSettings, Record
from adacd_hil.scheme.model.urdf import STANDARD_GRAVITY_M_S2

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
_RIDGE: Final = 1e-8
_IDLE_FRICTION: Final = 0.05
"""Share of the largest friction: power that a joint without friction may seem to give."""
UNITS: Final = {"deg": "degrees", "rad": "radians"}


class Reading(NamedTuple):
    """A reading that fits: its description, the key of the map, and the least share of torque explained at a joint."""

    text: str
    remedy: str
    share: float


class _Motion(NamedTuple):
    """A reading of the motion. T (n, n), R (n, n) of the torques: see above; R None: unchanged."""

    kind: str  # "map": unchanged
    T: Vector
    R: Vector | None = None
    joints: tuple[int, ...] = ()
    unit: str = ""
    has_rotors: bool | None = None  # None: as in the map
    gravity_m_s2: tuple[float, ...] | None = None  # None: as in the map
    is_of_velocities: bool = True

    @property
    def weight(self) -> int:
        """Number of differences from the map."""
        return int(self.kind != "map")


class _Torques(NamedTuple):
    """A reading of torques: joint i has `signs[i]` times the column of joint `places[i]`."""

    signs: tuple[float, ...]
    places: tuple[int, ...]

    @property
    def weight(self) -> int:
        """Number of differences from the map."""
        return min(self.signs.count(-1.0), 2) + (self.places != tuple(range(len(self.places))))


class _Equations(NamedTuple):
    """Normal equations of fit or test: A (n, p, p), b (n, n, p), S (n, n) of torques; u (n,), U (1,) of a constant."""

    A: Vector
    b: Vector
    S: Vector
    u: Vector
    U: Vector

    @property
    def spread(self) -> Vector:
        """Sum of squares (n,) of each torque column about its best constant."""
        return np.maximum(np.diag(self.S) - self.u**2 / np.maximum(self.U, 1e-18), 1e-18)


class _Judged(NamedTuple):
    motion: _Motion
    torques: _Torques
    unexplained: float  # the largest share of a joint
    is_possible: bool

    @property
    def weight(self) -> int:
        return self.motion.weight + self.torques.weight


def find_readings(
    described: RecordingMap, model: ArmModel, settings: OfflineSettings, fitted: list[Record], tested: list[Record]
) -> tuple[Reading, ...]:
    """Return the readings that explain the test far better than the map's; the simplest of nearly equal ones first."""
    fitted, tested = _thinned(fitted, settings), _thinned(tested, settings)
    step = _step(settings)
    settings = replace(settings, period_s=step * settings.period_s, fit_every=max(1, round(settings.fit_every / step)))
    judged: list[_Judged] = []
    for motion in _motions(described, model):
        other = _model_of(model, motion)
        fit, test = (_equations(other, part, settings, motion) for part in (fitted, tested))
        if fit is not None and test is not None:
            for torques in _torques(model.joints, most_turned=1 if motion.weight else model.joints):
                judged.append(_judge(other, fit, test, motion, torques, fitted))
    of_map = next((each for each in judged if each.weight == 0), None)
    if of_map is None:
        return ()
    limit = min(1.0 - EXPLAINED, _BETTER * of_map.unexplained if of_map.is_possible else 1.0)
    right = [each for each in judged if each.weight and each.is_possible and each.unexplained <= limit]
    if not right:
        return ()
    best = min(each.unexplained for each in right)
    alike = [each for each in right if each.unexplained <= max(_ALIKE * best, best + 1e-4)]
    simplest = min(each.weight for each in alike)
    named = sorted((each for each in alike if each.weight == simplest), key=lambda each: each.unexplained)
    return tuple(Reading(*_texts(described, each), 1.0 - each.unexplained) for each in named)


def _model_of(model: ArmModel, motion: _Motion) -> ArmModel:
    if motion.gravity_m_s2 is not None:
        return offline.model_of(model.chain._replace(gravity_m_s2=np.array(motion.gravity_m_s2)), model.has_rotors)
    return model if motion.has_rotors is None else offline.model_of(model.chain, motion.has_rotors)


def is_possible(model: ArmModel, theta: Vector, q: Vector, dq: Vector) -> bool:
    """Tell whether an arm can have these parameters: each joint has an inertia, and friction dissipates. q (k, n)."""
    F_v, F_c = theta[model.place_of("F_v")], theta[model.place_of("F_c")]
    speed, square = np.abs(dq).mean(axis=0), (dq**2).mean(axis=0)
    idle = _IDLE_FRICTION * (np.abs(F_c).max() + np.abs(F_v).max() * speed.mean()) * speed
    if np.any(F_c * speed + F_v * square < -idle):
        return False
    poses = q[:: max(1, len(q) // 8)]
    return all(
        float(offline.mass_terms(model, pose, unit) @ theta) > 0.0 for pose in poses for unit in np.eye(len(F_c))
    )


def _step(settings: OfflineSettings) -> int:
    return max(1, math.floor(_PERIOD_S / settings.period_s + 1e-9))


def _thinned(records: list[Record], settings: OfflineSettings) -> list[Record]:
    """Thin the samples out and shorten the records to the longest time that is used."""
    step, room = _step(settings), round(_MOST_S / settings.period_s)
    kept = []
    for record in records:
        rows = slice(0, max(0, min(room, len(record.q))), step)
        room -= len(record.q)
        if len(record.q[rows]) > 1:
            kept.append(Record(record.q[rows], record.dq[rows], record.tau_J[rows]))
    return kept


def _equations(model: ArmModel, records: list[Record], settings: OfflineSettings, motion: _Motion) -> _Equations | None:
    """Sum the normal equations of a reading of the motion; None if its numbers overflow."""
    n, p = model.joints, len(model.parameter_names)
    found = _Equations(*(np.zeros(shape) for shape in ((n, p, p), (n, n, p), (n, n), (n,), (1,))))
    offset = model.place_of("offset").start
    for record in records:
        tau_J = record.tau_J if motion.R is None else record.tau_J @ motion.R.T
        dq = record.dq @ motion.T.T if motion.is_of_velocities else record.dq
        W, tau = offline.fit_rows(model, Record(record.q @ motion.T.T, dq, tau_J), settings)
        if not np.all(np.isfinite(W)):
            return None
        constant = W[:, 0, offset]
        for i in range(n):
            found.A[i] += W[:, i].T @ W[:, i]
            found.b[i] += tau.T @ W[:, i]
        found.S[:] += tau.T @ tau
        found.u[:] += constant @ tau
        found.U[:] += constant @ constant
    return found


def _judge(
    model: ArmModel, fit: _Equations, test: _Equations, motion: _Motion, torques: _Torques, fitted: list[Record]
) -> _Judged:
    """Fit one reading; return the largest share of a joint's torque that it leaves unexplained in the test."""
    signs, places, joints = np.array(torques.signs), list(torques.places), range(model.joints)
    weight = 1.0 / fit.spread[places]
    A = np.tensordot(weight, fit.A, axes=1)
    b = np.sum([weight[i] * signs[i] * fit.b[i, places[i]] for i in joints], axis=0)
    scale = np.sqrt(np.maximum(np.diag(A), 1e-30))
    theta = np.linalg.solve(A / np.outer(scale, scale) + _RIDGE * np.eye(len(scale)), b / scale) / scale
    left = [
        test.S[places[i], places[i]] - 2.0 * signs[i] * theta @ test.b[i, places[i]] + theta @ test.A[i] @ theta
        for i in joints
    ]
    unexplained = float(np.max(np.maximum(left, 0.0) / test.spread[places]))
    is_of_map = motion.weight + torques.weight == 0
    if unexplained > 1.0 - EXPLAINED and not is_of_map:
        return _Judged(motion, torques, unexplained, is_possible=False)
    q, dq = (np.concatenate([getattr(record, name) for record in fitted]) @ motion.T.T for name in ("q", "dq"))
    return _Judged(motion, torques, unexplained, is_possible(model, theta, q, dq))


def _torques(n: int, most_turned: int) -> Iterator[_Torques]:
    """Yield readings of torques: some or all turned, two exchanged, all in reverse order."""
    straight, ones = tuple(range(n)), (1.0,) * n
    for signs in itertools.product((1.0, -1.0), repeat=min(n, _MOST_SIGNS)):
        turned = signs.count(-1.0)
        if turned <= most_turned or turned == n:
            yield _Torques(signs + ones[len(signs) :], straight)
    for i, j in itertools.combinations(range(n), 2):
        yield _Torques(ones, tuple(_exchanged(n, i, j)))
    if n > 3:
        yield _Torques(ones, straight[::-1])


def _motions(described: RecordingMap, model: ArmModel) -> Iterator[_Motion]:
    """Yield readings of the motion, the map's first."""
    n, straight = model.joints, np.eye(model.joints)
    yield _Motion("map", straight)
    for unit, factor in (("deg", math.pi / 180.0), ("rad", 180.0 / math.pi)):
        if unit != described.units.q:
            yield _Motion("unit", factor * straight, unit=unit)
            if described.columns.dq:
                yield _Motion("unit", factor * straight, unit=unit, is_of_velocities=False)
    for i in range(n):
        yield _Motion("turned", np.diag(np.where(np.arange(n) == i, -1.0, 1.0)), joints=(i,))
    for i, j in itertools.combinations(range(n), 2):
        swap = straight[_exchanged(n, i, j)]
        yield _Motion("exchanged", swap, joints=(i, j))
        yield _Motion("joints", swap, swap, joints=(i, j))
    if n > 3:
        yield _Motion("order", straight[::-1], straight[::-1])
    # A column may count from the base, or with the joint before, as behind belts: then torques do the same power.
    for i, sign in itertools.product(range(1, n), (-1.0, 1.0)):
        T = straight.copy()
        T[i, i - 1] = sign
        for R in (None, np.linalg.inv(T).T.astype(np.float64)):
            yield _Motion("sum" if sign < 0.0 else "difference", T, R, joints=(i - 1, i))
    if n > 2:
        T = straight - np.eye(n, k=-1)
        for R in (None, np.linalg.inv(T).T.astype(np.float64)):
            yield _Motion("absolute", T, R)
    yield _Motion("rotors", straight, has_rotors=not model.has_rotors)
    gravity_of_map = model.chain.gravity_m_s2
    size = float(np.linalg.norm(gravity_of_map)) or float(np.linalg.norm(STANDARD_GRAVITY_M_S2))
    for direction in (np.zeros(3), *np.eye(3), *-np.eye(3)):
        if not np.allclose(size * direction, gravity_of_map):
            yield _Motion("gravity", straight, gravity_m_s2=tuple((size * direction + 0.0).tolist()))


def _exchanged(n: int, i: int, j: int) -> list[int]:
    places = list(range(n))
    places[i], places[j] = j, i
    return places


def _texts(described: RecordingMap, judged: _Judged) -> tuple[str, str]:
    """Return a reading's description, and the change of the map that adopts it."""
    motion, torques = judged.motion, judged.torques
    turned = [i for i, sign in enumerate(torques.signs) if sign < 0.0]
    if motion.kind == "turned" and turned == list(motion.joints):
        keys = f"{_scale(described, 'q', turned)}, {_scale(described, 'tau_J', turned)}"
        return f"{described.urdf.joint_names[turned[0]]} counts the other way round, position and torque", keys
    pairs = [_motion_texts(described, motion)] if motion.weight else []
    pairs += [_torque_texts(described, torques, turned)] if torques.weight else []
    return ", and ".join(text for text, _ in pairs), ", ".join(dict.fromkeys(remedy for _, remedy in pairs))


def _motion_texts(described: RecordingMap, motion: _Motion) -> tuple[str, str]:
    names = [described.urdf.joint_names[joint] for joint in motion.joints]
    both, last = " and ".join(names), names[-1] if names else ""
    likewise = ", and so do the torques" if motion.R is not None else ""
    own = "record the joints' own positions and torques, or write them into new columns"
    columns = "`columns.q`, `columns.tau_J`"
    gravity = motion.gravity_m_s2 or (0.0, 0.0, 0.0)
    along = next(
        (f"{'-' if value < 0.0 else '+'}{axis}" for axis, value in zip("xyz", gravity, strict=True) if value), ""
    )
    texts = {
        "gravity": (
            f"gravity acts along {along} of the URDF's root" if along else "there is no gravity in the torques",
            f"`arm.gravity_m_s2` = [{', '.join(f'{value:g}' for value in gravity)}]",
        ),
        "unit": (f"the positions are {UNITS.get(motion.unit)}", f'`units.q` = "{motion.unit}"'),
        "turned": (f"the position of {both} counts the other way round", _scale(described, "q", motion.joints)),
        "exchanged": (f"the positions of {both} are exchanged", "exchange them in `columns.q`"),
        "joints": (f"{both} are exchanged, positions and torques", f"exchange them in {columns}"),
        "order": ("the columns begin with the outermost joint", f"turn the order round in {columns}"),
        "sum": (f"the column of {last} has the sum of {both}{likewise}", own),
        "difference": (f"the column of {last} has the difference of {both}{likewise}", own),
        "absolute": (f"each position counts from the base, not from the link before{likewise}", own),
        "rotors": (
            "the torques are those of geared motors, which turn their rotors too"
            if motion.has_rotors
            else "the torques turn no rotors",
            f"`arm.has_rotors` = {str(motion.has_rotors).lower()}",
        ),
    }
    return texts[motion.kind]


def _torque_texts(described: RecordingMap, torques: _Torques, turned: list[int]) -> tuple[str, str]:
    n, names = len(torques.signs), described.urdf.joint_names
    moved = [i for i in range(n) if torques.places[i] != i]
    if len(moved) > 2:
        return "the torques begin with the outermost joint", "turn the order round in `columns.tau_J`"
    if moved:
        both = " and ".join(names[i] for i in moved)
        return f"the torques of {both} are exchanged", "exchange them in `columns.tau_J`"
    some = " and ".join(names[i] for i in turned)
    which = "all torques have" if len(turned) == n > 1 else f"the torque of {some} has"
    return f"{which} the other sign", _scale(described, "tau_J", turned)


def _scale(described: RecordingMap, key: str, turned: Sequence[int]) -> str:
    given = getattr(described.scale, key) or (1.0,) * described.joints
    values = [-value if i in turned else value for i, value in enumerate(given)]
    return f"`scale.{key}` = [{', '.join(f'{value:g}' for value in values)}]"
