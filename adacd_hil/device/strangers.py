"""Another sender on the bus: it sends frames that only this host, or only one device of the arm, may send.

A CAN frame doesn't name its sender. A frame that only one node may send reveals a second sender:

- Commands, SYNC, NMT, the host's heartbeat and SDO requests to the arm's devices come from this host alone. If the host
  receives one, it has another sender. A sender that only reads objects, as a survey of the bus does, is reported but
  doesn't stop the arm.
- A device answers each SYNC with one cyclic frame. A second, different frame with correct length and CRC is reported.
  Two of them within 0.1 s have another sender: a second device with that node id, or an attack.

CRC and alive counter find errors; they don't protect against intent. See `docs/threat-model.md`.
"""

from collections import deque
from collections.abc import Iterable, Sequence

from adacd_hil.clock import Clock
from adacd_hil.device.arm_watch import RateLimitedEvents
from adacd_hil.device.canopen_bus import DeviceError
from adacd_hil.device.profile import PlacedDevice
from adacd_hil.records import Event
from adacd_hil.settings.configuration import Settings
from adacd_hil.wire.bus import Bus, Frame
from adacd_hil.wire.codec import Codec
from adacd_hil.wire.contract_frames import FUNCTION_MASK, HOST_HEARTBEAT, NMT_ID, SDO_REQUEST_ID

HOSTS_LISTEN_S = 0.3
"""How long a host listens before it resets an arm: 30 SYNCs of the longest period, 3 heartbeats of 100 ms."""
HOLD_S = 1.0
"""How long after another sender's frame the arm counts as another host's, too: ten heartbeats of 100 ms."""
CONTRADICTIONS = 2
"""Number of second frames of a device that is no accident, if they come within CONTRADICTION_WINDOW_S."""
CONTRADICTION_WINDOW_S = 0.1
"""Time within which a device's second frames are counted together."""
_NMT_WORDS = {1: "start", 2: "stop", 128: "pre-operational", 129: "reset node", 130: "reset communication"}
_READING = (2, 3, 5)
"""SDO client commands that only read: upload initiate, segment, block. Source: CiA 301 (4.2), clause 7.2.4.3."""


def host_frames(settings: Settings, codec: Codec, devices: Iterable[PlacedDevice]) -> dict[int, str]:
    """Return, by identifier, the frames that only this host may send.

    The values are words for the action of another sender, such as `sends SYNC`.
    """
    doing = {
        codec.message(HOST_HEARTBEAT).can_id: "sends this host's heartbeat",
        NMT_ID: "sends NMT commands",
    }
    if not settings.bus.follows:
        doing[codec.message("Sync").can_id] = "sends SYNC"
    for device in devices:
        name = _plain(device.name)
        doing[SDO_REQUEST_ID + device.node_id] = f"writes objects of {name}"
        if device.settings.kind == "drive":
            doing[codec.message(f"{device.name}Command").can_id] = f"commands {name}"
    return doing


def refuse_company(bus: Bus, clock: Clock, settings: Settings, codec: Codec, devices: Sequence[PlacedDevice]) -> None:
    """Listen for HOSTS_LISTEN_S; raise DeviceError if another host runs the arm, which a reset would take from it.

    Not for lockstep, where time passes only by this host's own frames. Requests that only read objects, and NMT
    commands to nodes of other arms, are ignored. Frames that arrive meanwhile are dropped. Raises BusError if the bus
    fails.
    """
    strangers = Strangers(settings, codec, devices)
    end_ns = clock.now_ns() + round(HOSTS_LISTEN_S * 1e9)
    while (remaining_ns := end_ns - clock.now_ns()) > 0:
        frame = bus.receive(remaining_ns * 1e-9)
        if frame is not None and not frame.is_error:
            strangers.judge_host_frame(frame, 0)
    if heard := strangers.describe_senders(0):
        raise DeviceError(f"{'; '.join(heard)} on {bus.channel}: end the other program; an arm has one host")


def _plain(name: str) -> str:
    """Return a device's name in the contract as words: drive 1 for Drive1."""
    return f"{name[:-1].lower()} {name[-1]}"


class Strangers(RateLimitedEvents):
    """Finds frames of other senders that act on the arm, and reports them as events."""

    def __init__(self, settings: Settings, codec: Codec, devices: Sequence[PlacedDevice]) -> None:
        super().__init__()
        self._doing = host_frames(settings, codec, devices)
        self._nodes = {0, *(device.node_id for device in devices)}
        self._hold_cycles = round(HOLD_S / settings.bus.period_s)
        self._window_cycles = max(1, round(CONTRADICTION_WINDOW_S / settings.bus.period_s))
        self._until_cycle = -2  # before any, the first of which is -1: none begun
        self._complaints: dict[str, int] = {}
        self._contradictions: dict[str, deque[int]] = {}

    def judge_host_frame(self, frame: Frame, cycle: int) -> bool:
        """Judge a frame received in a cycle; return True if only this host may send its identifier.

        Append an event, at a limited rate: a warning for an SDO request that only reads, else an error. The frame of an
        error counts for `have_acted` and `describe_senders`. NMT to nodes of other arms gives no event.
        """
        doing = self._doing.get(frame.can_id)
        if doing is None:
            return False
        if frame.can_id == NMT_ID:
            command, node_id = (*frame.data[:2], 0, 0)[:2]
            if node_id not in self._nodes:
                return True  # to a node of another arm
            word = _NMT_WORDS.get(command, f"command {command}")
            doing = f"sends NMT {word} to {f'node {node_id}' if node_id else 'all nodes'}"
        elif frame.can_id & FUNCTION_MASK == SDO_REQUEST_ID and frame.data and frame.data[0] >> 5 in _READING:
            text = f"somebody else {doing.replace('writes', 'reads')} (0x{frame.can_id:03X})"
            self.report(frame.t_ns, (frame.can_id, "reads"), Event("warning", "bus", text))
            return True
        self._complain(frame, doing, cycle)
        return True

    def report_second_frame(self, frame: Frame, name: str, cycle: int) -> None:
        """Report a second, different frame of a device on one SYNC: as a warning if it is a single one.

        CONTRADICTIONS of them within CONTRADICTION_WINDOW_S are an error, and count as another sender's action. name:
        of the device.
        """
        seen = self._contradictions.setdefault(name, deque(maxlen=CONTRADICTIONS))
        seen.append(cycle)
        if len(seen) == CONTRADICTIONS and cycle - seen[0] <= self._window_cycles:
            self._complain(frame, f"sends as {_plain(name)}", cycle)
            return
        text = f"a second frame of {_plain(name)} (0x{frame.can_id:03X}) on one SYNC, with other content"
        self.report(frame.t_ns, (frame.can_id, "once"), Event("warning", "bus", text))

    def _complain(self, frame: Frame, doing: str, cycle: int) -> None:
        """Report an action of another sender, `doing`, as an error.

        For HOLD_S from `cycle` on, `have_acted` is then True and `describe_senders` has the action.
        """
        text = f"somebody else {doing} (0x{frame.can_id:03X})"
        self._until_cycle = cycle + self._hold_cycles
        self._complaints[text] = cycle
        self.report(frame.t_ns, text, Event("error", "bus", text))

    def have_acted(self, cycle: int) -> bool:
        """Return whether another sender has acted on the arm within HOLD_S before a cycle; reading is no action."""
        return cycle <= self._until_cycle

    def describe_senders(self, cycle: int) -> list[str]:
        """Return the actions of other senders on the arm within HOLD_S before a cycle, one line each."""
        return [text for text, heard in self._complaints.items() if cycle <= heard + self._hold_cycles]
