"""Ways in which the devices may be at the joints, and which of them the arm's own motion bears out.

A reading says what the true q, tau of the arm are by what the devices count: exchanged, reversed, or in another scale.
The equation of a 2R arm, linear in theta, is fitted to each reading, with offsets and what the torque is late,

    tau_J = W(q, dq, ddq) theta + offset − l dtau_J/dt

A reading of a share of unexplained squares that is far below that of the configuration's, and of an inertia that an arm
can have, is how the devices are. One reading is of the mounting: gravity acts in any direction of the plane of motion,
so a4 and a5 have columns of sin(q1 - level_rad), too. Of 95 scenarios of the package, touched arms included, none comes
below 0.5 times the share as told; of the mistakes below, each comes to 0.1 times or less, a mounting to 0.17.

Not told apart: an arm without gravity is its own mirror image, so of two joints of which one is reversed nothing says
which, nor that both are. Torques in one wrong scale make an arm that is as much heavier.
"""

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np

from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.model.regressor import A4, A5, is_positive_definite, regressor
from adacd_hil.settings.configuration import Settings

_FEWEST_BLOCKS: Final = 15
_BETTER: Final = 0.2
"""Share over that of the configuration, at most, of a reading that is right."""
_EXPLAINED: Final = 0.004
"""Largest unexplained share of it."""
_UNEXPLAINED: Final = 1e-4
"""Least share as told: what explains all but 1 % of the torque is right. Mistakes leave 2 % and more."""
_JUDGED_EVERY: Final = 4
_ROUNDS: Final = 3
"""Verdicts in a row that have to agree."""
_SUSPECT_BLOCKS: Final = 6
_NEARLY: Final = 1.2
"""As `_BETTER`, of an arm that has run away and whose configuration no arm can have."""
RIDGE: Final = 1e-9
"""Of the scaled equations, so that what a motion doesn't tell is 0."""
_MOUNTING_BLOCKS: Final = 60
"""Before, a small motion hardly tells gravity from an offset: two more parameters explain any torque."""
_TURNED_DEG: Final = 10.0
"""Least angle by which a mounting is wrong."""
_SCALES: Final = (0.5, 0.67, 0.8, 1.25, 1.5, 2.0)


class Reading(NamedTuple):
    """One way. position, torque: factors on what is counted, by joint. kind: of the texts of `describe`.

    is_turned: gravity acts in any direction.
    """

    kind: str
    is_drive_exchanged: bool = False
    is_sensor_exchanged: bool = False
    position: tuple[float, float] = (1.0, 1.0)
    torque: tuple[float, float] = (1.0, 1.0)
    is_turned: bool = False

    @property
    def joint(self) -> int:
        """The joint whose position is read otherwise, 0 or 1."""
        return 0 if self.position[0] != 1.0 else 1

    @property
    def row(self) -> tuple[float, ...]:
        """The numbers of it, for compiled functions."""
        return (self.is_drive_exchanged, self.is_sensor_exchanged, *self.position, *self.torque, self.is_turned)


READINGS: Final = (
    Reading("told"),
    Reading("reversed", position=(1.0, -1.0), torque=(1.0, -1.0)),
    Reading("joints", True, True),
    Reading("joints", True, True, (1.0, -1.0), (1.0, -1.0)),
    Reading("drives", is_drive_exchanged=True),
    Reading("sensors", is_sensor_exchanged=True),
    Reading("position", position=(-1.0, 1.0)),
    Reading("position", position=(1.0, -1.0)),
    *(Reading("scale", position=(factor, 1.0)) for factor in _SCALES),
    *(Reading("scale", position=(1.0, factor)) for factor in _SCALES),
    *(Reading("torque", torque=(1.0, factor)) for factor in (-1.0, *_SCALES)),
)
_MOUNTED: Final = Reading("mounting", is_turned=True)
_OF_EXCHANGE: Final = tuple(place for place, reading in enumerate(READINGS) if reading.kind in ("drives", "sensors"))


