"""The process of the live view: batches from the writer in, the Foxglove WebSocket protocol out. Run by LiveFeed.

Server to viewer, JSON: serverInfo, advertise, status. Binary, little endian: 1, subscription (uint32), log time in ns
(uint64), payload; and 2, time (uint64), since the capability `time` is offered: log time, which never runs backwards.
Viewer to server: subscribe, unsubscribe; any other message is answered with one warning and ignored.

A viewer that reads slowly loses its oldest messages; one that answers no ping for some 40 s is closed. The number of
viewers is limited, and so is the number of connections that are still opening. The server never logs or prints data
that a viewer sends: the run's terminal gets a fixed line of each kind of refusal, once.

It runs with lower priority than the writer, and ends with it.
"""

import asyncio
import contextlib
import functools
import html
import json
import logging
import os
import secrets
import socket
import struct
import sys
from collections import defaultdict, deque
from http import HTTPStatus
from pathlib import Path
from string import Template
from typing import Any, cast

from websockets.asyncio.connection import Connection
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from adacd_hil.lab.live.admission import (
    FULL,
    OPEN_TIMEOUT_S,
    SHOWN_DATA,
    SHOWN_HEAD,
    SUBPROTOCOLS,
    Admission,
    ViewerRefusal,
)
from adacd_hil.lab.live.feed import LiveTopics, ServerSetup, Shown, unpack_batch
from adacd_hil.lab.live.live_view import LiveView
from adacd_hil.log.log_files import LAYOUT_NAME
from adacd_hil.log.recording import processes
from adacd_hil.log.recording.processes import read_setup
from adacd_hil.log.recording.ring import RingReader, split

NICENESS = 5
BACKLOG = 1024
"""Messages that are kept for a viewer which is slow."""
BACKLOG_BYTES = 4 * 1024 * 1024
OPENING = 64
"""Connections beyond the viewers, such as those that are still opening; further ones are dropped at once."""
PING_S = 20.0
LINGER_S = 1.0
"""Longest time after the log's end in which the server sends the rest."""
_MOST_REQUEST_BYTES = 64 * 1024
_SUBSCRIPTIONS_PER_TOPIC = 4
_AT_ONCE_BYTES = 256 * 1024
_TIME = struct.Struct("<BQ")
_TIME_DATA = 2
_TIME_STEP_NS = 10_000_000
"""Interval between time messages: viewers stamp received messages with the latest time."""
_WARNING, _ERROR = 1, 2
_POLICY_VIOLATION = 1008

Data = str | bytes


class Viewer:
    """A connection of a viewer, its subscriptions, and the data that wait for it."""

    def __init__(self, connection: ServerConnection) -> None:
        self.subscriptions: dict[int, int] = {}
        """Channel of each subscription, by the numbers that the viewer has given them."""
        self.by_channel: dict[int, list[int]] = defaultdict(list)
        self._connection = connection
        self._waiting: deque[Data] = deque()
        self._waiting_bytes = 0
        self._has_some = asyncio.Event()
        self._is_warned = False

    def put(self, data: Data) -> None:
        """Queue data for the viewer; drop the oldest if more than BACKLOG messages or BACKLOG_BYTES wait."""
        self._waiting.append(data)
        self._waiting_bytes += len(data)
        while len(self._waiting) > BACKLOG or self._waiting_bytes > BACKLOG_BYTES:
            self._waiting_bytes -= len(self._waiting.popleft())
        self._has_some.set()

    def put_message(self, shown: Shown) -> None:
        """Queue a message for the viewer once per subscription to its channel; none without one."""
        for number in self.by_channel.get(shown.channel, ()):
            self.put(_message(number, shown))

    def warn_once(self, text: str) -> None:
        """Queue a warning for the viewer; later calls do nothing."""
        if not self._is_warned:
            self._is_warned = True
            self.put(_status(_WARNING, text))

    @property
    def is_served(self) -> bool:
        """Whether no data wait for the viewer."""
        return not self._waiting

    async def send_all(self) -> None:
        """Send queued data to the viewer until the task is cancelled. Raises ConnectionClosed if the viewer is gone."""
        while True:
            await self._has_some.wait()
            self._has_some.clear()
            while self._waiting:
                data = self._waiting.popleft()
                self._waiting_bytes -= len(data)
                await self._connection.send(data)


