"""Five hundred clients of a live view that behave badly, by raw sockets: run by test_live_server.py.

    python live_crowd.py PORT COUNT

A quarter subscribes to everything and never reads, a quarter reads a few bytes now and then, a quarter comes and goes
without end, and a quarter says half a request and waits. Prints "ready" once all who subscribe have done so; ends when
its input does.
"""

import contextlib
import json
import os
import select
import socket
import struct
import sys

REQUEST = (
    "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Protocol: foxglove.websocket.v1\r\n\r\n"
)


def frame(text: str) -> bytes:
    """Write a text frame as a client does, with a mask of zeros."""
    data = text.encode()
    length = bytes([0x80 | len(data)]) if len(data) < 126 else bytes([0x80 | 126]) + struct.pack(">H", len(data))
    return b"\x81" + length + bytes(4) + data


SUBSCRIBE = frame(json.dumps({"op": "subscribe", "subscriptions": [{"id": n, "channelId": n} for n in range(40)]}))


def opened(port: int, receive_bytes: int = 4096) -> socket.socket:
    """Connect, with little room for what comes."""
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_bytes)
    client.connect(("127.0.0.1", port))
    return client


def subscribed(port: int) -> socket.socket:
    """Connect, subscribe to everything, and wait until the server has begun to speak."""
    client = opened(port)
    client.sendall(REQUEST.format(port=port).encode())
    begun = client.recv(12)
    assert begun == b"HTTP/1.1 101", begun
    client.sendall(SUBSCRIBE)
    return client


def main(port: int, count: int) -> None:
    """Behave badly."""
    quarter = count // 4
    deaf = [subscribed(port) for _ in range(quarter)]
    slow = [subscribed(port) for _ in range(quarter)]
    half = [opened(port) for _ in range(quarter)]
    for client in half:
        client.sendall(b"GET / HTTP/1.1\r\nHost: x")
    print("ready", flush=True)
    restless: list[socket.socket] = []
    while not select.select([0], [], [], 0.005)[0]:
        for client in slow[:: max(1, quarter // 10)]:
            client.setblocking(False)
            with contextlib.suppress(BlockingIOError, ConnectionError):
                client.recv(64)
        for client in restless:
            client.close()
        restless = []
        for index in range(quarter // 4):
            with contextlib.suppress(ConnectionError):  # the run may end before this does
                client = opened(port)
                restless.append(client)
                if index % 2:
                    client.sendall(REQUEST.format(port=port).encode() + SUBSCRIBE)
    os.read(0, 1)
    for client in (*deaf, *slow, *half, *restless):
        client.close()


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
