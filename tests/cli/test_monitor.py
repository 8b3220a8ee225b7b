"""What `monitor` prints, and that it only listens."""

import json

from called import called
from rig import CODEC, Rig

from adacd_hil.cli.connection import Connection
from adacd_hil.lab.cli.monitor_command import Monitor, as_text
from adacd_hil.wire.bus import Frame


def monitor(rig: Rig, node_id: int | None = None) -> Monitor:
    connection = Connection("embedded", "embedded", None, "paper", None, None)
    return Monitor(connection, connection.load_decoder(), rig.bus, rig.clock, node_id)


def test_the_table_shows_nodes_messages_and_load():
    rig = Rig(is_wall=True)
    rig.start()
    rig.add_host()
    rig.bus.deliver(0x055, b"\xab\xcd")
    watched = monitor(rig)
    watched.listen(1.0)
    lines = [line.split() for line in as_text(watched.describe()).splitlines()]
    assert ["1", "Drive1", "operational"] in [line[:3] for line in lines]
    (feedback,) = [line for line in lines if "Drive1Feedback" in line]
    assert (feedback[0], feedback[4:6]) == ("0x181", ["-", "0"])
    assert 970.0 <= float(feedback[2]) <= 1000.0  # up to one slice of waiting is still in the queue
    assert feedback[6:9] == ["position", "-0.523597", "rad,"]
    (unknown,) = [line for line in lines if line[:3] == ["0x055", "unknown", "1.0"]]
    assert unknown[-1] == "[abcd]"
    assert rig.sent == []
    of_one = monitor(rig, node_id=3)
    of_one.listen(0.5)
    shown = {message["message"] for message in of_one.describe()["messages"]}
    assert shown == {"Sensor1Torque", "Sensor1Status", "Sensor1Heartbeat"}


def test_frames_that_this_computer_dropped_are_not_counted_against_the_sensor(monkeypatch):
    rig = Rig(is_wall=True)
    rig.start()
    rig.add_host()
    inner = rig.bus.receive
    heard = 0

    def lossy(timeout_s: float) -> Frame | None:  # of the frames of 0.5 s nothing is read
        nonlocal heard
        heard += 1
        while 3000 <= heard < 6000 and inner(1.0) is not None:
            heard += 1
        return inner(timeout_s)

    monkeypatch.setattr(rig.bus, "receive", lossy)
    monkeypatch.setattr(type(rig.bus), "frames_lost", property(lambda _: 3000 * (heard >= 6000)), raising=False)
    watched = monitor(rig)
    watched.listen(1.5)
    messages = {message["message"]: message for message in watched.describe()["messages"]}
    assert heard > 6500
    assert (messages["Sensor1Torque"]["lost"], messages["Sensor1Torque"]["errors"]) == (0, 0)


def test_a_full_bus_ends_in_time_and_misses_nothing():
    rig = Rig(is_wall=True)
    inner = rig.bus.receive

    def flood(timeout_s: float) -> Frame:  # a frame is always waiting
        rig.clock.sleep_until_ns(rig.clock.now_ns() + 50_000)
        return inner(0.0) or Frame(0x7FF, bytes(8), rig.clock.now_ns())

    rig.bus.receive = flood  # type: ignore[method-assign]
    watched = monitor(rig)
    begin_ns = rig.clock.now_ns()
    watched.listen(0.2)
    assert 0.2 <= (rig.clock.now_ns() - begin_ns) * 1e-9 < 0.215  # a batch later at most
    assert watched.describe()["frames"] in range(4000, 4300)


def test_a_silent_bus_is_said_to_be_and_json_is_one_snapshot():
    words = ("monitor", "-i", "virtual", "-c", "silent", "--seconds", "0.1")
    result = called(*words)
    assert (result.exit_code, result.stderr) == (0, "listening on silent\n")
    assert result.stdout == "load 0.0 %, 0 frames, 0 error frames\n\nnothing heard\n"
    described = json.loads(called(*words, "--json").stdout)
    assert (described["frames"], described["messages"], described["not_processed"]) == (0, [], None)


def test_every_signal_of_the_contract_can_be_shown():
    rig = Rig(is_wall=True)
    watched = monitor(rig)
    for message in CODEC.messages.values():
        data = message.sender().protect(bytearray(message.length)) if message.is_protected else bytes(message.length)
        rig.bus.deliver(message.can_id, data)
    watched.listen(0.1)
    described = {row["message"]: row for row in watched.describe()["messages"]}
    assert {name: tuple(row["values"]) for name, row in described.items()} == {
        message.name: tuple(signal.name for signal in message.values) for message in CODEC.messages.values()
    }
