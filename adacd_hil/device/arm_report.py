"""Messages about an arm's devices and data: ages, gaps, checks and faults in words, shares of cycles.

The shares of cycles whose cyclic data came in time are compared, second by second, with the limits of `[data]`.

After MOST_IN_A_ROW cycles without a sample for the model, a warning follows at once: a contact is detected so much
later.

Cycles are counted only while the drives are enabled: data from before and after don't count for a run.
"""

import math
from dataclasses import dataclass

from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_watch import EventSource
from adacd_hil.device.canopen_bus import name_error
from adacd_hil.device.drive import MODE_CYCLIC_SYNCHRONOUS_TORQUE, Cia402State, Drive
from adacd_hil.device.torque_sensor import SensorStatus
from adacd_hil.records import ArmState, Event
from adacd_hil.settings.arm_settings import DATA_WINDOW_S, SHORTEST_DATA_WINDOW
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.e2e import E2eStatus

MOST_IN_A_ROW = 2
_REVOLUTION_DEG = 360.0
_STATUS_WORDS = (
    (SensorStatus.POSITIVE_OVERLOAD, "positive overload"),
    (SensorStatus.NEGATIVE_OVERLOAD, "negative overload"),
    (SensorStatus.NOT_VALID, "not valid"),
)


@dataclass(frozen=True)
class DataShares:
    """Shares of a run's cycles with enabled drives, 0…1.

    incomplete: some cyclic frame was missing, late or wrong. late: the scheme's sample was older than the cycle.
    no_new_data, repeated: by device; its frame was not in time, or came again; every repeated frame counts, so that
    `repeated` may exceed 1. excesses: quantities that exceeded their limit in some second, one line each with the
    worst value.
    """

    cycles: int
    incomplete: float
    late: float
    no_new_data: dict[str, float]
    repeated: dict[str, float]
    excesses: tuple[str, ...]


class DataWatch(EventSource):
    """Counts missing and late data over one attempt; reports shares of a second that exceed their limit as events."""

    def __init__(self, settings: Settings, arm: Arm) -> None:
        super().__init__()
        limits = settings.data
        self._arm = arm
        self._window_cycles = max(1, round(DATA_WINDOW_S / settings.bus.period_s))
        self._names = [device.name for device in arm.devices]
        self._limits = {"incomplete cycles": limits.incomplete_share}
        self._limits |= {f"no frame of {name} in time": limits.no_new_data_share for name in self._names}
        self._limits |= {f"frames of {name} repeated": limits.repeated_share for name in self._names}
        self._totals = dict.fromkeys(self._limits, 0)
        self._worst = dict.fromkeys(self._limits, 0.0)
        self._over: set[str] = set()
        self._missing = [0] * len(self._names)  # of the present window
        self._repeats_before = list(arm.repeats)
        self._cycles = self._all_cycles = self._incomplete = 0
        self._late = self._all_late = 0  # cycles with an older sample: of the window, of ended ones
        self._in_a_row = self._rows = 0  # cycles without a sample; rows of them in the present window
        self._has_rows = False

    def count_cycle(self, state: ArmState) -> None:
        """Count a cycle and its missing frames and sample; compare the shares with their limits after each second.

        Add a warning when MOST_IN_A_ROW cycles in a row have no sample, again only after a second without that, which
        is an event, too. After each second of counted cycles, also add an event for each share that now exceeds its
        limit, or no longer does. Call it once per cycle, after the cycle's last frame. A cycle without enabled drives
        is not counted.
        """
        if not state.is_enabled:
            return
        if self._cycles == 0:
            self._repeats_before = list(self._arm.repeats)
        self._cycles += 1
        self._in_a_row = 0 if state.is_complete else self._in_a_row + 1
        if self._in_a_row == MOST_IN_A_ROW:
            self._note_row()
        if self._arm.missing_frames:
            self._incomplete += 1
            self._late += state.is_complete
            received = self._arm.received
            for place in range(len(self._missing)):
                self._missing[place] += ~received >> place & 1
        if self._cycles == self._window_cycles:
            self._end_window()

    def _note_row(self) -> None:
        """Count one row of MOST_IN_A_ROW cycles without a sample; add a warning, unless the last one still holds.

        It holds until a window has ended in which this didn't happen.
        """
        self._rows += 1
        if not self._has_rows:
            self._has_rows = True
            text = f"no sample for the model in {MOST_IN_A_ROW} cycles in a row: so much later a contact is found"
            self.events.append(Event("warning", "data", text))

    def _end_window(self) -> None:
        """Add an event for each share of the window that now exceeds its limit, or no longer does.

        Add one, too, if rows of cycles without a sample were reported and the window had none. Add the window's counts
        to the totals, and begin the next window.
        """
        repeats = [now - before for now, before in zip(self._arm.repeats, self._repeats_before, strict=True)]
        for name, count in zip(self._limits, [self._incomplete, *self._missing, *repeats], strict=True):
            share, limit = count / self._cycles, self._limits[name]
            self._totals[name] += count
            self._worst[name] = max(self._worst[name], share)
            if (share > limit) == (name in self._over):
                continue
            self._over ^= {name}
            level = "warning" if share > limit else "info"
            text = f"{name}: {share:.1%} of the last {self._cycles} cycles, {limit:.1%} allowed"
            self.events.append(Event(level, "data", text))
        if self._has_rows and not self._rows:
            self._has_rows = False
            text = f"a sample for the model at least every {MOST_IN_A_ROW} cycles again, for {self._cycles} cycles"
            self.events.append(Event("info", "data", text))
        self._rows = 0
        self._all_cycles += self._cycles
        self._all_late += self._late
        self._cycles = self._incomplete = self._late = 0
        self._missing = [0] * len(self._names)

    def finish_shares(self) -> DataShares:
        """Return the shares of missing and late data over all ended windows; 0 if no window has ended.

        The present window is ended first if it has at least SHORTEST_DATA_WINDOW of a whole one's cycles.
        """
        if self._cycles >= SHORTEST_DATA_WINDOW * self._window_cycles:
            self._end_window()
        cycles = max(self._all_cycles, 1)
        share = [total / cycles for total in self._totals.values()]
        count = len(self._names)
        return DataShares(
            cycles=self._all_cycles,
            incomplete=share[0],
            late=self._all_late / cycles,
            no_new_data=dict(zip(self._names, share[1 : 1 + count], strict=True)),
            repeated=dict(zip(self._names, share[1 + count :], strict=True)),
            excesses=tuple(
                f"{name}: up to {worst:.1%} of the cycles of a second, {self._limits[name]:.1%} allowed"
                for name, worst in self._worst.items()
                if worst > self._limits[name]
            ),
        )


