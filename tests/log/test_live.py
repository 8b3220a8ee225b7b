"""The live view: what a viewer receives, and that the log doesn't care whether somebody watches."""

import functools
import json
import math
import os
import signal
import socket
import struct
from pathlib import Path
from types import SimpleNamespace

import pytest
from hang import HANG_S
from live_rig import (
    EPOCH_NS,
    LAST,
    LINK_LENGTH_M,
    SETUP,
    URDF,
    Feed,
    ThreadedWriter,
    by_topic,
    first_cycles_of_slots,
    receive_until_last,
    setup_of,
)
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from recorded_run import CODEC, feed, make_run, start
from websockets.sync.client import connect

from adacd_hil.clock import VirtualClock
from adacd_hil.lab.live.client import LiveClient, live_client
from adacd_hil.lab.live.live_view import LiveView
from adacd_hil.lab.live.server import BACKLOG, BACKLOG_BYTES
from adacd_hil.log.log_files import LogError
from adacd_hil.log.recording.log_file import Sink
from adacd_hil.log.recording.packet import pack_cycle, pack_event
from adacd_hil.log.recording.recorder import Recorder
from adacd_hil.records import Event

STATED_HZ = {
    "/scheme": 50,
    "/joint_states": 50,
    "/control": 50,
    "/arm": 20,
    "/cycle": 20,
    "/to_can_bus": 10,
    "/from_can_bus": 10,
    "/contact": 0,
    "/events": 0,
    **{f"/decoded/{name}": 10 for name in CODEC.messages},
}
"""As docs/live.md has it."""
FLOOD = 4000


@pytest.fixture(scope="module")
def run():
    return make_run(1000, seed=5)


@pytest.fixture(scope="module")
def watched(run):
    """All that a viewer receives of a run, what it was told of the topics, and the file that was written meanwhile."""
    with Feed() as fed, live_client(fed.live.url) as client:
        fed.cycles(run, 37)
        messages = receive_until_last(client)
        topics = client.topics
    return messages, topics, fed.file()


def test_a_viewer_receives_every_topic_at_its_rate_as_the_file_has_it(watched):
    messages, _, file = watched
    expected = first_cycles_of_slots(file, STATED_HZ)
    received = by_topic(messages)
    assert {topic for topic in received if topic not in expected} == {"/tf", "/scene", "/robot_description"}
    assert {topic: received.get(topic) for topic in expected} == expected
    assert len(received["/robot_description"]) == 1


def decode(topic, payload):
    name, text = topic
    schema = Schema(id=1, name=name, encoding="ros2msg", data=text.encode())
    return DecoderFactory().decoder_for("cdr", schema)(payload)


def test_the_transforms_put_the_links_where_the_joints_are(watched):
    messages, topics, _ = watched
    received = by_topic(messages)
    assert decode(topics["/robot_description"], received["/robot_description"][0][1]).data == URDF
    assert [log_ns for log_ns, _ in received["/tf"]] == [log_ns for log_ns, _ in received["/joint_states"]]
    q = decode(topics["/joint_states"], received["/joint_states"][-1][1]).position
    log_ns, payload = received["/tf"][-1]
    transforms = decode(topics["/tf"], payload).transforms
    names = [(transform.header.frame_id, transform.child_frame_id) for transform in transforms]
    assert names == [("world", "base"), ("base", "link1"), ("link1", "link2"), ("link2", "tip")]
    stamps = {transform.header.stamp.sec * 1_000_000_000 + transform.header.stamp.nanosec for transform in transforms}
    assert stamps == {log_ns}
    angles = [2.0 * math.atan2(t.transform.rotation.z, t.transform.rotation.w) for t in transforms]
    assert angles == pytest.approx([0.0, *q, 0.0])
    assert [t.transform.translation.x for t in transforms] == [0.0, 0.0, *LINK_LENGTH_M]