class LiveServer:
    """Serves viewers the messages of a ring buffer that the log's writer fills, until the writer ends or dies."""

    def __init__(self, told: ServerSetup, ring: RingReader, writer: socket.socket) -> None:
        """Serve what `told` sets up. ring: the writer's messages; writer: socket to it."""
        self._most_viewers = told.live.most_viewers
        self._topics = topics = LiveTopics(told.live, told.setup.channels, told.ids, told.start_ns)
        self._ring = ring
        self._writer = writer
        self._admission = Admission(told.live)
        self._viewers: set[Viewer] = set()
        self._connections: set[Connection] = set()
        self._admitted: set[Connection] = set()
        self._is_over = asyncio.Event()
        self._is_watched = False
        self._time_ns = topics.latest_ns
        self._noticed: set[str] = set()
        self._info = json.dumps(
            {
                "op": "serverInfo",
                "name": "adacd-hil",
                "capabilities": ["time"],
                "supportedEncodings": [],
                "metadata": {},
                "sessionId": secrets.token_hex(8),
            }
        )
        self._notices: int | None = None

    async def run(self, listening: socket.socket, notices: int | None = None) -> None:
        """Serve until the writer ends or dies; then send the rest and close.

        listening: the open socket; notices: descriptor of the run's terminal, None: no notices.
        """
        self._notices = notices
        loop = asyncio.get_running_loop()
        most = self._most_viewers + OPENING
        connection = functools.partial(_CountedConnection, self._connections, self._admitted, most)
        server = await serve(
            self._attend,
            sock=listening,
            compression=None,  # the viewer is near, and memory is bounded without it
            process_request=self._judge,
            subprotocols=[Subprotocol(name) for name in SUBPROTOCOLS],
            server_header=None,
            open_timeout=OPEN_TIMEOUT_S,
            ping_interval=PING_S,
            ping_timeout=PING_S,
            close_timeout=LINGER_S,
            max_size=_MOST_REQUEST_BYTES,
            logger=_no_logger(),
            create_connection=cast(Any, connection),  # which may be any factory
        )
        self._writer.setblocking(False)
        loop.add_reader(self._writer, self._hear)
        await self._is_over.wait()
        loop.remove_reader(self._writer)
        await self._end(server)

    # -- the writer -----------------------------------------------------------------------------------------------

    def _hear(self) -> None:
        """Receive the writer's waiting messages from its socket; END or a closed socket ends the server.

        Then queue packets of the ring for the viewers.
        """
        word: bytes | None = None
        with contextlib.suppress(BlockingIOError):
            while True:
                try:
                    word = self._writer.recv(processes.MOST_BYTES)
                except ConnectionResetError:
                    word = processes.NOTHING
                if word in (processes.END, processes.NOTHING):
                    self._is_over.set()
                    break
        self._show_some()

    def _show_some(self) -> None:
        """Queue about `_AT_ONCE_BYTES` of the ring's packets for the viewers; the rest follows after other tasks."""
        for batch in split(self._ring.take_packets(_AT_ONCE_BYTES)):
            self._show(batch)
        if self._ring.waiting:
            asyncio.get_running_loop().call_soon(self._show_some)

    def _show(self, batch: bytes) -> None:
        """Queue the messages of a batch for the viewers that have subscribed to them, and the log time for all viewers.

        Messages that the decimators of the topics don't choose are left out.
        """
        wanted = {channel for viewer in self._viewers for channel in viewer.by_channel}
        for shown in self._topics.choose(unpack_batch(batch), wanted):
            self._tell_time(shown.log_ns)
            for viewer in self._viewers:
                viewer.put_message(shown)
        self._tell_time(self._topics.latest_ns)

    def _tell_time(self, log_ns: int) -> None:
        """Queue the log time for all viewers if `_TIME_STEP_NS` of it have passed since the time queued last."""
        if log_ns - self._time_ns >= _TIME_STEP_NS:
            self._time_ns = log_ns
            for viewer in self._viewers:
                viewer.put(_TIME.pack(_TIME_DATA, log_ns))

    def _tell_writer(self) -> None:
        """Send the writer WATCHED when the first subscription has begun, ALONE when the last one has ended."""
        is_watched = any(viewer.subscriptions for viewer in self._viewers)
        if is_watched != self._is_watched:
            self._is_watched = is_watched
            with contextlib.suppress(OSError):  # it is gone, which _hear will notice
                self._writer.send(processes.WATCHED if is_watched else processes.ALONE)

    # -- viewers --------------------------------------------------------------------------------------------------

    def _judge(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the answer to a refused request, or the page for a browser; print a line on a refusal, once per kind.

        None: the connection is admitted, and counted as a viewer.
        """
        headers = request.headers
        origins, hosts, protocols = (headers.get_all(name) for name in ("Origin", "Host", "Sec-WebSocket-Protocol"))
        is_page = not headers.get_all("Upgrade")
        refusal = self._admission.refuse(origins, hosts, None if is_page else protocols)
        if refusal is None and is_page:
            return _page(connection, hosts[0])
        if refusal is None and len(self._admitted) >= self._most_viewers:
            refusal = FULL
        if refusal is None:
            self._admitted.add(connection)
            return None
        self._notice(refusal)
        return connection.respond(refusal.status, refusal.reason + "\n")

    def _notice(self, refusal: ViewerRefusal) -> None:
        """Print a refusal's line on the run's terminal, once per line; nothing without a terminal."""
        if self._notices is not None and refusal.notice not in self._noticed:
            self._noticed.add(refusal.notice)
            with contextlib.suppress(OSError):
                os.write(self._notices, f"{refusal.notice}\n".encode())

    async def _attend(self, connection: ServerConnection) -> None:
        """Send a viewer the server's info, the channels and the log time; then serve it until it disconnects.

        One that asks for too many subscriptions is disconnected. The writer learns if the last subscription has ended.
        """
        viewer = Viewer(connection)
        viewer.put(self._info)
        viewer.put(json.dumps({"op": "advertise", "channels": list(self._topics.advertised.values())}))
        viewer.put(_TIME.pack(_TIME_DATA, self._time_ns))
        self._viewers.add(viewer)
        sending = asyncio.create_task(viewer.send_all())
        try:
            async for data in connection:
                if not self._obey(viewer, data):
                    await connection.close(_POLICY_VIOLATION, "more subscriptions than topics")
        except ConnectionClosed:
            pass
        finally:
            self._viewers.discard(viewer)
            self._tell_writer()
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionClosed):
                await sending

    def _obey(self, viewer: Viewer, data: Data) -> bool:
        """Carry out a viewer's request, JSON as text; return False if it asks for too many subscriptions.

        Each request that makes no sense is answered with an error. Of those that aren't supported, only the viewer's
        first one is answered, with a warning.
        """
        try:
            word = json.loads(data) if isinstance(data, str) else {}
            op = word.get("op") if isinstance(word, dict) else None
            if op == "subscribe":
                return self._subscribe(
                    viewer, [(int(row["id"]), int(row["channelId"])) for row in word["subscriptions"]]
                )
            if op == "unsubscribe":
                self._unsubscribe(viewer, [int(number) for number in word["subscriptionIds"]])
                return True
            viewer.warn_once("this run can only be watched: it takes subscriptions, and nothing else")
        except (ValueError, TypeError, KeyError, RecursionError, OverflowError):
            viewer.put(_status(_ERROR, "this request makes no sense"))
        return True

    def _subscribe(self, viewer: Viewer, asked: list[tuple[int, int]]) -> bool:
        """Add subscriptions, and answer invalid ones with an error; return False if they are too many.

        asked: number of each subscription, and its channel. A subscription to the arm's description gets it at once.
        """
        for number, channel in asked:
            if len(viewer.subscriptions) >= _SUBSCRIPTIONS_PER_TOPIC * len(self._topics.advertised):
                return False
            if channel not in self._topics.advertised or number in viewer.subscriptions or not 0 <= number < 2**32:
                viewer.put(_status(_ERROR, "a subscription to no topic, or with a number that is taken"))
                continue
            viewer.subscriptions[number] = channel
            viewer.by_channel[channel].append(number)
            self._tell_writer()
            if channel == self._topics.robot:
                viewer.put(_message(number, self._topics.description()))
        return True

    def _unsubscribe(self, viewer: Viewer, numbers: list[int]) -> None:
        for number in numbers:
            channel = viewer.subscriptions.pop(number, None)
            if channel is not None:
                viewer.by_channel[channel].remove(number)
                if not viewer.by_channel[channel]:
                    del viewer.by_channel[channel]
        self._tell_writer()

    async def _end(self, server: Server) -> None:
        """Stop listening, send the rest for at most `LINGER_S`, then close all connections."""
        for listening in server.sockets:  # before it closes: asyncio drops, unclosed, whom it accepts while it does
            asyncio.get_running_loop().remove_reader(listening)
        server.close(close_connections=False)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LINGER_S):
                while self._ring.waiting or not all(viewer.is_served for viewer in self._viewers):
                    await asyncio.sleep(0.01)  # the ring and each viewer empty at their own pace
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LINGER_S):
                await asyncio.gather(*(each.close(1001, "the run is over") for each in list(server.connections)))


class _CountedConnection(ServerConnection):
    """A connection that is in the set `present` while it lasts, and removes itself from `admitted` at its end.

    It aborts at once if `present` has more than `most`.
    """

    def __init__(
        self, present: set[Connection], admitted: set[Connection], most: int, *given: Any, **named: Any
    ) -> None:
        super().__init__(*given, **named)
        self._present, self._admitted, self._most = present, admitted, most

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._present.add(self)
        if len(self._present) > self._most:
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._present.discard(self)
        self._admitted.discard(self)
        super().connection_lost(exc)


def _message(subscription: int, shown: Shown) -> bytes:
    return SHOWN_HEAD.pack(SHOWN_DATA, subscription, shown.log_ns) + shown.payload


def _status(level: int, text: str) -> str:
    return json.dumps({"op": "status", "level": level, "message": text})


def _page(connection: ServerConnection, host: str) -> Response:
    """Return the page for a browser, with the address for viewers.

    host: the admitted value of the request's Host header.
    """
    page = Template(_PAGE.read_text(encoding="utf-8")).substitute(url=f"ws://{html.escape(host)}", layout=LAYOUT_NAME)
    response = connection.respond(HTTPStatus.OK, page)
    del response.headers["Content-Type"]  # headers may be there twice
    response.headers.update(_PAGE_HEADERS)
    return response


_PAGE_HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'",
    "X-Content-Type-Options": "nosniff",
}
_PAGE = Path(__file__).with_name("live_page.html")


def _no_logger() -> logging.Logger:
    """Return a logger that is disabled, since strangers may send much."""
    logger = logging.getLogger("adacd_hil.live")
    logger.disabled = True
    return logger


def listen(setup: LiveView) -> socket.socket:
    """Return the open listening socket, on the first address of the host's name.

    Raises OSError if it can't be opened or the name has no address, OverflowError or UnicodeError for a wrong port or
    name.
    """
    family, _, _, _, address = socket.getaddrinfo(setup.host, setup.port, type=socket.SOCK_STREAM)[0]
    return socket.create_server(address[:2], family=family, backlog=128)


def url_of(setup: LiveView, listening: socket.socket) -> str:
    """Return the URL for viewers, ws://…: `setup`'s host, and the port of the open socket `listening`."""
    host = f"[{setup.host}]" if ":" in setup.host else setup.host
    return f"ws://{host}:{listening.getsockname()[1]}"


def main(socket_descriptor: int, ring_descriptor: int, notices: int) -> None:
    """Serve the live view: send the writer the address, then serve until the writer ends or dies.

    If the address can't be opened, send an error and return. Lowers the priority of this process. notices: descriptor
    of the run's terminal. The setup is read from stdin.
    """
    writer = socket.socket(fileno=socket_descriptor)
    told: ServerSetup = read_setup()
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    try:
        listening = listen(told.live)
    except (OSError, OverflowError, UnicodeError) as error:
        writer.send(json.dumps({"error": " ".join(str(error).split())}).encode())
        return
    writer.send(json.dumps({"error": "", "url": url_of(told.live, listening)}).encode())
    asyncio.run(LiveServer(told, RingReader(ring_descriptor), writer).run(listening, notices))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
