"""Detects exchanged, reversed or wrongly scaled devices from the arm's own motion.

A reading is a hypothesis: it gives the true q, tau of the arm from the devices' values, with devices exchanged,
reversed, or in another scale. The equation of a 2R arm, linear in theta, is fitted to each reading, with offsets and
the lag of the torque,

    tau_J = W(q, dq, ddq) theta + offset - l dtau_J/dt

The configuration is refuted if another reading leaves a far smaller share of the squares unexplained and has the
inertia of a possible arm. In 95 scenarios of the package, touched arms included, no other reading leaves less than 0.5
times the configuration's share; of the mistakes below, each leaves 0.1 times or less, a mounting 0.17. A refuted
configuration doesn't yet identify the mistake. One reading is of the mounting: gravity acts in any direction of the
plane of motion, so a4 and a5 have columns of sin(q1 - level_rad), too. A reading is refuted

    by the equation   if it leaves 1 / `_BETTER` times the least share of all, at a likelihood that is at least
                      exp(`_LOG_ODDS`) times smaller, or if its inertia is outside any arm's by `DEVIATIONS` standard
                      deviations: gravity and a short motion leave the inertia open
    by the torques    if sensed over commanded torque differs from its prediction by more than that ratio's error

`left` returns the readings that neither refutes. A single one is certain.

Indistinguishable: an arm without gravity equals its mirror image, so if one of two joints is reversed, the motion can't
show which, nor that both are. If all torques have one wrong scale, the arm seems heavier by it.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np

from adacd_hil import linalg
from adacd_hil.compiled import compiled
from adacd_hil.records import JOINTS, Vector
from adacd_hil.scheme.model.regressor import A1, A2, A3, A4, A5, is_positive_definite, regressor
from adacd_hil.settings.configuration import Settings

_FEWEST_BLOCKS: Final = 15
_BETTER: Final = 0.2
"""Most that the right reading leaves of the configuration's share."""
_EXPLAINED: Final = 0.004
"""Largest unexplained share of the right reading."""
_UNEXPLAINED: Final = 1e-4
"""Unexplained share below which the configuration is accepted: it explains 99 % of the torque. Mistakes leave 2 %."""
_JUDGED_EVERY: Final = 4
_ROUNDS: Final = 3
"""Equal verdicts in a row that are needed."""
_SUSPECT_BLOCKS: Final = 6
CORRELATED: Final = 4.0
"""Number of blocks that count as one: the errors of the equation last longer than a block."""
DEVIATIONS: Final = 5.0
_LOG_ODDS: Final = 7.0
"""Logarithm of 1000 : 1, for blocks of normal errors: n / 2 times the logarithm of the ratio of shares."""
_OTHERS: Final = 0.4
"""Largest difference of a sensor's share of the other joint's command from the predicted one."""
_MOST_NAMED: Final = 8
"""Most causes in one line; if more are left, the motion shows nothing."""
_SHORT: Final = {
    "reversed": "one of the joints reversed (arm.sign)",
    "joints": "joints exchanged (devices.drive_node and devices.sensor_node)",
    "drives": "drives exchanged (devices.drive_node)",
    "sensors": "torque sensors exchanged (devices.sensor_node)",
    "position": "encoder of joint {joint} reversed (devices.drive_node[{place}])",
    "sensor": "torque sensor of joint {joint} reversed (devices.sensor_node[{place}])",
    "motor": "motor of joint {joint} reversed (devices.drive_node[{place}])",
    "reaction": "both torque sensors reversed (devices.sensor_node)",
    "encoders": "both encoders reversed (devices.drive_node)",
    "drive": "encoder and motor of joint {joint} reversed (devices.drive_node[{place}])",
    "scale": "gear of joint {joint} wrong, it turns about {turns:g} times as far (devices.drive[{place}])",
    "torque": "scale of a torque sensor wrong (devices.sensor[0] or devices.sensor[1])",
    "mounting": "mounting wrong, link 1 hangs at about q1 = {hangs:.0f} deg (arm.mounting_deg[1] or arm.zero_deg[0])",
}
"""Text of each cause in a list, by kind."""
RIDGE: Final = 1e-9
"""Ridge of the scaled equations, which sets parameters that the motion doesn't show to 0."""
_MOUNTING_BLOCKS: Final = 60
"""With fewer blocks, a small motion hardly tells gravity from an offset: two more parameters explain any torque."""
_TURNED_DEG: Final = 10.0
"""Smallest error of a mounting angle that is reported."""
_SCALES: Final = (0.5, 0.67, 0.8, 1.25, 1.5, 2.0)


