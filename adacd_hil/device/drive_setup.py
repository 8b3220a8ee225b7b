"""What a drive must be and be told before cyclic synchronous torque. Source: CiA 402-2 / IEC 61800-7-201."""

import math

from adacd_hil.device.drive import MODE_CYCLIC_SYNCHRONOUS_TORQUE, option_codes, torque_limit_permille
from adacd_hil.device.slave import Slave
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.codec import Codec

_CST_SUPPORTED = 1 << 9  # of 0x6502
_MODE_READS = 20
"""A drive may take a few of its own cycles to show a new mode; an SDO takes 0.3 ms at 1 Mbit/s at the least."""


def command_deadline_ms(settings: Settings) -> int:
    """Return the deadline of commands in ms, for drives that count time instead of SYNCs."""
    return max(1, math.ceil(settings.bus.command_patience_cycles * settings.bus.period_us / 1000))


def set_up_drive(slave: Slave, settings: Settings, codec: Codec) -> None:
    """Check what the drive is, write limits, option codes and mode. Raises DeviceError."""
    arm, joint, profile = settings.arm, slave.device.joint, slave.device.settings
    if slave.has(0x6502):
        modes = slave.read(0x6502)
        if not modes & _CST_SUPPORTED:
            slave.fail(f"supported modes 0x6502 = 0x{modes:08X}, bit 9 (cyclic synchronous torque) expected")
    if slave.has(0x6076):
        slave.expect(0x6076, 0, round(arm.rated_torque_Nm[joint] * 1000), "rated torque", "mNm")
    _check_resolution(slave, codec)
    if slave.device.can("option_codes"):
        quick_stop, fault_reaction = option_codes(settings, profile)
        for index, value in ((0x605A, quick_stop), (0x605E, fault_reaction)):
            if value is not None and slave.has(index):
                slave.write_checked(index, 0, value)
    if slave.device.can("torque_limits"):
        for index in (0x6072, 0x60E0, 0x60E1):
            if slave.has(index):
                slave.write_checked(index, 0, torque_limit_permille(settings, joint), "per mille")
    if profile.command_watchdog == "0x2200":
        slave.write_checked(0x2200, 0, settings.bus.command_patience_cycles, "SYNCs")
    if slave.device.can("sync_tolerance"):
        slave.write_checked(0x2201, 0, round(10 * settings.bus.sync_patience_periods), "tenths of a period")
    _enter_mode(slave)


def _check_resolution(slave: Slave, codec: Codec) -> None:
    """Compare encoder and gear, where the EDS has both, with what the contract makes of an increment."""
    if not all(slave.has(index, sub) for index in (0x608F, 0x6091) for sub in (1, 2)):
        return
    increments, motor_revs = slave.read(0x608F, 1), slave.read(0x608F, 2)
    gear_in, gear_out = slave.read(0x6091, 1), slave.read(0x6091, 2)
    feedback = codec.message(f"{slave.name}Feedback")
    position = next(signal for signal in feedback.values if signal.name == "position")
    expected = round(2.0 * math.pi / position.scale)
    if motor_revs * gear_out == 0 or increments * gear_in != expected * motor_revs * gear_out:
        slave.fail(
            f"increments per joint revolution 0x608F x 0x6091 = {increments}/{motor_revs} x {gear_in}/{gear_out}, "
            f"{expected} expected"
        )


def _enter_mode(slave: Slave) -> None:
    slave.write(0x6060, 0, MODE_CYCLIC_SYNCHRONOUS_TORQUE)
    for _ in range(_MODE_READS):
        if slave.read(0x6061) == MODE_CYCLIC_SYNCHRONOUS_TORQUE:
            return
    slave.expect(0x6061, 0, MODE_CYCLIC_SYNCHRONOUS_TORQUE, "mode of operation")
