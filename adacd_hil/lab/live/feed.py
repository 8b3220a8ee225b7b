"""The live view's messages: from the writer into a ring that a process of its own looks into, and which are shown.

The writer never waits for that process. Messages that find the ring full are not shown; a process that is stopped, dead
or busy with five hundred viewers does not delay the log. Only the writer's start waits until it listens or fails.

**Topics**: those of a log, fewer messages of them, and three that are drawn from these.

A person watches, and the network may be a radio, so each topic has a rate. The decimator keeps a rate by log time: it
divides time into slots of 1 / rate, and shows all messages of the first cycle in each slot. So frames of one cycle stay
together, and a topic that comes more seldom than its rate is shown whole.

Encoding (`cdr`), schemas (`ros2msg`) and stamps are those of the file.
"""

import contextlib
import json
import os
import socket
import struct
import subprocess
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from adacd_hil.error_texts import error_text
from adacd_hil.lab.live.live_view import LiveView
from adacd_hil.lab.live.scene import (
    DESCRIPTION_TOPIC,
    SCENE,
    STRING,
    TRANSFORMS,
    TRANSFORMS_TOPIC,
    Entity,
    draw_contact,
    draw_joints,
    pack_scene,
    pack_string,
    pack_transforms,
    threshold_shares,
    transforms_of,
)
from adacd_hil.log.log_files import LogError
from adacd_hil.log.recording import processes
from adacd_hil.log.recording.processes import LoggedMessage, WriterSetup, start_module
from adacd_hil.log.recording.ring import Ring
from adacd_hil.log.types.message_types import ENCAPSULATION, JOINT_STATE_DTYPE, MessageType
from adacd_hil.log.types.topics import DECODED, RUN_TOPICS, ChannelId, LogChannel
from adacd_hil.log.types.unpacking import unpack_contact
from adacd_hil.log.viewer_layout import SCENE_TOPIC
from adacd_hil.records import SchemeState

_HEAD = struct.Struct("<HqqI")
"""Of a message in a batch: channel, log time, publish time, bytes of the payload that follows."""


class ServerSetup(NamedTuple):
    """Setup of the view's process.

    live: its address and admitted viewers. setup: of the log. ids: number in the file of each of our channels.
    start_ns: log time before the first message.
    """

    live: LiveView
    setup: WriterSetup
    ids: dict[int, int]
    start_ns: int


def pack_batch(messages: Iterable[LoggedMessage]) -> bytes:
    """Return messages as bytes, from which `unpack_batch` gives them again."""
    parts = []
    for channel, log_ns, publish_ns, payload in messages:
        parts += [_HEAD.pack(channel, log_ns, publish_ns, len(payload)), payload]
    return b"".join(parts)


def unpack_batch(data: bytes) -> Iterator[LoggedMessage]:
    """Yield the messages in bytes of `pack_batch`."""
    place = 0
    while place < len(data):
        channel, log_ns, publish_ns, size = _HEAD.unpack_from(data, place)
        place += _HEAD.size
        yield LoggedMessage(channel, log_ns, publish_ns, data[place : place + size])
        place += size


START_TIMEOUT_S = 30.0
RING_BYTES = 8 * 1024 * 1024
"""3.8 s of a certified run at 1 kHz: longer than any viewer's request keeps the other process busy."""


