"""The communication test: share of cycles with complete fresh data, and the lateness of each part of a cycle.

Judged as libfranka's `examples/communication_test.cpp` does by its success rate: below `SUFFICIENT_SHARE` the
connection isn't sufficient, below `GOOD_SHARE` it is poor. A period that was skipped counts as one without data.

Tests and tares cycle at zero torque on the fixed grid (`ZeroTorqueLoop`): SYNC out, feedback and torque in, zero torque
out.
"""

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.clock import Clock
from adacd_hil.control.exchange import Exchange
from adacd_hil.control.pacing import make_pacer
from adacd_hil.device.arm import Arm
from adacd_hil.device.arm_report import describe_disabled, describe_faults
from adacd_hil.device.drive import DISABLE_CYCLES, Drive
from adacd_hil.device.network import Master
from adacd_hil.device.torque_sensor import TorqueSensor
from adacd_hil.lab.commission.load_meter import LoadMeter
from adacd_hil.lab.score.evaluation import OLDEST_CYCLES
from adacd_hil.lab.score.run_arrays import CycleColumns, columns_of_records
from adacd_hil.lab.stated_bounds import GOOD_SHARE, SUFFICIENT_SHARE
from adacd_hil.records import JOINTS, ArmCommand, ArmState, CycleRecord, FaultReason
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Frame, Tap


class ZeroTorqueCycle(NamedTuple):
    """One cycle: the arm's state, the cycle's record for the log, and its frames, each with True if it was sent."""

    state: ArmState
    record: CycleRecord
    frames: list[tuple[bool, Frame]]


class ZeroTorqueLoop:
    """Runs cycles at zero torque of an arm whose nodes are Operational. `is_enabling`: `run` enables the drives."""

    def __init__(
        self, settings: Settings, bus: Tap, clock: Clock, arm: Arm, master: Master, is_enabling: bool = False
    ) -> None:
        self.pacer = make_pacer(settings, clock, bus, arm.sync_id)
        self._period_ns = settings.bus.period_ns
        self._clock = clock
        self._bus = bus
        self._arm = arm
        self._is_enabling = is_enabling
        self.is_interrupted = False
        """Whether the end was requested."""
        self.device_faults: list[str] = []
        """Lines on the devices at the end of the last `run`, before it disabled the drives; empty without a fault."""
        self._exchange = Exchange(settings, bus, arm, master, self.pacer, clock)
        self._max_age_cycles = settings.bus.max_age_cycles

    def interrupt(self) -> None:
        """Make `run` after the present cycle, and every later `run` at once, disable the drives and end.

        Safe in a signal handler.
        """
        self.is_interrupted = True

    def run(
        self,
        duration_s: float,
        observe: Callable[[ZeroTorqueCycle], None],
        is_over: Callable[[], bool] = lambda: False,
    ) -> FaultReason:
        """Run cycles for a duration, then disable the drives; return the fault that ended the cycles, NONE without one.

        observe: called with each cycle but those that disable. is_over: ends the cycles earlier when it returns True.
        After `interrupt` only the cycles that disable are run. A fault counts only if the loop enables the drives; then
        a quick stop disables them. Stores `device_faults`. Raises BusError if the bus fails; the drives are then not
        disabled.
        """
        last_ns = self._clock.now_ns() + round(duration_s * 1e9) - self._period_ns
        fault = FaultReason.NONE
        while self._clock.now_ns() < last_ns and not (self.is_interrupted or is_over() or fault):
            cycle = self.step(self._is_enabling)
            fault = self._fault(cycle.state)
            observe(cycle)
        never = self._is_enabling and not self._arm.was_enabled
        self.device_faults = [*describe_faults(self._arm), *(describe_disabled(self._arm) if never else ())]
        self.disable(quick_stop=fault is not FaultReason.NONE)
        return fault

    def _fault(self, state: ArmState) -> FaultReason:
        """Return the fault of a cycle: DATA_AGE if the arm is enabled and a value is too old, else the arm's.

        Too old: more than `bus.max_age_cycles`. NONE without a fault, and always if the loop doesn't enable the drives.
        """
        if not self._is_enabling:
            return FaultReason.NONE
        if state.is_enabled and max(*state.age_q, *state.age_tau_J) > self._max_age_cycles:
            return FaultReason.DATA_AGE
        return state.fault

    def disable(self, quick_stop: bool = False) -> None:
        """Run `DISABLE_CYCLES` cycles that disable the drives; quick_stop: by a quick stop.

        Raises BusError if the bus fails.
        """
        for _ in range(DISABLE_CYCLES):
            self.step(quick_stop=quick_stop)

    def step(self, is_enabling: bool = False, quick_stop: bool = False) -> ZeroTorqueCycle:
        """Run one cycle at zero torque, and return it.

        is_enabling, quick_stop: parts of the command to the drives; without either they are disabled. Raises BusError
        if the bus fails, in lockstep SilenceError if no device answers.
        """
        tick, arm = self._exchange.turn()
        self._exchange.leave()
        record = self._exchange.end(tick, arm, ArmCommand(np.zeros(JOINTS), is_enabling, quick_stop))
        return ZeroTorqueCycle(arm, record, self._bus.take_passed())


_LOAD_CYCLES = 1000
"""Cycles at the end of the test from whose frames the bus load is computed."""


