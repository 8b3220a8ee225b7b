"""What each fault does to the wire and what the host must make of it, row by row: the emulator's campaign.

All rows: configuration paper, profile P, nobody touches the arm, at_s since the drives were enabled. The arm adapts at
0.8 s and monitors at 7 s. A bound is in ms (cycles of 1 ms) from the first SYNC at which the row is active to the cycle
in which the supervisor is in FAULT; 0 is that SYNC's own cycle. Where no cycle can be recorded any more, the run ends
with an error of one line. Without fault and error: tolerated, no collision, the run ends as asked.

Bounds from the host's rules:

    max_age_cycles = 3             a value that comes no more is 4 cycles old in the 4th cycle: 3 ms
    command_patience_cycles = 10   the drive faults at the 10th SYNC without a new command, and says so there
    heartbeats of 100 ms           silent after 250 ms, looked for every 10 ms; the last one came up to 100 ms before
    drive status every 100 ms      too old after 250 cycles; the last one came up to 100 ms before
    sync_patience_periods = 1.5    by the clock only: one lost SYNC is too many
"""

import tomllib
from typing import NamedTuple

ADAPT_S, MONITOR_S = 0.8, 7.0


class Expected(NamedTuple):
    """What the host makes of it. `fault`: names of FaultReason of which one must come, or none.

    `error`: what the line begins with that ends the run. `says`: a part of what the log says of the fault.
    `low_ms`, `high_ms`: bounds. `collisions`: stops by the detector.
    """

    fault: tuple[str, ...] = ()
    high_ms: int = 0
    low_ms: int = 0
    error: str = ""
    says: str = ""
    collisions: int = 0


class Wire(NamedTuple):
    """How many frames with an identifier the devices put on the bus in the first `cycles` cycles of the row."""

    can_id: int
    cycles: int
    frames: int


TOLERATED = Expected()


class Case(NamedTuple):
    """One row of the campaign. `realtime`: what the host makes of it by the clock, where that is not as in lockstep."""

    name: str
    toml: str
    lockstep: Expected = TOLERATED
    realtime: Expected | None = None
    wire: tuple[Wire, ...] = ()
    at_s: float = ADAPT_S
    note: str = ""

    def expected(self, clock: str) -> Expected:
        return self.realtime if clock == "realtime" and self.realtime is not None else self.lockstep


def too_old(signal: str, high_ms: int = 3, low_ms: int = 0) -> Expected:
    return Expected(("DATA_AGE",), high_ms, low_ms, says=signal)


def deaf(joint: int, periods: int = 10) -> tuple[Expected, Expected]:
    """A drive that hears no command: in lockstep its EMCY comes a cycle before its status, by the clock in the same."""
    low_ms, high_ms = periods - 1, periods + 1
    return (
        Expected(("DRIVE",), high_ms, low_ms, says=f"Drive{joint}: EMCY 0x8250: RPDO timeout"),
        Expected(("DRIVE",), high_ms, low_ms, says=f"Drive{joint}: FAULT_REACTION_ACTIVE, error code 0x8250: RPDO"),
    )


GONE = ("DATA_AGE", "HEARTBEAT")
"""A node that has left Operational: what is noticed first depends on when heartbeats are looked at."""