class TorqueRatio(NamedTuple):
    """Sensed torque over the torque commanded to its own joint's drive, and to the other's; standard deviations."""

    own: float
    other: float
    own_std: float
    other_std: float


class Reading(NamedTuple):
    """A hypothesis on how the devices are connected and scaled. kind: of its text, or "configured": no mistake.

    position, torque, motor: factors on measured position and torque, and on commanded torque, by joint; -1: reversed.
    is_turned: gravity acts in any direction, since the mounting is wrong.
    """

    kind: str
    is_drive_exchanged: bool = False
    is_sensor_exchanged: bool = False
    position: tuple[float, float] = (1.0, 1.0)
    torque: tuple[float, float] = (1.0, 1.0)
    motor: tuple[float, float] = (1.0, 1.0)
    is_turned: bool = False

    @property
    def joint(self) -> int:
        """Return the joint, 0 or 1, whose factors this hypothesis changes; 0 if both joints', 1 if none."""
        return 0 if (self.position[0], self.torque[0], self.motor[0]) != (1.0, 1.0, 1.0) else 1

    def allows(self, found: Sequence[TorqueRatio | None], error: float) -> bool:
        """Return whether this hypothesis predicts the found ratios of sensed to commanded torque, by node.

        None: unknown. error: possible relative error of a torque constant or a scale, 0 to 1. A wrong scale of torque
        predicts any ratio of the right sign.
        """
        for i in range(JOINTS):
            drive, sensor = 1 - i if self.is_drive_exchanged else i, 1 - i if self.is_sensor_exchanged else i
            ratio = found[sensor]
            if ratio is None:
                continue
            sign = math.copysign(1.0, self.motor[i] * self.torque[i])
            own, other, own_std, other_std = ratio
            own, other = sign * own, sign * other
            if drive != sensor:
                own, other, own_std, other_std = other, own, other_std, own_std
            low, high = (0.0, math.inf) if self.kind == "torque" else (1.0 - error, 1.0 / (1.0 - error))
            slack, cross_slack = DEVIATIONS * own_std, DEVIATIONS * other_std
            if own + slack < low or own - slack > high or abs(other) > _OTHERS + cross_slack:
                return False
        return True

    @property
    def row(self) -> tuple[float, ...]:
        """Return the hypothesis as numbers (7,) for `add_block`: both exchanges, `position`, `torque`, `is_turned`."""
        return (self.is_drive_exchanged, self.is_sensor_exchanged, *self.position, *self.torque, self.is_turned)


