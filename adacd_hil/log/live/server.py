"""The live view: the log's records as they are written, fewer of them, over the Foxglove WebSocket protocol.

It lives in the writer process, which imports this module only when it is asked for. The server runs in threads of the
SDK; to hand it a record takes about 2 µs and never waits: a client that is slow loses its oldest messages. As long as
nobody has subscribed, nothing is done at all.

Encoding and schemas are those of the log (`cdr`, `ros2msg`); the stamps are, too. Its own topics are drawn from
/joint_states, /scheme and /contact: see scene.py.
"""

import contextlib
import struct
import threading
from collections.abc import Iterable

import foxglove
import numpy as np
from foxglove.websocket import ChannelView, Client, ServerListener
from numpy.typing import NDArray

from adacd_hil.log.cdr import ENCAPSULATION, MessageType
from adacd_hil.log.channels import Channel, ChannelId, unpack_contact
from adacd_hil.log.errors import LogError
from adacd_hil.log.live.rates import DESCRIPTION_TOPIC, SCENE_TOPIC, TRANSFORMS_TOPIC, Decimator, rate_of
from adacd_hil.log.live.scene import Shape, draw_contact, draw_joints, transforms_of
from adacd_hil.log.live.scene_types import SCENE, STRING, TRANSFORMS, Entity, pack_scene, pack_string, pack_transforms
from adacd_hil.log.mcap_walk import MESSAGE_HEAD
from adacd_hil.log.ros_types import JOINT_STATE_DTYPE
from adacd_hil.log.setup import LiveSetup
from adacd_hil.records import SchemeState

_PUBLISH_TIME = slice(MESSAGE_HEAD - 8, MESSAGE_HEAD)
_BODY = len(ENCAPSULATION) + 8
"""Where a body begins in a payload, bytes: after the stamp."""


class LiveView(ServerListener):
    """A server of the topics of one log, and of its own."""

    def __init__(self, setup: LiveSetup, channels: Iterable[Channel], ids: dict[int, int], start_ns: int) -> None:
        """Listen where `setup` says.

        ids: the file's number of each channel, by ours. start_ns: log time of what is sent before the first record.
        Raises LogError.
        """
        self._shape = Shape(setup.link_length_m, setup.is_upright)
        self._description = pack_string(setup.robot_description)
        self._latest_ns = start_ns
        self._subscriptions: set[tuple[int, int]] = set()  # of client and channel
        self._lock = threading.Lock()
        self._context = foxglove.Context()  # kept: without it the channels would be closed
        self._outlets = {ids[channel.id]: self._open(channel.topic, channel.type) for channel in channels}
        self._decimators = {ids[channel.id]: Decimator(rate_of(channel.topic)) for channel in channels}
        self._joint_states, self._scheme, self._contact = (
            ids.get(channel) for channel in (ChannelId.JOINT_STATES, ChannelId.SCHEME, ChannelId.CONTACT)
        )
        self._scheme_dtype = next(channel.type.dtype for channel in channels if channel.id == ChannelId.SCHEME)
        self._transforms = self._open(TRANSFORMS_TOPIC, TRANSFORMS)
        self._scene = self._open(SCENE_TOPIC, SCENE)
        self._scene_decimator = Decimator(rate_of(SCENE_TOPIC))
        self._robot = self._open(DESCRIPTION_TOPIC, STRING)
        try:
            self._server = foxglove.start_server(
                name="adacd-hil", host=setup.host, port=setup.port, server_listener=self, context=self._context
            )
        except (RuntimeError, ValueError, OSError) as error:
            raise LogError(f"the live view can't listen on {setup.host}:{setup.port}: {error}") from None
        self.url = f"ws://{setup.host}:{self._server.port}"

    def _open(self, topic: str, message_type: MessageType) -> foxglove.Channel:
        schema = foxglove.Schema(name=message_type.name, encoding="ros2msg", data=message_type.text.encode())
        return foxglove.Channel(topic, message_encoding="cdr", schema=schema, context=self._context)

    @property
    def is_watched(self) -> bool:
        """Whether somebody has subscribed to something."""
        return bool(self._subscriptions)

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Take notice, in a thread of the server; send the description of the robot to who asks for it."""
        with self._lock:
            self._subscriptions.add((client.id, channel.id))
        if channel.topic == DESCRIPTION_TOPIC:
            self._robot.log(self._description, log_time=self._latest_ns)

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """Take notice, in a thread of the server; also of a client that has gone."""
        with self._lock:
            self._subscriptions.discard((client.id, channel.id))

    def show(
        self,
        records: NDArray[np.uint8],
        channels: NDArray[np.uint16],
        log_ns: NDArray[np.int64],
        ends: NDArray[np.int64],
    ) -> None:
        """Show some of the message records that follow each other in `records`, in their order.

        channels: the file's numbers (n,); log_ns: their log times (n,); ends: where each record ends (n,).
        """
        if not self.is_watched or not len(ends):
            return
        starts = np.concatenate(([0], ends[:-1]))
        cycles_ns = records[starts[:, np.newaxis] + np.arange(MESSAGE_HEAD)[_PUBLISH_TIME]].view(np.int64)[:, 0]
        is_shown = np.zeros(len(ends), np.bool_)
        for channel in np.unique(channels).tolist():
            places = np.flatnonzero(channels == channel)
            is_shown[places] = self._decimators[channel].choose(cycles_ns[places])
        for place in np.flatnonzero(is_shown).tolist():
            payload = records[starts[place] + MESSAGE_HEAD : ends[place]].tobytes()
            self._send(int(channels[place]), int(log_ns[place]), payload)

    def _send(self, channel: int, log_ns: int, payload: bytes) -> None:
        """Send a record, and what is drawn from it."""
        self._latest_ns = max(self._latest_ns, log_ns)
        self._outlets[channel].log(payload, log_time=log_ns)
        with contextlib.suppress(ValueError, IndexError, struct.error):  # a record that makes no sense isn't drawn
            self._draw_from(channel, log_ns, payload)

    def _draw_from(self, channel: int, log_ns: int, payload: bytes) -> None:
        if channel == self._joint_states:
            q = np.frombuffer(payload, JOINT_STATE_DTYPE)[0]["q"]
            self._transforms.log(pack_transforms(log_ns, transforms_of(self._shape, q)), log_time=log_ns)
        elif channel == self._contact:
            self._draw(log_ns, draw_contact(self._shape, unpack_contact(payload[_BODY:])))
        elif channel == self._scheme and self._scene_decimator.choose(np.array([log_ns]))[0]:
            record = np.frombuffer(payload, self._scheme_dtype)[0]
            state = SchemeState(int(record["state"]))
            self._draw(log_ns, *draw_joints(state, record["tau_ext_hat"], record["threshold"]))

    def _draw(self, log_ns: int, *entities: Entity) -> None:
        self._scene.log(pack_scene(log_ns, entities), log_time=log_ns)

    def close(self) -> None:
        """End the server and its connections."""
        self._server.stop()