def describe_gaps(arm: Arm) -> list[str]:
    """Return a line per device with gaps: in how many of the last cycles it had no usable frame in time.

    Count the present cycle, too; skip devices without a gap.
    """
    received = [*arm.received_before, arm.received]
    gaps = [sum(~bits >> place & 1 for bits in received) for place in range(len(arm.devices))]
    return [
        f"{device.name}: no usable frame in time in {count} of the last {len(received)} cycles"
        for device, count in zip(arm.devices, gaps, strict=True)
        if count
    ]


def describe_checks(arm: Arm) -> list[str]:
    """Return a line per device with the number of its cyclic frames by status of their end-to-end check.

    The line of an unprotected device has the implausible and the missing frames.
    """
    lines = []
    for device in arm.devices:
        tally = dict(device.end_to_end.tally())
        counts = ", ".join(f"{count} {status.name}" for status, count in tally.items())
        if not device.is_protected:
            missing = f"{tally[E2eStatus.NO_NEW_DATA]} {E2eStatus.NO_NEW_DATA.name}"
            counts = f"unprotected, {device.implausible_frames} implausible, {missing}"
        lines.append(f"{device.name}: {counts}")
    return lines


def describe_faults(arm: Arm) -> list[str]:
    """Return the arm's faults, one line each; empty without a fault.

    Lines name a drive's fault or error code, a drive that dropped out, other senders, a sensor's status unless it is 0,
    bounded values outside their bounds, and signals older than their limit.
    """
    lines = []
    for drive in arm.drives:
        if drive.state in (Cia402State.FAULT, Cia402State.FAULT_REACTION_ACTIVE) or drive.error_code:
            name = f": {name_error(drive.error_code)}" if drive.error_code else ""
            lines.append(f"{drive.name}: {drive.state.name}, error code 0x{drive.error_code:04X}{name}")
        elif arm.was_enabled:
            lines += _describe_disabled(drive)
    lines += arm.strangers.describe_senders(arm.cycle)
    for sensor in arm.sensors:
        if sensor.status:
            words = ", ".join(text for bit, text in _STATUS_WORDS if sensor.status & bit)
            lines.append(f"{sensor.name}: status 0x{int(sensor.status):02X}: {words}")
    for device in arm.devices:
        lines += device.describe_excess(arm.cycle)
    ages: list[tuple[str, int, float]] = []
    for drive in arm.drives:
        ages.append((f"{drive.name}: position, velocity", drive.sample_cycle, arm.max_age_cycles))
        if drive.has_status_frame:
            ages.append((f"{drive.name}: status", drive.status_cycle, drive.status_age_limit))
    ages += ((f"{sensor.name}: torque", sensor.sample_cycle, arm.max_age_cycles) for sensor in arm.sensors)
    lines += (
        f"{signals} {arm.cycle - cycle} cycles old, {limit:g} allowed"
        for signals, cycle, limit in ages
        if arm.cycle - cycle > limit
    )
    return lines


def describe_disabled(arm: Arm) -> list[str]:
    """Return a line per drive that is not enabled, with its state and mode; empty when both are enabled."""
    return [line for drive in arm.drives for line in _describe_disabled(drive)]


def describe_excess(arm: Arm) -> list[str]:
    """Return a line per position or velocity limit that a joint exceeds, with value and limit, deg or deg/s.

    Beyond a revolution the line names settings that may be wrong. Return [] without an excess.
    """
    lines = []
    for joint, (drive, sign) in enumerate(zip(arm.drives, arm.sign, strict=True)):
        position, velocity = drive.values
        for quantity, value, bound, unit in (
            ("position", sign * position - arm.zero_rad[joint], arm.limits.position_limit_deg[joint], "deg"),
            ("velocity", sign * velocity, arm.limits.velocity_limit_deg_s[joint], "deg/s"),
        ):
            value_deg = math.degrees(value)
            if abs(value_deg) > bound:
                text = f"joint {joint + 1}: {quantity} {value_deg:.2f} {unit}, ±{bound:g} {unit} allowed"
                if quantity == "position" and abs(value_deg) > _REVOLUTION_DEG:
                    text += (
                        "; more than a revolution: check scale.increments_per_joint_rev, scale.gear_ratio and the "
                        f"encoder's zero of devices.drive[{joint}]"
                    )
                lines.append(text)
    return lines


def _describe_disabled(drive: Drive) -> list[str]:
    """Return a line with state and mode of a drive that is not enabled; empty for one that is."""
    if drive.is_enabled:
        return []
    expected = f"OPERATION_ENABLED in mode {MODE_CYCLIC_SYNCHRONOUS_TORQUE} expected"
    return [f"{drive.name}: {drive.state.name}, mode {drive.mode}, {expected}"]