FRAMES = [
    Case(
        "torque is lost",
        'kind = "lose", node = "sensor1", frame = "torque"',
        too_old("Sensor1: torque 4 cycles old, 3 allowed", 3, 3),
        wire=(Wire(0x183, 20, 0), Wire(0x184, 20, 20)),
    ),
    Case(
        "three torques are lost",
        'kind = "lose", node = "sensor1", frame = "torque", count = 3',
        wire=(Wire(0x183, 20, 17),),
    ),
    Case(
        "four torques are lost",
        'kind = "lose", node = "sensor2", frame = "torque", count = 4',
        too_old("Sensor2: torque 4 cycles old", 3, 3),
        wire=(Wire(0x184, 20, 16),),
    ),
    Case(
        "torques are lost now and then",
        'kind = "lose", node = "all", frame = "torque", probability = 0.05, duration_s = 1.0',
        note="four in a row have a chance of 6e-6 per cycle",
    ),
    Case(
        "feedback is lost",
        'kind = "lose", node = "drive2", frame = "feedback"',
        too_old("Drive2: position, velocity 4 cycles old", 3, 3),
        wire=(Wire(0x182, 20, 0), Wire(0x181, 20, 20)),
    ),
    Case(
        "a drive's status is lost",
        'kind = "lose", node = "drive1", frame = "status"',
        too_old("Drive1: status 251 cycles old, 250 allowed", 251, 150),
        wire=(Wire(0x281, 140, 0),),
    ),
    Case(
        "a sensor's status is lost",
        'kind = "lose", node = "sensor1", frame = "status"',
        wire=(Wire(0x283, 300, 0),),
        note="the header of the torque frame carries it too",
    ),
    Case(
        "commands are lost",
        'kind = "lose", node = "drive1", frame = "command"',
        *deaf(1),
        wire=(Wire(0x081, 20, 1), Wire(0x281, 20, 2)),
    ),
    Case(
        "seven commands are lost",
        'kind = "lose", node = "drive1", frame = "command", count = 7',
        note="the drive drops two more to find the sequence again: 9 SYNCs without a command",
    ),
    Case("eight commands are lost", 'kind = "lose", node = "drive1", frame = "command", count = 8', *deaf(1)),
    Case(
        "heartbeats of a sensor are lost",
        'kind = "lose", node = "sensor1", frame = "heartbeat"',
        Expected(("HEARTBEAT",), 260, 150, says="Sensor1 (node 3): no heartbeat for"),
        wire=(Wire(0x703, 140, 0),),
    ),
    Case(
        "the host's heartbeats are lost",
        'kind = "lose", node = "host", frame = "heartbeat"',
        TOLERATED,
        Expected(("DRIVE",), 254, 150, says="Drive1: EMCY 0x8130"),
        note="in lockstep nobody watches the host; by the clock all devices go Pre-operational after 250 ms, by EMCY",
    ),
    Case(
        "SYNC is lost",
        'kind = "lose", frame = "sync"',
        too_old("Drive1: position, velocity 4 cycles old, 3 allowed; Drive2: position", 3, 3),
        Expected(("DRIVE",), 2, 1, says="error code 0x8700: sync controller"),
        wire=(Wire(0x181, 2, 0),),
        note="in lockstep nobody watches SYNC",
    ),
    Case(
        "one SYNC is lost",
        'kind = "lose", frame = "sync", count = 1',
        TOLERATED,
        Expected(("DRIVE",), 2, 1, says="error code 0x8700: sync controller"),
        wire=(Wire(0x181, 1, 0),),
        note="`sync_patience_periods` = 1.5: by the clock one lost SYNC stops the arm; in lockstep both sensors "
        "count as a cycle late from then on",
    ),
    Case(
        "one SYNC doesn't reach a sensor",
        'kind = "lose", node = "sensor1", frame = "sync", count = 1',
        wire=(Wire(0x183, 20, 19), Wire(0x184, 20, 20)),
        note="its counter goes on by one, as that of a sensor that answers a period late: it counts as a cycle late "
        "from then on",
    ),
    Case(
        "one SYNC doesn't reach a drive",
        'kind = "lose", node = "drive1", frame = "sync", count = 1',
        TOLERATED,
        Expected(("DRIVE",), 2, 1, says="Drive1: FAULT_REACTION_ACTIVE, error code 0x8700"),
    ),
    Case(
        "SYNC comes twice",
        'kind = "duplicate", frame = "sync"',
        Expected(("DRIVE",), 5, 3, says="error code 0x8700: sync controller"),
        Expected(("DRIVE",), 4, 3, says="error code 0x8700: sync controller"),
        wire=(Wire(0x181, 3, 3), Wire(0x081, 1, 1)),
        note="the fourth that is odd before 100 were right faults the drives; "
        "on the modelled bus four EMCY delay feedback and status by a cycle",
    ),
    Case(
        "three SYNCs come twice",
        'kind = "duplicate", frame = "sync", count = 3',
        wire=(Wire(0x181, 20, 20), Wire(0x081, 20, 1)),
    ),
    Case(
        "the reset of a sensor is lost at power-on",
        'kind = "lose", node = "sensor1", frame = "nmt", since = "power_on", count = 1',
        Expected(error="no boot-up from Sensor1 (node 3)"),
        at_s=0.0,
    ),
    Case(
        "an SDO answer is lost at power-on",
        'kind = "lose", node = "drive1", frame = "sdo_response", since = "power_on", count = 1',
        Expected(error="Drive1 (node 1): no SDO answer within 0.5 s"),
        at_s=0.0,
    ),
    Case(
        "torque comes twice",
        'kind = "duplicate", node = "all", frame = "torque"',
        wire=(Wire(0x183, 20, 40), Wire(0x184, 20, 40)),
    ),
    Case(
        "feedback comes twice",
        'kind = "duplicate", node = "all", frame = "feedback"',
        wire=(Wire(0x181, 20, 40),),
        note="on the modelled bus torque then comes later than the host waits, 0.7 ms, and is a cycle old",
    ),
    Case("commands come twice", 'kind = "duplicate", node = "all", frame = "command"'),
    Case(
        "torque is late by less than a period",
        'kind = "delay", node = "sensor1", frame = "torque", delay_us = 300.0, duration_s = 0.5',
    ),
    Case(
        "torque is late by one and a half periods",
        'kind = "delay", node = "sensor1", frame = "torque", delay_us = 1500.0, duration_s = 0.5',
        TOLERATED,
        Expected(("DATA_AGE",), 6, 6, says="Sensor1: no usable frame in time in 7 of the last 9 cycles"),
        note="by the clock every sample is two cycles old, five of them are too many; on the modelled bus it is one",
    ),
    Case(
        "torque is late by five periods",
        'kind = "delay", node = "sensor1", frame = "torque", delay_us = 5000.0',
        too_old("Sensor1: torque 4 cycles old", 3, 3),
        wire=(Wire(0x183, 4, 0),),
    ),
    Case(
        "commands are late by one and a half periods",
        'kind = "delay", node = "all", frame = "command", delay_us = 1500.0, duration_s = 0.5',
        note="they act one SYNC later, or two",
    ),
    Case(
        "commands are late by fifteen periods",
        'kind = "delay", node = "drive1", frame = "command", delay_us = 15000.0',
        *deaf(1),
    ),
    Case(
        "SYNC is late by 0.3 periods",
        'kind = "late_sync", delay_us = 300.0, duration_s = 0.5',
        note="torque comes later than the host waits, 0.7 ms, and is a cycle old; "
        "in lockstep the devices have no time but SYNC",
    ),
    Case(
        "SYNC is late by 0.6 periods",
        'kind = "late_sync", delay_us = 600.0, duration_s = 0.5',
        TOLERATED,
        Expected(("DRIVE",), 1, 1, says="error code 0x8700: sync controller"),
        note="by the clock the first comes after 1.6 of 1.5 periods; in lockstep all feedback and commands are late",
    ),
    Case(
        "two torques swap",
        'kind = "reorder", node = "sensor1", frame = "torque", count = 1',
        wire=(Wire(0x183, 1, 0), Wire(0x183, 2, 2), Wire(0x183, 20, 20)),
    ),
    Case(
        "all torques swap",
        'kind = "reorder", node = "sensor1", frame = "torque"',
        note="the later one of each pair is used, so every second cycle has its sample; the run warns of the others",
    ),
    Case(
        "torques are corrupted",
        'kind = "corrupt", node = "sensor1", frame = "torque"',
        too_old("Sensor1: torque 4 cycles old", 3, 3),
        wire=(Wire(0x183, 20, 20),),
    ),
    Case(
        "torques are corrupted now and then",
        'kind = "corrupt", node = "all", frame = "torque", bits = 2, probability = 0.05, duration_s = 1.0',
    ),
    Case(
        "one feedback has a wrong high bit",
        'kind = "corrupt", node = "drive1", frame = "feedback", mask = "00001000", count = 1',
        note="implausible there and back: two cycles without position",
    ),
    Case(
        "all feedback has the same wrong high bit",
        'kind = "corrupt", node = "drive1", frame = "feedback", mask = "00000001"',
        Expected(("LIMIT",), 1, 1, says="joint 1: position"),
        note="implausible once; from then on the steps fit",
    ),
    Case(
        "commands are corrupted",
        'kind = "corrupt", node = "drive2", frame = "command"',
        *deaf(2),
        wire=(Wire(0x082, 20, 1),),
    ),
    Case(
        "one status has a wrong bit",
        'kind = "corrupt", node = "drive1", frame = "status", mask = "04", count = 1',
        Expected(("DRIVE",), 101, 0, says="Drive1: "),
        note="status frames are not protected: a false alarm on the safe side",
    ),
    Case(
        "one heartbeat says PRE-OPERATIONAL",
        'kind = "corrupt", node = "sensor2", frame = "heartbeat", mask = "7a", count = 1',
        Expected(("HEARTBEAT",), 111, 0, says="Sensor2 (node 4): is PRE-OPERATIONAL, OPERATIONAL expected"),
    ),
    Case(
        "a sensor's counter stands still",
        'kind = "freeze_counter", node = "sensor1", frame = "torque"',
        too_old("Sensor1: torque 4 cycles old", 4, 4),
        wire=(Wire(0x183, 20, 20),),
    ),
    Case(
        "the counter of commands stands still",
        'kind = "freeze_counter", node = "drive1", frame = "command"',
        *deaf(1, periods=11),
    ),
]