class LiveFeed:
    """Passes messages to the process that serves the live view.

    `url`: for viewers; `process`: the view's; `hidden`: number of batches dropped because the ring was full.
    """

    def __init__(self, live: LiveView, setup: WriterSetup, ids: dict[int, int], start_ns: int) -> None:
        """Start the view's process, and wait until it listens on the address of `live`.

        setup: of the log. ids: the file's number of each channel, by ours. start_ns: log time before the first message.
        Raises LogError if the process can't start or listen, or doesn't answer within `START_TIMEOUT_S`.
        """
        self.hidden = 0
        self._is_watched = False
        place = f"{live.host}:{live.port}"
        told = ServerSetup(live, replace(setup, attachments={}, metadata={}, live=None), ids, start_ns)
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._ring = Ring(RING_BYTES)
            descriptors = (theirs.fileno(), self._ring.descriptor)
            # Its libraries may print text from viewers, which must not reach the run's terminal.
            notices = os.dup(2)
            try:
                self.process = start_module(
                    "adacd_hil.lab.live.server", (*descriptors, notices), told, subprocess.DEVNULL
                )
            finally:
                os.close(notices)
        except OSError as error:
            self._socket.close()
            raise LogError(f"the live view can't start: {error_text(error)}") from None
        finally:
            theirs.close()
        word = self._hear()
        if word["error"]:
            self.process.kill()
            self.process.wait()
            self._release()
            raise LogError(f"the live view can't listen on {place}: {word['error']}")
        self.url = word["url"]
        self._socket.setblocking(False)

    def _hear(self) -> dict[str, str]:
        """Return the first message of the view's process: its "url" with an empty "error", or an "error".

        It is an "error" if the process ends, or none comes within `START_TIMEOUT_S`.
        """
        self._socket.settimeout(START_TIMEOUT_S)
        try:
            received = self._socket.recv(processes.MOST_BYTES)
        except OSError:
            received = b""
        word: dict[str, str] = json.loads(received) if received else {"error": "it did not start"}
        return word

    @property
    def is_watched(self) -> bool:
        """Whether a viewer has subscribed to a topic, by the latest word of the view's process, which is read here.

        False once that process has closed its socket; if the socket is reset, only from the second call on.
        """
        with contextlib.suppress(BlockingIOError, ConnectionResetError):
            while word := self._socket.recv(processes.MOST_BYTES):
                self._is_watched = word == processes.WATCHED
            self._is_watched = False  # the view's process has closed its socket
        return self._is_watched

    def show(self, messages: Sequence[LoggedMessage]) -> None:
        """Hand consecutive messages to the view's process, without waiting; without a subscription, do nothing.

        If the ring is full, the messages are dropped and `hidden` counts the batch.
        """
        if not messages or not self.is_watched:
            return
        if not self._ring.put_packet(pack_batch(messages)):
            self.hidden += 1
            return
        self._say(processes.WAKE)

    def _say(self, word: bytes) -> None:
        with contextlib.suppress(OSError):  # it has words that it hasn't heard yet, or is dead
            self._socket.send(word)

    def end_view(self) -> None:
        """Ask the view's process to send the rest and end, without waiting for it. No other call may follow."""
        self._say(processes.END)
        self._release()

    def _release(self) -> None:
        self._socket.close()
        self._ring.close()


RATES_HZ = {TRANSFORMS_TOPIC: 50, SCENE_TOPIC: 10, **{topic.name: topic.rate_Hz for topic in RUN_TOPICS}}
DECODED_RATE_HZ = 10
EVERY_MESSAGE = 0
"""The rate of topics without a limit, as /events, /contact and /frame_checks."""


def rate_of(topic: str) -> int:
    """Return the rate at which a topic is shown, Hz; EVERY_MESSAGE if all its messages are."""
    return DECODED_RATE_HZ if topic.startswith(DECODED) else RATES_HZ.get(topic, EVERY_MESSAGE)


