"""Rules that every run must keep, judged from the wire and from the truth, whatever its configuration and its faults.

Each rule is a function of a `Case` that names what broke it. What the host knew is what it had read when it sent; what
it decided is in its log's /scheme, which is compared with the truth. Bounds are in `Bounds`, each with its reason.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from wire_record import Bools, Ints, Sight
from witnessed_run import Played

from adacd_hil.log.reader import RunLog
from adacd_hil.records import ContactLevel, Request, SchemeState
from adacd_hil.settings.arm_settings import MOST_BLIND_CYCLES

JOINTS = (0, 1)
SENSOR_NOT_VALID = 1
OPERATIONAL = 5
QUICK_STOP, ENABLE_OPERATION = 0x02, 0x0F
STATE_MASK, IS_ENABLED = 0x6F, 0x27  # of the statusword
TORQUE_MODE = 10
DOWNLOADS = (0x20, 0x00)  # command specifiers by which a client writes: initiate, segment
ARMED = (SchemeState.MONITOR, SchemeState.ADAPT, SchemeState.CERTIFY, SchemeState.PAYLOAD)
"""States in which the arm moves as it likes while its thresholds are in force."""
VALUE_KINDS = ("stick", "jump", "saturate", "sensor_error")
"""Faults that change what is measured behind a right CRC: no receiver can tell."""


@dataclass(frozen=True)
class Bounds:
    """How much is allowed. Cycles are SYNCs."""

    hidden_s: float = 0.01
    """What the start may hide of `safety.commission_s` before the drives are asked to enable."""
    hidden_rad_s: float = 0.01
    """What a count may add to `safety.rest_velocity_rad_s`."""
    permille: float = 1.01
    """Rounding of torque on the wire, one count."""
    status_cycles: int = 2
    """From a status that says that a drive has dropped out to zero torque on both joints."""
    emergency_cycles: int = 3
    """The same from an EMCY: at once, and a cycle for one that was read last."""
    heartbeat_cycles: int = 12
    """The same from a heartbeat of a node that is not Operational; the host looks at them every 10 ms."""
    limit_frames: int = 5
    """Frames in a row beyond a limit, so that no single implausible value counts."""
    limit_cycles: int = 5
    """From the last of them to zero torque."""
    old_cycles: int = 2
    """Feedback of this age is older than a cycle: torque must not grow on it."""
    blind_cycles: int = MOST_BLIND_CYCLES + 1
    """Cycles in a row in which the armed model had no fresh sample: so many are allowed, and the one that says so.
    Where a setting lets a value be older than that, so many more."""
    deaf_cycles: int = 2
    """Cycles without feedback after which a drive has gone: where all have, nobody acknowledges what stops them."""
    contact_share: float = 3.0
    """A true contact is clear when it is so many times over the threshold in force..."""
    contact_s: float = 0.1
    """...for so long: the slowest filter, 10 rad/s, is then at 1.9 times the threshold."""
    settle_s: float = 0.3
    """Armed for so long before the contact."""
    quiet_s: float = 1.0
    """Nothing touches the arm for so long before a reaction to nothing: the slowest filter forgets 1 in 20,000."""
    still_rad_s: float = 0.05
    """True speed of a stopped arm."""
    stop_s: float = 0.5
    """After the stop, before the arm must stand still."""


BOUNDS = Bounds()


class Violation(NamedTuple):
    """One broken rule: which, at which time of the host's clock, and how."""

    rule: str
    t_s: float
    text: str


class _Commands(NamedTuple):
    """Commands to one drive, in the order of sending."""

    sight: Sight
    controlword: Ints
    torque: NDArray[np.float64]  # per mille
    attempt: Ints
    cycle: Ints


