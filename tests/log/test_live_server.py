"""The live view's server: whom it refuses, what it says, and that whatever viewers do, the log is whole."""

import asyncio
import contextlib
import dataclasses
import gc
import json
import os
import signal
import socket
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from hang import HANG_S
from live_rig import EPOCH_NS, SETUP, Feed, setup_of
from recorded_run import CODEC, feed, make_run, start
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from adacd_hil.lab.live import admission as admission_module
from adacd_hil.lab.live import server as server_module
from adacd_hil.lab.live.admission import FULL, Admission, ViewerRefusal
from adacd_hil.lab.live.feed import ServerSetup
from adacd_hil.lab.live.live_view import LiveView
from adacd_hil.lab.live.server import LiveServer, listen, url_of
from adacd_hil.log.recording import processes
from adacd_hil.log.recording.ring import Ring, RingReader
from adacd_hil.log.types.topics import run_channels

SDK = "foxglove.sdk.v1"
OLD = "foxglove.websocket.v1"
CHANNEL_IDS = {channel.id: channel.id for channel in run_channels(7, tuple(CODEC.messages.values()))}


def live_setup(**changes) -> LiveView:
    return dataclasses.replace(SETUP, **changes)


@pytest.fixture
def fed():
    with Feed() as one:
        yield one


@pytest.fixture(scope="module")
def served():
    """One that nothing is written to."""
    with Feed() as one:
        yield one.live.url


def opened(url, *, protocols=(SDK,), origin=None, host=None, **options):
    headers = {} if host is None else {"Host": host}
    return connect(
        url,
        subprotocols=list(protocols),
        origin=origin,
        additional_headers=headers,
        compression=None,
        proxy=None,
        max_queue=None,
        **options,
    )


def words_until_advertised(viewer):
    info = json.loads(viewer.recv(timeout=HANG_S))
    return info, json.loads(viewer.recv(timeout=HANG_S))


def ask(viewer, *topics):
    """Subscribe to topics, all or none named, and return their channels."""
    _, advertised = words_until_advertised(viewer)
    channels = [channel for channel in advertised["channels"] if not topics or channel["topic"] in topics]
    rows = [{"id": channel["id"] + 100, "channelId": channel["id"]} for channel in channels]
    viewer.send(json.dumps({"op": "subscribe", "subscriptions": rows}))
    return channels


def status_of(viewer):
    while True:
        data = viewer.recv(timeout=HANG_S)
        if isinstance(data, str) and (word := json.loads(data))["op"] == "status":
            return word


def code_at_the_end(viewer):
    """Read until the server closes the connection; return its reason."""
    try:
        while True:
            viewer.recv(timeout=HANG_S)
    except ConnectionClosed as closed:
        return closed.rcvd.code


# -- who may watch ---------------------------------------------------------------------------------------------------

OWN = socket.gethostname().lower()


