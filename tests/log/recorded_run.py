"""A run made of random numbers, a recorder that is fed with it, and the log as others read it.

Every field has a value of its own.
"""

import collections
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from adacd_hil.log.mcap.record_layout import MESSAGE_HEAD
from adacd_hil.log.reader import Series
from adacd_hil.log.recording.recorder import LogSummary, Recorder
from adacd_hil.log.types.topics import CONTROL, CYCLE, ChannelId, pack_arm, pack_contact, pack_scheme
from adacd_hil.records import (
    CONTROL_LAYOUT,
    ArmState,
    ContactKind,
    ContactLevel,
    ContactReport,
    CycleRecord,
    Event,
    FaultReason,
    Location,
    Reaction,
    Request,
    SchemeOutput,
    SchemeState,
    scheme_layout,
)
from adacd_hil.wire.bus import Frame
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.dbc_contract import load_codec, parse_codec
from adacd_hil.wire.frame_lengths import FD_LENGTHS

PERIOD_NS = 1_000_000
CODEC = load_codec()
CYCLIC = (
    "Sync",
    "Drive1Command",
    "Drive2Command",
    "Drive1Feedback",
    "Drive2Feedback",
    "Sensor1Torque",
    "Sensor2Torque",
)
CONTACT = (ContactLevel.COLLISION, ContactKind.HIT, Reaction.FLOAT, Location.SINGULAR, True)
UNKNOWN_ID = 0x7A5
LONG_ID = 0x3A5


@dataclass
class Cycle:
    t_ns: int
    arm: ArmState
    output: SchemeOutput
    request: Request
    control: np.ndarray
    gate_flags: int
    record: CycleRecord
    frames: list[tuple[bool, Frame]]
    contact: ContactReport | None = None
    event: Event | None = None

    def messages(self):
        messages = [
            (ChannelId.SCHEME, pack_scheme(self.output, self.request)),
            (ChannelId.ARM, pack_arm(self.arm, 5)),
            (ChannelId.CONTROL, CONTROL.pack(self.output.cycle, self.gate_flags, True, False, block=self.control)),
            (ChannelId.CYCLE, CYCLE.pack(*self.record)),
        ]
        if self.contact is not None:
            messages.append((ChannelId.CONTACT, pack_contact(self.contact)))
        return messages


@dataclass
class Run:
    cycles: list[Cycle]
    parameter_count: int = 7
    attachments: dict[str, bytes] = field(default_factory=lambda: {"arm.dbc": CODEC.text, "run.toml": b'name = "x"\n'})
    metadata: dict[str, str] = field(default_factory=lambda: {"interface": "embedded", "name": "Prüfung"})

    @property
    def blocks(self):
        return np.array([cycle.output.block for cycle in self.cycles])

    @property
    def frames(self):
        """List (t_ns of the cycle, is_tx, frame)."""
        return [
            (cycle.t_ns, is_tx, frame._replace(data=bytes(frame.data)))
            for cycle in self.cycles
            for is_tx, frame in cycle.frames
        ]