class Case:
    """A played run, with what several rules need."""

    def __init__(self, played: Played, bounds: Bounds = BOUNDS) -> None:
        self.played = played
        self.bounds = bounds
        self.wire = played.wire
        self.truth = played.truth
        self.period_s = played.settings.bus.period_s
        self.arm = played.settings.arm

    @cached_property
    def commands(self) -> tuple[_Commands, _Commands]:
        """Commands to both drives."""
        found = []
        for joint in JOINTS:
            sight = self.wire[f"Drive{joint + 1}Command"]
            found.append(
                _Commands(
                    sight,
                    sight.signals["controlword"].astype(np.int64),
                    sight.signals["target_torque"],
                    self.wire.attempt(sight.place),
                    sight.cycle,
                )
            )
        return found[0], found[1]

    @cached_property
    def enabling_places(self) -> dict[int, int]:
        """Where a drive is first asked to be enabled, by attempt."""
        places: dict[int, int] = {}
        for commands in self.commands:
            for at in np.flatnonzero(commands.controlword == ENABLE_OPERATION).tolist():
                attempt, place = int(commands.attempt[at]), int(commands.sight.place[at])
                places[attempt] = min(place, places.get(attempt, place))
        return places

    def status_of(self, joint: int) -> tuple[Sight, Bools]:
        """Return the frames that say a drive's status, and which of them are to be believed."""
        own = self.wire[f"Drive{joint + 1}Status"]
        if len(own) or self.wire.has(f"Drive{joint + 1}Status"):
            return own, own.is_right
        feedback = self.wire[f"Drive{joint + 1}Feedback"]
        return feedback, feedback.is_fresh

    def enabled(self, joint: int) -> tuple[Ints, Bools]:
        """Return the places of a drive's believed statuses, and whether each says Operation enabled, mode 10."""
        sight, believed = self.status_of(joint)
        word = sight.signals["statusword"][believed].astype(np.int64)
        is_enabled = word & STATE_MASK == IS_ENABLED
        if "mode_display" in sight.signals:
            is_enabled &= sight.signals["mode_display"][believed] == TORQUE_MODE
        return sight.place[believed], is_enabled

    def age(self, name: str, places: Ints) -> Ints:
        """Return how many cycles ago the last fresh frame before each place was sampled; huge: none in this attempt."""
        sight = self.wire[name]
        last = sight.last_before(places, sight.is_fresh)
        age = self.wire.cycle[places] - np.where(last >= 0, sight.cycle[np.maximum(last, 0)], -(1 << 30))
        is_other = (last < 0) | (self.wire.attempt(places) != self.wire.attempt(sight.place[np.maximum(last, 0)]))
        if self.played.settings.bus.is_pipelined:
            age = age - 1  # such a command goes out behind the SYNC after its own
        return np.where(is_other, 1 << 30, age)

    @cached_property
    def log(self) -> RunLog | None:
        """The host's log, if it has rows."""
        log = self.played.log
        return log if log is not None and len(log.scheme) else None

    @cached_property
    def scheme_sync(self) -> Ints:
        """Which SYNC of the host each row of /scheme belongs to."""
        assert self.log is not None
        return np.asarray(np.searchsorted(self.wire.sync_t_ns, self.log.scheme.t_ns, side="right") - 1, np.int64)

    @cached_property
    def state(self) -> Ints:
        """State of each row of /scheme."""
        assert self.log is not None
        return self.log.scheme["state"].astype(np.int64)

    @cached_property
    def truth_row(self) -> Ints:
        """The truth's row of each row of /scheme."""
        return np.maximum(self.truth.at_sync(self.scheme_sync), 0)

    @cached_property
    def value_mask(self) -> int:
        """Bits of the faults that change what is measured in a way that no receiver can tell."""
        mask = 0
        for index, row in enumerate(self.played.scenario.faults):
            is_unprotected = row.frame in ("feedback", "torque", "any") and not self._is_protected(row.frame)
            changes = row.kind in VALUE_KINDS or (row.kind == "corrupt" and is_unprotected)
            # Frames that nothing protects can't tell an old one from a new one, nor a stranger's from the device's.
            changes |= row.kind in ("reorder", "babble") or row.kind.endswith("node_id")
            mask |= (1 << index) if changes else 0
        return mask

    def is_velocity_made_up(self, joint: int, first_row: int, last_row: int) -> bool:
        """Whether a fault that may change a drive's measured velocity is active in some of the truth's rows."""
        mask = 0
        for index, row in enumerate(self.played.scenario.faults):
            is_mine = row.node in (f"drive{joint + 1}", "all") or row.kind in ("babble", "reorder")
            mask |= (1 << index) if is_mine else 0
        masks = self.truth["faults"][first_row : last_row + 1, 0].astype(np.int64)
        return bool((masks & self.value_mask & mask).any())

    def _is_protected(self, frame: str) -> bool:
        names = {"feedback": ("Drive1Feedback",), "torque": ("Sensor1Torque",)}.get(
            frame, ("Drive1Feedback", "Sensor1Torque")
        )
        return all(self.wire.has_signal(name, "e2e_crc") for name in names)

    def has_value_fault(self, first_row: int, last_row: int) -> bool:
        """Whether such a fault is active in some of the truth's rows."""
        masks = self.truth["faults"][first_row : last_row + 1, 0].astype(np.int64)
        return bool((masks & self.value_mask).any())

    def t_s(self, t_ns: int) -> float:
        """Time of the host's clock, s."""
        return t_ns * 1e-9

    def stays(self, state: SchemeState) -> Iterator[tuple[int, int]]:
        """Return first and last row of each stay in a state, within one attempt."""
        attempt = self.wire.attempt(self.wire.sync_place[self.scheme_sync])
        yield from runs((self.state == state), attempt)


def runs(holds: Bools, group: Ints | None = None) -> Iterator[tuple[int, int]]:
    """Return first and last index of each run of True, broken where `group` changes."""
    where = np.flatnonzero(holds)
    if not len(where):
        return
    is_break = np.diff(where) > 1
    if group is not None:
        is_break |= np.diff(group[where]) != 0
    starts = np.concatenate(([0], np.flatnonzero(is_break) + 1))
    ends = np.concatenate((starts[1:] - 1, [len(where) - 1]))
    for start, end in zip(starts, ends, strict=True):
        yield int(where[start]), int(where[end])