@pytest.mark.parametrize(
    ("origin", "host", "status"),
    [
        (None, "127.0.0.1:8765", None),
        (None, "[::1]:8765", None),
        (None, "LOCALHOST.:8765", None),
        (None, OWN, None),
        (None, f"{OWN.partition('.')[0]}.local:8765", None),
        (None, "arm.lab.example:8765", None),  # --live-name
        (None, "stranger.example:8765", 403),
        (None, "127.0.0.1.stranger.example", 403),
        (None, "", 403),
        (None, "127.0.0.1:x", 403),
        (None, "user@127.0.0.1", 403),
        ("https://app.foxglove.dev", "127.0.0.1:8765", None),
        ("https://studio.foxglove.dev", "127.0.0.1:8765", None),
        ("file://", "127.0.0.1:8765", None),
        ("http://localhost:8080", "127.0.0.1:8765", None),
        ("https://[::1]:3000", "127.0.0.1:8765", None),
        ("https://view.lab.example", "127.0.0.1:8765", None),  # --live-origin
        ("viewer-app://", "127.0.0.1:8765", None),
        ("viewer-app://x", "127.0.0.1:8765", 403),
        ("https://View.Lab.Example", "127.0.0.1:8765", None),
        ("http://view.lab.example", "127.0.0.1:8765", 403),
        ("https://view.lab.example:444", "127.0.0.1:8765", 403),
        ("https://stranger.example", "127.0.0.1:8765", 403),
        ("null", "127.0.0.1:8765", 403),  # a sandboxed frame of anybody's
        ("", "127.0.0.1:8765", 403),
        ("https://app.foxglove.dev@stranger.example", "127.0.0.1:8765", 403),
        ("http://app.foxglove.dev", "127.0.0.1:8765", 403),
        ("http://localhost:8080/x", "127.0.0.1:8765", 403),
        ("http://127.0.0.1.stranger.example", "127.0.0.1:8765", 403),
        ("http://stranger.example:8765", "stranger.example:8765", 403),  # a name that was bound to this machine
    ],
)
def test_pages_of_viewers_and_names_of_this_machine_are_admitted(origin, host, status):
    admission = Admission(
        live_setup(origins=("https://view.lab.example/", "viewer-app://"), names=("arm.lab.example",))
    )
    refusal = admission.refuse([] if origin is None else [origin], [host], [SDK])
    assert (None if refusal is None else refusal.status) == status


@pytest.mark.parametrize(
    ("origins", "hosts", "protocols", "status"),
    [
        ([], [], [SDK], 403),
        ([], ["127.0.0.1", "127.0.0.1"], [SDK], 403),
        (["file://", "https://stranger.example"], ["127.0.0.1"], [SDK], 403),
        ([], ["127.0.0.1"], [], 400),
        ([], ["127.0.0.1"], ["foxglove.sdk.v2"], 400),
        ([], ["127.0.0.1"], ["foxglove.sdk.v2, foxglove.websocket.v1"], None),
        ([], ["127.0.0.1"], ["x", SDK], None),
    ],
)
def test_what_a_request_has_twice_or_not_at_all(origins, hosts, protocols, status):
    refusal = Admission(SETUP).refuse(origins, hosts, protocols)
    assert (None if refusal is None else refusal.status) == status


@pytest.mark.parametrize(
    ("request_options", "status", "word"),
    [
        ({"origin": "https://stranger.example"}, 403, "--live-origin"),
        ({"origin": "null"}, 403, "--live-origin"),
        ({"protocols": ("graphql-ws",)}, 400, "foxglove.websocket.v1"),
    ],
)
def test_who_is_refused_gets_the_reason_and_nothing_else(served, request_options, status, word):
    with pytest.raises(InvalidStatus) as refused:
        opened(served, **request_options)
    response = refused.value.response
    assert (response.status_code, word in response.body.decode()) == (status, True)
    assert "scheme" not in response.body.decode()


def page(url, *headers):
    """What a browser gets that is pointed at the port: status line, headers, body."""
    port = int(url.rsplit(":", 1)[1])
    with socket.create_connection(("127.0.0.1", port)) as client:
        client.sendall("\r\n".join(["GET / HTTP/1.1", *headers, "", ""]).encode())
        head, _, body = client.makefile("rb").read().decode().partition("\r\n\r\n")
    return head, body


def test_a_browser_gets_a_page_that_says_what_connects(served):
    host = served.removeprefix("ws://")
    head, body = page(served, f"Host: {host}", "Accept: text/html")
    assert head.startswith("HTTP/1.1 200")
    assert head.count("Content-Type:") == 1
    assert "Content-Type: text/html; charset=utf-8" in head
    assert f"<code>adacd-hil monitor --url {served}</code>" in body
    assert "Foxglove WebSocket" in body
    assert "<script" not in body
    assert "/scheme" not in body


