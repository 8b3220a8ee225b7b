"""Checks the first motion against the configuration: signs, order and scales of the devices.

A horizontal arm at rest shows none of them. In motion, means over blocks of 20 ms show, joint by joint,

    tau_J = k tau_c + x tau_c of the other joint - l dtau_c/dt - R ddq - v dq - c sgn(dq) + offset    by least squares

The sensor sits between motor and link, so k = 1 and x = 0 for any touch and any payload. k = -1 is a sensor that counts
against its drive, k = 2 a torque unit or a torque constant of half or twice the configured one, and k = 0 with x = 1 at
both joints are exchanged drives or sensors. Before the sensor lie l, extra delay of drive and bus, the rotor R, and
friction v, c.

    position    Δq = s ∫ dq dt,  s = 1 if the increments and the velocity unit are as configured

Each joint is judged until its ratios are known well enough. A wrong one stops the arm: `line`. A smaller error gives a
warning, for a torque constant has a tolerance. Until the first certificate `DeviceReadings` fits the arm's own
equation, too, on shorter blocks, which shows joints that are exchanged or reversed as a whole.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.control.device_readings import CORRELATED, DEVIATIONS, RIDGE, DeviceReadings, Reading, TorqueRatio
from adacd_hil.control.geometry_check import EVENT as GEOMETRY
from adacd_hil.control.geometry_check import geometry_event
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_watch import EventSource
from adacd_hil.records import JOINTS, ArmState, Event, SchemeState, Vector
from adacd_hil.scheme.identify.certificate import Certificate
from adacd_hil.scheme.supervisor.supervisor import POWERED
from adacd_hil.settings.configuration import Settings

BLOCK_S, SHORT_BLOCK_S = 0.02, 0.008
_FEWEST_BLOCKS: Final = 20
"""Fewest blocks in motion, per joint: two and a half times the unknowns of the regression."""
_JUDGED_EVERY: Final = 5
_LONGEST_S: Final = 60.0
"""After so long with power, an unknown joint is reported and no longer judged."""
_MOVING_RAD_S: Final = 0.05
"""At a lower speed, friction before the sensor may hold any torque."""
_SURE: Final = 0.06
"""Largest standard deviation of k at which a joint can be judged wrong."""
_KNOWN: Final = 0.02
"""Largest standard deviation of k at which a joint is accepted, and no longer judged."""
_WARNED: Final = 0.15
"""An error of k beyond this is worth a warning: torque constants are within ±10 %."""
_NOTHING: Final = 0.1
"""Largest |k| of a sensor that doesn't measure its joint."""
_LEAST_WAY_RAD: Final = 0.2
"""Shortest way over which a joint's position is compared with its velocity."""
_UNEVEN: Final = 0.1
"""Largest share of Σ Δq² that one scale may leave unexplained: a position that sticks at times leaves a half."""
_ALIGNED: Final = 0.7
"""Correlation of torque and acceleration from which they count as aligned, or opposed."""
_IN_SCALE: Final = 0.95
"""Correlation of commanded and sensed torque from which they differ by a scale only: 0.995 for wrong gears, 0.76 at
most for exchanged drives."""
_FAR: Final = 2.5
"""Sensed over commanded torque from which wrong scales are the likeliest reason of an arm that runs away or lags."""
_EXCHANGES: Final = ("drives", "sensors", "joints")
NO_CAUSE: Final = (
    "the motion contradicts the configuration, for an unknown reason: check nodes, signs and scales of the devices"
)
"""Line of a contradiction that no reading of the devices explains."""
TOO_SHORT: Final = (
    "perhaps a node, sign or scale of the devices is wrong, or something pushed the arm; the motion was too short to "
    "distinguish them"
)
"""Line of an arm that left its limits before the readings could be told apart."""
_OWN, _OTHER = 0, 1
_COLUMNS: Final = 7


def is_shown(event: Event) -> bool:
    """Return whether an event is printed as it happens: one of geometry, or a warning of the first motion."""
    return event.name == GEOMETRY or (event.name == "first motion" and event.level == "warning")


