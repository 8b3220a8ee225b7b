"""The emulated devices around a recorded arm: the answers to SYNC come from a recording, all else from live nodes.

Object dictionary, NMT and CiA 402 states, heartbeats, status frames, EMCY and watchdogs are those of `Bench`, so any
host can boot and command the devices. Torque has no effect: the arm repeats its recorded motion.

The bench reads the recording as the host asks for it. An attempt begins with the first SYNC of the recording, and with
the first after an NMT reset, so a run that recovered from a fault has several. In each the cycles count from its first
SYNC by the SYNC counter, as the bench counts them; SYNCs that were lost leave a gap.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.frames.frame_log import of_one_channel, open_frames
from adacd_hil.records import JOINTS, Vector
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_frames import SYNC_OVERFLOW
from adacd_hil.wire.time_marks import ANSWERS, answers_to_sync
from firmware_sim.arm.joint_forces import REFERENCE_C
from firmware_sim.arm.sensing import POSITION_LSB_RAD, TORQUE_LSB_NM, VELOCITY_LSB_RAD_S, DriveMode, Measurement
from firmware_sim.bench.bench import Bench, ClockMode
from firmware_sim.canopen.object_dictionary import EmulatedContract
from firmware_sim.nodes.device import RESET_COMMUNICATION, RESET_NODE
from firmware_sim.scenario.scenario import Scenario

RESETS: Final = (bytes([RESET_NODE]), bytes([RESET_COMMUNICATION]))
"""First bytes of the NMT commands that begin an attempt."""
Answer = tuple[int, bytes]
"""Identifier and data."""


RecordedCycle = tuple[tuple[int, int], tuple[Answer, ...]]
"""Attempt and cycle of one SYNC, and its recorded answers; cycles count the SYNCs of the attempt, both from 0."""


class RecordedCycles:
    """The cycles of a recording, read forwards only."""

    def __init__(self, path: Path, codec: Codec) -> None:
        """Open the recording and read its first cycle.

        Raises LogError if it can't be read, CodecError if the DBC lacks Sync, Nmt or one of `ANSWERS`.
        """
        self.attempt = -1
        """Number of the attempt in progress, -1 before the first."""
        self.answered = 0
        """Cycles so far that had an answer."""
        self.is_over = False
        """Whether the recording has no more."""
        self._answer_ids = answers_to_sync(codec)
        self._sync_id, self._nmt_id = (codec.message(name).can_id for name in ("Sync", "Nmt"))
        self._path = path
        self._source = open_frames(path)
        self._cycles = self._read()
        self._next = self._fetch()

    @property
    def problem(self) -> str:
        """One line on the part of the recording that is damaged or missing; empty if it is whole.

        It is complete once the recording is over.
        """
        return self._source.problem

    def begin(self) -> None:
        """Begin the next attempt; `take` then refers to it."""
        self.attempt += 1

    def take(self, cycle: int) -> tuple[Answer, ...]:
        """Return the answers to a cycle of this attempt, () if the recording lacks them.

        Each cycle is returned once, and earlier ones are skipped for good. Counts cycles with answers in `answered`.
        Raises LogError if the recording can't be read on.
        """
        wanted = (self.attempt, cycle)
        while self._next is not None and self._next[0] < wanted:
            self._next = self._fetch()
        if self._next is None or self._next[0] != wanted:
            return ()
        _, answers = self._next
        self._next = self._fetch()
        self.answered += bool(answers)
        return answers

    def _fetch(self) -> RecordedCycle | None:
        found = next(self._cycles, None)
        self.is_over = found is None
        return found

    def _read(self) -> Iterator[RecordedCycle]:
        answers: list[Answer] = []
        attempt, cycle, counter = -1, 0, 0
        is_reset = True
        for can_id, data in self._frames():
            if can_id == self._nmt_id:
                is_reset = is_reset or data[:1] in RESETS
            elif can_id != self._sync_id:
                answers.append((can_id, data))
            else:
                if attempt >= 0:
                    yield (attempt, cycle), tuple(answers)
                answers = []
                now = data[0] if data else 0
                if is_reset:
                    attempt, cycle, is_reset = attempt + 1, 0, False
                else:
                    cycle += (now - counter) % SYNC_OVERFLOW if now and counter else 1
                counter = now
        if attempt >= 0:
            yield (attempt, cycle), tuple(answers)

    def _frames(self) -> Iterator[Answer]:
        """Yield identifier and data of SYNC, NMT and the answers, in the order of the bus.

        Error frames, remote frames and those with extended identifiers are left out.
        """
        for chosen in of_one_channel(map(self._chosen, self._source), self._source.channels, self._path):
            for can_id, length, data in zip(
                chosen["can_id"].tolist(), chosen["length"].tolist(), chosen["data"], strict=True
            ):
                yield can_id, data[:length].tobytes()

    def _chosen(self, frames: NDArray[Any]) -> NDArray[Any]:
        is_data = ~frames["is_error"] & ~frames["is_remote"] & ~frames["is_extended"]
        is_wanted = np.isin(frames["can_id"], [self._sync_id, self._nmt_id, *self._answer_ids])
        return np.asarray(frames[is_data & is_wanted])


_TORQUE = DriveMode.TORQUE


class RecordedBody:
    """The recorded arm in place of a `Body`: for the nodes' objects and standstill. It has no truth."""

    has_ideal_motors = True
    is_torque_limited = (False, False)
    motor_error_code = (0, 0)
    joint_temperature_C = (REFERENCE_C, REFERENCE_C)

    def __init__(self, codec: Codec) -> None:
        self.motor_torque_Nm = (0.0, 0.0)
        """Torque of motors that follow at once."""
        messages = [codec.message(name) for name in ANSWERS]
        self._sources = {message.can_id: (place % JOINTS, message) for place, message in enumerate(messages)}
        self._values = {name: [0.0, 0.0] for name in ("position", "velocity", "torque")}

    @property
    def drive_velocity_rad_s(self) -> tuple[float, float]:
        """Velocity in the latest recorded feedback of each drive, rad/s; 0 before the first."""
        first, second = self._values["velocity"]
        return first, second

    def show(self, answers: Sequence[Answer]) -> None:
        """Store position, velocity and torque from recorded answers (identifier, data).

        Answers of wrong length are skipped.
        """
        for can_id, data in answers:
            place, message = self._sources[can_id]
            if len(data) == message.length:
                for signal, value in zip(message.signals, message.decode(data), strict=True):
                    if signal.name in self._values:
                        self._values[signal.name][place] = value

    def start_scenario(self) -> None:
        """Ignore the start: the recording already has all faults and contacts."""

    def advance(
        self,
        torque_setpoint_Nm: Sequence[float],
        drive_mode: Sequence[int],
        tick_count: int | None = None,  # noqa: ARG002 (the body's signature)
    ) -> None:
        """Set `motor_torque_Nm` to the set-points of drives in torque mode, else to 0; don't move the recorded arm.

        tick_count has no effect.
        """
        first_Nm, second_Nm = torque_setpoint_Nm
        self.motor_torque_Nm = first_Nm * (drive_mode[0] == _TORQUE), second_Nm * (drive_mode[1] == _TORQUE)

    def sample(self) -> Measurement:
        """Return the latest recorded values in the default counts of position, velocity and torque, 0 before any."""
        return Measurement(
            _counts(self._values["position"], POSITION_LSB_RAD),
            _counts(self._values["velocity"], VELOCITY_LSB_RAD_S),
            _counts(self._values["torque"], TORQUE_LSB_NM),
        )

    def truth(self, out: Vector) -> None:
        """Leave `out` unchanged: a recording has no truth."""