def make_run(count, seed=1, parameter_count=7, start_ns=5_000_000_123, has_fd=False):
    generator = np.random.default_rng(seed)
    layout = scheme_layout(parameter_count)
    cycles = []
    for number in range(count):
        t_ns = start_ns + number * PERIOD_NS
        block = generator.normal(size=layout.size)
        block[layout.slices["threshold"]] = np.inf if number % 7 else np.nan
        output = SchemeOutput(
            cycle=number,
            state=SchemeState(number % len(SchemeState)),
            previous_state=SchemeState((number + 3) % len(SchemeState)),
            fault=FaultReason((number + 1) % len(FaultReason)),
            contact_joints=number % 4,
            is_model_valid=number % 2 == 1,
            theta_ff=block[:parameter_count],
            tau_ext_hat=block[:2],
            contact=None,
            block=block,
        )
        cycle = Cycle(
            t_ns=t_ns,
            arm=_arm_state(number, t_ns, block, layout.slices),
            output=output,
            request=Request(number % len(Request)),
            control=generator.normal(size=CONTROL_LAYOUT.size),
            gate_flags=number % 251,
            record=CycleRecord(
                number,
                -number,
                3 * number,
                2**40 + number,
                number,
                -7,
                2,
                7,
                number % 5,
                number % 3,
                4,
                number % 11,
                9,
                8,
            ),
            frames=_frames(generator, t_ns, number),
        )
        if has_fd:
            cycle.frames[3:3] = _long_frames(generator, t_ns, number)
        if number % 50 == 20:
            head = (number, 2, (-1, 1), (1.5, -2.5), (0.25, number), number % 100 == 20)
            cycle.contact = ContactReport(*head, *CONTACT, (0.1, 0.2), (0.3, 0.4), 10.0, 0.5, 0.2, 0.01, 0.05)
        if number % 40 == 10:
            level = ("info", "warning", "error")[number // 40 % 3]
            cycle.event = Event(level, f"name{number}", f"Nachricht {number}: θ̂ ok")
        cycles.append(cycle)
    return Run(cycles, parameter_count)


def _arm_state(number, t_ns, block, places):
    q, dq, tau_J = (block[places[name]] for name in ("q", "dq", "tau_J"))
    ages = ((number % 3, number % 5), (2**40 + number, number % 2))
    fault = FaultReason(number % len(FaultReason))
    return ArmState(
        number, t_ns, 1 + number % 4, q, dq, tau_J, *ages, number % 2 == 0, number % 3 == 0, fault, False, 2, t_ns - 9
    )


def _frames(generator, t_ns, number):
    frames = []
    for place, name in enumerate(CYCLIC):
        message = CODEC.messages[name]
        frames.append((place < 3, Frame(message.can_id, generator.bytes(message.length), t_ns + 10 * place)))
    if number % 10 == 3:
        frames.append((False, Frame(UNKNOWN_ID, b"\x01\x02\x03", t_ns + 100)))
    if number % 10 == 5:
        frames.append((False, Frame(0x181, generator.bytes(8), t_ns + 200, is_error=True)))
    if number % 10 == 6:
        frames.append((False, Frame(0x181, b"short", t_ns + 300)))
    if number % 10 == 7:
        frames.append((False, Frame(0x18DAF110, bytearray(b"extended"), t_ns - 5_000_000)))  # stamped late
    return frames


def _long_frames(generator, t_ns, number):
    """Make an FD frame each way, of every length in turn, of which the first is in the DBC of `fd_codec`."""
    length = FD_LENGTHS[number % len(FD_LENGTHS)]
    return [
        (number % 2 == 0, Frame(LONG_ID, generator.bytes(length), t_ns + 25)),
        (number % 2 == 1, Frame(0x18DAF111, generator.bytes(length), t_ns + 26)),
    ]


LONG = f"BO_ {LONG_ID} Long: 24 Drive1\n" + "".join(
    f' SG_ part{n} : {32 * n}|32@1- (0.5,0) [0|0] "Nm" HOST\n' for n in range(6)
)


def fd_codec(more: str = "") -> Codec:
    """Return the contract with `Long`, an FD message of 24 bytes, and with `more` messages."""
    text = CODEC.text.decode()
    place = text.index("BO_ ")
    kinds = ",".join(['"StandardCAN"', *['"other"'] * 13, '"StandardCAN_FD"'])
    is_fd = f'BA_DEF_ BO_ "VFrameFormat" ENUM {kinds};\nBA_ "VFrameFormat" BO_ {LONG_ID} 14;\n'
    return parse_codec((text[:place] + LONG + "\n" + more + text[place:] + is_fd).encode(), CODEC.path)


def start(path: Path, run: Run, **options) -> Recorder:
    options = {"blocking": True, "messages": CODEC.messages.values(), **options}
    return Recorder(
        path,
        parameter_count=run.parameter_count,
        attachments=run.attachments,
        metadata=run.metadata,
        **options,
    )


def feed(recorder: Recorder, cycles: list[Cycle]) -> None:
    for cycle in cycles:
        recorder.cycle(cycle.t_ns, cycle.messages(), cycle.frames)
        if cycle.event is not None:
            recorder.event(cycle.t_ns, cycle.event)


def record(path: Path, run: Run, **options) -> LogSummary:
    recorder = start(path, run, **options)
    feed(recorder, run.cycles)
    return recorder.close()


def payloads(series: Series) -> bytes:
    """Return the payloads of a topic of fixed size, one after the other."""
    rows = np.ascontiguousarray(series.records).view(np.uint8).reshape(len(series), series.records.dtype.itemsize)
    return rows[:, MESSAGE_HEAD:].tobytes()


def wait_until_taken(recorder: Recorder) -> None:
    """Wait until the writer has taken every packet of a recorder in real time."""
    recorder.flush()
    while recorder.waiting_bytes:
        os.sched_yield()


def by_others(path: Path) -> dict[str, list]:
    """Read each topic's messages as (message, decoded) with mcap and mcap_ros2."""
    messages = collections.defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
            messages[channel.topic].append((message, decoded))
    return messages


def plain_frames(frames: np.ndarray) -> list[tuple[int, bool, Frame]]:
    """List frames of a log as (t_ns of the cycle, is_tx, frame)."""
    return [
        (
            int(f["cycle_t_ns"]),
            bool(f["is_tx"]),
            Frame(int(f["can_id"]), f["data"].tobytes()[: f["length"]], int(f["t_ns"]), bool(f["is_error"])),
        )
        for f in frames
    ]
