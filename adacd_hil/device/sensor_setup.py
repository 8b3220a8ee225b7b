"""What a torque sensor must be before its counts are taken for torque. Source: CiA 404, CiA 303-2 (units)."""

import math

from adacd_hil.device.slave import Slave
from adacd_hil.wire.codec import Codec

NEWTON_METRE = 0x00560100
"""0x6131 without its prefix: numerator Nm, denominator 1."""
_PREFIX_SHIFT = 24  # of 0x6131: power of ten, signed


def set_up_sensor(slave: Slave, codec: Codec) -> str:
    """Compare unit and decimal digits with the contract; return what the status says, empty when nothing.

    Raises DeviceError.
    """
    torque = codec.message(f"{slave.name}Torque")
    scale = next(signal.scale for signal in torque.values if signal.name == "torque")
    channel = _channel(slave)
    prefix = 0
    if slave.has(0x6131, channel):
        unit = slave.read(0x6131, channel)
        if unit & 0x00FFFFFF != NEWTON_METRE:
            slave.fail(f"unit 0x6131:{channel} = 0x{unit:08X}, 0x{NEWTON_METRE:08X} (Nm) expected")
        prefix = unit >> _PREFIX_SHIFT
        prefix -= 256 if prefix > 127 else 0
    if slave.has(0x6132, channel):
        digits = prefix - math.log10(scale)
        if abs(digits - round(digits)) > 1e-9:
            slave.fail(f"a count of {scale:g} Nm can't be said in decimal digits 0x6132:{channel}")
        slave.expect(0x6132, channel, round(digits), "decimal digits")
    if slave.has(0x6150, channel):
        status = slave.read(0x6150, channel)
        if status:
            return f"status 0x6150:{channel} = 0x{status:02X}"
    return ""


def _channel(slave: Slave) -> int:
    pdo = slave.device.pdo("Torque")
    signals = () if pdo is None else pdo.signals
    return next((signal.name.sub for signal in signals if signal.signal == "torque"), 0) or 1