class FirstMotion(EventSource):
    """Compares the arm's first motion with the configured signs, order and scales of its devices.

    `line`: the first contradiction, with its remedy; "" without one.
    """

    def __init__(self, settings: Settings, arm: Arm) -> None:
        """Prepare to judge both joints; with `safety.first_motion_error` = 0, prepare to judge nothing.

        arm: for its drives' limits and gear ratios.
        """
        super().__init__()
        self._arm = arm
        self._settings = settings
        self._error = settings.safety.first_motion_error
        self._period_s = settings.bus.period_s
        # A command of cycle k acts from the next SYNC on, the sample after that shows it; pipelined one later.
        self._commands = np.zeros((4 if settings.bus.is_pipelined else 3, JOINTS))
        self._long, self._short = (_Blocks(span_s, self._period_s) for span_s in (BLOCK_S, SHORT_BLOCK_S))
        self._blocks = self._powered = 0  # powered: cycles
        self._readings: DeviceReadings | None = DeviceReadings(settings) if self._error > 0.0 else None
        # Over short blocks, Σ of ddq², tau_c², tau_J², tau_c ddq, tau_J ddq, tau_c dq, tau_c tau_J.
        self._pushed = np.zeros((7, JOINTS))
        self._normal = np.zeros((JOINTS, _COLUMNS + 1, _COLUMNS + 1))
        self._moving = [0] * JOINTS
        self._path = np.zeros((3, JOINTS))  # Σ Δq ∫ dq dt, Σ (∫ dq dt)², Σ Δq²
        self._way_rad = np.zeros(JOINTS)
        self._open = set(range(JOINTS)) if self._error > 0.0 else set[int]()
        self.is_certified = False
        """Whether a certificate has been compared with the lengths."""
        self.line = ""

    @property
    def is_on(self) -> bool:
        """Return whether joints or hypotheses on the devices are still to be judged, without a contradiction so far."""
        return bool(self._open or self._readings) and not self.line

    def compile_readings(self) -> None:
        """Compile the functions of `DeviceReadings` that `add_cycle` calls."""
        if self._readings is not None:
            self._readings.compile_readings()

    def add_cycle(self, arm: ArmState, state: SchemeState, tau_c: Vector) -> None:
        """Add a cycle to the blocks, and judge the joints; put a contradiction in `line`, remarks in `events`.

        `tau_c` (2,): its commanded torque, Nm. `state`: of the scheme after the cycle before. A cycle without power,
        with missing data or periods, or with a drive at a limit discards the unfinished blocks. Stop judging after
        _LONGEST_S with power.
        """
        if not self.is_on:
            return
        self._powered += arm.periods if state in POWERED else 0
        if self._powered * self._period_s >= _LONGEST_S:
            self._give_up()
            return
        commands = self._commands
        commands[1:] = commands[:-1]
        commands[0] = tau_c
        is_usable = arm.is_complete and arm.periods == 1 and arm.steps == 1 and state in POWERED
        if not is_usable or any(drive.is_limited for drive in self._arm.drives):
            self._long.break_off()
            self._short.break_off()
            return
        acting = commands[-1]
        block = self._long.add_cycle(arm, acting)
        if block is not None:
            self._take_block(block)
        self._read(self._short.add_cycle(arm, acting), state)

    def _read(self, block: "_Block | None", state: SchemeState) -> None:
        """Add a short block, if any, to the hypotheses on the devices; if they refute the settings, fill `line`.

        Drop the hypotheses in MONITOR.
        """
        readings = self._readings
        if readings is None or self.line:
            return
        if state is SchemeState.MONITOR:
            self._readings = None
        elif block is not None:
            readings.add_means(block.q, block.dq, block.ddq, block.tau_J, block.dtau_J)
            ddq, tau_c, tau_J = block.ddq, block.tau_c, block.tau_J
            squares = ddq * ddq, tau_c * tau_c, tau_J * tau_J
            self._pushed += *squares, tau_c * ddq, tau_J * ddq, tau_c * block.dq, tau_c * tau_J
            if readings.judge_blocks(is_torque_known=not self._open):
                self.line = readings.name_causes(self._left()) or NO_CAUSE

    def check_lengths(self, certificates: tuple[Certificate, ...]) -> None:
        """Compare the run's first certificate, if any, with the configured lengths; add the event of `geometry_event`.

        It is a warning if a length or the mounting contradicts the certificate, or an info if a smaller tilt explains
        that or torques can't check a length; otherwise there is none. Set `is_certified` to True, also without a
        certificate.
        """
        self.is_certified = True
        event = geometry_event(self._settings, certificates[0]) if certificates else None
        if event is not None:
            self.events.append(event)

    def suspicion(self) -> str:
        """Return the likely causes of an arm that runs away in its first motion, as text; TOO_SHORT for unknown ones.

        "" if torques and motion have no contrary signs and give an inertia that an arm can have. Also if the motion
        isn't judged, or no longer, or `line` is set already.
        """
        if self._readings is None or self.line:
            return ""
        if scales := self._suspect_scales():
            return scales
        left = [reading for reading in self._left() if reading.kind not in ("scale", "torque", "mounting")]
        ddq, tau_c, tau_J, commanded, sensed, power, *_ = self._pushed
        joint = int(np.argmin(power))  # it drives the other, which is dragged and takes less
        along_c = commanded[joint] / math.sqrt(max(ddq[joint] * tau_c[joint], 1e-12))
        along_J = sensed[joint] / math.sqrt(max(ddq[joint] * tau_J[joint], 1e-12))
        if along_c < -_ALIGNED and abs(along_J) > _ALIGNED:
            kinds = ("motor",) if along_J > 0.0 else ("position", "drive")
            left = [r for r in left if r.kind in _EXCHANGES or (r.kind in kinds and r.joint == joint)]
        elif not self._readings.is_unlike_an_arm():
            return ""
        text = self._readings.name_causes(left)
        return f"perhaps {text.removeprefix('either ')}" if text else TOO_SHORT

    def _left(self) -> list[Reading]:
        """Return the hypotheses on the devices that neither the arm's equation nor torques refute, best first.

        [] with few blocks, if the right one isn't among them (`DeviceReadings.left`), or if they are no longer judged.
        """
        return [] if self._readings is None else self._readings.left(self._ratios(), self._error)

    def _ratios(self) -> list[TorqueRatio | None]:
        """Return each joint's ratios of sensed to commanded torque; None with fewer than _FEWEST_BLOCKS in motion."""
        return [
            ratio_of(self._normal[joint], self._moving[joint]) if self._moving[joint] >= _FEWEST_BLOCKS else None
            for joint in range(JOINTS)
        ]

    def _suspect_scales(self) -> str:
        """Return a text on a joint whose sensor measures `_FAR` times its command or more, or 1 / `_FAR` or less.

        "" without one. Torque and command must be correlated by _IN_SCALE. Of two joints the one that is further off.
        """
        _, tau_c, tau_J, _, _, _, both = self._pushed
        found = [
            (abs(math.log(ratio)), joint, ratio)
            for joint in range(JOINTS)
            if both[joint] > _IN_SCALE * math.sqrt(tau_c[joint] * tau_J[joint])
            and not 1.0 / _FAR < (ratio := both[joint] / tau_c[joint]) < _FAR
        ]
        if not found:
            return ""
        _, joint, ratio = max(found)
        return (
            f"perhaps joint {joint + 1}: its torque sensor measures {ratio:.2g} times the commanded torque: check "
            f"{self._scales(joint)}"
        )

    def _take_block(self, block: "_Block") -> None:
        """Add a long block to the sums by which positions are judged, and for a moving joint also torques.

        Moving: at _MOVING_RAD_S or more on average, and in that direction at both ends of the block. Judge the joints
        at each fifth block, while any is still to be judged.
        """
        self._path += block.travel * block.way, block.way * block.way, block.travel * block.travel
        self._way_rad += np.abs(block.way)
        for joint in range(JOINTS):
            speed, other = block.dq[joint], 1 - joint
            if block.least_speed[joint] > 0.0 and abs(speed) >= _MOVING_RAD_S:
                sign = math.copysign(1.0, speed)
                own, cross, lag = block.tau_c[joint], block.tau_c[other], block.dtau_c[joint]
                row = np.array((own, cross, lag, block.ddq[joint], speed, sign, 1.0, block.tau_J[joint]))
                self._normal[joint] += row[:, np.newaxis] * row
                self._moving[joint] += 1
        self._blocks += 1
        if self._open and self._blocks % _JUDGED_EVERY == 0:
            self._judge()

    def _give_up(self) -> None:
        """Stop judging joints and hypotheses on the devices; add a warning for each joint that is still unknown."""
        for joint in sorted(self._open):
            text = (
                f"joint {joint + 1} is not known after {_LONGEST_S:g} s, since it moves too little, a drive is at a "
                "limit, or cycles are missing: unchecked are its signs, scales of position and velocity, "
                f"{self._scales(joint)}"
            )
            self.events.append(Event("warning", "first motion", text))
        self._open.clear()
        self._readings = None

    def _judge(self) -> None:
        self.line = self._judge_position() or self._judge_torque()

    def _judge_position(self) -> str:
        """Return the contradiction of a joint's position to its velocity, a wrong scale or sign; "" without one.

        "" also for a way below _LEAST_WAY_RAD, and if no single scale explains the way.
        """
        for joint in range(JOINTS):
            if self._way_rad[joint] < _LEAST_WAY_RAD:
                continue
            common, way, travel = self._path[:, joint].tolist()
            ratio = common / way
            if travel - ratio * common > _UNEVEN * travel:
                continue  # the ratio varied during the motion: not a scale
            if not 1.0 - self._error <= ratio <= 1.0 / (1.0 - self._error):
                return (
                    f"joint {joint + 1}: its position moves {ratio:+.2f} times as far as its velocity says, "
                    "+1 expected; correct scale.increments_per_joint_rev or scale.velocity_rad_s of "
                    f"devices.drive[{joint}]"
                )
        return ""

    def _judge_torque(self) -> str:
        """Return the contradiction of a torque sensor to the commands, "" without one; close joints that agree.

        A contradiction: both sensors measure the other joint's torque, or a ratio is surely outside the tolerance of
        `safety.first_motion_error`. The latter doesn't count while the ratio to the other joint's command is over 0.5.
        A joint closes once its ratio's standard deviation is at most _KNOWN, and its way at least _LEAST_WAY_RAD.
        """
        found = self._ratios()
        first, second = found
        if first is not None and second is not None and is_of_other(first) and is_of_other(second):
            head = "joints 1 and 2: each torque sensor measures the commanded torque of the other joint: "
            causes = "" if self._readings is None else self._readings.name_causes(self._left())
            return head + (causes or "the drives or the sensors are exchanged")
        for joint, ratio in enumerate(found):
            if ratio is None or joint not in self._open or ratio.own_std > _SURE:
                continue
            slack = DEVIATIONS * ratio.own_std
            if ratio.own + slack < 1.0 - self._error or ratio.own - slack > 1.0 / (1.0 - self._error):
                if abs(ratio.other) > 0.5:  # perhaps exchanged: the other joint's ratios decide
                    continue
                return self._describe(joint, ratio)
            is_right = 1.0 - self._error <= ratio.own - slack and ratio.own + slack <= 1.0 / (1.0 - self._error)
            if is_right and ratio.own_std <= _KNOWN and self._way_rad[joint] >= _LEAST_WAY_RAD:
                self._close(joint, ratio)
        return ""

    def _close(self, joint: int, ratio: "TorqueRatio") -> None:
        """Stop judging a joint that agrees with the configuration; add an event with its torque ratio.

        The event is a warning if the ratio is more than _WARNED away from 1.
        """
        self._open.remove(joint)
        is_off = abs(ratio.own - 1.0) > _WARNED
        text = (
            f"joint {joint + 1}: its torque sensor measures {ratio.own:.2f} ± {ratio.own_std:.2f} times the commanded "
            f"torque"
        )
        if is_off:
            text += f"; check {self._scales(joint)}"
        self.events.append(Event("warning" if is_off else "info", "first motion", text))

    def _scales(self, joint: int) -> str:
        """Return, as text, the settings that scale a joint's torque, and the motor's torque constant.

        Only gear ratio and rated torque have their values; `scale.gear_efficiency` is left out if the gear ratio is 1.
        """
        gear, rated_Nm = self._arm.gear_ratios[joint], self._settings.arm.rated_torque_Nm[joint]
        gear_text = f"scale.gear_ratio = {gear:g} of devices.drive[{joint}]"
        text = f"scale.torque_Nm of devices.sensor[{joint}], arm.rated_torque_Nm[{joint}] = {rated_Nm:g} Nm"
        if gear == 1.0:
            return f"{text}, {gear_text}, and the motor's torque constant"
        return f"{gear_text}, its scale.gear_efficiency, {text}, and the motor's torque constant"

    def _describe(self, joint: int, ratio: "TorqueRatio") -> str:
        """Return the contradiction of a joint whose torque ratio is wrong: the ratio, likely mistake and remedy."""
        head = f"joint {joint + 1}: its torque sensor measures {ratio.own:+.2f} times the commanded torque"
        if abs(ratio.own) <= _NOTHING:
            return (
                f"{head}, +1 expected, so not its joint's torque: check that the sensor of "
                f"devices.sensor_node[{joint}] is at this joint and measures, and {self._scales(joint)}"
            )
        if ratio.own < 0.0:
            causes = "" if self._readings is None else self._readings.name_causes(self._left())
            either = (
                f"either the sensor of devices.sensor_node[{joint}] or devices.drive_node[{joint}] counts the other way"
            )
            return f"{head}, +1 expected: {causes or either}"
        low, high = 1.0 - self._error, 1.0 / (1.0 - self._error)
        return f"{head}, {low:.2f} to {high:.2f} allowed by safety.first_motion_error; correct {self._scales(joint)}"