Rule = Callable[[Case], Iterable[Violation]]


def torque_needs_enabled_drives(case: Case) -> Iterator[Violation]:
    """Find torque before both drives have said Operation enabled, in cyclic synchronous torque."""
    for joint, commands in enumerate(case.commands):
        pushing = np.flatnonzero(commands.torque != 0)
        for other in JOINTS:
            places, is_enabled = case.enabled(other)
            last = np.searchsorted(places, commands.sight.place[pushing]) - 1
            is_fine = (last >= 0) & is_enabled[np.maximum(last, 0)] if len(places) else np.zeros(len(pushing), bool)
            for bad in pushing[~is_fine][:1]:
                yield Violation(
                    "torque-before-enabled",
                    case.t_s(int(commands.sight.t_ns[bad])),
                    f"{commands.torque[bad]:g} per mille to drive {joint + 1} while drive {other + 1} has not said "
                    f"that it is enabled; {int((~is_fine).sum())} such commands",
                )


def enabling_needs_rest(case: Case) -> Iterator[Violation]:
    """Find attempts that ask a drive for Operation enabled before the arm has rested for the commissioning time.

    Rest is judged by all right feedback frames of that time; where some fault may change their values, by the truth.
    """
    bounds, safety = case.bounds, case.played.settings.safety
    rest_s, rest_rad_s = safety.commission_s - bounds.hidden_s, safety.rest_velocity_rad_s + bounds.hidden_rad_s
    least = round(rest_s / case.period_s)
    for joint, commands in enumerate(case.commands):
        for attempt in np.unique(commands.attempt):
            wants = np.flatnonzero((commands.attempt == attempt) & (commands.controlword == ENABLE_OPERATION))
            if not len(wants):
                continue
            first = int(wants[0])
            place, cycle = int(commands.sight.place[first]), int(commands.cycle[first])
            began = int(case.wire.cycle[case.wire.boots[attempt]]) if attempt >= 0 else -1
            if cycle - began < least:
                text = f"drive {joint + 1} is to be enabled {cycle - began} SYNCs after the boot, {least} expected"
                yield Violation("enabled-too-early", case.t_s(int(commands.sight.t_ns[first])), text)
            feedback = case.wire[f"Drive{joint + 1}Feedback"]
            is_before = feedback.is_right & (feedback.place < place) & (feedback.cycle >= cycle - least)
            speed = feedback.signals["velocity"][is_before]
            first_row, last_row = np.maximum(case.truth.at_sync(np.array([cycle - least, cycle])), 0).tolist()
            if case.is_velocity_made_up(joint, first_row, last_row):
                speed = case.truth["dq"][first_row : last_row + 1, joint]
            fastest = float(np.abs(speed).max(initial=0.0))
            if fastest > rest_rad_s:
                text = f"joint {joint + 1} moved at {fastest:.3f} rad/s within {rest_s:g} s before"
                yield Violation("enabled-in-motion", case.t_s(int(commands.sight.t_ns[first])), text)


def torque_has_limits(case: Case) -> Iterator[Violation]:
    """Find torque, or changes of it, beyond the arm's limits; only the way to zero may be a jump."""
    for joint, commands in enumerate(case.commands):
        rated = case.arm.rated_torque_Nm[joint]
        limit = 1000.0 * case.arm.torque_limit_Nm[joint] / rated + case.bounds.permille
        step = 1000.0 * case.arm.torque_rate_limit_Nm_s[joint] * case.period_s / rated + 2 * case.bounds.permille
        for bad in np.flatnonzero(np.abs(commands.torque) > limit)[:1]:
            text = f"{commands.torque[bad]:g} per mille to drive {joint + 1}, {limit:.1f} allowed"
            yield Violation("torque-limit", case.t_s(int(commands.sight.t_ns[bad])), text)
        change = np.abs(np.diff(commands.torque, prepend=0.0))
        for bad in np.flatnonzero((change > step) & (commands.torque != 0))[:1]:
            text = f"a step of {change[bad]:g} per mille to drive {joint + 1}, {step:.1f} allowed"
            yield Violation("torque-rate", case.t_s(int(commands.sight.t_ns[bad])), text)


def stopped_stays_stopped(case: Case) -> Iterator[Violation]:
    """Find torque after the first Quick stop of an attempt, before the devices boot again."""
    for attempt in np.unique(case.commands[0].attempt):
        stops = [
            int(commands.sight.place[at])
            for commands in case.commands
            for at in np.flatnonzero((commands.attempt == attempt) & (commands.controlword & 0x06 == QUICK_STOP))[:1]
        ]
        if not stops:
            continue
        for joint, commands in enumerate(case.commands):
            after = (commands.attempt == attempt) & (commands.sight.place > min(stops))
            for bad in np.flatnonzero(after & (commands.torque != 0))[:1]:
                text = f"{commands.torque[bad]:g} per mille to drive {joint + 1} after a quick stop"
                yield Violation("torque-after-stop", case.t_s(int(commands.sight.t_ns[bad])), text)