class Verdict(Enum):
    """Verdict on the share of complete cycles."""

    GOOD = "good"
    WARNING = "warning"
    NOT_SUFFICIENT = "not sufficient"


def judge(share: float) -> Verdict:
    """Return the verdict on a share 0…1 of periods with complete fresh data.

    NOT_SUFFICIENT is below `SUFFICIENT_SHARE`, GOOD is from `GOOD_SHARE` on.
    """
    if share < SUFFICIENT_SHARE:
        return Verdict.NOT_SUFFICIENT
    return Verdict.WARNING if share < GOOD_SHARE else Verdict.GOOD


@dataclass
class CommunicationTest:
    """Collects the cycles of a test, by `observe_cycle`, and judges them.

    Bitrate, data_bitrate: bit/s, 0 without CAN FD. is_enabling: whether the drives shall be enabled. complete: number
    of cycles with complete fresh data. overruns: number of periods skipped after the first cycle. enabled: number of
    cycles with both drives enabled.
    """

    settings: Settings
    arm: Arm
    bitrate: int
    data_bitrate: int = 0
    is_enabling: bool = False
    complete: int = 0
    overruns: int = 0
    enabled: int = 0
    _t_ns: list[int] = field(default_factory=list)
    _records: list[CycleRecord] = field(default_factory=list)
    _ages: list[tuple[int, ...]] = field(default_factory=list)
    _recent: deque[ZeroTorqueCycle] = field(default_factory=lambda: deque(maxlen=_LOAD_CYCLES))

    def observe_cycle(self, cycle: ZeroTorqueCycle, log_queue_bytes: int = 0) -> CycleRecord:
        """Add a cycle to the test; return its record for the log, with the overruns so far and `log_queue_bytes`.

        Periods skipped before the first cycle are not overruns. log_queue_bytes: size of the records that wait for the
        log's writer.
        """
        state = cycle.state
        ages = (*state.age_q, *state.age_tau_J)
        if self._ages:  # periods skipped before the first cycle don't count
            self.overruns += state.periods - 1
        self.complete += state.is_complete
        self.enabled += state.is_enabled
        self._ages.append(ages)
        self._recent.append(cycle)
        record = cycle.record._replace(overruns=self.overruns, log_queue_bytes=log_queue_bytes)
        self._t_ns.append(state.t_ns)
        self._records.append(record)
        return record

    @property
    def cycles(self) -> int:
        """Number of cycles observed so far, without skipped periods."""
        return len(self._ages)

    @property
    def periods(self) -> int:
        """Number of periods, including those skipped after the first cycle."""
        return self.cycles + self.overruns

    @property
    def share(self) -> float:
        """Share of the periods with complete fresh data; 0 without periods."""
        return self.complete / self.periods if self.periods else 0.0

    @property
    def verdict(self) -> Verdict:
        """Verdict on `share`; NOT_SUFFICIENT if drives that shall be enabled never were."""
        return Verdict.NOT_SUFFICIENT if self.is_enabling and not self.enabled else judge(self.share)

    @cached_property
    def columns(self) -> CycleColumns:
        """The cycles as columns of /cycle, made at the first use and then kept: use it when the test is over.

        feedback_ns is -1 for an incomplete cycle.
        """
        return columns_of_records(self._t_ns, self._records)

    def devices(self) -> dict[str, dict[str, Any]]:
        """Return the results of each device, by its name and for JSON.

        share: of the periods with a fresh value; ages: number of cycles by age of the value in cycles, the last for all
        older ones, from the first fresh value on; never: cycles before that; checks: number of frames by result of the
        end-to-end check, and implausible ones; is_protected: whether it has that check.
        """
        devices: tuple[Drive | TorqueSensor, ...] = (*self.arm.drives, *self.arm.sensors)
        ages = np.array(self._ages, dtype=np.int64).reshape(self.cycles, len(devices)).T
        return {device.name: self._device(device, own) for device, own in zip(devices, ages, strict=True)}

    def _device(self, device: Drive | TorqueSensor, ages: NDArray[np.int64]) -> dict[str, Any]:
        seen = ages[np.cumsum(ages == 0) > 0]
        counts = np.bincount(np.minimum(seen, OLDEST_CYCLES), minlength=OLDEST_CYCLES + 1)
        checks = {status.name: count for status, count in device.end_to_end.tally()} if device.is_protected else {}
        checks["IMPLAUSIBLE"] = device.implausible_frames
        return {
            "share": int(np.count_nonzero(ages == 0)) / self.periods if self.periods else 0.0,
            "ages": counts.tolist(),
            "never": len(ages) - len(seen),
            "checks": checks,
            "is_protected": device.is_protected,
        }

    def load_percent(self) -> float:
        """Return the bus load, percent, over the last `_LOAD_CYCLES`, sent and received; 0 without cycles.

        Skipped periods count as time. Error frames, and frames of a length that the contract's bus can't have, are left
        out.
        """
        meter = LoadMeter(self.bitrate, self.data_bitrate, 0)
        for cycle in self._recent:
            for _, frame in cycle.frames:
                with suppress(ValueError):  # a foreign frame whose length the contract's bus can't have
                    meter.count_frame(frame)
        periods = sum(cycle.state.periods for cycle in self._recent)
        return meter.take_percent(periods * self.settings.bus.period_ns)
