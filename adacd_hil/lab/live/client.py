"""A client of the live view: subscribes to all advertised channels and receives their messages.

Foxglove WebSocket protocol: the server advertises channels as JSON; a message is 1, the subscription's number (uint32),
the log time in ns (uint64), then the payload, little endian. https://github.com/foxglove/ws-protocol
"""

import json
from collections import deque
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from adacd_hil.clock import MonotonicClock
from adacd_hil.lab.live.admission import OPEN_TIMEOUT_S, SHOWN_DATA, SHOWN_HEAD, SUBPROTOCOLS
from adacd_hil.lab.live.scene import DESCRIPTION_TOPIC
from adacd_hil.log.log_files import LogError
from adacd_hil.log.types.message_types import payload_dtype

NO_LOG = "it does not serve a log of adacd-hil"
MOST_MESSAGE_BYTES = 16 * 1024 * 1024
"""Longer messages don't come from our server."""


class LiveMessage(NamedTuple):
    """A message; log_ns as in the file: since 1970 in real time, since the beginning in lockstep."""

    topic: str
    log_ns: int
    payload: bytes


class LiveClient:
    """A connection to a live view, with subscriptions to topics."""

    def __init__(self, connection: ClientConnection, topics: Collection[str] | None) -> None:
        """Subscribe to `topics`, None: to all, and wait until the server confirms it by the arm's description.

        Raises LogError after OPEN_TIMEOUT_S, if the server ends before, or for data that is no log of adacd-hil. The
        messages received so far are returned by `receive`.
        """
        self.topics: dict[str, tuple[str, str]] = {}
        """Name and text of the schema of each topic that the server offers."""
        self.is_open = True
        """Whether more can come."""
        self._connection = connection
        self._wanted = topics
        self._names: dict[int, str] = {}  # by the numbers of the subscriptions
        self._dtypes: dict[str, np.dtype[Any]] = {}
        self._waiting: deque[LiveMessage] = deque()
        self._wait()

    def _wait(self) -> None:
        """Receive and store messages up to the arm's description: then the subscriptions are in force.

        Raises LogError after OPEN_TIMEOUT_S, if the connection ends before, or for data that is no log of adacd-hil.
        """
        clock = MonotonicClock()
        end_ns = clock.now_ns() + round(OPEN_TIMEOUT_S * 1e9)
        while not self._waiting or self._waiting[-1].topic != DESCRIPTION_TOPIC:
            message = self._receive(max(0.0, (end_ns - clock.now_ns()) * 1e-9))
            if message is None or clock.now_ns() >= end_ns:
                raise LogError(NO_LOG)
            self._waiting.append(message)

    def receive(self, timeout_s: float) -> LiveMessage | None:
        """Return the next message, a waiting one at once; None after the timeout, or at the server's end.

        At the end `is_open` is False. Raises LogError for data that is no log of adacd-hil.
        """
        return self._waiting.popleft() if self._waiting else self._receive(timeout_s)

    def _receive(self, timeout_s: float) -> LiveMessage | None:
        """Return the next message from the connection; None after the timeout or at the server's end.

        At the end, set `is_open` to False. JSON from the server is obeyed on the way, its other binary data ignored.
        Raises LogError for data that is no log of adacd-hil, such as a message without a subscription.
        """
        clock = MonotonicClock()
        end_ns = clock.now_ns() + round(timeout_s * 1e9)
        while self.is_open:
            try:
                data = self._connection.recv(timeout=max(0.0, (end_ns - clock.now_ns()) * 1e-9))
            except TimeoutError:
                break
            except ConnectionClosed:
                self.is_open = False
                break
            try:
                if isinstance(data, str):
                    self._obey(json.loads(data))
                elif len(data) >= SHOWN_HEAD.size and data[0] == SHOWN_DATA:
                    _, number, log_ns = SHOWN_HEAD.unpack_from(data)
                    return LiveMessage(self._names[number], log_ns, data[SHOWN_HEAD.size :])
            except (ValueError, KeyError, TypeError, RecursionError):
                raise LogError(NO_LOG) from None
            if clock.now_ns() >= end_ns:
                break
        return None

    def _obey(self, word: dict[str, Any]) -> None:
        """Subscribe to the wanted channels that the server advertises, and last, always, to the arm's description.

        The description ends `_wait`. Adds the channels to `topics`, wanted or not. word: a message of the server,
        decoded from JSON; kinds other than "advertise" have no effect.
        """
        if word["op"] != "advertise":
            return
        last: dict[str, int] | None = None
        subscriptions = []
        for channel in word["channels"]:
            name = channel["topic"]
            self.topics[name] = channel["schemaName"], channel["schema"]
            subscription = {"id": channel["id"], "channelId": channel["id"]}
            self._names[channel["id"]] = name
            if name == DESCRIPTION_TOPIC:
                last = subscription
            elif self._wanted is None or name in self._wanted:
                subscriptions.append(subscription)
        for group in (subscriptions, [last] if last else []):
            self._connection.send(json.dumps({"op": "subscribe", "subscriptions": group}))

    def decode(self, message: LiveMessage) -> Any:
        """Return a message as a numpy record with the fields of its schema, which must have numbers only.

        Raises LogError if the message doesn't fit its schema, or if the schema has no fixed size.
        """
        if message.topic not in self._dtypes:
            self._dtypes[message.topic] = payload_dtype(self.topics[message.topic][1])
        try:
            return np.frombuffer(message.payload, self._dtypes[message.topic])[0]
        except (ValueError, IndexError):
            raise LogError(f"a message of {message.topic} does not fit its schema") from None


@contextmanager
def live_client(url: str, topics: Collection[str] | None = None) -> Iterator[LiveClient]:
    """Connect to a live view while the block lasts, then disconnect; `topics`: to subscribe to, None: all.

    Raises LogError if none answers at `url`, or for data that is no log of adacd-hil. OSError, ValueError, LogError and
    errors of the WebSocket in the block become LogErrors with the URL.
    """
    try:
        connection = connect(
            url,
            subprotocols=[Subprotocol(name) for name in SUBPROTOCOLS],
            compression=None,
            max_size=MOST_MESSAGE_BYTES,
            max_queue=None,  # a full queue would keep the server's goodbye from being heard when the block ends
            open_timeout=OPEN_TIMEOUT_S,
            proxy=None,
        )
        with connection as opened:
            yield LiveClient(opened, topics)
    except ConnectionRefusedError:
        raise LogError(f"live view {url}: nobody serves one there; start the run with --live") from None
    except (OSError, WebSocketException, ValueError, LogError) as error:
        raise LogError(f"live view {url}: {' '.join(str(error).split()) or type(error).__name__}") from None