class _Block(NamedTuple):
    """Means over a block, (2,) each, and changes per second over it; `travel`: change of q, `way`: ∫ dq dt, rad.

    least_speed: the smaller product of the velocity at an end and `dq`, rad²/s²; negative if the joint has reversed.
    """

    q: Vector
    dq: Vector
    tau_J: Vector
    tau_c: Vector
    ddq: Vector
    dtau_J: Vector
    dtau_c: Vector
    travel: Vector
    way: Vector
    least_speed: Vector


class _Blocks:
    """Forms the means over blocks of consecutive cycles, each `span_s` long."""

    def __init__(self, span_s: float, period_s: float) -> None:
        self._period_s = period_s
        self._cycles = max(2, round(span_s / period_s))
        self._sums, self._first = np.zeros((4, JOINTS)), np.zeros((4, JOINTS))  # q, dq, tau_J, tau_c
        self._seen = 0

    def break_off(self) -> None:
        """Discard the unfinished block, because cycles are missing; the next cycle begins a new block."""
        self._seen = 0

    def add_cycle(self, arm: ArmState, acting: Vector) -> _Block | None:
        """Add a cycle; return the block that it completes, or None. That cycle also begins the next block.

        arm: for q, dq and tau_J. acting (2,): commanded torque that acts in this cycle, Nm.
        """
        last = np.array((arm.q, arm.dq, arm.tau_J, acting))
        if self._seen == 0:
            self._sums[:], self._first = 0.0, last
        self._seen += 1
        self._sums += last
        if self._seen <= self._cycles:
            return None
        first, span_s = self._first, self._cycles * self._period_s
        q, dq, tau_J, tau_c = self._sums / self._seen
        way = (self._sums[1] - 0.5 * (first[1] + last[1])) * self._period_s  # by the trapezoidal rule
        travel, ddq, dtau_J, dtau_c = last - first
        least_speed = np.minimum(first[1] * dq, last[1] * dq)
        self._seen, self._first, self._sums = 1, last, last.copy()
        return _Block(q, dq, tau_J, tau_c, ddq / span_s, dtau_J / span_s, dtau_c / span_s, travel, way, least_speed)


