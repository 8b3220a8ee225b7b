"""`adacd-hil play`: what goes out, what doesn't, and what is said."""

import json

import can
import pytest
from click.testing import CliRunner

from adacd_hil.lab.cli import play_command as play_module
from adacd_hil.lab.cli.play_command import play
from adacd_hil.lab.logs.frame_writer import FrameWriter
from adacd_hil.log.frames.mcap_frames import RecordedFrame
from adacd_hil.scheduling import RealtimeGrant

CHANNEL = "test_play"
KINDS = (
    {"can_id": 0x000, "data": b"\x01\x00", "is_tx": True},
    {"can_id": 0x080, "data": b"\x07"},  # the host's, whoever recorded it
    {"can_id": 0x181, "data": bytes(8), "is_tx": True},
    {"can_id": 0x18DAF110, "data": b"\x01", "is_extended": True, "is_tx": True},
    {"can_id": 0x201, "data": bytes(6), "is_tx": True},
    {"can_id": 0x7A5, "data": b"\x02"},
    {"can_id": 0x181, "data": b"", "length": 8, "is_remote": True},
    {"can_id": 0x080, "data": bytes(8), "is_error": True},
    {"can_id": 0x181, "data": bytes(8), "is_fd": True, "has_rate_switch": True},
    {"can_id": 0x123, "data": b"", "is_extended": True},
)
"""A frame of every kind that a playback meets."""


@pytest.fixture(autouse=True)
def plain_process(monkeypatch):
    """Keep this process, which other tests share, from becoming a real-time one."""
    monkeypatch.setattr(play_module, "request_realtime", lambda: RealtimeGrant("SCHED_OTHER"))
    monkeypatch.setattr(play_module, "freeze_garbage", lambda: None)


@pytest.fixture
def listener():
    with can.Bus(interface="virtual", channel=CHANNEL, receive_own_messages=False) as bus:
        yield bus


def heard(bus):
    return list(iter(lambda: bus.recv(0), None))


@pytest.fixture(params=[0, 5_000_000_000])
def log(request, tmp_path):
    """A recording that begins at a time."""
    path = tmp_path / "bus.mcap"
    with path.open("wb") as file:
        writer = FrameWriter(file)
        for number, kind in enumerate(KINDS):
            t_ns = request.param + 1_000_000 * number
            writer.write_frame(RecordedFrame(**{"t_ns": t_ns, "length": len(kind["data"]), **kind}))
        writer.finish()
    return path


def run(log, *arguments):
    command = [str(log), "-i", "virtual", "-c", CHANNEL, *arguments]
    return CliRunner().invoke(play, command)


def test_every_frame_goes_out_in_its_order(log, listener):
    done = run(log, "--json")
    described = json.loads(done.stdout)
    messages = heard(listener)
    assert done.exit_code == 0, done.stderr
    assert [m.arbitration_id for m in messages] == [0x000, 0x080, 0x181, 0x18DAF110, 0x201, 0x7A5]
    assert [bytes(m.data) for m in messages][:3] == [b"\x01\x00", b"\x07", bytes(8)]
    assert messages[3].is_extended_id
    assert (described["frames"], described["unsendable"], described["withheld"]) == (6, 4, 0)
    assert described["lateness_us"]["p50"] <= described["lateness_us"]["p99"] <= described["lateness_us"]["max"] + 1


@pytest.mark.parametrize(
    ("options", "expected", "unsendable"),
    [
        (("--only", "host"), [0x000, 0x080, 0x18DAF110, 0x201], 0),
        (("--only", "devices"), [0x181, 0x7A5], 4),
        (("--start", "0.002", "--end", "0.004"), [0x181, 0x18DAF110], 0),
        (("--id", "181", "--loop", "3", "--speed", "2"), [0x181] * 3, 6),
    ],
)
def test_frames_are_chosen(log, listener, options, expected, unsendable):
    """By side, which the contract says and else the direction, by time and identifier."""
    done = run(log, *options, "--json")
    assert (done.exit_code, json.loads(done.stdout)["unsendable"]) == (0, unsendable)
    assert [m.arbitration_id for m in heard(listener)] == expected


@pytest.mark.parametrize(
    ("options", "status", "words"),
    [
        (("--start", "100"), 1, "no frame sent: the recording has none"),
        (("--id", "7ff"), 1, "no frame sent: the recording has none"),
        (("--start", "0.004", "--end", "0.002"), 2, "--start 0.004 s is not before --end 0.002 s"),
        (("--end", "inf"), 2, "inf is not finite"),
        (("--speed", "nan"), 2, "nan is not finite"),
    ],
)
def test_a_choice_that_leaves_no_frame_is_a_failure(log, listener, options, status, words):
    done = run(log, *options)
    assert (done.exit_code, heard(listener)) == (status, [])
    assert words in done.output


def test_a_recording_of_two_buses_is_refused_unless_the_choice_is_of_one(listener, tmp_path):
    path = tmp_path / "any.log"
    path.write_text("(1.0) can0 080#01\n(1.0) can1 080#01\n(1.1) can1 181#0000000000000000\n")
    done = run(path)
    assert (done.exit_code, heard(listener), len(done.stderr.splitlines())) == (1, [], 1)
    assert all(name in done.stderr for name in ("can0", "can1"))
    assert run(path, "--id", "181").exit_code == 0
    assert [m.arbitration_id for m in heard(listener)] == [0x181]


def test_a_real_bus_gets_what_devices_send_and_commands_when_asked_for(log, listener, monkeypatch):
    monkeypatch.setattr(play_module, "is_virtual", lambda *_: False)
    done = run(log)
    assert [m.arbitration_id for m in heard(listener)] == [0x181]
    assert "5 frames withheld: they could move an arm on this bus; --commands sends them, too" in done.stdout
    assert "4 frames can't be sent" in done.stdout
    assert "withheld" not in run(log, "--commands").stdout
    assert len(heard(listener)) == 6


def test_a_damaged_recording_is_played_up_to_its_damage_and_partial(log, listener):
    log.write_bytes(log.read_bytes()[:-20])
    done = run(log)
    assert (done.exit_code, len(heard(listener))) == (3, 6)
    assert "warning: bus.mcap is cut" in done.stdout