READINGS: Final = (
    Reading("configured"),
    Reading("reversed", position=(1.0, -1.0), torque=(1.0, -1.0), motor=(1.0, -1.0)),
    Reading("joints", True, True),
    Reading("joints", True, True, (1.0, -1.0), (1.0, -1.0), (1.0, -1.0)),
    Reading("drives", is_drive_exchanged=True),
    Reading("sensors", is_sensor_exchanged=True),
    Reading("position", position=(-1.0, 1.0)),
    Reading("position", position=(1.0, -1.0)),
    Reading("sensor", torque=(-1.0, 1.0)),
    Reading("sensor", torque=(1.0, -1.0)),
    Reading("motor", motor=(-1.0, 1.0)),
    Reading("motor", motor=(1.0, -1.0)),
    Reading("reaction", torque=(-1.0, -1.0)),
    Reading("encoders", position=(-1.0, -1.0)),
    Reading("drive", position=(-1.0, 1.0), motor=(-1.0, 1.0)),
    Reading("drive", position=(1.0, -1.0), motor=(1.0, -1.0)),
    *(Reading("scale", position=(factor, 1.0)) for factor in _SCALES),
    *(Reading("scale", position=(1.0, factor)) for factor in _SCALES),
    *(Reading("torque", torque=(1.0, factor)) for factor in _SCALES),
)
_MOUNTED: Final = Reading("mounting", is_turned=True)


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
    """Add a block's means (2,) to the normal equations (h, k, k) of each hypothesis on the devices, `readings` (h, 7).

    `normals`: these equations. k = p + 5, or p + 7 with gravity: theta (p = count), two offsets, two lags, a4 and a5 of
    another direction, torque. Only a hypothesis with `is_turned` fills the columns of another direction. A row of
    `readings` is a `Reading.row`. `level_rad`: q1 at which link 1 is level.
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
    """Solve the normal equations (h, k, k) of each hypothesis; fill `shares` (h,), `solutions` (h, k - 1) in place.

    count: parameters p. blocks: number in the equations. shares: unexplained part of the squares of the torques less
    their means. By Cholesky factors of the equations, scaled to a diagonal of ones.
    """
    size = normals.shape[1] - 1
    L, x, unit = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    for h in range(normals.shape[0]):
        N = normals[h]
        for a in range(size):
            unit[a] = math.sqrt(max(N[a, a], 1e-12))
        for a in range(size):
            x[a] = N[a, size] / unit[a]
            for b in range(a + 1):
                L[a, b] = N[a, b] / (unit[a] * unit[b]) + (RIDGE if a == b else 0.0)
        linalg.factor(L, 1e-15)
        linalg.solve_lower(L, x)
        explained = linalg.dot(x, x)
        linalg.solve_upper(L, x)
        solutions[h] = x / unit
        spread = N[size, size]
        for i in range(JOINTS):
            spread -= N[count + i, size] ** 2 / blocks
        shares[h] = max(N[size, size] - explained, 0.0) / max(spread, 1e-12)


class DeviceReadings:
    """Fits the arm's equation to a motion under each hypothesis (`Reading`); names those that it doesn't refute.

    The motion comes as means over blocks.
    """

    def __init__(self, settings: Settings) -> None:
        """Prepare the normal equations of all hypotheses, without blocks; with gravity also of a wrong mounting."""
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
        self._refuted = 0  # rounds in a row in which the configuration was refuted

    def compile_readings(self) -> None:
        """Compile the functions that add and judge blocks, by calls on copies."""
        zero = np.zeros(JOINTS)
        add_block(self._rows, zero, zero, zero, zero, zero, self._level_rad, self._count, self._normals.copy())
        solve_readings(self._normals, self._count, 1, self._shares.copy(), self._solutions.copy())
        is_positive_definite(self._solutions[0])

    def add_means(self, q: Vector, dq: Vector, ddq: Vector, tau_J: Vector, dtau_J: Vector) -> None:
        """Add the means of a block of cycles, (2,) each, to the normal equations of all hypotheses."""
        add_block(self._rows, q, dq, ddq, tau_J, dtau_J, self._level_rad, self._count, self._normals)
        self._blocks += 1

    def judge_blocks(self, is_torque_known: bool) -> bool:
        """Return whether the configuration is refuted: another hypothesis was far better `_ROUNDS` times in a row.

        Far better: the configuration leaves `_UNEXPLAINED` or more, the other at most `_BETTER` of that, and at most
        `_EXPLAINED`. Judge at every fourth block from `_FEWEST_BLOCKS` on, return False between. is_torque_known: the
        commanded torques have confirmed the sensors' scales; without that a wrong scale of torque as the best
        hypothesis gives False.
        """
        if self._blocks < _FEWEST_BLOCKS or self._blocks % _JUDGED_EVERY:
            return False
        best = self._solve(range(1, len(self._readings)))
        bound = min(_BETTER * float(self._shares[0]), _EXPLAINED)
        is_refuted = self._shares[0] >= _UNEXPLAINED and self._rank(best) <= bound
        self._refuted = self._refuted + 1 if is_refuted else 0
        return self._refuted >= _ROUNDS and (is_torque_known or self._readings[best].kind != "torque")

    def left(self, found: Sequence[TorqueRatio | None], error: float) -> list[Reading]:
        """Return the hypotheses that no equation, inertia or torque refutes, best first, one of each kind and joint.

        found: ratios of the torque sensors, by node; None: unknown. error: possible relative error of a scale. Empty
        with fewer than _SUSPECT_BLOCKS blocks, or if the best hypothesis of all is refuted but explains far more than
        the others: then the right one is not among them.
        """
        if self._blocks < _SUSPECT_BLOCKS:
            return []
        self._solve(())
        allowed = [
            place
            for place, reading in enumerate(self._readings)
            if self._is_distinct(place) and reading.allows(found, error)
        ]
        possible = [place for place, is_arm in zip(allowed, self._may_be_arms(allowed), strict=True) if is_arm]
        possible.sort(key=lambda place: float(self._shares[place]))
        least = min(self._shares[place] for place in range(len(self._readings)) if self._is_distinct(place))
        odds = math.exp(min(2.0 * _LOG_ODDS * CORRELATED / self._freedom, 50.0))
        left = [place for place in possible if self._shares[place] <= max(1.0 / _BETTER, odds) * least]
        texts: dict[tuple[str, int], Reading] = {}
        for place in left:
            texts.setdefault((self._readings[place].kind, self._readings[place].joint), self._readings[place])
        return list(texts.values())

    def is_unlike_an_arm(self) -> bool:
        """Return whether the configured devices give an inertia that no arm has: one that isn't positive definite.

        True also with fewer than _SUSPECT_BLOCKS blocks, which are too few to know. Solves the equations of all
        hypotheses anew.
        """
        self._solve(())
        return 0 < self._blocks < _SUSPECT_BLOCKS or not is_positive_definite(self._solutions[0])

    def name_causes(self, left: Sequence[Reading]) -> str:
        """Return a text of the causes left, their unexplained shares and remedies.

        left: hypotheses, the result of the method `left`. "" if they are none but the configuration, more than
        _MOST_NAMED, or none that leaves at most _EXPLAINED unexplained: then the cause is not among them, or there are
        several.
        """
        wrong = [reading for reading in left if reading.kind != "configured"]
        places = [self._readings.index(reading) for reading in wrong]
        if not wrong or len(wrong) > _MOST_NAMED or min(self._shares[places]) > _EXPLAINED:
            return ""
        shares = 100.0 * np.sqrt(self._shares[[0, *places]])
        unexplained = f"unexplained of the torque: {shares[0]:.1f} % as configured"
        if len(wrong) == 1:
            return f"{self._text(wrong[0])} ({unexplained}, {shares[1]:.1f} % so)"
        names = [
            _SHORT[reading.kind].format(
                joint=reading.joint + 1,
                place=reading.joint,
                turns=reading.position[reading.joint],
                hangs=self._hangs_deg,
            )
            for reading in wrong
        ]
        texts = " or ".join(f"{name}: {so:.1f} %" for name, so in zip(names, shares[1:], strict=True))
        return f"either {texts}; the motion can't distinguish them ({unexplained})"

    def _text(self, reading: Reading) -> str:
        """Return the text of one cause, by the hypothesis's kind and joint: the mistake, and the way to correct it."""
        sign, joint = list(self._settings.arm.sign), reading.joint
        drives, sensors = list(self._settings.devices.drive_node), list(self._settings.devices.sensor_node)
        drive, sensor = f"devices.drive_node[{joint}]", f"devices.sensor_node[{joint}]"
        return {
            "joints": (
                "joints 1 and 2 are exchanged, drives and sensors: exchange devices.drive_node and devices.sensor_node"
            ),
            "drives": f"the drives of joints 1 and 2 are exchanged: exchange devices.drive_node = {drives}",
            "sensors": f"the sensors of joints 1 and 2 are exchanged: exchange devices.sensor_node = {sensors}",
            "reversed": (
                f"joint 2 turns the other way than arm.sign = {sign} says, if joint 1 is right: arm.sign = "
                f"{[sign[0], -sign[1]]}, or {[-sign[0], sign[1]]} if it is joint 1"
            ),
            "position": (
                f"joint {joint + 1}: its position counts against its torques: reverse the encoder of {drive}, or its "
                f"motor and torque sensor and arm.sign[{joint}] = {sign[joint]}"
            ),
            "sensor": f"joint {joint + 1}: its torque sensor counts against its drive: reverse the sensor of {sensor}",
            "reaction": (
                f"both torque sensors count against their drives: reverse those of devices.sensor_node = {sensors}, "
                "and both of arm.sign if it is the drives"
            ),
            "encoders": f"both positions count against their torques: reverse those of devices.drive_node = {drives}",
            "motor": (
                f"joint {joint + 1}: its motor counts against its encoder and sensor: reverse the motor of {drive}, or "
                f"its encoder and torque sensor and arm.sign[{joint}] = {sign[joint]}"
            ),
            "drive": (
                f"joint {joint + 1}: its encoder and motor count against its torque sensor: reverse both of {drive}, "
                f"or the sensor of {sensor} and arm.sign[{joint}] = {sign[joint]}"
            ),
            "scale": (
                f"joint {joint + 1} turns about {reading.position[joint]:g} times as far as position and velocity say: "
                "correct its gear: scale.gear_ratio, scale.increments_per_joint_rev and scale.velocity_rad_s of "
                f"devices.drive[{joint}]"
            ),
            "torque": (
                f"the torque sensor of joint 2 measures about {1.0 / reading.torque[1]:+.2g} times what that of joint "
                "1 would: correct scale.torque_Nm of devices.sensor[0] or devices.sensor[1]"
            ),
            "mounting": self._mounting_text(),
        }[reading.kind]

    def _mounting_text(self) -> str:
        return (
            f"gravity acts as if link 1 hung at about q1 = {self._hangs_deg:.0f} deg: correct the mounting, "
            f"arm.mounting_deg[1] = {self._settings.mounting_deg[1]:g} deg, or arm.zero_deg[0] if the angle is wrong"
        )

    @property
    def _hangs_deg(self) -> float:
        """Return the q1, deg in [-180, 180), at which link 1 hangs down if the configured mounting is wrong.

        It is the mounting's angle, turned as the hypothesis of a wrong mounting turns gravity in its last solution.
        """
        return (self._settings.mounting_deg[1] + self._turned_deg + 180.0) % 360.0 - 180.0

    @property
    def _freedom(self) -> int:
        """Return the number of measured torques less that of the equation's unknowns, at least 1."""
        return max(JOINTS * self._blocks - (self._normals.shape[1] - 1), 1)

    def _rank(self, place: int) -> float:
        """Return the unexplained share of a hypothesis, by index, of the last solution; the lower the better.

        inf if its inertia isn't positive definite, or it can't be distinguished from the configuration.
        """
        is_right = self._is_distinct(place) and is_positive_definite(self._solutions[place])
        return float(self._shares[place]) if is_right else math.inf

    def _is_distinct(self, place: int) -> bool:
        """Return whether the data can distinguish a hypothesis from the configuration, by its index.

        False for turned gravity with fewer than _MOUNTING_BLOCKS blocks, or turned by less than _TURNED_DEG.
        """
        if not self._readings[place].is_turned:
            return True
        return self._blocks >= _MOUNTING_BLOCKS and abs(self._turned_deg) >= _TURNED_DEG

    @property
    def _turned_deg(self) -> float:
        """Return the angle, deg, toward +q, by which the hypothesis of a wrong mounting turns gravity.

        It is the last hypothesis; its solution is the last one of `_solve`.
        """
        mounted = self._solutions[-1]
        return math.degrees(math.atan2(mounted[-2:].sum(), mounted[A4 : A5 + 1].sum()))

    def _may_be_arms(self, places: Sequence[int]) -> list[bool]:
        """Return for each index of a hypothesis whether its inertia, within its error, is that of a possible arm."""
        normals = self._normals[list(places), :-1, :-1]
        size = np.sqrt(np.maximum(np.diagonal(normals, axis1=1, axis2=2), 1e-12))
        scaled = normals / (size[:, :, np.newaxis] * size[:, np.newaxis, :])
        inverse = np.diagonal(np.linalg.inv(scaled + RIDGE * np.eye(scaled.shape[1])), axis1=1, axis2=2)
        spread = self._normals[list(places), -1, -1]
        left = np.maximum(self._shares[list(places)] * spread, 1e-12) / self._freedom * CORRELATED
        slack = DEVIATIONS * np.sqrt(left[:, np.newaxis] * np.maximum(inverse, 0.0)) / size
        return [may_be_arm(self._solutions[place], slack[row]) for row, place in enumerate(places)]

    def _solve(self, among: Iterable[int]) -> int:
        """Solve all hypotheses anew; return that of the indices `among` that has the least `_rank`, 0 if empty."""
        solve_readings(self._normals, self._count, max(self._blocks, 1), self._shares, self._solutions)
        return min(among, key=self._rank, default=0)


def may_be_arm(theta: Vector, slack: Vector) -> bool:
    """Return whether M(q) is positive definite, for all q, with some parameters within `slack` (p,) of theta (p,)."""
    a1, a2 = theta[A1] + slack[A1], max(abs(theta[A2]) - slack[A2], 0.0)
    a3 = min(max(0.5 * a1, theta[A3] - slack[A3]), theta[A3] + slack[A3])
    return bool(a3 > 0.0 and a3 * (a1 - a3) > a2**2)
