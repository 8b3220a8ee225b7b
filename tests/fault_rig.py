"""Host and emulator in one process with a scenario's faults, in lockstep or on the real-time grid in virtual time."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from fault_table import Case, Expected, Wire, rows_of
from rig import CycleRig, Rig, SessionRig, scripted

from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.log.reader import RunLog
from adacd_hil.log.types.topics import DECODED
from adacd_hil.records import Event, FaultReason, SchemeState
from adacd_hil.settings.parsing import parse
from adacd_hil.wire.bus import BusError, Frame
from firmware_sim.scenario.scenario import Scenario

AFTER_S = 1.2  # how long a run of the campaign goes on after the onset


class Outcome(NamedTuple):
    """What came of a run. `onset`, `faulted`: cycles, -1 for never.

    `edges`: cycle and text; `masks`: the truth's, by cycle; `wire`: cycle and identifier of all that the devices have
    sent since the first edge.
    """

    fault: str
    error: str
    onset: int
    faulted: int
    log: RunLog
    edges: list[tuple[int, str]]
    masks: list[int]
    wire: list[tuple[int, int]]

    def sent(self, can_id: int, cycles: int) -> int:
        """Count what the devices sent with an identifier in the first cycles of the faults."""
        return sum(found == can_id and cycle < self.onset + cycles for cycle, found in self.wire)

    @property
    def delay_ms(self) -> int | None:
        """From onset to FAULT."""
        return None if self.faulted < 0 or self.onset < 0 else self.faulted - self.onset

    @property
    def collisions(self) -> int:
        """Stops by the detector."""
        states = self.log.scheme["state"]
        return int(np.count_nonzero((states[1:] == SchemeState.REACT) & (states[:-1] != SchemeState.REACT)))

    @property
    def reason(self) -> str:
        """What the log says of the fault."""
        said = [entry.event.message for entry in self.log.events if "-> FAULT" in entry.event.message]
        return said[0] if said else ""

    @property
    def late_commands(self) -> int:
        """Commands that missed the SYNC that they were for."""
        return int(self.log.cycle["commands_late"].sum()) if self.log.cycle.t_ns.size else 0

    @property
    def missing_frames(self) -> int:
        """Cyclic frames that weren't in by the end of their cycle, from the onset to the fault or the end."""
        if not self.log.cycle.t_ns.size:
            return 0
        cycles = self.log.cycle["cycle"]
        is_meant = (cycles >= self.onset) & ((self.faulted < 0) | (cycles <= self.faulted))
        return int(self.log.cycle["frames_missing"][is_meant].sum())

    def torques_since_fault(self) -> int:
        """Count the commands with a torque from the cycle of the fault on."""
        (at, *_) = np.flatnonzero(self.log.scheme["cycle"] == self.faulted)
        start_ns = self.log.scheme.t_ns[at]
        commands = [self.log.topics[f"{DECODED}{name}"] for name in ("Drive1Command", "Drive2Command")]
        return sum(int(np.count_nonzero(c["target_torque"][c.t_ns >= start_ns])) for c in commands)


def play(case: Case, clock: str, folder: Path) -> Outcome:
    """Run one case of the campaign by `lockstep` or `realtime`."""
    run = run_lockstep if clock == "lockstep" else run_realtime
    return run(folder, rows_of(case), finish_s=max(case.at_s, 0.0) + AFTER_S)


def deviations(outcome: Outcome, expected: Expected, wire: tuple[Wire, ...]) -> list[str]:
    """Say in what a run isn't as its row says, one line each."""
    checks = [
        ("error", outcome.error[: len(expected.error) or None], expected.error),
        ("collisions", outcome.collisions, expected.collisions),
        *(
            (f"frames 0x{seen.can_id:03X} in {seen.cycles} cycles", outcome.sent(seen.can_id, seen.cycles), seen.frames)
            for seen in wire
        ),
    ]
    lines = [f"{what} = {found!r}, {due!r} expected" for what, found, due in checks if found != due]
    if not next((text for _, text in outcome.edges), "").startswith("begins: "):
        lines.append("no fault ever began")
    if outcome.fault not in (expected.fault or ("NONE", "")):
        due = " or ".join(expected.fault) or "none"
        lines.append(f"fault = {outcome.fault} after {outcome.delay_ms} ms ({outcome.reason}), {due} expected")
    elif expected.fault:
        lines += _late(outcome, expected)
    return lines