def test_the_scene_shows_the_joints_at_its_rate_and_every_contact(watched, run):
    messages, topics, _ = watched
    received = by_topic(messages)
    scenes = [[entity.id for entity in decode(topics["/scene"], data).entities] for _, data in received["/scene"]]
    contacts = sum(cycle.contact is not None for cycle in run.cycles)
    slots = {log_ns // 100_000_000 for log_ns, _ in received["/scheme"]}
    assert scenes.count(["contact"]) == contacts > 0
    assert scenes.count(["joint1", "joint2", "state"]) == len(slots) > 5
    assert len(scenes) == contacts + len(slots)


def test_a_record_that_makes_no_sense_is_not_drawn_and_nothing_stops(run):
    with Feed() as fed, live_client(fed.live.url, ["/scene", "/events", "/scheme"]) as client:
        odd = make_run(1, seed=5)
        odd.cycles[0].output = odd.cycles[0].output._replace(state=200)
        fed.cycles(odd, 1)
        received = by_topic(receive_until_last(client))
    assert len(received["/scheme"]) == 1
    assert "/scene" not in received


def test_a_slow_viewer_costs_messages_and_never_the_log():
    fed, alone = Feed(), Feed(None)
    narrow = socket.create_connection(("127.0.0.1", int(fed.live.url.rsplit(":", 1)[1])))
    narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    options = {"subprotocols": ["foxglove.sdk.v1"], "compression": None, "max_queue": 1, "sock": narrow}
    with connect(fed.live.url, **options) as slow:
        advertised = next(word for word in map(json.loads, slow) if word["op"] == "advertise")
        for topic in ("/events", "/robot_description"):
            subscribe(slow, [channel for channel in advertised["channels"] if channel["topic"] == topic])
        slow.recv(timeout=HANG_S)
        for file in (fed, alone):
            flood(file)
        received = 1
        while b"last\0" not in slow.recv(timeout=HANG_S):
            received += 1
    fed.close()
    assert min(BACKLOG, BACKLOG_BYTES // 4200) <= received < FLOOD  # a message has 4.1 kB
    assert fed.file() == alone.file()


def flood(fed):
    """Write more than the system and the server keep for a client that doesn't read."""
    for number in range(FLOOD):
        fed.event(number, Event("info", "flood", 4000 * "x"))
        if number % 500 == 0 or number == FLOOD - 1:
            fed.write()
            while fed.live is not None and fed.live._ring.waiting:  # what finds no room isn't shown at all
                os.sched_yield()
    fed.event(FLOOD, LAST)
    fed.write()


def subscribe(connection, channels):
    subscriptions = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels]
    connection.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))


@pytest.mark.usefixtures("writer_process")
def test_the_file_of_the_writer_is_the_same_watched_or_not(tmp_path):
    run = make_run(300, seed=6)
    run.cycles[-1].event = LAST
    loaded = set()
    for name, live in (("watched", SETUP), ("alone", None)):
        recorder = start(tmp_path / f"{name}.mcap", run, live=live)
        loaded.add("websockets" in Path(f"/proc/{recorder.pid}/maps").read_text())
        if live is None:
            feed(recorder, run.cycles)
        else:
            with live_client(recorder.live_url) as client:
                feed(recorder, run.cycles)
                recorder.flush()
                received = by_topic(receive_until_last(client))
        assert recorder.close().is_complete
    assert loaded == {False}  # what serves is in a process of its own
    assert (tmp_path / "watched.mcap").read_bytes() == (tmp_path / "alone.mcap").read_bytes()
    assert len(received["/scheme"]) == 15
    assert len(received["/events"]) == sum(cycle.event is not None for cycle in run.cycles)