def test_a_page_leaves_the_place_of_a_viewer_free():
    with Feed(live_setup(most_viewers=1)) as fed:
        host = f"Host: {fed.live.url.removeprefix('ws://')}"
        assert all(page(fed.live.url, host)[0].startswith("HTTP/1.1 200") for _ in range(3))
        with opened(fed.live.url):
            assert page(fed.live.url, host)[0].startswith("HTTP/1.1 200")


def raw_request(host, *more, key="AAAAAAAAAAAAAAAAAAAAAA==", protocol=SDK, path="/"):
    lines = [
        f"GET {path} HTTP/1.1",
        f"Host: {host}",
        "Upgrade: websocket",
        "Connection: Upgrade",
        f"Sec-WebSocket-Key: {key}",
        "Sec-WebSocket-Version: 13",
        f"Sec-WebSocket-Protocol: {protocol}",
        *more,
    ]
    return "\r\n".join([*lines, "", ""]).encode("latin-1")


def test_one_viewer_too_many_is_refused_until_one_has_left():
    with Feed(live_setup(most_viewers=2)) as fed, contextlib.ExitStack() as stack:
        first, _ = (stack.enter_context(opened(fed.live.url)) for _ in range(2))
        with pytest.raises(InvalidStatus) as refused:
            opened(fed.live.url)
        assert refused.value.response.status_code == FULL.status
        assert "--live-viewers" in refused.value.response.body.decode()
        first.close()
        stack.enter_context(opened(fed.live.url))  # its place is free


# -- what is said ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offered", [(SDK,), (OLD,), (OLD, SDK), ("x", OLD)])
def test_viewers_of_either_name_of_the_protocol_are_served_alike(fed, offered):
    run = make_run(40)
    with opened(fed.live.url, protocols=offered) as viewer:
        assert viewer.subprotocol in offered
        channels = ask(viewer, "/events", "/robot_description")
        events = next(channel for channel in channels if channel["topic"] == "/events")
        assert (events["encoding"], events["schemaEncoding"]) == ("cdr", "ros2msg")
        await_description(viewer, channels)
        fed.cycles(run, 1)
        message = next_message(viewer)
    assert struct.unpack_from("<BI", message) == (1, events["id"] + 100)
    assert b"name10" in message


def await_description(viewer, channels):
    number = next(channel["id"] for channel in channels if channel["topic"] == "/robot_description") + 100
    while struct.unpack_from("<BI", next_message(viewer)) != (1, number):
        pass


def next_message(viewer):
    while True:
        data = viewer.recv(timeout=HANG_S)
        if isinstance(data, bytes) and data[0] == 1:
            return data


def test_the_servers_time_is_offered_and_is_that_of_the_log(fed):
    run = make_run(200, start_ns=7_000_000_000)
    with opened(fed.live.url) as viewer:
        info, _ = words_until_advertised(viewer)
    assert info["capabilities"] == ["time"]
    times_ns, stamps_ns = [], []
    with opened(fed.live.url) as viewer:
        channels = ask(viewer, "/cycle", "/robot_description", "/events")
        await_description(viewer, channels)
        fed.cycles(run, 60)
        while True:
            data = viewer.recv(timeout=HANG_S)
            if data[0] == 2:
                times_ns.append(struct.unpack("<BQ", data)[1])
            else:
                stamps_ns.append((struct.unpack_from("<BIQ", data)[2], times_ns[-1] if times_ns else 0))
            if b"last\0" in data:
                break
    assert times_ns == sorted(times_ns)
    assert EPOCH_NS + 7_000_000_000 <= times_ns[0] < times_ns[-1] <= EPOCH_NS + 7_200_000_000
    assert len(times_ns) >= 8  # more often than the four times that something came
    assert all(abs(stamp_ns - time_ns) < 20_000_000 for stamp_ns, time_ns in stamps_ns[1:])