class Decimator:
    """Chooses the messages of one topic that are shown: all of the first cycle in each slot of 1 / rate."""

    def __init__(self, rate_Hz: int) -> None:
        self._slot_ns = 1_000_000_000 // rate_Hz if rate_Hz else 0
        self._slot = -1
        self._first_ns = -1  # the first cycle of the slot

    def takes(self, cycle_ns: int) -> bool:
        """Return whether the next message is shown: if it is of the first cycle that came in its slot of 1 / rate.

        At the rate EVERY_MESSAGE always. Keeps the slot for the next call. cycle_ns: time of the message's cycle, which
        never runs backwards.
        """
        if not self._slot_ns:
            return True
        if (slot := cycle_ns // self._slot_ns) != self._slot:
            self._slot, self._first_ns = slot, cycle_ns
        return cycle_ns == self._first_ns


_BODY = len(ENCAPSULATION) + 8
"""Offset of a body in a payload, bytes: after the stamp."""


class Shown(NamedTuple):
    """A message for the viewers that have subscribed to its channel."""

    channel: int
    log_ns: int
    payload: bytes


class LiveTopics:
    """The topics of a live view, and the choice of messages that are shown.

    `latest_ns`: log time of the latest message; before the first, `start_ns`.
    """

    def __init__(self, setup: LiveView, channels: Iterable[LogChannel], ids: dict[int, int], start_ns: int) -> None:
        """Prepare the topics of a log, and the three that the view draws: poses, scene, and the arm's description.

        ids: the file's number of each channel, by ours. start_ns: log time before the first message.
        """
        channels = tuple(channels)
        self.latest_ns = start_ns
        self._shape = setup.shape
        self._decimators = {ids[channel.id]: Decimator(rate_of(channel.topic)) for channel in channels}
        self._scene_decimator = Decimator(rate_of(SCENE_TOPIC))
        self._joint_states, self._scheme, self._contact = (
            ids.get(channel) for channel in (ChannelId.JOINT_STATES, ChannelId.SCHEME, ChannelId.CONTACT)
        )
        self._scheme_dtype = next(channel.type.dtype for channel in channels if channel.id == ChannelId.SCHEME)
        free = 1 + max(ids.values())
        self.transforms, self.scene, self.robot = free, free + 1, free + 2
        """Numbers of the topics that only the live view has."""
        types = {ids[channel.id]: (channel.topic, channel.type) for channel in channels}
        types[self.transforms] = (TRANSFORMS_TOPIC, TRANSFORMS)
        types[self.scene] = (SCENE_TOPIC, SCENE)
        types[self.robot] = (DESCRIPTION_TOPIC, STRING)
        self.advertised = {number: _advertise(number, *named) for number, named in types.items()}
        """Channels by number, as the protocol describes them."""
        self._description = pack_string(setup.robot_description)

    def description(self) -> Shown:
        """Return the message with the arm's URDF, which each new subscription to its topic gets."""
        return Shown(self.robot, self.latest_ns, self._description)

    def choose(self, messages: Iterable[LoggedMessage], wanted: Collection[int]) -> Iterator[Shown]:
        """Yield the messages that are shown, in their order, each followed by those that are drawn from it.

        wanted: channels to which viewers have subscribed; others yield nothing. Drawn messages come without their
        source if only they are wanted; a message that can't be decoded isn't drawn. Raises `latest_ns` to the latest
        log time, also of messages that are not shown, and keeps the slots of the decimators.
        """
        sources = self._sources(wanted)
        for channel, log_ns, publish_ns, payload in messages:
            self.latest_ns = max(self.latest_ns, log_ns)
            if channel not in sources or not self._decimators[channel].takes(publish_ns):
                continue
            shown = Shown(channel, log_ns, payload)
            if channel in wanted:
                yield shown
            with contextlib.suppress(ValueError, IndexError, struct.error):  # a message without sense isn't drawn
                yield from self._drawn_from(shown, wanted)

    def _sources(self, wanted: Collection[int]) -> set[int]:
        """Return the log's channels that are wanted, or from which a wanted topic is drawn."""
        sources = set(wanted)
        if self.transforms in sources:
            sources.add(self._joint_states or 0)
        if self.scene in sources:
            sources |= {self._scheme or 0, self._contact or 0}
        return sources & self._decimators.keys()

    def _drawn_from(self, shown: Shown, wanted: Collection[int]) -> Iterator[Shown]:
        """Yield the wanted messages that are drawn from a shown one, poses or shapes; none from most channels.

        Shapes of /scheme keep the rate of the scene. Raises ValueError, IndexError or struct.error for a damaged
        payload.
        """
        channel, log_ns, payload = shown
        if channel == self._joint_states and self.transforms in wanted:
            q = np.frombuffer(payload, JOINT_STATE_DTYPE)[0]["q"]
            yield Shown(self.transforms, log_ns, pack_transforms(log_ns, transforms_of(self._shape, q)))
        elif channel == self._contact and self.scene in wanted:
            yield self._draw(log_ns, draw_contact(self._shape, unpack_contact(payload[_BODY:])))
        elif channel == self._scheme and self.scene in wanted and self._scene_decimator.takes(log_ns):
            record = np.frombuffer(payload, self._scheme_dtype)[0]
            state = SchemeState(int(record["state"]))
            yield self._draw(log_ns, *draw_joints(state, record["tau_ext_hat"], threshold_shares(record)))

    def _draw(self, log_ns: int, *entities: Entity) -> Shown:
        return Shown(self.scene, log_ns, pack_scene(log_ns, entities))


def _advertise(number: int, topic: str, message_type: MessageType) -> dict[str, Any]:
    return {
        "id": number,
        "topic": topic,
        "encoding": "cdr",
        "schemaName": message_type.name,
        "schema": message_type.text,
        "schemaEncoding": "ros2msg",
    }
