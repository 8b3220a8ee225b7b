"""One tare from the boot of the devices to the solved offsets; the drives stay disabled throughout."""

import contextlib
import dataclasses
import getpass
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adacd_hil import __version__
from adacd_hil.clock import Clock, wall_ns
from adacd_hil.control.session import git_commit
from adacd_hil.control.tare_file import TARE_FORMAT, PoseRecord, SensorRecord, Tare, sensor_identities
from adacd_hil.dates import format_date
from adacd_hil.device.arm import Arm
from adacd_hil.device.canopen_bus import CanopenBus, DeviceError, as_device_error
from adacd_hil.device.network import ENTER_PRE_OPERATIONAL, START, Identity, Master
from adacd_hil.device.profile import PlacedDevice
from adacd_hil.lab.commission.communication_test import ZeroTorqueLoop
from adacd_hil.lab.commission.tare import (
    ArmMovedError,
    Pose,
    TareRefusedError,
    TareSolution,
    check_motion,
    check_plan,
    measure_pose,
    solve_tare,
)
from adacd_hil.records import JOINT_NAMES, ArmState, Vector
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.bus import Bus, BusError, Tap
from adacd_hil.wire.codec import Codec

AUTO_ZERO = (0x6125, 1)
AUTO_ZERO_SIGNATURE = b"zero"
"""0x6F72657A, CiA 404: the signature that 0x6125 (auto-zero) requires."""
AUTO_ZERO_CYCLES = 64
"""Samples that an emulated sensor averages for its zero."""
_AUTO_ZERO_WAIT_CYCLES = 2 * AUTO_ZERO_CYCLES
_TEMPERATURE = (0x2111, 0)  # i16, 0.01 °C; of sensors of our own kind
_OWN_VENDOR = int.from_bytes(b"ADAC", "big")