@compiled
def add_block(
    readings: Vector,
    q: Vector,
    dq: Vector,
    ddq: Vector,
    tau_J: Vector,
    dtau_J: Vector,
    level_rad: float,
    count: int,
    normals: Vector,
) -> None:
    """Add a block's means (2,) to the normal equations (h, k, k) of each of the readings (h, 7).

    k = p + 5, or p + 7 with gravity: theta (p = count), two offsets, two lags, a4 and a5 of another direction, torque.
    """
    size = normals.shape[1]
    position, velocity, acceleration, row = np.zeros(JOINTS), np.zeros(JOINTS), np.zeros(JOINTS), np.zeros(size)
    for h in range(readings.shape[0]):
        for i in range(JOINTS):
            at = 1 - i if readings[h, 0] != 0.0 else i
            position[i] = q[at] * readings[h, 2 + i]
            velocity[i] = dq[at] * readings[h, 2 + i]
            acceleration[i] = ddq[at] * readings[h, 2 + i]
        W = regressor(position, velocity, acceleration, count, level_rad)
        for i in range(JOINTS):
            at = 1 - i if readings[h, 1] != 0.0 else i
            row[:] = 0.0
            row[:count] = W[i]
            row[count + i] = 1.0
            row[count + JOINTS + i] = dtau_J[at] * readings[h, 4 + i]
            if readings[h, 6] != 0.0:
                turned = regressor(position, velocity, acceleration, count, level_rad + 0.5 * math.pi)
                row[size - 3 : size - 1] = turned[i, A4 : A5 + 1]
            row[size - 1] = tau_J[at] * readings[h, 4 + i]
            for a in range(size):
                for b in range(size):
                    normals[h, a, b] += row[a] * row[b]


@compiled
def solve_readings(normals: Vector, count: int, blocks: int, shares: Vector, solutions: Vector) -> None:
    """Solve the normal equations (h, k, k) of so many blocks: unexplained share (h,) of squares, unknowns (h, k - 1).

    By Cholesky's factors of the equations, scaled to a diagonal of ones.
    """
    size = normals.shape[1] - 1
    L, x, unit = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    for h in range(normals.shape[0]):
        N = normals[h]
        for a in range(size):
            unit[a] = math.sqrt(max(N[a, a], 1e-12))
        for a in range(size):
            for b in range(a + 1):
                value = N[a, b] / (unit[a] * unit[b])
                for c in range(b):
                    value -= L[a, c] * L[b, c]
                L[a, b] = math.sqrt(max(value + RIDGE, 1e-15)) if a == b else value / L[b, b]
        explained = 0.0
        for a in range(size):
            value = N[a, size] / unit[a]
            for c in range(a):
                value -= L[a, c] * x[c]
            x[a] = value / L[a, a]
            explained += x[a] * x[a]
        for a in range(size - 1, -1, -1):
            for c in range(a + 1, size):
                x[a] -= L[c, a] * x[c]
            x[a] /= L[a, a]
        solutions[h] = x / unit
        spread = N[size, size]
        for i in range(JOINTS):
            spread -= N[count + i, size] ** 2 / blocks
        shares[h] = max(N[size, size] - explained, 0.0) / max(spread, 1e-12)