def test_a_viewer_can_end_a_subscription_and_begin_it_again(fed):
    with opened(fed.live.url) as viewer:
        channels = ask(viewer, "/events", "/robot_description")
        await_description(viewer, channels)
        rows = [{"id": 7, "channelId": channel["id"]} for channel in channels if channel["topic"] == "/events"]
        viewer.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [row["channelId"] + 100 for row in rows]}))
        viewer.send(json.dumps({"op": "subscribe", "subscriptions": rows}))
        viewer.send(json.dumps({"op": "subscribe", "subscriptions": rows}))  # the number is taken
        assert status_of(viewer)["level"] == 2
        fed.cycles(make_run(20), 1)
        assert struct.unpack_from("<BI", next_message(viewer)) == (1, 7)


NONSENSE = [
    "",
    "{",
    "[]",
    "7",
    '"subscribe"',
    '{"op": "subscribe"}',
    '{"op": "subscribe", "subscriptions": 3}',
    '{"op": "subscribe", "subscriptions": [3]}',
    '{"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 1}]}',
    '{"op": "subscribe", "subscriptions": [{"id": 1e999, "channelId": 1}]}',
    '{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 4711}]}',
    '{"op": "subscribe", "subscriptions": [{"id": ' + 4400 * "9" + ', "channelId": 1}]}',
    '{"op": "unsubscribe", "subscriptionIds": ["x"]}',
    '{"op": "unsubscribe", "subscriptionIds": [99]}',
    30_000 * "[",
    '{"op": "advertise", "channels": [{"id": 1, "topic": "/to_can_bus", "encoding": "cdr", "schemaName": "x"}]}',
    '{"op": "setParameters", "parameters": [{"name": "arm.torque_limit_Nm", "value": 99}]}',
    b"",
    b"\x01\x00\x00\x00\x00payload",
    b"\xff",
    "\x1b]0;owned\x07",
]


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (70_000 * "x", 1009),
        (json.dumps({"op": "subscribe", "subscriptions": [{"id": n, "channelId": 1} for n in range(500)]}), 1008),
    ],
)
def test_a_viewer_that_asks_for_too_much_is_closed(served, data, code):
    with opened(served) as viewer:
        viewer.send(data)
        assert code_at_the_end(viewer) == code


