"""What the live view shows: the topics of a log, fewer records of them, and three topics drawn from these.

Encoding (`cdr`) and schemas (`ros2msg`) are those of the file; the stamps are, too.
"""

import contextlib
import struct
from collections.abc import Collection, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from adacd_hil.log.cdr import ENCAPSULATION, MessageType
from adacd_hil.log.channels import Channel, ChannelId, unpack_contact
from adacd_hil.log.live.rates import DESCRIPTION_TOPIC, SCENE_TOPIC, TRANSFORMS_TOPIC, Decimator, rate_of
from adacd_hil.log.live.scene import Shape, draw_contact, draw_joints, transforms_of
from adacd_hil.log.live.scene_types import SCENE, STRING, TRANSFORMS, Entity, pack_scene, pack_string, pack_transforms
from adacd_hil.log.live.told import Batch
from adacd_hil.log.mcap.mcap_records import MESSAGE_HEAD
from adacd_hil.log.ros_types import JOINT_STATE_DTYPE
from adacd_hil.log.setup import LiveSetup
from adacd_hil.records import SchemeState

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

    def __init__(self, setup: LiveSetup, channels: Iterable[Channel], ids: dict[int, int], start_ns: int) -> None:
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