VALUES = [
    Case(
        "a position sticks",
        'kind = "stick", node = "drive1", signal = "position"',
        Expected(("LIMIT",), 1000, says="joint 1: velocity"),
        note="steps of 0 fit any velocity below 20 rad/s; the joint runs after the reference until it is too fast",
    ),
    Case("a velocity sticks for 50 ms", 'kind = "stick", node = "drive2", signal = "velocity", duration_s = 0.05'),
    Case(
        "a torque sticks while the arm adapts",
        'kind = "stick", node = "sensor1", signal = "torque", duration_s = 0.5',
        note="counter and CRC go on; eq. (15) is what doesn't hold then",
    ),
    Case(
        "one position is off by 0.1 rad",
        'kind = "jump", node = "drive1", signal = "position", step = 0.1, count = 1',
        note="implausible there and back",
    ),
    Case("torque has a spike of 5 Nm", 'kind = "jump", node = "sensor1", signal = "torque", step = 5.0, count = 1'),
    Case(
        "a sensor saturates",
        'kind = "saturate", node = "sensor1", signal = "torque"',
        Expected(("SENSOR",), 0, says="Sensor1: status 0x0"),
        wire=(Wire(0x283, 20, 1),),
    ),
    Case(
        "a sensor jumps beyond its range",
        'kind = "jump", node = "sensor2", signal = "torque", step = -200.0',
        Expected(("SENSOR",), 0, says="Sensor2: status 0x05: negative overload, not valid"),
    ),
    Case(
        "an amplifier clips below the range",
        'kind = "saturate", node = "sensor1", signal = "torque", value = 1.0, duration_s = 0.5',
        note="nothing shows it but the model",
    ),
]