def _late(outcome: Outcome, expected: Expected) -> list[str]:
    lines = []
    if outcome.delay_ms is None or not expected.low_ms <= outcome.delay_ms <= expected.high_ms:
        lines.append(f"fault after {outcome.delay_ms} ms, {expected.low_ms} to {expected.high_ms} ms expected")
    if expected.says not in outcome.reason:
        lines.append(f"the log says {outcome.reason!r}, {expected.says!r} expected")
    if torques := outcome.torques_since_fault():
        lines.append(f"{torques} commands with a torque since the fault")
    return lines


def scenario_of(rows: list[dict[str, Any]]) -> Scenario:
    return parse(Scenario, {"name": "faults", "start_deg": [-30.0, -60.0], "seed": 1, "faults": rows})


class _Watched(Rig):
    """A rig that remembers what both kinds of run are judged by."""

    def __init__(self, *place: Any, **parts: Any) -> None:
        self.edges: list[tuple[int, str]] = []
        self.masks: list[int] = []
        self.wire: list[tuple[int, int]] = []
        self._syncs = 0
        self._is_in_frame = False
        super().__init__(*place, on_truth=self._on_truth, on_event=self._on_event, **parts)

    @property
    def host_cycle(self) -> int:
        """The host's cycle whose SYNC is on the bus; between two SYNCs, that of the next."""
        return self._syncs - 1 if self._is_in_frame else self._syncs

    def on_frame(self, frame: Frame) -> None:
        """Pass on what the host sends."""
        self._syncs += frame.can_id == 0x080
        self._is_in_frame = True
        super().on_frame(frame)
        self._is_in_frame = False

    def deliver(self, can_id: int, data: bytes) -> None:
        """Pass on what a device sends."""
        if self.edges:
            self.wire.append((self.host_cycle, can_id))
        super().deliver(can_id, data)

    def _on_event(self, _t_ns: int, event: Event) -> None:
        self.edges.append((self.host_cycle, event.message))

    def _on_truth(self, _cycle: int, _t_ns: int, block: Any) -> None:
        self.masks.append(int(block[-1]))

    def outcome(self, fault: str, error: str, log: RunLog) -> Outcome:
        states = log.scheme["state"] if log.scheme.t_ns.size else np.zeros(0)
        at = np.flatnonzero(states == SchemeState.FAULT)
        onsets = [cycle for cycle, text in self.edges if text.startswith("begins")]
        faulted = int(log.scheme["cycle"][at[0]]) if at.size else -1
        return Outcome(fault, error, onsets[0] if onsets else -1, faulted, log, self.edges, self.masks, self.wire)


class _WatchedSession(_Watched, SessionRig):
    """A session on the modelled bus, watched."""


class _WatchedCycle(_Watched, CycleRig):
    """A real-time cycle over a transmit queue, watched."""


def run_lockstep(
    folder: Path, rows: list[dict[str, Any]], finish_s: float = 2.0, acknowledge_faults: int = 0
) -> Outcome:
    """Run a session in lockstep on the embedded bus."""
    settings = scripted("paper", finish_s, acknowledge_after_s=0.6, acknowledge_faults=acknowledge_faults)
    rig = _WatchedSession(folder, settings, scenario_of(rows), is_modelled=True)
    summary, log = rig.run()
    return rig.outcome(summary.result.fault.name if summary.result is not None else "", summary.error, log)


def run_realtime(folder: Path, rows: list[dict[str, Any]], finish_s: float = 2.0, queue_frames: int = 10) -> Outcome:
    """Run the real-time cycle in virtual time against a bench that goes by the clock, over a transmit queue."""
    settings = scripted("paper", finish_s, acknowledge_after_s=0.6)
    rig = _WatchedCycle(folder, settings, scenario_of(rows), is_wall=True)
    fault, error = FaultReason.NONE.name, ""
    try:
        fault = rig.run().fault.name
    except (BusError, DeviceError) as failure:
        error = str(failure)
        rig.recorder.cycle(rig.clock.now_ns(), [], rig.tap.take_passed())
    return rig.outcome(fault, error, rig.read())