def _torque_after(case: Case, place: int, cycles: int) -> tuple[float, str] | None:
    """Return when and what is commanded more than `cycles` SYNCs after a place of the same attempt; None if nothing.

    Before a drive is asked to be enabled, devices may say what they like: their boot is not over.
    """
    attempt, cycle = int(case.wire.attempt(np.array([place]))[0]), int(case.wire.cycle[place])
    if place < case.enabling_places.get(attempt, 1 << 62):
        return None
    for joint, commands in enumerate(case.commands):
        late = (commands.attempt == attempt) & (commands.cycle > cycle + cycles) & (commands.torque != 0)
        found = np.flatnonzero(late)
        if len(found):
            at, last = int(found[0]), int(found[-1])
            lasted_ms = 1e3 * case.period_s * (int(commands.cycle[last]) - cycle)
            text = f"{commands.torque[at]:g} per mille to drive {joint + 1}; torque went on for {lasted_ms:.0f} ms"
            return case.t_s(int(commands.sight.t_ns[at])), text
    return None


def a_device_that_drops_out_ends_torque(case: Case) -> Iterator[Violation]:
    """Find torque on a joint after a device has said that it no longer works, before the devices boot again.

    A drive that the host itself no longer wants enabled works.
    """
    bounds = case.bounds
    for joint in JOINTS:
        places, is_enabled = case.enabled(joint)
        attempt = case.wire.attempt(places)
        drops = np.flatnonzero(~is_enabled[1:] & is_enabled[:-1] & (attempt[1:] == attempt[:-1])) + 1
        for at in drops[_is_wanted(case.commands[joint], places[drops])]:
            found = _torque_after(case, int(places[at]), bounds.status_cycles)
            if found:
                yield Violation("torque-after-drive-fault", found[0], f"drive {joint + 1} has dropped out: {found[1]}")
                break
    for place, text in [*_emergencies(case), *_sensor_errors(case)]:
        found = _torque_after(case, place, bounds.emergency_cycles)
        if found:
            yield Violation("torque-after-emergency", found[0], f"{text}: {found[1]}")
            break
    for place, text in _departures(case):
        found = _torque_after(case, place, bounds.heartbeat_cycles)
        if found:
            yield Violation("torque-after-departure", found[0], f"{text}: {found[1]}")
            break


def _is_wanted(commands: _Commands, places: Ints) -> Bools:
    """Tell of each place whether the last command to the drive before it wants it enabled."""
    before = np.searchsorted(commands.sight.place, places) - 1
    return np.asarray((before >= 0) & (commands.controlword[np.maximum(before, 0)] == ENABLE_OPERATION))


HARMLESS_CODES = (0x0000, 0x6320, 0x8200, 0x8210, 0x8240)
"""Error codes that stop nothing: an error is over; no RPDO brings commands; one odd SYNC, or one of a wrong length."""


def _emergencies(case: Case) -> Iterator[tuple[int, str]]:
    """Return EMCY messages of devices that have stopped working: any of a drive; of a sensor, one that has left."""
    for name in ("Drive1", "Drive2", "Sensor1", "Sensor2"):
        sight = case.wire[f"{name}Emcy"]
        codes = sight.signals.get("error_code", np.zeros(0)).astype(np.int64)
        for at in np.flatnonzero(sight.is_right & ~np.isin(codes, HARMLESS_CODES)):
            is_trip = name.startswith("Drive") or codes[at] >> 8 == 0x81
            if is_trip and sight.cycle[at] >= 0:
                yield int(sight.place[at]), f"{name} sends EMCY 0x{codes[at]:04X}"


def _sensor_errors(case: Case) -> Iterator[tuple[int, str]]:
    """Return frames in which a sensor says that its value is not valid."""
    for name in ("Sensor1", "Sensor2"):
        for sight, believed in (
            (case.wire[f"{name}Status"], case.wire[f"{name}Status"].is_right),
            (case.wire[f"{name}Torque"], case.wire[f"{name}Torque"].is_fresh),
        ):
            if "status" not in sight.signals:
                continue
            word = np.nan_to_num(sight.signals["status"]).astype(np.int64)
            for at in np.flatnonzero(believed & (word & SENSOR_NOT_VALID != 0)):
                yield int(sight.place[at]), f"{name} says that its value is not valid"


def _departures(case: Case) -> Iterator[tuple[int, str]]:
    """Return boot-ups and heartbeats of nodes that are not Operational, after they have been in this attempt."""
    for name in ("Drive1", "Drive2", "Sensor1", "Sensor2"):
        sight = case.wire[f"{name}Heartbeat"]
        if not len(sight):
            continue
        state = np.nan_to_num(sight.signals["state"]).astype(np.int64) & 0x7F
        attempt = case.wire.attempt(sight.place)
        for one in np.unique(attempt[sight.is_right]):
            mine = np.flatnonzero(sight.is_right & (attempt == one))
            up = np.flatnonzero(state[mine] == OPERATIONAL)
            if not len(up):
                continue
            gone = mine[up[0] :][state[mine[up[0] :]] != OPERATIONAL]
            for at in gone[:1]:
                yield int(sight.place[at]), f"{name} is in NMT state {state[at]}"


