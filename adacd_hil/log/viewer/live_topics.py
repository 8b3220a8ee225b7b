"""The topics of the live view: those of a log, fewer records of them, and three that are drawn from these.

A person watches, and the network may be a radio, so each topic has a rate. The decimator keeps a rate by log time: it
divides time into slots of 1 / rate, and shows all records of the first cycle in each slot. So frames of one cycle stay
together, and a topic that comes more seldom than its rate is shown whole.

Encoding (`cdr`), schemas (`ros2msg`) and stamps are those of the file.
"""

import contextlib
import struct
from collections.abc import Collection, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adacd_hil.log.mcap.mcap_records import MESSAGE_HEAD
from adacd_hil.log.recording.processes import LiveSetup
from adacd_hil.log.types.message_types import ENCAPSULATION, JOINT_STATE_DTYPE, MessageType
from adacd_hil.log.types.topics import DECODED, RUN_TOPICS, ChannelId, LogChannel, unpack_contact
from adacd_hil.log.viewer.feed import Batch
from adacd_hil.log.viewer.scene import (
    DESCRIPTION_TOPIC,
    SCENE,
    SCENE_TOPIC,
    STRING,
    TRANSFORMS,
    TRANSFORMS_TOPIC,
    Entity,
    Shape,
    draw_contact,
    draw_joints,
    pack_scene,
    pack_string,
    pack_transforms,
    transforms_of,
)
from adacd_hil.records import SchemeState

RATES_HZ = {TRANSFORMS_TOPIC: 50, SCENE_TOPIC: 10, **{topic.name: topic.rate_Hz for topic in RUN_TOPICS}}
DECODED_RATE_HZ = 10
EVERY_RECORD = 0
"""The rate of topics that have none, as /events, /contact and /frame_checks."""


def rate_of(topic: str) -> int:
    """Return the rate of a topic, Hz; EVERY_RECORD: it is shown whole."""
    return DECODED_RATE_HZ if topic.startswith(DECODED) else RATES_HZ.get(topic, EVERY_RECORD)


class Decimator:
    """Chooses the records of one topic that are shown."""

    def __init__(self, rate_Hz: int) -> None:
        self._slot_ns = 1_000_000_000 // rate_Hz if rate_Hz else 0
        self._slot = -1
        self._first_ns = -1  # the first cycle of the slot

    def choose(self, cycles_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Say which of the next records are shown (n,), by the times of their cycles, which never run backwards."""
        if not self._slot_ns or not len(cycles_ns):
            return np.ones(len(cycles_ns), np.bool_)
        slots = cycles_ns // self._slot_ns
        begins = np.diff(slots, prepend=self._slot) != 0
        latest = np.maximum.accumulate(np.where(begins, np.arange(len(slots)), -1))
        firsts_ns = np.where(latest < 0, self._first_ns, cycles_ns[latest])
        self._slot, self._first_ns = int(slots[-1]), int(firsts_ns[-1])
        return np.asarray(cycles_ns == firsts_ns)


_PUBLISH_TIME = slice(MESSAGE_HEAD - 8, MESSAGE_HEAD)
_BODY = len(ENCAPSULATION) + 8
"""Where a body begins in a payload, bytes: after the stamp."""


class Shown(NamedTuple):
    """A message for those who have subscribed to its topic."""

    channel: int
    log_ns: int
    payload: bytes


class LiveTopics:
    """The topics that are served. `latest_ns`: log time of the latest record; before the first, of the beginning."""

    def __init__(self, setup: LiveSetup, channels: Iterable[LogChannel], ids: dict[int, int], start_ns: int) -> None:
        """`ids`: the file's number of each channel, by ours. `start_ns`: log time before the first record."""
        channels = tuple(channels)
        self.latest_ns = start_ns
        self._shape = Shape(setup.link_length_m, setup.is_upright)
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
        self.advertised = [_advertise(number, *named) for number, named in types.items()]
        """As the protocol describes channels."""
        self._description = pack_string(setup.robot_description)

    def description(self) -> Shown:
        """Return the arm's description, for somebody who has just asked for it."""
        return Shown(self.robot, self.latest_ns, self._description)

    def choose(self, batch: Batch, wanted: Collection[int]) -> Iterator[Shown]:
        """Give what is shown of a batch, in its order, on the channels that somebody wants."""
        if not len(batch.ends):
            return
        self.latest_ns = max(self.latest_ns, int(batch.log_ns.max()))
        starts = np.concatenate(([0], batch.ends[:-1]))
        is_shown = np.zeros(len(batch.ends), np.bool_)
        for channel in self._sources(wanted):
            places = np.flatnonzero(batch.channels == channel)
            at = starts[places][:, np.newaxis] + np.arange(MESSAGE_HEAD)[_PUBLISH_TIME]
            is_shown[places] = self._decimators[channel].choose(batch.records[at].view(np.int64)[:, 0])
        for place in np.flatnonzero(is_shown).tolist():
            payload = batch.records[starts[place] + MESSAGE_HEAD : batch.ends[place]].tobytes()
            shown = Shown(int(batch.channels[place]), int(batch.log_ns[place]), payload)
            if shown.channel in wanted:
                yield shown
            with contextlib.suppress(ValueError, IndexError, struct.error):  # a record without sense isn't drawn
                yield from self._drawn_from(shown, wanted)

    def _sources(self, wanted: Collection[int]) -> set[int]:
        """Return the file's channels that are wanted, or that something wanted is drawn from."""
        sources = set(wanted)
        if self.transforms in sources:
            sources.add(self._joint_states or 0)
        if self.scene in sources:
            sources |= {self._scheme or 0, self._contact or 0}
        return sources & self._decimators.keys()

    def _drawn_from(self, shown: Shown, wanted: Collection[int]) -> Iterator[Shown]:
        channel, log_ns, payload = shown
        if channel == self._joint_states and self.transforms in wanted:
            q = np.frombuffer(payload, JOINT_STATE_DTYPE)[0]["q"]
            yield Shown(self.transforms, log_ns, pack_transforms(log_ns, transforms_of(self._shape, q)))
        elif channel == self._contact and self.scene in wanted:
            yield self._draw(log_ns, draw_contact(self._shape, unpack_contact(payload[_BODY:])))
        elif channel == self._scheme and self.scene in wanted and self._is_scene_due(log_ns):
            record = np.frombuffer(payload, self._scheme_dtype)[0]
            state = SchemeState(int(record["state"]))
            yield self._draw(log_ns, *draw_joints(state, record["tau_ext_hat"], record["threshold"]))

    def _is_scene_due(self, log_ns: int) -> bool:
        return bool(self._scene_decimator.choose(np.array([log_ns]))[0])

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