class DeviceReadings:
    """Fits all readings to the blocks of a motion."""

    def __init__(self, settings: Settings) -> None:
        """Begin without a block."""
        self._settings = settings
        self._level_rad = settings.level_rad
        self._count = len(settings.estimator.parameter_names)
        has_gravity = settings.estimator.gravity
        self._readings = (*READINGS, _MOUNTED) if has_gravity else READINGS
        self._rows = np.array([reading.row for reading in self._readings])
        readings, unknowns = len(self._readings), self._count + 2 * JOINTS + (2 if has_gravity else 0)
        self._normals = np.zeros((readings, unknowns + 1, unknowns + 1))
        self._blocks = 0
        self._shares, self._solutions = np.ones(readings), np.zeros((readings, unknowns))
        self._agreed = (0, 0)  # which reading, how often in a row

    def compile(self) -> None:
        """Compile what `add` calls."""
        zero = np.zeros(JOINTS)
        add_block(self._rows, zero, zero, zero, zero, zero, self._level_rad, self._count, self._normals.copy())
        solve_readings(self._normals, self._count, 1, self._shares.copy(), self._solutions.copy())
        is_positive_definite(self._solutions[0])

    def add(self, q: Vector, dq: Vector, ddq: Vector, tau_J: Vector, dtau_J: Vector) -> None:
        """Take in the means of a block, (2,) each."""
        add_block(self._rows, q, dq, ddq, tau_J, dtau_J, self._level_rad, self._count, self._normals)
        self._blocks += 1

    def step(self) -> Reading | None:
        """Judge every few blocks; return the right reading once it is certain that it isn't the configuration's."""
        if self._blocks < _FEWEST_BLOCKS or self._blocks % _JUDGED_EVERY:
            return None
        best = self._solve(range(len(self._readings)))
        is_wrong = best != 0 and self._shares[0] >= _UNEXPLAINED
        is_better = is_wrong and self._rank(best) <= min(_BETTER * self._shares[0], _EXPLAINED)
        self._agreed = (best, self._agreed[1] + 1 if best == self._agreed[0] else 1) if is_better else (0, 0)
        return self._readings[best] if self._agreed[1] >= _ROUNDS else None

    def suspect(self) -> Reading | None:
        """Return the likeliest reading of an arm that has run away and that no arm is like as it was told, if any."""
        if self._blocks < _SUSPECT_BLOCKS:
            return None
        unlikely = ("scale", "torque", "mounting")
        best = self._solve([place for place, reading in enumerate(self._readings) if reading.kind not in unlikely])
        if is_positive_definite(self._solutions[0]):
            return None
        return self._readings[best] if self._rank(best) <= _NEARLY * self._shares[0] else None

    def exchanged(self) -> str:
        """Say which of the devices are at each other's joint where it is the drives or the sensors."""
        self._solve(_OF_EXCHANGE)
        drives, sensors = self._shares[list(_OF_EXCHANGE)]
        return "drives" if drives < sensors else "sensors"

    def describe(self, reading: Reading) -> str:
        """Say what is wrong, how sure that is, and what to change."""
        place = self._readings.index(reading)
        told, so = 100.0 * np.sqrt(self._shares[[0, place]])
        text = self._mounting_text() if reading.is_turned else self._text(reading)
        return f"{text} (unexplained of the torque: {told:.1f} % as told, {so:.1f} % so)"

    def _text(self, reading: Reading) -> str:
        sign, joint = list(self._settings.arm.sign), reading.joint
        if reading.kind == "joints":
            return (
                "joints 1 and 2 are exchanged, drives and sensors: exchange devices.drive_node and devices.sensor_node"
            )
        if reading.kind in ("drives", "sensors"):
            key = f"devices.{reading.kind[:-1]}_node"
            return f"the {reading.kind} of joints 1 and 2 are exchanged: exchange {key} = {self._nodes(reading.kind)}"
        if reading.kind == "reversed":
            return (
                f"joint 2 turns the other way than arm.sign = {sign} says, if joint 1 is right: arm.sign = "
                f"{[sign[0], -sign[1]]}, or {[-sign[0], sign[1]]} if it is joint 1"
            )
        if reading.kind == "position":
            return (
                f"joint {joint + 1}: its position counts against its torques: reverse the encoder of "
                f"devices.drive_node[{joint}], or its motor and torque sensor and arm.sign[{joint}] = {sign[joint]}"
            )
        if reading.kind == "scale":
            return (
                f"joint {joint + 1} turns about {reading.position[joint]:g} times as far as position and velocity say: "
                "correct its gear: scale.gear_ratio, scale.increments_per_joint_rev and scale.velocity_rad_s of "
                f"devices.drive[{joint}]"
            )
        return (
            f"the torque sensor of joint 2 measures about {1.0 / reading.torque[1]:+.2g} times what that of joint 1 "
            "would: correct scale.torque_Nm of devices.sensor[0] or devices.sensor[1]"
        )

    def _mounting_text(self) -> str:
        hangs_deg = self._settings.mounting_deg[1]
        found_deg = (hangs_deg + self._turned_deg + 180.0) % 360.0 - 180.0
        return (
            f"gravity acts as if link 1 hung at about q1 = {found_deg:.0f} deg: correct the mounting, "
            f"arm.mounting_deg[1] = {hangs_deg:g} deg, or arm.zero_deg[0] if the angle is wrong"
        )

    def _nodes(self, kind: str) -> list[int]:
        devices = self._settings.devices
        return list(devices.drive_node if kind == "drives" else devices.sensor_node)

    def _rank(self, place: int) -> float:
        """Return the share that a reading leaves, infinite where it is no arm's, or too early to be known."""
        is_early = self._readings[place].is_turned and self._blocks < _MOUNTING_BLOCKS
        if is_early or not is_positive_definite(self._solutions[place]):
            return math.inf
        is_as_told = self._readings[place].is_turned and abs(self._turned_deg) < _TURNED_DEG
        return math.inf if is_as_told else float(self._shares[place])

    @property
    def _turned_deg(self) -> float:
        """By how much gravity is turned, deg, in the direction of +q."""
        mounted = self._solutions[-1]
        return math.degrees(math.atan2(mounted[-2:].sum(), mounted[A4 : A5 + 1].sum()))

    def _solve(self, among: Iterable[int]) -> int:
        """Solve for all readings; return the best of some."""
        solve_readings(self._normals, self._count, max(self._blocks, 1), self._shares, self._solutions)
        return min(among, key=self._rank)