def torque_needs_data(case: Case) -> Iterator[Violation]:
    """Find torque while a value is older than the run allows."""
    most = case.played.settings.bus.max_age_cycles
    for joint, commands in enumerate(case.commands):
        pushing = np.flatnonzero(commands.torque != 0)
        for name in ("Drive1Feedback", "Drive2Feedback", "Sensor1Torque", "Sensor2Torque"):
            age = case.age(name, commands.sight.place[pushing])
            for at in np.flatnonzero(age > most)[:1]:
                bad = int(pushing[at])
                text = f"{commands.torque[bad]:g} per mille to drive {joint + 1} on a {name} {age[at]} cycles old"
                yield Violation("torque-on-old-data", case.t_s(int(commands.sight.t_ns[bad])), text)


def torque_does_not_grow_blindly(case: Case) -> Iterator[Violation]:
    """Find torque that grows while the joint's feedback is older than a cycle."""
    bounds = case.bounds
    for joint, commands in enumerate(case.commands):
        age = case.age(f"Drive{joint + 1}Feedback", commands.sight.place)
        size = np.abs(commands.torque)
        grown = np.diff(size, prepend=0.0)
        is_bad = (age >= bounds.old_cycles) & (grown > 2 * bounds.permille) & (commands.torque != 0)
        for at in np.flatnonzero(is_bad)[:1]:
            bad = np.flatnonzero(is_bad)
            text = (
                f"drive {joint + 1}: from {size[at] - grown[at]:g} to {size[at]:g} per mille on feedback {age[at]} "
                f"cycles old; {len(bad)} such commands, by {grown[bad].sum():g} per mille in all"
            )
            yield Violation("torque-grew-blindly", case.t_s(int(commands.sight.t_ns[at])), text)


def limits_stop_the_arm(case: Case) -> Iterator[Violation]:
    """Find torque a few cycles after a joint was measured beyond its limit again and again."""
    bounds = case.bounds
    for joint in JOINTS:
        sight = case.wire[f"Drive{joint + 1}Feedback"]
        fresh = np.flatnonzero(sight.is_fresh)
        for what, limit in (
            ("position", float(np.radians(case.arm.position_limit_deg[joint]))),
            ("velocity", float(np.radians(case.arm.velocity_limit_deg_s[joint]))),
        ):
            is_over = np.abs(sight.signals[what][fresh]) > limit
            if what == "velocity":
                is_over &= ~_is_thrown(case, sight.cycle[fresh])
            for first, last in runs(is_over, case.wire.attempt(sight.place[fresh])):
                if last - first + 1 < bounds.limit_frames:
                    continue
                place = int(sight.place[fresh[first + bounds.limit_frames - 1]])
                found = _torque_after(case, place, bounds.limit_cycles)
                if found:
                    value = float(np.abs(sight.signals[what][fresh[first : last + 1]]).max())
                    text = f"joint {joint + 1}: {what} {np.degrees(value):.1f}, {np.degrees(limit):g} deg(/s) allowed"
                    yield Violation("limit-not-stopped", found[0], f"{text}: {found[1]}")
                    break


def _is_thrown(case: Case, cycles: Ints) -> Bools:
    """Tell in which cycles a blow may throw the arm faster than its limit: in REACT, for `reaction.rebound_s`."""
    thrown = np.zeros(len(cycles), np.bool_)
    if case.log is None:
        return thrown
    length = round(case.played.settings.reaction.rebound_s / case.period_s) + 2
    for first, _ in case.stays(SchemeState.REACT):
        begin = int(case.scheme_sync[first])
        thrown |= (cycles >= begin - 1) & (cycles <= begin + length)
    return thrown


