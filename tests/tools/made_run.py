"""A run written by hand, cycle by cycle, for the judges of run_rules.py: everything right unless changed."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from crccheck.crc import Crc8Autosar
from wire_record import Passed, WireRecord, data_ids
from witnessed_run import Played, Truth

from adacd_hil.log.reader import LoggedEvent
from adacd_hil.log.types.truth_topic import TRUTH_LAYOUT
from adacd_hil.records import Event, FaultReason, Request, SchemeState
from adacd_hil.settings.configuration import Settings
from adacd_hil.settings.configuration_files import load_settings
from adacd_hil.wire.dbc_contract import contract_folder
from firmware_sim.scenario.scenario import Scenario

PERIOD_NS = 1_000_000
COMMISSION, ENABLED, ARMED = 10, 230, 300
"""Cycles in which the drives begin to be commissioned, are enabled, and detection is armed."""
DBC = (contract_folder() / "arm.dbc").read_bytes()
ENABLED_WORD, DISABLED_WORD = 0x0027, 0x0040


@cache
def crc_of(data: bytes) -> int:
    """Compute the CRC of AUTOSAR Profile 2 with code that is not ours, and slow."""
    return int(Crc8Autosar.calc(data))


def usual_state(cycle: int) -> SchemeState:
    """Return where a run without trouble stands."""
    if cycle >= ARMED:
        return SchemeState.MONITOR
    return SchemeState.ADAPT if cycle >= ENABLED + 4 else SchemeState.COMMISSION


def states(*changes: tuple[int, SchemeState]) -> Callable[[int], SchemeState]:
    """Return where a run stands that leaves the usual states for others at some cycles, in order."""

    def state(cycle: int) -> SchemeState:
        own = usual_state(cycle)
        for begin, value in changes:
            own = value if cycle >= begin else own
        return own

    return state


@dataclass
class Made:
    """One run. Every callable gives a value by cycle; what is in `extra` is put before the commands of its cycle.

    Commands carry a torque from 5 cycles after enabling to 10 cycles before the end; `torques` replaces single ones.
    """

    cycles: int = 600
    torque: Callable[[int], int] | None = None
    torques: dict[int, int] = field(default_factory=dict)
    controlword: Callable[[int], int] = lambda cycle: 0x0F if cycle >= ENABLED else 0x00
    statusword: Callable[[int], int] = lambda cycle: ENABLED_WORD if cycle >= ENABLED + 3 else DISABLED_WORD
    state: Callable[[int], SchemeState] = usual_state
    request: Callable[[int], Request] = lambda cycle: Request.NONE
    position_rad: Callable[[int], float] = lambda cycle: 0.0
    velocity_rad_s: Callable[[int], float] = lambda cycle: 0.0
    tau_f: Callable[[int], float] = lambda cycle: 1e-4 * cycle
    tau_ext: Callable[[int], float] = lambda cycle: 0.0
    true_speed: Callable[[int], float] = lambda cycle: 0.0
    has_feedback: Callable[[int], bool] = lambda cycle: True
    faults: Callable[[int], int] = lambda cycle: 0
    command: Callable[[int, int, bytes], list[bytes]] = lambda cycle, joint, data: [data]
    sync: Callable[[int], int] = lambda cycle: 1 + cycle % 240
    extra: dict[int, list[tuple[bool, int, bytes]]] = field(default_factory=dict)
    events: list[tuple[int, str, str, str]] = field(default_factory=list)
    scenario: Scenario = field(default_factory=Scenario)
    settings: Settings = field(default_factory=load_settings)
    changes: dict[str, Any] = field(default_factory=dict)

    def torque_of(self, cycle: int) -> int:
        if self.torque is not None:
            return self.torque(cycle)
        return self.torques.get(cycle, 10 if ENABLED + 5 <= cycle < self.cycles - 10 else 0)

    def play(self) -> Played:
        """Write the frames, the truth and the log."""
        passed = [Passed(0, True, 0x000, b"\x82\x00")]
        ids = {0x183: b"", 0x184: b"", 0x201: b"", 0x202: b""}
        database = WireRecord(DBC, passed).database
        for can_id in ids:
            ids[can_id] = data_ids(database.get_message_by_frame_id(can_id))

        def signed(can_id: int, counter: int, payload: bytes) -> bytes:
            rest = bytes([counter]) + payload
            return bytes([crc_of(rest + ids[can_id][counter : counter + 1])]) + rest

        for cycle in range(self.cycles):
            t_ns = (cycle + 1) * PERIOD_NS
            passed.append(Passed(t_ns, True, 0x080, bytes([self.sync(cycle)])))
            counts = round(self.position_rad(cycle) / 5.9921124526782858e-06)
            speed = round(self.velocity_rad_s(cycle) / 0.0005)
            feedback = counts.to_bytes(4, "little", signed=True) + speed.to_bytes(4, "little", signed=True)
            for joint in (0, 1):
                if self.has_feedback(cycle):
                    passed.append(Passed(t_ns + 100_000, False, 0x181 + joint, feedback))
                torque = signed(0x183 + joint, cycle % 16, (1000 * (cycle % 64)).to_bytes(4, "little", signed=True))
                passed.append(Passed(t_ns + 200_000, False, 0x183 + joint, torque))
            if cycle % 100 == 0 or self.statusword(cycle) != self.statusword(cycle - 1):
                word = self.statusword(cycle).to_bytes(2, "little")
                status = word + b"\x0a" + bytes(4)
                passed += [Passed(t_ns + 300_000, False, 0x281 + joint, status) for joint in (0, 1)]
            passed += [Passed(t_ns + 350_000, *frame) for frame in self.extra.get(cycle, [])]
            for joint in (0, 1):
                payload = self.controlword(cycle).to_bytes(2, "little")
                payload += self.torque_of(cycle).to_bytes(2, "little", signed=True)
                frames = self.command(cycle, joint, signed(0x201 + joint, cycle % 16, payload))
                passed += [Passed(t_ns + 400_000, True, 0x201 + joint, data) for data in frames]
        return self._played(passed)

    def _played(self, passed: list[Passed]) -> Played:
        cycles = np.arange(self.cycles)
        block = np.zeros((self.cycles, TRUTH_LAYOUT.size))
        for name, value in (("q", self.position_rad), ("dq", self.true_speed), ("tau_ext", self.tau_ext)):
            block[:, TRUTH_LAYOUT.slices[name]] = np.array([[value(cycle)] for cycle in cycles])
        block[:, TRUTH_LAYOUT.slices["tau_J"]] = 1e-3 * cycles[:, None]
        block[:, TRUTH_LAYOUT.slices["faults"]] = np.array([[self.faults(cycle)] for cycle in cycles])
        truth = Truth(cycles, block)
        log: Any = SimpleNamespace(
            scheme=_Rows(
                t_ns=(cycles + 1) * PERIOD_NS,
                state=np.array([int(self.state(cycle)) for cycle in cycles], np.uint8),
                request=np.array([int(self.request(cycle)) for cycle in cycles], np.uint8),
                threshold=np.full((self.cycles, 2), 0.15),
                tau_ext_hat=np.zeros((self.cycles, 2)),
                tau_f=np.array([[self.tau_f(cycle)] * 2 for cycle in cycles]),
                tau_f_hat=np.zeros((self.cycles, 2)),
            ),
            events=[
                LoggedEvent((cycle + 1) * PERIOD_NS, Event(level, name, text))
                for cycle, level, name, text in self.events
            ],
            contacts=[],
            is_complete=True,
            problem="",
            summary={},
        )
        result = SimpleNamespace(state=SchemeState.MONITOR, fault=FaultReason.NONE)
        summary: Any = SimpleNamespace(result=result, error="")
        played: dict[str, Any] = {
            "settings": self.settings,
            "scenario": self.scenario,
            "wire": WireRecord(DBC, passed),
            "truth": truth,
            "log": log,
            "summary": summary,
            "crash": "",
            "overdue": "",
            "finish_ns": None,
            "end_ns": self.cycles * PERIOD_NS,
            "enabled_at_end": (False, False),
        }
        # The end of a real run: drives disabled, without torque.
        return Played(**played | self.changes)


class _Rows(dict[str, Any]):
    """Columns of a topic, as adacd_hil.log.reader.Series has them."""

    def __init__(self, t_ns: Any, **columns: Any) -> None:
        super().__init__(columns)
        self.t_ns = t_ns

    def __len__(self) -> int:
        return len(self.t_ns)