NODES = [
    Case(
        "a drive reboots",
        'kind = "reboot", node = "drive1"',
        Expected(GONE, 3),
        wire=(Wire(0x701, 1, 1), Wire(0x181, 20, 0)),
    ),
    Case(
        "a sensor reboots and needs 50 ms",
        'kind = "reboot", node = "sensor2", duration_s = 0.05',
        Expected(GONE, 3, says="Sensor2"),
        wire=(Wire(0x184, 60, 0), Wire(0x704, 60, 1)),
    ),
    Case(
        "a sensor sends a storm of EMCY",
        'kind = "emcy_storm", node = "sensor1", code = 0x1000, rate_Hz = 500.0, duration_s = 0.5',
        Expected(("SENSOR",), 1, says="Sensor1: EMCY 0x1000: generic error"),
        wire=(Wire(0x083, 100, 50),),
    ),
    Case(
        "a node babbles with an identifier of nobody's",
        'kind = "babble", node = "sensor1", can_id = 0x7F0, rate_Hz = 2000.0, duration_s = 0.5',
        wire=(Wire(0x7F0, 600, 1000),),
    ),
    Case(
        "a node babbles with the identifier of a status",
        'kind = "babble", node = "sensor1", can_id = 0x281, rate_Hz = 1000.0, data = "00000000000000"',
        Expected(("DRIVE",), 2, says="Drive1: NOT_READY_TO_SWITCH_ON"),
        note="a cycle later where the drive's own status comes at once",
    ),
    Case(
        "a drive leaves the bus for good",
        'kind = "bus_off", node = "drive1"',
        Expected(GONE, 3),
        wire=(Wire(0x181, 200, 0), Wire(0x701, 200, 0)),
    ),
    Case(
        "a sensor leaves the bus and returns",
        'kind = "bus_off", node = "sensor1", duration_s = 0.002',
        Expected(("SENSOR",), 3, says="Sensor1: EMCY 0x8140: recovered from bus-off"),
        wire=(Wire(0x183, 20, 0), Wire(0x083, 20, 1)),
        note="it is Pre-operational when it returns, with EMCY 0x8140",
    ),
    Case(
        "a drive has another's id",
        'kind = "duplicate_node_id", node = "drive2", same_as = "drive1"',
        Expected(error="no boot-up from Drive2 (node 2)"),
        at_s=-1.0,
    ),
    Case(
        "a drive has a wrong id",
        'kind = "wrong_node_id", node = "drive1", node_id = 9',
        Expected(error="no boot-up from Drive1 (node 1)"),
        at_s=-1.0,
    ),
    Case(
        "two drives have swapped ids",
        'kind = "duplicate_node_id", node = "drive1", same_as = "drive2"\n'
        'kind = "duplicate_node_id", node = "drive2", same_as = "drive1"',
        Expected(error="Drive1 (node 1): "),
        at_s=-1.0,
        note="told apart by the rated torque, 12 and 6 Nm",
    ),
    Case(
        "a drive's clock runs at half the speed",
        'kind = "clock_drift", node = "drive1", drift_ppm = -500000.0',
        wire=(Wire(0x701, 1000, 5),),
        note="heartbeat and status come every 200 ms of 250",
    ),
    Case(
        "a drive's clock runs half as fast again",
        'kind = "clock_drift", node = "drive1", drift_ppm = 500000.0',
        TOLERATED,
        Expected(("DRIVE",), 2, says="Drive1: FAULT_REACTION_ACTIVE, error code 0x8700"),
        note="by the clock its 1.5 periods are one",
    ),
    Case(
        "all devices lose their power",
        'kind = "power_loss", duration_s = 0.5',
        Expected(error="transmit queue of embedded is full with 10 frames"),
        wire=(Wire(0x181, 3, 0),),
        note="with a queue of 512 frames: DATA_AGE after 3 ms",
    ),
    Case(
        "one drive loses its power",
        'kind = "power_loss", node = "drive2", duration_s = 0.5',
        too_old("Drive2: position, velocity 4 cycles old", 3, 3),
        wire=(Wire(0x182, 200, 0), Wire(0x181, 4, 4)),
    ),
    Case(
        "a sensor falls silent",
        'kind = "silence", node = "sensor2"',
        too_old("Sensor2: torque 4 cycles old", 3, 3),
        wire=(Wire(0x184, 200, 0), Wire(0x704, 200, 0)),
    ),
    Case(
        "a drive is silent for 3 ms",
        'kind = "silence", node = "drive1", duration_s = 0.003',
        wire=(Wire(0x181, 20, 17),),
    ),
    Case(
        "all devices are silent for 2 ms",
        'kind = "silence", node = "all", duration_s = 0.002',
        wire=(Wire(0x181, 2, 0), Wire(0x181, 20, 18), Wire(0x704, 2, 0)),
    ),
    Case(
        "a drive faults by itself",
        'kind = "drive_fault", node = "drive1", code = 0x2310',
        Expected(("DRIVE",), 1, 0, says="0x2310: continuous over-current, output"),
        wire=(Wire(0x081, 1, 1), Wire(0x281, 1, 1)),
    ),
    Case(
        "a sensor finds fault with itself",
        'kind = "sensor_error", node = "sensor1", duration_s = 0.2',
        Expected(("SENSOR",), 0, says="Sensor1: status 0x01: not valid"),
        wire=(Wire(0x283, 1, 1),),
    ),
    Case(
        "a drive reports that it is no longer enabled",
        'kind = "object_value", node = "drive2", index = 0x6041, raw = 0x0233',
        Expected(("DRIVE",), 100, says="Drive2: SWITCHED_ON"),
    ),
    Case(
        "a sensor reports an overload that it calls valid",
        'kind = "sensor_error", node = "sensor2", status = 2, duration_s = 0.2',
    ),
]