def counters_go_on(case: Case) -> Iterator[Violation]:
    """Find a SYNC that does not count the periods, commands that do not count by one, and wrong CRCs."""
    counter = np.array([case.wire.passed[place].data[0] for place in case.wire.sync_place.tolist()], np.int64)
    attempt = case.wire.attempt(case.wire.sync_place)
    # In lockstep the grid is that of the clock's whole periods, and a late SYNC is still that of its period.
    periods = np.diff(case.wire.sync_t_ns // round(1e9 * case.period_s))
    step = np.diff(counter) % 240
    is_bad = (attempt[1:] == attempt[:-1]) & (step != periods % 240)
    for at in np.flatnonzero(is_bad)[:1]:
        text = f"SYNC counter goes on by {step[at]} in {periods[at]} periods; {int(is_bad.sum())} times"
        yield Violation("sync-counter", case.t_s(int(case.wire.sync_t_ns[at + 1])), text)
    for joint, commands in enumerate(case.commands):
        for bad in np.flatnonzero(~commands.sight.is_right)[:1]:
            yield Violation(
                "command-crc", case.t_s(int(commands.sight.t_ns[bad])), f"drive {joint + 1}: length or CRC is wrong"
            )
        count = commands.sight.signals.get("e2e_counter")
        if count is None or len(count) < 2:
            continue
        modulo = 16 if case.wire.database.get_message_by_name(f"Drive{joint + 1}Command").length <= 8 else 256
        is_bad = (np.diff(count) % modulo != 1) & (np.diff(commands.attempt) == 0)
        for at in np.flatnonzero(is_bad)[:1]:
            text = f"drive {joint + 1}: counter {count[at]:g} is followed by {count[at + 1]:g}"
            yield Violation("command-counter", case.t_s(int(commands.sight.t_ns[at + 1])), text)


def one_command_per_sync(case: Case) -> Iterator[Violation]:
    """Find cycles in which a drive gets more than one command."""
    for joint, commands in enumerate(case.commands):
        began = commands.cycle[0] if len(commands.cycle) else 0
        count = np.bincount(commands.cycle - began) if len(commands.cycle) else np.zeros(0, np.int64)
        for at in np.flatnonzero(count > 1)[:1]:
            text = f"drive {joint + 1}: {count[at]} commands in one cycle"
            yield Violation("two-commands", case.t_s(int(case.wire.sync_t_ns[at + began])), text)


def nothing_is_written_while_powered(case: Case) -> Iterator[Violation]:
    """Find objects that are written while a drive is asked to be enabled; reading is allowed."""
    places = np.sort(
        np.concatenate([commands.sight.place[commands.controlword == ENABLE_OPERATION] for commands in case.commands])
    )
    if not len(places):
        return
    attempts = case.wire.attempt(places)
    for name in ("Drive1", "Drive2", "Sensor1", "Sensor2"):
        sight = case.wire[f"{name}SdoRequest"]
        if not len(sight):
            continue
        is_write = np.isin(np.nan_to_num(sight.signals["command"]).astype(np.int64) & 0xE0, DOWNLOADS)
        for at in np.flatnonzero(is_write):
            place = int(sight.place[at])
            mine = places[attempts == case.wire.attempt(np.array([place]))[0]]
            if len(mine) and mine[0] < place < mine[-1]:
                index = int(np.nan_to_num(sight.signals["index"][at]))
                text = f"0x{index:04X} of {name} is written while the drives are enabled"
                yield Violation("sdo-write-while-powered", case.t_s(int(sight.t_ns[at])), text)
                break


def an_armed_model_sees(case: Case) -> Iterator[Violation]:
    """Find stretches in which detection is armed, the arm moves, and the model's filters stand still."""
    if case.log is None:
        return
    scheme = case.log.scheme
    is_armed = np.isfinite(scheme["threshold"]).all(axis=1) & np.isin(case.state, ARMED)
    is_armed |= case.state == SchemeState.MONITOR
    stands = np.zeros(len(scheme), np.bool_)
    stands[1:] = np.ones(len(scheme) - 1, np.bool_)
    for name in ("tau_f", "tau_f_hat", "tau_ext_hat"):
        rows = scheme[name]
        stands[1:] &= (rows[1:] == rows[:-1]).all(axis=1)
    q = case.truth["q"][case.truth_row]
    tau = case.truth["tau_J"][case.truth_row]
    worst: dict[SchemeState, tuple[int, int, int]] = {}
    allowed = max(case.bounds.blind_cycles, case.played.settings.bus.max_age_cycles + 1)
    attempt = case.wire.attempt(case.wire.sync_place[case.scheme_sync])
    for first, last in runs(stands & is_armed, attempt):
        elapsed = int(case.scheme_sync[last] - case.scheme_sync[first]) + 1
        moved = np.abs(q[last] - q[first]).max() > 1e-6 or np.abs(tau[last] - tau[first]).max() > 1e-3
        if elapsed > allowed and moved:
            state = SchemeState(int(case.state[last]))
            longest, total, _ = worst.get(state, (0, 0, first))
            worst[state] = (max(longest, elapsed), total + elapsed, first if elapsed > longest else worst[state][2])
    for state, (longest, total, first) in worst.items():
        text = f"{state.name}: the model stood still for {longest} cycles, {total} in all such stretches"
        yield Violation("blind", case.t_s(int(scheme.t_ns[first])), text)


def armed_stretches(case: Case) -> list[tuple[int, int]]:
    """Return first and last row of /scheme of each stay in MONITOR."""
    return list(case.stays(SchemeState.MONITOR)) if case.log is not None else []


def clear_contacts(case: Case) -> list[tuple[int, int]]:
    """Return first and last row of /scheme of each clear contact that begins while armed: by the truth alone."""
    if case.log is None:
        return []
    bounds = case.bounds
    threshold = case.log.scheme["threshold"]
    tau_ext = np.abs(case.truth["tau_ext"][case.truth_row])
    settle, length = round(bounds.settle_s / case.period_s), round(bounds.contact_s / case.period_s)
    found = []
    for first, last in armed_stretches(case):
        for joint in JOINTS:
            in_force = threshold[:, joint].copy()
            in_force[last + 1 :] = in_force[last]  # the contact itself may outlast the stay
            is_clear = tau_ext[:, joint] > bounds.contact_share * in_force
            is_clear[: first + settle] = False
            for begin, end in runs(is_clear):
                if begin <= last and end - begin + 1 >= length and begin > first + settle:
                    found.append((begin, end))
    return found


def contacts_are_found(case: Case) -> Iterator[Violation]:
    """Find clear contacts that begin while armed and do not end the stay in MONITOR before they have lasted long."""
    if case.log is None:
        return
    length = round(case.bounds.contact_s / case.period_s)
    for begin, end in clear_contacts(case):
        until = begin + length
        if until >= len(case.state) or (case.state[begin : until + 1] != SchemeState.MONITOR).any():
            continue
        if case.has_value_fault(int(case.truth_row[begin]) - 500, int(case.truth_row[until])):
            continue
        rest = case.state[begin : end + 1]
        left = np.flatnonzero(rest != SchemeState.MONITOR)
        how = f"left MONITOR after {1e3 * case.period_s * left[0]:.0f} ms" if len(left) else "never left MONITOR"
        tau = np.abs(case.truth["tau_ext"][case.truth_row[begin : end + 1]]).max(axis=0)
        threshold = case.log.scheme["threshold"][begin]
        text = (
            f"contact of {tau[0]:.2f}, {tau[1]:.2f} Nm for {1e3 * case.period_s * (end - begin + 1):.0f} ms, "
            f"thresholds {threshold[0]:.2f}, {threshold[1]:.2f} Nm: {how}"
        )
        yield Violation("contact-missed", case.t_s(int(case.log.scheme.t_ns[begin])), text)


def reactions_have_a_cause(case: Case) -> Iterator[Violation]:
    """Find reactions to nothing that touches the arm, for which the log gives no other reason."""
    if case.log is None:
        return
    quiet = round(case.bounds.quiet_s / case.period_s)
    tau_ext = np.abs(case.truth["tau_ext"]).max(axis=1)
    payload = case.truth["payload"][:, 0]
    reactions = np.flatnonzero((case.state[1:] == SchemeState.REACT) & (case.state[:-1] == SchemeState.MONITOR)) + 1
    for at in reactions.tolist():
        row = int(case.truth_row[at])
        before = max(row - quiet, 0)
        if tau_ext[before : row + 1].max() > 1e-6 or case.has_value_fault(before, row):
            continue
        if payload[row] != payload[_learnt_row(case, at)] or is_named(case, at):
            continue
        estimate = case.log.scheme["tau_ext_hat"][at]
        text = f"nothing touched it for {case.bounds.quiet_s:g} s; tau_ext_hat {estimate[0]:.2f}, {estimate[1]:.2f} Nm"
        yield Violation("reaction-to-nothing", case.t_s(int(case.log.scheme.t_ns[at])), text)


def _learnt_row(case: Case, at: int) -> int:
    """Return the truth's row of the last cycle in which the model was learnt, before a row of /scheme."""
    learnt = np.flatnonzero(np.isin(case.state[:at], (SchemeState.ADAPT, SchemeState.CERTIFY)))
    return int(case.truth_row[learnt[-1]]) if len(learnt) else 0


def is_named(case: Case, at: int) -> bool:
    """Whether the log gives a reason other than a contact for a change of state, or warned just before."""
    assert case.log is not None
    t_ns = int(case.log.scheme.t_ns[at])
    for entry in case.log.events:
        if not t_ns - 100_000_000 <= entry.t_ns <= t_ns + 2_000_000:
            continue
        text = entry.event.message
        if "-> REACT" in text and ";" in text:
            return True
        if entry.event.level in ("warning", "error") and "->" not in text and "late commands" not in entry.event.name:
            return True
    return False


def a_collision_waits_for_its_acknowledgement(case: Case) -> Iterator[Violation]:
    """Find stops that end without the user's word or a fault, and motion in a stop though nothing pushes."""
    if case.log is None:
        return
    requests = case.log.scheme["request"]
    attempt = case.wire.attempt(case.wire.sync_place[case.scheme_sync])
    speed = np.abs(case.truth["dq"][case.truth_row]).max(axis=1)
    pushed = np.abs(case.truth["tau_ext"][case.truth_row]).max(axis=1)
    stop = round(case.bounds.stop_s / case.period_s)
    for first, last in case.stays(SchemeState.STOPPED):
        after = int(case.state[last + 1]) if last + 1 < len(case.state) and attempt[last + 1] == attempt[last] else None
        asked = set(requests[first + 1 : last + 2].tolist())  # what was said in the cycle that stopped was said before
        if after not in (None, SchemeState.FAULT) and not asked & {Request.ACKNOWLEDGE, Request.PAYLOAD}:
            text = f"STOPPED -> {SchemeState(after).name} without the user's word" if after is not None else ""
            yield Violation("stop-not-latched", case.t_s(int(case.log.scheme.t_ns[last])), text)
        rows = slice(first + stop, last + 1)
        if last - first <= stop or case.has_value_fault(int(case.truth_row[first]), int(case.truth_row[last])):
            continue
        is_free = pushed[first : last + 1].max() < 1e-6
        if is_free and speed[rows].max() > case.bounds.still_rad_s:
            text = f"{speed[rows].max():.3f} rad/s while stopped, with nothing that pushes"
            yield Violation("moves-while-stopped", case.t_s(int(case.log.scheme.t_ns[first])), text)
    yield from _collisions_latch(case)


def _collisions_latch(case: Case) -> Iterator[Violation]:
    assert case.log is not None
    attempt = case.wire.attempt(case.wire.sync_place[case.scheme_sync])
    for first, last in case.stays(SchemeState.REACT):
        begin_ns, end_ns = int(case.log.scheme.t_ns[first]), int(case.log.scheme.t_ns[last])
        levels = [report.level for t_ns, report in case.log.contacts if begin_ns <= t_ns <= end_ns]
        if ContactLevel.COLLISION not in levels or last + 1 >= len(case.state):
            continue
        if attempt[last + 1] != attempt[last]:  # broken off, and begun anew once the user had acknowledged that
            continue
        after = SchemeState(int(case.state[last + 1]))
        if after not in (SchemeState.STOPPED, SchemeState.FAULT, SchemeState.INIT):
            text = f"a collision, and REACT -> {after.name}"
            yield Violation("stop-not-latched", case.t_s(end_ns), text)


def the_run_ends(case: Case) -> Iterator[Violation]:
    """Find a run that goes on long after it was asked to end, ends by a traceback, or leaves its drives enabled."""
    played = case.played
    if played.crash:
        yield Violation("crash", case.t_s(played.end_ns), played.crash)
    if played.overdue:
        asked = "never" if played.finish_ns is None else f"at {played.finish_ns * 1e-9:.2f} s"
        yield Violation("unending", case.t_s(played.end_ns), f"{played.overdue}; asked to end {asked}")
        return
    for joint, commands in enumerate(case.commands):
        answers = case.wire[f"Drive{joint + 1}Feedback"].cycle
        is_deaf = len(answers) and len(commands.cycle) and commands.cycle[-1] - answers[-1] > case.bounds.deaf_cycles
        if len(commands.torque) and commands.torque[-1] != 0 and not is_deaf:
            text = f"the last command to drive {joint + 1} has {commands.torque[-1]:g} per mille"
            yield Violation("torque-at-the-end", case.t_s(played.end_ns), text)
    has_bus = played.summary is not None and not played.summary.error
    if has_bus and any(played.enabled_at_end):
        names = [str(joint + 1) for joint in JOINTS if played.enabled_at_end[joint]]
        yield Violation("enabled-at-the-end", case.t_s(played.end_ns), f"drive {', '.join(names)} is still enabled")


def the_log_is_whole(case: Case) -> Iterator[Violation]:
    """Find a log that is not whole, or does not say why the run ended."""
    played = case.played
    if played.overdue or played.crash:
        return
    if played.log is None:
        yield Violation("no-log", case.t_s(played.end_ns), "the run left no log")
        return
    if not played.log.is_complete:
        problem = played.log.problem or f"{played.log.summary.get('dropped', '?')} packets dropped"
        yield Violation("log-not-whole", case.t_s(played.end_ns), problem)
    said = [entry.event.message for entry in played.log.events]
    faulted = [text for text in said if "-> FAULT" in text]
    for text in faulted:
        if ";" not in text:
            yield Violation("fault-not-named", case.t_s(played.end_ns), f"{text!r} names no cause")
            break
    result = played.summary.result if played.summary is not None else None
    if result is not None and result.fault != 0 and not faulted:
        yield Violation("fault-not-named", case.t_s(played.end_ns), f"{result.fault.name} has no event")


RULES: tuple[Rule, ...] = (
    torque_needs_enabled_drives,
    enabling_needs_rest,
    torque_has_limits,
    stopped_stays_stopped,
    a_device_that_drops_out_ends_torque,
    torque_needs_data,
    torque_does_not_grow_blindly,
    limits_stop_the_arm,
    counters_go_on,
    one_command_per_sync,
    nothing_is_written_while_powered,
    an_armed_model_sees,
    contacts_are_found,
    reactions_have_a_cause,
    a_collision_waits_for_its_acknowledgement,
    the_run_ends,
    the_log_is_whole,
)


def judge(played: Played, bounds: Bounds = BOUNDS) -> list[Violation]:
    """Apply every rule."""
    case = Case(played, bounds)
    return [violation for rule in RULES for violation in rule(case)]