@dataclass
class TareSession:
    """One tare on one bus. Raises ConfigError if the settings allow none, or none with is_auto_zeroing.

    `clock` is a VirtualClock in lockstep and a MonotonicClock in real time. old_offset_Nm: offsets before, for the
    record. is_auto_zeroing: the sensors set their own zero first. progress: called with a line at each step.
    """

    settings: Settings
    codec: Codec
    devices: Sequence[PlacedDevice]
    bus: Bus
    clock: Clock
    interface: str
    old_offset_Nm: tuple[float, float]
    is_auto_zeroing: bool = False
    progress: Callable[[str], None] = lambda _: None
    _is_interrupted: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        check_plan(self.settings)
        if self.is_auto_zeroing and self.settings.estimator.gravity:
            raise ConfigError("--auto-zero needs vertical joint axes, but `estimator.gravity` = true")
        # Nothing subtracted: tau_J is the sensor's value in joint direction.
        arm = dataclasses.replace(self.settings.arm, torque_offset_Nm=(0.0, 0.0))
        tap = Tap(self.bus, self.clock)
        self._arm = Arm(dataclasses.replace(self.settings, arm=arm), self.codec, self.devices, tap)
        self._master = Master(self.settings, self.codec, self.devices, tap)
        self._canopen = CanopenBus(self.bus)
        self._loop = ZeroTorqueLoop(self.settings, tap, self.clock, self._arm, self._master)
        self._period_s = self.settings.bus.period_s

    def interrupt(self) -> None:
        """Make `run` end at its next cycle, with KeyboardInterrupt. Safe in a signal handler."""
        self._is_interrupted = True

    def run(self) -> Tare:
        """Boot the devices, measure the poses, solve for the offsets; return the tare. Writes no file.

        With `is_auto_zeroing` the sensors set their own zero before the first pose. Once the devices are set up, stops
        the nodes at the end, also after an error. Raises TareRefusedError for data or motion that allow no tare,
        DeviceError if a device is missing or refuses its set-up, BusError if the bus fails, KeyboardInterrupt after
        `interrupt`.
        """
        self.progress(f"looking for the arm on {self.bus.channel}")
        self._master.reset()
        sensors = sensor_identities(self._master.identify())
        self._master.configure()
        nodes = [self._canopen.add_node(sensor.node_id, None) for sensor in sensors]
        temperatures = [self._read_temperature(node, sensor) for node, sensor in zip(nodes, sensors, strict=True)]
        try:
            self._master.start()
            self._await_data()
            if self.is_auto_zeroing:
                self._auto_zero(nodes, sensors)
            poses = self._measure_poses()
        finally:
            with contextlib.suppress(BusError):  # the error that broke the bus is being raised already
                self._master.stop()
        return self._describe(poses, solve_tare(poses, self.settings), sensors, temperatures)

    def _read_temperature(self, node: Any, sensor: Identity) -> float | None:
        """Read the sensor's temperature, °C; None for another maker's sensor, or one that refuses or doesn't answer."""
        if sensor.vendor != _OWN_VENDOR:
            return None
        try:
            with as_device_error(sensor.name, sensor.node_id, "temperature"):
                data: bytes = node.sdo.upload(*_TEMPERATURE)
        except DeviceError:
            return None
        return int.from_bytes(data[:2], "little", signed=True) * 0.01

    def _step(self) -> ArmState:
        """Run one cycle at zero torque; return the arm's state.

        Raises KeyboardInterrupt after `interrupt`, BusError if the bus fails.
        """
        if self._is_interrupted:
            raise KeyboardInterrupt
        return self._loop.step().state

    def _cycles(self, duration_s: float) -> int:
        return max(1, round(duration_s / self._period_s))

    def _await_data(self) -> None:
        """Run cycles until those of `safety.commission_s` in a row have complete data.

        Raises TareRefusedError if they haven't within `safety.phase_timeout_s` more.
        """
        safety = self.settings.safety
        good, enough = 0, self._cycles(safety.commission_s)
        for _ in range(enough + self._cycles(safety.phase_timeout_s)):
            good = good + 1 if self._step().is_complete else 0
            if good == enough:
                return
        missing = ", ".join(self._arm.missing_names()) or "now and then a device"
        raise TareRefusedError(
            f"data are missing from {missing}: no {safety.commission_s:g} s of complete cycles within "
            f"safety.phase_timeout_s = {safety.phase_timeout_s:g} s"
        )

    def _measure_poses(self) -> list[Pose]:
        tare = self.settings.tare
        self.progress(f"pose 1 of {tare.poses}: measuring for {tare.window_s:g} s, keep off the arm")
        poses = [self._measure()]
        for number in range(2, tare.poses + 1):
            self.progress(f"pose {number - 1} of {tare.poses}: {_describe_pose(poses[-1])}")
            poses.append(self._measure_next_pose(poses[-1], number))
        self.progress(f"pose {tare.poses} of {tare.poses}: {_describe_pose(poses[-1])}")
        return poses

    def _measure_next_pose(self, last: Pose, number: int) -> Pose:
        """Ask the user to move the arm, wait until it has left the last pose and rests, and measure a pose.

        If the arm moves meanwhile, wait again. Raises TareRefusedError after `tare.move_timeout_s` of waiting in all,
        or as `_measure`. number: of the pose, from 1.
        """
        tare = self.settings.tare
        self.progress(
            f"pose {number} of {tare.poses}: move a joint by hand by more than {tare.move_deg:g} deg, then let go"
        )
        cycles_left = self._cycles(tare.move_timeout_s)
        while True:
            cycles_left = self._await_rest(last, number, cycles_left)
            try:
                return self._measure()
            except ArmMovedError as reason:
                self.progress(f"pose {number} of {tare.poses}: {reason}; let go of it")

    def _await_rest(self, last: Pose, number: int, cycles_left: int) -> int:
        """Wait until the arm has left the last pose and rests for `tare.settle_s`; return the cycles then left to wait.

        cycles_left: most cycles to wait. Raises TareRefusedError when they are used up.
        """
        tare = self.settings.tare
        settle_cycles = self._cycles(tare.settle_s)
        has_moved = False
        rest: list[ArmState] = []
        while cycles_left > 0:
            cycles_left -= 1
            state = self._step()
            distance_deg = np.degrees(np.abs(state.q - last.q))
            is_away = bool(distance_deg.max() > tare.move_deg)
            if is_away and not has_moved:
                has_moved = True
                joint = JOINT_NAMES[int(distance_deg.argmax())]
                self.progress(f"pose {number} of {tare.poses}: {joint} has moved, waiting until the arm rests")
            rest.append(state)
            if not is_away or not self._is_at_rest(rest[0].q, state):
                rest.clear()
            elif len(rest) >= settle_cycles:
                return cycles_left
        what = "come to rest" if has_moved else f"been moved by more than tare.move_deg = {tare.move_deg:g} deg"
        raise TareRefusedError(
            f"the arm has not {what} within tare.move_timeout_s = {tare.move_timeout_s:g} s for pose {number}"
        )

    def _is_at_rest(self, start: Vector, state: ArmState) -> bool:
        try:
            check_motion(np.array((start, state.q)), np.array((state.dq, state.dq)), self.settings)
        except ArmMovedError:
            return False
        return state.is_complete

    def _measure(self) -> Pose:
        """Run cycles for `tare.window_s`; return the pose.

        Raises ArmMovedError for motion, TareRefusedError for missing or old values, a sensor's error, noise or drift.
        """
        settings = self.settings
        cycles = self._cycles(settings.tare.window_s)
        states: list[ArmState] = []
        for _ in range(cycles):
            state = self._step()
            self._check_data(state)
            if state.is_complete:
                check_motion(state.q, state.dq, settings)
                states.append(state)
        missing = 1.0 - len(states) / cycles
        if missing > settings.tare.missing_limit:
            raise TareRefusedError(
                f"{missing:.1%} of the cycles lacked frames or had wrong ones, more than tare.missing_limit = "
                f"{settings.tare.missing_limit:.1%}"
            )
        q, dq, tau_J = (np.array([getattr(state, name) for state in states]) for name in ("q", "dq", "tau_J"))
        return measure_pose(q, dq, tau_J, settings)

    def _check_data(self, state: ArmState) -> None:
        """Raise TareRefusedError if a sensor's status isn't zero, or a value is older than `bus.max_age_cycles`."""
        for sensor in self._arm.sensors:
            if sensor.status:
                flags = ", ".join(str(flag.name) for flag in sensor.status)
                raise TareRefusedError(f"{sensor.name} reports {flags} (0x6150 = {int(sensor.status)})")
        bound = self.settings.bus.max_age_cycles
        names = [drive.name for drive in self._arm.drives] + [sensor.name for sensor in self._arm.sensors]
        for name, age in zip(names, (*state.age_q, *state.age_tau_J), strict=True):
            if age > bound:
                raise TareRefusedError(f"{name} has sent nothing usable for {age} cycles, bus.max_age_cycles = {bound}")

    def _auto_zero(self, nodes: list[Any], sensors: tuple[Identity, ...]) -> None:
        """Let the sensors set their own zero at rest, in pre-operational; measure before and after it, and report both.

        Raises TareRefusedError as `_measure`, before and after; if the arm isn't unloaded before; or if more torque
        than `tare.auto_zero_limit_Nm` is left after. Raises DeviceError if a sensor refuses or doesn't answer.
        """
        before = self._measure()
        solve_tare([before], self.settings)  # refuse if the arm is pushed
        for node, sensor in zip(nodes, sensors, strict=True):
            # adacd-sensors refuse it in Operational, where their values are in use.
            self._canopen.command(ENTER_PRE_OPERATIONAL, sensor.node_id)
            with as_device_error(sensor.name, sensor.node_id, "auto-zero"):
                node.sdo.download(*AUTO_ZERO, AUTO_ZERO_SIGNATURE)
            self._canopen.command(START, sensor.node_id)
        for _ in range(_AUTO_ZERO_WAIT_CYCLES):
            self._step()
        after = self._measure()
        bound = self.settings.tare.auto_zero_limit_Nm
        for name, left in zip(JOINT_NAMES, after.mean_Nm, strict=True):
            if not abs(left) <= bound:
                raise TareRefusedError(
                    f"tau_J[{name}] = {left:.4g} Nm after the sensor's own zero exceeds tare.auto_zero_limit_Nm = "
                    f"{bound:g} Nm"
                )
        self.progress(f"sensors zeroed: {_pair(before.mean_Nm)} Nm before, {_pair(after.mean_Nm)} Nm after")

    def _describe(
        self,
        poses: list[Pose],
        solution: TareSolution,
        sensors: tuple[Identity, ...],
        temperatures: list[float | None],
    ) -> Tare:
        settings = self.settings
        samples = sum(pose.samples for pose in poses)
        sensor1, sensor2 = (
            SensorRecord(**identity._asdict(), temperature_C=temperature)
            for identity, temperature in zip(sensors, temperatures, strict=True)
        )
        return Tare(
            format=TARE_FORMAT,
            offset_Nm=_floats(solution.offset_Nm),
            standard_error_Nm=_floats(solution.standard_error_Nm),
            spread_Nm=_floats(solution.spread_Nm),
            old_offset_Nm=self.old_offset_Nm,
            sign=settings.arm.sign,
            mounting_deg=settings.mounting_deg if settings.estimator.gravity else None,
            zero_deg=settings.arm.zero_deg if settings.estimator.gravity else None,
            is_auto_zeroed=self.is_auto_zeroing,
            gravity_model=settings.tare.gravity_model if settings.estimator.gravity else "none",
            gravity_Nm=_floats(solution.gravity_Nm),
            condition=solution.condition,
            samples=samples,
            duration_s=samples * self._period_s,
            date_utc=format_date(wall_ns()),
            user=_user(),
            host=platform.node(),
            interface=self.interface,
            channel=self.bus.channel,
            config=settings.name,
            profile=settings.arm.profile,
            wire_version=self.codec.wire_version,
            layout_digest=f"0x{self.codec.layout_digest:08X}",
            version=__version__,
            git=git_commit(),
            sensor1=sensor1,
            sensor2=sensor2,
            poses=tuple(
                PoseRecord(
                    q_rad=_floats(pose.q),
                    mean_Nm=_floats(pose.mean_Nm),
                    std_Nm=_floats(pose.std_Nm),
                    peak_to_peak_Nm=_floats(pose.peak_to_peak_Nm),
                    drift_Nm=_floats(pose.drift_Nm),
                    residual_Nm=_floats(residual),
                    samples=pose.samples,
                )
                for pose, residual in zip(poses, solution.residual_Nm, strict=True)
            ),
        )


def _floats(values: Vector) -> tuple[float, float]:
    first, second = values.tolist()
    return first, second


def _pair(values: Vector) -> str:
    return ", ".join(f"{value:+.4f}" for value in values)


def _describe_pose(pose: Pose) -> str:
    q1, q2 = np.degrees(pose.q)
    return f"q = {q1:.1f}, {q2:.1f} deg; tau_J = {_pair(pose.mean_Nm)} Nm; {pose.samples} samples"


def _user() -> str:
    """Return the name of the user who runs this; "" if the system doesn't know it."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return ""