def test_nothing_that_a_peer_sends_reaches_the_runs_terminal():
    escape = "\x1b]0;owned\x07\x1b[2J"
    script = (
        "import sys; sys.path[:0] = sys.argv[1:]\n"
        "from live_rig import Feed\n"
        "if __name__ == '__main__':\n"
        "    fed = Feed(); print(fed.live.url, flush=True); sys.stdin.read(); fed.close()\n"
    )
    folder = Path(__file__).parent
    run = subprocess.Popen(
        [sys.executable, "-c", script, str(folder), str(folder.parent)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    url = run.stdout.readline().decode().strip()
    port = int(url.rsplit(":", 1)[1])
    hostile = [
        raw_request("127.0.0.1", f"Origin: https://{escape}"),
        raw_request("127.0.0.1", f"Origin: https://{escape}"),
        raw_request("127.0.0.1", "Origin: https://owned.example"),
        raw_request("127.0.0.1", "Origin: https://owned.example"),
        raw_request(escape),
        raw_request("owned.example"),
        raw_request("127.0.0.1", protocol=escape),
        raw_request("127.0.0.1", protocol="owned"),
        raw_request("127.0.0.1", key=escape),
        raw_request("127.0.0.1", path=f"/{escape}"),
        raw_request("127.0.0.1", f"X: {'y' * 100_000}"),
        f"{escape}\r\n\r\n".encode(),
        b"\x16\x03\x01\x02\x00" + os.urandom(500),  # TLS
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    ]
    for request in hostile:
        with socket.create_connection(("127.0.0.1", port)) as client:
            client.sendall(request)
            if not request.endswith(b"\r\n\r\n"):  # the server would wait for the rest
                client.shutdown(socket.SHUT_WR)
            with contextlib.suppress(ConnectionResetError):
                client.recv(4096)
    with opened(url) as viewer:
        for data in NONSENSE:
            viewer.send(data)
        status_of(viewer)
    out, complaints = run.communicate(timeout=HANG_S)
    lines = complaints.decode().splitlines()
    assert run.returncode == 0
    assert out == b""
    notices = {each.notice for each in vars(admission_module).values() if isinstance(each, ViewerRefusal)}
    assert set(lines) <= notices
    assert len(lines) == len(set(lines)) == 3  # of origin, name and protocol, once each


# -- the log ---------------------------------------------------------------------------------------------------------


def live_process_of(writer_pid):
    """Find the process of the live view among the writer's children."""
    (child,) = Path(f"/proc/{writer_pid}/task/{writer_pid}/children").read_text().split()
    return int(child)


def is_running(pid):
    """Whether a process is there and no zombie."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes() != b""
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
def test_a_live_view_that_is_stopped_or_killed_costs_the_log_nothing(tmp_path, number):
    run = make_run(1500, seed=9)
    recorder = start(tmp_path / "run.mcap", run, live=SETUP)
    other = start(tmp_path / "alone.mcap", run)
    pid = live_process_of(recorder.pid)
    with opened(recorder.live_url) as viewer:
        channels = ask(viewer)
        await_description(viewer, channels)
        os.kill(pid, number)
        for each in (recorder, other):
            feed(each, run.cycles)
            assert each.close().is_complete
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    assert (tmp_path / "run.mcap").read_bytes() == (tmp_path / "alone.mcap").read_bytes()


def test_the_live_view_ends_when_the_writer_dies(tmp_path):
    recorder = start(tmp_path / "run.mcap", make_run(1), live=SETUP)
    pid = live_process_of(recorder.pid)
    with opened(recorder.live_url) as viewer:
        words_until_advertised(viewer)
        os.kill(recorder.pid, signal.SIGKILL)
        assert code_at_the_end(viewer) == 1001
    assert not recorder.close().is_complete
    while is_running(pid):
        os.sched_yield()


@pytest.fixture
def unstarted():
    """A server that listens and has not begun to serve, its socket, and what the log's writer tells it through."""
    ring = Ring(2**16)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    reader = RingReader(ring.descriptor)
    server = LiveServer(ServerSetup(SETUP, setup_of(None), CHANNEL_IDS, EPOCH_NS), reader, theirs)
    yield server, listen(SETUP), ours
    for end in (ours, theirs, ring):
        end.close()


@pytest.mark.parametrize("steps", range(5))
def test_a_viewer_that_comes_as_the_run_ends_leaves_nothing_open(steps, unstarted, monkeypatch):
    """It comes so many steps of the server's loop after the end was said."""
    monkeypatch.setattr(server_module, "LINGER_S", 0.1)
    server, listening, writer = unstarted
    address = listening.getsockname()

    async def meet():
        serving = asyncio.create_task(server.run(listening))
        silent = await asyncio.open_connection(*address)  # has its viewer accepted, and never says a word
        refused = await asyncio.open_connection(*address)
        refused[1].write(raw_request("elsewhere.example"))
        assert (await refused[0].read()).startswith(b"HTTP/1.1 403")
        writer.send(processes.END)
        for _ in range(steps):
            await asyncio.sleep(0)
        with contextlib.suppress(ConnectionRefusedError), socket.create_connection(address):
            await serving
        await serving
        for _, theirs in (silent, refused):
            theirs.close()

    asyncio.run(meet())
    gc.collect()  # whatever is still open warns, and a warning is an error


def test_an_address_of_version_6_is_written_so_that_it_can_be_opened():
    setup = live_setup(host="::1")
    with socket.socket(socket.AF_INET6) as listening:
        try:
            listening.bind(("::1", 0))
        except OSError as error:
            pytest.skip(f"no IPv6 here: {error}")
        assert url_of(setup, listening) == f"ws://[::1]:{listening.getsockname()[1]}"