MONITORED = [
    Case(
        "torques are corrupted now and then while the arm is monitored",
        'kind = "corrupt", node = "all", frame = "torque", probability = 0.05',
        at_s=MONITOR_S,
    ),
    Case(
        "torque has a spike of 5 Nm while the arm is monitored",
        'kind = "jump", node = "sensor1", signal = "torque", step = 5.0, count = 1',
        at_s=MONITOR_S,
        note="5 Nm for 1 ms through 10 rad/s is 0.05 Nm of 0.15",
    ),
    Case(
        "torque jumps by 1 Nm while the arm is monitored",
        'kind = "jump", node = "sensor1", signal = "torque", step = 1.0, duration_s = 0.3',
        Expected(collisions=1),
        at_s=MONITOR_S,
        note="nothing but a contact looks like this",
    ),
    Case(
        "a torque sticks while the arm is monitored",
        'kind = "stick", node = "sensor1", signal = "torque", duration_s = 0.5',
        Expected(collisions=1),
        at_s=MONITOR_S,
    ),
]

CASES = [*FRAMES, *VALUES, *NODES, *MONITORED]


CLOCKS = ("lockstep", "realtime")


def covering() -> list[tuple[Case, str]]:
    """Return the first case of each kind in lockstep, and in real time where the host makes something else of it."""
    first: dict[str, Case] = {}
    for case in CASES:
        for row in rows_of(case):
            first.setdefault(str(row["kind"]), case)
    chosen = [case for case in CASES if case in first.values()]
    return [(case, clock) for case in chosen for clock in CLOCKS if clock == "lockstep" or case.realtime is not None]


def rows_of(case: Case) -> list[dict[str, object]]:
    """Return the scenario's faults of a case: one row of `toml` each, with its time."""
    time = f", at_s = {case.at_s}" if case.at_s >= 0.0 else ""
    lines = ", ".join(f"{{ {line}{time} }}" for line in case.toml.splitlines())
    rows: list[dict[str, object]] = tomllib.loads(f"faults = [{lines}]")["faults"]
    return rows