def is_of_other(ratio: TorqueRatio) -> bool:
    """Return whether the sensor measures the other joint's torque instead of its own; False while a ratio is uncertain.

    Instead: |own| < 0.4 and |other| > 0.6. Uncertain: a standard deviation of 2 _SURE or more.
    """
    is_known = max(ratio.own_std, ratio.other_std) < 2.0 * _SURE
    return is_known and abs(ratio.own) < 0.4 and abs(ratio.other) > 0.6


def ratio_of(normal: NDArray[np.float64], blocks: int) -> TorqueRatio:
    """Return a joint's ratios of sensed to commanded torque by its normal equations (8, 8), the torque in the last row.

    blocks: number in which the joint has moved.

    If the motion can't separate unknowns, the ridge shrinks them; the shrinkage is added to their standard deviation.
    """
    A, b, square = normal[:-1, :-1], normal[:-1, -1], float(normal[-1, -1])
    size = np.sqrt(np.maximum(np.diag(A), 1e-12))
    inverse = np.linalg.inv(A / np.outer(size, size) + RIDGE * np.eye(_COLUMNS))
    x = inverse @ (b / size)
    left = max(square - float(x @ (b / size)), 0.0) / max(blocks - _COLUMNS, 1) * CORRELATED
    std = (np.sqrt(left * np.diag(inverse)) + RIDGE * np.abs(inverse) @ np.abs(x)) / size
    own, other = x[:2] / size[:2]
    return TorqueRatio(float(own), float(other), float(std[_OWN]), float(std[_OTHER]))