class RecordedBench(Bench):
    """A bench whose cyclic frames come from a recording, or from another sender on the bus; all else is live."""

    def __init__(
        self,
        scenario: Scenario,
        codec: Codec,
        send: Callable[[int, bytes], None],
        cycles: RecordedCycles | None,
        *,
        clock_mode: ClockMode = "sync",
        contract: EmulatedContract | None = None,
        on_answer: Callable[[], None] = lambda: None,
    ) -> None:
        """Build everything as `Bench` does. `scenario`: without faults. `cycles`: None: SYNC gets no cyclic answer.

        The other arguments are as of `Bench`.
        """
        self._cycles = cycles
        self._answers_now: tuple[Answer, ...] = ()
        self._codec = codec
        self._body_now = RecordedBody(codec)
        self._is_reset = True
        self._first_cycle = 0
        super().__init__(
            scenario, codec, send, clock_mode=clock_mode, contract=contract, on_answer=on_answer, arm=self._body_now
        )

    def outlive_host(self) -> None:
        """Ignore the loss of the host: the recording moves the arm with or without it."""

    def _on_nmt(self, data: bytes, t_ns: int) -> None:
        super()._on_nmt(data, t_ns)
        self._is_reset = self._is_reset or data[:1] in RESETS

    def _answer(self, data: bytes, t_ns: int, late_ns: int) -> None:
        if self._cycles is not None:
            if self._is_reset:
                self._is_reset = False
                self._first_cycle = self.cycle
                self._cycles.begin()
            self._answers_now = self._cycles.take(self.cycle - self._first_cycle)
            self._body_now.show(self._answers_now)
        super()._answer(data, t_ns, late_ns)

    @property
    def _is_plain(self) -> bool:
        is_whole = sorted(can_id for can_id, _ in self._answers_now) == sorted(self._nodes.answers)
        return is_whole and super()._is_plain

    def _listen(self) -> None:
        super()._listen()
        self._nodes.senders = ((0, self._send_recorded),) if self._nodes.senders else ()

    def _send_recorded(self) -> None:
        for can_id, data in self._answers_now:
            self._outbox.put(can_id, data)


def _counts(values: Sequence[float], lsb: float) -> tuple[int, int]:
    return round(values[0] / lsb), round(values[1] / lsb)
