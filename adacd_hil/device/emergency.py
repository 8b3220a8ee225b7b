"""Names of EMCY error codes (and of 0x603F, which has the same ones).

Source: CiA 301 (4.2), clause 7.2.7.1, table 26 (classes and communication codes); CiA 402-2 / IEC 61800-7-201,
table of error codes of drives.
"""

_CLASSES = {
    0x00: "error reset or no error",
    0x10: "generic error",
    0x20: "current",
    0x21: "current, device input side",
    0x22: "current inside the device",
    0x23: "current, device output side",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the device",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x43: "drive temperature",
    0x44: "supply temperature",
    0x50: "device hardware",
    0x51: "supply",
    0x52: "control hardware",
    0x53: "operating unit",
    0x54: "power section",
    0x55: "data storage",
    0x60: "device software",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x70: "additional modules",
    0x71: "power module",
    0x72: "measurement circuit",
    0x73: "sensor",
    0x74: "computation circuit",
    0x75: "communication module",
    0x76: "external data storage",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol error",
    0x83: "torque control",
    0x84: "velocity controller",
    0x85: "position controller",
    0x86: "positioning controller",
    0x87: "sync controller",
    0x88: "winding controller",
    0x89: "process data monitoring",
    0x8A: "control monitoring",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "device specific",
}
"""By the high byte."""

_CODES = {
    # CiA 301
    0x8110: "CAN overrun, objects lost",
    0x8120: "CAN in error passive mode",
    0x8130: "life guard or heartbeat error",
    0x8140: "recovered from bus-off",
    0x8150: "CAN identifier collision",
    0x8210: "PDO not processed due to length error",
    0x8220: "PDO length exceeded",
    0x8230: "destination object of a multiplexed PDO not available",
    0x8240: "unexpected SYNC data length",
    0x8250: "RPDO timeout",
    # CiA 402
    0x2110: "short circuit or earth leakage, input",
    0x2120: "earth leakage, input",
    0x2130: "short circuit, input",
    0x2213: "over-current in ramp function",
    0x2214: "over-current in the sequence",
    0x2220: "continuous over-current inside the device",
    0x2230: "short circuit or earth leakage inside the device",
    0x2240: "earth leakage inside the device",
    0x2250: "short circuit inside the device",
    0x2310: "continuous over-current, output",
    0x2320: "short circuit or earth leakage, motor side",
    0x2330: "earth leakage, motor side",
    0x2340: "short circuit, motor side",
    0x3110: "mains over-voltage",
    0x3120: "mains under-voltage",
    0x3130: "phase failure",
    0x3134: "phase sequence",
    0x3140: "mains frequency",
    0x3210: "DC link over-voltage",
    0x3220: "DC link under-voltage",
    0x3230: "load error",
    0x3310: "output over-voltage",
    0x3320: "armature circuit",
    0x3330: "field circuit",
    0x4110: "excess ambient temperature",
    0x4120: "too low ambient temperature",
    0x4210: "excess temperature of the device",
    0x4220: "too low temperature of the device",
    0x4310: "excess temperature of the drive",
    0x4320: "too low temperature of the drive",
    0x4410: "excess temperature of the supply",
    0x4420: "too low temperature of the supply",
    0x5110: "low supply voltage",
    0x5112: "+24 V supply",
    0x5113: "+5 V supply",
    0x5120: "supply of the intermediate circuit",
    0x5210: "measurement circuit",
    0x5220: "computing circuit",
    0x5410: "output stages",
    0x5420: "chopper",
    0x5430: "input stages",
    0x5440: "contacts",
    0x5450: "fuses",
    0x5510: "working memory",
    0x5520: "program memory",
    0x5530: "non-volatile memory",
    0x6010: "software reset by watchdog",
    0x6310: "loss of parameters",
    0x6320: "parameter error",
    0x7110: "brake chopper",
    0x7120: "motor",
    0x7121: "motor blocked",
    0x7122: "motor error or commutation malfunction",
    0x7123: "motor tilted",
    0x7301: "tachometer fault",
    0x7302: "tachometer with wrong polarity",
    0x7303: "resolver 1 fault",
    0x7304: "resolver 2 fault",
    0x7305: "incremental sensor 1 fault",
    0x7306: "incremental sensor 2 fault",
    0x7307: "incremental sensor 3 fault",
    0x7310: "speed",
    0x7320: "position",
    0x7510: "serial interface 1",
    0x7520: "serial interface 2",
    0x8311: "excess torque",
    0x8312: "difficult start-up",
    0x8313: "standstill torque",
    0x8321: "insufficient torque",
    0x8331: "torque fault",
    0x8611: "following error",
    0x8612: "reference limit",
    0xF001: "deceleration",
    0xF002: "sub-synchronous run",
    0xF003: "stroke operation",
    0xF004: "control",
}

WATCHDOGS = {
    1: "SYNC",
    2: "command",
    3: "host heartbeat",
    4: "left Operational",
    5: "PDO length",
    6: "SYNC order",
    7: "SYNC length",
    8: "no RPDO brings commands",
}
"""Byte 3 of an EMCY of devices with the feature `watchdog_in_emcy`; bytes 4 to 7 are the device's time in ms."""


def name_error(code: int) -> str:
    """Name an error code; an unlisted one gets the name of its class."""
    return _CODES.get(code) or _CLASSES.get(code >> 8) or _CLASSES.get((code >> 8) & 0xF0, "unknown")


def describe_emergency(code: int, manufacturer: bytes, has_watchdog: bool) -> str:
    """Describe an EMCY message in one line. `manufacturer`: its bytes 3 to 7.

    `has_watchdog`: these bytes are the watchdog's number and the device's time.
    """
    text = f"EMCY 0x{code:04X}: {name_error(code) if code else 'error reset'}"
    if not any(manufacturer):
        return text
    watchdog = manufacturer[0]
    if not has_watchdog or watchdog not in WATCHDOGS:
        return f"{text}, manufacturer bytes {manufacturer.hex(' ')}"
    time_ms = int.from_bytes(manufacturer[1:5], "little")
    return f"{text}, watchdog {watchdog} ({WATCHDOGS[watchdog]}) at device time {time_ms} ms"