def test_a_port_that_is_taken_is_named_and_leaves_no_log(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        live = LiveView("127.0.0.1", port)
        with pytest.raises(LogError, match=rf"can't listen on 127\.0\.0\.1:{port}: .*in use"):
            Recorder(tmp_path / "run.mcap", messages=CODEC.messages.values(), live=live)
    assert list(tmp_path.iterdir()) == []


def test_who_comes_late_gets_the_description_with_the_time_of_the_last_record():
    late = make_run(1, start_ns=7_000_000_000)
    with Feed() as fed, live_client(fed.live.url, []) as client:
        assert client.receive(HANG_S)[:2] == ("/robot_description", EPOCH_NS)
        fed.cycles(late, 1)
        with live_client(fed.live.url, []) as second:
            message = second.receive(HANG_S)
    assert message[:2] == ("/robot_description", EPOCH_NS + 7_000_000_000 + 60)  # its last frame


def test_nothing_is_sent_or_kept_while_nobody_watches(run):
    with Feed() as fed:
        with live_client(fed.live.url, ["/events"]) as client:
            assert fed.live.is_watched
            client.receive(HANG_S)
        while fed.live.is_watched:  # until the server has seen it go
            os.sched_yield()
        fed.cycles(make_run(50), 50)
        with live_client(fed.live.url) as client:
            first = client.receive(HANG_S)
    assert (first.topic, first.log_ns) == ("/robot_description", EPOCH_NS)


def test_a_viewer_that_leaves_amid_what_it_has_not_read_leaves_at_once(run, monkeypatch):
    endless = functools.partial(connect, close_timeout=2 * HANG_S)  # one that waited for it would meet the time limit
    monkeypatch.setattr("adacd_hil.lab.live.client.connect", endless)
    with Feed() as fed, live_client(fed.live.url) as client:
        fed.cycles(run, 100)
        assert client.receive(HANG_S) is not None


def test_a_live_view_that_is_stopped_never_makes_the_writer_wait():
    with Feed() as fed, live_client(fed.live.url, ["/events"]):
        os.kill(fed.live.process.pid, signal.SIGSTOP)
        for number in range(4000):  # more than its socket and its ring have room for
            fed.event(number, Event("info", "flood", 6000 * "x"))
            if number % 8 == 0:
                fed.write()
        assert fed.live.hidden > 50
        os.kill(fed.live.process.pid, signal.SIGCONT)


def test_in_real_time_the_writer_shows_sooner_than_it_flushes_and_waits_for_nobody(tmp_path):
    run = make_run(1)
    run.cycles[0].event = LAST
    path, clock = tmp_path / "run.mcap", VirtualClock()
    clock.sleep_until_ns(3_000_000_000)
    sink = Sink(os.open(path, os.O_WRONLY | os.O_CREAT), waits=False)
    writer = ThreadedWriter(setup_of(SETUP, path), sink, clock)
    live = writer.process.live
    with live_client(live.url) as client:
        assert client.receive(HANG_S)[:2] == ("/robot_description", EPOCH_NS + 3_000_000_000)
        writer.ring.put_packet(pack_cycle(run.cycles[0].t_ns, 0, run.cycles[0].messages(), []))
        writer.ring.put_packet(pack_event(run.cycles[0].t_ns, 0, LAST))
        assert "/scheme" in by_topic(receive_until_last(client))
        writer.end()
    live.process.wait(HANG_S)
    assert clock.now_ns() == 3_000_000_000


@pytest.mark.parametrize(
    "word",
    [
        "7",
        "{}",
        "{",
        '{"op": "advertise"}',
        '{"op": "advertise", "channels": [{"id": 1}]}',
        '{"op": "advertise", "channels": 7}',
        5000 * "[",
        struct.pack("<BIQ", 1, 99, 5),
        struct.pack("<BQ", 2, 5),  # the time, without end
    ],
)
def test_a_server_that_is_none_of_ours_is_one_line(word, monkeypatch):
    monkeypatch.setattr("adacd_hil.lab.live.client.OPEN_TIMEOUT_S", 0.05)
    with pytest.raises(LogError, match=r"^it does not serve a log of adacd-hil$"):
        LiveClient(SimpleNamespace(recv=lambda timeout: word), None)
